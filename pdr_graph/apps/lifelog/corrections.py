"""Apply a person's corrections: to the observations that a day is estimated from, to its outings and its timeline.

Of a walk with steps a stated place becomes fixes in place of the recorded ones, a stated activity a constraint; "not
me" and deleted times are masked. Positions alone are estimated as recorded, and a correction replaces its part of the
result, so that nothing beside it changes. Merging, splitting and naming change only the timeline. The place of a
receipt or photo is a measurement of the walk that could reach it, beside its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from pdr_graph.apps.lifelog.day import (
    GAP,
    PRIVATE,
    STANDING,
    VEHICLE,
    WALKING,
    Day,
    Outing,
    Segment,
    Stay,
    Timed,
    path_shares,
    sampled,
)
from pdr_graph.apps.lifelog.facts import (
    AT,
    FORGOTTEN,
    MERGE,
    MODE,
    MODE_ACTIVITIES,
    NOT_ME,
    PLACE_NAME,
    SPLIT,
    VISITED,
    Correction,
)
from pdr_graph.apps.lifelog.observation import DELETED, Observation, is_usable, steps_without, without_times
from pdr_graph.apps.lifelog.sessions import is_located
from pdr_graph.apps.lifelog.stays_and_legs import Track, cut
from pdr_graph.apps.lifelog.timeline import STAY, TimelineEntry, distance_text
from pdr_graph.frames import Frame, enu
from pdr_graph.geometry import horizontal_sigma, length_along
from pdr_graph.types import INSTANT, Array, Fixes, UntimedFixes

NOT_MINE = "part of this recording is masked: not this person's"
# Fixes of a stated place: often enough that the smoother sees no gap (`TRACK.longest`), and enough of them that it
# accepts a jump to them (`TRACK.jump`)
FIX_INTERVAL, FEWEST_FIXES = 45.0, 22  # [s]
SLIVER = 60.0  # [s] from the start or end of an entry, within which a time means that: people read minutes
CONTRADICTION = 3.0  # sigmas between a stated place and the recorded positions, from which a note says the distance
# [s] at either end of a stated stay in which a walk with steps may go to the place and back, and [m/s] how fast: slower
# than `FIXES.driven`; chosen by hand
FREE_TIME, FREE_SPEED = 60.0, 20.0
WALKED = 2.0  # [m/s] largest mean speed of a walk that goes to the place of a receipt; chosen by hand


def apply_to_observations(
    observations: Mapping[str, Observation], corrections: Sequence[Correction]
) -> dict[str, Observation]:
    """The observations of a day, by content hash, as corrected; those of which nothing remains are left out.

    Those of positions alone, without a walk at their time, lose only what was deleted (`corrected`).
    """
    forgotten, not_mine = ([c.span for c in corrections if c.kind == kind] for kind in (FORGOTTEN, NOT_ME))
    left = _without(observations, forgotten, DELETED)
    walks = [part for part in left.values() if part.steps is not None]
    times = np.array([(walk.epoch, walk.epoch + walk.duration) for walk in walks]).reshape(-1, 2)
    beside = {n: p for n, p in left.items() if np.any((p.epoch <= times[:, 1]) & (times[:, 0] <= p.epoch + p.duration))}
    found, masked = _without(beside, not_mine, NOT_MINE), [*forgotten, *not_mine]
    for correction in corrections:
        start, end = correction.span
        covered = {n: part for n, part in found.items() if correction.touches(part.epoch, part.epoch + part.duration)}
        kind = STANDING
        if correction.kind == AT:
            # Fixes state the place once together, with its sigma: they share one error
            number = max(FEWEST_FIXES, int((end - start) / FIX_INTERVAL) + 1)
            time, sigma = np.linspace(start, end, number), correction.radius * np.sqrt(number)
            time = time[~np.any([np.zeros(number, bool), *((time > a) & (time < b) for a, b in masked)], axis=0)]
            for name, part in sorted(covered.items(), key=lambda item: (item[1].steps is None, item[1].epoch, item[0])):
                inside = (time >= part.epoch) & (time <= part.epoch + part.duration)
                covered[name] = _with_fixes(part, correction, time[inside], sigma)
                time = time[~inside]
        elif correction.kind == MODE:
            kind = MODE_ACTIVITIES[correction.text("mode")]
        else:
            continue
        found |= {name: replace(part, stated=(*part.stated, (start, end, kind))) for name, part in covered.items()}
    for correction in (c for c in corrections if c.kind == VISITED):
        reached = {name: _detour(part, correction) for name, part in found.items()}
        reached = {name: off for name, off in reached.items() if off <= 0}
        if reached:  # the place is visited once: by the walk that came nearest
            nearest = min(reached, key=lambda name: (reached[name], name))
            found[nearest] = _with_visited(found[nearest], correction)
    return {name: found.get(name, part) for name, part in left.items() if name in found or name not in beside}


def _without(
    observations: Mapping[str, Observation], spans: Sequence[tuple[float, float]], note: str
) -> dict[str, Observation]:
    """What remains of observations without some times [s]."""
    cut = {name: without_times(part, spans, note) if spans else part for name, part in observations.items()}
    return {name: part for name, part in cut.items() if part is not None and (not spans or is_usable(part))}


def corrected(day: Day, corrections: Iterable[Correction]) -> Day:
    """A stored day with its outings as corrected. Those with steps were estimated so."""
    outings = day.outings
    for correction in corrections:
        if correction.kind in (NOT_ME, FORGOTTEN, AT, MODE):
            outings = tuple(filter(None, (o if o.steps else _with_stated(o, correction) for o in outings)))
    return replace(day, outings=outings)


def _with_stated(outing: Outing, correction: Correction) -> Outing | None:
    """An outing of positions with what a correction states in place of its estimate; None if nothing is left."""
    start, end = np.subtract(correction.span, outing.epoch).tolist()
    a, b = max(start, outing.segments[0].start), min(end, outing.segments[-1].end)
    if a >= b:
        return outing
    return (_masked if correction.kind in (NOT_ME, FORGOTTEN) else _as_stated)(outing, correction, a, b)


def _masked(outing: Outing, correction: Correction, a: float, b: float) -> Outing | None:
    """An outing without a time [s], beside which the person is at the nearest position that remains, if one does."""
    track = outing.trajectory
    gaps = [
        s for s in outing.segments if s.kind == GAP and s.start < b and s.end > a
    ]  # whose ways lead to what is gone
    first, last = min([a, *(s.start + INSTANT for s in gaps)]), max([b, *(s.end - INSTANT for s in gaps)])
    before, after = track.time[track.time < first], track.time[track.time > last]
    if not len(before) + len(after):
        return None
    kind, notes = (GAP, (*outing.notes, NOT_MINE)) if correction.kind == NOT_ME else (PRIVATE, (DELETED,))
    rows = sampled(track, np.concatenate([before, before[-1:], after[:1], after]))
    made = replace(rows, time=np.concatenate([before, [a][: len(before)], [b][: len(after)], after]))
    blank = [Segment(kind, a, b, 0.0)] if len(before) and len(after) else []
    (early, stays), (late, others) = _outside(outing, -np.inf, a), _outside(outing, b, np.inf)
    segments, notes = (*early, *blank, *late), tuple(dict.fromkeys(notes))
    return replace(outing, trajectory=made, segments=segments, stays=(*stays, *others), notes=notes)


def _as_stated(outing: Outing, correction: Correction, a: float, b: float) -> Outing:
    """An outing that is a stay, walk or ride from one time to another [s]."""
    kind, notes = MODE_ACTIVITIES.get(correction.text("mode"), STANDING), outing.notes
    (early, stays), (late, others) = _outside(outing, -np.inf, a), _outside(outing, b, np.inf)
    made = sampled(outing.trajectory, np.unique(np.concatenate([outing.trajectory.time, [a, b]])))
    here = (made.time >= a) & (made.time <= b)
    if kind == STANDING:
        place = np.median(made.position[here], axis=0)
        covariance = np.zeros((len(made), 3, 3)) if made.covariance is None else made.covariance
        if correction.kind == AT and outing.frame.georeferenced:
            place = _placed(outing.frame, correction)[0]
            notes = (*notes, *_objection(correction, place, made.position[here], horizontal_sigma(covariance[here]))[1])
            covariance[here, :2, :2] = correction.radius**2 * np.eye(2)
        first = int(np.argmax(here))
        stays.append(Stay(a, b, False, place, covariance[first, :2, :2], np.nan, made.floor[first]))
        made = replace(made, position=np.where(here[:, None], place, made.position))
    way = length_along(made.position)[here]
    distance = float(way[-1] - way[0]) if kind in (WALKING, VEHICLE) else 0.0
    segments, notes = (*early, Segment(kind, a, b, distance), *late), tuple(dict.fromkeys(notes))
    return replace(outing, trajectory=made, segments=segments, stays=(*stays, *others), notes=notes)


def _outside(outing: Outing, start: float, end: float) -> tuple[list[Segment], list[Stay]]:
    """What of an outing's segments and stays is in a time [s]."""

    def parts(items: Sequence[Timed]) -> Iterator[tuple[Timed, Timed]]:
        """Each with its part."""
        for item in items:
            first, last = max(item.start, start), min(item.end, end)
            if last - first > INSTANT:
                yield item, replace(item, start=first, end=last)

    segments = list[Segment]()
    for whole, part in parts(outing.segments):
        share = path_shares(outing.trajectory, [whole.start, part.start, part.end, whole.end])[1]
        segments.append(replace(part, distance=whole.distance * float(share)))
    return segments, [part for _, part in parts(outing.stays)]


