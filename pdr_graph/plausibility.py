"""Refuse inputs that cannot belong to one walk: a plan, a list or fixes of another place, a truth of another time.

Only what no walk explains is refused: two inputs must be farther apart than the walker can have gone within the
recording, plus their errors. Where that is open, nothing is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pdr_graph.errors import InputError, count
from pdr_graph.floor.building import Building
from pdr_graph.floor.formats.drawing import storey_of
from pdr_graph.floor.plan import FAR_FROM_PLAN
from pdr_graph.frames import Frame, projected
from pdr_graph.geometry import distance_to_box
from pdr_graph.io.likely_causes import CLOCK_MARGIN, clock_hint
from pdr_graph.types import Array, Beacons, Fixes, OneLineRepr, Recording, Trajectory

# Chosen by hand
FASTEST_WALK = 2.0  # [m/s] mean speed of a walker over a recording; a brisk walk has 1.8
FASTEST_RIDE = 60.0  # [m/s] the same where the recording may contain a ride by train
LIVE_DURATION = 3600.0  # [s] of a walk that has not begun
RADIO_RANGE = 100.0  # [m] from which a beacon or an anchor is received
WIDEST_ERROR = 5.0  # [sigma] of a fix


@dataclass(frozen=True)
class Reach(OneLineRepr):
    """The area where a walk can have been: boxes, each with a margin.

    low, high: ``(k, 2)`` corners of the boxes [m], for a fix the same point; margin: ``(k,)`` [m].
    """

    low: Array
    high: Array
    margin: Array

    def __len__(self) -> int:
        return len(self.margin)

    def _summary(self) -> list[str]:
        return [count(len(self), "box")]

    @classmethod
    def of_fixes(cls, fixes: Fixes, span: tuple[float, float], fastest: float) -> Reach:
        """Places that the walker can visit from fixes within a time span [s], at a speed [m/s]."""
        start, end = span
        fixes = fixes[(fixes.time >= start - CLOCK_MARGIN) & (fixes.time <= end + CLOCK_MARGIN)]
        longest = np.maximum(np.maximum(fixes.time - start, end - fixes.time), 0.0)
        return cls(fixes.position, fixes.position, WIDEST_ERROR * fixes.sigma + fastest * longest)

    @classmethod
    def of_plan(cls, building: Building, margin: float) -> Reach:
        """Places within `margin` [m] of a building's bounding box."""
        low, high = building.corners
        return cls(low[None], high[None], np.array([margin]))

    def joined(self, other: Reach) -> Reach:
        """The boxes of both."""
        return Reach(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in ("low", "high", "margin")))

    def distance(self, position: Array) -> Array:
        """Distance ``(n, k)`` [m] of positions ``(n, 2)`` from each box, without its margin."""
        return distance_to_box(position[:, None], self.low, self.high)


