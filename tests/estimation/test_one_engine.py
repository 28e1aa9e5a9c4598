"""Batch and live smoother are one engine: with all of a walk in the window they find the same walk."""

from dataclasses import replace

import numpy as np
import pytest
from plans import ring
from tiers import thorough
from walks import (
    dead_reckon,
    drawn_beside_beacons,
    drawn_from_the_model,
    drawn_with_a_receiver,
    fixes_on,
    pushed,
    square_walk,
)

from pdr_graph import smooth
from pdr_graph.estimation.factors.base import RobustLoss
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.linear_system import NormalEquations
from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.floor.building import Building
from pdr_graph.geometry import interpolate, wrap_angle
from pdr_graph.types import Headings

ROUNDS = 40


def plain(seed):
    steps, fixes, _ = drawn_from_the_model(120, seed)
    return steps, [fixes], None


def with_outliers(seed):
    steps, fixes, _ = drawn_from_the_model(150, seed)
    far = np.where(np.arange(len(fixes)) % 5 == 3, 40.0, 0.0)
    return steps, [replace(fixes, position=fixes.position + far[:, None])], None


def with_headings(seed):
    steps, fixes, truth = drawn_from_the_model(120, seed, every=40)
    time = np.arange(4.0, 60.0, 11.0)
    turned = interpolate(time, truth.time, np.unwrap(truth.heading)[:, None])[:, 0]
    heading = turned + np.random.default_rng(seed).normal(0, 0.2, len(time))
    return steps, [fixes, Headings(time, wrap_angle(heading), np.full(len(time), 0.2))], None


def with_a_receiver(seed):
    steps, fixes, _ = drawn_with_a_receiver(120, seed)
    return steps, [fixes], None


def with_beacons(seed):
    steps, fixes, levels, _ = drawn_beside_beacons(120, seed)
    return steps, [fixes, levels], None


def on_a_plan(seed):
    steps = square_walk(20, laps=2)
    random = np.random.default_rng(seed)
    truth = dead_reckon(steps)
    measured = replace(steps, length=steps.length * 1.05, turn=steps.turn + random.normal(0, 0.02, len(steps)))
    return measured, [fixes_on(truth, every=15, sigma=1.5, seed=seed)], ring()


def on_a_plan_with_a_receiver(seed):
    steps, [fixes], floor = on_a_plan(seed)
    return steps, [replace(fixes, source=("GNSS",) * len(fixes))], floor


def started(floor, lag=np.inf):
    return LiveSmoother(lag=lag, plan=None if floor is None else Building.around(floor))


def from_batch(estimate, other):
    """Greatest distance [m] between the tracks of two estimates."""
    first, second = estimate.trajectory, other.trajectory
    assert first.time == pytest.approx(second.time, abs=2e-6)
    return float(np.hypot(*(first.position - second.position).T).max())


WALKS = [plain, with_outliers, with_headings, with_a_receiver, with_beacons, on_a_plan, on_a_plan_with_a_receiver]
ONE_HALF, OTHER_HALF = WALKS[::2], WALKS[1::2]


@pytest.mark.parametrize(
    ("drawn", "size"),
    [(plain, 120), *((drawn, 1) for drawn in ONE_HALF), *((thorough(drawn, 1)) for drawn in OTHER_HALF)],
)
def test_a_finished_live_walk_equals_the_batch(drawn, size):
    """The track to a millimetre, with covariance, cost, calibration and all reports; also by one chunk."""
    steps, data, floor = drawn(1)
    live = pushed(started(floor), steps, *data, size=size)
    live.finish()
    batch = smooth(WalkGraph.of(steps, data, floor=floor))
    assert live.final is not None
    assert from_batch(batch, live.final) < 1e-3
    assert live.final.trajectory.covariance == pytest.approx(batch.trajectory.covariance, rel=1e-3, abs=1e-6)
    assert live.final.cost == pytest.approx(batch.cost, rel=1e-5)
    assert live.final.calibration.value == pytest.approx(batch.calibration.value, abs=1e-5)
    assert live.final.reports.keys() == batch.reports.keys()
    assert [report.reason for report in live.final.fixes] == [report.reason for report in batch.fixes]
    assert live.final.warnings == batch.warnings


def relinearized(live):
    """The search goes on until nothing moves; the association is as it was."""
    graph = live.graph
    graph.solve(ROUNDS)
    return graph.at


def optimum(at):
    """Gauss–Newton over the blocks of an evaluation, with a line search, to convergence."""
    for _ in range(ROUNDS):
        move = NormalEquations(at).assembled(at).step()
        candidate = at.chain.evaluate(at.state.retracted(move), at.measurements, at.priors)
        longest = np.inf
        while candidate.cost > at.cost and longest > 1e-6:
            longest = 0.5 * min(longest, 2.0)
            candidate = at.chain.evaluate(at.state.retracted(move, longest), at.measurements, at.priors)
        if np.abs(candidate.state.poses[:, :2] - at.state.poses[:, :2]).max() < 1e-7:
            return candidate
        at = candidate
    return at


@pytest.mark.parametrize("drawn", [*OTHER_HALF, *map(thorough, ONE_HALF)])
def test_the_window_reaches_the_optimum_of_its_factors(drawn):
    """It equals Gauss–Newton over the same blocks in cost, and to 15 cm where sigmas are metres: iSAM2 linearises a
    factor anew where a variable has moved beyond its threshold.
    """
    steps, data, floor = drawn(0)
    live = pushed(started(floor), steps, *data)
    at = relinearized(live)
    best = optimum(at)
    assert best.cost == pytest.approx(at.cost, rel=1e-4, abs=1e-4), "where the search ends"
    assert np.abs(best.state.poses[:, :2] - at.state.poses[:, :2]).max() < 0.15
    assert wrap_angle(best.state.poses[:, 2] - at.state.poses[:, 2]) == pytest.approx(0, abs=3e-3)
    assert best.state.c == pytest.approx(at.state.c, abs=3e-3)


def test_the_optimum_is_that_of_these_factors_alone():
    """Control: with the sigmas of all fixes halved it lies elsewhere."""
    steps, [fixes], floor = with_outliers(0)
    at = relinearized(pushed(started(floor), steps, fixes))
    surer = relinearized(pushed(started(floor), steps, replace(fixes, sigma=fixes.sigma / 2)))
    assert np.abs(optimum(surer).state.poses[:, :2] - at.state.poses[:, :2]).max() > 0.05


def test_the_windows_factors_are_those_of_the_batch():
    """As many rows of every kind, with the same losses; calibration segments and keyframes lie elsewhere."""
    steps, data, _ = with_a_receiver(0)
    live = pushed(started(None), steps, *data)
    batch = WalkGraph.of(steps, data)
    refined = batch.refined(batch.evaluate(batch.start))
    again = refined.evaluate(refined.start)
    for name in ("fixes", "gnss_bias.begin"):
        [one], [other] = (at.blocks_of(name)[:1] for at in (live.graph.at, again))
        assert len(one) == len(other)
        assert isinstance(one.loss, RobustLoss) == isinstance(other.loss, RobustLoss)
