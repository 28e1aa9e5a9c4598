"""What the phone feels agrees with its movement, and what it logs has the faults that were asked for."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pdr_graph import detect_steps
from pdr_graph.simulation import sensors
from pdr_graph.simulation.carrying import HOLDS
from pdr_graph.simulation.scenario import Scenario
from pdr_graph.simulation.simulate import simulate

ROUTE = [[0, 0], {"stand": 4}, {"to": [[25, 0], [25, 15]]}, {"stand": 4}]
CARRIED = [hold for hold in HOLDS if hold != "cart"]


def walked(route=ROUTE, seed=1, **phone):
    return simulate(Scenario.of({"seed": seed, "route": route, "phone": {"rate": 100} | phone}))


@pytest.fixture(scope="module", params=CARRIED)
def walk(request):
    return walked(hold=request.param)


def test_integrated_rates_are_the_attitude(walk):
    """Exponentials of the angular rate, one after the other, end at the true attitude."""
    motion = walk.motion
    mean = (motion.angular_rate[:-1] + motion.angular_rate[1:]) / 2 / motion.rate
    turned = Rotation.identity()
    for step in Rotation.from_rotvec(mean):
        turned = turned * step
    truth = motion.R_world_device[0].inv() * motion.R_world_device[-1]
    assert np.degrees((turned.inv() * truth).magnitude()) < 1.0


def test_forces_from_rest_to_rest_add_up_to_gravity_alone(walk):
    """Newton: who stands before and after has been pushed by nothing on average."""
    force = walk.motion.R_world_device.apply(walk.motion.acceleration)
    assert force.mean(axis=0) == pytest.approx([0, 0, 9.80665], abs=0.03)


def test_a_phone_at_rest_feels_gravity(walk):
    rest = (walk.motion.time > 0.5) & (walk.motion.time < 3.0)
    assert np.linalg.norm(walk.motion.acceleration[rest], axis=1) == pytest.approx(9.80665, abs=0.3)


@pytest.mark.parametrize("hold", CARRIED)
def test_a_step_detector_finds_the_steps(hold):
    """Of most people: in a pocket one's every heel strike may count twice, a swinging arm's every stride once."""
    ratios = []
    for seed in range(5):
        walk = walked(hold=hold, seed=seed)
        ratios.append(len(detect_steps(walk.recording("accelerometer", "gyroscope"))) / len(walk.body.landings))
    assert np.median(ratios) == pytest.approx(1, abs=0.06)


def test_an_elliptical_swing_drifts_the_rate_about_the_vertical():
    """Coning: with perfect sensors and attitude, what is integrated about gravity is not the change of heading."""

    def drift(hold):
        drifted = []
        for seed in range(6):
            walk = walked(hold=hold, seed=seed, route=[[0, 0], [60, 0]])
            motion, heading = walk.motion, walk.body.heading
            up = motion.R_world_device.inv().apply([0.0, 0.0, 1.0])
            turned = np.sum(motion.angular_rate * up) / motion.rate
            drifted.append((turned - (heading[-1] - heading[0])) / len(walk.body.landings))
        return np.degrees(np.mean(np.abs(drifted)))

    assert drift("swinging arm") > 3 * drift("hand")


def test_holds_differ_as_real_ones_do():
    """docs/simulation.md: a pocket shocks, an arm and a leg swing, a breast is quiet."""
    felt = {hold: walked(hold=hold).motion for hold in CARRIED}
    turning = {hold: np.median(np.linalg.norm(m.angular_rate, axis=1)) for hold, m in felt.items()}
    shaken = {hold: np.linalg.norm(m.acceleration, axis=1).std() for hold, m in felt.items()}
    assert min(turning["swinging arm"], turning["trouser pocket"]) > 1.5 * turning["hand"]
    assert max(shaken, key=shaken.get) == "trouser pocket"
    assert min(shaken, key=shaken.get) == "swinging arm"


def test_taking_the_phone_otherwise_turns_it_and_then_leaves_it():
    walk = walked([[0, 0], {"stand": 5}, {"hold": "trouser pocket"}, {"stand": 5}])
    begun = walk.body.during("hold")[1].start
    attitude, time = walk.motion.R_world_device, walk.motion.time

    def turned(start, end):
        first, last = np.searchsorted(time, [start, end])
        return np.degrees((attitude[int(first)].inv() * attitude[int(last)]).magnitude())

    assert turned(begun, begun + 1.4) > 60
    assert max(turned(1, begun - 0.1), turned(begun + 1.5, begun + 5)) < 12


def test_shaking_shakes():
    walk = walked([[0, 0], {"stand": 5}, {"shake": 5}, {"stand": 5}])
    (event,) = walk.body.during("shake")
    on = (walk.motion.time > event.start + 1) & (walk.motion.time < event.end - 1)
    rate = np.linalg.norm(walk.motion.angular_rate, axis=1)
    assert rate[on].mean() > 20 * rate[walk.motion.time < event.start - 1].mean()


def test_a_cart_feels_its_own_acceleration():
    """The accelerometer along x, integrated, is the cart's speed."""
    route = [[0, 0], {"stand": 3}, {"roll": [2, 0], "speed": 0.5}, {"stand": 3}]
    walk = simulate(Scenario.of({"route": route, "heading": 0, "phone": {"hold": "cart"}}))
    force = walk.motion.R_world_device.apply(walk.motion.acceleration)
    speed = np.cumsum(force[:, 0]) / walk.motion.rate
    truth = np.gradient(walk.body.position[:, 0]) * walk.motion.rate
    assert np.abs(speed - truth).max() < 0.15


