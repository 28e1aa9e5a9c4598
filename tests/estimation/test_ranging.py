"""Ranges to anchors: without line of sight errors are long and never short, and an anchor's bias is estimated."""

from dataclasses import replace

import numpy as np
import pytest
from tiers import thorough
from walks import dead_reckon, drawn_from_the_model, pushed, steps_of

from pdr_graph.apps.report.evaluation import coverage
from pdr_graph.estimation.ambiguity.path_modes import solutions
from pdr_graph.estimation.factors.ranging import LongErrors, RangeFactor
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.estimation.smoother import smooth
from pdr_graph.geometry import interpolate
from pdr_graph.priors import RANGES
from pdr_graph.types import Ranges

SIGMA, NLOS, DETOUR = 0.3, 0.2, 3.0  # [m], share, [m]
ANCHOR_SIGMA = 0.1  # [m]


def ranged(truth, seed, bias=(0.0, 0.0, 0.0, 0.0), nlos=NLOS):
    """Ranges at 1 Hz to four anchors about a walk, a share of them with a detour."""
    random = np.random.default_rng(seed)
    (west, south), (east, north) = truth.position.min(axis=0) - 5, truth.position.max(axis=0) + 5
    anchors = np.array([[west, south], [west, north], [east, north], [east, south]])
    rows = []
    for m, anchor in enumerate(anchors):
        times = np.arange(truth.time[0] + 0.5 + 0.1 * m, truth.time[-1])
        for time, place in zip(times.tolist(), interpolate(times, truth.time, truth.position), strict=True):
            detour = DETOUR if random.random() < nlos else 0.0
            rows.append((time, m, np.hypot(*(place - anchor)) + bias[m] + random.normal(0, SIGMA) + detour, detour))
    time, anchor, distance, detour = np.array(sorted(rows)).T
    n, label = len(time), tuple(f"A{m}" for m in range(4))
    sigma, survey = np.full(n, SIGMA), np.full(4, ANCHOR_SIGMA)
    ranges = Ranges(time, anchor.astype(np.intp), np.maximum(distance, 0.0), sigma, label, anchors, survey)
    return ranges, detour > 0


def off(trajectory, truth):
    """Distances from the truth [m]."""
    return np.hypot(*(interpolate(truth.time, trajectory.time, trajectory.position) - truth.position).T)


def test_a_walk_by_ranges_alone_is_right_and_honest():
    """No fix, no plan: 0.3 m noise and one range in five 3 m too long. Asked: CE50 0.3 m, 85 to 95 % inside."""
    errors, inside = [], []
    for seed in range(6):
        steps, _, truth = drawn_from_the_model(120, seed)
        track = smooth(WalkGraph(steps, measurements=[ranged(truth, seed)[0]])).trajectory
        errors.append(off(track, truth))
        inside.append(coverage(track, truth))
    assert np.median(errors) < 0.3
    assert 0.85 < np.mean(inside) < 0.97


@pytest.mark.parametrize("late", [-2.0, 2.0])
def test_a_clock_that_is_off_does_not_shift_the_walk(late):
    """Ranges of another device, whose clock is 2 s early or late, on a walk with many turns."""
    turn = np.where(np.arange(200) % 15 == 14, np.random.default_rng(0).choice([-1, 1], 200) * np.pi / 2, 0.0)
    steps = steps_of(np.full(200, 0.7), turn)
    truth = dead_reckon(steps)
    ranges = ranged(truth, 0)[0]
    track = smooth(WalkGraph(steps, measurements=[replace(ranges, time=ranges.time + late)])).trajectory
    assert np.median(off(track, truth)) < 0.4
    assert coverage(track, truth) > 0.85


def test_a_symmetric_loss_is_worse(monkeypatch):
    """Control: with Huber's loss the detours pull the walk away."""
    steps, _, truth = drawn_from_the_model(120, 1)
    graph = WalkGraph(steps, measurements=[ranged(truth, 1)[0]])
    one_sided = np.median(off(smooth(graph).trajectory, truth))
    monkeypatch.setattr(RangeFactor, "refined", lambda self, at: self)
    assert np.median(off(smooth(graph).trajectory, truth)) > 1.2 * one_sided


def test_reports_identify_detours():
    """Nine in ten ranges with a 3 m detour, ten sigmas, are said to have no line of sight, and few of the others."""
    steps, _, truth = drawn_from_the_model(120, 2)
    ranges, detour = ranged(truth, 2)
    reports = smooth(WalkGraph(steps, measurements=[ranges])).reports["ranges"]
    reported = np.array(["no line of sight" in one.reason for one in reports])
    assert reported[detour].mean() > 0.9
    assert reported[~detour].mean() < 0.03


def test_an_anchors_bias_is_estimated():
    """One anchor measures 0.4 m too long throughout, almost three of its prior sigmas: more than half is found."""
    steps, _, truth = drawn_from_the_model(150, 3)
    ranges, _ = ranged(truth, 3, bias=(0.0, 0.4, 0.0, 0.0), nlos=0.0)
    graph = WalkGraph(steps, measurements=[ranges])
    bias = solutions(graph)[0].state[RangeFactor.symbol][:, 2]
    assert 0.2 < bias[1] < 0.5
    assert np.abs(bias[[0, 2, 3]]).max() < 0.1


def test_long_errors_cost_little_and_short_ones_huber_loss():
    """The cost rises on both sides, is steeper for ranges too short, and its slope is w(s) s everywhere."""
    deviation = np.linspace(-15, 15, 301)
    loss = LongErrors(np.full(301, RANGES.detour / SIGMA))
    cost, weight = loss.cost(deviation), loss.weight(deviation)
    assert cost[150] == pytest.approx(0.0, abs=1e-9)
    assert (np.diff(cost[150:]) > 0).all()
    assert (np.diff(cost[:150]) < 1e-9).all()
    assert cost[100] < 0.5 * cost[200]
    assert 0 < weight[0] < 0.01
    assert weight[200] == pytest.approx(2.45 / deviation[200])
    slope = (loss.cost(deviation + 1e-5) - loss.cost(deviation - 1e-5)) / 2e-5
    assert weight * deviation == pytest.approx(slope, abs=1e-4)


@pytest.mark.parametrize(("lag", "near"), [(20.0, 0.3), thorough(np.inf, 0.2)])
def test_ranges_work_live(lag, near):
    """The same object in the live smoother: near the batch at each end of a lag of 20 s, and within iSAM2's thresholds
    with none.
    """
    steps, _, truth = drawn_from_the_model(120, 5)  # with turns that determine the lag of the clock
    steps = replace(steps, end=float(steps.time[-1]))
    ranges, _ = ranged(truth, 5)
    batch = smooth(WalkGraph(steps, measurements=[ranges])).trajectory
    live = pushed(LiveSmoother(lag=lag), steps, ranges)
    assert live.sure
    rows = live.output.rows()
    there = interpolate(rows.time, batch.time, batch.position)
    assert np.median(np.hypot(*(there - rows.pose[:, :2]).T)) < near
