"""The exported graph: GTSAM's own optimisers and algebra have the same optimum, covariance and cost."""

import copy
import pickle
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from derivatives import assert_gtsam_agrees, perturbed
from simulated import scenario_walk
from test_factor_equations import beside_beacons
from test_factors import received
from test_ranging import ranged
from walks import drawn_from_the_model, in_corridors

import pdr_graph as pdr
from pdr_graph.estimation.ambiguity.bank import paths, probabilities
from pdr_graph.estimation.ambiguity.plan_hypotheses import joint_solutions
from pdr_graph.estimation.factors.base import Loss, extract
from pdr_graph.estimation.factors.beacon_rssi import levels_along
from pdr_graph.estimation.factors.gtsam_export import FactorError
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.optimizer import fully_optimized, optimize
from pdr_graph.floor.cells import BEACON
from pdr_graph.geometry import differences, nearest, pose_rotation
from pdr_graph.io.tables import drawn_beacons


def minimised(optimizer, params):
    params.setRelativeErrorTol(1e-10)
    return lambda factors, start: optimizer(factors, start, params).optimize()


def incremental(factors, start):
    """By ISAM2, relinearised to the end."""
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(0.0)
    params.relinearizeSkip = 1
    isam = gtsam.ISAM2(params)
    isam.update(factors, start)
    for _ in range(20):
        isam.update()
    return isam.calculateEstimate()


OPTIMISERS = {
    "Gauss-Newton": minimised(gtsam.GaussNewtonOptimizer, gtsam.GaussNewtonParams()),
    "Levenberg-Marquardt": minimised(gtsam.LevenbergMarquardtOptimizer, gtsam.LevenbergMarquardtParams()),
    "dogleg": minimised(gtsam.DoglegOptimizer, gtsam.DoglegParams()),
}


def apart(values, others):
    """Greatest distance between the keyframes of two solutions. [m]"""
    return float(np.hypot(*(extract(values, "x") - extract(others, "x"))[:, :2].T).max())


def assert_stays(estimate, start=None, within=0.02):
    """GTSAM's optimisers end at the estimate's optimum, from there or from ``start``, up to a distance [m]."""
    exported, optimum = estimate.graph.to_gtsam(), estimate.graph.optimal_values()
    for name, method in OPTIMISERS.items():
        assert apart(method(exported, start or optimum), optimum) < within, name


@pytest.mark.parametrize("with_plan", [False, True])
def test_the_demo_with_its_outliers(with_plan):
    """From the optimum; without walls, which are local, from the caller's start as well.

    The caller's own graph has another optimum, more than a metre away.
    """
    graph = demo(with_plan)
    estimate = pdr.smooth(graph)
    assert any("outlier" in fix.reason for fix in estimate.fixes)
    assert_stays(estimate)
    if not with_plan:
        assert_stays(estimate, graph.initial_values())
    before = OPTIMISERS["Levenberg-Marquardt"](graph.to_gtsam(), graph.initial_values())
    assert apart(before, estimate.graph.optimal_values()) > 1.0


@pytest.mark.parametrize("with_fixes", [False, True])
def test_ranges_with_detours(with_fixes):
    steps, fixes, truth = drawn_from_the_model(120, 2)
    ranges, detour = ranged(truth, 2)
    estimate = pdr.smooth(WalkGraph(steps, fixes if with_fixes else None, measurements=[ranges]))
    assert detour.any()
    assert_stays(estimate, within=0.05)  # by ranges alone the optimum is flat


def demo(with_plan):
    """The demo walk: two of its fixes are outliers, and it passes walls."""
    made, steps = scenario_walk("arcade")
    [plan] = made.scenario.plans.values()
    return WalkGraph(steps, made.user_fixes, floor=plan if with_plan else None)


def with_ranges():
    """A walk by ranges, some of which took detours, and fixes."""
    steps, fixes, truth = drawn_from_the_model(120, 2)
    return WalkGraph(steps, fixes, measurements=[ranged(truth, 2)[0]])


WALKS = {
    "demo": lambda: demo(with_plan=False),
    "demo between walls": lambda: demo(with_plan=True),
    "ranges": with_ranges,
    "receiver": received,
    "beacons": beside_beacons,
    "corridors": lambda: in_corridors("turns"),
}