def _objection(stated: Correction, place: Array, recorded: Array, sigma: Array) -> tuple[float, tuple[str, ...]]:
    """How far recorded positions ``(n, 2)`` are from a stated place [m], and a note if they contradict it.

    sigma: ``(n,)`` of the positions per axis [m].
    """
    if not len(recorded):
        return 0.0, ()
    away = float(np.hypot(*(np.median(recorded, axis=0) - place)))
    # recorded sigma [m] per axis of recorded positions during a stay, which is mostly indoors; chosen by hand
    if away <= CONTRADICTION * np.hypot(stated.radius, max(20.0, float(np.median(sigma)))):
        return away, ()
    against = f"{len(recorded)} recorded positions: their median is {distance_text(away)} away"
    return away, (f"corrected by the person, against {against}",)


def _detour(part: Observation, visited: Correction) -> float:
    """How much farther a place is than a walk with steps could go beside its positions in the time [m]; else infinite.

    That is CONTRADICTION sigmas, and WALKED times the silence after or before a position.
    """
    steps, fixes = part.steps, part.fixes
    if steps is None or not visited.touches(part.epoch + steps.start, part.epoch + steps.end):
        return np.inf
    if not part.frame.georeferenced:
        return np.inf
    place = _placed(part.frame, visited)
    if not len(fixes):
        return 0.0 if part.plan and _on_plan(part.plan, place[0]) else np.inf
    off = np.hypot(*(fixes.position - place).T)
    time = np.sort(fixes.time)
    silent = np.diff(time, prepend=min(steps.start, time[0]), append=max(steps.end, time[-1]))
    order = np.argsort(np.argsort(fixes.time, kind="stable"))
    longest = np.maximum(silent[:-1], silent[1:])[order]
    spread = CONTRADICTION * np.hypot(fixes.sigma, visited.radius)
    inside = (part.epoch + fixes.time >= visited.start - longest) & (part.epoch + fixes.time <= visited.end + longest)
    return float(np.min((off - spread - WALKED * longest)[inside], initial=np.inf))


