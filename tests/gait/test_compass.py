"""Headings by the magnetometer of simulated walks, of whole recordings and live, are right or missing.

Together they are never more certain than one can be.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tiers import thorough

from pdr_graph import magnetic_headings
from pdr_graph.frames import Frame, projected
from pdr_graph.gait.compass import STORED, LiveCompass, StretchValue, compass_measurements, gyro_drift
from pdr_graph.gait.heading import walking_direction
from pdr_graph.gait.step_stream import StepStream
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import interpolate, wrap_angle
from pdr_graph.inertial.attitude import attitude_of
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.online.interface import events_of
from pdr_graph.priors import COMPASS
from pdr_graph.types import Signal

HERE = np.zeros(2)
SENSORS = ("accelerometer", "gyroscope", "magnetometer")
HOLDS = ("hand", "swinging arm", "trouser pocket", "breast pocket", "bag")


def along(*route, seed=0, hold="hand"):
    phone = {"hold": hold, "rate": 50}
    return simulate(Scenario.of({"seed": seed, "route": [[0, 0], *route], "phone": phone}))


@cache
def walked(hold="hand", seed=0, laps=1):
    """Laps round a rectangle after three seconds of standing, or 20 m straight on."""
    corners = [[40, 0], [40, 30], [0, 30], [0, 0]] * laps or [[20, 0]]
    return along({"stand": 3}, {"to": corners}, seed=seed, hold=hold)


def recorded(walk, change=None):
    """The recording of a walk, with changed times and values of the magnetometer."""
    recording = walk.recording(*SENSORS)
    if change is None:
        return recording
    field = recording.magnetometer
    return replace(recording, magnetometer=Signal(*change(field.time, field.values.copy())))


def streamed(walk, recording=None, preview=True, compass=None):
    """The time after each packet, and the new headings."""
    compass = compass or LiveCompass()
    compass.locate(walk.frame, HERE)
    gait = StepStream(listener=compass.update, preview=compass.preview if preview else None)
    for event in events_of(recording or recorded(walk)):
        if event.sensor == "magnetometer":
            compass.push(event.time, event.values)
        else:
            gait.push(event.sensor, event.time, event.values)
            gait.advance()
        yield event.time[-1], compass.advance()
    gait.finish()
    yield np.inf, compass.advance()


def live(walk, recording=None):
    """All headings in the order of their appearance."""
    return [heading for _, found in streamed(walk, recording) for heading in found]


def batch(walk, recording=None):
    headings = magnetic_headings(recording or recorded(walk), walk.frame, HERE)
    columns = (headings.time, headings.heading, headings.sigma)
    return [StretchValue(0, *map(float, row)) for row in zip(*columns, strict=True)]


def errors(walk, found):
    """Errors against the true walking direction, in sigmas and in radians."""
    time, heading, sigma = np.array([(one.time, one.value, one.sigma) for one in found]).reshape(-1, 3).T
    error = wrap_angle(heading - np.interp(time, walk.body.time, walk.body.heading))
    return error / sigma, error


OTHERS_LIVE = [thorough(live, hold) for hold in HOLDS if hold != "hand"]


@pytest.mark.parametrize(("headings", "hold"), [*((batch, hold) for hold in HOLDS), (live, "hand"), *OTHERS_LIVE])
def test_headings_are_right_or_missing(headings, hold):
    """With steel and 3 µT of hard iron per axis all are within three sigmas and 0.8 rad, live ones 0.9."""
    for seed in range(3 if headings is batch else 1):
        walk = walked(hold, seed)
        z, error = errors(walk, headings(walk))
        assert np.all(np.abs(z) < 3)
        assert np.all(np.abs(error[np.isfinite(z)]) < (0.8 if headings is batch else 0.9))


BAD = {
    "a magnet": lambda time, field: (time, field + np.array([0.0, 0.0, 150.0])),
    "stuck": lambda time, field: (time, 0 * field + np.array([20.0, 0.0, 40.0])),
    "dead": lambda time, field: (time, 0 * field),
    "missing": lambda time, field: (time[:0], field[:0]),
    "noise": lambda time, field: (time, np.random.default_rng(0).normal(0, 60, field.shape)),
    "one sample": lambda time, field: (time[:1], field[:1]),
}


@pytest.mark.parametrize("laps", [0, thorough(1)])
@pytest.mark.parametrize("name", BAD)
def test_a_bad_magnetometer_gives_no_headings(name, laps):
    walk = walked(laps=laps)
    assert live(walk, recorded(walk, BAD[name])) == batch(walk, recorded(walk, BAD[name])) == []


def test_a_magnetometer_that_stopped_gives_no_headings():
    """In the whole recording of four minutes ten seconds are too few; live the first headings are retracted."""
    walk = walked(laps=3)
    assert batch(walk, recorded(walk, lambda time, field: (time[:500], field[:500]))) == []
    walk = walked()
    found = live(walk, recorded(walk, lambda time, field: (time[:100], field[:100])))
    assert len(found) > 1
    assert np.all(np.abs(errors(walk, found)[0]) < 3)
    assert found[-1].sigma == np.inf


def test_there_are_no_headings_without_a_location_or_a_sensor_or_steps():
    walk = walked(laps=0)
    assert live(walk), "a control"
    nowhere = replace(walk, frame=Frame())
    assert live(nowhere) == batch(nowhere) == []
    for missing in SENSORS:
        assert batch(walk, walk.recording(*(sensor for sensor in SENSORS if sensor != missing))) == []
    assert batch(along({"stand": 30})) == []
    assert live(walk, recorded(walk, lambda time, field: (time, field * np.nan))) == []


def test_many_headings_together_have_the_information_of_one():
    """Their shared error does not average out: after four minutes the direction is known as after one."""

    def known(walk):
        """Sigma of the present direction after the last heading; each step adds 0.02 rad."""
        information, before, landed = 0.0, 0.0, walk.body.landings
        headings = batch(walk)
        for one in headings:
            steps = np.sum((landed > before) & (landed <= one.time))
            information = 1 / (1 / information + steps * 0.02**2) if information else 0.0
            information, before = information + one.sigma**-2.0, one.time
        return len(headings), information**-0.5

    (few, once), (many, four) = known(walked(laps=1)), known(walked(laps=4))
    assert few < many
    assert four == pytest.approx(once, rel=0.2)


def last_of_each(found):
    """The last heading of every stretch, unless it was retracted."""
    return [one for one in {one.stretch: one for one in found}.values() if np.isfinite(one.sigma)]


@pytest.mark.thorough
def test_all_live_headings_together_are_less_certain_than_the_shared_error():
    """Oracle: a filter of the direction that drifts as the graph's turns do and uses all headings."""
    walk = walked(laps=5)
    kept = last_of_each(live(walk))
    assert len(kept) > 2
    drift = Walker().sigma_turn ** 2 * walk.walker.cadence
    variance, now = np.inf, 0.0
    for one in kept:
        variance += drift * (one.time - now)
        variance, now = 1 / (1 / variance + one.sigma**-2.0), one.time
        assert variance > COMPASS.sigma**2


