"""The current pose of a live walk: the expectation over the ways that remain, in the walkable area, without jumps."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import shapely
from simulated import scenario
from tiers import thorough
from walks import part, straight

from pdr_graph.estimation.live.live_ambiguity import Deferred
from pdr_graph.floor.plan_files import FloorPlan
from pdr_graph.geometry import interpolate
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.online.interface import Pose, events_of
from pdr_graph.online.navigator import Display, Navigator
from pdr_graph.types import Fixes, Recording, Signal, Trajectory

ROOT = Path(__file__).parents[2]
INERTIAL = ("accelerometer", "gyroscope")
PATIENCE = 30.0  # [s]
WITHIN = 1.0  # [m] of the fix, without any direction
FAR = 2.0  # [m] of a pose that jumps


def fixes_at(*rows, sigma=1.0):
    """Fixes of rows (time, x, y)."""
    time, *place = np.array(rows, dtype=float).reshape(-1, 3).T
    return Fixes(time, np.stack(place, axis=1), np.full(len(time), sigma), ("",) * len(time))


@cache
def recorded(route, seed=0):
    """Samples of accelerometer and gyroscope along a route: two seconds of standing at either end; no compass."""
    simulation = simulate(scenario(route, seed, phone={"rate": 50.0}))
    return Recording("walk", 0.0, None, **{name: simulation.signals[name] for name in INERTIAL}), simulation.truth


@cache
def arcade():
    """The arcade's plan, and 80 s of its walk with the fixes of the demo, two of them outliers; no compass."""
    simulation = simulate(Scenario.load("arcade"))
    signals, fixes = {}, demo_fixes(simulation)
    for name in INERTIAL:
        signal = simulation.signals[name]
        signals[name] = Signal(signal.time[signal.time < 80.0], signal.values[signal.time < 80.0])
    return fresh_plan(), Recording("arcade", 0.0, None, **signals, fixes=fixes[fixes.time < 80.0])


def fresh_plan():
    """A plan whose wall distances nobody has asked for."""
    return FloorPlan.load(ROOT / "maps" / "arcade.geojson")


def demo_fixes(simulation):
    """A fix of 1.5 m each 12 s; those at 24 and 60 s are 12 m off."""
    time = np.arange(0.0, simulation.truth.time[-1], 12.0)
    place = np.column_stack([np.interp(time, simulation.truth.time, axis) for axis in simulation.truth.position.T])
    place += np.random.default_rng(1).normal(0, 1.5, place.shape)
    place[[2, 5]] += [8.5, -8.5]
    return Fixes(time, place, np.full(len(time), 1.5), ("",) * len(time))


def poses(recording, every=None, **options):
    """The pose after each event, None where there is none; every: called with the navigator after each."""
    nav, found = Navigator(**options), []
    for event in events_of(recording):
        nav.push(event)
        if every is not None:
            every(nav)
        found.append(nav.pose)
    return found


def row(pose):
    """All numbers of a pose."""
    modes = [(mode.probability, mode.x, mode.y, mode.heading, *mode.covariance.ravel()) for mode in pose.modes]
    return (pose.time, pose.x, pose.y, pose.heading, *pose.covariance.ravel(), *(pose.display or ()), *np.ravel(modes))


STRAIGHT = ((0.0, 0.0), (20.0, 0.0))


def test_without_a_direction_the_pose_stays_at_the_fix():
    """Within 1 m while the walker goes 20 m straight on, and the sigma says how far; a second fix is the control."""
    walk, truth = recorded(STRAIGHT)
    alone = [pose for pose in poses(replace(walk, fixes=fixes_at((0.5, 0.0, 0.0)))) if pose is not None]
    assert max(np.hypot(pose.x, pose.y) for pose in alone) < WITHIN
    assert alone[-1].sigma > 0.5 * 20.0
    assert len(alone[-1].modes) > 1
    both = poses(replace(walk, fixes=fixes_at((0.5, 0.0, 0.0), (truth.time[-1] - 1.0, 20.0, 0.0))))[-1]
    assert both.heading == pytest.approx(0.0, abs=0.3)
    assert (both.x, both.y) == pytest.approx((20.0, 0.0), abs=2.0)
    assert both.sigma < 2.0


@pytest.fixture(scope="module")
def walked():
    """The poses of the arcade walk with its plan, after each packet."""
    plan, walk = arcade()
    return poses(walk, floor=plan, lag=60.0)


@pytest.fixture(scope="module")
def without_plan():
    """The poses of the same walk without its plan."""
    return poses(arcade()[1], lag=60.0)


