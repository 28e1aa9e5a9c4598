"""A walker's profile and the graph: what a walk taught becomes a profile, and a profile the next walk's prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdr_graph.estimation.graph import Prior
from pdr_graph.gait.profile import Profile
from pdr_graph.types import Estimate, Steps

BETWEEN_WALKS = (0.05, 0.01, 0.001)  # of R_s, R_d, b [rad/s]: how they differ from one walk of somebody to the next


def posterior_profile(estimate: Estimate, steps: Steps, known: Profile | None = None) -> Profile:
    """What a walk taught of its walker, for the next one: the calibration at its end.

    steps: of this walk, as the graph had them; known: the profile by which they were already corrected.
    """
    calibration = estimate.calibration
    assert calibration is not None, "a graph's or a filter's estimate has one"
    speed = float(steps.length.sum() / steps.duration[steps.length > 0].sum())
    before = known or Profile(0.0, 0.0, 0.0, np.zeros((3, 3)), 0.0, speed)
    to_paper = np.array([[1, 0, 0], [0, 0, 1 / speed], [0, 1, 0]])  # (R_s, R_d, b) to (length, straight, corner)
    length, straight, corner = to_paper @ (calibration.value[-1] - (1, 1, 0))
    used = np.array([fix.residual for fix in estimate.fixes if fix.weight > 0])
    return Profile(
        E_length=float((1 + before.E_length) * (1 + length) - 1),
        E_straight=float((1 + before.E_length) * straight + (1 + corner) * before.E_straight),
        E_corner=float((1 + before.E_corner) * (1 + corner) - 1),
        covariance=to_paper @ calibration.covariance[-1] @ to_paper.T,
        residual=float(np.sqrt(np.mean(used**2))) if len(used) else 0.0,
        speed=speed / (1 + before.E_length),
    )


def prior_of(profile: Profile | None) -> Prior:
    """The graph's prior for a walk whose steps the profile has already corrected."""
    if profile is None:
        return Prior()
    usual = Prior()
    to_graph = np.array([[1, 0, 0], [0, 0, 1], [0, profile.speed, 0]])
    covariance = to_graph @ profile.covariance @ to_graph.T + np.diag(np.square(BETWEEN_WALKS))
    sigma = np.sqrt(np.diag(covariance))
    correlation = (covariance / np.outer(sigma, sigma))[np.triu_indices(3, 1)]
    return replace(usual, sigma=tuple(np.minimum(sigma, usual.sigma).tolist()), correlation=tuple(correlation.tolist()))
