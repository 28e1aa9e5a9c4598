"""The ways that remain for a walk under way: a mixture of Gaussians until its direction is certain.

It begins at the first fix, in all directions. Each fix and heading corrects it, and each solution of the batch replaces
it. On a plan, ways whose present position is inside walls count less, as long as they are there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdr_graph.estimation.factors.chain import intervals
from pdr_graph.estimation.kalman import GaussianMixture
from pdr_graph.estimation.live.batch_start import BatchSolution
from pdr_graph.estimation.live.prediction import SHORTEST, Position, corrected_by_heading, in_any_direction, predict
from pdr_graph.estimation.live.step_buffer import StepBuffer
from pdr_graph.floor.distance_field import DistanceField
from pdr_graph.geometry import horizontal_sigma
from pdr_graph.priors import LIVE_PATHS
from pdr_graph.types import Array, Headings, Index, take


class Modes:
    """Gaussians over (x, y, θ, R_s, R_d, b) with weights, at ``time`` [s]; none before the first fix.

    used: numbers of the headings that corrected them.
    """

    def __init__(self) -> None:
        self.mixture: GaussianMixture | None = None
        self.time = np.nan
        self.used = np.empty(0, dtype=np.intp)

    def begin(self, calibration: GaussianMixture, fix: Position, start: float) -> None:
        """Begin in all directions at a first fix; the walk starts at ``start`` [s]."""
        self.mixture, self.time = in_any_direction(calibration, fix), max(fix.time, start)

    def adopt(self, solution: BatchSolution | None) -> None:
        """Replace the ways by those of the batch if it tells their directions; None: one way is certain."""
        if solution is None:
            self.mixture = None
        elif solution.directed or self.mixture is None:
            everywhere = in_any_direction(solution.modes, solution.near)
            self.mixture = solution.modes if solution.directed else everywhere
            self.time, self.used = float(solution.time[-1]), solution.headings

    def advance(self, steps: StepBuffer, fixes: list[Position]) -> None:
        """Follow the certain steps, with the fixes since the last update."""
        if self.mixture is None or steps.end < self.time + SHORTEST:
            return
        self.mixture = predict(self.mixture, steps.whole, steps.start, self.time, steps.end, fixes)
        self.time = steps.end

    def point(self, steps: StepBuffer, headings: Headings, number: Index) -> None:
        """Correct the ways with the headings up to now that have not been used yet; number: ``(h,)`` theirs."""
        new = ~np.isin(number, self.used) & (headings.time <= self.time)
        if self.mixture is not None and new.any():
            self.mixture = after_headings(
                self.mixture, steps.whole, steps.start, self.time, take(headings, np.flatnonzero(new))
            )
            self.used = np.append(self.used, number[new])


def after_headings(
    mixture: GaussianMixture, whole: Array, start: float, now: float, headings: Headings
) -> GaussianMixture:
    """The mixture at ``now`` [s] after headings of earlier moments. whole, start: of the steps, see `intervals`."""
    rows = zip(headings.time.tolist(), headings.heading.tolist(), headings.sigma.tolist(), strict=True)
    for time, heading, sigma in rows:
        if time > now - SHORTEST:
            mixture = corrected_by_heading(mixture, np.zeros(3), heading, sigma)
            continue
        pieces = intervals(whole, start, max(time, start), np.array([now]))
        turned = np.append(0.0, pieces.to_end[:, -1])
        mixture = corrected_by_heading(mixture, turned, heading, float(np.sqrt(sigma**2 + pieces.variance[:, 2].sum())))
    return mixture


def in_walkable_area(mixture: GaussianMixture, field: DistanceField) -> GaussianMixture:
    """The mixture with lower weights of ways that are inside walls, by their depth there [σ]."""
    if len(mixture) == 1:
        return mixture
    depth = np.maximum(0.0, -field.exact(mixture.mean[:, :2]))
    sigma = horizontal_sigma(mixture.covariance)
    price = np.minimum(0.5 * np.square(depth / sigma), LIVE_PATHS.wall_price)
    return replace(mixture, log_weight=mixture.log_weight - price).take(np.arange(len(mixture)))