def test_no_pose_is_outside_the_walkable_area(walked, without_plan):
    """Although poses of the walk without the plan are."""
    plan, _ = arcade()

    def outside(poses):
        place = np.array([(pose.x, pose.y) for pose in poses if pose is not None])
        return np.count_nonzero(~shapely.covers(plan.walkable, shapely.points(place)))

    assert outside(walked) == 0
    assert outside(without_plan) > 50


def test_modes_are_sorted_and_the_pose_is_their_mean():
    """Without a plan; with one it is moved into the walkable area."""
    walk, _ = recorded(((0.0, 0.0), (20.0, 0.0), (20.0, 10.0)))
    several = 0
    for pose in poses(replace(walk, fixes=fixes_at((0.5, 0.0, 0.0), (12.0, 14.0, 0.5)))):
        if pose is None or not pose.modes:
            continue
        probability = np.array([mode.probability for mode in pose.modes])
        place = np.array([(mode.x, mode.y) for mode in pose.modes])
        assert probability.sum() == pytest.approx(1.0, abs=0.05)
        assert (np.diff(probability) <= 0).all()
        several += len(pose.modes) > 1
        if probability.sum() > 0.9999:
            assert probability @ place == pytest.approx((pose.x, pose.y), abs=0.01)
    assert several > 50


def test_a_jump_is_displayed_within_two_seconds():
    """A jump of 10 m while walking east at 1.4 m/s: evenly, and after 2 s all of it."""
    display, time = Display(), np.arange(0.0, 6.0, 0.1)
    pose = np.column_stack([1.4 * time, np.where(time < 3.0, 0.0, 10.0)])
    shown = np.array([display.at(t, place, 0.0, place[0]) for t, place in zip(time.tolist(), pose, strict=True)])
    assert shown[time < 2.95] == pytest.approx(pose[time < 2.95]), "no delay without a jump"
    assert np.hypot(*np.diff(shown, axis=0).T).max() < 0.07 * 10.0
    assert np.hypot(*(shown - pose)[time > 4.95].T).max() < 0.01 * 10.0
    assert np.hypot(*(shown - pose)[time < 3.95].T).max() > 8.0, "a control: at once it is not there"


def test_a_map_shows_smaller_jumps_than_the_pose_has(without_plan):
    """The live poses are half a second apart: one shows at most a quarter of a jump, beside the way walked since."""
    shown = [pose for pose in without_plan if pose is not None and pose.display is not None]
    pose, display = np.array([(one.x, one.y) for one in shown]), np.array([one.display for one in shown])
    jump, moved = (np.hypot(*np.diff(path, axis=0).T) for path in (pose, display))
    assert jump.max() > FAR
    assert moved.max() <= 0.3 * jump.max() + 0.8


def test_the_first_pose_comes_with_the_first_fix():
    """Before any step, and before any sample."""
    walk, _ = recorded(STRAIGHT)
    nav = Navigator()
    nav.push(fixes_at((0.0, 3.0, 4.0)))
    assert (nav.pose.x, nav.pose.y, nav.pose.sigma) == pytest.approx((3.0, 4.0, 1.0))
    assert nav.status.state == "fixes alone"
    nav = Navigator()
    for event in events_of(replace(walk, fixes=fixes_at((1.2, 3.0, 4.0)))):
        nav.push(event)
        if isinstance(event, Fixes):
            break
    assert nav.steps == 0
    assert (nav.pose.x, nav.pose.y) == pytest.approx((3.0, 4.0), abs=0.1)


AROUND = ((0.0, 0.0), (30.0, 0.0), (30.0, 20.0), (0.0, 20.0))


@pytest.mark.thorough
def test_one_wild_fix_moves_the_pose_by_a_sixteenth_of_its_error():
    """At most: 40 m off, and the next good fix is 15 s away; one that states a sigma of 10 m is the control."""
    walk, truth = recorded(AROUND)
    time = np.arange(0.5, truth.time[-1] - 2.0, 15.0)
    place, middle = np.column_stack([np.interp(time, truth.time, axis) for axis in truth.position.T]), len(time) // 2
    good = Fixes(time, place, np.ones(len(time)), ("",) * len(time))
    without = poses(replace(walk, fixes=good[np.arange(len(time)) != middle]))
    before = {pose.time: pose for pose in without if pose is not None}

    def moved(sigma):
        wild = replace(good, position=place.copy(), sigma=np.where(np.arange(len(time)) == middle, sigma, 1.0))
        wild.position[middle] += (28.0, -28.0)
        found = [pose for pose in poses(replace(walk, fixes=wild)) if pose is not None and pose.time > time[middle]]
        return max(np.hypot(a.x - b.x, a.y - b.y) for a in found if (b := before.get(a.time)) is not None)

    assert moved(1.0) < 40.0 / 16
    assert moved(10.0) > 40.0 / 16


