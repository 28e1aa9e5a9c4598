"""The step detector finds every step once, and no steps in other motion."""

from functools import cache

import numpy as np
import pytest
from gait_data import in_hand, quarter_car, waved
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation
from tiers import thorough

from pdr_graph.gait.step_detection import Bout, Candidates, StepDetector, walking_steps
from pdr_graph.inertial.units import unit_of
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.priors import IRREGULARITY

RATE = 50.0
HOLDS = ("hand", "swinging arm", "trouser pocket", "breast pocket", "bag")


def walking(cadence, amplitude, seconds=30.0, rate=RATE, seed=0):
    """Gravity and a bounce of ``amplitude`` [m/s²] per step, with a heel strike that rings, and noise."""
    t = np.arange(0, seconds, 1 / rate)
    phase = 2 * np.pi * cadence * t
    bounce = amplitude * (np.cos(phase) + 0.3 * np.cos(2 * phase + 1)) + 0.8 * np.cos(10 * phase)
    noise = np.random.default_rng(seed).normal(0, 0.3, (len(t), 3))
    return t, np.array([0.0, 0.0, 9.81]) + bounce[:, None] * [0, 0, 1] + noise


@pytest.mark.parametrize("cadence", [1.2, 1.6, 2.0, 2.4])
@pytest.mark.parametrize("amplitude", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("rate", [25.0, 200.0])
def test_every_step_is_found_once(cadence, amplitude, rate):
    t, a = walking(cadence, amplitude, rate=rate)
    landings = walking_steps(t, a)
    assert len(landings) == pytest.approx(30 * cadence, abs=1)
    assert np.median(landings.period) == pytest.approx(1 / cadence, rel=0.05)
    assert np.median(landings.amplitude) == pytest.approx(2 * amplitude, rel=0.4)


def in_turn(*changes, start=10.0, duration=0.5):
    """Landings whose durations are longer by each change [log] than the one before."""
    time = start + np.cumsum(duration * np.exp(np.cumsum([0.0, *changes])))
    n = len(time)
    return Candidates(time, np.full(n, duration), np.full(n, 3.0), np.full(n, 0.9), np.ones(n, bool))


def irregularity(*bouts):
    detected = Bout()
    return np.concatenate([detected.steps(bout)[:, 4] for bout in bouts])


def test_irregularity_is_the_mean_change_of_the_duration_from_step_to_step():
    assert irregularity(in_turn(*[0.04, -0.04] * 40))[-1] == pytest.approx(0.04, rel=0.01)
    assert irregularity(in_turn(*[0.0] * 80))[-1] < 1e-3
    assert irregularity(in_turn(*[0.5, -0.5] * 40))[-1] <= IRREGULARITY.largest, "a hesitation counts as a large change"


def test_a_stop_is_no_irregularity():
    steady = irregularity(in_turn(*[0.0] * 40), in_turn(*[0.0] * 40, start=60.0))
    assert np.all(np.diff(steady[1:]) <= 0)


@pytest.mark.parametrize("rate", [25.0, 50.0, 200.0])
def test_irregularity_is_of_the_walker_and_not_of_the_sampling(rate):
    """Times of landings are interpolated between samples: steps of 0.4977 s do not seem to vary."""
    t, a = walking(1 / 0.4977, 3.0, rate=rate)
    assert walking_steps(t, a).irregularity[-1] < IRREGULARITY.usual / 2


def slow_walking(duration, count=24, spread=0.1, seed=0):
    """A slow walk in the hand: soft landings of 1 m/s² that vary, and a sway of 0.7 m/s² from foot to foot."""
    random = np.random.default_rng(seed)
    landed = 3 + np.cumsum(duration * (1 + spread * random.normal(size=count)))
    t = np.arange(0, landed[-1] + 4, 1 / RATE)
    up = np.sum(random.uniform(0.8, 1.2, count) * np.exp(-(((t[:, None] - landed) / 0.15) ** 2) / 2), axis=1)
    walked = np.interp(t, landed, np.arange(count), left=0, right=count - 1)
    sway = 0.7 * np.sin(np.pi * walked) * ((t > landed[0]) & (t < landed[-1]))
    noise = random.normal(0, 0.15, (len(t), 3))
    return t, np.array([0.5, 3.0, 9.3]) + up[:, None] * [0.0, 0.3, 0.95] + sway[:, None] * [1.0, 0, 0] + noise


@pytest.mark.parametrize("duration", [0.8, 1.0, 1.2, 1.4, 1.6])
def test_slow_steps_are_neither_lost_nor_counted_twice(duration):
    """As the old, the ill and those who browse walk: 38 to 75 steps a minute, each 10 % off the rhythm; within 10 %."""
    found = [len(walking_steps(*slow_walking(duration, seed=seed))) for seed in range(4)]
    assert sum(found) == pytest.approx(4 * 24, rel=0.1)


def typing():
    """Four minutes of taps on the screen, five a second, in a hand that wanders."""
    random, n = np.random.default_rng(3), round(240 * RATE)
    tap, wander = np.zeros(n), gaussian_filter1d(random.normal(size=n), 0.5 * RATE)
    tap[np.cumsum(random.integers(5, 16, n // 16))] = random.uniform(0.5, 2, n // 16)
    return in_hand(gaussian_filter1d(tap, 0.6) + 0.05 * wander / wander.std())


@pytest.mark.parametrize("hold", HOLDS)
def test_steps_are_found_in_every_hold(hold):
    """From normal walking to browsing, with a stop; within 2 % over four walkers."""
    found, true = 0, 0
    for seed, manner in enumerate(("normal", "fast", "slow", "normal")):
        route = [[0, 0], {"stand": 4}, {"to": [[40, 0]], "manner": manner}, {"stand": 6}, {"to": [[40, 30]]}]
        walk = simulate(Scenario.of({"seed": seed, "route": route, "phone": {"hold": hold, "rate": 50}}))
        accelerometer = walk.signals["accelerometer"]
        found += len(walking_steps(accelerometer.time, accelerometer.values))
        true += len(walk.body.landings)
    assert found == pytest.approx(true, rel=0.02)


@pytest.mark.parametrize("hold", HOLDS)
@pytest.mark.parametrize("manner", ["jog", thorough("run"), thorough("sprint")])
def test_steps_of_runs_are_found_in_every_hold(manner, hold):
    """2.4 to 3.2 steps a second, with flight: within 4 % over three runners, neither strides nor half steps."""
    found, true = 0, 0
    for seed in range(3):
        route = [[0, 0], {"stand": 4}, {"to": [[120, 0], [120, 120]], "manner": manner}, {"stand": 4}]
        walk = simulate(Scenario.of({"seed": seed, "route": route, "phone": {"hold": hold}}))
        accelerometer = walk.signals["accelerometer"]
        assert unit_of("", "accelerometer", accelerometer, []) == ("accelerometer", 1.0), "though an arm pulls at it"
        found += len(walking_steps(accelerometer.time, accelerometer.values))
        true += len(walk.body.landings)
    assert found == pytest.approx(true, rel=0.04)


@settings(max_examples=20, deadline=None)
@given(st.tuples(*[st.floats(-np.pi, np.pi)] * 3))
def test_the_orientation_of_the_phone_does_not_matter(angles):
    t, a = walking(1.9, 3.0)
    turned = walking_steps(t, Rotation.from_euler("xyz", angles).apply(a))
    assert turned.time == pytest.approx(walking_steps(t, a).time)


@cache
def browsing():
    """The accelerometer of a walk with two stops, the last leg of which is browsing."""
    browse = {"to": [[25, 20]], "manner": "browse"}
    route = [[0, 0], {"stand": 3}, {"to": [[25, 0]]}, {"stand": 4}, browse, {"stand": 3}]
    return simulate(Scenario.of({"seed": 3, "route": route, "phone": {"rate": 50}})).signals["accelerometer"]


@pytest.mark.thorough
@settings(max_examples=10, deadline=None)
@given(st.lists(st.integers(1, 400), min_size=1), st.sampled_from([0.0, 0.5, 2.0]))
def test_live_steps_equal_those_of_the_whole_recording(chunks, look_ahead):
    """With samples one by one, in packets or all at once."""
    a = browsing()
    whole = walking_steps(a.time, a.values, look_ahead)
    detector = StepDetector(float(a.time[-1] - a.time[0]) / (len(a) - 1), float(a.time[0]), look_ahead)
    ends = np.cumsum(np.resize(chunks, len(a)))
    packets = np.split(a.values, ends[ends < len(a)])
    found = np.concatenate([*(detector.update(packet) for packet in packets), detector.finish()])
    assert found[:, 0] == pytest.approx(whole.time)
    assert found[:, 1] == pytest.approx(whole.amplitude)


def test_live_steps_are_certain_in_time():
    """A step is certain 4.5 s after the look-ahead."""
    _, a = walking(2.0, 3.0, seconds=20)
    detector = StepDetector(1 / RATE, look_ahead=0.5)
    found = detector.update(a[: round(15 * RATE)])[:, 0]
    assert found[-1] == pytest.approx(15 - 5.0, abs=0.6)


def standing():
    """Five minutes of the tremor of a hand and the sway of a body, up to 0.3 m/s²."""
    sway = gaussian_filter1d(np.random.default_rng(1).normal(size=round(300 * RATE)), 0.1 * RATE)
    return in_hand(0.1 * sway / sway.std())


def gestures():
    """Every few seconds the phone is lifted to read it, or tapped."""
    up, random = np.zeros(round(300 * RATE)), np.random.default_rng(2)
    for n in np.arange(5, 295, 5.0):
        k = round((n + random.uniform(0, 2)) * RATE)
        up[k] += random.uniform(20, 120)
        up[k + round(random.uniform(0.2, 0.6) * RATE)] -= random.uniform(20, 120)
    return in_hand(gaussian_filter1d(up, 0.1 * RATE))


def shaking():
    """The figures of eight with which a compass is calibrated."""
    route = [[0, 0], {"shake": 30}, {"stand": 10}]
    signal = simulate(Scenario.of({"seed": 1, "route": route, "phone": {"rate": 50}})).signals["accelerometer"]
    return signal.time, signal.values


@pytest.mark.parametrize("motion", [standing, gestures, shaking, typing])
def test_other_motion_gives_no_steps(motion):
    assert len(walking_steps(*motion())) == 0


@pytest.mark.parametrize("angle", [0.2, 0.35, 0.5])
@pytest.mark.parametrize("lever", [0.35, 0.6])
@pytest.mark.parametrize("frequency", [0.5, 0.6, 0.8])
@pytest.mark.parametrize("every", [1, 2])
def test_an_arm_that_swings_smoothly_makes_no_steps(frequency, lever, angle, every):
    """As a slow and a usual walker steps, with the sway of one; but no landing jars; at 50 and 25 Hz."""
    t, a = waved(frequency, angle, lever)
    assert len(walking_steps(t[::every], a.reshape(-1, every, 3).mean(axis=1))) == 0


def test_a_walker_is_known_again_at_a_door_and_not_in_a_car():
    """Two single steps within seconds of a walk in its rhythm are steps; a ride on a rough road after it is none."""
    t, a = walking(1.9, 3.0, seconds=30.0)
    still = np.array([0.0, 0.0, 9.81]) + np.random.default_rng(1).normal(0, 0.05, a.shape)
    door = np.where(((t < 20) | ((t > 22.1) & (t < 23.2)) | (t > 25))[:, None], a, still)
    gap = walking_steps(t, door).time
    assert 1 <= np.sum((gap > 21.5) & (gap < 23.8)) <= 3
    ride = in_hand(quarter_car(14.0, 64e-6, seconds=120))[1] @ Rotation.from_euler("x", 17, degrees=True).as_matrix()
    both = np.concatenate([a, ride])
    landed = walking_steps(np.arange(len(both)) / RATE, both).time
    assert np.sum(landed > 32) < 6


@pytest.mark.parametrize("speed", [8.0, 14.0, 30.0])
def test_a_passenger_makes_no_steps(speed):
    """Four minutes on a good road (class A); on a rough one (class C) one step in ten seconds at most."""
    assert len(walking_steps(*in_hand(quarter_car(speed, 16e-6)))) == 0
    assert len(walking_steps(*in_hand(quarter_car(speed, 64e-6, seed=1)))) < 24


def test_a_stop_has_no_steps_and_the_step_after_it_a_usual_duration():
    t, a = walking(2.0, 3.0, seconds=20)
    a[(t > 8) & (t < 13)] = [0, 0, 9.81]
    landings = walking_steps(t, a)
    assert not np.any((landings.time > 8.5) & (landings.time < 12.5))
    after = np.searchsorted(landings.time, 12.5)
    assert landings.period[after] == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize("rate", [3.0, 8.0, 12.0])
def test_low_sampling_rates_and_short_recordings_are_accepted(rate):
    """Below 7 Hz there are no steps, and no error."""
    t, a = walking(1.8, 3.0, rate=rate)
    assert len(walking_steps(t, a)) == (0 if rate < 7 else pytest.approx(54, abs=2))
    assert all(len(walking_steps(t[:count], a[:count])) <= 2 for count in (2, 5, 10))
