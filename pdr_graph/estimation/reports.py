"""What an estimate says of itself: why each fix was trusted or not, and what to beware of."""

from __future__ import annotations

import gtsam
import numpy as np

from pdr_graph.estimation.beacons import LEVEL_SIGMA, Levels
from pdr_graph.estimation.graph import Prior, State, WalkGraph
from pdr_graph.types import Array, BeaconReport, Calibration, FixReport, Index

SURE = 0.9  # probability below which a user is warned
DOUBTED = 0.1  # weight below which a fix counts for nothing
MANY = 0.1  # share of doubted fixes at which a user is warned
SAID = {"R_s": "the stride's scale R_s", "R_d": "the turns' scale R_d", "b": "the gyro's drift b"}


def fix_reports(graph: WalkGraph, distance: Array, sigmas: Array, weight: Array, from_: str) -> tuple[FixReport, ...]:
    """Residual, weight and reason of every fix.

    distance: ``(f,)`` [m] from ``from_`` ("the walk"); the same in ``sigmas (f,)``; weight: ``(f,)`` what it was given.
    """
    reports = []
    for n, (x, y) in enumerate(graph.fixes.position.tolist()):
        if graph.fix_repeats[n]:
            reason = "the receiver said again what it had said: not used twice"
        elif graph.by_proximity:
            reason = "a beacon that was loud: it told where to start"
        elif not graph.fix_used[n]:
            reason = "outside the recording: not used"
        else:
            reason = reason_of(float(sigmas[n]), float(weight[n]), bool(graph.fix_wild[n]), from_)
        time, sigma = float(graph.fixes.time[n]), float(graph.fixes.sigma[n])
        reports.append(FixReport(time, x, y, sigma, float(distance[n]), float(weight[n]), reason))
    return tuple(reports)


def reports_at(graph: WalkGraph, values: gtsam.Values) -> tuple[FixReport, ...]:
    """Of every fix, from the walk at ``values``."""
    distance = graph.fix_distance(values)
    return fix_reports(graph, distance, distance / graph.fix_sigma, graph.fix_weight(values), "the walk")


def reason_of(sigmas: float, weight: float, wild: bool, from_: str = "the walk") -> str:
    """Why a fix that was met so many sigmas ``from_`` where it was expected has this weight."""
    trust = {0.0: "refused", 1.0: "full weight"}.get(weight, "weighted down")
    return f"{sigmas:.1f} sigma from {from_}: {'taken for wild' if wild else trust}"


def calibration_of(graph: WalkGraph, value: Array, covariance: Array) -> Calibration:
    """What the walk taught of (R_s, R_d, b) in each of its segments: ``(s, 3)``, ``(s, 3, 3)``."""
    prior = prior_sigma(graph.prior, np.arange(len(value)))
    return Calibration(graph.pieces.keyframe_time[graph.segment_first], value, covariance, prior)


def prior_sigma(prior: Prior, segment: Index) -> Array:
    """Standard deviations ``(s, 3)`` of (R_s, R_d, b) in segments ``(s,)`` before any measurement."""
    return np.sqrt(np.square(prior.sigma) + segment[:, None] * np.square(prior.change))


def warnings(
    graph: WalkGraph, walks: int, probability: float, converged: bool, calibration: Calibration
) -> tuple[str, ...]:
    """What a user must know before trusting the result.

    walks: how many explain the measurements; probability: that it went the way that the estimate did.
    """
    used, given = int(graph.fix_used.sum()), int((~graph.fix_repeats).sum())
    warned = {
        "no position fix: the track starts at (0, 0) with heading 0": used == 0,
        "one position fix: the direction of the walk is unknown, heading 0 was assumed": used == 1
        and not graph.walled
        and not len(graph.headings),
        "no fix lies near the floor plan: its walls were not used": bool(used and graph.ground and not graph.walled),
        f"{given - used} fixes lie outside the recording, by {_beside(graph):.0f} s or more, and were not used": used
        < given,
        f"{walks} different walks explain the measurements, this way with a probability of {probability:.0%}; the "
        "covariance spans them": walks > 1,
        f"the walk fits the plan poorly, this way with a probability of {probability:.0%}: it may have been another": (
            walks == 1 and probability < SURE
        ),
        "the optimiser had not settled": not converged,
    }
    open_ = [SAID[name] for n, name in enumerate(calibration.names) if not calibration.learnt[:, n].any()]
    be, them = ("is", "it") if len(open_) == 1 else ("are", "them")
    warned[f"{', '.join(open_)} {be} the prior's: the measurements do not determine {them}"] = bool(open_)
    return tuple(text for text, holds in warned.items() if holds)


def contradicted(graph: WalkGraph, fixes: tuple[FixReport, ...]) -> tuple[str, ...]:
    """What a user must know of fixes that the steps and the other fixes contradict; see `is_a_guess`."""
    doubted, used = _doubted(graph, fixes), int(graph.fix_used.sum())
    if doubted <= MANY * used:
        return ()
    guess = ": where the walk was is a guess" if is_a_guess(graph, fixes) else ""
    return (f"{doubted} of {used} fixes contradict the steps and the other fixes and counted for nothing{guess}",)


def is_a_guess(graph: WalkGraph, fixes: tuple[FixReport, ...]) -> bool:
    """Whether as many fixes say that the walk was elsewhere as say that it was where it is."""
    return 2 * _doubted(graph, fixes) >= max(int(graph.fix_used.sum()), 1)


def _doubted(graph: WalkGraph, fixes: tuple[FixReport, ...]) -> int:
    """How many of the used fixes counted for nothing; none of loud beacons, which are let go of on purpose."""
    weight = np.array([fix.weight for fix in fixes])
    return 0 if graph.by_proximity else int(np.sum(graph.fix_used & (weight < DOUBTED)))


def _beside(graph: WalkGraph) -> float:
    """By how much the nearest of the fixes that lie outside the recording do. [s]"""
    time = graph.fixes.time[~graph.fix_used & ~graph.fix_repeats]
    return float(np.min(np.maximum(graph.steps.start - time, time - graph.steps.end), initial=np.inf))


def beacon_reports(levels: Levels | None, graph: WalkGraph, state: State) -> tuple[BeaconReport, ...]:
    """What the walk of ``graph`` tells of each beacon of ``levels``, as they were given to it."""
    if levels is None or graph.levels is None:
        return ()
    rows = graph.levels.heard(graph.level_keyframe, state.poses, state.b, state.q[0])
    off = LEVEL_SIGMA * rows.value[:, 0]
    reports = []
    for m, (x, y) in enumerate(state.b[:, :2].tolist()):
        own, listed = levels.beacon == m, levels.position[m]
        moved = bool(np.isfinite(listed[0]) and np.isnan(graph.levels.position[m, 0]))
        distance = np.hypot(*(levels.position - (x, y)).T)
        if np.isnan(listed[0]):
            reason = "its place is learnt"
        elif moved:
            like = levels.label[int(np.nanargmin(distance))]
            reason = (
                f"heard as if it were {distance[m]:.0f} m from where it is listed, nearest to the place of {like}: "
            )
            reason += "moved or swapped, its place was not used"
        else:
            reason = "heard where it is listed"
        reports.append(
            BeaconReport(levels.label[m], int(own.sum()), float(np.abs(off[own]).mean()), x, y, moved, reason)
        )
    return tuple(reports)
