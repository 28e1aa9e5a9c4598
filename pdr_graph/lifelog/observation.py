"""What one recording tells of a day before the day is known: steps, headings, positions, what its radios heard.

The costly part of a lifelog, done once for each recording: everything later is made of this.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.frames import Frame
from pdr_graph.gait.gait import Gait, gait_of
from pdr_graph.gait.heading import magnetic_headings
from pdr_graph.gait.pdr import detect_steps
from pdr_graph.gait.profile import Profile
from pdr_graph.inertial.magnetometer import measured_field
from pdr_graph.inputs import placed_beacons, read_inputs
from pdr_graph.types import INSTANT, Array, Beacons, Fixes, Headings, Recording, Sightings, Signal, Steps

AT_ENDS = 1.5  # [s] at either end of a recording over which the field is taken
SHORTEST_LOOK = 1.0  # [s] of standing: less is the rhythm of a walk
FEWEST = 2  # positions that make an outing without steps
PRESSURE_RATE = 5.0  # [Hz] that are kept of a barometer: climbs take seconds


@dataclass(frozen=True)
class Ends:
    """The horizontal magnetic field as the walker faced it at the first and the last moment of a recording.

    field: ``(2, 2)`` horizontal, x ahead and y to the left, start and end [µT]; vertical: ``(2,)`` up [µT].
    """

    field: Array
    vertical: Array


@dataclass(frozen=True)
class Observation:
    """A recording, observed; times are seconds from its start.

    source: what a message calls it; epoch: Unix time of its start [s]; duration: [s].
    frame: of fixes, headings and beacons; plan: path of the floor plan, "" without one; floor: label where it began,
    "" if unknown.
    steps: None without an accelerometer; looks: ``(n + 1,)`` how far the walker had turned while standing before each
    step and after the last, in the middle of that time, since the step before [rad].
    headings, fixes, barometer, bluetooth, wifi, beacons: as of ``Recording``, in the frame; ends: None where the field
    is unknown; profile: of the walker file, for a lifelog to begin with. notes: what was left out or assumed.
    """

    source: str
    epoch: float
    duration: float
    frame: Frame
    plan: str
    floor: str
    steps: Steps | None
    looks: Array
    headings: Headings
    fixes: Fixes
    barometer: Signal | None = None
    bluetooth: Sightings | None = None
    wifi: Sightings | None = None
    beacons: Beacons | None = None
    ends: Ends | None = None
    profile: Profile | None = None
    notes: tuple[str, ...] = ()


def observe(
    recording: Path,
    plan: Path | None = None,
    fixes: Path | None = None,
    walker: Path | None = None,
    begins: float | None = None,
    floor: str = "",
) -> Observation:
    """Read a recording and find the steps in it.

    plan, fixes, walker: as of ``pdr-graph smooth``; steps are not yet corrected by the walker's profile, which a
    lifelog learns. begins: Unix time of its start [s], of a recording that does not say; floor: where it began.

    Raises InputError if it cannot be used, or nobody knows of which day it is.
    """
    given = read_inputs(recording, plan, fixes, walker)
    walk, known, notes = given.walk, replace(given.walker, profile=None), given.notes
    epoch = walk.epoch if begins is None else begins
    if epoch is None:
        raise InputError(recording, "", "no date", "--begins, when it was recorded")
    check_tells(recording, walk, len(given.fixes))
    steps, looks, headings, ends = None, np.empty(0), Headings.none(), None
    last = [s.time[-1] for s in walk.signals.values()] or [given.fixes.time[-1]]
    if walk.has_acceleration:
        gaits = gait_of(walk)
        steps, headings = detect_steps(gaits, known), magnetic_headings(gaits, given.frame, given.near)
        looks, ends = _looks(gaits, steps), _ends(gaits)
    return Observation(
        source=walk.source,
        epoch=epoch,
        duration=float(max(last)),
        frame=given.frame,
        plan="" if plan is None else str(plan),
        floor=floor,
        steps=steps,
        looks=looks,
        headings=headings,
        fixes=given.fixes,
        barometer=_thinned(walk.barometer),
        bluetooth=walk.bluetooth,
        wifi=walk.wifi,
        beacons=placed_beacons(walk, given.frame, notes),
        ends=ends,
        profile=given.walker.profile,
        notes=tuple(notes),
    )


def check_tells(recording: Path, walk: Recording, positions: int) -> None:
    """Raise InputError where a recording tells neither steps nor a way."""
    if not walk.has_acceleration and positions < FEWEST:
        raise InputError(recording, "", f"no acceleration and {positions} positions", f"steps, or {FEWEST} positions")


def _looks(gaits: list[Gait], steps: Steps) -> Array:
    """Which way the walker looked in each pause ``(n + 1,)``, from the direction of the step before. [rad]"""
    landed = np.concatenate([[steps.start], steps.time])
    set_off = np.append(steps.time - steps.duration, steps.end)
    looks = np.zeros(len(landed))
    for gait in gaits:
        time, heading = gait.attitude.time, gait.direction.heading
        here = (set_off - landed > SHORTEST_LOOK) & (landed >= time[0] - INSTANT) & (set_off <= time[-1] + INSTANT)
        for n in np.flatnonzero(here).tolist():
            first, after = np.searchsorted(time, [landed[n], set_off[n]])
            looks[n] = np.median(heading[first:after]) - heading[first]
    return looks


def _ends(gaits: list[Gait]) -> Ends | None:
    """The field at both ends of a recording, relative to the walker."""
    if gaits[0].recording.magnetometer is None:
        return None
    start = _field(gaits[0], gaits[0].attitude.time[0], gaits[0].attitude.time[0] + AT_ENDS, 0)
    end = _field(gaits[-1], gaits[-1].attitude.time[-1] - AT_ENDS, gaits[-1].attitude.time[-1], -1)
    field = np.array([start, end])
    return Ends(field[:, :2], field[:, 2]) if np.isfinite(field).all() else None


def _field(gait: Gait, begin: float, end: float, at: int) -> Array:
    """The mean field ``(3,)`` ahead, to the left and up of the walker as they stood at a sample. [µT]"""
    attitude = gait.attitude
    assert gait.recording.magnetometer is not None, "asked for with one"
    held = attitude[slice(*np.searchsorted(attitude.time, [begin, end]).tolist())]
    field = measured_field(gait.recording.magnetometer, held.time)
    measured = np.count_nonzero(field.any(axis=1))
    if not measured:
        return np.full(3, np.nan)
    x, y, z = held.R_world_device.apply(field).sum(axis=0) / measured
    cos, sin = np.cos(heading := gait.direction.heading[at]), np.sin(heading)
    return np.array([cos * x + sin * y, cos * y - sin * x, z])


def _thinned(barometer: Signal | None) -> Signal | None:
    """A barometer's samples, means over a fifth of a second."""
    if barometer is None or barometer.rate <= PRESSURE_RATE:
        return barometer
    bins = np.floor(barometer.time * PRESSURE_RATE).astype(np.int64)
    _, first, count = np.unique(bins, return_index=True, return_counts=True)
    time = np.add.reduceat(barometer.time, first) / count
    return Signal(time, np.add.reduceat(barometer.values, first, axis=0) / count[:, None])
