"""Paths of a walk under way in a building: trials of alternatives, particles elsewhere, walls, and the whole plan."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from plans import MAPS, plan
from simulated import scenario_walk
from walks import PERIOD, fixes_at, pushed, pushing, straight

from pdr_graph import FloorPlan, Prior, Recording
from pdr_graph.estimation.factors.chain import intervals, whole_pieces
from pdr_graph.estimation.kalman import GaussianMixture
from pdr_graph.estimation.live.live_ambiguity import try_path
from pdr_graph.estimation.live.live_graph import UPDATES
from pdr_graph.estimation.live.live_output import predict, retraced
from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.estimation.live.particles import ParallelParticleFilter, PredictionBetweenWalls, ways_elsewhere
from pdr_graph.estimation.live.window import Path
from pdr_graph.estimation.particle_filter import Paths
from pdr_graph.floor.building import Building
from pdr_graph.online.interface import Samples, events_of
from pdr_graph.online.navigator import Navigator
from pdr_graph.priors import LIVE_PATHS

STRIDE, STEPS, EVERY = 0.7, 60, 10
RIGHT, OTHER, SHOP = 1.0, 9.0, -2.0  # y of the middle of the aisles and a shop; fixes are along the first [m]
SHOPS = [("shop", shapely.box(0, low, 100, high)) for low, high in ((-4, 0), (2, 8), (10, 14))]
AISLES = Building.around(plan(("floor", shapely.box(-2, -4, 100, 14)), *SHOPS))  # two of 2 m
HALL = Building.around(plan(("floor", shapely.box(-2, -20, 100, 20))))


def walk_of(count):
    """Steps straight on, of which the last ends the walk."""
    steps = straight(count)
    return replace(steps, end=float(steps.time[-1]))


def walking(building):
    """A walk of 30 s along the first aisle with fixes of 1 m, still going on; it is sure."""
    steps = walk_of(STEPS)
    time = steps.time[::EVERY]
    fixes = fixes_at(time, np.stack([STRIDE / PERIOD * time, np.full(len(time), RIGHT)], axis=1), 1.0)
    live = pushed(LiveSmoother(lag=60.0, plan=building), steps, fixes)
    assert live.sure
    return live


# The prediction between walls

LONG_TAIL = 20  # steps since the last keyframe
ALONG = np.diag(np.square([0.3, 0.3, 0.15, 0.05, 0.05, 1e-3]))  # of a place in the aisle, and of its direction


def tail_pieces(count):
    """The pieces of some steps straight on."""
    steps = walk_of(count)
    whole = whole_pieces(steps)
    return intervals(whole, steps.start, steps.start, whole[-1:, 0])


def in_the_aisle(*headings, y=RIGHT):
    """Modes at the middle of an aisle, equally probable, one in each direction."""
    mean = np.array([(5.0, y, heading, 1.0, 1.0, 0.0) for heading in headings])
    every = np.arange(len(mean))
    return GaussianMixture(mean, np.tile(ALONG, (len(mean), 1, 1)), np.full(len(mean), -np.log(len(mean))), every)


def between_walls(ways, count=LONG_TAIL, prediction=None):
    """The prediction of a mixture through some steps straight on, in the aisles."""
    prediction = prediction or PredictionBetweenWalls(Prior())
    return prediction.predict(ways, tail_pieces(count), AISLES.floors[0].distance)


def test_walls_hold_a_prediction_in_its_aisle():
    (off,) = between_walls(in_the_aisle(0.1)).mean[:, 1] - RIGHT
    assert abs(off) < 0.6, "14 m at 0.1 rad lead 1.4 m to the side, through the wall"


def test_walls_narrow_a_prediction_across_the_aisle_and_not_along():
    after = between_walls(in_the_aisle(0.0)).covariance[0]
    assert np.sqrt(after[1, 1]) < 0.7, "2 m wide; without walls 0.15 rad are 2 m after 14 m"
    assert np.sqrt(after[0, 0]) > 0.6


def test_a_mode_that_walks_into_a_wall_loses_to_one_that_does_not():
    after = between_walls(in_the_aisle(0.0, np.pi / 2))
    assert np.exp(after.log_weight[0]) > 0.9


def test_a_prediction_does_not_depend_on_how_often_it_is_asked_for():
    ways, prediction = in_the_aisle(0.0, 0.3), PredictionBetweenWalls(Prior())
    for count in (3, 12, 7, 15):
        between_walls(ways, count, prediction)
    often, once = between_walls(ways, prediction=prediction), between_walls(ways)
    np.testing.assert_array_equal(often.mean, once.mean)
    np.testing.assert_array_equal(often.log_weight, once.log_weight)


def test_a_mixture_is_retraced_along_the_steps_it_was_predicted_through():
    steps, ways = walk_of(LONG_TAIL), in_the_aisle(0.0, 0.3)
    whole = whole_pieces(steps)
    end = float(whole[-1, 0])
    whole = np.column_stack([whole, np.zeros((len(whole), 2))])
    later = predict(ways, whole, steps.start, steps.start, end, ())
    np.testing.assert_allclose(retraced(later, whole, steps.start, end, steps.start).mean, ways.mean, atol=1e-9)


# Trials of an alternative path


@pytest.fixture(scope="module")
def in_aisle():
    return walking(AISLES)


def along(graph, y):
    """The window's path, straight along an aisle."""
    times = np.array(graph.window.times)
    place = STRIDE / PERIOD * times
    pose = np.column_stack([place, np.full(len(times), y), np.zeros(len(times))])
    return Path(times, pose, times[:1], np.array([[1.0, 1.0, 0.0]]))


