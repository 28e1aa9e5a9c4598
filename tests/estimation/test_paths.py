"""Paths through a building: modes of the particles, paths that fixes determine, and when particles search for them."""

from dataclasses import replace

import numpy as np
import pytest
from plans import corridors
from walks import PERIOD, fixes_at, part, steps_of, straight

from pdr_graph import Headings, WalkGraph
from pdr_graph.estimation import particle_filter as filter_module
from pdr_graph.estimation.ambiguity import path_modes as modes_module
from pdr_graph.estimation.ambiguity.path_modes import dominant_modes, path_modes, path_starts, solutions
from pdr_graph.estimation.particle_filter import Paths, particle_filter
from pdr_graph.geometry import dead_reckon
from pdr_graph.priors import SEARCH

STEM, BRANCH, HALF_ANGLE = 20.0, 22.0, np.radians(30)  # [m], [m], of each branch from straight ahead


def junction():
    """A corridor of 2.4 m that forks into two at 60°."""
    at = np.array([STEM, 0.0])
    ends = [at + BRANCH * np.array([np.cos(a), np.sin(a)]) for a in (HALF_ANGLE, -HALF_ANGLE)]
    lines = [[(0, 0), at], *([at, end] for end in ends)]
    return corridors(*lines, width=2.4)


def walk(turn_at_fork, sigma):
    """Into the stem, and as far into a branch as strides say; the turn at the fork is known to ``sigma`` [rad]."""
    at = np.arange(50) == round((STEM - 1.0) / 0.7)
    steps = replace(straight(50), turn=np.where(at, turn_at_fork, 0.0), sigma_turn=np.where(at, sigma, 0.02))
    there = Headings(np.array([0.0]), np.array([0.0]), np.array([0.1]))
    return WalkGraph(steps, fixes_at([0.0], [[1.0, 0.0]], 0.3), headings=there, floor=junction())


def test_a_fork_has_two_modes_of_similar_share():
    """There is a wall straight ahead; the walk went to one side, and no measurement says which."""
    graph = walk(0.0, sigma=0.5)  # the phone may have turned there
    paths = particle_filter(graph)
    assert paths.weight[paths.state[-1, 1] > 0].sum() == pytest.approx(0.5, abs=0.2)
    ways = path_starts(graph)
    ends = np.array([way.poses[-1, 1] for way in ways[:3]])
    strongest = [side * ends[np.sign(ends) == side][0] for side in (-1, 1)]
    assert strongest == pytest.approx(np.full(2, (35.0 - STEM) * np.sin(HALF_ANGLE)), abs=3.5)  # strides: by a quarter


@pytest.mark.parametrize("side", [-1, 1])
def test_a_measured_turn_leaves_one_mode(side):
    ways = path_starts(walk(side * HALF_ANGLE, sigma=0.02))
    assert ways
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
    state[:, 1] = np.linspace(-SEARCH.same_path / 2.2, SEARCH.same_path / 2.2, 11)
    (middle,) = path_modes(Paths(state, np.full(11, 1 / 11)))
    assert middle == 5


# Paths by fixes

WIDTH, LONG, APART = 3.0, 60.0, 8.0  # [m] of two aisles side by side, joined at their ends


def ladder():
    """Two aisles, a block of shops between them."""
    a, b, c, d = (0.0, 0.0), (LONG, 0.0), (LONG, -APART), (0.0, -APART)
    return corridors([a, b], [b, c], [c, d], [d, a], width=WIDTH)


def up_and_down(laps=3):
    """Round the ladder, as steps have it and as it was."""
    sides = np.round(np.array([LONG, APART, LONG, APART]) / 0.7).astype(int)
    turn = np.zeros(int(sides.sum()) * laps)
    turn[np.cumsum(np.tile(sides, laps))[:-1]] = -np.pi / 2
    steps = steps_of(np.full(len(turn), 0.7), turn)
    return steps, dead_reckon(steps)


def graph(every, sigma, until=None, headings=None):
    """The walk with a fix every so many steps, those after the step ``until`` left out."""
    steps, truth = up_and_down()
    rows = np.arange(0, until or len(steps), every)
    noise = np.random.default_rng(1).normal(0, sigma, (len(rows), 2))
    fixes = fixes_at(truth.time[rows], truth.position[rows] + noise, sigma)
    return WalkGraph(steps, fixes, headings=headings, floor=ladder()), truth


@pytest.fixture
def sent_off(monkeypatch):
    """How many intervals particles were led through."""
    led, advance = [], filter_module.ParticleFilter.advance

    def counted(self, *arguments):
        led.append(1)
        return advance(self, *arguments)

    monkeypatch.setattr(filter_module.ParticleFilter, "advance", counted)
    return led


def test_dense_fixes_determine_the_path_without_particles(sent_off):
    walk, truth = graph(every=20, sigma=2.0)
    best = solutions(walk)[0]
    assert not sent_off
    apart = best.at.ends[walk.pieces.row_end, :2] - truth.position[1:]
    assert np.hypot(*apart.T).max() < 2.5  # half the way from the middle of an aisle to the shops behind the other's


def test_particles_lead_to_the_same_walk(monkeypatch):
    walk, _ = graph(every=20, sigma=2.0)
    by_fixes = solutions(walk)[0]
    monkeypatch.setattr(modes_module, "fixes_determine_path", lambda *_: None)
    sought = solutions(walk)[0]
    # the optimiser settles within 3e-5 of a cost of some tens
    assert by_fixes.surprise == pytest.approx(sought.surprise, abs=0.02)
    assert by_fixes.at.ends[:, :2] == pytest.approx(sought.at.ends[:, :2], abs=0.05)


def test_sparse_fixes_do_not_determine_the_path(sent_off):
    """Fixes of 3 m every hundred steps: half-way between, the sigma exceeds a third of the distance of two aisles."""
    solutions(graph(every=100, sigma=3.0)[0])
    assert sent_off


def test_two_fixes_do_not_check_one_another(sent_off):
    steps, truth = up_and_down(laps=1)
    walk = WalkGraph(part(steps, 0, 30), fixes_at(truth.time[[0, 29]], truth.position[[0, 29]], 0.3), floor=ladder())
    solutions(walk)
    assert sent_off


def test_particles_search_only_after_the_last_fix(sent_off):
    until = 480
    start = Headings(np.array([PERIOD]), np.zeros(1), np.array([0.1]))
    walk, truth = graph(every=20, sigma=2.0, until=until, headings=start)
    best = solutions(walk)[0]
    of_the_end = np.count_nonzero(walk.pieces.keyframe_time > truth.time[until] - 20 * PERIOD)
    assert 0 < len(sent_off) <= of_the_end + 1
    assert np.hypot(*(best.at.ends[-1, :2] - truth.position[-1])) < 6.0


def test_particles_search_where_walls_contradict_the_path_of_the_fixes(sent_off):
    """All fixes lie in the block between the aisles, so their path crosses walls."""
    steps, truth = up_and_down()
    rows = np.arange(0, len(steps), 20)
    place = truth.position[rows] + np.where(truth.position[rows, 1:] > -APART / 2, -1, 1) * [0.0, 3.5]
    solutions(WalkGraph(steps, fixes_at(truth.time[rows], place, 0.5), floor=ladder()))
    assert sent_off