def _placed(frame: Frame, stated: Correction) -> Array:
    """The place ``(1, 2)`` of a correction [m]."""
    return frame.from_lonlat(np.array([stated.place[::-1]]))


def _on_plan(plan: str, place: Array) -> bool:
    """True if a place [m] is within the bounding box of a plan."""
    from pdr_graph.apps.lifelog.reconstruct import building_of  # imports all of estimation, which is slow

    low, high = building_of(plan).floors[0].corners
    return bool(np.all((place >= low) & (place <= high)))


def _with_visited(part: Observation, visited: Correction) -> Observation:
    """The observation with the place of a receipt or photo as a measurement of the walk."""
    time = np.array([visited.span]) - part.epoch
    label = f"{visited.text('source')} {visited.text('name')}"
    place = UntimedFixes(time, _placed(part.frame, visited), np.array([visited.radius]), (label,))
    return replace(part, measurements=(*part.measurements, place))


def _with_fixes(part: Observation, correction: Correction, time: Array, sigma: float) -> Observation:
    """The observation with fixes at the stated place at times (Unix times [s]), instead of the recorded ones."""
    frame = part.frame
    if not frame.georeferenced and not part.plan and not is_located(part):
        frame = enu(*correction.place)
    if not frame.georeferenced:
        note = "a place by latitude and longitude that was stated could not be used: the plan has no latitude"
        return replace(part, notes=(*part.notes, note))
    place = _placed(frame, correction)
    seconds = part.epoch + part.fixes.time
    replaced = (seconds >= correction.start) & (seconds <= correction.end)
    stated = Fixes(time - part.epoch, np.repeat(place, len(time), axis=0), np.full(len(time), sigma))
    recorded = part.fixes[replaced]
    away, notes = _objection(correction, place[0], recorded.position, recorded.sigma)
    notes = (*part.notes, *notes)
    fixes = Fixes.concatenate([part.fixes[~replaced], stated])
    part = replace(part, frame=frame, fixes=fixes, notes=notes)
    if away <= correction.radius:
        return part

    # Without the steps just after the start and before the end, which would drag the walk before and after to the place
    steps, looks = part.steps, part.looks
    long = min(max(FREE_TIME, away / FREE_SPEED), (correction.end - correction.start) / 3)
    for start in (correction.start - part.epoch, correction.end - part.epoch - long):
        if steps is not None:
            steps, looks = steps_without(steps, looks, start, start + long)
    if steps is None:
        return part
    free = steps.is_gap & (steps.time > correction.start - part.epoch)
    free &= steps.time - steps.duration < correction.end - part.epoch
    sigma_length = np.where(free, np.maximum(steps.sigma_length, away), steps.sigma_length)
    return replace(part, steps=replace(steps, sigma_length=sigma_length), looks=looks)


