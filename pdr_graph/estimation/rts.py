"""The filter's walk, smoothed as by Rauch, Tung and Striebel, "Maximum likelihood estimates of linear dynamic systems".

AIAA Journal 3(8), 1965. From the last moment back, each state is corrected by what the one after it learnt:

    C_k = P_k F_kᵀ (P⁻_{k+1})⁻¹
    x̂_k = x_k + C_k (x̂_{k+1} − x⁻_{k+1}),      P̂_k = P_k + C_k (P̂_{k+1} − P⁻_{k+1}) C_kᵀ

with x, P as the filter knew them and x⁻, P⁻ as it predicted. It is linear about the filter's walk, where the graph is
linearised again and again about its own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdr_graph.errors import expect
from pdr_graph.estimation.filters import Moment, estimate_of, moments
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.geometry import interpolate
from pdr_graph.types import Array, Estimate


def kalman_smoother(graph: WalkGraph) -> Estimate:
    """The filter's most probable walk at every row, given the fixes before and after; it knows no wall.

    graph: the same measurements as for ``smooth``; its walls are not used. What the filter refused stays refused.
    """
    expect("kalman_smoother, graph", graph, WalkGraph, instead="WalkGraph(steps, fixes)")
    run = list(moments(graph))
    means, covariances = _backward(run)
    met = [one for moment in run for one in moment.met]
    estimate = estimate_of(graph, means, covariances, met, run[-1].known)
    track = estimate.trajectory
    apart = np.hypot(*(graph.fixes.position - interpolate(graph.fixes.time, track.time, track.position)).T)
    fixes = (replace(fix, residual=float(d)) for fix, d in zip(estimate.fixes, apart, strict=True))
    return replace(estimate, fixes=tuple(fixes))


def _backward(run: list[Moment]) -> tuple[Array, Array]:
    """Smoothed states ``(m + 1, 6)`` and covariances ``(m + 1, 6, 6)`` along the hypothesis that won."""
    own = run[-1].known.best
    mean, P = run[-1].known.mean[own], run[-1].known.covariance[own]
    means, covariances = [mean], [P]
    for before, after in zip(run[-2::-1], run[:0:-1], strict=True):
        n = after.known.origin[own]
        own, F, predicted = after.parent[n], after.motion[n], after.predicted
        known = before.known
        C = np.linalg.solve(predicted.covariance[n], F @ known.covariance[own]).T
        mean = known.mean[own] + C @ (mean - predicted.mean[n])
        P = known.covariance[own] + C @ (P - predicted.covariance[n]) @ C.T
        means.append(mean)
        covariances.append(P)
    return np.array(means[::-1]), np.array(covariances[::-1])
