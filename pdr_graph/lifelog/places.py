"""Where a walk stood, and what it passed by slowly: each with what that may have been at, and how probably."""

from __future__ import annotations

from itertools import groupby
from operator import itemgetter

import numpy as np

from pdr_graph.floor.building import Building
from pdr_graph.geometry import length_along, row_times, wrap_angle
from pdr_graph.lifelog.day import STANDING, Segment, Stay
from pdr_graph.lifelog.fronts import BODY, Fronts
from pdr_graph.lifelog.parts import at
from pdr_graph.types import INSTANT, Array, Index, Steps, Trajectory

SHORTEST = 5.0  # [s] of a stay: who lets somebody pass or looks about is sooner off again
ON_THE_WAY = 60.0  # [s] of waiting where no plan has a name for anything: at a crossing, for a bus
MOMENT = 1.0  # [s] of standing between steps that is more than their rhythm
SHUFFLE, BACK = 1.5, 20.0  # [m] and [s] at most between two halts of one stay: a shift along a shelf, a restarted log
UNSEEN_LOOK = 1.2  # [rad] of which way one turned while standing where nobody measured it
USUAL = 0.75  # quantile of a walk's speeds that is its usual one: much of it may be slow
SLOW = 0.7  # of that speed: people stroll at 0.8 of it and browse at half
STEADY = 4.0  # [s] under way over which speed is taken: several strides
PIECE = 3.0  # [m] of a slow way that are looked at at a time: half of a small shop's front
PASSING = 1.2  # [rad] between the way and the look of who passes fronts on either side
NAMED = 0.5  # probability that a slow way led past something with a name; else it is just slow


def stays_of(
    steps: Steps, trajectory: Trajectory, building: Building | None, looks: Array | None = None
) -> tuple[Stay, ...]:
    """Stays and slow passes of a walk, in order of time.

    trajectory: of these steps with covariance, rows as of `row_times`. looks: ``(n + 1,)`` how far the walker had
    turned while standing before each step and after the last, since the step before [rad]; None if nobody knows.

    Raises ValueError where rows do not belong together.
    """
    _check(steps, trajectory, looks)
    fronts = _fronts(building, trajectory)
    found = _stays(steps, trajectory, fronts, looks) + _passes(steps, trajectory, fronts)
    return tuple(sorted(found, key=lambda stay: stay.start))


def stays_of_positions(
    trajectory: Trajectory, segments: tuple[Segment, ...], building: Building | None
) -> tuple[Stay, ...]:
    """The stays of a day of positions alone: its segments of standing. Which way somebody faced is not known.

    trajectory: with covariance.
    """
    fronts, found = _fronts(building, trajectory), list[Stay]()
    for segment in segments:
        if segment.kind != STANDING:
            continue
        first, after = np.searchsorted(trajectory.time, [segment.start, segment.end + INSTANT])
        track = at(trajectory, np.append(trajectory.time[first:after], (segment.start + segment.end) / 2))
        pose = track.position.mean(axis=0), np.nan, _covariance(track).mean(axis=0)
        stay = _stay(segment.start, segment.end, False, *pose, track.floor[-1], fronts)
        found += [stay] if _lasts(stay, fronts) else []
    return tuple(found)


def _check(steps: Steps, trajectory: Trajectory, looks: Array | None) -> None:
    if len(trajectory) != len(steps) + 2:
        raise ValueError(f"trajectory: found {len(trajectory)} rows, needed {len(steps) + 2}, two more than steps")
    if looks is not None and len(looks) != len(steps) + 1:
        raise ValueError(f"looks: found {len(looks)}, needed {len(steps) + 1}, one more than steps")


def _covariance(trajectory: Trajectory) -> Array:
    if trajectory.covariance is None:
        raise ValueError("trajectory: found no covariance, needed one of each row")
    return trajectory.covariance


def _fronts(building: Building | None, trajectory: Trajectory) -> dict[str, Fronts]:
    """What can be looked at, by the labels of the trajectory's floors; none of a floor where nothing has a name."""
    if building is None:
        return {}
    labels, only = set(trajectory.floor), len(building.labels) == 1
    floors = {
        label: building.floors[0] if only else building[label] for label in labels if only or label in building.labels
    }
    made = {label: Fronts.of(floor) for label, floor in floors.items()}
    return {label: own for label, own in made.items() if own.names}


def _stay(
    start: float,
    end: float,
    passing: bool,
    position: Array,
    heading: float,
    covariance: Array,
    floor: str,
    fronts: dict[str, Fronts],
) -> Stay:
    """A stay at a pose, covariance ``(3, 3)``, with what it was at."""
    facing = ()
    if floor in fronts:
        facing = fronts[floor].facing(position, heading, covariance, PASSING if passing else BODY)
    return Stay(start, end, passing, position, covariance[:2, :2], heading, floor, facing)


