"""The measures of the table of the live navigator, on poses that are known."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import shapely

from pdr_graph.online.interface import Pose
from pdr_graph.types import Fixes, Trajectory

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def script(scripts_on_path):
    """The script."""
    import live

    return live


def run_of(script, place, walked):
    """A run whose poses, one a second, are at ``place (n, 2)`` after ``walked (n,)`` metres."""
    nothing = {"display": None, "tail": None, "cpu": 0.001, "wall": 0.002, "fixes": 0, "headings": 0, "chunks": 0}
    asks = [
        script.Ask(time=t, pose=Pose(t, *xy, 0.0, "", np.eye(3)), anchored=True, walked=walked[n], **nothing)
        for n, (t, xy) in enumerate(zip(np.arange(float(len(place))).tolist(), np.asarray(place).tolist(), strict=True))
    ]
    return script.Run(asks, script.trajectory_of([ask.pose for ask in asks]), [], [], [])


def test_a_pose_that_moves_3_m_beyond_its_steps_has_jumped_3_m(script):
    """Steps of a metre are no jump; a metre back after a step of one is one of none either."""
    walked = np.arange(10.0)
    place = np.stack([walked, np.zeros(10)], 1)
    assert script.jumps(run_of(script, place, walked)) == pytest.approx(np.zeros(10))
    place[5:] += [3.0, 0.0]
    assert script.jumps(run_of(script, place, walked)) == pytest.approx(np.where(np.arange(10) == 5, 3.0, 0.0))


def test_the_largest_jump_of_each_minute_counts(script):
    """Two jumps in the first minute and one in the second."""
    place, walked = np.zeros((100, 2)), np.zeros(100)
    for row, size in ((10, 1.0), (30, 2.0), (70, 0.5)):
        place[row:] += [size, 0.0]
    run = run_of(script, place, walked)
    assert script.by_minute(run.shown, script.jumps(run)) == pytest.approx([2.0, 0.5])


def test_a_place_beyond_the_walkable_area_is_outside(script):
    """By more than the 5 cm that a plan is exact to."""
    plan = SimpleNamespace(floors=[SimpleNamespace(walkable=shapely.box(0, 0, 10, 2))])
    place = np.array([[5.0, 1.0], [5.0, 2.04], [5.0, 2.1], [11.0, 1.0]])
    assert script.outside(place, plan).tolist() == [False, False, True, True]
    assert not len(script.outside(place, None))


def test_the_jitter_of_a_constant_pose_is_zero(script):
    """And that of one that moves by 0.6 m half-way is 0.3 m, half of it."""
    for moved in (0.0, 0.6):
        place = np.where(np.arange(70)[:, None] < 40, 0.0, [moved, 0.0])
        asks = run_of(script, place, np.zeros(70)).asks
        assert script.jitter(asks, [(5.0, 70.0)]) == pytest.approx([moved / 2])


def test_a_minute_in_which_the_truth_does_not_move_is_a_stand(script):
    """From 20 to 80 s; 30 s are too short."""
    time = np.arange(0.0, 120.0)
    x = np.interp(time, [0, 20, 80, 119], [0, 20, 20, 59])
    truth = Trajectory(time, np.stack([x, 0 * x], 1), np.zeros(120))
    assert script.standing(truth) == [(20.0, 80.0)]
    assert script.standing(truth[30:60]) == []


def test_times_to_the_place_and_the_direction_need_two_in_a_row(script):
    """A pose that is right once and wrong again is not yet right."""
    time = np.arange(6.0)
    truth = Trajectory(time, np.zeros((6, 2)), np.zeros(6))
    far, turned = np.array([9, 0, 9, 4, 4, 4.0]), np.array([3, 0, 3, 3, 0.4, 0.4])
    causal = Trajectory(time, np.stack([far, 0 * far], 1), turned)
    assert script.time_to_near(causal, truth) == 3.0
    assert script.time_to_pointed(causal, truth) == 4.0
    unknown = Trajectory(time, np.zeros((6, 2)), np.full(6, np.nan))
    assert np.isnan(script.time_to_pointed(causal, unknown))


def test_poses_without_a_place_are_not_scored(script):
    """The navigator's first steps, before any fix, are about (0, 0)."""
    nav, walk = script.LoggingNavigator(), script.from_steps("outdoors", 1)
    for n, step in enumerate([step for step in script.events(walk.evidence) if hasattr(step, "length")][:10]):
        nav.push(step)
        assert not script.ask_of(nav, float(n), nav.pose, np.zeros(2)).anchored
    nav.push(Fixes(np.array([1.0]), np.array([[5.0, 5.0]]), np.array([1.0])))
    assert script.ask_of(nav, 10.0, nav.pose, np.zeros(2)).anchored


def test_the_filter_knows_a_heading_only_when_the_front_end_has_given_it(script):
    """Of two prefixes, the later one has the compass; the pose of the earlier time is that without."""
    case = script.from_steps("indoors, fixes every 30 s", 60_001)
    run = script.followed(case)
    versions = [ask.headings for ask in run.current]
    assert versions[0] < versions[-1]
    time = np.array([ask.pose.time for ask in run.current])
    before = time[versions.index(versions[-1]) - 1]
    unaware = script.Run(run.asks, run.smoothed, run.chunks, run.headings[: versions[0]], run.fixes)
    early = time[time <= before]
    assert run.filtered(early) == pytest.approx(unaware.filtered(early))
    assert np.abs(run.filtered(time) - unaware.filtered(time)).max() > 0.01


@pytest.mark.thorough
def test_a_row_of_the_table_has_its_cells(script):
    """One walk of each kind of estimate, from the steps."""
    group = script.Group("simulated", "outdoors", ())
    case = script.from_steps("outdoors", 60_000)
    run = script.followed(case)
    score = script.pooled([script.score_of(case, run, run.smoothed)])
    assert len(script.accuracy_row(group, score, 1)) == len(script.ACCURACY)
    assert len(script.behaviour_row(group, score)) == len(script.BEHAVIOUR)
    assert "in 0 of 0 with a plan" in script.targets([score])
