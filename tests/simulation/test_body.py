"""The movement of the body is continuous, follows the route and has its events."""

from functools import cache

import numpy as np
import pytest
import shapely
from plans import MAPS

from pdr_graph import FloorPlan
from pdr_graph.geometry import interpolate
from pdr_graph.lab.simulation.scenario import Scenario, names
from pdr_graph.lab.simulation.simulate import simulate


def walked(*route, **more):
    return simulate(Scenario.of({"seed": 1, "route": list(route), "phone": {"rate": 50}} | more)).body


@cache
def scenario(name):
    return simulate(Scenario.load(name))


@pytest.mark.parametrize("name", names())
def test_the_walker_of_a_scenario_crosses_no_wall_and_is_as_fast_as_people(name):
    walk = scenario(name)
    body, at = walk.body, walk.body.position
    for label, plan in walk.scenario.plans.items():
        on_floor = np.array(walk.truth.floor) == label
        stays = on_floor[:-1] & on_floor[1:]
        assert not plan.crosses_wall(at[:-1][stays], at[1:][stays]).any()
    assert np.all(np.isfinite(walk.motion.acceleration))
    speed = np.hypot(*np.diff(at, axis=0).T) * body.rate
    assert speed.max() < 2.6
    assert np.abs(np.diff(speed) * body.rate).max() < 12


def test_steps_have_the_length_of_the_true_movement():
    """The distance between two landings is the length of the step."""
    body = walked([0, 0], {"stand": 2}, {"to": [[30, 0], [30, 20]]}, {"stand": 2})
    at = interpolate(body.landings, body.time, body.position)
    chord = np.hypot(*np.diff(at, axis=0).T)
    assert np.abs(chord - body.lengths[1:])[1:-3].max() < 0.08
    assert body.lengths.sum() == pytest.approx(50, abs=1.0)
    assert body.position[-1] == pytest.approx([30, 20], abs=0.02)


def test_headings_are_the_directions_of_the_movement():
    body = walked([0, 0], {"to": [[30, 0], [30, 20]]})
    moving = np.gradient(body.position, axis=0) * body.rate
    fast = np.hypot(*moving.T) > 0.8
    course = np.arctan2(moving[fast, 1], moving[fast, 0])
    assert np.abs(np.angle(np.exp(1j * (course - body.heading[fast])))).max() < 0.12


def test_zigzags_swing_from_side_to_side():
    straight, swinging = (walked([0, 0], {"to": [60, 0], "zigzag": z}) for z in (0.0, 0.6))
    assert np.abs(straight.position[:, 1]).max() < 0.45
    assert 0.5 < np.abs(swinging.position[:, 1]).max() < 1.2
    assert 12 < np.sum(np.diff(np.sign(swinging.position[:, 1] - 0.001)) != 0) < 40


def test_a_visitor_of_a_shop_stands_before_its_front():
    body = scenario("mall").body
    plan, visits = FloorPlan.load(MAPS / "mall.geojson"), body.events_of("visit")
    assert [v.what for v in visits] == ["Books", "Coffee", "E0", "Music"]
    for visit, stay in zip(visits, (20, 30, 15, 10), strict=True):
        assert visit.end - visit.start == pytest.approx(stay, abs=0.1)
        place = body.position[(body.time > visit.start + 0.5) & (body.time < visit.end - 0.5)]
        assert np.ptp(place, axis=0).max() < 0.05
        shop = next(a for a in plan.areas if a.name == visit.what)
        assert shapely.distance(shop.shape, shapely.Point(place[0])) < 1.0


def test_the_holds_are_those_of_the_route():
    holds = scenario("mall").body.events_of("hold")
    assert [h.what for h in holds] == ["hand", "trouser pocket", "hand", "swinging arm"]
    assert all(h.end - h.start == pytest.approx(1.4) for h in holds[1:])


def test_a_lift_has_its_speed_and_acceleration():
    body = walked([0, 0], {"to": [5, 0]}, {"lift": "2", "climb": 11.4}, {"to": [10, 0]})
    speed = np.gradient(body.height) * body.rate
    assert speed.max() == pytest.approx(1.6, abs=0.05)
    assert np.abs(np.gradient(speed) * body.rate).max() < 1.1
    assert body.height[-1] == pytest.approx(11.4, abs=0.01)
    assert body.floors[body.floor[-1]] == "2"


def test_stairs_and_lifts_climb_to_the_floors_of_the_building():
    """4 m by the plan; the floor changes half-way, and the pressure falls by 12 Pa per metre."""
    walk = scenario("two_floors")
    truth, height = walk.truth, walk.body.height
    changes = [n for n in range(1, len(truth)) if truth.floor[n] != truth.floor[n - 1]]
    assert [truth.floor[n] for n in (0, *changes)] == ["1", "2", "1"]
    assert height[changes] == pytest.approx([2, 2], abs=0.1)
    assert np.ptp(height) == pytest.approx(4.0, abs=0.01)
    air = walk.signals["barometer"]
    pressure, climbed = air.values[:, 0], np.interp(air.time, walk.body.time, height)
    levels = [np.median(pressure[np.abs(climbed - level) < 0.1]) for level in (0, 4)]
    assert levels[0] - levels[1] == pytest.approx(4 * 0.12, abs=0.04), "[hPa], and a little weather"


def test_stairs_are_climbed_step_by_step():
    body = walked([0, 0], {"to": [3, 0]}, {"stairs": "2", "to": [8, 0], "climb": 3.8}, {"to": [12, 0]})
    assert body.height[-1] == pytest.approx(3.8, abs=0.01)
    climbing = (body.landings > 0) & (np.interp(body.landings, body.time, body.height) > 0.3)
    climbing &= np.interp(body.landings, body.time, body.height) < 3.5
    assert np.median(body.lengths[climbing]) < 0.45, "treads are short"


def test_a_cart_moves_as_pushed_and_keeps_its_heading():
    """[stationary-switch]: forward 0.95 m, back 1.05 m, without a turn or a step."""
    body = scenario("cart").body
    assert len(body.landings) == 0
    assert np.ptp(body.heading) == 0
    forth, back = np.diff(body.position[:, 0]).clip(0).sum(), np.diff(body.position[:, 0]).clip(None, 0).sum()
    assert (forth, back) == (pytest.approx(0.95, abs=0.01), pytest.approx(-1.05, abs=0.01))
    assert np.abs(np.gradient(body.position[:, 0]) * body.rate).max() == pytest.approx(0.452, abs=0.01)
