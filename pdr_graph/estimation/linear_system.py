"""The linear system of a walk: all factors at one state in 3 × 3 blocks, its solution, and covariances.

With whitened, weighted residuals r and derivatives J, the step δ of Gauss–Newton solves JᵀJ δ = −Jᵀr. Which blocks are
not zero depends on which variables a factor binds, not on the state: the order of elimination and the places of all
contributions are found once and used in every iteration.

JᵀJ is factorised by a Cholesky of sparse symmetric blocks. Variables that are not neighbours are eliminated together,
in rounds of array operations: of a chain every second one, so that an hour needs about ten rounds (nested dissection,
George 1973; multiple minimum degree, Liu 1985). With F the block of a variable f, S its blocks with its parents p, the
neighbours that are left,

    A_pp ← A_pp − S F⁻¹ Sᵀ,    b_p ← b_p − S F⁻¹ b_f,    x_f = F⁻¹ b_f − (S F⁻¹)ᵀ x_p

Variables that very many others are bound to (beacons) are the border: dense columns that are carried along, and whose
matrix at the end is dense. The inverse follows backwards, since the parents of a variable are neighbours of each other
(Golub & Plemmons 1980):

    Σ_pf = −Σ_pp S F⁻¹,      Σ_ff = F⁻¹ − (S F⁻¹)ᵀ Σ_pf
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ContextDecorator, suppress
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import combinations
from threading import Lock
from typing import Any, Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csc_array

from pdr_graph.estimation.factors.base import FactorBlock, State
from pdr_graph.estimation.factors.chain import Evaluation
from pdr_graph.geometry import pose_rotation
from pdr_graph.types import Array, Index, Mask


class OneThread(ContextDecorator):
    """Lets the linear algebra of the process use one thread while any of its threads is within.

    For matrices of some hundred rows, OpenBLAS's threads wait for each other: a walk takes two to five times as long.
    """

    def __init__(self) -> None:
        self._lock, self._within, self._limiter = Lock(), 0, None

    def __enter__(self) -> None:
        with self._lock:
            self._within += 1
            if self._within == 1:
                self._limiter = _libraries().limit(limits=1)

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._within -= 1
            if not self._within and self._limiter is not None:
                self._limiter.restore_original_limits()


@cache
def _libraries() -> Any:
    """The libraries of linear algebra that are loaded."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


one_thread = OneThread()
RESCUING = (0.0, 1e-8, 1e-6, 1e-4, 1e-2)  # damping of a system that is indeterminate by rounding errors


class NormalEquations:
    """The places of all blocks for graphs with the same factors, and how they are filled."""

    def __init__(self, at: Evaluation):
        """at: all factors at any state."""
        self._first = first_variables(at.state)
        count = sum(len(rows) for rows in at.state.arrays.values())
        self._bound = [self._variables(block) for block in at.blocks]
        pairs = [bound[:, two] for bound in self._bound for two in combinations(range(bound.shape[1]), 2)]
        self.elimination = Elimination(count, *np.concatenate([np.empty((0, 2), dtype=np.intp), *pairs]).T)
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
        for block in filter(len, at.blocks):
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
        return Solution(self.state, self._factorized(0.0))

    def step(self, damping: float = 0.0) -> dict[str, Array]:
        """A step of the search ``(n, 3)`` of the variables of each symbol; damping: Levenberg and Marquardt's."""
        if damping or self._curved is not None:
            return Solution(self.state, self._factorized(damping)).moves
        return self.solution.moves

    def gain(self, moves: Mapping[str, Array]) -> float:
        """The decrease of the cost by an undamped step, were all factors linear."""
        return float(np.sum(np.concatenate([moves[symbol] for symbol in self.state.arrays]) * self._right)) / 2

    def _factorized(self, damping: float) -> Factorization:
        """The factorised system; with more damping if it is indeterminate."""
        elimination = self.equations.elimination
        for least in RESCUING:
            blocks = self._blocks
            if more := max(damping, least):
                blocks = blocks.copy()
                blocks[elimination.diagonal] += more * np.eye(3)
            with suppress(RuntimeError):
                return Factorization(elimination, blocks, self._right)
        raise RuntimeError(INDETERMINATE_TEXT)


class Linearization:
    """All factors at one state, linearised when the solution is asked.

    Covariances need it at the optimum itself: a centimetre before it, where the last move of a search began, another
    step may be within the margin of a wall and add a row.
    """

    def __init__(self, equations: NormalEquations, at: Evaluation):
        self._equations, self._at = equations, at

    @cached_property
    def solution(self) -> Solution:
        """The system without curvature, solved."""
        return self._equations.assembled(self._at, curved=False).solution


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


