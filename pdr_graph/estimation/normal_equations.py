"""The normal equations of all factors at one state, in 3 × 3 blocks, assembled by array operations.

With whitened, weighted residuals r and derivatives J, the step δ of Gauss–Newton solves JᵀJ δ = −Jᵀr. Which blocks are
not zero depends on which variables a factor binds, not on the state: the places of all contributions are found once
and used in every iteration.
"""

from __future__ import annotations

from contextlib import suppress
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

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
        self._to_blocks = [SumOfSquares(of_factors, len(self.elimination.codes)) for of_factors in slots]
        self._to_variables = [Sum(bound) for bound in self._bound]

    def fits(self, at: Evaluation) -> bool:
        """True if all factors at ``at`` bind the same variables."""
        if len(at.blocks) != len(self._bound) or first_variables(at.state) != self._first:
            return False
        return all(np.array_equal(self._variables(b), bound) for b, bound in zip(at.blocks, self._bound, strict=True))

    def assembled(self, at: Evaluation, curved: bool = True) -> LinearSystem:
        """The system at a state; curved: with the curvature of the residuals, for a step of the search."""
        rows, right = np.zeros((3 * len(self.elimination.codes), 3)), np.zeros((self.elimination.count, 3))
        for block, to_blocks, to_variables in zip(at.blocks, self._to_blocks, self._to_variables, strict=True):
            squares, gradient = _products(block, curved)
            rows[to_blocks.places] += to_blocks(squares)
            right[to_variables.places] -= to_variables(gradient)
        blocks = np.ascontiguousarray(rows.reshape(3, -1, 3).transpose(1, 0, 2))
        return LinearSystem(self, at, blocks, right, curved)

    def _variables(self, block: FactorBlock) -> Index:
        """Numbers ``(n, v)`` of the variables of each factor."""
        return np.stack([self._first[symbol] + rows for symbol, rows in block.variables], axis=1)


class SumOfSquares:
    """Sums of JᵀJ of all factors of a kind to the rows of the blocks.

    places: of each sum, ``row * slots + slot``.
    """

    def __init__(self, slots: Index, count: int):
        """slots: ``(n, v, v)`` of the blocks of each factor; count: of all slots."""
        n, v = slots.shape[:2]
        place, of = np.unique(slots, return_inverse=True)
        factor, a, b = np.unravel_index(np.argsort(of.ravel(), kind="stable"), slots.shape)
        first = (factor * 3 * v + 3 * a) * v + b  # of the three rows of a block in JᵀJ, (n, 3 v, v, 3)
        index = np.concatenate([first + row * v for row in range(3)])
        sizes = np.tile(np.bincount(of.ravel(), minlength=len(place)), 3)
        bounds = np.concatenate([[0], np.cumsum(sizes)])
        self.places = (count * np.arange(3)[:, None] + place).ravel()
        self._matrix = csr_array((np.ones(len(index)), index, bounds), shape=(len(self.places), n * 3 * v * v))

    def __call__(self, squares: Array) -> Array:
        """Sums ``(p, 3)`` to ``places`` of JᵀJ ``(n, 3 v, 3 v)`` of each factor."""
        return self._matrix @ squares.reshape(-1, 3)


class LinearSystem:
    """All factors at one state, linearised.

    at: where; blocks, right: the matrix and the negative gradient of the cost; curved: see `NormalEquations.assembled`.
    """

    def __init__(self, equations: NormalEquations, at: Evaluation, blocks: Array, right: Array, curved: bool):
        self.equations, self.at, self._blocks, self._right = equations, at, blocks, right
        self._curved = curved and any(block.curvature for block in at.blocks)

    @cached_property
    def solution(self) -> Solution:
        """The system without curvature, factorised; damped if rounding errors make it indeterminate.

        That happens where variables hang on a gap of half an hour alone, which says next to nothing of them.
        """
        if self._curved:
            return self.equations.assembled(self.at, curved=False).solution
        return Solution(self.at.state, self._rescued(0.0))

    def step(self, damping: float = 0.0) -> dict[str, Array]:
        """A step of the search ``(n, 3)`` of the variables of each symbol; damping: Levenberg and Marquardt's."""
        if damping or self._curved:
            return Solution(self.at.state, self._rescued(damping)).moves
        return self.solution.moves

    def _rescued(self, damping: float) -> Factorization:
        """The factorised system; with more damping if it is indeterminate."""
        for least in RESCUING[:-1]:
            with suppress(RuntimeError):
                return self._factorized(max(damping, least))
        return self._factorized(max(damping, RESCUING[-1]))

    def _factorized(self, damping: float) -> Factorization:
        elimination, blocks = self.equations.elimination, self._blocks
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


def _products(block: FactorBlock, curved: bool) -> tuple[Array, Array]:
    """JᵀJ ``(n, 3 v, 3 v)`` and Jᵀr ``(n, v, 3)`` of each factor, weighted."""
    residual, derivatives = block.weighted
    n, v = len(block), len(derivatives)
    J = np.hstack(derivatives)
    rows = len(residual) // max(n, 1)
    if len(residual) == rows * n and np.array_equal(block.row_of, np.repeat(np.arange(n), rows)):
        J = J.reshape(n, rows, 3 * v)
        gradient = residual.reshape(n, 1, rows) @ J
        if curved and block.curvature is not None:
            J = np.concatenate([J, np.sqrt(block.weight)[:, None, None] * block.curvature()], axis=1)
        squares = J.transpose(0, 2, 1) @ J
    else:
        present, start = np.unique(block.row_of, return_index=True)
        squares, gradient = np.zeros((n, 3 * v, 3 * v)), np.zeros((n, 3 * v))
        if len(present):
            squares[present] = np.add.reduceat(J[:, :, None] * J[:, None, :], start)
            gradient[present] = np.add.reduceat(J * residual[:, None], start)
    return squares, gradient.reshape(n, v, 3)
