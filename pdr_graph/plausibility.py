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
from pdr_graph.io.tables import CLOCK_MARGIN, check_clock
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

    @classmethod
    def of(
        cls, walk: Recording, frame: Frame, fixes: Fixes, building: Building | None, fastest: float = FASTEST_WALK
    ) -> Plausibility:
        """The area of a walk; fixes: all of them, in the frame."""
        timed = [signal.time for signal in walk.signals.values() if len(signal)] or [fixes.time, walk.fixes.time]
        time = np.concatenate([np.zeros(0 if any(map(len, timed)) else 1), *timed])
        span = float(time.min()), float(time.max())
        area = reach = Reach.of_fixes(fixes, span, fastest)
        if building is not None:
            plan = Reach.of_plan(building, fastest * (span[1] - span[0]))
            area = Reach(*(np.concatenate([getattr(r, n) for r in (reach, plan)]) for n in ("low", "high", "margin")))
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
            _check_plan(plan, self.frame, self.fixes, outline, hint)
        # three fixes inside a recording can contradict a file: a single one is often an old position
        if source is None or len(recorded) < 3:
            return
        if outline is not None and (outline.distance(listed.position) <= outline.margin).any():
            return  # the receiver is wrong
        widest = WIDEST_ERROR * float(listed.sigma.max(initial=0.0))
        reach = Reach.of_fixes(recorded, self.span, self.fastest)
        evidence = "those inside the recording"
        _check_reach(source, self.frame, "fix", listed.position, reach, widest, evidence, hint)

    def check_list(self, source: Path | None, noun: str, position: Array, margin: float = 0.0) -> None:
        """Raise InputError if all places of a list ``(n, 2)`` [m] are out of reach of the fixes and the plan.

        source: the list's file, None if nothing is to be checked; noun: of one place; margin: of the reach [m].
        """
        if source is not None:
            evidence = "the plan" if not len(self.fixes) else "all fixes" if self.building is None else "fixes and plan"
            _check_reach(source, self.frame, noun, position, self.area, margin, evidence)

    def check_truth(self, source: Path, truth: Trajectory) -> None:
        """Raise InputError if a truth is of another time than the walk, or out of its reach."""
        check_clock(source, truth.time, self.walk, self.span)
        if truth.epsg is None:
            self.check_list(source, "row", truth.position)


def _check_plan(plan: Path, frame: Frame, fixes: Reach, outline: Reach, hint: str = "") -> None:
    """Raise InputError if no fix can reach the plan. outline: of the plan; hint: at the cause, if it is known."""
    far = outline.distance(fixes.low)[:, 0]
    if not len(far) or (far <= np.maximum(fixes.margin, outline.margin)).any():
        return
    nearest = int(np.argmin(far - fixes.margin))
    found = f"a plan {_distance(far[nearest])} or more from {_each(len(far), 'fix')}"
    within = _distance(max(fixes.margin[nearest], FAR_FROM_PLAN))
    expected = f"a plan within {within}, which the walk can reach"
    raise InputError(plan, "", found + (hint or _swapped(frame, fixes.low, outline)), expected)


def _check_reach(
    source: Path, frame: Frame, noun: str, position: Array, reach: Reach, margin: float, evidence: str, hint: str = ""
) -> None:
    """Raise InputError if no position ``(n, 2)`` [m] lies within reach and a margin [m].

    noun: of one position; evidence: what the reach follows from; hint: at the cause, if it is known.
    """
    far = reach.distance(position)
    if not far.size or (far <= reach.margin + margin).any():
        return
    row, box = np.unravel_index(np.argmin(far - reach.margin), far.shape)
    found = f"{_each(len(position), noun)} {_distance(far[row, box])} or more from {evidence}"
    expected = f"places within {_distance(reach.margin[box] + margin)}, in reach of the walk"
    raise InputError(source, "", found + (hint or _swapped(frame, position, reach)), expected)


def _swapped(frame: Frame, position: Array, reach: Reach) -> str:
    """A hint if positions ``(n, 2)`` would be in reach with latitude and longitude swapped; else empty."""
    if not frame.georeferenced:
        return ""
    swapped = frame.to_lonlat(position)[:, ::-1]
    swapped = swapped[np.abs(swapped[:, 1]) <= 90]
    back = frame.from_lonlat(swapped) if len(swapped) else swapped
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
    # only positions over 2 m apart can be millimetres: any others, divided by 1000, are near the origin
    guesses = {
        "x and y swapped?": position[:, ::-1],
        "millimetres?": position / 1000 if np.ptp(position, axis=0).max() > 2000.0 else position,
        "metres from a corner of the plan?": position + corner,
    }
    if frame.georeferenced:
        lon, lat = frame.to_lonlat(corner[None])[0].tolist()
        zone = (32601 if lat >= 0 else 32701) + min(int((lon + 180) // 6), 59)
        is_projected = (np.abs(position) < 2e7).all()
        from_utm = frame.from_lonlat(projected(zone).to_lonlat(position)) if is_projected else position
        guesses[f"metres of EPSG:{zone}?"] = from_utm[np.isfinite(from_utm).all(axis=1)]
    return next((f" ({guess})" for guess, metres in guesses.items() if on_plan(metres)), "")


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
    reach = Reach.of_fixes(place, (0.0, LIVE_DURATION), FASTEST_WALK)
    _check_plan(plan, frame, reach, outline, hint)


def check_beacons_on_plan(source: Path, beacons: Beacons, building: Building) -> None:
    """Raise InputError if no beacon of a list can be near a plan, before a live walk begins."""
    frame = building.floors[0].frame
    if beacons.epsg is not None and not frame.georeferenced:
        return
    reach, position = Reach.of_plan(building, FASTEST_WALK * LIVE_DURATION), frame.place(beacons).position
    position = position[np.isfinite(position).all(axis=1)]
    _check_reach(source, frame, "beacon", position, reach, RADIO_RANGE, "the plan")


def _each(number: int, noun: str) -> str:
    """A text for all of some things: ``the only fix``, ``each of 12 fixes``."""
    return f"the only {noun}" if number == 1 else f"each of {count(number, noun)}"


def _distance(metres: float) -> str:
    """A distance in metres or kilometres."""
    if metres < 2000:
        return f"{metres:.0f} m"
    return f"{metres / 1000:.1f} km" if metres < 20e3 else f"{metres / 1000:,.0f} km"