class Covariances(Protocol):
    """What gives joint covariances: a `Solution`, or iSAM2."""

    def joint(self, *groups: tuple[str, Index]) -> Array:
        """Joint covariances ``(n, 3 d, 3 d)`` of n groups of d variables, see `Solution.joint`."""
        ...


def first_variables(state: State) -> dict[str, int]:
    """The number of the first variable of each symbol, in one numbering of all variables."""
    sizes = [len(rows) for rows in state.arrays.values()]
    return dict(zip(state.arrays, np.cumsum([0, *sizes[:-1]]).tolist(), strict=True))


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


ROOT = 48  # variables that are eliminated last, as one dense matrix
FEWEST_BOUND, SHARE_BOUND = 32, 1 / 8  # neighbours, as number and as share of all variables, from which one is border
SPARSE = 0.5  # share of all that are left to which each is bound, from which they are one dense matrix
INDETERMINATE = 1e-15  # share of a diagonal element that is left of it by rounding errors
INDETERMINATE_TEXT = "the factors do not determine all variables"


@dataclass(frozen=True)
class Round:
    """Variables ``n`` that are eliminated together.

    eliminated: ``(n,)``; parents: ``(n, p)``, filled up with `Elimination.count`; slots: ``(n, 1 + p, 1 + p)`` of the
    blocks of variable and parents with each other; to_slots, to_variables: sums of the contributions to parents.
    """

    eliminated: Index
    parents: Index
    slots: Index
    to_slots: Sum
    to_variables: Sum


class Sum:
    """Sums of contributions to the same place."""

    def __init__(self, place: Index, count: int):
        """place: of each contribution, any shape; count: of all places. size: number of contributions."""
        self.size, self._count, column = place.size, count, place.ravel()
        occurs = np.zeros(count, dtype=bool)
        occurs[column] = True
        self._places, row = np.flatnonzero(occurs), (np.cumsum(occurs) - 1)[column]
        one_each = np.arange(self.size + 1)
        self._matrix = csc_array((np.ones(self.size), row, one_each), shape=(len(self._places), self.size))

    def add(self, total: Array, contribution: Array) -> None:
        """Add all contributions to ``total (count, …)``: their first axes are those of ``place``."""
        sums = self._matrix @ contribution.reshape(self.size, int(np.prod(total.shape[1:])))
        total[self._places] += sums.reshape(-1, *total.shape[1:])

    def of(self, contribution: Array) -> Array:
        """The sums ``(count, k)`` of all contributions ``(n, k)``."""
        total = np.zeros((self._count, contribution.shape[1]))
        total[self._places] = self._matrix @ contribution
        return total