def test_the_grid_convergence_of_a_projection_is_applied():
    """UTM 32 at 6° east of its central meridian and 36° N: the convergence is 6° sin 36°."""
    utm = projected(32632)
    east = utm.from_lonlat(np.array([[15.0, 36.0]]))[0]
    assert np.degrees(utm.bearing_of_east(east)) == pytest.approx(6 * np.sin(np.radians(36)), abs=0.1)


# Drifts of the gyroscope


def drifting(recording, drift):
    """The recording of a phone whose gyroscope turns faster about the vertical [rad/s], as it is held."""
    attitude, gyroscope = attitude_of(recording), recording.gyroscope
    up = interpolate(gyroscope.time, attitude.time, attitude.R_world_device.inv().apply([0.0, 0.0, 1.0]))
    return replace(recording, gyroscope=Signal(gyroscope.time, gyroscope.values + drift * up))


@pytest.mark.parametrize("drift", [0.0, 0.033, -0.1])
def test_the_field_shows_how_the_gyroscope_drifts(drift):
    """Oracle: by how much the gyroscope's heading leaves the true one, per second of the first stretch.

    The headings of the walk are as right as without a drift.
    """
    for seed in range(3):
        walk = walked(seed=seed, laps=2)
        recording = drifting(recorded(walk), drift)
        headings, drifts = compass_measurements(recording, walk.frame, HERE)
        attitude = attitude_of(recording)
        gained = walking_direction(attitude, 1 / walk.walker.cadence).heading
        gained -= np.interp(attitude.time, walk.body.time, walk.body.heading)
        stretch = attitude.time < COMPASS.longest_stretch
        true = -np.polyfit(attitude.time[stretch], gained[stretch], 1)[0]
        assert abs(true + drift) < 0.01
        assert abs(drifts.drift[0] - true) < 3 * drifts.sigma[0]
        assert drifts.sigma[0] < 0.002
        columns = (headings.time, headings.heading, headings.sigma)
        assert np.all(np.abs(errors(walk, [StretchValue(0, *row) for row in zip(*columns, strict=True)])[0]) < 3)


@pytest.mark.parametrize("share", [1, 2])
def test_a_frozen_or_mirrored_north_says_nothing_of_the_drift(share):
    """That of a walker who turns at a corner every twenty seconds; the control stays where it is."""
    time, random = np.arange(0.0, 150.0), np.random.default_rng(0)
    turned = np.pi / 2 * np.cumsum(random.choice([-1, 0, 1], 150, p=[0.025, 0.95, 0.025]))
    noise = random.normal(0, 0.1, 150)
    assert gyro_drift(time, noise - share * turned, np.ones(150))[1] == np.inf
    assert gyro_drift(time, noise, np.ones(150))[1] < 0.001


# Live


def first_heading(walk, preview=True):
    """Seconds of walking before the first heading, infinite in the first 15 s; and the headings of that time."""
    delay, found = np.inf, []
    for time, new in streamed(walk, preview=preview):
        if time > 15:
            break
        if new and not found:
            delay = time - 3
        found += new
    return delay, found


