"""How the current pose of a live walk is scored: errors, time to the first pose, jumps, walls, jitter and latency."""

from collections import Counter
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely
from recorded import errors_at, gaps

from pdr_graph.apps.report.evaluation import circular_error, heading_error, pair

NEAR, POINTED = 5.0, 0.5  # [m] and [rad] within which a place and a direction are right
MINUTE = 60.0  # [s]
NOTABLE = 1.0  # [m] of a jump whose cause is counted
ON_THE_EDGE = 0.05  # [m] beyond the walkable area that a place may be, by the plan's own precision
STILL, LEAST_STAND = 0.05, 50.0  # [m] within which a walker stands; [s] of a stand whose jitter is measured
SETTLING = 5.0  # [s] after the last step, until a stand is known to be one


@dataclass(frozen=True)
class WalkScore:
    """How the current pose of one walk is off.

    errors: by estimate at the places of the truth that all estimates have ``(n,)`` [m]; inside: of each, whether it is
    in the 90 % region of the pose; first, near, pointed: seconds from the first sample to the first pose, to a place
    within NEAR and to a direction within POINTED, infinite if never, pointed NaN without true directions; jumps,
    display_jumps: the largest of each minute [m]; causes: of the notable ones; outside: whether each pose is outside
    the walkable area, empty without a plan; jitter: of each stand of a minute [m]; cpu, wall: of each ask [s].
    """

    errors: dict
    inside: np.ndarray
    first: float
    near: float
    pointed: float
    jumps: np.ndarray
    display_jumps: np.ndarray
    causes: tuple
    outside: np.ndarray
    jitter: np.ndarray
    cpu: np.ndarray
    wall: np.ndarray


def score_of(case, run, batch):
    """The score of a run. batch: the trajectory of the whole walk at once."""
    cpu, wall = (np.array([getattr(ask, name) for ask in run.asks]) for name in ("cpu", "wall"))
    empty = np.empty(0)
    if not run.shown:
        never = np.inf
        errors = {name: empty for name in ("pose", "filter", "lag", "batch")}
        return WalkScore(errors, empty, never, never, never, empty, empty, (), empty, empty, cpu, wall)
    truth, causal = case.walk.truth, run.causal
    errors, inside = errors_of(case, run, batch)
    size, causes = jumps(run)
    return WalkScore(
        errors=errors,
        inside=inside,
        first=run.shown[0].time - case.begin,
        near=time_to_near(causal, truth) - case.begin,
        pointed=time_to_pointed(causal, truth) - case.begin,
        jumps=by_minute(run.shown, size),
        display_jumps=by_minute(run.shown, display_jumps(run)),
        causes=tuple(np.array(causes, dtype=object)[size > NOTABLE]),
        outside=outside(causal.position, case.plan),
        jitter=jitter(run.shown, standing(truth)),
        cpu=cpu,
        wall=wall,
    )


def errors_of(case, run, batch):
    """Errors by estimate where all have one ``(n,)`` [m], and whether the truth is in the pose's 90 % region."""
    truth, causal = case.walk.truth, run.causal
    errors = {
        name: errors_at(track, truth) for name, track in (("pose", causal), ("lag", run.smoothed), ("batch", batch))
    }
    errors["filter"] = np.hypot(*(run.filtered(truth.time) - truth.position).T)
    inside = np.zeros(len(truth), dtype=bool)
    if len(pair(causal, truth).time):
        inside[~np.isnan(errors["pose"])] = gaps(causal, truth, case.noise)[1]
    known = np.isfinite(list(errors.values())).all(axis=0)
    return {name: values[known] for name, values in errors.items()}, inside[known]


def time_to_near(causal, truth):
    """Time [s] of the first place that is within NEAR, as is the next one; infinite if there is none."""
    pairs = pair(causal, truth)
    return _first_twice(pairs.time, circular_error(pairs) <= NEAR)


def time_to_pointed(causal, truth):
    """Time [s] of the first direction within POINTED, as is the next; infinite if there is none, NaN without truth."""
    if not np.isfinite(truth.heading).any():
        return np.nan
    pairs = pair(causal, truth)
    pairs = pairs.where(np.isfinite(pairs.truth_heading))
    return _first_twice(pairs.time, heading_error(pairs) <= POINTED)