class Elimination:
    """The order in which variables are eliminated, and where all blocks are stored: the same for every state.

    count: of variables, and the number of one without neighbours, with which tables are filled up; codes: those of the
    blocks, ascending; border, root: variables that are eliminated last.
    """

    def __init__(self, count: int, first: Index, second: Index):
        """first, second: ``(n,)`` pairs of variables that have a factor in common, in any order, repeated or not."""
        self.count = count
        diagonal = np.arange(count + 1) * (count + 2)
        u, v = self._edges(first, second)
        self.border = np.flatnonzero(np.bincount(u, minlength=count) > max(FEWEST_BOUND, SHARE_BOUND * count))
        inner = np.ones(count + 1, dtype=bool)
        inner[self.border] = False
        within = inner[u] & inner[v]
        eliminated, left, filled = _rounds(u[within], v[within], inner[:-1])
        self.root = np.flatnonzero(left)
        at_border = np.flatnonzero(~within)
        among_root = self._code(self.root[:, None], self.root).ravel()
        codes = [diagonal, self._code(u[at_border], v[at_border]), among_root, *filled]
        self.codes = _distinct(np.concatenate(codes))
        self.diagonal = self.slots(np.arange(count), np.arange(count))
        self.rounds = list[Round]()
        for chosen, parents in eliminated:
            family = np.column_stack([chosen, parents])
            slots = self.slots(family[:, :, None], family[:, None, :])
            self.rounds.append(
                Round(chosen, parents, slots, Sum(slots[:, 1:, 1:], len(self.codes)), Sum(parents, count + 1))
            )
        place = np.full(count + 1, -1)
        place[self.border] = np.arange(len(self.border))
        at = at_border[place[v[at_border]] >= 0]
        self._row, self._place = np.append(u[at], self.border), np.append(place[v[at]], place[self.border])
        self._border_slots = self.slots(self._row, self.border[self._place])

    def slots(self, first: Index, second: Index) -> Index:
        """Index of the block of each pair of variables; the last block, which stays 0, for `count`."""
        nowhere = (first == self.count) | (second == self.count)
        found = np.searchsorted(self.codes, self._code(first, second))
        return np.where(nowhere, len(self.codes) - 1, found)

    def columns(self, blocks: Array, right: Array) -> Array:
        """Columns ``(count + 1, 3, 3 g + 1)`` of the ``g`` variables of the border, and the right-hand side."""
        columns = np.zeros((self.count + 1, len(self.border) + 1, 3, 3))
        columns[self._row, self._place] = blocks[self._border_slots]
        columns = columns.transpose(0, 2, 1, 3).reshape(self.count + 1, 3, -1)[:, :, : 3 * len(self.border) + 1]
        columns[:-1, :, -1] = right
        return np.ascontiguousarray(columns)

    def fill_in(self, inverse: Array, to_border: Array) -> None:
        """Set the blocks of the border in ``inverse``. to_border: ``(count + 1, 3, 3 g)`` columns of the inverse."""
        parts = to_border.reshape(self.count + 1, 3, len(self.border), 3)[self._row, :, self._place]
        inverse[self._border_slots] = parts
        inverse[self.slots(self.border[self._place], self._row)] = parts.transpose(0, 2, 1)

    def _code(self, first: Index, second: Index) -> Index:
        """A number for each pair of variables."""
        return first * (self.count + 1) + second

    def _edges(self, first: Index, second: Index) -> tuple[Index, Index]:
        """Pairs of different variables, each once in both orders, ascending."""
        differ = first != second
        first, second = first[differ], second[differ]
        once = _distinct(self._code(np.minimum(first, second), np.maximum(first, second)))
        codes = np.sort(np.concatenate([once, self._code(*np.divmod(once, self.count + 1)[::-1])]))
        u, v = np.divmod(codes, self.count + 1)
        return u, v


