"""Modes of the paths that a building admits, with their shares of the particles."""

import numpy as np
import pytest
import shapely
from walks import fixes_at, steps_of

from pdr_graph import FloorPlan, Headings, WalkGraph
from pdr_graph.estimation.ambiguity.path_modes import dominant_modes, path_modes, path_starts
from pdr_graph.estimation.particle_filter import Paths, particle_filter
from pdr_graph.floor.cells import Area
from pdr_graph.frames import Frame
from pdr_graph.priors import PATHS

STEM, BRANCH, HALF_ANGLE = 20.0, 22.0, np.radians(30)  # [m], [m], of each branch from straight ahead


def junction():
    """A corridor of 2.4 m that forks into two at 60°."""
    at = np.array([STEM, 0.0])
    ends = [at + BRANCH * np.array([np.cos(a), np.sin(a)]) for a in (HALF_ANGLE, -HALF_ANGLE)]
    lines = [[(0, 0), at], *([at, end] for end in ends)]
    shape = shapely.union_all([shapely.buffer(shapely.LineString(line), 1.2, cap_style="square") for line in lines])
    return FloorPlan("1", (Area("corridor", "", shape),), Frame())


def walk(turn_at_fork):
    """Into the stem, and as far into a branch as strides say."""
    n, at = 50, round((STEM - 1.0) / 0.7)
    turn = np.zeros(n)
    turn[at] = turn_at_fork
    plain = steps_of(np.full(n, 0.7), turn)
    sigma = np.where(np.arange(n) == at, 0.5, 0.02)  # [rad] the phone may have turned there
    return type(plain)(**{**plain.__dict__, "sigma_turn": sigma})


def graph_of(steps):
    there = Headings(np.array([0.0]), np.array([0.0]), np.array([0.1]))
    return WalkGraph(steps, fixes_at([0.0], [[1.0, 0.0]], 0.3), headings=there, floor=junction())


def upper(paths):
    return float(paths.weight[paths.state[-1, 1] > 0].sum())


def test_a_fork_has_two_modes_of_similar_share():
    """There is a wall straight ahead; the walk went to one side, and no measurement says which."""
    paths = particle_filter(graph_of(walk(0.0)))
    assert upper(paths) == pytest.approx(0.5, abs=0.2)
    ways = path_starts(graph_of(walk(0.0)))
    ends = np.array([way.poses[-1, 1] for way in ways[:3]])
    strongest = [side * ends[np.sign(ends) == side][0] for side in (-1, 1)]
    assert strongest == pytest.approx(np.full(2, (35.0 - STEM) * np.sin(HALF_ANGLE)), abs=3.5)  # strides: by a quarter


@pytest.mark.parametrize("side", [-1, 1])
def test_a_measured_turn_leaves_one_mode(side):
    steps = walk(side * HALF_ANGLE)
    steps = type(steps)(**{**steps.__dict__, "sigma_turn": np.full(len(steps), 0.02)})
    ways = path_starts(graph_of(steps))
    assert np.sign(ways[0].poses[-1, 1]) == side
    assert all(np.sign(way.poses[-1, 1]) == side for way in ways)


SHARES = [0.2, 0.5, 0.3]
SIDE = np.repeat([0.0, 10.0, 20.0], 100)  # [m]


def three_bundles(k=61):
    """Of SHARES, in the end at SIDE, each a decimetre wide."""
    random = np.random.default_rng(0)
    state = np.zeros((k, 6, 300))
    state[:, 0] = np.arange(k)[:, None]
    state[:, 1] = np.minimum(2 * np.arange(k)[:, None] / k, 1) * SIDE + 0.1 * random.standard_normal(300)
    return Paths(state, np.repeat(np.array(SHARES) / 100, 100))


def test_modes_are_distinct_and_sorted_by_share():
    assert SIDE[path_modes(three_bundles())].tolist() == [10.0, 20.0, 0.0]


@pytest.mark.parametrize("k", [2, 30])
def test_the_fast_dominant_modes_are_the_same(k):
    shares, middles = zip(*dominant_modes(three_bundles(k)), strict=True)
    assert SIDE[list(middles)].tolist() == [10.0, 20.0, 0.0]
    assert shares == pytest.approx(sorted(SHARES, reverse=True))


def test_paths_of_vanishing_weight_are_in_no_mode():
    """Their weight is too small for a float."""
    paths = three_bundles()
    weight = np.where(SIDE == 0.0, 0.0, paths.weight)
    assert SIDE[path_modes(Paths(paths.state, weight / weight.sum()))].tolist() == [10.0, 20.0]


def test_a_central_path_represents_its_mode():
    state = np.zeros((61, 6, 11))
    state[:, 1] = np.linspace(-PATHS.apart / 2.2, PATHS.apart / 2.2, 11)
    (middle,) = path_modes(Paths(state, np.full(11, 1 / 11)))
    assert middle == 5
