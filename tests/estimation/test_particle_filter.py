"""The particle filter on a plan with walls, fixes and stairs."""

import numpy as np
import pytest
import shapely
from plans import MAPS, plan
from walks import fixes_at, steps_of

from pdr_graph import Headings, WalkGraph
from pdr_graph.estimation.particle_filter import Walls, particle_filter, stepped
from pdr_graph.floor.plan_files import Building
from pdr_graph.priors import PARTICLES, REGIONS
from pdr_graph.types import Fixes

SIGMA = np.array([0.07, 0.25, 0.02])  # of a step's length, sway [m] and turn [rad]


def graph_of(steps, floor, start, heading=0.0, more=(), **given):
    """A walk from a known start and heading, with further fixes (time, place)."""
    time, place = zip((steps.start, start), *more, strict=True) if more else ([steps.start], [start])
    there = Headings(np.array([steps.start]), np.array([heading]), np.array([0.1]))
    return WalkGraph(steps, fixes_at(time, place, 0.3), headings=there, floor=floor, **given)


def crowd(n, x, y, theta=0.0):
    """Particles ``(6, n)`` in one place."""
    return np.tile(np.array([x, y, theta, 1.0, 1.0, 0.0])[:, None], n)


def crosses(floor, before, after):
    return floor.crosses_wall(before[:2].T, after[:2].T)


# One step, and a wall


def test_no_particle_crosses_a_thin_wall():
    """Rooms that share an edge. Who walks at it obliquely draws their errors again, until they pass beside."""
    floor = plan(("room", shapely.box(0, 0, 10, 4)), ("room", shapely.box(0, 4, 10, 8)), ("door", shapely.Point(9, 4)))
    random = np.random.default_rng(0)
    before = crowd(4000, 2.0, 3.7, theta=0.2)
    after, price = stepped(before, 0.7, 0.0, 0.5, SIGMA, Walls(floor.distance), random)
    paid = price >= REGIONS.wall_cost
    assert not crosses(floor, before, after)[~paid].any()
    assert np.mean(paid) < 0.3, "most find a way along the wall"
    assert np.all(price[~paid] < np.log(5) + 0.2), "having drawn again costs at most one of five"


def test_a_wall_without_a_way_round_is_crossed_at_its_price():
    """In a dead end all particles pay for the wall."""
    floor = plan(("corridor", shapely.box(0, 0, 10, 2)))
    before = crowd(500, 9.7, 1.0)
    after, price = stepped(
        before, 0.7, 0.0, 0.5, np.array([0.01, 0.01, 0.01]), Walls(floor.distance), np.random.default_rng(0)
    )
    assert after[0].mean() == pytest.approx(10.4, abs=0.02)
    assert np.all(price == REGIONS.wall_cost)


def test_a_step_inside_a_solid_area_costs_little():
    """Somebody entered a shop: each step there has a small cost, not that of a wall."""
    floor = plan(("floor", shapely.box(0, 0, 40, 40)), ("shop", shapely.box(10, 10, 30, 30)))
    before = crowd(100, 20.0, 20.0)
    _, price = stepped(before, 0.7, 0.0, 0.5, SIGMA, Walls(floor.distance), np.random.default_rng(0))
    assert np.all((price > 0) & (price < 1))


# A walk


