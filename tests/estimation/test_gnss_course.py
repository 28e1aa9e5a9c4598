"""The course of a receiver: a direction of the walk, behind by the receiver's lag."""

from dataclasses import replace

import numpy as np
import pytest
from derivatives import assert_derivatives, random_state
from test_gnss_bias import meander, named
from walks import dead_reckon, fixes_at, steps_of

from pdr_graph import Fixes, Frame
from pdr_graph.apps.report.evaluation import coverage
from pdr_graph.estimation.factors.gnss_bias import COURSE, GnssBias
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.optimizer import optimize
from pdr_graph.estimation.smoother import smooth
from pdr_graph.estimation.verdict import verdict
from pdr_graph.frames import enu, projected
from pdr_graph.geometry import interpolate
from pdr_graph.online.navigator import Navigator
from pdr_graph.priors import RECEIVERS
from pdr_graph.types import LONLAT, NONE, UTM_32N

LATE = 1.5  # [s]


def with_courses(steps, lag=0.0, off=0.0, seed=0, sigma=3.0):
    """A fix each second with an error throughout, and the course over the two seconds before; both late."""
    random, track = np.random.default_rng(seed), dead_reckon(steps)
    time = np.arange(3.0, steps.end, 1.0)
    place = interpolate(time - lag, track.time, track.position)
    way = place - interpolate(time - lag - 2.0, track.time, track.position)
    course = np.arctan2(way[:, 1], way[:, 0]) + random.normal(0, 0.05, len(time)) + off
    fixes = fixes_at(time, place + random.normal(0, 1.0, 2) + random.normal(0, 0.5, place.shape), sigma)
    course = np.angle(np.exp(1j * course))
    return named(replace(fixes, speed=np.hypot(*way.T) / 2, course=course))


def graph_of(lag=0.0, off=0.0, n=300):
    steps = meander(n)
    return WalkGraph(steps, with_courses(steps, lag, off))


def test_derivatives_are_those_of_the_residuals():
    """By the heading of a keyframe and by the lag; a course that lies between two steps has no kink there."""
    graph = graph_of(n=60)
    graph = graph.refined(graph.evaluate(graph.start))
    random = np.random.default_rng(3)
    state = random_state(graph, random)
    assert COURSE in assert_derivatives(graph, state)


def test_the_residual_is_the_angle_between_the_way_of_the_steps_and_the_course():
    graph = graph_of()
    graph = graph.refined(graph.evaluate(graph.start))
    [block] = graph.evaluate(graph.start).blocks_of(COURSE)
    track, fixes = dead_reckon(graph.steps), graph.positions.fixes
    keyframe = graph.find(GnssBias).courses.keyframe
    for n in range(20, 60, 7):
        t, k = fixes.time[n], keyframe[n]
        assert t - 6.0 < graph.chain.time[k] <= t - 5.0 + 1e-5
        second = np.linspace(-1.0, 0.0, 1001)
        late = t - RECEIVERS.lag
        ends = [interpolate(s + second, track.time, track.position).mean(axis=0) for s in (late, late - 1.0)]
        way = ends[0] - ends[1]
        turned = np.interp(graph.chain.time[k], track.time, track.heading) - graph.start.poses[k, 2]
        off = np.angle(np.exp(1j * (np.arctan2(way[1], way[0]) - turned - fixes.course[n])))
        alone = 0.05 * 3.0 / fixes.speed[n]  # [rad]: a share of the position's sigma, by the speed
        assert block.residual[n] == pytest.approx(off / (alone * np.sqrt(10)), abs=0.2)


def test_turns_tell_the_lag_of_a_receiver():
    """Within half a second; by positions alone it is a third of what it is, since their common error may be the lag."""
    steps, found = steps_of(np.full(300, 0.7), np.where(np.arange(300) % 50 == 49, np.pi / 2, 0.0)), []
    for fixes in (late := with_courses(steps, LATE), without(late)):
        graph = smooth(WalkGraph(steps, fixes)).graph
        lags = graph.evaluate(optimize(graph, graph.start).state).state["g"][:, 2]
        found.append(float(np.median(lags)))
    assert found[0] == pytest.approx(LATE, abs=0.5)
    assert abs(found[0] - LATE) < abs(found[1] - LATE)


