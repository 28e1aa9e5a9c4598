"""The particle filter on a plan with walls, fixes and stairs, of a whole walk and keyframe by keyframe."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import shapely
from plans import MAPS, plan
from simulated import scenario_walk
from test_beacons import beacons_about, heard
from test_ranging import ranged
from tiers import thorough
from walks import PERIOD, dead_reckon, drawn_from_the_model, fixes_at, square_walk, steps_of, straight

import pdr_graph as pdr
from pdr_graph import Headings, WalkGraph, kalman_filter
from pdr_graph.estimation import particle_filter as filter_module
from pdr_graph.estimation.ambiguity.path_modes import dominant_modes
from pdr_graph.estimation.factors.base import WeighsPoses
from pdr_graph.estimation.factors.beacon_rssi import levels_along
from pdr_graph.estimation.factors.chain import intervals, whole_pieces
from pdr_graph.estimation.factors.fixes import FixCosts
from pdr_graph.estimation.factors.heading_prior import HeadingCosts
from pdr_graph.estimation.factors.ranging import NEAR_ANCHOR, RangeFactor
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.particle_filter import (
    ParticleFilter,
    Walls,
    particle_filter,
    pose_costs,
    stepped,
)
from pdr_graph.floor.plan_files import Building
from pdr_graph.geometry import interpolate, rotation
from pdr_graph.priors import PARTICLES, RANGES, REGIONS
from pdr_graph.types import Fixes, Ranges, take

SIGMA = np.array([0.07, 0.25, 0.02])  # of a step's length, sway [m] and turn [rad]


def graph_of(steps, floor, start, heading=0.0, more=(), **given):
    """A walk from a known start and heading, with further fixes (time, place)."""
    time, place = zip((steps.start, start), *more, strict=True) if more else ([steps.start], [start])
    there = Headings(np.array([steps.start]), np.array([heading]), np.array([0.1]))
    return WalkGraph(steps, fixes_at(time, place, 0.3), headings=there, floor=floor, **given)


def crowd(n, x, y, theta=0.0):
    """Particles ``(6, n)`` in one place."""
    return np.tile(np.array([x, y, theta, 1.0, 1.0, 0.0])[:, None], n)


# One step, and a wall


def test_no_particle_crosses_a_thin_wall():
    """Rooms that share an edge. Who walks at it obliquely draws their errors again, until they pass beside."""
    floor = plan(("room", shapely.box(0, 0, 10, 4)), ("room", shapely.box(0, 4, 10, 8)), ("door", shapely.Point(9, 4)))
    random = np.random.default_rng(0)
    before = crowd(4000, 2.0, 3.7, theta=0.2)
    after, price = stepped(before, 0.7, 0.0, 0.5, SIGMA, Walls(floor.distance), random)
    paid = price >= REGIONS.wall_cost
    assert not floor.crosses_wall(before[:2].T, after[:2].T)[~paid].any()
    assert np.mean(paid) < 0.3, "most find a way along the wall"
    assert np.all(price[~paid] < np.log(5) + 0.2), "having drawn again costs at most one of five"


def test_a_wall_without_a_way_round_is_crossed_at_its_price():
    """In a dead end all particles pay for the wall."""
    floor = plan(("corridor", shapely.box(0, 0, 10, 2)))
    before = crowd(500, 9.7, 1.0)
    random = np.random.default_rng(0)
    after, price = stepped(before, 0.7, 0.0, 0.5, np.full(3, 0.01), Walls(floor.distance), random)
    assert after[0].mean() == pytest.approx(10.4, abs=0.02)
    assert np.all(price == REGIONS.wall_cost)


def test_a_step_inside_a_solid_area_costs_little():
    """Somebody entered a shop: each step there has a small cost, not that of a wall."""
    floor = plan(("floor", shapely.box(0, 0, 40, 40)), ("shop", shapely.box(10, 10, 30, 30)))
    before = crowd(100, 20.0, 20.0)
    _, price = stepped(before, 0.7, 0.0, 0.5, SIGMA, Walls(floor.distance), np.random.default_rng(0))
    assert np.all((price > 0) & (price < 1))


# A walk


def test_in_the_open_particles_have_the_covariance_of_the_kalman_filter(monkeypatch):
    """They start by fix and heading, and are then weighed by both: these count as two of each."""
    for name, value in {"fewest": 20_000, "most": 20_000, "wide": (1, 1, 1), "calm": (1, 1, 1)}.items():
        monkeypatch.setitem(vars(PARTICLES), name, value)

    def graph(share, **more):
        there = Headings(np.zeros(1), np.zeros(1), np.array([0.1 * share]))
        return WalkGraph(straight(30), fixes_at([0.0], [[0.0, 0.0]], 1.0 * share), headings=there, **more)

    paths = particle_filter(graph(1.0, floor=plan(("floor", shapely.box(-500, -500, 500, 500)))))
    spread = np.cov(paths.state[-1, :2], aweights=paths.weight)
    expected = kalman_filter(graph(np.sqrt(0.5))).trajectory.covariance[-1, :2, :2]
    assert np.sqrt(np.diag(spread)) == pytest.approx(np.sqrt(np.diag(expected)), rel=0.05), "a few resamplings"


def two_aisles():
    """Two aisles of 2 m, 3 m apart, between cross aisles."""
    shops = [("shop", shapely.box(4, low, 36, high)) for low, high in ((0, 2), (4, 7), (9, 11))]
    return plan(("floor", shapely.box(0, 0, 40, 11)), *shops)


@pytest.mark.parametrize(("y", "side"), [(3.0, -1), (8.0, 1)])
def test_a_walk_along_one_of_two_aisles_stays_in_it(y, side):
    """Its gyroscope drifts by 3 m over the aisle, into the shop between: the walls say no."""
    n = 48
    steps = steps_of(np.full(n, 0.7), np.full(n, -side * 0.005))
    paths = particle_filter(graph_of(steps, two_aisles(), [2.0, y]))
    in_aisle = np.abs(paths.state[:, 1] - y) < 2.0 + 2.5 * ((paths.state[:, 0] < 4) | (paths.state[:, 0] > 36))
    assert np.sum(paths.weight[in_aisle.all(axis=0)]) > 0.95


def test_some_particles_move_to_a_far_fix():
    """The stated start is in the wrong aisle; three later fixes agree on the other."""
    n = 40
    steps = straight(n)
    time = [(steps.time[k], [6.0 + 0.7 * (k - 5), 8.0]) for k in (12, 20, 28)]
    paths = particle_filter(graph_of(steps, two_aisles(), [2.0, 3.0], more=time))
    assert np.sum(paths.weight[np.abs(paths.state[-1, 1] - 8.0) < 1.5]) > 0.8


@pytest.mark.parametrize("turned", [0.5, 1.5, 3.0, -2.0])
def test_particles_survive_any_turn_of_the_phone(turned):
    """In mid-corridor the phone is turned in the hand: the walk goes on along the corridor."""
    floor = plan(("corridor", shapely.box(0, 0, 60, 2.4)))
    n, at = 70, 30
    turn, sigma = np.zeros(n), np.full(n, 0.02)
    turn[at], sigma[at] = turned, 1.2
    plain = steps_of(np.full(n, 0.7), turn)
    steps = replace(plain, sigma_turn=sigma)
    graph = graph_of(steps, floor, [2.0, 1.2])
    runs = (particle_filter(graph, seed) for seed in range(3))  # the end differs by a metre between seeds
    ends = np.array([np.average(paths.state[-1, :2], axis=1, weights=paths.weight) for paths in runs])
    assert ends[:, 0].mean() == pytest.approx(2 + 0.7 * n, abs=0.15 * 0.7 * n), "as far as strides are known"
    assert np.all((ends[:, 1] > 0) & (ends[:, 1] < 2.4))


# Floors


def test_floors_change_at_stairs():
    """Strides are a fifth too short: the barometer gives the time of the change, the plan its place."""
    office = Building.load(MAPS / "two_floors.geojson")
    stairs = next(c for c in office.connections if c.kind == "stairs")
    n, start = 20, np.array([1.0, 9.2])
    way = stairs.distance(np.array([[x, start[1]] for x in np.arange(0, 30, 0.1)])).argmin() / 10 - start[0]
    steps = steps_of(np.full(n, 0.8 * way / n), np.zeros(n))

    def apart(labels):
        paths = particle_filter(graph_of(steps, office, start, floors=labels))
        return np.average(stairs.distance(paths.state[-1, :2].T), weights=paths.weight)

    assert apart(["1"] * n + ["2"] * 2) < 1.5
    assert apart(["1"] * (n + 2)) > 2.0, "who stays on the floor is where the strides say"


def test_fixes_alone_place_a_walk_of_unknown_heading():
    """Two fixes at the ends of an aisle, and no heading: of particles in all directions those along it survive."""
    n = 48
    steps = straight(n)
    fixes = Fixes(np.array([0.0, steps.time[-1]]), np.array([[36.0, 3.0], [2.5, 3.0]]), np.full(2, 0.5), ("", ""))
    paths = particle_filter(WalkGraph(steps, fixes, floor=two_aisles()))
    heading = np.cos(paths.state[len(paths.state) // 2, 2])
    assert np.average(heading, weights=paths.weight) < -0.95


# Keyframe by keyframe: in bounded memory, and robust to faults


FEWEST, MOST = 400, 500
STRIDE = 0.7  # [m]


def aisle(length=400.0):
    """An aisle of 2 m between shops."""
    shops = [("shop", shapely.box(0, low, length, low + 4)) for low in (-4, 2)]
    return plan(("floor", shapely.box(-2, -4, length, 6)), *shops)


def begun(seed=0, **given):
    """A cloud at the start of the aisle, facing along it."""
    cloud = ParticleFilter(Prior(), seed, fewest=FEWEST, most=MOST, **given)
    cloud.begin(np.array([0.5, 1.0]), 0.3, 0.0, 0.1)
    return cloud


TEN = intervals(whole_pieces(straight(10)), 0.0, 0.0, np.array([10 * PERIOD]))  # steps straight on, as one interval


def row(length, seconds, sigma_length, sigma_turn, turn=0.0):
    """A single piece as an interval."""
    piece = np.array([[seconds, length, turn, sigma_length**2, sigma_length**2, sigma_turn**2]])
    return intervals(piece, 0.0, 0.0, np.array([seconds]))


def at(x, y=1.0, sigma=0.5):
    """A fix."""
    return (FixCosts(np.array([[x, y]]), np.array([sigma]), np.zeros(1, dtype=bool)),)


def on(cloud, floor, intervals, seen=None):
    """Straight on, so many intervals."""
    for _ in range(intervals):
        cloud.advance(TEN, [floor.distance] * len(TEN.length), measured=seen or ())


def test_interval_by_interval_equals_the_whole_walk():
    n, floor = 60, aisle()
    steps = steps_of(np.full(n, STRIDE), np.full(n, 0.004))
    there = Headings(np.array([0.0, 12.0]), np.array([0.0, 0.1]), np.array([0.1, 0.3]))
    fixes = fixes_at([0.0, steps.time[30]], [[0.5, 1.0], [21.0, 1.0]], 0.5)
    graph = WalkGraph(steps, fixes, headings=there, floor=floor)
    at_once = particle_filter(graph)

    pieces, place = graph.pieces, graph.positions.fixes.position
    turn, time = 2 * (pieces.to_end - pieces.to_middle)

    def seen(keyframe):
        return pose_costs(graph.measurements, keyframe)

    cloud = ParticleFilter(graph.prior, 0, fewest=1000, most=8000)
    cloud.begin(place[0], 0.5, graph.start.poses[0, 2], graph.sigma_direction, measured=seen(0))
    for interval, (first, last) in enumerate(zip(pieces.first, pieces.last, strict=True)):
        for m in range(first, last + 1):
            cloud.step(float(pieces.length[m]), turn[m], time[m], pieces.variance[m], graph.floor_sequence.field(m))
        cloud.close(seen(interval + 1))
    paths = cloud.paths()
    assert np.array_equal(paths.state, at_once.state)
    assert np.array_equal(paths.weight, at_once.weight)


def test_dropped_keyframes_do_not_change_the_others():
    floor, whole, window = aisle(), begun(), begun()
    for _ in range(12):
        on(whole, floor, 1)
        on(window, floor, 1)
        window.forget(max(0, len(window.paths().state) - 5))
    assert np.array_equal(window.paths().state, whole.paths().state[-5:])
    assert np.array_equal(window.paths().weight, whole.paths().weight)


def test_memory_is_constant():
    floor, cloud, size = aisle(), begun(), []
    tracemalloc.start()
    for keyframe in range(400):
        on(cloud, floor, 1, at(2.0, sigma=3.0))
        cloud.forget(max(0, len(cloud.paths().state) - 10))
        if keyframe % 100 == 99:
            size.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert size[-1] < 1.1 * size[0], "from the 100th keyframe to the 400th"


FAULTS = {
    "a dead end": lambda cloud, floor: on(cloud, aisle(3.0), 8),
    "a fix 1 km off": lambda cloud, floor: on(cloud, floor, 1, at(1000.0, 1000.0)),
    "fixes 1 km off that agree": lambda cloud, floor: on(cloud, floor, 6, at(1000.0, 1000.0)),
    "a compass that is sure of nonsense": lambda cloud, floor: on(
        cloud, floor, 3, (HeadingCosts(np.full(100, 2.0), np.full(100, 1e-9)),)
    ),
    "a crowd of fixes in another place": lambda cloud, floor: on(
        cloud, floor, 3, (FixCosts(np.full((300, 2), 60.0), np.full(300, 1e-3), np.ones(300, dtype=bool)),)
    ),
    "ten minutes of standing": lambda cloud, floor: [
        cloud.advance(row(0.0, 1.0, 0.0, 0.02), [floor.distance]) for _ in range(600)
    ],
    "a gap that leads anywhere": lambda cloud, floor: cloud.advance(row(0.0, 400.0, 500.0, 3.0), [floor.distance]),
    "a walk out of the plan": lambda cloud, floor: cloud.advance(row(300.0, 1.0, 0.1, 0.01, 3.0), [floor.distance]),
    "a walk far out of the plan": lambda cloud, floor: cloud.advance(row(1e6, 1.0, 0.1, 0.01, 3.0), [floor.distance]),
    "nothing between two keyframes": lambda cloud, floor: [cloud.close() for _ in range(3)],
}


@pytest.mark.parametrize("fault", FAULTS)
def test_after_a_fault_fixes_bring_the_particles_back(fault):
    """Particles stay finite; after six fixes along the aisle they are nearer to the last one than to any other."""
    floor, cloud = aisle(), begun(at_once=1)
    on(cloud, floor, 1)
    with np.errstate(all="raise", under="ignore"):
        FAULTS[fault](cloud, floor)
        for k in range(6):
            on(cloud, floor, 1, at(20.0 + 10 * STRIDE * k))
        paths = cloud.paths()
        share, middle = dominant_modes(paths)[0]
    assert np.isfinite(paths.state).all()
    assert paths.weight.sum() == pytest.approx(1.0)
    assert FEWEST <= len(paths.weight) <= MOST
    assert share > 0.5
    assert paths.state[-1, :2, middle] == pytest.approx([20.0 + 50 * STRIDE, 1.0], abs=5 * STRIDE)


# Weights by the residuals of measurements of any kind


def states(n, middle=(0.0, 0.0), seed=0):
    """Random states ``(6, n)`` of particles."""
    random = np.random.default_rng(seed)
    pose = np.stack([*(np.array(middle)[:, None] + random.normal(0, 8, (2, n))), random.uniform(-np.pi, np.pi, n)])
    return np.concatenate([pose, np.tile([[1.0], [1.0], [0.0]], n)])


def total(costs, state):
    return np.sum([cost for kind in costs for cost in kind.costs(state)], axis=0)


def test_ranges_weigh_each_pose_by_its_residual():
    """By Huber's loss of the first pass; survey, bias and lag widen the sigma, to a metre at least."""
    steps, _, truth = drawn_from_the_model(40, 1)
    ranges = ranged(truth, 1)[0]
    wide = replace(ranges, sigma=np.full(len(ranges), 1.5))
    for table in (ranges, wide):
        graph = WalkGraph(steps, measurements=[table])
        kind = next(kind for kind in graph.measurements if kind.name == "ranges")
        keyframe = int(kind.keyframe[7])
        state = states(50, truth.position[20])
        expected = np.zeros(50)
        for n in np.flatnonzero(kind.keyframe == keyframe):
            anchor = table.position[table.anchor[n]]
            gap = state[:2].T - anchor
            distance = np.sqrt(np.sum(gap**2, axis=1) + NEAR_ANCHOR**2)
            _, [ahead] = kind._behind(np.array([n]), np.zeros(1))
            approach = np.sum(
                gap / distance[:, None] * np.array([rotation(angle) @ ahead for angle in state[2]]), axis=1
            )
            variance = table.sigma[n] ** 2 + 0.1**2 + RANGES.bias**2 + (RANGES.lag * approach) ** 2
            s = (distance - table.range[n]) / np.sqrt(np.maximum(variance, PARTICLES.least_sigma**2))
            huber = np.where(np.abs(s) > 2.45, 2.45 * (np.abs(s) - 2.45 / 2), s**2 / 2)
            expected += np.minimum(huber, PARTICLES.outlier_price)
        assert total(pose_costs([kind], keyframe), state) == pytest.approx(expected, rel=0.02, abs=0.02)