@pytest.mark.parametrize("hold", ["hand", *(thorough(hold) for hold in HOLDS[1:])])
def test_the_first_heading_comes_after_eight_steps(hold):
    """Within 8 s of walking for most walkers, with an honest sigma, and never reversed."""
    delays, z = [], []
    for seed in range(6):
        walk = walked(hold, seed, laps=0)
        delay, found = first_heading(walk)
        delays.append(delay)
        z += errors(walk, found)[0].tolist()
    assert np.sum(np.array(delays) < 8) >= 4
    assert np.abs(z).max() < 2.5
    assert np.sqrt(np.mean(np.square(z))) < 1.2


def test_without_preview_the_first_heading_waits_for_certain_steps():
    """The control: five seconds later."""
    walk = walked(seed=1, laps=0)
    first = next(time for time, found in streamed(walk, preview=False) if found)
    assert 8 < first - 3 < 14


def test_standing_long_beside_steel_gives_no_certainty():
    """A minute in one disturbance is one observation: the sigma is that of a walk that starts at once."""
    sigmas = [live(along({"stand": stand}, {"to": [[40, 0]]}, seed=1))[0].sigma for stand in (3, 63)]
    assert sigmas[1] == pytest.approx(sigmas[0], rel=0.15)


@pytest.mark.thorough
def test_a_phone_in_the_hand_has_a_better_heading_later():
    """The last equals that of the whole recording to the drift of a filter, a third of the sigma of either."""
    apart = []
    for seed in range(1, 5):
        walk = walked(seed=seed, laps=2)
        found = live(walk)
        assert found[-1].sigma < next(one for one in found if one.stretch == found[-1].stretch).sigma
        apart.append(errors(walk, found[-1:])[1][0] - errors(walk, batch(walk)[-1:])[1][0])
    assert np.sqrt(np.mean(np.square(apart))) < 0.15


@pytest.mark.thorough
def test_a_stretch_ends_at_a_grip_change_or_after_minutes():
    assert [one.stretch for one in last_of_each(live(walked(laps=3)))] == [0, 1]
    walk = along({"to": [[45, 0]]}, {"hold": "trouser pocket"}, {"to": [[45, 45], [0, 45]]}, seed=2)
    found = live(walk)
    assert np.all(np.abs(errors(walk, found)[0]) < 3)
    assert len({one.stretch for one in found}) > 1 or max(one.time for one in found) < 40


def test_a_gap_starts_a_new_stretch():
    """The attitude's world changes."""
    walk = walked(laps=2)
    recording, gap = recorded(walk), {}
    for name, signal in recording.signals.items():
        outside = (signal.time < 60) | (signal.time > 70)
        gap[name] = Signal(signal.time[outside], signal.values[outside])
    found = live(walk, replace(recording, **gap))
    assert {one.stretch for one in found if one.time < 60} == {0}
    assert {one.stretch for one in found if one.time > 70} == {1}
    assert np.all(np.abs(errors(walk, found)[0]) < 3)


OCCASIONAL = {
    "NaN": lambda time, field: (time, np.where(np.arange(len(time))[:, None] % 7 == 0, np.nan, field)),
    "spikes": lambda time, field: (time, np.where(np.arange(len(time))[:, None] % 97 == 0, 1e6, field)),
    "clock reset": lambda time, field: (np.where(time > 40, time - 25, time), field),
    "wrong times": lambda time, field: (np.where(np.arange(len(time)) % 50 == 0, time + 1e5, time), field),
    "repeated": lambda time, field: (np.repeat(time, 2), np.repeat(field, 2, axis=0)),
}


LESS_OFTEN = [thorough(name) for name in ("spikes", "wrong times", "repeated")]


@pytest.mark.parametrize("name", ["NaN", "clock reset", *LESS_OFTEN])
def test_a_magnetometer_with_occasional_errors_is_used(name):
    """Its headings are within three sigmas."""
    walk = walked()
    recording = recorded(walk)
    order = recording.magnetometer.time
    packets = OCCASIONAL[name](order, recording.magnetometer.values.copy())
    compass, rows, found = LiveCompass(), len(packets[0]) // len(order), []
    compass.locate(walk.frame, HERE)
    gait = StepStream(listener=compass.update)
    for event in events_of(replace(recording, magnetometer=None)):
        gait.push(event.sensor, event.time, event.values)
        if event.sensor == "gyroscope":
            a, b = np.searchsorted(order, event.time[[0, -1]] + [0, 1e-9])
            compass.push(*(column[rows * a : rows * b] for column in packets))
        gait.advance()
        found += compass.advance()
    assert len(found) > 1
    assert np.all(np.abs(errors(walk, found)[0]) < 3)


@pytest.mark.thorough
@pytest.mark.parametrize("located", [True, False])
def test_the_state_does_not_grow(located):
    """It holds at most a stretch of 150 s at 25 Hz."""
    walk, compass = walked(laps=3), LiveCompass()
    for _ in streamed(walk if located else replace(walk, frame=Frame()), recorded(walk), compass=compass):
        sizes = [len(v) for v in vars(compass).values() if isinstance(v, np.ndarray)]
        assert max(sizes) <= 1.2 * COMPASS.longest_stretch / STORED
