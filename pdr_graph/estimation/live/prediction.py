"""The current pose: extended Kalman filters from the last keyframe through later steps and fixes.

One filter if the direction of the walk is certain; else a mixture, one for each way that remains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.estimation.factors.chain import increment_covariance, intervals, preintegrate
from pdr_graph.estimation.kalman import (
    FAR,
    OF_POSITION,
    GaussianMixture,
    by_direction,
    heading_corrected,
    measured,
    thinned,
)
from pdr_graph.geometry import pose_rotation
from pdr_graph.types import Array

LEFT = np.array([[0.0, -1.0], [1.0, 0.0]])  # rotation by 90°
SHORTEST = 1e-6  # [s] between two times; less is rounding


@dataclass(frozen=True)
class Position:
    """A fix: time [s], position ``(2,)`` [m], sigma [m]; share: of its information that is independent of others."""

    time: float
    position: Array
    sigma: float
    share: float


@dataclass(frozen=True)
class Belief:
    """Mean ``(6,)`` and covariance ``(6, 6)`` of (x, y, θ, R_s, R_d, b), in the output axes."""

    mean: Array
    covariance: Array


def single_mode(mean: Array, covariance: Array) -> GaussianMixture:
    """The mixture of one Gaussian: mean ``(6,)``, covariance ``(6, 6)`` of (x, y, θ, R_s, R_d, b)."""
    return GaussianMixture(mean[None], covariance[None], np.zeros(1), np.zeros(1, dtype=np.intp))


def in_output_axes(joint: Array, heading: float) -> Array:
    """The joint covariance ``(6, 6)`` of a pose with this heading [rad], in its own axes, and a calibration."""
    T = np.eye(6)
    T[:3, :3] = pose_rotation(np.array([heading]))[0]
    return T @ joint @ T.T


def in_any_direction(at: GaussianMixture, fix: Position) -> GaussianMixture:
    """The mixture of all directions at a first fix; ``at`` has the calibration."""
    mean, covariance = at.mean[0].copy(), np.zeros((6, 6))
    mean[:2] = fix.position
    covariance[:3, :3] = np.diag(np.square([FAR, FAR, FAR]))
    covariance[3:, 3:] = at.covariance[0, 3:, 3:]
    return corrected(by_direction(single_mode(mean, covariance)), fix)


def corrected(mixture: GaussianMixture, fix: Position) -> GaussianMixture:
    """The mixture after a fix, with Huber's weight, and weight 0 beyond the gate."""
    R = fix.sigma**2 * np.eye(2)
    return thinned(measured(mixture, OF_POSITION, fix.position - mixture.mean[:, :2], R, fix.share)[0])


def beyond_gate(mixture: GaussianMixture, position: Array, sigma: float) -> bool:
    """True if a position ``(2,)`` [m] with this sigma [m] is beyond the gate of all ways."""
    R = sigma**2 * np.eye(2)
    return bool((measured(mixture, OF_POSITION, position - mixture.mean[:, :2], R)[1].weight == 0.0).all())


def corrected_by_heading(mixture: GaussianMixture, turned: Array, heading: float, sigma: float) -> GaussianMixture:
    """The mixture after a heading of a moment in the past [rad].

    turned: ``(3,)`` since then, as a function of (R_s, R_d, b).
    """
    H = np.zeros((1, 6))
    H[0, 2], H[0, 3:] = 1.0, -turned
    return thinned(heading_corrected(mixture, H, heading, sigma**2))


def predict(
    mixture: GaussianMixture, whole: Array, start: float, begin: float, end: float, fixes: Sequence[Position]
) -> GaussianMixture:
    """Predict the mixture from ``begin`` to ``end`` [s] through the steps and fixes between, in order of time.

    whole, start: of the steps, see `intervals`.
    """
    moments = np.unique([*(fix.time for fix in fixes if begin + SHORTEST < fix.time <= end), end])
    if moments[-1] < begin + SHORTEST:
        return mixture
    pieces = intervals(whole, start, begin, moments)
    mean_c = mixture.mean[mixture.best, 3:]
    increments = preintegrate(pieces, np.tile(mean_c, (len(moments), 1)))
    spread = increment_covariance(pieces, increments)
    waiting = list(fixes)
    for n, moment in enumerate(moments.tolist()):
        last = pieces.last[n]
        mixture = _moved(mixture, increments.delta[last], increments.by_c[last], spread[n], mean_c)
        while waiting and waiting[0].time <= moment:
            mixture = corrected(mixture, waiting.pop(0))
    return mixture


def _moved(mixture: GaussianMixture, delta: Array, by_c: Array, spread: Array, mean_c: Array) -> GaussianMixture:
    """The mixture after a displacement ``delta (3,)`` at calibration ``mean_c (3,)``, with covariance ``spread``."""
    R = pose_rotation(mixture.mean[:, 2])
    of_each = delta + (mixture.mean[:, 3:] - mean_c) @ by_c.T
    mean = mixture.mean.copy()
    mean[:, :3] += np.einsum("hij,hj->hi", R, of_each)
    F = np.tile(np.eye(6), (len(mean), 1, 1))
    F[:, :2, 2] = (mean - mixture.mean)[:, :2] @ LEFT.T
    F[:, :3, 3:] = R @ by_c
    covariance = F @ mixture.covariance @ F.transpose(0, 2, 1)
    covariance[:, :3, :3] += R @ spread @ R.transpose(0, 2, 1)
    return replace(mixture, mean=mean, covariance=covariance)