@pytest.mark.parametrize("rate", [25, 50, 100, 200, 400])
def test_any_rate(rate):
    walk = walked([[0, 0], {"to": [10, 0]}], rate=rate, lost=0, repeated=0, jitter=0.0001)
    signal = walk.signals["accelerometer"]
    assert np.median(np.diff(signal.time)) == pytest.approx(1 / rate, rel=0.02)
    assert len(signal) == pytest.approx(rate * walk.body.time[-1], abs=2)


def test_samples_are_lost_and_repeated_as_often_as_asked():
    time = walked(lost=0.05, repeated=0.03).signals["gyroscope"].time
    steps = np.diff(time)
    assert np.mean(steps == 0) == pytest.approx(0.03, abs=0.008)
    assert np.mean(steps > 0.017) == pytest.approx(0.05, abs=0.012)


def test_a_sensor_ends_at_its_range_and_speaks_in_its_steps():
    still = walked([[0, 0], {"stand": 60}]).motion
    hit = replace(still, acceleration=still.acceleration * 50)
    signal = sensors.imu(hit, sensors.Clock(), np.random.default_rng(0))["accelerometer"]
    assert np.abs(signal.values).max() == 78.4
    inside = signal.values[np.abs(signal.values) < 78]
    assert np.abs(inside / 0.0024 - np.round(inside / 0.0024)).max() < 1e-6


def test_a_phone_that_warms_up_drifts():
    """Over a quarter of an hour the mean of a resting gyroscope moves by more than its noise explains."""
    moved = []
    for seed in range(8):
        values = walked([[0, 0], {"stand": 900}], seed=seed, hold="cart", rate=25).signals["gyroscope"].values
        moved.append(values[-1000:].mean(axis=0) - values[:1000].mean(axis=0))
    assert 0.0003 < np.std(moved) < 0.003  # [rad/s]; 0.0022 of noise leaves 0.00005


def test_the_magnetic_field_is_the_places():
    """As the World Magnetic Model has it, but for the sensor and a little steel."""
    given = {"route": [[0, 0], [5, 0]], "place": [11.08, 49.45], "phone": {"disturbance": 0.5}}
    walk = simulate(Scenario.of(given))
    field = walk.signals["magnetometer"].values
    assert np.linalg.norm(field, axis=1).mean() == pytest.approx(48.9, abs=8.0)


def test_a_place_disturbs_the_field_for_everyone_alike():
    """Two walkers on the same cart track feel the same steel, but for their own sensors' bias."""
    route = [[0, 0], {"roll": [30, 0], "speed": 1.0}]

    def felt(seed, disturbance):
        phone = {"hold": "cart", "disturbance": disturbance}
        walk = simulate(Scenario.of({"seed": seed, "heading": 0, "route": route, "phone": phone}))
        signal = walk.signals["magnetometer"]
        level = np.stack([np.interp(np.arange(2, 28, 0.2), signal.time, axis) for axis in signal.values.T])
        return level - level.mean(axis=1, keepdims=True)

    one, other, quiet = felt(1, 8.0), felt(2, 8.0), felt(1, 0.0)
    assert np.corrcoef(one.ravel(), other.ravel())[0, 1] > 0.95
    assert one.std() > 5 > 1 > quiet.std()


def test_a_storey_is_half_a_hectopascal():
    """12.0 Pa per metre near the sea, by the barometric formula at 15 °C."""
    route = [[0, 0], {"stand": 20}, {"lift": "2", "climb": 3.8}, {"stand": 20}]
    fell = []
    for seed in range(10):
        signal = walked(route, seed=seed).signals["barometer"]
        low, high = signal.time < 19, signal.time > signal.time[-1] - 19
        fell.append(signal.values[low].mean() - signal.values[high].mean())
    assert np.mean(fell) == pytest.approx(3.8 * 0.120, abs=0.03)
