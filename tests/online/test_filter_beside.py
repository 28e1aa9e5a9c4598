"""The Kalman filter beside the smoother: the batch's filter, step by step, and what is said where both disagree."""

from dataclasses import replace

import numpy as np
import pytest
from tiers import thorough
from walks import PERIOD, drawn_from_the_model, part, wandering_walk

from pdr_graph import Fixes, Navigator, Prior, kalman_filter
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.kalman import HELD_BACK, KalmanFilter
from pdr_graph.geometry import dead_reckon, interpolate, wrap_angle
from pdr_graph.online.filter_beside import SUSTAINED, disagree


def gnss(steps, truth, seed, every=1.0, sigma=3.0):
    """Fixes of one receiver."""
    time = np.arange(0.4, steps.end, every)
    place = interpolate(time, truth.time, truth.position)
    place += np.random.default_rng(seed).normal(0, sigma, place.shape)
    return Fixes(time, place, np.full(len(time), sigma), ("GNSS",) * len(time))


def pushing(target, steps, fixes, late=0.0):
    """Push a walk step by step, each fix so ``late`` [s]; yields after each step."""
    add, arrival = getattr(target, "add_fixes", None) or target.push, fixes.time + late
    extend, before = getattr(target, "extend", None) or target.push, -np.inf
    for n in range(len(steps)):
        chunk = part(steps, n, n + 1)
        extend(chunk)
        for f in np.flatnonzero((arrival > before) & (arrival <= chunk.end)):
            add(fixes[int(f)])
        before = chunk.end
        yield


@pytest.mark.parametrize("late", [0.0, HELD_BACK - PERIOD])
@pytest.mark.parametrize("seed", range(3))
def test_a_walk_pushed_live_has_the_poses_of_the_batch_filter(seed, late):
    """At every step that both have followed, also over a change of calibration, and with fixes that come late."""
    steps, sparse, truth = drawn_from_the_model(230, seed)
    fixes = gnss(steps, truth, seed) if seed else sparse
    live, batch, rows = KalmanFilter(Prior()), kalman_filter(WalkGraph(steps, fixes)).trajectory, 0
    for _ in pushing(live, steps, fixes, late):
        row = np.flatnonzero(np.abs(batch.time - live.time) < 1e-6)
        if not len(row) or not live.located:
            continue
        mean, covariance = live.state
        assert mean[:2] == pytest.approx(batch.position[row[0]], abs=1e-9)
        assert wrap_angle(mean[2] - batch.heading[row[0]]) == pytest.approx(0, abs=1e-9)
        assert covariance[:3, :3] == pytest.approx(batch.covariance[row[0]], abs=1e-8)
        rows += 1
    assert rows > 50
    assert live.skipped == 0
    if not late:  # else the last fixes have not come
        assert live.present().state[0][:2] == pytest.approx(batch.position[-2], abs=1e-9)


def test_a_fix_that_comes_too_late_is_skipped_and_counted():
    steps, fixes, _ = drawn_from_the_model(120, seed=2)
    live = KalmanFilter(Prior())
    for _ in pushing(live, steps, fixes, late=3 * HELD_BACK):
        pass
    assert live.skipped > 0
    assert not live.located or live.skipped + live._fixes == len(fixes)


def test_a_heading_of_earlier_steps_is_carried_on_by_the_turns():
    """Pushed 20 s late it gives the direction that it gives in its time, but for the calibration of the gyroscope."""
    steps = wandering_walk(120, seed=4)
    truth = dead_reckon(steps, heading=0.7)
    live = KalmanFilter(Prior())
    live.add_fixes(Fixes(np.array([0.0]), np.zeros((1, 2)), np.array([1.0]), ("",)))
    for n in range(len(steps)):
        live.extend(part(steps, n, n + 1))
        if n == 80:
            live.add_heading(float(steps.time[44]), float(truth.heading[45]), 0.05)
    mean, covariance = live.present().state
    assert abs(wrap_angle(mean[2] - truth.heading[-2])) < 0.05
    assert covariance[2, 2] < 0.4**2


def test_the_memory_of_the_filter_does_not_grow():
    steps, _, truth = drawn_from_the_model(800, seed=3)
    live, sizes = KalmanFilter(Prior()), []
    for _ in pushing(live, steps, gnss(steps, truth, 3)):
        history = sum(len(source.drifts) for source in live._sources.values())
        sizes.append(len(live._waiting) + len(live._held) + len(live._turned) + history + len(live.mixture))
    assert max(sizes[400:]) <= 1.2 * max(sizes[100:400])


def test_two_positions_disagree_only_where_each_is_outside_the_region_of_the_other():
    random = np.random.default_rng(0)
    for _ in range(200):
        a, b, A, B = random.normal(0, 4, 2), random.normal(0, 4, 2), *random.normal(size=(2, 2, 2))
        P_a, P_b = A @ A.T + 0.1 * np.eye(2), B @ B.T + 0.1 * np.eye(2)
        if disagree(a, P_a, b, P_b):
            assert min((a - b) @ np.linalg.solve(P, a - b) for P in (P_a, P_b)) > 9.21


def test_positions_without_errors_disagree_where_they_differ():
    """Two covariances of zero have no inverse."""
    place, none = np.array([1.0, 2.0]), np.zeros((2, 2))
    assert not disagree(place, none, place, none)
    assert disagree(place, none, place + 0.01, none)


def followed(nav, steps, fixes):
    """The issues of the status after every tenth step, those about the filter."""
    steps_so_far = enumerate(pushing(nav, steps, fixes))
    return [[line for line in nav.status.issues if "Kalman filter" in line] for n, _ in steps_so_far if n % 10 == 0]


OTHERS = [thorough(seed) for seed in range(1, 10)]


@pytest.mark.parametrize("seed", [0, *OTHERS])
def test_nothing_is_said_of_an_honest_walk(seed):
    steps, _, truth = drawn_from_the_model(180, seed)
    nav = Navigator(lag=30.0, executor=None)
    assert not any(followed(nav, steps, gnss(steps, truth, seed)))
    pose, filtered = nav.pose, nav.filtered
    assert filtered.time == pose.time
    assert np.hypot(filtered.x - pose.x, filtered.y - pose.y) < 5
    assert filtered.covariance.shape == (3, 3)
    estimate = nav.finish()
    assert not any("Kalman filter" in line for line in estimate.warnings)


def test_a_filter_that_goes_elsewhere_is_said_with_distance_and_time():
    """The filter is turned by 2 rad in the midst of the walk, and no later fix corrects it."""
    steps, _, truth = drawn_from_the_model(230, seed=1)
    fixes = gnss(steps, truth, 1)
    fixes = fixes[fixes.time < 40]
    nav, said = Navigator(executor=None), []
    for n, _ in enumerate(pushing(nav, steps, fixes)):
        if n == 80:
            away = nav._filter.filter
            mean = away.mixture.mean.copy()
            mean[:, 2] += 2.0
            away.moment = replace(away.moment, posterior=replace(away.mixture, mean=mean))
        said.append(nav._filter.issues())
    assert set(said[-1]) <= set(nav.status.issues)
    first = next(n for n, lines in enumerate(said) if lines)
    assert steps.time[first] - steps.time[80] >= SUSTAINED
    assert " m away since " in said[first][0]
    assert any(doubt.source == "filter" for doubt in nav.status.verdict.reasons)