def test_the_cost_of_a_range_does_not_depend_on_the_number_of_others():
    """Nor where there are as many ranges as keyframes: the walked track belongs to the walk, not to the ranges."""
    steps, _, truth = drawn_from_the_model(40, 1)
    ranges, state, costs = ranged(truth, 1)[0], states(50, truth.position[20]), dict[int, np.ndarray]()
    few = take(replace(ranges, sigma=np.full(len(ranges), 1.5)), ranges.time < 4.0)
    graph = WalkGraph(steps, measurements=[few])
    keyframes = len(graph.chain.time)
    for n in (keyframes - 1, keyframes, keyframes + 1):
        more = take(few, np.minimum(np.arange(n), len(few) - 1))  # the last range again and again
        kind = RangeFactor.of(more, steps, graph.prior).bind(graph.chain)
        costs[n] = total(pose_costs([kind], int(kind.keyframe[2])), state)
    below, equal, above = (costs[keyframes + by] for by in (-1, 0, 1))
    assert below == pytest.approx(above, rel=1e-12)
    assert equal == pytest.approx(below, rel=1e-12)


def test_levels_of_many_poses_are_those_of_each_alone():
    """As many beacons as levels: the table of beacons is not taken for one of instances."""
    truth = dead_reckon(square_walk())
    beacons = beacons_about(truth)
    graph = WalkGraph(square_walk(), levels=levels_along(heard(truth, beacons.position), beacons, square_walk()))
    kind = next(kind for kind in graph.measurements if kind.name == "beacons")
    keyframe = int(kind.keyframe[0])
    state, costs = states(20), pose_costs([kind], keyframe)
    alone = [total(costs, state[:, n : n + 1])[0] for n in range(20)]
    assert total(costs, state) == pytest.approx(alone)

    # One pose by the factors themselves, of which the same keyframe is evaluated in the walk
    here = graph.start.poses.copy()
    here[keyframe] = state[:3, 4]
    at = graph.evaluate(graph.start.replaced(x=here))
    [block] = at.blocks_of("beacons")
    bound = kind.keyframe[kind.keyframe >= 0] == keyframe
    narrow = block.loss.cost(block.deviation)[: len(bound)][bound].sum()
    assert 0 < alone[4] < narrow, "the path loss and the places are uncertain"