def test_fixes_alone_are_followed():
    """Without any samples: the pose follows the fixes, and one outlier does not move it."""
    nav = Navigator()
    for second in range(30):
        nav.push(fixes_at((float(second), second, 0.0) if second != 20 else (20.0, 20.0, 500.0)))
        assert abs(nav.pose.y) < 1.0
    assert (nav.pose.time, nav.pose.x) == pytest.approx((29.0, 29.0), abs=1.0)
    assert nav.status.missing


class Counting(ThreadPoolExecutor):
    """It counts what it was asked to do."""

    submitted = 0

    def submit(self, *work, **named):
        self.submitted += 1
        return super().submit(*work, **named)


@pytest.mark.thorough
def test_results_do_not_depend_on_the_timing(walked):
    """The same poses bit by bit with a thread, the shared one, a review after each event, or none of these."""
    walk = arcade()[1]
    with Counting(1) as pool:
        threaded = poses(walk, floor=fresh_plan(), lag=60.0, executor=pool)
    reviewed = poses(walk, Navigator.review, floor=fresh_plan(), lag=60.0, executor=None)
    alone = poses(walk, floor=fresh_plan(), lag=60.0, executor=None)
    assert pool.submitted > 3
    plain = [row(pose) for pose in walked if pose is not None]
    assert [row(pose) for pose in threaded if pose is not None] == plain
    assert [row(pose) for pose in reviewed if pose is not None] == plain
    assert [row(pose) for pose in alone if pose is not None] == plain


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_question_that_a_thread_had_begun_is_answered_in_a_fork_too():
    begun, go = threading.Event(), threading.Event()

    def question():
        begun.set()
        return go.wait(PATIENCE) or True

    with ThreadPoolExecutor(1) as pool:
        deferred = Deferred(pool)
        deferred.ask(question, 1.0)
        begun.wait(PATIENCE)
        if not (child := os.fork()):
            go.set()
            os._exit(0 if deferred.collect(1.0) else 1)
        status = os.waitpid(child, 0)[1]
        go.set()
        assert (status, deferred.collect(1.0)) == (0, True)


@pytest.mark.thorough
def test_standing_still_the_pose_stands():
    """For a minute, the phone in a hand: within 0.2 m; the walk before it, and the control moves."""
    route = [[0.0, 0.0], {"stand": 2}, {"to": [[15.0, 0.0], [15.0, 12.0]]}, {"stand": 62}]
    simulation = simulate(Scenario.of({"seed": 1, "start": 0.0, "phone": {"rate": 50.0}, "route": route}))
    signals = {name: simulation.signals[name] for name in INERTIAL}
    stop = simulation.truth.time[-1] - 60.0
    fixes = fixes_at((0.5, 0.0, 0.0), (stop - 3.0, 15.0, 11.0))
    found = [pose for pose in poses(Recording("stand", 0.0, None, **signals, fixes=fixes)) if pose is not None]
    place = np.array([(pose.x, pose.y) for pose in found if pose.time > stop])
    assert len(place) > 300
    assert np.hypot(*(place - np.median(place, axis=0)).T).max() < 0.2


def pushed_by_step(steps, *later):
    """A navigator after some steps of a walk; after step n the data ``later`` has for it."""
    nav = Navigator()
    for n in range(len(steps)):
        nav.push(part(steps, n, n + 1))
        for number, data in later:
            if number == n:
                nav.push(data)
    return nav


def test_fixes_that_come_late_tell_the_direction_as_others_do():
    """A receiver's fix each second, each pushed two steps late: west is told from east."""
    steps, random = straight(12), np.random.default_rng(1)
    time = steps.time[1::2]
    place = np.column_stack([-0.7 * (np.arange(len(steps))[1::2] + 1), np.zeros(len(time))])
    place += np.array([6.0, -4.0]) + random.normal(0, 0.7, place.shape)
    fixes = [replace(fixes_at((t, *p), sigma=4.0), source=("GNSS",)) for t, p in zip(time, place, strict=True)]
    pose = pushed_by_step(steps, *((2 * n + 3, fix) for n, fix in enumerate(fixes))).pose
    assert abs(np.abs(pose.heading) - np.pi) < 0.8
    assert np.hypot(pose.x - (6.0 - 0.7 * 12), pose.y + 4.0) < 2.5
    assert 3.0 < pose.sigma < 7.0, "what all fixes share stays unknown"


