"""How an estimate that may be lied to is scored: error, stated regions, harm, probability and verdict."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from tables import table

from pdr_graph.apps.report.evaluation import REGION_90, pair
from pdr_graph.geometry import interpolate

TIMES, SLACK = 1.25, 0.3  # [-], [m]: no harm if the error is at most TIMES that without the source, plus SLACK
RADII = 3.0  # stated 95 % radii beyond which an error is a broken promise
LEAST_COVERAGE, MOST_BROKEN, LEAST_UNHARMED = 0.85, 0.01, 0.9  # targets
HEADER = ["walks", "error [m]", "in 90 % region", "its radius [m]", "mean over 3 × r95", "worst place over 3 × r95"]
HEADER += ["no harm", "not ok"]


def _radii():
    """Ratios of a Gaussian's two sigmas, and the radius that holds 95 % of it, in the larger one."""
    ratio, angle = np.linspace(0, 1, 51), np.linspace(0, np.pi / 2, 401)
    square = np.cos(angle) ** 2 + ratio[:, None] ** 2 * np.sin(angle) ** 2 + 1e-12
    low, high = np.ones(len(ratio)), np.full(len(ratio), 3.0)
    for _ in range(40):
        middle = (low + high) / 2
        inside = np.trapezoid(1 - np.exp(-0.5 * middle[:, None] ** 2 / square), angle) * 2 / np.pi
        low, high = np.where(inside < 0.95, middle, low), np.where(inside < 0.95, high, middle)
    return ratio, (low + high) / 2


RATIO, RADIUS_95 = _radii()


@dataclass(frozen=True)
class Score:
    """How an estimate is off along a walk.

    error [m], inside (the 90 % region), size of that region as the radius of a circle of its area [m], radius that
    holds 95 % [m]: ``(n,)``; probability: stated of the route; verdict: "" while the package has none.
    """

    error: np.ndarray
    inside: np.ndarray
    size: np.ndarray
    radius: np.ndarray
    probability: float
    verdict: str

    @property
    def broken(self):
        """The mean error is more than three times the mean stated 95 % radius."""
        return self.error.mean() > RADII * self.radius.mean()

    @property
    def broken_somewhere(self):
        """At some place the error is more than three times the 95 % radius that is stated there."""
        return (self.error > RADII * self.radius).any()

    def harmless(self, without):
        """The walk is about as good as without the source, or better."""
        return self.error.mean() <= TIMES * without.error.mean() + SLACK


def score(estimate, truth, noise=0.0):
    """The score of an estimate. noise: of the truth itself, per axis [m]."""
    track = estimate.trajectory
    pairs = pair(track, truth)
    covariance = interpolate(pairs.time, track.time, track.covariance[:, :2, :2].reshape(-1, 4)).reshape(-1, 2, 2)
    covariance = covariance + noise**2 * np.eye(2)
    gap = pairs.estimate - pairs.truth
    variance = np.linalg.eigvalsh(covariance)
    small, large = np.sqrt(np.maximum(variance, 1e-12)).T
    return Score(
        error=np.hypot(*gap.T),
        inside=np.einsum("ni,nij,nj->n", gap, np.linalg.inv(covariance), gap) < REGION_90,
        size=np.sqrt(REGION_90 * small * large),
        radius=large * np.interp(small / large, RATIO, RADIUS_95),
        probability=estimate.probability,
        verdict=verdict_of(estimate),
    )


def verdict_of(estimate):
    """The state of the package's verdict; empty while there is none."""
    try:
        from pdr_graph import verdict
    except ImportError:
        return ""
    return verdict(estimate).state


def cells(scores, without):
    """Cells of a row from the scores of its walks; those that miss a target are bold. without: None, or scores."""
    error, inside, size = (np.concatenate([getattr(s, name) for s in scores]) for name in ("error", "inside", "size"))
    errors = " / ".join(f"{p:.1f}" for p in np.percentile(error, [50, 75, 95]))
    row = [len(scores), errors, share(inside, LEAST_COVERAGE), f"{np.median(size):.1f}"]
    for broken in ([s.broken for s in scores], [s.broken_somewhere for s in scores]):
        row.append(marked(f"{sum(broken)} of {len(broken)}", np.mean(broken) > MOST_BROKEN))
    unharmed = None if without is None else [s.harmless(w) for s, w in zip(scores, without, strict=True)]
    row.append("—" if unharmed is None else share(unharmed, LEAST_UNHARMED))
    states = [s.verdict for s in scores]
    return [*row, share([state != "ok" for state in states]) if all(states) else "-"]


def share(holds, least=0.0):
    """How often something holds; bold below the target."""
    return marked(f"{100 * np.mean(holds):.0f} %", np.mean(holds) < least)


def marked(text, missed):
    return f"**{text}**" if missed else text


BINS = (0.0, 0.5, 0.7, 0.9, 0.97, 1.0)
RIGHT, CALIBRATED = 4.0, 0.05  # [m] mean error of a walk on the right route; target of the expected calibration error


def reliability(groups):
    """How often routes are right by what is stated of them. groups: by name, scores of walks with a plan."""
    rows = []
    for name, scores in groups.items():
        stated = np.array([s.probability for s in scores])
        right = np.array([s.error.mean() < RIGHT for s in scores])
        place = np.clip(np.searchsorted(BINS, stated) - 1, 0, len(BINS) - 2)
        calibration = 0.0
        for n, (low, high) in enumerate(pairwise(BINS)):
            here = place == n
            if here.any():
                calibration += here.mean() * abs(stated[here].mean() - right[here].mean())
                shares = [f"{100 * values[here].mean():.0f} %" for values in (stated, right)]
                rows.append([name, f"{100 * low:.0f}–{100 * high:.0f} %", here.sum(), *shares])
        said = marked(f"{calibration:.3f}", calibration > CALIBRATED)
        rows.append([name, "expected calibration error", len(scores), said, ""])
    return table(["given", "stated", "walks", "mean stated", "right route"], rows)