def apply_to_entries(
    entries: Sequence[TimelineEntry], corrections: Iterable[Correction], track: Track
) -> tuple[TimelineEntry, ...]:
    """The entries of a person's timeline as corrected, in time order; a later correction overrules an earlier one.

    track: where the person was, by which the distance of an entry is divided.
    """
    found = list(entries)
    for correction in corrections:
        if correction.kind in (PLACE_NAME, VISITED) or not found:
            continue
        start, end = _bounds(found, correction)
        found = [piece for entry in found for piece in cut(entry, sorted({start, end}), track)]
        if correction.kind == SPLIT:
            found = [replace(e, corrected=True) if start in (e.start, e.end) else e for e in found]
            continue
        inside = [e for e in found if e.start >= start and e.end <= end]
        if inside:
            first = found.index(inside[0])
            found[first : first + len(inside)] = [_stated(inside, correction, track)]
    return tuple(found)


def place_names(corrections: Iterable[Correction]) -> list[tuple[float, float, float, str]]:
    """Latitude, longitude [deg], radius [m] and name of each place that the person has named, in the order stated."""
    named = [c for c in corrections if c.kind == PLACE_NAME]
    return [(*c.place, c.radius, c.text("name")) for c in named]


def _bounds(entries: Sequence[TimelineEntry], correction: Correction) -> tuple[float, float]:
    """Start and end of a correction, moved to those of entries within SLIVER: a rebuilt day has slightly other ones."""
    if correction.kind in (SPLIT, NOT_ME, FORGOTTEN):
        return correction.span
    edges = np.array([entries[0].start, *(e.end for e in entries)])
    start, end = (float(edges[np.argmin(np.abs(edges - time))]) for time in correction.span)
    start = start if abs(start - correction.start) <= SLIVER else correction.start
    end = end if abs(end - correction.end) <= SLIVER else correction.end
    return (start, end) if start < end else correction.span