@dataclass(frozen=True)
class Plausibility(OneLineRepr):
    """The area of a walk by its fixes and its plan, against which its other inputs are checked.

    span: first and last time [s]; fastest: mean speed at which the walker can have gone [m/s].
    """

    walk: Recording
    frame: Frame
    building: Building | None
    span: tuple[float, float]
    fastest: float
    fixes: Reach
    area: Reach

    def _summary(self) -> list[str]:
        return [repr(self.walk.source), f"{self.span[1] - self.span[0]:.0f} s", repr(self.area)]

    @classmethod
    def of(
        cls, walk: Recording, frame: Frame, fixes: Fixes, building: Building | None, fastest: float = FASTEST_WALK
    ) -> Plausibility:
        """The area of a walk; fixes: all of them, in the frame."""
        span = _span(walk, fixes)
        area = reach = Reach.of_fixes(fixes, span, fastest)
        if building is not None:
            area = reach.joined(Reach.of_plan(building, fastest * (span[1] - span[0])))
        return cls(walk, frame, building, span, fastest, reach, area)

    def check_fixes(
        self, plan: Path | None, source: Path | None, listed: Fixes, recorded: Fixes, metric: bool = False
    ) -> None:
        """Raise InputError if no fix can reach the plan, or a file's fixes lie elsewhere than the recording's.

        plan, source: files of the plan and of the listed fixes; recorded: fixes inside the recording; metric: True if
        the file has no degrees but x and y, taken as metres of the frame.
        """
        outline = None if self.building is None else Reach.of_plan(self.building, np.sqrt(2) * FAR_FROM_PLAN)
        hint = ""
        if outline is not None and source is not None and metric:
            hint = _mistaken_metres(self.frame, listed.position, outline)
            if hint == DEGREES_HINT:
                raise InputError(source, "x, y", f"degrees on the plan{hint}", "metres in the plan's frame")
        if outline is not None and plan is not None:
            self.check_plan(plan, outline, hint)
        # fewest recorded: fixes inside a recording that can contradict a file: a single one is often an old position
        if source is None or len(recorded) < 3:
            return
        if outline is not None and (outline.distance(listed.position) <= outline.margin).any():
            return  # the receiver is wrong
        widest = WIDEST_ERROR * float(listed.sigma.max(initial=0.0))
        reach = Reach.of_fixes(recorded, self.span, self.fastest)
        self._check(source, "fix", listed.position, reach, widest, "those inside the recording", hint)

    def check_list(self, source: Path | None, noun: str, position: Array, margin: float = 0.0) -> None:
        """Raise InputError if all places of a list ``(n, 2)`` [m] are out of reach of the fixes and the plan.

        source: the list's file, None if nothing is to be checked; noun: of one place; margin: of the reach [m].
        """
        if source is not None:
            evidence = "the plan" if not len(self.fixes) else "all fixes" if self.building is None else "fixes and plan"
            self._check(source, noun, position, self.area, margin, evidence)

    def check_truth(self, source: Path, truth: Trajectory) -> None:
        """Raise InputError if a truth is of another time than the walk, or out of its reach."""
        start, end = self.span
        if not ((truth.time >= start - CLOCK_MARGIN) & (truth.time <= end + CLOCK_MARGIN)).any():
            first, last = (truth.time[[0, -1]] + self.walk.clock_origin).tolist()
            start, end = start + self.walk.clock_origin, end + self.walk.clock_origin
            found = f"{first:.3f} to {last:.3f}{clock_hint((first, last), (start, end))}"
            raise InputError(source, "time", found, f"times within the recording, {start:.3f} to {end:.3f}")
        if truth.epsg is None:
            self.check_list(source, "row", truth.position)

    def check_plan(self, plan: Path, outline: Reach, hint: str = "") -> None:
        """Raise InputError if no fix can reach the plan. outline: of the plan; hint: at the cause, if it is known."""
        far = outline.distance(self.fixes.low)[:, 0]
        if not len(far) or (far <= np.maximum(self.fixes.margin, outline.margin)).any():
            return
        nearest = int(np.argmin(far - self.fixes.margin))
        found = f"a plan {_distance(far[nearest])} or more from {_each(len(far), 'fix')}"
        found += hint or self._swapped(self.fixes.low, outline)
        expected = (
            f"a plan within {_distance(max(self.fixes.margin[nearest], FAR_FROM_PLAN))}, which the walk can reach"
        )
        raise InputError(plan, "", found, expected)

    def _check(
        self, source: Path, noun: str, position: Array, reach: Reach, margin: float, evidence: str, hint: str = ""
    ) -> None:
        """Raise InputError if no position lies within reach and a margin [m].

        evidence: what the reach follows from; hint: at the cause, if it is known.
        """
        far = reach.distance(position)
        if not far.size or (far <= reach.margin + margin).any():
            return
        row, box = np.unravel_index(np.argmin(far - reach.margin), far.shape)
        found = f"{_each(len(position), noun)} {_distance(far[row, box])} or more from {evidence}"
        found += hint or self._swapped(position, reach)
        raise InputError(
            source, "", found, f"places within {_distance(reach.margin[box] + margin)}, in reach of the walk"
        )

    def _swapped(self, position: Array, reach: Reach) -> str:
        """A hint if positions ``(n, 2)`` would be in reach with latitude and longitude swapped; else empty."""
        if not self.frame.georeferenced:
            return ""
        swapped = self.frame.to_lonlat(position)[:, ::-1]
        swapped = swapped[np.abs(swapped[:, 1]) <= 90]
        back = self.frame.from_lonlat(swapped) if len(swapped) else swapped
        near = (reach.distance(back[np.isfinite(back).all(axis=1)]) <= reach.margin).any()
        return " (latitude and longitude swapped?)" if near else ""


DEGREES_HINT = " (time,lat,lon,sigma in the header?)"


def _mistaken_metres(frame: Frame, position: Array, outline: Reach) -> str:
    """A hint at what x and y ``(n, 2)`` of a file are, if they lie on the plan only as that; else empty.

    Degrees are found even if they would be on the plan as metres: few metres from its origin.
    """

    def on_plan(metres: Array) -> bool:
        return bool(len(metres)) and bool((outline.distance(metres) <= outline.margin).all())

    if not len(position):
        return ""
    in_degrees = frame.georeferenced and bool((np.abs(position) <= 180).all())
    for lonlat in (position, position[:, ::-1]) if in_degrees else ():
        if np.abs(lonlat[:, 1]).max() <= 90 and on_plan(frame.from_lonlat(lonlat)):
            return DEGREES_HINT
    if on_plan(position):
        return ""
    corner = outline.low[0]
    # shortest in millimetres [mm] between fixes: any metres divided by 1000 are near the origin
    guesses = {
        "x and y swapped?": position[:, ::-1],
        "millimetres?": position / 1000 if np.ptp(position, axis=0).max() > 2000.0 else position,
        "metres from a corner of the plan?": position + corner,
    }
    if frame.georeferenced:
        zone, is_projected = _utm_at(frame, corner), (np.abs(position) < 2e7).all()
        from_utm = frame.from_lonlat(projected(zone).to_lonlat(position)) if is_projected else position
        guesses[f"metres of EPSG:{zone}?"] = from_utm[np.isfinite(from_utm).all(axis=1)]
    return next((f" ({guess})" for guess, metres in guesses.items() if on_plan(metres)), "")