def without(fixes):
    return replace(fixes, speed=NONE, course=NONE)


@pytest.mark.parametrize("off", [np.pi / 2, np.pi])
def test_courses_of_something_else_are_named_and_not_used(off):
    """A compass of the phone instead of the direction of motion, say."""
    lied, honest = smooth(graph_of(off=off)), smooth(WalkGraph(meander(), without(with_courses(meander()))))
    assert lied.assumed == ("gnss_bias: not following",)
    assert any("GNSS do not follow" in found.text for found in lied.contradictions)
    apart = lied.trajectory.position - honest.trajectory.position
    assert np.hypot(*apart.T).max() < 0.5


@pytest.mark.parametrize("direction", range(4))
def test_a_receiver_that_does_not_follow_the_walk_has_a_region_that_holds_it(direction):
    """Four sigmas off throughout, with courses of something else; it is never "ok"."""
    steps = meander()
    fixes = with_courses(steps, off=np.pi / 2)
    away = 12.0 * np.array([np.cos(direction), np.sin(direction)])
    estimate = smooth(WalkGraph(steps, replace(fixes, position=fixes.position + away)))
    assert not verdict(estimate).ok
    assert coverage(estimate.trajectory, dead_reckon(steps)) > 0.9


def test_right_courses_are_not_doubted():
    assert smooth(graph_of(LATE)).assumed == ()


def test_a_live_walk_uses_courses():
    """Steps turn by themselves: a gyroscope that drifts by 0.01 rad/s, fixes of 6 m."""
    steps = meander(120)
    fixes = with_courses(steps, sigma=6.0)
    drifting = replace(steps, turn=steps.turn + 0.01 * np.diff(steps.time, prepend=0.0))
    track, error = dead_reckon(steps), {}
    for given in (fixes, without(fixes)):
        navigator = Navigator(frame=Frame())
        navigator.push(drifting)
        navigator.push(given)
        pose = navigator.finish().trajectory
        off = np.angle(np.exp(1j * (np.interp(track.time[1:], pose.time, np.unwrap(pose.heading)) - track.heading[1:])))
        error[np.isfinite(given.course).any()] = float(np.abs(off[20:]).mean())
    assert error[True] < 0.8 * error[False]


def test_columns_that_are_not_known_are_nan():
    fixes = Fixes(np.arange(2.0), np.zeros((2, 2)), np.ones(2))
    assert np.isnan(fixes.speed).all()
    assert fixes.source == ("", "")
    assert np.isnan(fixes[1].course).all()


def test_a_fix_with_a_speed_is_a_receivers():
    assert Fixes(0.0, [0.0, 0.0], 1.0, speed=1.0, course=0.5).source == ("GNSS",)


@pytest.mark.parametrize(
    ("column", "value", "needed"),
    [("speed", -1.0, "0 or more"), ("course", 270.0, "radians counter-clockwise"), ("speed", [1.0, 2.0], "2 rows")],
)
def test_impossible_columns_are_refused(column, value, needed):
    with pytest.raises(ValueError, match=f"Fixes.{column}.*{needed}"):
        Fixes(0.0, [0.0, 0.0], 1.0, **{column: value})


def test_a_course_is_in_the_axes_of_the_frame():
    """North of the equator and east of the central meridian, a projection's axes are turned."""
    east, north = enu(53.5, 12.5), projected(UTM_32N)
    fixes = Fixes(0.0, [12.5, 53.5], 1.0, epsg=LONLAT, speed=1.0, course=0.3)
    assert east.place(fixes).course == pytest.approx(0.3, abs=1e-6)
    turned = north.place(fixes)
    assert turned.course - 0.3 == pytest.approx(north.bearing_of_east(turned.position[0]))
    assert abs(turned.course - 0.3) > 0.03
    again = east.place(replace(turned, epsg=UTM_32N))
    assert again.course == pytest.approx(0.3, abs=1e-4)
