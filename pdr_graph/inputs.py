"""The inputs of a walk: files read into one frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.floor.cells import BEACON
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import Frame, frame_of
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import wrap_angle
from pdr_graph.io.beacons import SURVEY_SIGMA, beside, drawn_beacons, read_beacons
from pdr_graph.io.loading import load
from pdr_graph.io.ranges import ANCHOR_SIGMA, read_ranges
from pdr_graph.io.tables import read_fixes, read_trajectory
from pdr_graph.plausibility import FASTEST_WALK, RADIO_RANGE, Plausibility, check_floors
from pdr_graph.types import LONLAT, Array, Beacons, Fixes, Recording
from pdr_graph.walk_options import Options

if TYPE_CHECKING:
    from pdr_graph.estimation.fingerprinting import RadioMap


@dataclass(frozen=True)
class Inputs:
    """A recording and all other inputs.

    walk; walker; building: None without a plan; frame: of the output; fixes: all that are used, in this frame and in
    order of time; notes: what was left out or assumed, one line each; beacons: in this frame, None if none was
    received; radio_map: the fixes include those from it; start_heading: of the first step, counter-clockwise from +x
    [rad].
    """

    walk: Recording
    walker: Walker
    building: Building | None
    frame: Frame
    fixes: Fixes
    notes: tuple[str, ...]
    beacons: Beacons | None = None
    radio_map: RadioMap | None = None
    start_heading: float | None = None

    @property
    def near(self) -> Array:
        """Approximate position ``(2,)`` [m] of the walk, for the World Magnetic Model."""
        if len(self.fixes):
            return self.fixes.position[0]
        return np.zeros(2) if self.building is None else self.building.floors[0].corners.mean(axis=0)

    @property
    def other_fixes(self) -> Fixes:
        """The fixes without those of the radio map, which a navigator makes from the scans itself."""
        if self.radio_map is None:
            return self.fixes
        return self.fixes[np.array([name != self.radio_map.source for name in self.fixes.source], dtype=bool)]


def read(
    recording: Path, options: Options | None = None, fastest: float = FASTEST_WALK, walk: Recording | None = None
) -> Inputs:
    """Read all files of a walk into one frame.

    fastest: mean speed at which the walker can have gone from one place to another [m/s]; walk: the recording, if it
    has been loaded already. Raises InputError if a file cannot be used, or cannot belong to this walk.
    """
    options = options or Options()
    if walk is None:
        walk = load(recording, options.gnss_latency)
    notes = list(walk.notes)
    walker = options.person()
    listed_fixes = read_fixes(options.fixes, walk, notes=notes) if options.fixes else Fixes.none()
    building = Building.load(options.plan, options.scale) if options.plan else None
    if building is not None and options.plan is not None:
        check_floors(options.plan, building, options.floor, options.fixes, listed_fixes.floor)
    listed = beside(recording) if options.recorded_fixes else None
    walk = replace(walk, beacons=_beacons(walk, options, listed, building, notes))
    radio_map = load_radio_map(options.radio_map, building) if options.radio_map else None
    recorded = walk.fixes if options.recorded_fixes else Fixes.none()
    metric = listed_fixes.epsg is None
    frame, listed_fixes, recorded = _in_one_frame(building, radio_map, listed_fixes, recorded, notes, options.fixes)
    fixes = Fixes.concatenate([listed_fixes, recorded])
    if radio_map is not None:
        fixes = Fixes.concatenate([fixes, _radio_fixes(radio_map, walk, frame, options.radio_map, notes)])
    places = Plausibility.of(walk, frame, fixes, building, fastest)
    places.check_fixes(options.plan, options.fixes, listed_fixes, recorded, metric)
    fixes = _thinned(fixes, places.span, notes)
    beacons = _placed_beacons(walk, frame, notes)
    beacons = _plausible(beacons, walk, options.beacons, listed, places, notes)
    if options.ranges is not None:
        frame, anchors = _anchors(walk, options.ranges, frame, located=len(fixes) > 0 or building is not None)
        ranges = read_ranges(options.ranges, walk, anchors)
        places.check_list(options.beacons, "anchor", anchors.position[np.unique(ranges.anchor)], RADIO_RANGE)
        walk = replace(walk, measurements=(*walk.measurements, ranges))
    if options.truth is not None:
        truth = read_trajectory(options.truth, walk)
        places.check_truth(options.truth, truth)
        walk = replace(walk, truth=truth)
    inputs = Inputs(walk, walker, building, frame, fixes, tuple(notes), beacons, radio_map)
    return (
        inputs
        if options.start_heading is None
        else replace(inputs, start_heading=_in_frame(inputs, options.start_heading))
    )


FASTEST_FIXES = 25.0  # [Hz] of the fastest receivers; each fix costs milliseconds, and denser ones repeat each other


def _thinned(fixes: Fixes, span: tuple[float, float], notes: list[str]) -> Fixes:
    """The fixes, of which every k-th is kept if they are more than FASTEST_FIXES allows in the time of the walk [s]."""
    every = int(np.ceil(len(fixes) / (FASTEST_FIXES * (span[1] - span[0] + 1))))
    if every <= 1:
        return fixes
    notes.append(f"{len(fixes)} fixes: more than {FASTEST_FIXES:.0f} per second, so one in {every} is used")
    return fixes[np.arange(0, len(fixes), every)]


def _in_frame(inputs: Inputs, bearing: float) -> float:
    """A compass bearing [deg] as a heading in the output frame. [rad]"""
    east = inputs.frame.bearing_of_east(inputs.near) if inputs.frame.georeferenced else 0.0
    return float(wrap_angle(np.pi / 2 - np.radians(bearing) + east))


def _plausible(
    beacons: Beacons | None,
    walk: Recording,
    option: Path | None,
    listed: Path | None,
    places: Plausibility,
    notes: list[str],
) -> Beacons | None:
    """The beacons, unless those received lie out of reach: raises InputError if ``option`` names their list.

    A list beside the recording is left out with a note; beacons of the plan are where the plan is.
    """
    source = option or listed
    if beacons is None or walk.bluetooth is None or source is None:
        return beacons
    received = np.isin(np.array(beacons.name), walk.bluetooth.transmitter) & np.isfinite(beacons.position).all(axis=1)
    try:
        places.check_list(source, "beacon", beacons.position[received], RADIO_RANGE)
    except InputError as error:
        if option is not None:
            raise
        notes.append(f"beacons were left out: {error}")
        return None
    return beacons


def _placed_beacons(walk: Recording, frame: Frame, notes: list[str]) -> Beacons | None:
    """The beacons of a walk in the output frame; None if none was received, or if the frame has no latitude."""
    if walk.beacons is None or walk.bluetooth is None:
        return None
    if walk.beacons.epsg is not None and not frame.georeferenced:
        notes.append(f"{len(walk.beacons)} beacons were left out: no latitude in the plan or in --fixes")
        return None
    return frame.place(walk.beacons)


def _anchors(walk: Recording, ranges: Path, frame: Frame, located: bool) -> tuple[Frame, Beacons]:
    """The frame, and the anchors of ranges in it. located: False if the anchors define the frame."""
    anchors = walk.beacons
    if anchors is None:
        raise InputError(ranges, "anchor", "no places of anchors", "--beacons, or a plan on which they are drawn")
    if not located and anchors.epsg is not None:
        frame = frame_of(Fixes(np.zeros(1), anchors.position[:1], np.ones(1), epsg=anchors.epsg))
    if anchors.epsg is not None and not frame.georeferenced:
        raise InputError(ranges, "anchor", "places by latitude in a frame that has none", "anchors as x,y [m]")
    return frame, frame.place(anchors)


def _beacons(
    walk: Recording, options: Options, listed: Path | None, building: Building | None, notes: list[str]
) -> Beacons | None:
    """Beacon positions from ``options.beacons``, else from the list beside the recording, else from the plan."""
    unstated = SURVEY_SIGMA if options.ranges is None else ANCHOR_SIGMA
    if options.beacons is not None:
        return read_beacons(options.beacons, walk, unstated)
    if listed is not None and walk.bluetooth is not None:
        try:
            return read_beacons(listed, walk, unstated)
        except InputError as error:  # no option named this file
            notes.append(f"beacons were left out: {error}")
    drawn = [(area, floor.label) for floor in building.floors for area in floor.of_kind(BEACON)] if building else []
    return drawn_beacons(drawn, walk, unstated) if drawn else None


def load_radio_map(path: Path, building: Building | None) -> RadioMap:
    """Read a radio map. Raises InputError if its frame is that of a plan and ``building`` is None."""
    from pdr_graph.estimation.fingerprinting import RadioMap  # it takes scipy.optimize, long to import

    radio_map = RadioMap.load(path)
    if building is None and radio_map.frame["kind"] == "plan":
        raise InputError(path, "frame", "that of a floor plan", "--map, the plan of the walks that it was learnt from")
    return radio_map


def _radio_fixes(radio_map: RadioMap, walk: Recording, frame: Frame, path: Path | None, notes: list[str]) -> Fixes:
    """The fixes of a radio map along a walk; the output frame must be that of the map."""
    if radio_map.frame != frame.describe():
        raise InputError(path or "--radio-map", "frame", f"{radio_map.frame}", f"that of the walk, {frame.describe()}")
    fixes = radio_map.fixes(walk)
    if not len(fixes):
        notes.append("radio map: no scan resembles its fingerprints, so it gives no fix")
    return fixes


def _in_one_frame(
    building: Building | None,
    radio_map: RadioMap | None,
    listed: Fixes,
    recorded: Fixes,
    notes: list[str],
    source: Path | None,
) -> tuple[Frame, Fixes, Fixes]:
    """The output frame, and the listed and the recorded fixes in it; adds a note on fixes that cannot be placed in it.

    It is the frame of the plan; else of the radio map; else of metric fixes; else east-north at the first geodetic fix.
    source: file of the listed fixes. Raises InputError for listed fixes by latitude in a plan's frame without any.
    """
    if building is not None:
        frame = building.floors[0].frame
    elif radio_map is not None:
        frame = Frame.from_description(radio_map.frame)
    elif len(listed) and listed.epsg != LONLAT:
        frame = frame_of(listed)
    elif not len(listed) + len(recorded):
        frame = Frame()
    else:
        frame = frame_of(min((f for f in (listed, recorded) if len(f)), key=lambda f: f.time[0]))
    if not frame.georeferenced and listed.epsg is not None and len(listed):
        expected = "time,x,y,sigma in metres of the plan, which has no latitude (map convert --georeference)"
        raise InputError(source or "--fixes", "", "positions by latitude and longitude", expected)
    if not frame.georeferenced and len(recorded):
        noun = f"{len(recorded)} fixes inside the recording"
        notes.append(f"{noun} were left out: no latitude in the plan or in --fixes")
        recorded = Fixes.none()
    return frame, frame.place(listed), frame.place(recorded)
