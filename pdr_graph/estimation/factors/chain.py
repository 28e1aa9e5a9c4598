"""The chain of keyframes, and the poses of the steps between them at one state of the variables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pdr_graph.estimation.factors.base import FactorBlock, Linearized, Measurement, State
from pdr_graph.estimation.factors.preintegration import Bridge, Increments, Pieces, bridge, preintegrate
from pdr_graph.estimation.factors.protocols import Priced
from pdr_graph.geometry import nearest, pose_rotation, wrap_angle
from pdr_graph.types import INSTANT, Array, Complex, Index

Priors = frozenset[tuple[str, int]]  # names of blocks, and numbers of the factors in them


@dataclass(frozen=True)
class Chain:
    """Keyframes, and the steps between them, cut into pieces.

    pieces, bridge: of the ``k`` intervals; delta: ``(k, 3)`` displacement of each, x, y [m], heading [rad], with the
    prior mean of the calibration; segment: ``(k,)`` the calibration of each, as row of the state.
    number: ``(k + 1,)`` of each keyframe, segment_number: ``(s,)`` of each calibration, in GTSAM's keys; begins,
    ends: True if the walk begins or ends with this chain.
    """

    pieces: Pieces
    bridge: Bridge
    delta: Array
    segment: Index
    number: Index
    segment_number: Index
    begins: bool = True
    ends: bool = True

    @classmethod
    def of(cls, pieces: Pieces, segment: Index, c: Array) -> Chain:
        """A chain whose variables are numbered 0, 1, …; c: ``(s, 3)`` prior means."""
        increments = preintegrate(pieces, c[segment])
        delta = increments.delta[pieces.last]
        numbers = np.arange(len(segment) + 1), np.arange(segment[-1] + 1)
        return cls(pieces, bridge(pieces, increments), delta, segment, *numbers)

    @classmethod
    def keyframe_alone(cls, time: float, number: int, segment: int) -> Chain:
        """A chain of a single keyframe at a time [s], with no steps; segment: number of its calibration."""
        numbers = np.array([number]), np.array([segment])
        return cls(Pieces.none(time), Bridge.none(), np.empty((0, 3)), np.empty(0, dtype=np.intp), *numbers)

    def after(self, first: int) -> Chain:
        """The part of the chain from keyframe ``first`` on, by its place in order."""
        m = self.pieces.first[first] if first < len(self.segment) else len(self.pieces.length)
        row = self.segment[first] if first < len(self.segment) else max(len(self.segment_number) - 1, 0)
        return Chain(
            pieces=self.pieces.after(first),
            bridge=Bridge(self.bridge.root[first:], self.bridge.gain[m:], self.bridge.spread[m:]),
            delta=self.delta[first:],
            segment=self.segment[first:] - row,
            number=self.number[first:],
            segment_number=self.segment_number[row:],
            begins=self.begins and first == 0,
            ends=self.ends,
        )

    @property
    def time(self) -> Array:
        """Times of the keyframes ``(k + 1,)``. [s]"""
        return self.pieces.keyframe_time

    @property
    def segment_first(self) -> Index:
        """The first interval of each calibration segment ``(s,)``."""
        return np.flatnonzero(np.diff(self.segment, prepend=-1))

    @cached_property
    def track(self) -> tuple[Complex, Array]:
        """Dead-reckoned keyframes ``(k + 1,)`` as complex numbers [m], and their headings ``(k + 1,)`` [rad]."""
        heading = np.concatenate([[0.0], np.cumsum(self.delta[:, 2])])
        moves = (self.delta[:, 0] + 1j * self.delta[:, 1]) * np.exp(1j * heading[:-1])
        return np.concatenate([[0.0], np.cumsum(moves)]), heading

    def keyframe(self, time: Array) -> Index:
        """The keyframe nearest to each time [s]; −1 for times outside, unless the walk begins or ends there."""
        inside = self.begins | (time >= self.time[0] - 2 * INSTANT)
        inside = inside & (self.ends | (time <= self.time[-1] + 2 * INSTANT))
        return np.where(inside, nearest(self.time, time), -1)

    def evaluate(
        self, state: State, measurements: Sequence[Measurement] = (), priors: Priors | None = None
    ) -> Evaluation:
        """All factors at one state. priors: see `Evaluation`."""
        increments = preintegrate(self.pieces, state.c[self.segment])
        residual = step_residuals(state.poses[:-1], state.poses[1:], increments, self.pieces)
        return Evaluation(self, state, tuple(measurements), increments, residual, priors)


@dataclass(frozen=True)
class Evaluation:
    """The walk and its factors at one state.

    increments: of the pieces, at c; step_residual: of each interval, in metres and radians; see `step_residuals`.
    priors: those of variables that measurements add which hold, None for all of them: a window has those of variables
    that were new in it.
    """

    chain: Chain
    state: State
    measurements: tuple[Measurement, ...]
    increments: Increments
    step_residual: Linearized
    priors: Priors | None = None

    @property
    def pieces(self) -> Pieces:
        """The pieces of the walk."""
        return self.chain.pieces

    @property
    def pose_i(self) -> Array:
        """Poses ``(k, 3)`` at the start of each interval."""
        return self.state.poses[:-1]

    @cached_property
    def blocks(self) -> list[FactorBlock]:
        """All factors, kind by kind."""
        blocks = [block for measurement in self.measurements for block in measurement.factors(self)]
        if self.priors is None:
            return blocks
        return [block.only(self._holding(block, self.priors)) if block.prior else block for block in blocks]

    @staticmethod
    def _holding(block: FactorBlock, priors: Priors) -> Index:
        return np.flatnonzero([(block.name, number) in priors for number in block.number.tolist()])

    def forget_blocks(self) -> None:
        """Free the factors: their derivatives refer to this evaluation, and such circles would stay in memory."""
        vars(self).pop("blocks", None)

    def blocks_of(self, name: str) -> list[FactorBlock]:
        """The factors of one kind."""
        return [block for block in self.blocks if block.name == name]

    @cached_property
    def cost(self) -> float:
        """Half the sum of squared, robustly weighted residuals, as GTSAM counts it."""
        return sum(block.cost for block in self.blocks)

    @property
    def surprise(self) -> float:
        """The negative log posterior: the cost plus the price of the rooms and corridors on the way."""
        return self.cost + sum(kind.price for kind in self.measurements if isinstance(kind, Priced))

    @cached_property
    def ends(self) -> Array:
        """Poses ``(m, 3)`` at the end of every piece."""
        interval = self.pieces.interval
        shared = np.einsum("kqr,kr->kq", self.chain.bridge.gain, self.step_residual.value[interval])
        R = pose_rotation(self.pose_i[:, 2])[interval]
        return np.einsum("kqr,kr->kq", R, self.increments.delta + shared) + self.pose_i[interval]

    @cached_property
    def poses(self) -> Linearized:
        """Poses ``(m, 3)`` at the end of every piece, with derivatives."""
        return self.poses_of(np.arange(len(self.pieces.length)))

    def poses_of(self, which: Index) -> Linearized:
        """Poses ``(n, 3)`` at the ends of some pieces, with derivatives by x_i, x_j and c.

        This is the one place where sub-steps are placed. The residual r of the steps is shared out by the conditional
        mean of a Gaussian walk whose two ends are known,

            s_k = Δ_k(c) + G_k r,      (p_k, θ_k) = (p_i + R_i s_k,xy,  θ_i + s_k,θ)

        with G_k of ``Bridge``; the last piece ends exactly at x_j, so the track has no jump at a keyframe.
        """
        interval = self.pieces.interval[which]
        shared = self.step_residual.take(interval).times(self.chain.bridge.gain[which])
        s = self.increments.delta[which] + shared.value
        by_i = shared.by_i + np.eye(3)
        by_i[:, 0, 2] -= s[:, 1]
        by_i[:, 1, 2] += s[:, 0]
        in_frame_of_i = Linearized(s, by_i, shared.by_j, self.increments.by_c[which] + shared.by_c)
        placed = in_frame_of_i.times(pose_rotation(self.pose_i[interval, 2]))
        return replace(placed, value=placed.value + self.pose_i[interval])


def step_residuals(pose_i: Array, pose_j: Array, increments: Increments, pieces: Pieces) -> Linearized:
    """Residuals ``(k, 3)`` of the steps between keyframes, in metres and radians, with derivatives.

    r = [ R_iᵀ (p_j − p_i) − Δp_K(c),  wrap(θ_j − θ_i − Δθ_K(c)) ]
    """
    x, y, turn = (pose_j - pose_i).T
    cos, sin = np.cos(pose_i[:, 2]), np.sin(pose_i[:, 2])
    way_x, way_y = cos * x + sin * y, cos * y - sin * x
    r = np.array([way_x, way_y, turn]).T - increments.delta[pieces.last]
    r[:, 2] = wrap_angle(r[:, 2])

    by_i = np.tile(-np.eye(3), (len(r), 1, 1))
    by_i[:, 0, 2], by_i[:, 1, 2] = way_y, -way_x
    return Linearized(r, by_i, pose_rotation(turn), -increments.by_c[pieces.last])