def test_in_the_open_particles_have_the_covariance_of_dead_reckoning(monkeypatch):
    """An independent oracle: the covariance of the end by propagating each error to first order."""
    for name, value in {"fewest": 20_000, "most": 20_000, "wide": (1, 1, 1), "calm": (1, 1, 1)}.items():
        monkeypatch.setitem(vars(PARTICLES), name, value)
    n, length, heading_sigma, fix_sigma = 30, 0.7, 0.1, 1.0
    steps = steps_of(np.full(n, length), np.zeros(n), sigma_length=0.07, sigma_turn=0.02)
    floor = plan(("floor", shapely.box(-500, -500, 500, 500)))
    there = Headings(np.array([0.0]), np.array([0.0]), np.array([heading_sigma]))
    graph = WalkGraph(steps, fixes_at([0.0], [[0.0, 0.0]], fix_sigma), headings=there, floor=floor)
    paths = particle_filter(graph)

    # Ahead: the start, the stride's prior and drift along the walk, each step's own error
    prior, pieces = graph.prior, graph.pieces
    way, moving = n * length, pieces.length > 0
    left = np.cumsum(pieces.length[::-1])[::-1] - pieces.length / 2  # [m] still to go from the middle of each piece
    # particles start twice as uncertain as the heading says, once by the start and once by the heading's own weight
    start_turn = heading_sigma**2 / 2
    # calibration changes by its random walk after every ten steps
    blocks = graph.pieces.last + 1
    change = np.array(prior.change)
    per_block = np.array([np.sqrt(np.sum(moving[a:b]) / 100) for a, b in zip([0, *blocks[:-1]], blocks, strict=True)])
    to_go = np.array([np.sum(pieces.length[b:]) for b in blocks])
    time = 2 * (pieces.to_end - pieces.to_middle)[1]
    drift = np.array([np.sum(time[b:] * left[b:]) for b in blocks])
    ahead = fix_sigma**2 / 2 + (prior.sigma[0] * way) ** 2 + np.sum(pieces.variance[moving, 0])
    ahead += np.sum((change[0] * per_block * to_go) ** 2)
    aside = fix_sigma**2 / 2 + start_turn * way**2 + np.sum(pieces.variance[moving, 1])
    aside += np.sum(pieces.variance[:, 2] * left**2) + (prior.sigma[2] * np.sum(time * left)) ** 2
    aside += np.sum((change[2] * per_block * drift) ** 2)

    end = paths.state[-1, :2] - np.average(paths.state[-1, :2], axis=1, weights=paths.weight)[:, None]
    spread = np.sqrt(np.average(end**2, axis=1, weights=paths.weight))
    assert spread == pytest.approx(np.sqrt([ahead, aside]), rel=0.05), "20 000 particles, a few resamplings"


def two_aisles():
    """Two aisles of 2 m, 3 m apart, between cross aisles."""
    outline, shop = shapely.box(0, 0, 40, 11), shapely.box(4, 4, 36, 7)
    return plan(
        ("floor", outline), ("shop", shop), ("shop", shapely.box(4, 0, 36, 2)), ("shop", shapely.box(4, 9, 36, 11))
    )


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
    steps = steps_of(np.full(n, 0.7), np.zeros(n))
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
    steps = type(plain)(**{**plain.__dict__, "sigma_turn": sigma})
    graph = graph_of(steps, floor, [2.0, 1.2])
    ends = np.array(
        [
            np.average(paths.state[-1, :2], axis=1, weights=paths.weight)
            for paths in (particle_filter(graph, seed) for seed in range(3))  # the end differs by a metre between seeds
        ]
    )
    assert ends[:, 0].mean() == pytest.approx(2 + 0.7 * n, abs=0.15 * 0.7 * n), "as far as strides are known"
    assert np.all((ends[:, 1] > 0) & (ends[:, 1] < 2.4))


def test_the_same_seed_is_the_same_walk():
    steps = steps_of(np.full(30, 0.7), np.zeros(30))
    graph = graph_of(steps, two_aisles(), [2.0, 3.0])
    first, same, third = (particle_filter(graph, seed).state for seed in (0, 0, 1))
    assert np.array_equal(first, same)
    assert not np.array_equal(first[-1][:, :100], third[-1][:, :100])


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
    steps = steps_of(np.full(n, 0.7), np.zeros(n))
    fixes = Fixes(np.array([0.0, steps.time[-1]]), np.array([[36.0, 3.0], [2.5, 3.0]]), np.full(2, 0.5), ("", ""))
    paths = particle_filter(WalkGraph(steps, fixes, floor=two_aisles()))
    heading = np.cos(paths.state[len(paths.state) // 2, 2])
    assert np.average(heading, weights=paths.weight) < -0.95
