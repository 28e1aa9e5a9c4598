"""Live headings by the magnetometer are right or missing, and together never more certain than one can be."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest

from pdr_graph import magnetic_headings
from pdr_graph.frames import Frame
from pdr_graph.gait.compass import LiveCompass, fit_iron
from pdr_graph.gait.step_stream import StepStream
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import wrap_angle
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.online.interface import Samples, events_of
from pdr_graph.priors import COMPASS, LIVE_COMPASS
from pdr_graph.types import Signal

HERE = np.zeros(2)
SENSORS = ("accelerometer", "gyroscope", "magnetometer")


@cache
def walked(hold="hand", seed=0, laps=1, **phone):
    corners = [[40, 0], [40, 30], [0, 30], [0, 0]] * laps or [[20, 0]]
    given = {
        "seed": seed,
        "route": [[0, 0], {"stand": 3}, {"to": corners}],
        "phone": {"hold": hold, "rate": 50} | phone,
    }
    return simulate(Scenario.of(given))


def recorded(walk):
    return walk.recording(*SENSORS)


def live(walk, recording=None, compass=None, after=-np.inf, packet=0.1):
    """All headings in the order of their appearance."""
    compass = compass or LiveCompass()
    compass.locate(walk.frame, HERE)
    gait, found = StepStream(listener=compass.update, preview=compass.preview), []
    for event in events_of(recording or recorded(walk), packet):
        if isinstance(event, Samples) and event.time[-1] > after:
            if event.sensor == "magnetometer":
                compass.push(event.time, event.values)
            else:
                gait.push(event.sensor, event.time, event.values)
                gait.advance()
            found += compass.advance()
    gait.finish()
    return found + compass.advance()


def errors(walk, found):
    """Errors against the true walking direction, in sigmas and in radians."""
    time, heading, sigma = np.array([(one.time, one.heading, one.sigma) for one in found]).reshape(-1, 3).T
    error = wrap_angle(heading - np.interp(time, walk.body.time, walk.body.heading))
    return error / sigma, error


def last_of_each(found):
    """The last heading of every stretch, unless it was retracted."""
    return [one for one in {one.stretch: one for one in found}.values() if np.isfinite(one.sigma)]


def field_of(recording, change):
    """The recording with changed times and values of the magnetometer."""
    field = recording.magnetometer
    return replace(recording, magnetometer=Signal(*change(field.time, field.values.copy())))


@pytest.mark.parametrize("hold", ["hand", "swinging arm", "trouser pocket"])
def test_live_headings_are_right_or_missing(hold):
    """With steel and 3 µT of hard iron per axis, as in batch."""
    for seed in range(2):
        walk = walked(hold, seed)
        z, error = errors(walk, live(walk))
        assert np.all(np.abs(z) < 3)
        assert np.all(np.abs(error[np.isfinite(z)]) < 0.9)


@pytest.mark.parametrize("hold", ["hand", "swinging arm", "trouser pocket", "breast pocket", "bag"])
def test_the_first_heading_comes_after_eight_steps(hold):
    """Within 8 s of walking for most walkers, with an honest sigma of at most 0.7 rad, and never reversed."""
    delays, z = [], []
    for seed in range(6):
        walk = walked(hold, seed, laps=0)
        compass, recording = LiveCompass(), recorded(walk)
        compass.locate(walk.frame, HERE)
        gait = StepStream(listener=compass.update, preview=compass.preview)
        for event in events_of(recording):
            if event.time[-1] > 15:
                break
            push = compass.push if event.sensor == "magnetometer" else partial(gait.push, event.sensor)
            push(event.time, event.values)
            gait.advance()
            found = compass.advance()
            if found and (not delays or len(delays) <= seed):
                delays += [np.inf] * (seed - len(delays)) + [event.time[-1] - 3]
            z += errors(walk, found)[0].tolist()
    assert np.sum(np.array(delays) < 8) >= 4
    assert np.abs(z).max() < 2.5
    assert np.sqrt(np.mean(np.square(z))) < 1.2


def test_without_preview_the_first_heading_waits_for_certain_steps():
    """The control: five seconds later."""
    walk = walked(seed=1, laps=0)
    compass, found = LiveCompass(), []
    compass.locate(walk.frame, HERE)
    gait = StepStream(listener=compass.update)
    for event in events_of(recorded(walk)):
        push = compass.push if event.sensor == "magnetometer" else partial(gait.push, event.sensor)
        push(event.time, event.values)
        gait.advance()
        if compass.advance():
            found.append(event.time[-1] - 3)
    assert 8 < found[0] < 14


def test_standing_long_beside_steel_gives_no_certainty():
    """A minute in one disturbance is one observation: the sigma is that of a walk that starts at once."""
    sigmas = []
    for stand in (3, 63):
        route = [[0, 0], {"stand": stand}, {"to": [[40, 0]]}]
        walk = simulate(Scenario.of({"seed": 1, "route": route, "phone": {"hold": "hand", "rate": 50}}))
        sigmas.append(live(walk)[0].sigma)
    assert sigmas[1] == pytest.approx(sigmas[0], rel=0.15)


def test_a_phone_in_the_hand_has_a_heading_soon_and_a_better_one_later():
    """The first is within 8 s; the last equals that of the whole recording to the drift of a filter."""
    walk = walked(seed=1, laps=2)
    found = live(walk)
    assert found[0].time < 8
    assert found[-1].sigma < found[0].sigma
    offline = magnetic_headings(recorded(walk), walk.frame, HERE)
    assert abs(errors(walk, found[-1:])[1][0] - errors(walk, [one_of(offline)])[1][0]) < 0.15


def one_of(headings):
    from pdr_graph.gait.compass import LiveHeading

    return LiveHeading(0, *(float(column[-1]) for column in (headings.time, headings.heading, headings.sigma)))


def test_all_headings_together_are_less_certain_than_the_shared_error():
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


def test_a_stretch_ends_at_a_grip_change_or_after_minutes():
    walk = walked(laps=3)
    assert [one.stretch for one in last_of_each(live(walk))] == [0, 1]
    route = [[0, 0], {"to": [[45, 0]]}, {"hold": "trouser pocket"}, {"to": [[45, 45], [0, 45]]}]
    reheld = simulate(Scenario.of({"seed": 2, "route": route, "phone": {"hold": "hand", "rate": 50}}))
    found = live(reheld)
    assert np.all(np.abs(errors(reheld, found)[0]) < 3)
    assert len({one.stretch for one in found}) > 1 or max(one.time for one in found) < 40


def test_a_gap_starts_a_new_stretch():
    """The attitude's world changes."""
    walk = walked(laps=2)
    recording = recorded(walk)
    gap = {}
    for name, signal in recording.signals.items():
        outside = (signal.time < 60) | (signal.time > 70)
        gap[name] = Signal(signal.time[outside], signal.values[outside])
    found = live(walk, replace(recording, **gap))
    assert {one.stretch for one in found if one.time < 60} == {0}
    assert {one.stretch for one in found if one.time > 70} == {1}
    assert np.all(np.abs(errors(walk, found)[0]) < 3)