@pytest.mark.parametrize("name", WALKS)
def test_the_stated_covariance_is_that_of_gtsam(name):
    """Poses and calibrations by GTSAM's marginals of each solution; a trajectory's is the mixture of all solutions."""
    graph = WALKS[name]()
    first, *others = joint_solutions(graph)
    optima, estimate = [fully_optimized(first), *others], pdr.smooth(graph)
    row = nearest(estimate.trajectory.time, graph.keyframe_time)
    on_row = np.abs(estimate.trajectory.time[row] - graph.keyframe_time) < 1e-6
    mixture, share = 0.0, probabilities(optima, paths(optima))
    for weight, optimum in zip(share / share.sum(), optima, strict=True):
        marginals, poses = marginals_of(optimum), optimum.state.poses
        R = pose_rotation(poses[:, 2])
        apart = differences(poses, estimate.graph.optimum.poses)
        own = R @ marginals["x"] @ R.transpose(0, 2, 1)
        mixture = mixture + weight * (own + apart[:, :, None] * apart[:, None, :])
    assert estimate.trajectory.covariance[row[on_row]] == pytest.approx(mixture[on_row], rel=1e-3, abs=1e-6)


def marginals_of(optimum):
    """GTSAM's covariances ``(n, 3, 3)`` of the variables of each symbol; all are those of the optimum itself."""
    graph, state = optimum.graph.smoothed(optimum.state), optimum.state
    marginals = gtsam.Marginals(graph.to_gtsam(), graph.optimal_values())
    covariance = {
        symbol: np.array([marginals.marginalCovariance(key) for key in state.keys(symbol).tolist()])
        for symbol, rows in state.arrays.items()
        if len(rows)
    }
    for symbol, theirs in covariance.items():
        ours = optimum.solution.joint((symbol, np.arange(len(theirs))))
        assert ours == pytest.approx(theirs, rel=1e-6, abs=1e-9), symbol
    return covariance


@pytest.mark.thorough
def test_beacons_one_of_which_was_moved():
    """In the mall, without any fix."""
    made, steps = scenario_walk("mall", seed=2)
    [plan] = made.scenario.plans.values()
    listed = drawn_beacons([(area, "") for area in plan.of_kind(BEACON)], made.recording(), 1.0)
    levels = levels_along(made.bluetooth, listed, steps)
    estimate = pdr.smooth(WalkGraph(steps, floor=plan, levels=levels))
    assert estimate.beacons
    assert_stays(estimate)


def test_cost_gradient_and_information_are_ours_under_the_loss_of_ranges():
    """At the optimum and anywhere near it, although the loss has a sign, which GTSAM's losses have not."""
    steps, fixes, truth = drawn_from_the_model(60, 3)
    estimate = pdr.smooth(WalkGraph(steps, fixes, measurements=[ranged(truth, 3)[0]]))
    start = estimate.graph.start
    for state in (start, perturbed(start, "x", 4, 0, 0.1), start.rotated(0.1, np.ones(2))):
        assert_gtsam_agrees(estimate.graph, state)


@pytest.mark.parametrize("method", [OPTIMISERS["Levenberg-Marquardt"], incremental], ids=["at once", "ISAM2"])
def test_gtsam_finds_the_same_walk(method):
    """The same optimum to a millimetre."""
    steps, fixes, _ = drawn_from_the_model(60, seed=5)
    graph = WalkGraph(steps, fixes)
    ours, exported = optimize(graph, graph.start, 1e-12), graph.to_gtsam()
    theirs = method(exported, graph.start.to_values())
    assert ours.cost == pytest.approx(exported.error(theirs), rel=1e-5)
    assert np.hypot(*(ours.state.poses - extract(theirs, "x"))[:, :2].T).max() < 1e-3


class Cauchy(Loss):
    """A loss that is not exported by name, of a factor with two rows: ρ = ln(1 + s²) / 2, w = 1 / (1 + s²)."""

    def weight(self, deviation):
        return 1 / (1 + deviation**2)

    def cost(self, deviation):
        return np.log1p(deviation**2) / 2


class Cubic(Loss):
    """A loss whose weight rises: ρ = |s|³ / 3, w = |s|."""

    def weight(self, deviation):
        return np.abs(deviation)

    def cost(self, deviation):
        return np.abs(deviation) ** 3 / 3


