"""What has left the window of a walk under way: rows and reports, and the marginal of its variables.

Of the factors that bind a leaving variable a, linearised, with JᵀJ = [[A, B], [Bᵀ, C]] and Jᵀr = (g_a, g_c), the Schur
complement is a linear factor of the remaining variables c (Sibley, Matthies, Sukhatme, "Sliding window filter with
application to planetary landing", J. Field Robotics 27(5), 2010, Sec. 3),

    RᵀR = C − Bᵀ A⁻¹ B,      Rᵀd = g_c − Bᵀ A⁻¹ g_a,      cost ½ |R δ + d|²

with δ their local coordinates about the point at which they were linearised.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from pdr_graph.estimation.factors.base import POSE, FactorBlock, Measurement, State
from pdr_graph.estimation.factors.chain import Evaluation, Priors
from pdr_graph.estimation.factors.start import FRAME_SIGMA
from pdr_graph.estimation.live.window import Interval
from pdr_graph.geometry import interpolate, pose_rotation, rotation, wrap_angle
from pdr_graph.types import Array, Index, Mask


@dataclass(frozen=True)
class TrajectoryRows:
    """Rows of a trajectory: time ``(n,)``, poses ``(n, 3)``, covariances ``(n, 3, 3)``, floors."""

    time: Array
    pose: Array
    covariance: Array
    floor: list[str]

    @classmethod
    def joined(cls, parts: Sequence[TrajectoryRows]) -> TrajectoryRows:
        """Concatenate rows that follow one another."""
        names = ("time", "pose", "covariance")
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return cls(**columns, floor=[label for part in parts for label in part.floor])


@dataclass(frozen=True)
class Excess:
    """Covariance ``(n, 3, 3)`` at times ``(n,)`` [s] to add to that of the solver, in the output axes; 0 by default."""

    time: Array = field(default_factory=lambda: np.zeros(1))
    covariance: Array = field(default_factory=lambda: np.zeros((1, 3, 3)))

    def at(self, time: Array) -> Array:
        """The covariances ``(n, 3, 3)`` at times ``(n,)`` [s]; constant before the first and after the last."""
        return interpolate(time, self.time, self.covariance.reshape(-1, 9)).reshape(-1, 3, 3)


def moved(pose: Array, before: Array, after: Array) -> Array:
    """Move poses ``(n, 3)`` rigidly, as pose ``before (3,)`` moves to ``after (3,)``."""
    turn = after[2] - before[2]
    return np.column_stack([(pose[:, :2] - before[:2]) @ rotation(turn).T + after[:2], pose[:, 2] + turn])


class FinalizedTrajectory:
    """Finalised rows and reports that `pop_finalized` has not returned yet.

    final: rows with covariance; left: later rows, whose covariance is still relative to their keyframes; reports: by
    kind and number of the instance; anchored: the position of the walk has been certain once; until then all rows move
    with the start of the window, whose last pose was ``hinge``; edge: time [s] of the last covariance of the first
    keyframe, and that covariance.
    """

    def __init__(self) -> None:
        self.final, self.left = list[TrajectoryRows](), list[TrajectoryRows]()
        self.reports: dict[str, dict[int, Any]] = {}
        self.anchored, self.hinge = False, np.zeros(3)
        self.edge = 0.0, np.eye(3) * FRAME_SIGMA**2

    def take(self, leaving: Sequence[Interval], at: Evaluation, start: Array | None) -> None:
        """Append the rows of intervals that leave the window; start: first pose of the walk if it leaves with them."""
        if start is not None:
            at_start = np.array([leaving[0].begin])
            self.left.append(TrajectoryRows(at_start, start[None], np.zeros((1, 3, 3)), [leaving[0].label]))
        for n, interval in enumerate(leaving):
            pose = at.ends[at.pieces.first[n] + interval.row_piece]
            R = pose_rotation(np.full(len(pose), at.pose_i[n, 2]))
            spread = R @ interval.bridge.spread[interval.row_piece] @ R.transpose(0, 2, 1)
            self.left.append(TrajectoryRows(interval.row_time, pose, spread, [interval.label] * len(pose)))

    def begin(self, start: Array, after: Array, covariance: Array) -> None:
        """Set the covariance of the first pose of a walk whose position is measured; otherwise it defines the frame.

        The solver has marginalised it: it is that of the first keyframe in the window, moved back rigidly, which
        neglects the errors of the few steps between them. start, after ``(3,)``: the poses of both; covariance
        ``(3, 3)``: of the keyframe.
        """
        by = np.eye(3)
        by[:2, 2] = rotation(np.pi / 2) @ (start[:2] - after[:2])
        self.edge = self.edge[0], by @ covariance @ by.T

    def rows(self, time: float, covariance: Array) -> list[TrajectoryRows]:
        """All rows; covariances are interpolated between that of ``edge`` and that of the first keyframe in the window.

        time [s], covariance ``(3, 3)``: of this keyframe.
        """
        (edge_time, edge_covariance), all_rows = self.edge, list(self.final)
        for rows in self.left:
            share = ((rows.time - edge_time) / (time - edge_time))[:, None, None]
            all_rows.append(
                replace(rows, covariance=(1 - share) * edge_covariance + share * covariance + rows.covariance)
            )
        return all_rows

    def finalize(self, time: float, covariance: Array) -> None:
        """Make all rows final, with covariances as of `rows`."""
        self.final = self.rows(time, covariance)
        self.left, self.edge = [], (time, covariance)

    def move(self, after: Array) -> None:
        """Move all rows rigidly with the start of the window, which is now at pose ``after (3,)``."""
        before, self.hinge = self.hinge, after
        R = pose_rotation(after[2:] - before[2])[0]
        for past in (self.final, self.left):
            for k, rows in enumerate(past):
                past[k] = replace(rows, pose=moved(rows.pose, before, after), covariance=R @ rows.covariance @ R.T)

    def pop_finalized(self) -> list[TrajectoryRows]:
        """Return and remove the final rows; none until the position of the walk is certain."""
        if not self.anchored:
            return []
        rows, self.final, self.reports = self.final, [], {}
        return rows


ROUNDING, TINY = 1e-13, 1e-30  # share of the information of a number that rounding errors leave; least information


@dataclass(frozen=True, eq=False)
class MarginalFactor(Measurement):
    """One linear factor of the variables that remain.

    symbol, number: of each variable ``v``; point: ``(v, 3)`` of linearisation; root: R ``(m, 3 v)``; offset: d
    ``(m,)``.
    """

    symbol: tuple[str, ...]
    number: Index
    point: Array
    root: Array
    offset: Array

    name: ClassVar[str] = "marginal"

    @property
    def names(self) -> list[tuple[str, int]]:
        """Symbol and number of each variable."""
        return list(zip(self.symbol, self.number.tolist(), strict=True))

    def among(self, state: State) -> MarginalFactor | None:
        """The marginal without the variables that a state does not have; None if none is left."""
        there = np.array([symbol in state.arrays and number in state.number(symbol) for symbol, number in self.names])
        if there.all() or not there.any():
            return self if there.all() else None
        order, gone = np.argsort(there, kind="stable"), int(np.count_nonzero(~there))
        root = self.root.reshape(len(self.offset), -1, 3)[:, order].reshape(len(self.offset), -1)
        root, offset = _schur_complement(root.T @ root, root.T @ self.offset, 3 * gone)
        symbol = tuple(self.symbol[n] for n in order[gone:].tolist())
        return MarginalFactor(symbol, self.number[there], self.point[there], root, offset)

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """The factor; poses are moved in the axes of their point."""
        rows = [int(np.flatnonzero(at.state.number(symbol) == number)[0]) for symbol, number in self.names]
        now = np.array([at.state[symbol][row] for symbol, row in zip(self.symbol, rows, strict=True)])
        pose = np.array([symbol == POSE for symbol in self.symbol])
        apart, turn = now - self.point, np.where(pose, self.point[:, 2], 0.0)
        apart[pose, 2] = wrap_angle(apart[pose, 2])
        apart = np.einsum("vij,vj->vi", pose_rotation(-turn), apart)

        def jacobian() -> list[Array]:
            roots = self.root.reshape(len(self.offset), -1, 3).transpose(1, 0, 2)
            axes = pose_rotation(np.where(pose, now[:, 2] - turn, 0.0))
            return list((roots @ axes)[:, None])

        residual = (self.root @ apart.ravel() + self.offset)[None]
        variables = [(symbol, np.array([row])) for symbol, row in zip(self.symbol, rows, strict=True)]
        return [FactorBlock.uniform(self.name, residual, variables, jacobian)]


def _schur_complement(information: Array, gradient: Array, a: int) -> tuple[Array, Array]:
    """R ``(m, n − a)`` and d ``(m,)`` of the last variables of a dense system, without its first ``a`` numbers."""
    scale = np.sqrt(np.maximum(np.diag(information), TINY))  # of numbers in metres and radians, near and after a gap
    information, gradient = information / np.outer(scale, scale), gradient / scale
    factor = cho_factor(information[:a, :a] + ROUNDING * np.eye(a))
    across = cho_solve(factor, np.column_stack([information[:a, a:], gradient[:a]]))
    schur = information[a:, a:] - information[:a, a:].T @ across[:, :-1]
    value, vector = np.linalg.eigh((schur + schur.T) / 2)
    kept = value > ROUNDING
    root = np.sqrt(value[kept])[:, None] * vector[:, kept].T
    offset = (vector[:, kept].T @ (gradient[a:] - information[:a, a:].T @ across[:, -1])) / np.sqrt(value[kept])
    return root * scale[a:], offset


def marginalized(at: Evaluation, leaving: Mask) -> tuple[MarginalFactor | None, Priors]:
    """The marginal of the variables that leave, at the estimate ``at``, and the priors that it absorbs.

    leaving: for each variable, symbol by symbol in the order of the state. The marginal is None if no others are bound.
    """
    symbols = list(at.state.arrays)
    sizes = [len(at.state[symbol]) for symbol in symbols]
    first = dict(zip(symbols, np.cumsum([0, *sizes[:-1]]).tolist(), strict=True))

    # The factors that bind a leaving variable, and all their variables
    bound, parts, absorbed = list[Index](), list[tuple[Index, Array, Array]](), set[tuple[str, int]]()
    for block in at.blocks:
        of_factor = np.stack([first[symbol] + rows for symbol, rows in block.variables], axis=1)
        which = np.flatnonzero(leaving[of_factor].any(axis=1))
        if len(which):
            rows = np.isin(block.row_of, which)
            residual, by = block.weighted
            parts.append((of_factor[block.row_of[rows]], np.stack([one[rows] for one in by], axis=1), residual[rows]))
            bound.append(of_factor[which].ravel())
            absorbed |= {(block.name, number) for number in block.number[which].tolist()} if block.prior else set()
    variables = np.unique(np.concatenate(bound)) if bound else np.empty(0, dtype=np.intp)
    remaining = variables[~leaving[variables]]
    if not len(remaining):
        return None, frozenset(absorbed)
    order = np.concatenate([variables[leaving[variables]], remaining])
    place = np.full(len(leaving), -1)
    place[order] = np.arange(len(order))

    # Their information and gradient, dense, and the Schur complement
    information, gradient = np.zeros((3 * len(order),) * 2), np.zeros(3 * len(order))
    for of_row, by, residual in parts:
        J = np.zeros((len(residual), len(order), 3))
        np.add.at(J, (np.arange(len(residual))[:, None], place[of_row]), by)
        J = J.reshape(len(residual), 3 * len(order))
        information += J.T @ J
        gradient += J.T @ residual
    root, offset = _schur_complement(information, gradient, 3 * (len(order) - len(remaining)))

    symbol_of = np.repeat(np.arange(len(symbols)), sizes)[remaining]
    names = tuple(symbols[s] for s in symbol_of.tolist())
    row = remaining - np.array([first[name] for name in names])
    number = np.array([at.state.number(name)[r] for name, r in zip(names, row.tolist(), strict=True)])
    point = np.array([at.state[name][r] for name, r in zip(names, row.tolist(), strict=True)])
    return MarginalFactor(names, number, point, root, offset), frozenset(absorbed)
