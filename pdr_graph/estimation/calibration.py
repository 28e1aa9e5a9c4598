"""A walker's own calibration from a walk along a known line; profiles as priors of the graph, and from its posterior.

[calibration-walk] Sec. 3.3 fits three coefficients by gradient descent to the path that was walked, and names what goes
wrong: they stand in for each other, and the direction in which the walk began is not known. Here the direction is a
variable like the others, and what the walk does not tell keeps its prior: the answer is the graph's posterior with its
covariance, not three numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.smoother import smooth
from pdr_graph.estimation.verdict import verdict
from pdr_graph.gait.walker import Profile
from pdr_graph.geometry import dead_reckon, unit
from pdr_graph.priors import FIXES, LINE, WALKER
from pdr_graph.types import Array, Estimate, Fixes, Steps


def posterior_profile(estimate: Estimate, steps: Steps, applied: Profile | None = None) -> Profile:
    """The walker's profile for the next walk, from the calibration at the end of this walk.

    steps: of this walk, as in the graph; applied: the profile that has already corrected them.
    """
    calibration = estimate.calibration
    assert calibration is not None, "a graph's or a filter's estimate has one"
    speed = float(steps.length.sum() / steps.duration[~steps.is_gap].sum())
    before = applied or Profile(0.0, 0.0, 0.0, np.zeros((3, 3)), 0.0, speed)
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
    # Somebody else's: R_s l, R_d φ + b t of the uncorrected steps in terms of (1 + E_l) l and (1 + E_c) φ + E_s l
    stride, turn = 1 + profile.E_length, 1 + profile.E_corner
    to_corrected = np.diag([1 / stride, 1 / turn, 1.0])
    to_corrected[2, 1] = -profile.E_straight * profile.speed / turn
    mean = tuple((to_corrected @ Prior().mean).tolist())
    another = _with_covariance(to_corrected @ Prior().covariance @ to_corrected.T, mean=mean, usual=mean[0])
    usual = Prior()
    to_graph = np.array([[1, 0, 0], [0, 0, 1], [0, profile.speed, 0]])
    covariance = to_graph @ profile.covariance @ to_graph.T + np.diag(np.square(WALKER.between_walks))
    known = _with_covariance(covariance, another=another, usual=another.usual)
    return replace(known, sigma=tuple(np.minimum(known.sigma, usual.sigma).tolist()))


def _with_covariance(covariance: Array, **others: Any) -> Prior:
    """A prior with this covariance ``(3, 3)`` of (R_s, R_d, b)."""
    sigma = np.sqrt(np.diag(covariance))
    correlation = (covariance / np.outer(sigma, sigma))[np.triu_indices(3, 1)]
    return Prior(sigma=tuple(sigma.tolist()), correlation=tuple(correlation.tolist()), **others)


FIXES_EVERY = 3.0  # [m] along the line
ROUNDS = 12  # of fitting the walk and matching it to the line


@dataclass(frozen=True)
class Followed:
    """A walk matched to a line: distance along it of the ends of all steps ``(n + 1,)`` [m], and number of laps.

    apart: rms distance of the fitted walk from the line [m].
    """

    along: Array
    laps: int
    apart: float


def calibrate(steps: Steps, route: Array, source: str = "") -> tuple[Profile, Estimate, int]:
    """The profile of a walker who followed a line, the walk in the frame of the line, and the number of laps.

    route: corners ``(m, 2)`` [m] of the line in walking order; a closed line may have been walked several times.
    Raises InputError if the steps do not follow it, or if the walk is not "ok".
    """
    if len(steps) < 20:
        raise InputError(source, "", f"{len(steps)} steps", "a walk of at least twenty along the route")
    closes = np.hypot(*(route[-1] - route[0])) < LINE.strays
    reached, most = steps.length.sum() / _line(route, 1).length, 5 if closes else 1
    likely = [n for n in range(1, most + 1) if reached / FIXES.stretched < n < reached * FIXES.stretched]
    if not likely:
        expected = f"those of a walk along the route, {_line(route, 1).length:.0f} m, give or take a third"
        raise InputError(source, "", f"steps of {steps.length.sum():.0f} m", expected)
    best = min((_follow(steps, route, laps) for laps in likely), key=lambda f: f.apart)
    if best.apart > LINE.farthest:
        expected = f"a walk from its first to its last point, within {LINE.farthest} m"
        raise InputError(source, "", f"steps that leave the route by {best.apart:.1f} m (rms)", expected)
    line = _line(route, best.laps)
    along = np.linspace(0, line.length, max(4, round(line.length / FIXES_EVERY)))
    time = np.interp(along, best.along, np.append(steps.time[0] - steps.duration[0], steps.time))
    fixes = Fixes(time, _at(line, along), np.full(len(along), LINE.sway), ("",) * len(along))
    estimate = smooth(WalkGraph(steps, fixes))
    if not (judged := verdict(estimate)).ok:
        raise InputError(
            source, "", f"a {judged.state} walk: {judged}", "a walk along the route that nothing contradicts"
        )
    profile = posterior_profile(estimate, steps)
    return replace(profile, residual=best.apart), estimate, best.laps


def _follow(steps: Steps, route: Array, laps: int) -> Followed:
    """Fit the walk's shape to the line: its start, direction, and the three coefficients."""
    from scipy.optimize import least_squares  # here, since few walks need it and it takes time to load

    line = _line(route, laps)
    walked = np.append(0.0, np.cumsum(steps.length))
    along = walked * line.length / walked[-1]
    first = _at(line, np.array([0.0, min(FIXES_EVERY, line.length)]))
    scale = np.clip(line.length / walked[-1] - 1, -0.5, 0.5)
    fit = np.array([*first[0], np.arctan2(*(first[1] - first[0])[::-1]), scale, 0.0, 0.0])
    widest = np.array([np.inf, np.inf, np.inf, 0.6, 3 * np.array(LINE.usual)[1], 3 * np.array(LINE.usual)[2]])
    tried = np.linspace(-LINE.strays, LINE.strays, 41)
    for _ in range(ROUNDS):
        place = _at(line, along)
        ahead = _at(line, np.minimum(along + 0.2, line.length)) - _at(line, np.maximum(along - 0.2, 0.0))
        across = unit(np.arctan2(ahead[:, 1], ahead[:, 0]) + np.pi / 2)
        misfit = partial(_misfit, steps=steps, place=place, across=across)
        fit = least_squares(misfit, fit, bounds=(-widest, widest), loss="soft_l1", f_scale=2 * LINE.sway).x
        # The points of the line nearest to the track, within LINE.strays of those before
        candidates = np.clip(along[:, None] + tried, 0, line.length)
        off = _at(line, candidates.ravel()).reshape(len(along), len(tried), 2) - _track(fit, steps)[:, None]
        best = np.argmin(np.sum(off**2, axis=2) + 1e-3 * tried**2, axis=1)
        along = candidates[np.arange(len(along)), best]
    apart = np.sum((_track(fit, steps) - _at(line, along)) ** 2, axis=1)
    return Followed(np.maximum.accumulate(along), laps, float(np.sqrt(np.mean(apart))))


def _misfit(fit: Array, steps: Steps, place: Array, across: Array) -> Array:
    """Residuals: distances across the line, of both ends from its ends, and the prior of the coefficients."""
    gap = _track(fit, steps) - place
    usual = fit[3:] / np.array(LINE.usual) * LINE.sway
    return np.concatenate([np.sum(gap * across, axis=1), gap[0], gap[-1], usual])


def _track(fit: Array, steps: Steps) -> Array:
    """Positions of the ends of all steps ``(n + 1, 2)`` [m]. fit: x, y, direction, E_length, E_corner, E_straight."""
    x, y, direction, length, corner, straight = fit
    profile = Profile(length, straight, corner, np.zeros((3, 3)), 0.0, 1.0)
    return dead_reckon(profile.corrected(steps), heading=direction).position[:-1] + np.array([x, y])


def _line(route: Array, laps: int) -> shapely.LineString:
    return shapely.LineString(np.concatenate([route, *[route[1:]] * (laps - 1)]))


def _at(line: shapely.LineString, along: Array) -> Array:
    return shapely.get_coordinates(shapely.line_interpolate_point(line, along))
