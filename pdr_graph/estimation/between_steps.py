"""Pose and covariance at any time: between steps, and inside the interval of two keyframes.

The step that a time falls into is split there, in proportion of time, as a fix would split it. The part is placed like
every step, by the conditional mean of a Gaussian walk whose two ends are known (`Evaluation.poses_of`), and its
covariance is that of `covariance_of_ends`: the joint of x_i, x_j and c through its derivatives, plus the spread given
both ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from pdr_graph.estimation.factors.base import CALIBRATION, POSE
from pdr_graph.estimation.factors.chain import Evaluation, Pieces, bridge, parts_of, preintegrate, step_residuals
from pdr_graph.estimation.linear_system import Covariances, NormalEquations
from pdr_graph.geometry import pose_rotation
from pdr_graph.types import INSTANT, Array, Between, Index

Joint = Callable[[Index], Array]
"""Joint covariances ``(n, 9, 9)`` of x_i, x_j and c of intervals ``(n,)``, poses in their own axes."""


def poses_between(at: Evaluation, joint: Joint, c: Sequence[float], time: Array) -> tuple[Array, Array]:
    """Poses ``(n, 3)`` and covariances ``(n, 3, 3)`` in the output axes at times ``(n,)`` [s] between two keyframes.

    at: the walk at the optimum; joint: of its variables there; c: (R_s, R_d, b) of the bridges of its chain.
    """
    chain, poses = at.chain, at.state.poses
    interval = np.clip(np.searchsorted(chain.time, time - INSTANT) - 1, 0, len(chain.segment) - 1)
    first, after = int(interval.min()), int(interval.max()) + 1
    pieces, which = split(chain.pieces.between(first, after), time)
    increments = preintegrate(pieces, at.state.c[chain.segment[first:after]])
    expected = preintegrate(pieces, np.tile(c, (after - first, 1)))
    here = replace(chain, pieces=pieces, bridge=bridge(pieces, expected))
    state = at.state.replaced(x=poses[first : after + 1])
    residual = step_residuals(poses[first:after], poses[first + 1 : after + 1], increments, pieces)
    placed = Evaluation(here, state, (), increments, residual).poses_of(np.maximum(which, 0))

    R, at_start = pose_rotation(poses[interval, 2]), which < 0
    D = np.concatenate([placed.by_i, placed.by_j, placed.by_c], axis=2)
    spread = R @ here.bridge.spread[np.maximum(which, 0)] @ R.transpose(0, 2, 1)
    D[at_start], spread[at_start] = 0.0, 0.0  # nothing was walked
    D[at_start, :, :3] = R[at_start]
    value = np.where(at_start[:, None], poses[interval], placed.value)
    return value, D @ joint(interval) @ D.transpose(0, 2, 1) + spread


def split(pieces: Pieces, time: Array) -> tuple[Pieces, Index]:
    """The pieces, split at times ``(n,)`` [s], and the piece that ends at each time; −1 for the start of the first.

    The whole rows of a trajectory are left out.
    """
    whole = pieces.keyframe_time[pieces.interval] + pieces.to_end[1]
    inside = np.abs(whole[np.clip(np.searchsorted(whole, time - INSTANT), 0, len(whole) - 1)] - time) > INSTANT
    inside &= time > pieces.keyframe_time[0] + INSTANT
    end = np.union1d(whole, time[inside]).astype(float)
    interval = pieces.interval[np.searchsorted(whole, end)]
    first, none = np.flatnonzero(np.diff(interval, prepend=-1)), np.empty(0, dtype=np.intp)
    turn, begin = 2 * (pieces.to_end[0] - pieces.to_middle[0]), float(pieces.keyframe_time[0])
    columns = np.column_stack([whole, pieces.length, turn, pieces.variance])
    which = np.where(time > begin + INSTANT, np.searchsorted(end, time - INSTANT), -1)
    return parts_of(columns, begin, end, interval, first, none), np.minimum(which, len(end) - 1)


def joint_of(at: Evaluation, solution: Covariances) -> Joint:
    """The joint covariances of the intervals of a walk at the optimum."""
    return lambda i: solution.joint((POSE, i), (POSE, i + 1), (CALIBRATION, at.chain.segment[i]))


def between_of(at: Evaluation, c: Sequence[float]) -> Between:
    """`poses_between` of a walk at its optimum; keeps 650 bytes per keyframe. c: (R_s, R_d, b) of its bridges."""
    joint = joint_of(at, NormalEquations(at).assembled(at).solution)(np.arange(len(at.chain.segment)))
    at.forget_blocks()
    return lambda time: poses_between(at, joint.__getitem__, c, time)
