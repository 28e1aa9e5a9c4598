"""What a walk is estimated from, read from files and brought into one frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pdr_graph import io
from pdr_graph.errors import InputError
from pdr_graph.floor.areas import BEACON
from pdr_graph.floor.building import Building
from pdr_graph.frames import Frame, frame_of
from pdr_graph.gait.walker import Walker
from pdr_graph.io.beacons import beside, drawn_beacons, read_beacons
from pdr_graph.io.tables import read_fixes
from pdr_graph.types import LONLAT, Array, Beacons, Fixes, Recording

if TYPE_CHECKING:
    from pdr_graph.estimation.radio_map import RadioMap


@dataclass(frozen=True)
class Inputs:
    """A recording and what else is known.

    walk: with the beacons that are listed; walker; building: None without a plan; frame: the output's; fixes: all that
    are used, in it and in order of time; notes: what was left out or assumed, one line each.
    """

    walk: Recording
    walker: Walker
    building: Building | None
    frame: Frame
    fixes: Fixes
    notes: list[str]

    @property
    def near(self) -> Array:
        """About where the walk was ``(2,)`` [m], for the World Magnetic Model."""
        if len(self.fixes):
            return self.fixes.position[0]
        return np.zeros(2) if self.building is None else self.building.floors[0].corners.mean(axis=0)


def read_inputs(
    recording: Path,
    plan: Path | None = None,
    fixes: Path | None = None,
    walker: Path | None = None,
    use_recorded_fixes: bool = True,
    gnss_latency: float = 0.0,
    beacons: Path | None = None,
    radio_map: Path | None = None,
) -> Inputs:
    """Read what ``pdr-graph smooth`` is given; arguments as of it. Raises InputError if a file cannot be used."""
    walk = io.load(recording, gnss_latency)
    known = Walker.load(walker) if walker else Walker()
    notes = list(walk.notes)
    given = read_fixes(fixes, walk, notes=notes) if fixes else Fixes.none()
    building = Building.load(plan) if plan else None
    listed = beside(recording) if use_recorded_fixes else None
    walk = replace(walk, beacons=_beacons(walk, beacons, listed, building, notes))
    places = _radio_map(radio_map, building) if radio_map else None
    recorded = walk.fixes if use_recorded_fixes else Fixes.none()
    frame, located = _locate(building, places, given, recorded, notes)
    if places is not None:
        located = Fixes.together([located, _radio_fixes(places, walk, frame, radio_map, notes)])
    return Inputs(walk, known, building, frame, located, notes)


def placed_beacons(walk: Recording, frame: Frame, notes: list[str]) -> Beacons | None:
    """The beacons of a walk in the output frame; None where none was heard or they have no place in it."""
    if walk.beacons is None or walk.bluetooth is None:
        return None
    if walk.beacons.epsg is not None and not frame.georeferenced:
        notes.append(f"{len(walk.beacons)} beacons were left out: the frame of --fixes has no latitude")
        return None
    return frame.place(walk.beacons)


def _beacons(
    walk: Recording, given: Path | None, listed: Path | None, building: Building | None, notes: list[str]
) -> Beacons | None:
    """Where beacons are: as a list that was given says, or one beside the recording, or the plan."""
    if given is not None:
        return read_beacons(given, walk)
    if listed is not None and walk.bluetooth is not None:
        try:
            return read_beacons(listed, walk)
        except InputError as error:  # nobody asked for it
            notes.append(f"beacons were left out: {error}")
    drawn = [(area, floor.label) for floor in building.floors for area in floor.of_kind(BEACON)] if building else []
    return drawn_beacons(drawn, walk) if drawn else None


def _radio_map(path: Path, building: Building | None) -> RadioMap:
    """A radio map that has a frame: its own, or that of the plan it was learnt on."""
    from pdr_graph.estimation.radio_map import RadioMap  # it takes scipy.optimize, long to import

    heard = RadioMap.load(path)
    if building is None and heard.frame["kind"] == "plan":
        raise InputError(path, "frame", "that of a floor plan", "--map, the plan of the walks that it was learnt from")
    return heard


def _radio_fixes(heard: RadioMap, walk: Recording, frame: Frame, path: Path | None, notes: list[str]) -> Fixes:
    """What a radio map says of a walk in the output frame, which must be its own."""
    if heard.frame != frame.describe():
        raise InputError(path or "--radio-map", "frame", f"{heard.frame}", f"that of the walk, {frame.describe()}")
    fixes = heard.fixes(walk)
    if not len(fixes):
        notes.append("radio map: nothing that was heard is like what it knows, so that it gives no fix")
    return fixes


def _locate(
    building: Building | None, heard: RadioMap | None, given: Fixes, recorded: Fixes, notes: list[str]
) -> tuple[Frame, Fixes]:
    """The output frame and all fixes in it; a note on fixes that have no place in it.

    The plan's frame; else a radio map's; else that of metric fixes; else east-north about the first geodetic fix.
    """
    if building is not None:
        frame = building.floors[0].frame
    elif heard is not None:
        frame = Frame.described(heard.frame)
    elif len(given) and given.epsg != LONLAT:
        frame = frame_of(given)
    elif not len(given) + len(recorded):
        frame = Frame()
    else:
        frame = frame_of(min((f for f in (given, recorded) if len(f)), key=lambda f: f.time[0]))
    if not frame.georeferenced and len(recorded):
        notes.append(f"{len(recorded)} fixes inside the recording were left out: the frame of --fixes has no latitude")
        recorded = Fixes.none()
    return frame, Fixes.together([frame.place(given), frame.place(recorded)])
