"""Absolute walking directions, by the magnetometer: a few for a walk, with honest sigmas, or none."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from pdr_graph.earth import EarthField, earth_field
from pdr_graph.errors import expect
from pdr_graph.frames import Frame
from pdr_graph.gait.direction import Direction
from pdr_graph.gait.forward import forward_axis
from pdr_graph.gait.gait import Gait, gait_of
from pdr_graph.geometry import wrap_angle
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.inertial.magnetometer import TILTED, fit_iron, measured_field
from pdr_graph.inertial.north import North, magnetic_north
from pdr_graph.inertial.windows import runs
from pdr_graph.types import Array, Headings, Index, Mask, Recording

STRETCH = 150.0  # [s] that one heading speaks for: a gyroscope that drifts by 0.002 rad/s is as unsure then
ABOUT = 2.0  # [s] to either side of it, in which a walker should not turn
LEAST_STEPS = 24  # in a stretch; a few may be none
COMPASS_SIGMA = 0.2  # [rad] that stays for a whole walk: the phone's own iron, a building's axis, a plan's
LEAST_CERTAIN = 0.7  # [rad] of north or of what is ahead; beyond it a heading tells nothing


def magnetic_headings(recording: Recording | list[Gait], frame: Frame, near: Array) -> Headings:
    """Walking directions where the magnetometer can be believed, and gait or grip tell what is ahead.

    Headings of one walk share most of their error. So that many do not pretend to know it better than one, the shared
    variance is counted as often as there are headings: all together weigh what one would.

    recording: or what `gait_of` made of it; frame: that of the headings; near: ``(2,)`` where in it the walk was [m],
    for the World Magnetic Model. Returns none in a frame that is nowhere on earth, or without an accelerometer,
    gyroscope and magnetometer.
    """
    expect("magnetic_headings, recording", recording, Recording, list, instead="load(path)")
    expect("magnetic_headings, frame", frame, Frame, instead="FloorPlan.frame or frame_of(fixes)")
    expect("magnetic_headings, near", near, np.ndarray, instead="fixes.position[0]")
    whole = recording if isinstance(recording, Recording) else recording[0].recording
    if not frame.georeferenced or None in (whole.accelerometer, whole.gyroscope, whole.magnetometer):
        return Headings.none()
    lon, lat = frame.to_lonlat(near[None])[0].tolist()
    earth = earth_field(lat, lon, whole.epoch)
    found = [row for gait in gait_of(recording) for row in _uninterrupted_headings(gait, earth)]
    time, from_east, own, ahead = np.array(found).reshape(-1, 4).T
    heading = wrap_angle(from_east + frame.bearing_of_east(near))
    return Headings(time, heading, np.sqrt(own**2 + len(time) * (ahead**2 + COMPASS_SIGMA**2)))


def _uninterrupted_headings(gait: Gait, earth: EarthField) -> list[tuple[float, float, float, float]]:
    """Rows of time, heading from true east, and the sigmas of north and of what is ahead."""
    attitude, walking, step = gait.attitude, gait.walking, gait.landings.usual_step
    north = _north(attitude, gait.recording, earth)
    if not len(north) or len(gait.landings) < LEAST_STEPS:
        return []
    rows = []
    for stretch in _stretches(gait.direction, attitude.time):
        held, heading, here = attitude[stretch], gait.direction.heading[stretch], walking[stretch]
        if np.sum(here) * attitude.period < LEAST_STEPS * step:
            continue
        walked = np.flatnonzero(here)
        middle = walked[len(walked) // 4 : max(1, len(walked) - len(walked) // 4)]
        straight = straightest(heading, middle, round(ABOUT / attitude.period))
        found = course_from_east(held, heading, here, step, north, straight)
        if found is not None:
            rows.append((float(held.time[straight]), *found))
    return rows


def course_from_east(
    held: Attitude, heading: Array, walking: Mask, step: float, north: North, sample: int
) -> tuple[float, float, float] | None:
    """Where a walker went at a sample, from true east, and the sigmas of north and of what is ahead; None if unsure.

    held, heading, walking, step: as of `forward_axis`. [rad]
    """
    ahead, moment = forward_axis(held, heading, walking, step), float(held.time[sample])
    sigma = float(np.interp(moment, north.time, north.sigma))
    if not max(ahead.sigma, sigma) < LEAST_CERTAIN:
        return None
    east = np.interp(moment, north.time, north.direction) - np.pi / 2
    return float(wrap_angle(heading[sample] + ahead.angle - east)), sigma, ahead.sigma


def straightest(heading: Array, among: Index, reach: int) -> int:
    """Of some samples that about which the heading turns least: a heading is of one moment."""
    turned = heading[np.minimum(among + reach, len(heading) - 1)] - heading[np.maximum(among - reach, 0)]
    return int(among[np.argmin(np.abs(turned))])


def _north(attitude: Attitude, recording: Recording, earth: EarthField) -> North:
    assert recording.magnetometer is not None, "asked for by magnetic_headings"
    field = measured_field(recording.magnetometer, attitude.time)
    up = attitude.R_world_device.inv().apply([0.0, 0.0, 1.0])
    measured = np.any(field, axis=1)
    if np.linalg.norm(up.mean(axis=0)) < TILTED and measured.any():
        iron = fit_iron(field[measured], earth.magnitude)
        field[measured] = iron.corrected(field[measured]) if iron.known else field[measured]
    return magnetic_north(attitude, field, earth)


def _stretches(direction: Direction, time: Array) -> list[slice]:
    """Parts of a walk, of equal duration up to STRETCH, in which the phone was not held otherwise."""
    reheld = np.diff(direction.variance, prepend=direction.variance[0]) > 0
    stretches = []
    for first, after in zip(*runs(~reheld), strict=True):
        count = max(1, int(np.ceil((time[after - 1] - time[first]) / STRETCH)))
        cuts = np.linspace(first, after, count + 1).round().astype(int).tolist()
        stretches += [slice(*span) for span in pairwise(cuts)]
    return stretches
