"""Simulated pedestrians have the published statistics of strides."""

import numpy as np
import pytest

from pdr_graph.lab.simulation.body import MANNERS, Pedestrian, footfalls, walk_path
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate

CROWD = [Pedestrian.sample(np.random.default_rng(seed)) for seed in range(400)]


def correlation(first, second):
    return np.corrcoef([first(w) for w in CROWD], [second(w) for w in CROWD])[0, 1]


def on_a_straight(manner="normal", seed=0, length=200.0):
    random = np.random.default_rng(seed)
    path = walk_path(np.array([[0, 0], [length, 0]]), np.zeros(2), np.zeros(1), random)
    return footfalls(CROWD[seed], path, lambda s: MANNERS[manner], random), path


def test_tall_people_take_longer_and_fewer_steps():
    assert correlation(lambda w: w.height, lambda w: w.step_length) > 0.3
    assert correlation(lambda w: w.height, lambda w: w.cadence) < -0.1
    assert correlation(lambda w: w.cadence, lambda w: w.step_length) > 0.3


def test_a_stated_height_and_sex_are_used():
    walker = Pedestrian.sample(np.random.default_rng(0), height=1.5, sex="f")
    assert (walker.height, walker.sex) == (1.5, "f")


def test_people_walk_at_published_speeds():
    """Comfortable gait speed of adults: 1.2–1.5 m/s on average (Bohannon 1997), nearly all within 0.9–1.9."""
    speed = np.array([w.step_length * w.cadence for w in CROWD])
    assert 1.2 < speed.mean() < 1.5
    assert np.mean((speed > 0.9) & (speed < 1.9)) > 0.97


@pytest.mark.parametrize(("manner", "speed", "cadence"), [("jog", 2.4, 2.6), ("run", 3.2, 2.75), ("sprint", 4.4, 3.1)])
def test_runs_have_published_cadences_and_fly(manner, speed, cadence):
    """Cavagna et al. 1988, 2005. A hand weighs nothing in flight, and its mean force is the weight."""
    falls, path = zip(*[on_a_straight(manner, seed) for seed in range(20)], strict=True)
    assert np.mean([p.length / f.time[-1] for f, p in zip(falls, path, strict=True)]) == pytest.approx(speed, rel=0.06)
    assert np.mean([len(f.time) / f.time[-1] for f in falls]) == pytest.approx(cadence, rel=0.04)
    route = [[0, 0], {"stand": 2}, {"to": [[100, 0]], "manner": manner}, {"stand": 2}]
    walk = simulate(Scenario.of({"route": route, "phone": {"hold": "breast pocket"}}))
    under_way = walk.body.flight > 0.2
    up = walk.motion.R_world_device.apply(walk.motion.acceleration)[under_way, 2]
    assert np.mean(up < 0.25 * 9.81) > 0.15
    assert np.mean(up) == pytest.approx(9.81, rel=0.03)
    assert np.percentile(up, 95) > 2 * 9.81


def test_steps_vary_as_published():
    """Hausdorff 2005: step time by 2–3 %, step length by 3–6 % from one to the next."""
    falls = [on_a_straight(seed=seed)[0] for seed in range(20)]
    time = [np.diff(f.time)[3:-3] for f in falls]
    length = [np.diff(f.along)[3:-3] for f in falls]
    change = [[np.std(np.diff(v)) / np.sqrt(2) / v.mean() for v in values] for values in (time, length)]
    assert 0.02 < np.mean(change[0]) < 0.04
    assert 0.03 < np.mean(change[1]) < 0.06


def test_steps_add_up_to_the_path_and_the_feet_close():
    falls, path = on_a_straight()
    assert falls.along[-1] == pytest.approx(path.length)
    lengths = np.diff(falls.along)
    assert lengths[-1] < 1.5 * np.median(lengths), "the last step is no leap"
    assert np.all(np.diff(falls.time) > 0.3)


def test_steps_shorten_in_turns_by_the_papers_rate():
    """[map-matching] Eq. (2): 1.124 % per degree of a step's turn; a circle of 3 m turns by 13° per step."""
    angle = np.linspace(0, 40 * np.pi, 4000)
    circle = 3 * np.column_stack([np.cos(angle), np.sin(angle)])
    path = walk_path(circle, np.zeros(4000), np.zeros(3999), np.random.default_rng(0))
    for seed in range(3):
        turning = footfalls(CROWD[seed], path, lambda s: MANNERS["normal"], np.random.default_rng(seed))
        shortened = np.median(np.diff(turning.along)) / CROWD[seed].step_length
        turned = np.degrees(CROWD[seed].step_length / 3)
        assert shortened == pytest.approx(1 - 0.01124 * turned, abs=0.03)


def test_browsing_steps_are_shorter_than_the_cadence_suggests():
    """[lifelog]: by a factor of 1.2 to 1.4, which is the error of a stride model that uses the cadence only."""
    walking, browsing = on_a_straight()[0], on_a_straight("browse")[0]
    ratio = [np.median(np.diff(f.along)) * np.median(np.diff(f.time)) for f in (walking, browsing)]
    assert 1.2 < ratio[0] / ratio[1] < 1.45