def _utm_at(frame: Frame, position: Array) -> int:
    """EPSG code of the UTM zone at a position ``(2,)`` [m]."""
    lon, lat = frame.to_lonlat(position[None])[0].tolist()
    return (32601 if lat >= 0 else 32701) + min(int((lon + 180) // 6), 59)


def check_floors(
    plan: Path, building: Building, start: str | None, source: Path | None = None, stated: Sequence[str] = ()
) -> None:
    """Raise InputError for the label of a floor that the plan does not have; one without labels has every floor.

    start: label of ``--floor``; source, stated: a file of fixes and its labels. For a plan of one floor it is enough if
    one of them is its label or has the same number (EG for 0): the others may be of floors that it leaves out.
    """
    labels = building.labels
    if labels == ("",):
        return
    if start is not None and start not in labels:
        floors = f"the floors {', '.join(labels)[:80]}"
        raise InputError(plan, "", floors, f"a floor {start!r}{_similar(start, labels)}")
    unknown = [label for label in dict.fromkeys(stated) if label and label not in labels]
    on_only_floor = len(labels) == 1 and any(label in labels or _similar(label, labels) for label in stated)
    if source is not None and unknown and not on_only_floor:
        found = f"{unknown[0]!r}{_similar(unknown[0], labels)}"
        raise InputError(source, "floor", found, f"the floors of {plan.name}: {', '.join(labels)[:80]}")


def _similar(label: str, labels: Sequence[str]) -> str:
    """A hint at the label of the same number: F1 for 1."""
    number, _ = storey_of(label)
    same = [other for other in labels if np.isfinite(number) and storey_of(other)[0] == number]
    same += [other for other in labels if other.strip().lower() == label.strip().lower()]
    return f" ({same[0]}?)" if same else ""


def check_initial(plan: Path, building: Building, initial: Fixes) -> None:
    """Raise InputError if a trial begins so far from a plan that the walk cannot reach it, or in another frame."""
    frame = building.floors[0].frame
    if not len(initial):
        return
    if initial.epsg is not None and not frame.georeferenced:
        raise InputError(plan, "", "a plan without latitude", "one that has it, or positions by --format xy")
    outline, place = Reach.of_plan(building, np.sqrt(2) * FAR_FROM_PLAN), frame.place(initial)
    hint = "" if initial.epsg is not None else _mistaken_metres(frame, place.position, outline)
    span = 0.0, LIVE_DURATION
    reach = Reach.of_fixes(place, span, FASTEST_WALK)
    walk = Recording("", 0.0, None)
    Plausibility(walk, frame, building, span, FASTEST_WALK, reach, reach).check_plan(plan, outline, hint)


def check_beacons_on_plan(source: Path, beacons: Beacons, building: Building) -> None:
    """Raise InputError if no beacon of a list can be near a plan, before a live walk begins."""
    frame, span = building.floors[0].frame, (0.0, LIVE_DURATION)
    if beacons.epsg is not None and not frame.georeferenced:
        return
    reach = Reach.of_plan(building, FASTEST_WALK * LIVE_DURATION)
    no_fixes = Reach(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))
    places = Plausibility(Recording("", 0.0, None), frame, building, span, FASTEST_WALK, no_fixes, reach)
    position = frame.place(beacons).position
    places.check_list(source, "beacon", position[np.isfinite(position).all(axis=1)], RADIO_RANGE)


def _span(walk: Recording, fixes: Fixes) -> tuple[float, float]:
    """First and last time [s] of the sensors; without any, of the fixes."""
    timed = [signal.time for signal in walk.signals.values() if len(signal)] or [fixes.time, walk.fixes.time]
    time = np.concatenate([part for part in timed if len(part)] or [np.zeros(1)])
    return float(time.min()), float(time.max())


def _each(number: int, noun: str) -> str:
    """A text for all of some things: ``the only fix``, ``each of 12 fixes``."""
    return f"the only {noun}" if number == 1 else f"each of {count(number, noun)}"


def _distance(metres: float) -> str:
    """A distance in metres or kilometres."""
    if metres < 2000:
        return f"{metres:.0f} m"
    return f"{metres / 1000:.1f} km" if metres < 20e3 else f"{metres / 1000:,.0f} km"