def test_a_heading_that_the_compass_revises_replaces_what_it_said():
    """Start alone: the compass says south-west, then west; the pose is in the west."""
    nav = pushed_by_step(straight(30), (0, fixes_at((0.1, 0.0, 0.0), sigma=0.5)))
    graph = nav._graph
    for heading, sigma in ((-2.0, 0.5), (np.pi, 0.3)):
        graph.set_heading(-1, 5.0, heading, sigma)
        nav.push(fixes_at((0.05, 0.0, 0.0), sigma=50.0))
    assert abs(np.abs(nav.pose.heading) - np.pi) < 0.2
    assert nav.pose.x < -15.0


def test_a_walker_who_stands_stays_where_they_are_while_fixes_scatter():
    """A minute's stand with a fix of 4 m each second: no pose is 0.2 m from another; then the walk goes on."""
    route = [[0.0, 0.0], {"stand": 2}, {"to": [[20.0, 0.0]]}, {"stand": 60}, {"to": [[20.0, 20.0]]}, {"stand": 2}]
    made = simulate(Scenario.of({"seed": 3, "start": 1.7e9, "phone": {"rate": 50.0}, "route": route}))
    walk, truth = Recording("walk", 0.0, None, **{name: made.signals[name] for name in INERTIAL}), made.truth
    time = np.arange(0.0, truth.time[-1])
    place = np.column_stack([np.interp(time, truth.time, axis) for axis in truth.position.T])
    place += np.random.default_rng(5).normal(0, 2.0, place.shape)
    fixes = replace(Fixes(time, place, np.full(len(time), 4.0), ("",) * len(time)), source=("GNSS",) * len(time))
    still = np.hypot(*np.gradient(truth.position, truth.time, axis=0).T) < 0.02
    begin = truth.time[np.flatnonzero(still & (truth.time > 10.0))[0]]
    found = [pose for pose in poses(replace(walk, fixes=fixes)) if pose is not None]
    stands = np.array([(pose.x, pose.y) for pose in found if begin + 5.0 < pose.time < begin + 58.0])
    assert len(stands) > 100
    assert np.ptp(stands, axis=0).max() < 0.2
    assert np.hypot(found[-1].x - 20.0, found[-1].y - 20.0) < 3.0


def test_the_region_of_a_pose_holds_its_probability_and_is_cut_by_walls():
    """Of draws from the pose's Gaussian, 9 of 10 and half are in it; on a plan it is walkable."""
    covariance = np.array([[4.0, 1.5, 0.0], [1.5, 1.0, 0.0], [0.0, 0.0, 0.1]])
    pose = Pose(0.0, 7.0, 19.0, 0.0, "", covariance)
    drawn = np.random.default_rng(0).multivariate_normal([7.0, 19.0], covariance[:2, :2], 20_000)
    for probability in (0.5, 0.9):
        inside = shapely.contains_xy(pose.region(probability), *drawn.T).mean()
        assert inside == pytest.approx(probability, abs=0.01)
    plan = fresh_plan()
    assert plan.walkable.buffer(1e-6).contains(pose.region(0.9, plan))
    assert 0.0 < pose.region(0.9, plan).area < pose.region(0.9).area
    with pytest.raises(ValueError, match="expected a number between 0 and 1"):
        pose.region(90)


def test_before_any_position_a_pose_has_no_sigma_and_no_region():
    [*_, last] = poses(recorded(STRAIGHT)[0])
    assert not last.placed
    assert np.isnan(last.sigma)
    assert last.region().is_empty


@pytest.mark.parametrize("seed", [2, thorough(3)])
def test_who_stands_turns_and_puts_the_phone_away_is_found_again(seed):
    """The direction is open until the gait shows it; without any further fix the region holds throughout."""
    route = [[0, 0], {"stand": 2}, {"to": [[40, 0]]}, {"stand": 20, "turn": 90}, {"hold": "trouser pocket"}]
    route += [{"to": [[40, 25]]}, {"stand": 2}]
    walk = simulate(Scenario.of({"seed": seed, "route": route, "phone": {"rate": 50}}))
    time = np.array([0.5, 12.0, 24.0])
    truth = Trajectory(walk.truth.time, walk.truth.position, walk.truth.heading)
    fixes = Fixes(time, interpolate(time, truth.time, truth.position), np.full(3, 0.5))
    navigator, ways, errors, last = Navigator(), set[int](), list[float](), 30.0
    for event in events_of(replace(walk.recording("accelerometer", "gyroscope"), fixes=fixes)):
        navigator.push(event)
        pose = navigator.pose
        if pose is not None and pose.time > last + 1.0:
            last, place = pose.time, interpolate(np.array([pose.time]), truth.time, truth.position)[0]
            ways.add(len(pose.modes))
            assert pose.region(0.9).distance(shapely.Point(place)) < 0.01, pose.time
            errors.append(np.hypot(pose.x - place[0], pose.y - place[1]))
    assert max(ways) > 2
    assert np.percentile(errors, 90) < 4.0