def _first_twice(time, right):
    """The first time that is right, as the next one is; the last needs no next."""
    found = np.flatnonzero(right & np.append(right[1:], True))
    return float(time[found[0]]) if len(found) else np.inf


def jumps(run):
    """How much farther the pose moved than the steps from each ask to the next ``(a,)`` [m], and the cause of each."""
    asks = run.shown
    place = np.array([(ask.pose.x, ask.pose.y) for ask in asks])
    fixes = np.array([(n, time) for n, fix in enumerate(run.fixes) for time in fix.time]).reshape(-1, 2)
    causes = ["first"] + [cause(before, after, fixes) for before, after in pairwise(asks)]
    return beyond_steps(asks, place), causes


def display_jumps(run):
    """The same of the places that are drawn; empty if the navigator has none."""
    asks = run.shown
    if any(ask.display is None for ask in asks):
        return np.empty(0)
    return beyond_steps(asks, np.array([ask.display for ask in asks]))


def beyond_steps(asks, place):
    """How much farther a place ``(a, 2)`` moved than the steps from each ask to the next ``(a,)`` [m]."""
    walked = np.array([ask.walked for ask in asks])
    moved = np.hypot(*np.diff(place, axis=0, prepend=place[:1]).T)
    return np.maximum(moved - np.abs(np.diff(walked, prepend=walked[:1])), 0.0)


def cause(before, after, fixes):
    """Why a pose may have jumped from one ask to the next: a word. fixes: their numbers and times ``(f, 2)`` [s]."""
    if after.restarts > before.restarts:
        return "restart"
    if after.state != before.state:
        return "direction"
    if after.state == "initialising heading":
        return "initialising"
    number, time = fixes.T
    was_used = (number < before.fixes) & (time <= before.reached)
    if ((number < after.fixes) & (time <= after.reached) & ~was_used).any():
        return "fix"
    if after.headings > before.headings:
        return "compass"
    return "steps" if after.chunks > before.chunks else "provisional"


def by_minute(asks, size):
    """The largest of each minute since the first pose. size: of each ask, or empty [m]"""
    if not len(size):
        return size
    minute = ((np.array([ask.time for ask in asks]) - asks[0].time) // MINUTE).astype(int)
    return np.array([size[minute == n].max() for n in np.unique(minute)])


def outside(place, plan):
    """Whether each place ``(n, 2)`` is outside the walkable area; empty without a plan."""
    if plan is None:
        return np.empty(0, dtype=bool)
    area = shapely.buffer(plan.walkable, ON_THE_EDGE)
    shapely.prepare(area)
    return ~shapely.contains_xy(area, *place.T)


def standing(truth):
    """Intervals [s] of at least LEAST_STAND in which a dense truth does not move."""
    if len(truth) < 2 or np.median(np.diff(truth.time)) > 2.0:
        return []
    still = np.hypot(*np.diff(truth.position, axis=0).T) < STILL * np.diff(truth.time)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    spans = truth.time[edges].reshape(-1, 2)
    return [tuple(span) for span in spans if span[1] - span[0] >= LEAST_STAND]


def jitter(asks, stands):
    """The largest distance of a pose from the mean pose in each stand ``(s,)`` [m]."""
    time = np.array([ask.time for ask in asks])
    place = np.array([(ask.pose.x, ask.pose.y) for ask in asks])
    still = [place[(time >= begin + SETTLING) & (time < end)] for begin, end in stands]
    return np.array([np.hypot(*(some - some.mean(axis=0)).T).max() for some in still if len(some)])


def pooled(scores):
    """The scores of several walks as one, but for the times and walks, which stay apart in arrays."""
    first = scores[0]
    arrays = ("inside", "jumps", "display_jumps", "outside", "jitter", "cpu", "wall")
    together = {name: np.concatenate([getattr(one, name) for one in scores]) for name in arrays}
    times = {name: np.array([getattr(one, name) for one in scores]) for name in ("first", "near", "pointed")}
    errors = {name: np.concatenate([one.errors[name] for one in scores]) for name in first.errors}
    return replace(first, errors=errors, causes=tuple(c for one in scores for c in one.causes), **together, **times)


def commonest(causes):
    """The two commonest causes with their counts, as text."""
    return ", ".join(f"{word} {count}" for word, count in Counter(causes).most_common(2)) or "—"