def _stated(inside: Sequence[TimelineEntry], correction: Correction, track: Track) -> TimelineEntry:
    """The one entry that a correction makes of consecutive entries; silences count with the straight line."""
    start, end = inside[0].start, max(e.end for e in inside)
    blank = TimelineEntry(GAP, start, end, offset=inside[0].offset)
    if correction.kind in (NOT_ME, FORGOTTEN):
        return replace(blank, corrected=correction.kind == NOT_ME)
    observed = sum(e.observed * (e.end - e.start) for e in inside) / max(end - start, 1e-9)
    blank = replace(blank, corrected=True, observed=observed)
    if correction.kind == MERGE:
        return _merged_stay(blank, inside)
    if correction.kind == AT:  # with what the person faced there if the estimate agrees
        (latitude, longitude), stay = correction.place, _merged_stay(blank, inside)
        agrees = distance(latitude, longitude, stay.latitude, stay.longitude) <= CONTRADICTION * correction.radius
        stay = stay if agrees else replace(blank, kind=STAY)
        at = {"latitude": latitude, "longitude": longitude, "sigma": correction.radius}
        return replace(stay, **at, place=correction.text("name") or stay.place)
    mode, kind = correction.text("mode"), MODE_ACTIVITIES[correction.text("mode")]
    if kind == STANDING:
        return replace(_merged_stay(blank, inside), mode=mode)
    floor = tuple(dict.fromkeys(label for e in inside for label in e.floor))
    far = sum(e.distance if e.is_known else track.length(e.start, e.end) for e in inside)
    return replace(blank, kind=kind, mode=mode, floor=floor, distance=far)


def _merged_stay(blank: TimelineEntry, inside: Sequence[TimelineEntry]) -> TimelineEntry:
    """A stay at the mean place of the entries, weighted by time; floor and places faced are those of the longest."""
    located = [e for e in inside if np.isfinite(e.latitude) or np.isfinite(e.x)]
    located = [e for e in located if e.kind in (STAY, STANDING)] or located
    if not located:
        return replace(blank, kind=STAY)
    longest = max(located, key=lambda e: e.end - e.start)
    alike = [e for e in located if np.isfinite(e.latitude) == np.isfinite(longest.latitude)]
    share = np.array([max(e.end - e.start, 1e-9) for e in alike])
    columns = ("x", "y", "latitude", "longitude", "sigma")
    mean = {name: float(np.average([getattr(e, name) for e in alike], weights=share)) for name in columns}
    if np.isfinite(longest.latitude) and len(alike) > 1:
        mean["x"] = mean["y"] = np.nan  # outings may have different frames
    others = {"floor": longest.floor, "facing": longest.facing, "place": longest.place}
    return replace(blank, kind=STAY, **mean, **others, place_number=longest.place_number)


def distance(latitude: float, longitude: float, other_latitude: float, other_longitude: float) -> float:
    """Distance between two places given in degrees [m], NaN if one is unknown."""
    if not np.isfinite([latitude, longitude, other_latitude, other_longitude]).all():
        return float("nan")
    return float(np.hypot(*enu(latitude, longitude).from_lonlat(np.array([[other_longitude, other_latitude]]))[0]))
