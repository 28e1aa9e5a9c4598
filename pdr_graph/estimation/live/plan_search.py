"""A walk under way without any position, sought on the whole plan.

The search is the batch's (`global_localization`), repeated while the walk goes on. Until one place is certain, its
solutions are the ways that remain; then that place is a fix and a heading like any others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pdr_graph.estimation.global_localization import Localization, localized
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.kalman import GaussianMixture
from pdr_graph.estimation.live.batch_start import modes_at_end
from pdr_graph.estimation.optimizer import paths, probabilities
from pdr_graph.geometry import ANY_HEADING, horizontal_sigma
from pdr_graph.priors import REPORTS
from pdr_graph.types import Array, Fixes, Headings

SOURCE = "plan"  # of the fix and the heading of a place that is certain
LEAST_SIGMA, LEAST_SIGMA_HEADING = 1.0, 0.2  # [m], [rad] of a certain place: the walls that tell it count again
NOWHERE_ELSE, LEAST = 1e-3, 1e-9  # probability below which no other place is kept; least of the solutions together


@dataclass(frozen=True)
class Places:
    """The places of a walk on the plan at ``time`` [s]. ways: with their probabilities; sure: the first is certain."""

    time: float
    ways: GaussianMixture
    sure: bool

    @property
    def fix(self) -> Fixes:
        """The certain place."""
        sigma = max(float(horizontal_sigma(self.ways.covariance[0])), LEAST_SIGMA)
        return Fixes(np.array([self.time]), self.ways.mean[:1, :2], np.array([sigma]), source=(SOURCE,))

    @property
    def heading(self) -> Headings:
        """The direction at the certain place."""
        sigma = max(float(np.sqrt(self.ways.covariance[0, 2, 2])), LEAST_SIGMA_HEADING)
        return Headings(np.array([self.time]), self.ways.mean[:1, 2], np.array([sigma]), (SOURCE,))


@dataclass(frozen=True)
class PlacesQuestion:
    """A search that is due. graph: builds that of the walk so far."""

    graph: Callable[[], WalkGraph]

    def answer(self) -> Places:
        """The places where the walk can be now."""
        graph = self.graph()
        found = localized(graph)
        path = paths(found.optima)
        share = probabilities(found.optima, path)
        there = 1.0 - found.elsewhere
        ways = _with_elsewhere(modes_at_end(found.optima, share), found, 1.0 - there * float(share.sum()))
        return Places(float(graph.keyframe_time[-1]), ways, there * float(share[path == 0].sum()) > REPORTS.sure)


def _with_elsewhere(ways: GaussianMixture, found: Localization, probability: float) -> GaussianMixture:
    """The ways, and anywhere on the plan in any direction with a probability."""
    if probability < NOWHERE_ELSE:
        return ways
    mean, covariance = ways.mean[0].copy(), ways.covariance[0].copy()
    mean[:3] = (*found.anywhere.mean(axis=0), 0.0)
    covariance[:3], covariance[:, :3] = 0.0, 0.0
    covariance[:2, :2], covariance[2, 2] = np.cov(found.anywhere.T), ANY_HEADING**2
    remaining = np.log(max(1.0 - probability, LEAST))
    weight = np.append(ways.log_weight + remaining, np.log(probability))
    both: tuple[Array, Array] = np.vstack([ways.mean, mean]), np.concatenate([ways.covariance, covariance[None]])
    return GaussianMixture(*both, weight, np.arange(len(weight)))
