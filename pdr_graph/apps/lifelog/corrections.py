"""Apply a person's corrections: to the observations that a day is estimated from, and to the entries of its timeline.

A stated place becomes position fixes in place of the recorded ones, a stated activity a constraint; "not me" and
deleted times are masked. Merging, splitting and naming change only the timeline. The place of a receipt or photo is a
measurement of the walk that could reach it, beside its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from pdr_graph.apps.lifelog.day import GAP, STANDING
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
from pdr_graph.types import Array, Fixes, UntimedFixes

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
    """The observations of a day, by content hash, as corrected; those of which nothing remains are left out."""
    found, masked = dict(observations), [c.span for c in corrections if c.kind in (FORGOTTEN, NOT_ME)]
    for kind, note in ((FORGOTTEN, DELETED), (NOT_ME, NOT_MINE)):
        spans = [c.span for c in corrections if c.kind == kind]
        cut = {name: without_times(part, spans, note) for name, part in found.items()} if spans else found
        found = {name: part for name, part in cut.items() if part is not None and is_usable(part)}
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
    return found


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
    away = float(np.hypot(*(np.median(recorded.position, axis=0) - place[0]))) if len(recorded) else 0.0
    notes = part.notes
    # recorded sigma [m] per axis of recorded positions during a stay, which is mostly indoors; chosen by hand
    spread = np.hypot(correction.radius, max(20.0, float(np.median(recorded.sigma)))) if len(recorded) else 0.0
    if away > CONTRADICTION * spread:
        against = f"{len(recorded)} recorded positions: their median is {distance_text(away)} away"
        notes = (*notes, f"corrected by the person, against {against}")
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
        is_cut = [any(e.start < time < e.end for e in found) for time in (start, end)]
        found = [piece for entry in found for piece in cut(entry, sorted({start, end}), track)]
        if correction.kind == SPLIT:
            found = [replace(e, corrected=True) if start in (e.start, e.end) else e for e in found]
            continue
        inside = [e for e in found if e.start >= start and e.end <= end]
        if inside:
            first = found.index(inside[0])
            found[first : first + len(inside)] = [_stated(inside, correction)]
            if correction.kind in (NOT_ME, FORGOTTEN):
                _absorb_rests(found, first, is_cut)
    return tuple(found)


def _absorb_rests(entries: list[TimelineEntry], blank: int, is_cut: Sequence[bool]) -> None:
    """Add what remains of an entry beside a blank one, shorter than SLIVER, to the entry beyond.

    A rebuilt day has slightly other ends for want of the masked data; times that persons state are moved to ends of
    entries. is_cut: True where the blank entry began, or ended, within an entry.
    """
    for side, inside in ((1, is_cut[1]), (-1, is_cut[0])):
        rest, beyond = blank + side, blank + 2 * side
        if not inside or not 0 <= beyond < len(entries) or entries[rest].duration >= SLIVER:
            continue
        own, other = entries[rest], entries[beyond]
        if other.is_known:
            parts = ((own, *other.parts) if side > 0 else (*other.parts, own)) if other.parts else ()
            start, end = min(other.start, own.start), max(other.end, own.end)
            entries[beyond] = replace(other, start=start, end=end, parts=parts)
            del entries[rest]


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


def _stated(inside: Sequence[TimelineEntry], correction: Correction) -> TimelineEntry:
    """The one entry that a correction makes of consecutive entries."""
    start, end = inside[0].start, max(e.end for e in inside)
    blank = TimelineEntry(GAP, start, end, offset=inside[0].offset)
    if correction.kind in (NOT_ME, FORGOTTEN):
        return replace(blank, corrected=correction.kind == NOT_ME)
    observed = sum(e.observed * (e.end - e.start) for e in inside) / max(end - start, 1e-9)
    blank = replace(blank, corrected=True, observed=observed)
    if correction.kind == MERGE:
        return _merged_stay(blank, inside)
    if correction.kind == AT:  # the estimate of the place where that agrees, else the place as it was stated
        (latitude, longitude), stay = correction.place, _merged_stay(blank, inside)
        if distance(latitude, longitude, stay.latitude, stay.longitude) <= CONTRADICTION * correction.radius:
            return replace(stay, place=correction.text("name") or stay.place)
        at = {"latitude": latitude, "longitude": longitude, "sigma": correction.radius}
        return replace(blank, kind=STAY, **at, place=correction.text("name"))
    mode, kind = correction.text("mode"), MODE_ACTIVITIES[correction.text("mode")]
    if kind == STANDING:
        return replace(_merged_stay(blank, inside), mode=mode)
    floor = tuple(dict.fromkeys(label for e in inside for label in e.floor))
    return replace(blank, kind=kind, mode=mode, floor=floor, distance=sum(e.distance for e in inside))


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
