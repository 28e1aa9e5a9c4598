"""What marginalisation leaves of the factors of variables that are gone: one linear factor of those that remain.

With δ the local coordinates of the remaining variables about the point at which they were linearised, its cost is

    ½ |R δ + d|²

A variable a that goes leaves the Schur complement of its information: with JᵀJ = [[A, B], [Bᵀ, C]] and
Jᵀr = (g_a, g_c) (Sibley, Matthies, Sukhatme, "Sliding window filter with application to planetary landing", J. Field
Robotics 27(5), 2010, Sec. 3),

    RᵀR = C − Bᵀ A⁻¹ B,      Rᵀd = g_c − Bᵀ A⁻¹ g_a
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from pdr_graph.estimation.factors.base import POSE, FactorBlock, Measurement, State
from pdr_graph.geometry import pose_rotation, wrap_angle
from pdr_graph.types import Array, Index

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.chain import Evaluation

ROUNDING_SHARE, TINY = 1e-13, 1e-30  # share of the information of a number that is rounding; least information


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

    @classmethod
    def of(cls, names: Sequence[tuple[str, int]], point: Array, information: Array, gradient: Array) -> MarginalFactor:
        """The factor with this information ``(3 v, 3 v)`` and gradient ``(3 v,)`` at ``point (v, 3)``.

        names: symbol and number of each variable.
        """
        root, offset = _reduced(information, gradient, 0)
        return cls(tuple(symbol for symbol, _ in names), np.array([n for _, n in names]), point, root, offset)

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
        root, offset = _reduced(root.T @ root, root.T @ self.offset, 3 * gone)
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


def _reduced(information: Array, gradient: Array, gone: int) -> tuple[Array, Array]:
    """R ``(m, n − gone)`` and d ``(m,)`` of the last numbers of a dense system, without its first ``gone``."""
    scale = np.sqrt(np.maximum(np.diag(information), TINY))  # of numbers in metres and radians, near and after a gap
    schur, left = information / np.outer(scale, scale), gradient / scale
    if gone:
        factor = cho_factor(schur[:gone, :gone] + ROUNDING_SHARE * np.eye(gone))
        across = cho_solve(factor, np.column_stack([schur[:gone, gone:], left[:gone]]))
        left = left[gone:] - schur[:gone, gone:].T @ across[:, -1]
        schur = schur[gone:, gone:] - schur[:gone, gone:].T @ across[:, :-1]
    value, vector = np.linalg.eigh((schur + schur.T) / 2)
    kept = value > ROUNDING_SHARE
    root = np.sqrt(value[kept])[:, None] * vector[:, kept].T
    offset = (vector[:, kept].T @ left) / np.sqrt(value[kept])
    return root * scale[gone:], offset
