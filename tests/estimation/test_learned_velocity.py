"""The network as a witness: it corrects a wrong direction of the steps, and a network that lies bends no walk."""

from dataclasses import replace
from functools import cache

import learned_nets
import numpy as np
import pytest

from pdr_graph import WalkGraph, detect_steps, smooth, verdict
from pdr_graph.apps.report.evaluation import circular_error, in_region, pair, stated_covariance
from pdr_graph.gait.heading import forward_axis
from pdr_graph.gait.learned import Network, learned_velocities, windows_of
from pdr_graph.gait.steps import gait_signals
from pdr_graph.geometry import as_points, interpolate
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Fixes

ROUTE = [[0, 0], [20, 0], [20, 15], [0, 15], [0, 4], [22, 4], [22, -10]]
FLIP = np.radians(90), 35.0, 47.0  # [rad], [s], [s] by which the steps' direction is wrong, from when to when


@cache
def walked(seed):
    """The gait signals and the truth of a walk of 1.5 minutes with a phone in the pocket."""
    turned = [[x, y if seed % 2 else -y] for x, y in ROUTE]
    route = [turned[0], {"stand": 2}, {"hold": "trouser pocket"}, {"to": turned[1:]}]
    walk = simulate(Scenario.of({"seed": seed, "route": route, "phone": {"rate": 50}}))
    return gait_signals(walk.recording("accelerometer", "gyroscope")), walk.truth


@cache
def weights():
    """A network that is fitted to two other walks, with their velocities in the frames of their gyroscopes."""
    every = []
    for seed in (11, 12):
        [gait], truth = walked(seed)
        time, windows = windows_of(gait.attitude)
        before, after = (interpolate(time + each, truth.time, truth.position) for each in (-0.5, 0.5))
        course = np.interp(time, gait.attitude.time, gait.direction.heading)
        ahead = forward_axis(gait.attitude, gait.direction.heading, gait.walking, gait.landings.usual_step).angle
        every.append((windows, as_points(np.hypot(*(after - before).T) * np.exp(1j * (course + ahead)))))
    return learned_nets.fitted(*(np.concatenate(columns) for columns in zip(*every, strict=True)))


def velocities_of(gaits, path, **lie):
    network = Network(learned_nets.write_network(path, weights(), **lie))
    return learned_velocities([gait.attitude for gait in gaits], network)[0]


def flipped(steps, angle=FLIP[0], begin=FLIP[1], end=FLIP[2]):
    """Steps whose direction is wrong for a while, as if the phone was turned in the hand unnoticed."""
    turn = steps.turn.copy()
    turn[np.searchsorted(steps.time, begin)] += angle
    turn[np.searchsorted(steps.time, end)] -= angle
    return replace(steps, turn=turn)


def scored(graph, truth):
    """The estimate, its mean error [m], and the share of the truth in its region."""
    estimate = smooth(graph)
    pairs = pair(estimate.trajectory, truth[::50])
    inside = in_region(pairs, stated_covariance(estimate.trajectory, pairs.time))
    return estimate, float(circular_error(pairs).mean()), float(inside.mean())


def started(truth):
    """Fixes at the start, and 20 s later."""
    time = truth.time[0] + np.array([1.0, 20.0])
    return Fixes(time, interpolate(time, truth.time, truth.position), np.full(2, 0.3))


def test_a_small_network_fitted_to_two_walks_knows_the_speed_and_course_of_a_third(tmp_path):
    [gait], truth = walked(13)
    found = velocities_of([gait], tmp_path / "net.onnx")
    walking = (found.time > 6) & (found.time < truth.time[-1] - 3)
    place = interpolate(found.time, truth.time, truth.position)
    true = np.gradient(place[:, 0] + 1j * place[:, 1], found.time)
    ratio = (found.velocity[:, 0] + 1j * found.velocity[:, 1])[walking] / true[walking]
    assert 0.8 < abs(np.median(ratio.real) + 1j * np.median(ratio.imag)) < 1.2
    assert np.degrees(np.median(np.abs(np.angle(ratio / np.median(ratio))))) < 20


def test_it_corrects_steps_whose_direction_is_wrong_for_a_while(tmp_path):
    gaits, truth = walked(13)
    steps, fixes = flipped(detect_steps(gaits)), started(truth)
    _, error, inside = scored(WalkGraph(steps, fixes), truth)
    assert error > 4, "a control"
    assert inside < 0.7, "a control"
    table = velocities_of(gaits, tmp_path / "net.onnx")
    estimate, with_network, region = scored(WalkGraph(steps, fixes, measurements=[table]), truth)
    assert with_network < 0.5 * error
    assert region > 0.85
    assert not verdict(estimate).ok
    assert any("step direction" in each.text or "network" in each.text for each in estimate.contradictions)


LIES = {
    "turned by 90 degrees": {"turn": np.pi / 2},
    "zero": {"scale": 0.0},
    "half": {"scale": 0.5},
    "constant": {"scale": 0.0, "offset": (1.0, 0.5)},
    "reversed": {"scale": -1.0},
}


@pytest.mark.parametrize("lie", ["", *LIES])
def test_a_network_bends_no_walk_whether_it_lies_or_not(lie, tmp_path):
    """A turned frame is estimated and does no harm; the others are not used, and the verdict says it."""
    gaits, truth = walked(13)
    steps, fixes = detect_steps(gaits), started(truth)
    _, error, _ = scored(WalkGraph(steps, fixes), truth)
    table = velocities_of(gaits, tmp_path / "net.onnx", **LIES.get(lie, {}))
    estimate, with_network, region = scored(WalkGraph(steps, fixes, measurements=[table]), truth)
    assert with_network < 1.25 * error + 0.3
    assert region > 0.85
    said = [each.text for each in verdict(estimate).reasons if each.source == "network"]
    assert (said == []) == (lie in ("", "turned by 90 degrees", "reversed")), said


def test_a_network_that_is_not_used_leaves_the_walk_as_it_is(tmp_path):
    gaits, truth = walked(13)
    steps, fixes = detect_steps(gaits), started(truth)
    table = velocities_of(gaits, tmp_path / "net.onnx", scale=0.0)
    without, unused = smooth(WalkGraph(steps, fixes)), smooth(WalkGraph(steps, fixes, measurements=[table]))
    off = interpolate(without.trajectory.time, unused.trajectory.time, unused.trajectory.position)
    assert np.abs(off - without.trajectory.position).max() < 0.1