@pytest.mark.parametrize(
    "change",
    [
        lambda time, field: (time, field + np.array([0.0, 0.0, 150.0])),
        lambda time, field: (time, 0 * field + np.array([20.0, 0.0, 40.0])),
        lambda time, field: (time, 0 * field),
        lambda time, field: (time, field * np.nan),
        lambda time, field: (time[:0], field[:0]),
        lambda time, field: (time, np.random.default_rng(0).normal(0, 60, field.shape)),
    ],
    ids=["a magnet", "stuck", "dead", "NaN", "missing", "noise"],
)
def test_a_bad_magnetometer_gives_no_headings(change):
    walk = walked()
    assert live(walk, field_of(recorded(walk), change)) == []


def test_a_heading_is_retracted_if_the_magnetometer_stopped():
    """Two seconds of it, while the walker still stood, are enough for the first steps only."""
    walk = walked()
    found = live(walk, field_of(recorded(walk), lambda time, field: (time[:100], field[:100])))
    assert len(found) > 1
    assert np.all(np.abs(errors(walk, found)[0]) < 3)
    assert found[-1].sigma == np.inf


@pytest.mark.parametrize(
    "change",
    [
        lambda time, field: (time, np.where(np.arange(len(time))[:, None] % 7 == 0, np.nan, field)),
        lambda time, field: (time, np.where(np.arange(len(time))[:, None] % 97 == 0, 1e6, field)),
        lambda time, field: (np.where(time > 40, time - 25, time), field),
        lambda time, field: (np.where(np.arange(len(time)) % 50 == 0, time + 1e5, time), field),
        lambda time, field: (np.repeat(time, 2), np.repeat(field, 2, axis=0)),
    ],
    ids=["NaN", "spikes", "clock reset", "wrong times", "repeated"],
)
def test_a_magnetometer_with_occasional_errors_is_used(change):
    """Its headings are within three sigmas."""
    walk = walked()
    recording = recorded(walk)
    packets = change(recording.magnetometer.time, recording.magnetometer.values.copy())
    compass, found = LiveCompass(), []
    compass.locate(walk.frame, HERE)
    gait, rows = StepStream(listener=compass.update), len(packets[0]) // len(recording.magnetometer)
    order = recording.magnetometer.time
    for event in events_of(replace(recording, magnetometer=None)):
        gait.push(event.sensor, event.time, event.values)
        if event.sensor == "gyroscope":
            a, b = np.searchsorted(order, event.time[[0, -1]] + [0, 1e-9])
            compass.push(*(column[rows * a : rows * b] for column in packets))
        gait.advance()
        found += compass.advance()
    assert len(found) > 1
    assert np.all(np.abs(errors(walk, found)[0]) < 3)


def test_there_are_no_headings_before_the_location_is_known():
    walk = walked()
    assert live(replace(walk, frame=Frame())) == []


def test_the_state_does_not_grow():
    """It holds at most a stretch of 150 s at 25 Hz, with and without a location."""
    walk = walked(laps=3)
    compass, gait = LiveCompass(), None
    gait = StepStream(listener=compass.update)
    for event in events_of(recorded(walk)):
        (compass if event.sensor == "magnetometer" else gait).push(
            *(
                (event.time, event.values)
                if event.sensor == "magnetometer"
                else (event.sensor, event.time, event.values)
            )
        )
        gait.advance()
        sizes = [len(v) for v in vars(compass).values() if isinstance(v, np.ndarray)]
        assert max(sizes) <= 1.2 * COMPASS.longest_stretch / LIVE_COMPASS.sampling


def test_iterations_of_a_fit_of_iron_converge():
    """For a phone turned all ways in 50 µT with hard iron of 20 and −30 µT, and for one that was hardly turned."""
    random = np.random.default_rng(1)
    for spread, reliable in ((3.0, True), (0.3, False)):
        way = random.normal([0, 0, 1], spread, (500, 3))
        field = 50 * way / np.linalg.norm(way, axis=1, keepdims=True) + [20, 0, -30] + random.normal(0, 0.5, (500, 3))
        fit, rounds = fit_iron(field, 50.0), None
        for _ in range(10):
            rounds = fit_iron(field, 50.0, rounds, 3)
        assert rounds.hard == pytest.approx(fit.hard, abs=1e-3)
        assert rounds.reliable == fit.reliable == reliable
