"""The Microsoft indoor location recordings: what the data page says of them, and what we make of them."""

import numpy as np
import pytest
import shapely
from tiers import thorough

from pdr_graph import FloorPlan
from pdr_graph.apps.bench.data_sets import given, recorded, walks_of
from pdr_graph.apps.bench.matrix import places
from pdr_graph.io.loading import load
from pdr_graph.options import Options
from pdr_graph.types import Trajectory
from pdr_graph.walk import estimate, observe

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


def errors_of(data, what, methods, every=1):
    """Errors at the waypoints that were not given, of all walks by each method."""
    errors = {name: [] for name in methods}
    for _, read in list(walks_of("microsoft", data))[::every]:
        if (walk := given(read(), what)) is not None:
            evidence = observe(walk.evidence)
            for name, method in methods.items():
                errors[name] += places(method(evidence), walk.truth, walk.noise)[0].tolist()
    return errors


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


def straight(evidence):
    """Straight lines between the waypoints given."""
    fixes = evidence.fixes
    return Trajectory(fixes.time, fixes.position, np.zeros(len(fixes)))


def graph(evidence):
    """The walk by the graph, which converges."""
    found = estimate(evidence).estimate
    assert found.converged
    return found.trajectory


@pytest.mark.parametrize("plan", [", plan", thorough("")])
def test_smoothing_beats_straight_lines_between_the_waypoints_given(data, plan):
    """Every second waypoint given: the others, where straight lines miss them by 1.6 m in the median, within 1.2 m."""
    errors = errors_of(data, f"every second{plan}", {"graph": graph, "straight": straight})
    assert np.median(errors["straight"]) > 1.5
    assert np.median(errors["graph"]) < 1.2
    assert np.percentile(errors["graph"], 95) < 2.6


@pytest.mark.thorough
def test_one_waypoint_a_compass_and_the_plan_find_the_walk(data):
    """The first waypoint alone: half of the others within 2.5 m and nearly all in the right aisle; each third walk."""
    errors = errors_of(data, "first, plan", {"graph": graph}, every=3)["graph"]
    assert np.median(errors) < 2.5
    assert np.percentile(errors, 90) < 7.0


def test_three_shops_by_their_names_and_the_plan_place_a_walk(data, tmp_path):
    """In any order, without a time and without a fix: the walk leads past their fronts."""
    (path,) = (data / "ms_indoor20").glob("site2/F6/5dd4b80e*.txt")
    (tmp_path / "visited.csv").write_text("place\nSimply Thai\nyuniudao\nxiyouji\n", encoding="utf-8")
    options = Options(plan=path.parent, visited=tmp_path / "visited.csv")
    walk = recorded(path, options)
    error, inside = places(estimate(observe(walk.evidence)).estimate.trajectory, walk.truth, walk.noise)
    assert np.median(error) < 2.0
    assert np.mean(inside) > 0.85
