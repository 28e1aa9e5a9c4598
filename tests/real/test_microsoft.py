"""The Microsoft indoor location recordings: what the data page says of them, and what we make of them."""

import numpy as np
import pytest
import shapely

from pdr_graph import FloorPlan, WalkGraph, detect_steps, magnetic_headings, smooth
from pdr_graph.apps.report.evaluation import circular_error, pair
from pdr_graph.io.loading import load
from pdr_graph.types import Fixes, Trajectory

LENGTHS = {  # [m] between waypoints, from the data page
    "site1/B1/5ddb8a03": 75,
    "site1/B1/5ddb8a08": 38,
    "site1/B1/5ddb8a07": 83,
    "site1/B1/5ddb8a06": 116,
    "site1/F1/5dda0214": 100,
    "site1/F2/5dda4035": 103,
    "site2/F1/5dd365fe": 24,
    "site2/F1/5dd365ff": 93,
    "site2/F6/5dd4b80e": 155,
}


@pytest.fixture(scope="module")
def walks(data):
    """All fifteen, by path."""
    return {p: load(p) for p in sorted((data / "ms_indoor20").glob("site*/*/*.txt"))}


def given(walk, which) -> Fixes:
    """Waypoints handed over as fixes, as a user would who tapped them."""
    truth = walk.truth
    return Fixes(truth.time[which], truth.position[which], np.full(len(which), 0.5), ("",) * len(which))


def test_all_are_read_as_described(walks):
    """50 Hz, gaps up to 104 ms, gravity up, the first waypoint up to 0.4 s before the first sample."""
    assert len(walks) == 15
    for path, walk in walks.items():
        for signal in (walk.accelerometer, walk.gyroscope, walk.magnetometer):
            assert np.median(np.diff(signal.time)) == pytest.approx(0.02, abs=1e-3), path
            assert np.diff(signal.time).max() < 0.105
        assert np.linalg.norm(walk.accelerometer.values, axis=1).mean() == pytest.approx(9.9, abs=0.4)
        assert -0.4 < walk.truth.time[0] < 0
        assert len(walk.fixes) == 0, "waypoints are truth, not fixes"
        assert walk.notes == ()


def test_waypoints_are_as_far_apart_as_described(walks, data):
    for name, length in LENGTHS.items():
        (path,) = (data / "ms_indoor20").glob(name + "*.txt")
        way = np.hypot(*np.diff(walks[path].truth.position, axis=0).T).sum()
        assert way == pytest.approx(length, abs=0.6), name


def test_waypoints_lie_where_one_can_walk(walks):
    """Inside the outline all, inside a shop at most a few: the frame and the walkable area are right."""
    inside, total = 0, 0
    for path, walk in walks.items():
        plan = FloorPlan.load(path.parent)
        points = shapely.points(walk.truth.position)
        assert shapely.covers(shapely.buffer(plan.areas[0].shape, 0.1), points).all(), path
        inside += int(shapely.covers(plan.walkable, points).sum())
        total += len(points)
    assert inside / total > 0.97


@pytest.mark.parametrize("with_map", [True, pytest.param(False, marks=pytest.mark.thorough)])
def test_smoothing_beats_straight_lines_between_the_waypoints_given(walks, with_map):
    """Every second waypoint given: the others, where straight lines miss them by 1.6 m in the median, within 1.2 m."""
    errors, straight = [], []
    for path, walk in walks.items():
        truth = walk.truth
        which = np.unique(np.append(np.arange(0, len(truth), 2), len(truth) - 1))
        rest = np.setdiff1d(np.arange(len(truth)), which)
        asked = Trajectory(truth.time[rest], truth.position[rest], truth.heading[rest], ("",) * len(rest))
        plan = FloorPlan.load(path.parent) if with_map else None
        fixes = given(walk, which)
        estimate = smooth(WalkGraph(detect_steps(walk), fixes, floor=plan))
        assert estimate.converged
        errors += circular_error(pair(estimate.trajectory, asked)).tolist()
        lines = Trajectory(fixes.time, fixes.position, np.zeros(len(fixes)), fixes.floor)
        straight += circular_error(pair(lines, asked)).tolist()
    assert np.median(straight) > 1.5
    assert np.median(errors) < 1.2
    assert np.percentile(errors, 95) < 2.6


@pytest.mark.thorough
def test_one_waypoint_a_compass_and_the_plan_find_the_walk(walks):
    """The first waypoint alone: half of the others within 2.5 m and nearly all in the right aisle; each third walk."""
    errors = []
    for path, walk in list(walks.items())[::3]:
        plan, truth = FloorPlan.load(path.parent), walk.truth
        headings = magnetic_headings(walk, plan.frame, np.zeros(2))
        graph = WalkGraph(detect_steps(walk), given(walk, np.array([0])), headings=headings, floor=plan)
        asked = Trajectory(truth.time[1:], truth.position[1:], truth.heading[1:], ("",) * (len(truth) - 1))
        errors += circular_error(pair(smooth(graph).trajectory, asked)).tolist()
    assert np.median(errors) < 2.5
    assert np.percentile(errors, 90) < 7.0
