"""A solved walk under another prior of a few variables, without solving it again.

Where the prior of q variables, picked out by E, changes its information by Δ and the gradient of the cost by g, the
matrix inversion lemma gives covariance, determinant and step from the covariances C = Σ E, S = Eᵀ Σ E before,

    Σ' = Σ − C M Cᵀ,   M = (1 + Δ S)⁻¹ Δ,   det Σ'⁻¹ = det Σ⁻¹ det(1 + Δ S),   δ = −(C − C M S) g

and the cost falls by gᵀ (S − S M S) g / 2, exactly if all factors are linear.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from pdr_graph.estimation.factors.base import FactorBlock, State
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.normal_equations import ChangedSolution, Solution
from pdr_graph.estimation.optimizer import CONVERGED, Optimum
from pdr_graph.types import Array


def with_changed_prior(old: Optimum, graph: WalkGraph, start: State, name: str) -> Optimum | None:
    """The optimum of ``graph``, which differs from that of ``old`` in the prior ``name`` alone.

    start: the state of ``old``. None if many variables are concerned, or the cost does not fall as in a linear walk.
    """
    at, before = graph.evaluate(start), old.solution
    [was], [now] = old.at.blocks_of(name), at.blocks_of(name)
    [(symbol, rows)] = now.variables
    if not isinstance(before, Solution) or (columns := before.covariance_with(symbol, rows)) is None:
        return None

    # The change of the prior, and what follows for all variables
    delta, g = (b - a for a, b in zip(_normal_equations(was), _normal_equations(now), strict=True))
    S = columns[symbol][rows].reshape(len(g), len(g))
    ratio = np.eye(len(g)) + delta @ S
    M: Array = np.linalg.inv(ratio).astype(float) @ delta
    step = g - M @ S @ g
    candidate = graph.evaluate(start.retracted({symbol: -(C @ step) for symbol, C in columns.items()}))
    if abs(at.cost - candidate.cost - g @ S @ step / 2) > CONVERGED * (1 + at.cost):
        return None
    information = before.log_determinant + float(np.linalg.slogdet(ratio)[1]) / 2
    system = ChangedSolution(before, columns, M, information)
    return replace(old, graph=graph, at=candidate, system=system, iterations=1, converged=True)


def _normal_equations(prior: FactorBlock) -> tuple[Array, Array]:
    """Information ``(q, q)`` and gradient ``(q,)`` of linear factors of one variable each, in order."""
    residual, [by] = prior.weighted
    J = np.asarray(block_diag(*by.reshape(len(prior), -1, 3)), dtype=float)
    return J.T @ J, J.T @ residual