def trial(live, graph, y, decisions=None):
    """The trial of a path along an aisle, beside a graph."""
    alternative = along(graph, y)
    return try_path(graph.frozen(), lambda: (alternative, decisions or {}), UPDATES)


def test_the_other_aisle_costs_more(in_aisle):
    assert trial(in_aisle, in_aisle.graph, OTHER) is None


def test_the_present_path_is_no_alternative_to_itself(in_aisle):
    assert trial(in_aisle, in_aisle.graph, RIGHT) is None


def test_a_path_that_has_left_the_window_is_no_alternative(in_aisle):
    """Particles that are behind: in a rest, one keyframe is left."""
    path = along(in_aisle.graph, OTHER)
    past = replace(path, time=path.time - path.time[-1] - 10.0)
    assert try_path(in_aisle.graph.frozen(), lambda: (past, {}), UPDATES) is None


def test_out_of_the_shops_the_aisle_is_found():
    """A walk through the shop beside the aisle, which takes all fixes for outliers, pays the shop's price."""
    graph = (in_aisle := walking(AISLES)).graph
    decided = graph.decisions
    graph.decide({"fixes": decided["fixes"] | {"held": np.zeros(STEPS // EVERY, dtype=bool)}})
    graph.move_to(along(graph, SHOP))
    assert np.abs(graph.window.pose[:, 1] - SHOP).max() < 0.1, "a control: it stays there"
    found = trial(in_aisle, graph, RIGHT, decided)
    assert found is not None
    path, decisions = found
    graph.decide(decisions)
    graph.move_to(path)
    assert np.abs(graph.window.pose[:, 1] - RIGHT).max() < 0.1


def test_a_trial_leaves_the_walk_as_it_is(in_aisle):
    graph = in_aisle.graph
    pose, marginals, at, cost = graph.window.pose.copy(), list(graph.marginals), graph.at, graph.cost
    trial(in_aisle, graph, OTHER)
    assert np.array_equal(graph.window.pose, pose)
    assert graph.marginals == marginals
    assert graph.at is at
    assert graph.cost == cost


# Particles elsewhere widen what is stated, and move nothing


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
    live = walking(HALL)
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

    live.append(fixes_at([live.graph.window.steps.end + 0.1], [[STRIDE * STEPS, RIGHT]], 1.0))
    modes = live.output.mixture(until=live.graph.window.steps.end)
    assert len(modes) == 2, "a fix that is still to come decides nothing"


def test_particles_begin_where_the_graph_is():
    """Their mean is the graph's; they are SPREAD times as wide, and correlated as the graph's variables."""
    covariance = np.diag([4.0, 1.0, 0.04, 0.01, 1e-4, 1e-6])
    covariance[0, 3] = covariance[3, 0] = 0.15
    mean = np.array([10.0, 1.0, 0.5, 1.0, 1.0, 0.0])
    belief = GaussianMixture(mean[None], covariance[None], np.zeros(1), np.zeros(1, dtype=np.intp))
    state = ParallelParticleFilter(HALL, Prior(), belief, 0.0, "1")._filter.state
    root = np.sqrt(np.diag(covariance))
    assert np.abs((state.mean(axis=1) - mean) / root).max() < 0.2
    assert np.cov(state) / np.outer(root, root) == pytest.approx(
        LIVE_PATHS.spread**2 * covariance / np.outer(root, root), abs=0.35
    )


# A direction that is measured roughly, and walls that say which way the walk went

HALF = 1.5  # [m] half the width of the corridor
OFF = 0.3  # [rad] of the measured direction, one sigma


def corridor(*beside):
    """A corridor, and others at these ordinates [m]."""
    shapes = [("corridor", shapely.box(-1, y - HALF, 200, y + HALF)) for y in (0.0, *beside)]
    return Building.around(plan(*shapes))


def misled(off, count, lag=60.0, beside=()):
    """A walk along the corridor from one fix, with a first heading that is so far off [rad]; yields after each step."""
    live = LiveSmoother(lag=lag, plan=corridor(*beside))
    for n in pushing(live, walk_of(count), fixes_at([PERIOD], [[STRIDE, 0.0]], 1.0)):
        if n == 1:
            live.set_heading(0, PERIOD, off, OFF)
        yield live


@pytest.mark.parametrize("off", [-OFF, OFF])
def test_a_solution_of_the_batch_is_adopted_with_its_walls(off):
    """A solver without them would turn the walk to the measured direction: 11 m out of the corridor."""
    outside, solvers = 0.0, set()
    for live in misled(off, 80):
        solvers.add(live.ambiguity.next_batch)
        outside = max(outside, float(np.abs(live.graph.window.pose[:, 1]).max()) - HALF)
    assert len(solvers) > 3, "the batch has been adopted so often"
    assert live.sure
    assert outside < 1.2, "[m], for a step or two"
    assert live.graph.window.pose[-1, 1:] == pytest.approx(0.0, abs=HALF)


@pytest.mark.parametrize("off", [-OFF, OFF])
def test_the_end_of_a_walk_costs_no_more_than_before(off):
    """Everything is linearised again there, where hardly any wall pulls; undamped it ends 30 m out of the corridor."""
    *_, live = misled(off, 150, lag=20.0)
    before = live.graph.at.cost
    live.finish()
    assert live.graph.at.cost <= before + 1e-6
    assert np.abs(live.graph.window.pose[:, 1]).max() < HALF
    assert np.abs(live.graph.window.pose[-1, 0] - 150 * STRIDE) < 15.0


@pytest.mark.parametrize(("beside", "asked"), [((), 0), ((20.0,), 0), ((6.0,), 1)])
def test_a_fix_beyond_a_wall_leads_to_a_search_only_where_one_can_walk_there(beside, asked, monkeypatch):
    """Two sigmas aside, where nobody can walk: the present way is the nearest; or in a corridor beside this one."""
    steps, searches = 80, []
    *_, live = misled(0.0, steps, beside=beside)
    assert live.sure
    live.ambiguity.trial.cancel()
    monkeypatch.setattr(live.ambiguity, "ask_batch_for_alternative", lambda: searches.append(1))
    live.append(fixes_at([PERIOD * steps], [[STRIDE * steps, 6.0]], 3.0))
    assert len(searches) == asked


# Without any position, the place is sought on the plan, and the walk goes on as if a fix had told it

INERTIAL = ("accelerometer", "gyroscope")


@cache
def followed():
    """The poses of the arcade's walk by plan and inertial sensors alone, its truth, and its estimate."""
    walk, _ = scenario_walk("arcade")
    recording = Recording("arcade", 0.0, None, **{name: walk.signals[name] for name in INERTIAL})
    navigator = Navigator(FloorPlan.load(MAPS / "arcade.geojson"), lag=60.0)
    poses, states = [], []
    for event in events_of(recording):
        navigator.push(event)
        navigator.review()
        if isinstance(event, Samples) and event.sensor == "accelerometer":
            poses.append(navigator.pose)
            states.append(navigator.status.state)
    return [pose for pose in poses if pose is not None], states, walk.truth, navigator.finish()


def errors(time, position, truth):
    """Distance from the truth [m]."""
    at = np.column_stack([np.interp(time, truth.time, axis) for axis in truth.position.T])
    return np.hypot(*(position - at).T)


def test_the_place_narrows_while_the_walk_goes_on():
    poses, states, truth, _ = followed()
    time = np.array([pose.time for pose in poses])
    off = errors(time, np.array([(pose.x, pose.y) for pose in poses]), truth)
    sigma = np.array([pose.sigma for pose in poses])
    assert time[0] < 45.0, "the first search is answered"
    late = time > time[-1] - 20.0
    assert np.median(off[late]) < 4.0
    assert np.median(sigma[late]) < sigma[0] / 3
    assert np.mean(off < 2.5 * sigma) > 0.85, "the region holds, before and after"
    assert (states[0], states[-1]) == ("waiting", "running")


@cache
def begun_on_a_plan():
    """Of moments of a walk with a start on a plan: its modes' age [s], and the distance of the rows since [m]."""
    walk, _ = scenario_walk("arcade")
    recording = Recording("arcade", 0.0, None, **{name: walk.signals[name] for name in INERTIAL})
    navigator, ages, apart, last = Navigator(FloorPlan.load(MAPS / "arcade.geojson")), [], [], 0.0
    navigator.push(fixes_at(walk.truth.time[:1], walk.truth.position[:1], 0.5))
    for event in events_of(recording):
        navigator.push(event)
        navigator.review()
        output, now = navigator._graph.output, navigator._now
        if now > last + 0.2 and not output.sure and output.modes.directed:
            last, rows = now, navigator.trajectory
            late = rows.time > navigator._window.times[-1]
            ages.append(now - output.modes.time)
            apart.append(np.hypot(*np.diff(rows.position[late], axis=0).T).max(initial=0.0))
    return ages, apart


def test_the_modes_of_an_open_walk_know_the_walls_of_its_last_ten_seconds():
    ages, _ = begun_on_a_plan()
    assert ages
    assert max(ages) < 10.5, "the certain steps alone are up to 20 s old"


def test_the_rows_of_an_open_walk_since_its_last_keyframe_are_steps_apart():
    _, apart = begun_on_a_plan()
    assert max(apart) < 3.0, "before the modes' time they are retraced"


def test_the_walk_is_smoothed_where_it_was_found():
    _, _, truth, estimate = followed()
    track = estimate.trajectory
    assert np.mean(errors(track.time, track.position, truth)) < 3.0
