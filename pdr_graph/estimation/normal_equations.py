"""The normal equations of all factors at one state, in 3 × 3 blocks, assembled by array operations.

With whitened, weighted residuals r and derivatives J, the step δ of Gauss–Newton solves JᵀJ δ = −Jᵀr. Which blocks are
not zero depends on which variables a factor binds, not on the state: the places of all contributions are found once
and used in every iteration.
"""

from __future__ import annotations

from contextlib import suppress
from functools import cached_property

import numpy as np

from pdr_graph.estimation.block_cholesky import Elimination, Factorization, Sum
from pdr_graph.estimation.factors.base import FactorBlock, State
from pdr_graph.estimation.factors.chain import Evaluation
from pdr_graph.types import Array, Index

RESCUING = (0.0, 1e-8, 1e-6, 1e-4, 1e-2)  # damping of a system that is indeterminate by rounding errors


class NormalEquations:
    """The places of all blocks for graphs with the same factors, and how they are filled."""

    def __init__(self, at: Evaluation):
        """at: all factors at any state."""
        self._first = first_variables(at.state)
        count = sum(len(rows) for rows in at.state.arrays.values())
        self._bound = [self._variables(block) for block in at.blocks]
        pairs = [np.broadcast_arrays(bound[:, :, None], bound[:, None, :]) for bound in self._bound]
        first, second = (np.concatenate([pair[side].ravel() for pair in pairs]) for side in (0, 1))
        self.elimination = Elimination(count, first, second)
        slots = [self.elimination.slots(bound[:, :, None], bound[:, None, :]) for bound in self._bound]
        self._to_slots = [Sum(place) for place in slots]
        self._to_variables = [Sum(bound) for bound in self._bound]

    def fits(self, at: Evaluation) -> bool:
        """True if all factors at ``at`` bind the same variables."""
        if len(at.blocks) != len(self._bound) or first_variables(at.state) != self._first:
            return False
        return all(np.array_equal(self._variables(b), bound) for b, bound in zip(at.blocks, self._bound, strict=True))

    def assembled(self, at: Evaluation) -> LinearSystem:
        """The system at a state."""
        blocks, right = np.zeros((len(self.elimination.codes), 3, 3)), np.zeros((self.elimination.count, 3))
        curvature = np.zeros_like(blocks) if any(block.curvature for block in at.blocks) else None
        for block, to_slots, to_variables in zip(at.blocks, self._to_slots, self._to_variables, strict=True):
            squares, gradient = _products(block)
            blocks[to_slots.places] += to_slots(squares)
            right[to_variables.places] -= to_variables(gradient)
            if curvature is not None and block.curvature:
                bend = block.weight[:, None, None, None, None] * block.curvature()
                curvature[to_slots.places] += to_slots(bend)
        return LinearSystem(self, at.state, blocks, right, curvature)

    def _variables(self, block: FactorBlock) -> Index:
        """Numbers ``(n, v)`` of the variables of each factor."""
        return np.stack([self._first[symbol] + rows for symbol, rows in block.variables], axis=1)


class LinearSystem:
    """All factors at one state, linearised.

    state: where; right: ``(n, 3)`` the negative gradient of the cost; curvature: of the residuals, as ``blocks``; None
    if all are linear enough.
    """

    def __init__(
        self, equations: NormalEquations, state: State, blocks: Array, right: Array, curvature: Array | None = None
    ):
        self.equations, self.state = equations, state
        self._blocks, self._right, self._curvature = blocks, right, curvature

    @cached_property
    def solution(self) -> Solution:
        """The system, factorised; damped if rounding errors make it indeterminate.

        That happens where variables hang on a gap of half an hour alone, which says next to nothing of them.
        """
        return Solution(self.state, self._rescued(self._blocks, 0.0))

    def step(self, damping: float = 0.0) -> dict[str, Array]:
        """A step of the search ``(n, 3)`` of the variables of each symbol; damping: Levenberg and Marquardt's."""
        if self._curvature is not None:
            return Solution(self.state, self._rescued(self._blocks + self._curvature, damping)).moves
        return (Solution(self.state, self._rescued(self._blocks, damping)) if damping else self.solution).moves

    def _rescued(self, blocks: Array, damping: float) -> Factorization:
        """The factorised system; with more damping if it is indeterminate."""
        for least in RESCUING[:-1]:
            with suppress(RuntimeError):
                return self._factorized(blocks, max(damping, least))
        return self._factorized(blocks, max(damping, RESCUING[-1]))

    def _factorized(self, blocks: Array, damping: float) -> Factorization:
        elimination = self.equations.elimination
        if damping:
            blocks = blocks.copy()
            blocks[elimination.diagonal] += damping * np.eye(3)
        return Factorization(elimination, blocks, self._right)


class Solution:
    """The step that solves a linear system, and covariances of its variables in GTSAM's local coordinates.

    log_determinant: logarithm of the determinant of the root of the information matrix.
    """

    def __init__(self, state: State, factorization: Factorization):
        self._state, self._factorization = state, factorization
        self.log_determinant = factorization.log_determinant

    @property
    def moves(self) -> dict[str, Array]:
        """The step ``(n, 3)`` of the variables of each symbol."""
        step, arrays = self._factorization.solution, self._state.arrays
        return {symbol: step[n : n + len(arrays[symbol])] for symbol, n in first_variables(self._state).items()}

    def joint(self, *groups: tuple[str, Index]) -> Array:
        """Joint covariances ``(n, 3 d, 3 d)`` of n groups of d variables that have a factor in common.

        groups: for each member, the symbol and the rows ``(n,)`` of the state.
        """
        first = first_variables(self._state)
        return self._factorization.joint(np.stack([first[symbol] + rows for symbol, rows in groups], axis=1))


def first_variables(state: State) -> dict[str, int]:
    """The number of the first variable of each symbol, in one numbering of all variables."""
    sizes = [len(rows) for rows in state.arrays.values()]
    return dict(zip(state.arrays, np.cumsum([0, *sizes[:-1]]).tolist(), strict=True))


def _products(block: FactorBlock) -> tuple[Array, Array]:
    """JᵀJ ``(n, v, v, 3, 3)`` and Jᵀr ``(n, v, 3)`` of each factor, weighted."""
    residual, derivatives = block.weighted
    n, v = len(block), len(derivatives)
    J = np.stack(derivatives, axis=1).reshape(len(residual), 3 * v) if v > 1 else derivatives[0]
    rows = len(residual) // max(n, 1)
    if len(residual) == rows * n and np.array_equal(block.row_of, np.repeat(np.arange(n), rows)):
        J = J.reshape(n, rows, 3 * v)
        squares, gradient = J.transpose(0, 2, 1) @ J, np.einsum("nri,nr->ni", J, residual.reshape(n, rows))
    else:
        present, start = np.unique(block.row_of, return_index=True)
        squares, gradient = np.zeros((n, 3 * v, 3 * v)), np.zeros((n, 3 * v))
        if len(present):
            squares[present] = np.add.reduceat(J[:, :, None] * J[:, None, :], start)
            gradient[present] = np.add.reduceat(J * residual[:, None], start)
    return squares.reshape(n, v, 3, v, 3).transpose(0, 1, 3, 2, 4), gradient.reshape(n, v, 3)
