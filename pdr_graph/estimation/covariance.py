"""Covariance of every step, from the factorised graph; batch and live."""

from __future__ import annotations

import numpy as np

from pdr_graph.estimation.factors.chain import Evaluation
from pdr_graph.estimation.normal_equations import Solution
from pdr_graph.geometry import pose_rotation
from pdr_graph.types import Array, Index

MOST_AT_ONCE = 2000  # pieces whose matrices fit into a processor's cache


def covariance_of_ends(at: Evaluation, solution: Solution, which: Index) -> tuple[Array, Array]:
    """Covariances of (x, y, heading) at the start and the ends of some pieces ``(1 + n, 3, 3)``, in the output axes.

    Between keyframes: the joint of x_i, x_j and c through the derivatives of the sub-steps, plus the covariance of a
    step given both ends. at, solution: the walk at the optimum, and its linear system there.

    Also returns the covariances of c ``(s, 3, 3)``.
    """
    R_0, first = pose_rotation(at.pose_i[:1, 2]), np.zeros(1, dtype=np.intp)
    covariance = np.empty((1 + len(which), 3, 3))
    covariance[:1] = R_0 @ solution.joint(("x", first)) @ R_0.transpose(0, 2, 1)
    for n in range(0, len(which), MOST_AT_ONCE):
        part = which[n : n + MOST_AT_ONCE]
        i, of_piece = np.unique(at.pieces.interval[part], return_inverse=True)
        joint = solution.joint(("x", i), ("x", i + 1), ("c", at.chain.segment[i]))
        covariance[1 + n : 1 + n + len(part)] = covariance_of_pieces(joint[of_piece], at, part)
    return covariance, solution.joint(("c", np.arange(len(at.state.c))))


def covariance_of_pieces(joint: Array, at: Evaluation, which: Index) -> Array:
    """Covariance ``(n, 3, 3)`` of the poses at the ends of some pieces, in the output axes.

    joint: covariance ``(n, 9, 9)`` of x_i, x_j and c of the interval of each.
    """
    placed, interval = at.poses_of(which), at.pieces.interval[which]
    D = np.concatenate([placed.by_i, placed.by_j, placed.by_c], axis=2)
    R = pose_rotation(at.pose_i[interval, 2])
    spread = at.chain.bridge.spread[which]
    return D @ joint @ D.transpose(0, 2, 1) + R @ spread @ R.transpose(0, 2, 1)