def fixes_under(loss, monkeypatch):
    """The graph of a walk whose fixes have another loss, and a state with a fix far off."""
    from pdr_graph.estimation.factors import fixes as fixes_module

    steps, fixes, _ = drawn_from_the_model(40, 1)
    graph = WalkGraph(steps, fixes)
    monkeypatch.setattr(fixes_module, "RobustLoss", lambda *args, **more: loss)
    made = fixes_module.FactorBlock.uniform
    alone = classmethod(lambda cls, *args, native=None, **more: made(*args, **more))
    monkeypatch.setattr(fixes_module.FactorBlock, "uniform", alone)
    return graph, perturbed(graph.start, "x", 3, 1, 2.0)


def test_a_loss_of_several_rows_that_gtsam_does_not_have(monkeypatch):
    """The norm of a position's two residuals has that loss."""
    assert_gtsam_agrees(*fixes_under(Cauchy(), monkeypatch))


def test_a_loss_whose_weight_rises_is_refused(monkeypatch):
    """No rows have its cost and its weighted information at once."""
    graph, state = fixes_under(Cubic(), monkeypatch)
    with pytest.raises(FactorError, match="weight of a loss rises"):
        graph.to_gtsam().linearize(state.to_values())


def test_only_an_estimate_has_an_optimum():
    steps, fixes, _ = drawn_from_the_model(30, 0)
    graph = WalkGraph(steps, fixes)
    with pytest.raises(ValueError, match="expected smooth"):
        graph.optimal_values()


def test_copies_and_pickles_of_an_estimate_are_without_its_graph():
    """Workers return estimates; everything else is there."""
    steps, fixes, _ = drawn_from_the_model(30, 0)
    estimate = pdr.smooth(WalkGraph(steps, fixes))
    for other in (copy.copy(estimate), pickle.loads(pickle.dumps(estimate))):
        assert other.graph is None
        assert other.cost == estimate.cost
    assert replace(estimate, cost=1.0).graph is estimate.graph


def smoothers():
    """Those of GTSAM that take increments, and how."""
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(0.001)  # [m, rad, 1], since walls begin and end to hold within a centimetre
    params.relinearizeSkip = 1
    params.setFactorization("QR")  # Cholesky takes numbers of other units for indeterminate
    isam = gtsam.ISAM2(params)
    endless, fixed = (gtsam.IncrementalFixedLagSmoother(lag, params) for lag in (1e9, 40.0))
    return {
        "ISAM2": (isam, lambda part: isam.update(part.factors, part.values)),
        "endless lag": (endless, lambda part: endless.update(part.factors, part.values, part.timestamps)),
        "lag of 40 s": (fixed, lambda part: fixed.update(part.factors, part.values, part.timestamps)),
    }


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *(("demo", kind) for kind in ("ISAM2", "endless lag")),
        *(("demo between walls", kind) for kind in ("ISAM2", "endless lag")),
        *(("receiver", kind) for kind in ("ISAM2", "endless lag", "lag of 40 s")),
    ],
)
def test_a_smoother_of_ones_own_that_takes_increments_ends_at_the_optimum(name, kind):
    """The variables that are left are those of `smooth` to 2 cm; without a lag where outliers are still open."""
    graph = pdr.smooth(WALKS[name]()).graph
    smoother, update = smoothers()[kind]
    times = []
    for part in graph.increments():
        update(part)
        times.append(part.time)
    for _ in range(5):  # of what has not left the lag, linearised at the optimum
        smoother.update()
    assert times == sorted(times)
    assert times[-1] == graph.keyframe_time[-1]
    estimate = graph.start.updated(smoother.calculateEstimate())
    assert np.abs(estimate.poses[:, :2] - graph.optimum.poses[:, :2]).max() < 0.02


def test_increments_are_the_whole_graph():
    """Each factor and each variable once."""
    graph = pdr.smooth(beside_beacons()).graph
    parts = list(graph.increments())
    assert sum(part.factors.size() for part in parts) == graph.to_gtsam().size()
    keys = [each for part in parts for each in part.values.keys()]
    assert sorted(keys) == sorted(graph.initial_values().keys())
