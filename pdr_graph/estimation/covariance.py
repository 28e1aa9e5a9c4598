"""Covariance of every step, from the factorised graph.

The joint covariance of x_i, x_j and c is needed for the steps between x_i and x_j. GTSAM gives one joint at a time; one
walk through its Bayes net, from the last eliminated variable to the first, gives all of them. With R x_f + S x_p = d
the conditional of a variable f on its parents p,

    Σ_pf = −Σ_pp Sᵀ R⁻ᵀ,      Σ_ff = R⁻¹ R⁻ᵀ + R⁻¹ S Σ_pp Sᵀ R⁻ᵀ

and Σ_pp is available, since the parents of a variable always occur together in a conditional eliminated later (Golub &
Plemmons 1980; Kaess & Dellaert 2009, Sec. 5). Variables at the same depth of the elimination tree are independent of
each other and computed together; with METIS the tree is about 2 log₂ N deep.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from pdr_graph.estimation.block_cholesky import INDETERMINATE_TEXT
from pdr_graph.estimation.factors.chain import Evaluation
from pdr_graph.estimation.normal_equations import RESCUING, Solution
from pdr_graph.geometry import pose_rotation
from pdr_graph.types import Array, Index

if TYPE_CHECKING:
    import gtsam

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


def eliminated(linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> gtsam.GaussianBayesNet:
    """The graph, factorised by GTSAM; with zero priors if rounding errors make it indeterminate.

    That happens where variables hang on a gap of half an hour alone, which says next to nothing of them.
    """
    import gtsam

    unit = gtsam.noiseModel.Unit.Create(3)
    for damping in RESCUING:
        damped = gtsam.GaussianFactorGraph()
        damped.push_back(linear)
        for key in linear.keyVector() if damping else ():
            damped.add(key, np.sqrt(damping) * np.eye(3), np.zeros(3), unit)
        with suppress(RuntimeError):
            return damped.eliminateSequential(ordering)
    raise RuntimeError(INDETERMINATE_TEXT)


class CovarianceBlocks:
    """Covariances of all pairs of 3-vectors that share a conditional, in GTSAM's local coordinates."""

    def __init__(self, net: gtsam.GaussianBayesNet):
        """net: from sequential elimination of a graph whose variables all have three dimensions."""
        conditionals = [net.at(n) for n in range(net.size())]
        families = [c.keys() for c in conditionals]  # the variable itself, then its parents
        self._place = {family[0]: n for n, family in enumerate(families)}
        families = [[self._place[key] for key in family] for family in families]
        depth = [0] * len(families)
        for f, *parents in reversed(families):
            depth[f] = 1 + max((depth[p] for p in parents), default=-1)

        batches: defaultdict[tuple[int, int], list[int]] = defaultdict(list)
        for f, family in enumerate(families):
            batches[depth[f], len(family)].append(f)
        members = {batch: np.array([families[f] for f in numbers]) for batch, numbers in batches.items()}
        pairs = [self._code(m[:, :1], m) for m in members.values()] + [
            self._code(m, m[:, :1]) for m in members.values()
        ]
        self._codes = np.unique(np.concatenate([p.ravel() for p in pairs]))
        self._blocks = np.empty((len(self._codes), 3, 3))
        for batch in sorted(batches):
            batch_conditionals = [conditionals[f] for f in batches[batch]]
            R, S = np.array([c.R() for c in batch_conditionals]), np.array([c.S() for c in batch_conditionals])
            self._solve(members[batch], np.linalg.inv(R).astype(float), S)

    def joint(self, keys: Sequence[tuple[int, ...]]) -> Array:
        """Joint covariances ``(n, 3 d, 3 d)`` of n tuples of d keys that share a conditional."""
        return self._among(np.array([[self._place[key] for key in group] for group in keys]))

    def _solve(self, family: Index, R_inverse: Array, S: Array) -> None:
        """Add the blocks of conditionals of one depth: ``family (n, 1 + p)`` places, S ``(n, 3, 3 p)``, p parents."""
        f, parents = family[:, :1], family[:, 1:]
        marginal = R_inverse @ R_inverse.transpose(0, 2, 1)
        if parents.size:
            share = R_inverse @ S
            across = -self._among(parents) @ share.transpose(0, 2, 1)
            marginal -= share @ across
            across = across.reshape(*parents.shape, 3, 3)
            self._blocks[self._slot(parents, f)] = across
            self._blocks[self._slot(f, parents)] = across.transpose(0, 1, 3, 2)
        self._blocks[self._slot(f, f)[:, 0]] = marginal

    def _among(self, group: Index) -> Array:
        """Joint covariances ``(n, 3 d, 3 d)`` of places ``(n, d)``."""
        n, d = group.shape
        blocks = self._blocks[self._slot(group[:, :, None], group[:, None, :])]
        return blocks.transpose(0, 1, 3, 2, 4).reshape(n, 3 * d, 3 * d)

    def _slot(self, rows: Index, columns: Index) -> Index:
        """Index of each pair of places in the blocks."""
        return np.searchsorted(self._codes, self._code(rows, columns))

    def _code(self, rows: Index, columns: Index) -> Index:
        """A number for each pair of places."""
        return rows * len(self._place) + columns
