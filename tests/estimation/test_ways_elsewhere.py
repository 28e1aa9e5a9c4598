"""Particles beside a walk under way that are not where its graph is: they widen what is stated, and move nothing."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from walks import PERIOD, fixes_at, steps_of

from pdr_graph import FloorPlan, Prior
from pdr_graph.estimation.kalman import GaussianMixture
from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.estimation.live.particles import ParallelParticleFilter, ways_elsewhere
from pdr_graph.estimation.particle_filter import Paths
from pdr_graph.floor.building import Building
from pdr_graph.floor.cells import Area
from pdr_graph.frames import Frame
from pdr_graph.priors import LIVE_PATHS

STRIDE, Y = 0.7, 1.0  # [m] of a step; y of the middle of the aisle


def hall():
    """A hall of 100 m by 40 m."""
    area = Area("floor", "", shapely.box(-2, -20, 100, 20))
    return Building.around(FloorPlan("1", (area,), Frame()))


def walked():
    """A certain walk of 30 s through the hall, with fixes of 1 m; it goes on."""
    live = LiveSmoother(lag=60.0, plan=hall())
    step = steps_of(np.full(1, STRIDE), np.zeros(1))
    for n in range(60):
        begin, end = PERIOD * n, PERIOD * (n + 1)
        live.extend(replace(step, start=begin, end=end, time=np.array([end])))
        if n % 10 == 0:
            live.append(fixes_at([end], [[STRIDE * (n + 1), Y]], 1.0))
    assert live.sure
    return live


def cloud(random, *modes):
    """Paths of one keyframe: of each mode so many particles about x, y [m], headed by θ [rad]."""
    parts = [random.normal([x, y, heading, 1, 1, 0], 0.1, (count, 6)) for count, x, y, heading in modes]
    state = np.concatenate(parts).T
    return Paths(state[None], np.full(state.shape[1], 1.0 / state.shape[1]))


def test_ways_elsewhere_have_the_share_and_the_moments_of_their_particles():
    """Six in ten are where the graph is; the direction of the others is about ±π."""
    paths = cloud(np.random.default_rng(0), (600, 0, 0, 0), (300, 20, 0, np.pi), (100, 0, 30, 1))
    ways = ways_elsewhere(paths, [5, 605, 905], np.array([1.0, 0.0]))
    assert ways is not None
    assert np.exp(ways.log_weight) == pytest.approx([0.3, 0.1])
    assert ways.mean[:, :2] == pytest.approx(np.array([[20.0, 0.0], [0.0, 30.0]]), abs=0.1)
    assert np.abs(ways.mean[0, 2]) == pytest.approx(np.pi, abs=0.1)
    assert ways.covariance == pytest.approx(np.tile(0.01 * np.eye(6), (2, 1, 1)), abs=0.005)


def test_particles_near_the_graph_are_nowhere_else():
    paths = cloud(np.random.default_rng(0), (500, 0, 0, 0), (500, 3, 0, 0))
    assert ways_elsewhere(paths, [0, 500], np.array([1.0, 0.0])) is None


def test_a_way_elsewhere_widens_the_stated_covariance_and_leaves_the_pose():
    """Half of the particles are 10 m to the left: the variance across grows by half of 10 m squared."""
    live = walked()
    live.output.particles = None
    before = live.output.expected(live.output.mixture())
    there = before.mean + np.array([0.0, 10.0, 0.0, 0.0, 0.0, 0.0])
    ways = GaussianMixture(there[None], before.covariance[None], np.log([0.5]), np.zeros(1, dtype=np.intp))
    live.output.particles = SimpleNamespace(elsewhere=ways, times=[live.graph.window.steps.end])
    after = live.output.expected(live.output.mixture())
    assert after.mean == pytest.approx(before.mean)
    assert after.covariance[1, 1] - before.covariance[1, 1] == pytest.approx(50.0, rel=0.01)
    assert after.covariance[0, 0] == pytest.approx(before.covariance[0, 0])
    assert np.exp(live.output.mixture().log_weight) == pytest.approx([0.5, 0.5])

    live.append(fixes_at([live.graph.window.steps.end + 0.1], [[STRIDE * 60, Y]], 1.0))
    assert len(live.output.mixture(until=live.graph.window.steps.end)) == 2, (
        "a fix that is still to come decides nothing"
    )


def test_particles_begin_where_the_graph_is():
    """Their mean is the graph's; they are SPREAD times as wide, and correlated as the graph's variables."""
    covariance = np.diag([4.0, 1.0, 0.04, 0.01, 1e-4, 1e-6])
    covariance[0, 3] = covariance[3, 0] = 0.15
    mean = np.array([10.0, 1.0, 0.5, 1.0, 1.0, 0.0])
    belief = GaussianMixture(mean[None], covariance[None], np.zeros(1), np.zeros(1, dtype=np.intp))
    state = ParallelParticleFilter(hall(), Prior(), belief, 0.0, "1")._filter.state
    root = np.sqrt(np.diag(covariance))
    assert np.abs((state.mean(axis=1) - mean) / root).max() < 0.2
    assert np.cov(state) / np.outer(root, root) == pytest.approx(
        LIVE_PATHS.spread**2 * covariance / np.outer(root, root), abs=0.35
    )
