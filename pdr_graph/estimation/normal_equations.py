"""The normal equations of all factors at one state, in 3 × 3 blocks, assembled by array operations.

With whitened, weighted residuals r and derivatives J, the step δ of Gauss–Newton solves JᵀJ δ = −Jᵀr. Which blocks are
not zero depends on which variables a factor binds, not on the state: the places of all contributions are found once
and used in every iteration.
"""

from __future__ import annotations

from collections.abc import Mapping
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
        pairs = [(bound[:, a].ravel(), bound[:, b].ravel()) for bound in self._bound for a, b in [_pairs(bound)]]
        self.elimination = Elimination(count, *(np.concatenate(side) for side in zip(*pairs, strict=True)))
        places = [self._rows(bound).ravel() for bound in self._bound]
        self._to_blocks = Sum(np.concatenate(places), 3 * len(self.elimination.codes))
        self._to_variables = Sum(np.concatenate([bound.ravel() for bound in self._bound]), count)

    def _rows(self, bound: Index) -> Index:
        """The rows of the blocks to which JᵀJ of each factor is added. bound: ``(n, v)`` its variables."""
        n, v = bound.shape
        slots = self.elimination.slots(bound[:, :, None], bound[:, None, :])
        rows = 3 * slots[:, :, None] + np.arange(3)[:, None]  # a block is three rows of three numbers
        return rows.reshape(n, 3 * v, v)

    def fits(self, at: Evaluation) -> bool:
        """True if all factors at ``at`` bind the same variables."""
        if len(at.blocks) != len(self._bound) or first_variables(at.state) != self._first:
            return False
        return all(np.array_equal(self._variables(b), bound) for b, bound in zip(at.blocks, self._bound, strict=True))

    def assembled(self, at: Evaluation, curved: bool = True) -> LinearSystem:
        """The system at a state; curved: with the curvature of the residuals, for a step of the search."""
        squares, gradients, end = np.empty((self._to_blocks.size, 3)), list[Array](), 0  # one kind after another
        for block in at.blocks:
            square, gradient = _products(block, curved)
            end += len(square)
            squares[end - len(square) : end] = square
            gradients.append(-gradient)
            del square  # as large as all that has been stored
        blocks = self._to_blocks.of(squares).reshape(-1, 3, 3)
        return LinearSystem(self, at, blocks, self._to_variables.of(np.concatenate(gradients)), curved)

    def _variables(self, block: FactorBlock) -> Index:
        """Numbers ``(n, v)`` of the variables of each factor."""
        return np.stack([self._first[symbol] + rows for symbol, rows in block.variables], axis=1)


class LinearSystem:
    """All factors at one state, linearised.

    at: where; blocks, right: the matrix and the negative gradient of the cost; curved: see `NormalEquations.assembled`.
    """

    def __init__(self, equations: NormalEquations, at: Evaluation, blocks: Array, right: Array, curved: bool):
        self.equations, self.state, self._blocks, self._right = equations, at.state, blocks, right
        self._curved = at if curved and any(block.curvature for block in at.blocks) else None  # large: kept if needed

    @cached_property
    def solution(self) -> Solution:
        """The system without curvature, factorised; damped if rounding errors make it indeterminate.

        That happens where variables hang on a gap of half an hour alone, which says next to nothing of them.
        """
        if self._curved is not None:
            return self.equations.assembled(self._curved, curved=False).solution
        return Solution(self.state, self._rescued(0.0))

    @property
    def solved(self) -> LinearSystem | Solution:
        """The solution alone if it is known, which frees the matrix; else the system."""
        return vars(self).get("solution", self)

    def step(self, damping: float = 0.0) -> dict[str, Array]:
        """A step of the search ``(n, 3)`` of the variables of each symbol; damping: Levenberg and Marquardt's."""
        if damping or self._curved is not None:
            return Solution(self.state, self._rescued(damping)).moves
        return self.solution.moves

    def gain(self, moves: Mapping[str, Array]) -> float:
        """The decrease of the cost by an undamped step, were all factors linear."""
        return float(np.sum(np.concatenate([moves[symbol] for symbol in self.state.arrays]) * self._right)) / 2

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


def _pairs(bound: Index) -> tuple[Index, Index]:
    """Columns of all pairs of variables of a factor. bound: ``(n, v)``."""
    first, second = np.triu_indices(bound.shape[1], 1)
    return first, second


def _products(block: FactorBlock, curved: bool) -> tuple[Array, Array]:
    """Rows of JᵀJ ``(n · 3 v · v, 3)`` and of Jᵀr ``(n · v, 3)`` of all factors in turn, weighted."""
    residual, derivatives = block.weighted
    n, v = len(block), len(derivatives)
    J = np.hstack(derivatives)
    if block.rows_each:
        J = J.reshape(n, block.rows_each, 3 * v)
        gradient = residual.reshape(n, 1, block.rows_each) @ J
        if curved and block.curvature is not None:
            J = np.concatenate([J, np.sqrt(block.weight)[:, None, None] * block.curvature()], axis=1)
        squares = J.transpose(0, 2, 1) @ J
    else:
        present, start = np.unique(block.row_of, return_index=True)
        squares, gradient = np.zeros((n, 3 * v, 3 * v)), np.zeros((n, 3 * v))
        if len(present):
            squares[present] = np.add.reduceat(J[:, :, None] * J[:, None, :], start)
            gradient[present] = np.add.reduceat(J * residual[:, None], start)
    return squares.reshape(-1, 3), gradient.reshape(-1, 3)
