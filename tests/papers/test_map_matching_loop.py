"""[map-matching] Sec. 4: the lap, its errors at 13 points, and why the projection's errors are what they are."""

from dataclasses import replace
from functools import cache, reduce

import numpy as np
import pytest
import shapely
from matplotlib.collections import PatchCollection

from pdr_graph.apps.report.plotting import plot_regions
from pdr_graph.lab.papers.map_matching import FeasibleRegion, correct
from pdr_graph.lab.papers.map_matching_loop import (
    MATCHING_METHODS,
    SHARES,
    errors_along,
    errors_at_times,
    loop_plan,
    projection_of,
    reckoned,
    simulate_lap,
    table_1,
)
from pdr_graph.types import Trajectory


@cache
def laps():
    return [simulate_lap(seed) for seed in range(3)]


def track(time, position):
    return Trajectory(np.array(time), np.array(position), np.zeros(len(time)), ("",) * len(time))


def test_the_loop_is_four_corridors_with_the_walls_of_both_sides():
    """Outer and inner rectangle, by hand."""
    plan = loop_plan(np.array([42.5, 25.5]))
    assert plan.walkable_area == pytest.approx(45 * 28 - 40 * 23)
    assert len(plan.network.links) == len(plan.network.nodes) == 4
    assert plan.network.width == pytest.approx(np.full(4, 2.5), abs=0.01)


def test_a_true_lap_crosses_no_wall():
    for lap in laps():
        place = lap.truth.position
        assert not lap.plan.crosses_wall(place[:-1], place[1:]).any()
        assert np.hypot(*(place[0] - lap.start)) < 0.01


def test_a_stride_error_is_no_error_at_shares_of_the_length_and_one_at_equal_times():
    """A walker goes 10 m north; the track goes there too, and has its first half in a quarter of the time."""
    truth = track([0.0, 5.0, 10.0], [(0, 0), (0, 5.0), (0, 10.0)])
    fast = track([0.0, 2.5, 10.0], [(0, 0), (0, 5.0), (0, 10.0)])
    assert errors_along(fast, truth) == pytest.approx(np.zeros((13, 2)))
    at_5_m = np.flatnonzero(np.isclose(SHARES, 0.5))[0]
    assert errors_at_times(fast, truth)[at_5_m] == pytest.approx((0, 5.0 / 3))


def test_dead_reckoning_with_short_strides_is_off_by_the_missing_part_of_the_way_back():
    """Strides × f shrink the track about its start."""
    lap = laps()[0]
    exact = reckoned(lap)
    short = reckoned(lap.with_errors(stride=0.8))
    assert short.position - lap.start == pytest.approx(0.8 * (exact.position - lap.start))
    shrunk = errors_along(short, exact)
    assert np.hypot(*shrunk.T).max() == pytest.approx(0.2 * np.hypot(*(exact.position - lap.start).T).max(), rel=0.1)


def test_without_drift_the_heading_error_has_no_trend():
    lap = laps()[0].without_drift()
    error = np.cumsum(lap.bent.turn) - np.interp(lap.bent.time, lap.truth.time, np.unwrap(lap.truth.heading))
    assert np.polyfit(lap.bent.time, error, 1)[0] == pytest.approx(0, abs=1e-9)


def test_a_stride_error_stays_in_the_projection_along_the_corridor_at_equal_times_alone():
    exact, short = ([projection_of(lap.with_errors(stride=f)) for lap in laps()] for f in (1.0, 0.8))
    assert max(walk.wrong for walk in exact + short) < 0.1

    def grown(part):
        return np.mean([getattr(b, part) for b in short]) - np.mean([getattr(a, part) for a in exact])

    assert grown("ahead") > 1.5
    assert abs(grown("aside")) < 0.1
    assert abs(grown("along")) < 0.4


def test_turns_measured_too_large_lead_to_wrong_links():
    walks = [projection_of(lap.without_drift().with_errors(turns=1.4)) for lap in laps()]
    assert max(walk.wrong for walk in walks) > 0.2


def test_the_graph_is_nearer_to_the_truth_than_the_methods_of_the_paper(monkeypatch):
    """Without the two that take longest."""
    for name in ("method 2", "graph, the paper's steps"):
        monkeypatch.delitem(MATCHING_METHODS, name)
    table = table_1(laps()[1:2], "lap", "strides")
    mean = {row[0]: float(row[1].split()[0].strip(",")) for row in table.rows}
    assert mean["graph, our steps"] < min(mean["method 1"], mean["projection on links"])
    assert max(mean["method 1"], mean["projection on links"]) < mean["dead reckoning"]
    assert "(0.57)" in table.rows[2][1], "the paper's figure stands beside ours"


# The figure of the regions


def drawn(*stretches):
    """The figure of the regions of some stretches."""
    regions = [(s.region.R_d, s.region.R_s, s.region.feasible) for s in stretches]
    return plot_regions(regions, [s.pair for s in stretches])


def first_stretch():
    lap = laps()[0]
    return correct(lap.steps, lap.plan, lap.start, 0.0).stretches[0]


def test_the_drawn_region_has_the_feasible_pairs_and_no_other():
    stretch = first_stretch()
    [fill] = [c for c in drawn(stretch).axes[0].collections if isinstance(c, PatchCollection)]
    rings = [shapely.Polygon(ring) for path in fill.get_paths() for ring in path.to_polygons()]
    region = reduce(shapely.symmetric_difference, rings)  # inner rings are holes
    R_d, R_s = np.meshgrid(stretch.region.R_d, stretch.region.R_s, indexing="ij")
    assert 0 < stretch.region.feasible.sum() < stretch.region.feasible.size
    assert shapely.contains_xy(region, R_d, R_s).tolist() == stretch.region.feasible.tolist()


def test_a_turn_without_a_feasible_pair_is_drawn_without_a_region():
    figure = drawn(replace(first_stretch(), region=FeasibleRegion.none(), pair=(1.0, 1.0)))
    assert len(figure.axes[0].collections) == 0
