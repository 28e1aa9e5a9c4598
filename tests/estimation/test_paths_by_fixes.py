"""Paths through a building that fixes determine, and when particles search for them."""

import numpy as np
import pytest
import shapely
from walks import PERIOD, fixes_at, steps_of

from pdr_graph import Headings, WalkGraph
from pdr_graph.estimation import particle_filter
from pdr_graph.estimation.ambiguity import path_modes
from pdr_graph.estimation.ambiguity.path_modes import solutions
from pdr_graph.floor.cells import Area
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.frames import Frame
from pdr_graph.geometry import dead_reckon

WIDTH, LONG, APART = 3.0, 60.0, 8.0  # [m] of two aisles side by side, joined at their ends


def ladder():
    """Two aisles, a block of shops between them."""
    a, b, c, d = (0.0, 0.0), (LONG, 0.0), (LONG, -APART), (0.0, -APART)
    lines = [[a, b], [b, c], [c, d], [d, a]]
    shapes = [shapely.LineString(line).buffer(WIDTH / 2, cap_style="square") for line in lines]
    return FloorPlan("", (Area("corridor", "", shapely.union_all(shapes)),), Frame())


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
    led, advance = [], particle_filter.ParticleFilter.advance

    def counted(self, *arguments):
        led.append(1)
        return advance(self, *arguments)

    monkeypatch.setattr(particle_filter.ParticleFilter, "advance", counted)
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
    monkeypatch.setattr(path_modes, "fixes_determine_path", lambda *_: None)
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
    few = steps_of(steps.length[:30], steps.turn[:30])
    walk = WalkGraph(few, fixes_at(truth.time[[0, 29]], truth.position[[0, 29]], 0.3), floor=ladder())
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