def _lasts(stay: Stay, fronts: dict[str, Fronts]) -> bool:
    return stay.end - stay.start >= (SHORTEST if stay.floor in fronts else ON_THE_WAY)


def _stays(steps: Steps, track: Trajectory, fronts: dict[str, Fronts], looks: Array | None) -> list[Stay]:
    """Halts, with those joined between which somebody only shuffled."""
    begin, end = row_times(steps)[:-1], np.append(steps.time - steps.duration, steps.end)
    lasted = end - begin
    halts = np.flatnonzero(lasted > MOMENT)
    apart = np.hypot(*np.diff(track.position[halts], axis=0).T) > SHUFFLE
    apart |= begin[halts[1:]] - end[halts[:-1]] > BACK
    unseen = UNSEEN_LOOK**2 * np.diag([0.0, 0.0, 1.0]) if looks is None else 0.0
    found = list[Stay]()
    for rows in np.split(halts, np.flatnonzero(apart) + 1) if len(halts) else []:
        longest = rows[np.argmax(lasted[rows])]
        heading = track.heading[longest] + (0.0 if looks is None else looks[longest])
        position, covariance = _together(track, rows, lasted[rows])
        pose = position, float(wrap_angle(heading)), covariance + unseen
        span = float(begin[rows[0]]), float(end[rows[-1]])
        found.append(_stay(*span, False, *pose, track.floor[longest], fronts))
    return [stay for stay in found if _lasts(stay, fronts)]


def _together(track: Trajectory, rows: Index, weight: Array) -> tuple[Array, Array]:
    """Mean position ``(2,)`` of some rows by weight, and the covariance ``(3, 3)`` of a pose at any of them."""
    share = weight / weight.sum()
    position = share @ track.position[rows]
    off = track.position[rows] - position
    covariance = np.tensordot(share, _covariance(track)[rows], axes=1)
    covariance[:2, :2] += (share * off.T) @ off
    return position, covariance


def _passes(steps: Steps, track: Trajectory, fronts: dict[str, Fronts]) -> list[Stay]:
    """Slow stretches of the way past something with a name, one for each name that was the likeliest for a while."""
    found = list[Stay]()
    for taken in _slow(steps) if fronts else []:
        along = length_along(track.position[taken + 1])
        cuts = np.unique(np.searchsorted(along, np.arange(PIECE, along[-1], PIECE)))
        pieces = np.split(taken, cuts)
        passed = [_pass(steps, piece, track, fronts).facing for piece in pieces]
        likeliest = [facing[0][0] if facing else "" for facing in passed]
        for _, same in groupby(zip(likeliest, pieces, strict=True), key=itemgetter(0)):
            whole = _pass(steps, np.concatenate([piece for _name, piece in same]), track, fronts)
            if _lasts(whole, fronts) and sum(p for _, p in whole.facing) > NAMED:
                found.append(whole)
    return found


def _pass(steps: Steps, taken: Index, track: Trajectory, fronts: dict[str, Fronts]) -> Stay:
    """What some neighbouring steps led past."""
    rows, first, last = taken + 1, taken[0], taken[-1]
    position, covariance = _together(track, rows, steps.duration[taken])
    heading = float(np.angle(np.exp(1j * track.heading[rows]).sum()))
    start, end = float(steps.time[first] - steps.duration[first]), float(steps.time[last])
    return _stay(start, end, True, position, heading, covariance, track.floor[rows[len(rows) // 2]], fronts)


def _slow(steps: Steps) -> list[Index]:
    """Which steps, for each stretch that is long enough, were slow and without a halt between.

    By the steps themselves: within a walk they compare well, where the trajectory is bent to what else is known.
    """
    under_way = np.concatenate([[0.0], np.cumsum(steps.duration)])
    walking = steps.length > 0
    if under_way[-1] < STEADY or not walking.any():
        return []
    way = np.concatenate([[0.0], np.cumsum(steps.length)])
    before, after = (np.clip(under_way[1:] + side * STEADY / 2, 0.0, under_way[-1]) for side in (-1, 1))
    speed = (np.interp(after, under_way, way) - np.interp(before, under_way, way)) / (after - before)
    slow = np.flatnonzero(walking & (speed < SLOW * np.quantile(speed[walking], USUAL)))
    halted = (steps.time - steps.duration - row_times(steps)[:-2] > MOMENT)[slow[1:]]
    stretches = np.split(slow, np.flatnonzero((np.diff(slow) > 1) | halted) + 1)
    return [taken for taken in stretches if steps.duration[taken].sum() >= SHORTEST]