def test_a_kind_with_other_poses_has_no_say():
    """Of a loop closure at two keyframes, one pose says nothing."""
    steps, fixes, _ = drawn_from_the_model(30, 0)
    graph = WalkGraph(steps, fixes)
    assert all(len(list(kind.costs(states(3)))) for kind in pose_costs(graph.measurements, 0))
    assert pose_costs([kind for kind in graph.measurements if kind.name in ("steps", "calibration", "start")], 0) == ()


ANCHORS = {1: (9.6, 12.7), 2: (12.6, 14.5), 3: (23.9, 7.3)}  # [m] in the office


def office(seed):
    """The office's walk: its plan, steps, truth and distances from one anchor every other second, without a fix."""
    made, steps = scenario_walk("office", seed=seed)
    [floor], truth, random = made.scenario.plans.values(), made.truth, np.random.default_rng(seed)
    time = np.arange(truth.time[0] + 0.5, truth.time[-1] - 0.5, 2.0)
    anchor = np.array([ANCHORS[seed]])
    distance = np.hypot(*(interpolate(time, truth.time, truth.position) - anchor).T)
    detour = np.where(random.random(len(time)) < 0.2, random.exponential(3.0, len(time)), 0.0)
    measured = np.maximum(distance + random.normal(0, 0.5, len(time)) + detour, 0.0)
    rows = np.zeros(len(time), dtype=np.intp)
    ranges = Ranges(time, rows, measured, np.full(len(time), 0.5), ("A",), anchor, np.array([0.1]))
    return floor, steps, truth, ranges


def walked_by_one_anchor(seed):
    """Mean error [m]."""
    floor, steps, truth, ranges = office(seed)
    track = pdr.smooth(WalkGraph(steps, floor=floor, measurements=[ranges])).trajectory
    return float(np.hypot(*(track.position - interpolate(track.time, truth.time, truth.position)).T).mean())


@pytest.mark.parametrize("seed", [1, thorough(2), thorough(3)])
def test_ranges_to_one_anchor_find_the_route_on_a_plan(seed):
    """One anchor leaves a circle at each moment, and walls alone the wrong corridor: together they are right."""
    assert walked_by_one_anchor(seed) < 2.0


@pytest.mark.thorough
def test_without_the_ranges_the_particles_are_farther_off(monkeypatch):
    """Control: weighed by fixes and headings alone, they take another corridor with some versions of NumPy."""
    weighed = max(walked_by_one_anchor(seed) for seed in ANCHORS)

    def some(measurements, keyframe):
        return pose_costs([kind for kind in measurements if isinstance(kind, WeighsPoses)], keyframe)

    monkeypatch.setattr(filter_module, "pose_costs", some)
    assert max(walked_by_one_anchor(seed) for seed in ANCHORS) > 1.5 * weighed