def _rounds(u: Index, v: Index, alive: Mask) -> tuple[list[tuple[Index, Index]], Mask, list[Index]]:
    """Variables of each round with their parents; those that are left; codes of all edges.

    u, v: edges in both orders, ascending; alive: ``(count,)`` variables to eliminate.
    """
    count, alive = len(alive), alive.copy()
    rounds, edges = list[tuple[Index, Index]](), [u * (count + 1) + v]
    while np.count_nonzero(alive) > ROOT:
        degree = np.bincount(u, minlength=count)
        few = np.sort(degree[alive])[(np.count_nonzero(alive) - 1) // 2]
        if few > SPARSE * np.count_nonzero(alive):
            break
        candidate = alive & (degree <= few)
        rank = np.cumsum(alive)
        turn = np.where(rank % 2 == 0, rank, rank + count)  # every second one first
        blocked = np.zeros(count, dtype=bool)
        blocked[u[candidate[u] & candidate[v] & (turn[v] < turn[u])]] = True
        chosen = candidate & ~blocked
        alive &= ~chosen
        leaving = chosen[u]
        which = np.flatnonzero(chosen)
        parents = np.full((len(which), int(degree[which].max(initial=0))), count)  # filled up
        parents[np.arange(parents.shape[1]) < degree[which, None]] = v[leaving]
        rounds.append((which, parents))
        first, second = np.broadcast_arrays(parents[:, :, None], parents[:, None, :])
        new = (first != second) & (first < count) & (second < count)
        kept = ~(leaving | chosen[v])
        codes = np.concatenate([u[kept] * (count + 1) + v[kept], first[new] * (count + 1) + second[new]])
        codes = _distinct(codes)
        edges.append(codes)
        u, v = np.divmod(codes, count + 1)
    return rounds, alive, edges


def _distinct(codes: Index) -> Index:
    """The different codes, ascending; several times as fast as ``np.unique``, which hashes them."""
    codes = np.sort(codes)
    return codes[np.diff(codes, prepend=-1) > 0]


class Factorization:
    """A factorised matrix: the solution of its system, its determinant and the blocks of its inverse."""

    def __init__(self, elimination: Elimination, blocks: Array, right: Array):
        """blocks: ``(s, 3, 3)`` in the slots of ``elimination``; right: ``(n, 3)`` right-hand side.

        Raises RuntimeError if the matrix is not positive definite.
        """
        self.elimination, self._size = elimination, len(blocks)
        least = INDETERMINATE * blocks[elimination.diagonal].diagonal(axis1=1, axis2=2)
        columns = elimination.columns(blocks, right)
        corner = columns[elimination.border].reshape(3 * len(elimination.border), columns.shape[2])  # of the border
        blocks = blocks.copy()
        self._steps = list[tuple[Array, Array, Array]]()  # of each round: F⁻¹, S F⁻¹, F⁻¹ (border, right-hand side)
        self.log_determinant = 0.0  # of the root of the matrix
        for batch in elimination.rounds:
            inverse, logarithm = _inverse(blocks[batch.slots[:, 0, 0]], least[batch.eliminated])
            self.log_determinant += logarithm
            bound, own = _joined(blocks[batch.slots[:, 1:, :1]]), columns[batch.eliminated]
            share, solved = bound @ inverse, inverse @ own
            self._steps.append((inverse, share, solved))
            if bound.size:
                batch.to_slots.add(blocks, _parted(share @ -bound.transpose(0, 2, 1)))
                batch.to_variables.add(columns, (share @ -own).reshape(*batch.parents.shape, *own.shape[1:]))
            if len(corner):
                corner -= own.reshape(-1, own.shape[2])[:, :-1].T @ solved.reshape(-1, own.shape[2])
        self._root, self._last = self._solve_root(blocks, columns, corner)
        self.log_determinant += float(np.log(np.diag(self._root[0])).sum())

    def _solve_root(self, blocks: Array, columns: Array, corner: Array) -> tuple[tuple[Array, bool], Array]:
        """Cholesky factor of what is left, root and border, and its solution."""
        root, size = self.elimination.root, 3 * len(self.elimination.root)
        dense = np.empty((size + len(corner), size + len(corner) + 1), order="F")  # as LAPACK takes it
        slots = self.elimination.slots(root[:, None], root)
        dense[:size, :size] = _joined(blocks[slots][None])[0]
        dense[:size, size:] = columns[root].reshape(size, columns.shape[2])
        dense[size:, :size] = dense[:size, size:-1].T
        dense[size:, size:] = corner
        try:
            factor = cho_factor(dense[:, :-1], check_finite=False)
        except np.linalg.LinAlgError as error:
            raise RuntimeError(INDETERMINATE_TEXT) from error
        if not np.isfinite(np.diag(factor[0])).all():
            raise RuntimeError(INDETERMINATE_TEXT)
        return factor, cho_solve(factor, dense[:, -1], check_finite=False)

    @cached_property
    def solution(self) -> Array:
        """The solution ``(n, 3)`` of the system."""
        elimination, size = self.elimination, 3 * len(self.elimination.root)
        x, at_border = np.zeros((elimination.count + 1, 3)), self._last[size:]
        x[elimination.root], x[elimination.border] = self._last[:size].reshape(-1, 3), at_border.reshape(-1, 3)
        for batch, (_, share, solved) in zip(elimination.rounds[::-1], self._steps[::-1], strict=True):
            above = x[batch.parents].reshape(len(share), share.shape[1], 1)
            own = solved[:, :, -1] - (share.transpose(0, 2, 1) @ above)[:, :, 0]
            x[batch.eliminated] = own - solved[:, :, :-1] @ at_border
        return x[:-1]

    @cached_property
    @one_thread
    def inverse(self) -> Array:
        """Blocks ``(s, 3, 3)`` of the inverse matrix, in the slots of ``elimination``."""
        elimination, size = self.elimination, 3 * len(self.elimination.root)
        root, blocks = elimination.root, np.zeros((self._size, 3, 3))
        dense = cho_solve(self._root, np.eye(len(self._last)), check_finite=False)
        slots = elimination.slots(root[:, None], root)
        blocks[slots] = _parted(dense[None, :size, :size])[0]
        corner, to_border = dense[size:, size:], np.zeros((elimination.count + 1, 3, len(dense) - size))
        to_border[root] = dense[:size, size:].reshape(len(root), 3, len(corner))
        to_border[elimination.border] = corner.reshape(len(elimination.border), 3, len(corner))
        for batch, (inverse, share, solved) in zip(elimination.rounds[::-1], self._steps[::-1], strict=True):
            turned, above = share.transpose(0, 2, 1), to_border[batch.parents].reshape(*share.shape[:2], len(corner))
            of_border = solved[:, :, :-1]
            across = -(_joined(blocks[batch.slots[:, 1:, 1:]]) @ share + above @ of_border.transpose(0, 2, 1))
            beside = -(turned @ above + of_border @ corner)
            blocks[batch.slots[:, 0, 0]] = inverse - turned @ across - of_border @ beside.transpose(0, 2, 1)
            parts = across.reshape(*batch.parents.shape, 3, 3)
            blocks[batch.slots[:, 1:, 0]], blocks[batch.slots[:, 0, 1:]] = parts, parts.transpose(0, 1, 3, 2)
            to_border[batch.eliminated] = beside
        elimination.fill_in(blocks, to_border)
        return blocks

    def joint(self, variables: Index) -> Array:
        """Joint covariances ``(n, 3 d, 3 d)`` of groups ``(n, d)`` of variables that all have a factor in common."""
        return _joined(self.inverse[self.elimination.slots(variables[:, :, None], variables[:, None, :])])


def _joined(blocks: Array) -> Array:
    """Matrices ``(n, 3 p, 3 q)`` of blocks ``(n, p, q, 3, 3)``."""
    n, p, q = blocks.shape[:3]
    return blocks.transpose(0, 1, 3, 2, 4).reshape(n, 3 * p, 3 * q)


def _parted(matrices: Array) -> Array:
    """Blocks ``(n, p, q, 3, 3)`` of matrices ``(n, 3 p, 3 q)``."""
    n, rows, columns = matrices.shape
    return matrices.reshape(n, rows // 3, 3, columns // 3, 3).transpose(0, 1, 3, 2, 4)


def _inverse(matrices: Array, least: Array) -> tuple[Array, float]:
    """Inverses of positive definite matrices ``(n, 3, 3)``, and the logarithm of the root of all determinants.

    least: ``(n, 3)`` pivots up to which a matrix is not positive definite.
    """
    (a, _, _), (b, d, _), (c, e, f) = matrices.transpose(1, 2, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        p = 1 / np.sqrt(a)
        u, v = b * p, c * p
        second = d - u * u
        q = 1 / np.sqrt(second)
        w = (e - u * v) * q
        third = f - v * v - w * w
        r = 1 / np.sqrt(third)
    if not ((a > least[:, 0]) & (second > least[:, 1]) & (third > least[:, 2])).all():
        raise RuntimeError(INDETERMINATE_TEXT)
    s, t = -u * p * q, -w * q * r
    z = -(v * p + w * s) * r  # the inverse of the lower factor is [[p, 0, 0], [s, q, 0], [z, t, r]]
    xy, xz, yz = s * q + z * t, z * r, t * r
    inverse = np.array([[p * p + s * s + z * z, xy, xz], [xy, q * q + t * t, yz], [xz, yz, r * r]])
    return np.ascontiguousarray(inverse.transpose(2, 0, 1)), -float(np.log(p * q * r).sum())


COVARIANCES_AT_ONCE = 2000  # pieces: all of a long walk would take most of its memory


def covariance_of_ends(at: Evaluation, solution: Covariances, which: Index) -> Array:
    """Covariances of (x, y, heading) at the start and the ends of some pieces ``(1 + n, 3, 3)``, in the output axes.

    Between keyframes: the joint of x_i, x_j and c through the derivatives of the sub-steps, plus the covariance of a
    step given both ends. at, solution: the walk at the optimum, and its linear system there.
    """
    start, covariance = pose_rotation(at.pose_i[:1, 2]), np.empty((1 + len(which), 3, 3))
    covariance[:1] = start @ solution.joint(("x", np.zeros(1, dtype=np.intp))) @ start.transpose(0, 2, 1)
    for n in range(0, len(which), COVARIANCES_AT_ONCE):
        part = which[n : n + COVARIANCES_AT_ONCE]
        i, of_piece = np.unique(at.pieces.interval[part], return_inverse=True)
        joint = solution.joint(("x", i), ("x", i + 1), ("c", at.chain.segment[i]))[of_piece]
        placed, R = at.poses_of(part), pose_rotation(at.pose_i[i[of_piece], 2])
        D = np.concatenate([placed.by_i, placed.by_j, placed.by_c], axis=2)
        spread = R @ at.chain.bridge.spread[part] @ R.transpose(0, 2, 1)
        covariance[1 + n : 1 + n + len(part)] = D @ joint @ D.transpose(0, 2, 1) + spread
    return covariance
