"""On which floor each piece of a walk is, and the walls about it."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from plans import MAPS
from walks import fixes_at, steps_of

from pdr_graph import FloorPlan, WalkGraph
from pdr_graph.floor.building import FloorSequence
from pdr_graph.floor.cells import NOWHERE, Area
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import Frame


@pytest.fixture(scope="module")
def office():
    return Building.load(MAPS / "two_floors.geojson")


@pytest.fixture(scope="module")
def stairs(office):
    return next(c for c in office.connections if c.kind == "stairs")


def up_the_stairs(stairs):
    """A walk to the stairs, up, and away: positions ``(n, 2)`` and the label of each piece."""
    x, y = shapely.get_coordinates(shapely.centroid(stairs.polygon))[0]
    low = shapely.bounds(stairs.polygon)[1]
    to = np.array([[x, low - 1.5], [x, low - 0.5], [x, low + 0.5], [x, y]])
    return np.concatenate([to, to[::-1]]), ["1"] * 4 + ["2"] * 4


def test_a_single_floor_needs_no_labels():
    plan = FloorPlan.load(MAPS / "office.geojson")
    floor_sequence = FloorSequence.of(plan, ["", "", ""])
    assert floor_sequence.level.tolist() == [0, 0, 0]
    assert floor_sequence.changes == {}
    assert floor_sequence.field(2) is plan.distance


def test_an_unknown_label_is_refused(office):
    with pytest.raises(ValueError, match="floors: found '3', expected labels out of 1, 2"):
        FloorSequence.of(office, ["1", "3"])


def test_a_floor_change_lists_the_connections_between_its_floors(office):
    changes = FloorSequence.of(office, ["1", "1", "2", "2", "1"]).changes
    assert list(changes) == [2, 4]
    assert {way.kind for way in changes[2]} == {"stairs", "lift"}


def test_before_a_floor_change_the_field_is_that_of_the_nearest_stairs(office, stairs):
    track, labels = up_the_stairs(stairs)
    floor_sequence = FloorSequence.of(office, labels)
    fields, which, _ = floor_sequence.walls_along(track, np.ones(len(track), dtype=bool))
    assert fields[which[3]] is stairs.field
    assert [fields[w] is stairs.field for w in which] == [n == 3 for n in range(8)]
    inside, _ = stairs.field.at(track[3:4])
    outside, _ = stairs.field.at(track[:1])
    assert inside > 0 > outside


def test_while_standing_the_last_step_before_a_floor_change_has_the_field(office, stairs):
    """In a lift the pieces before the change have length 0."""
    track, labels = up_the_stairs(stairs)
    moved = np.array([True, True, True, False, False, True, True, True])
    fields, which, _ = FloorSequence.of(office, labels).walls_along(track, moved)
    assert fields[which[2]] is stairs.field
    assert fields[which[3]] is not stairs.field


def test_walls_of_another_floor_have_no_effect(office):
    """A position that is solid on one floor and walkable on the other."""
    grid = np.stack(np.meshgrid(np.arange(-1, 45, 0.5), np.arange(0, 18, 0.5)), axis=-1).reshape(-1, 2)
    below, above = (office[label].distance.at(grid)[0] for label in ("1", "2"))
    (differs,) = np.nonzero((below > 0.5) & (above < -0.5))
    assert len(differs), "the floors are not the same"
    place = grid[differs[:1]]
    fields, which, _ = FloorSequence.of(office, ["1"]).walls_along(place, np.ones(1, dtype=bool))
    assert which[0] != NOWHERE
    assert fields[which[0]].at(place)[0] > 0.3


def test_a_cropped_plan_has_the_walls_of_the_whole():
    """In a grid of ten by ten malls, distances within a box around one are the same, with few of the other areas."""
    mall = FloorPlan.load(MAPS / "mall.geojson")
    wide, high = mall.corners[1] - mall.corners[0]
    places = [np.array([i * wide, j * high]) for i in range(10) for j in range(10)]
    areas = [
        replace(area, shape=shapely.transform(area.shape, lambda c, place=place: c + place))
        for place in places
        for area in mall.areas
    ]
    whole = FloorPlan("1", tuple(areas), mall.frame)
    low, top = whole.corners.mean(axis=0) - 10, whole.corners.mean(axis=0) + 10
    part = whole.within(low, top)
    assert len(part.areas) < len(areas) / 10
    points = np.random.default_rng(0).uniform(low + 5, top - 5, (2000, 2))
    expected, found = whole.distance.at(points)[0], part.distance.at(points)[0]
    near = np.abs(expected) < 5  # [m]: so far the box reaches beyond
    assert found[near] == pytest.approx(expected[near], abs=0.01)


def test_cropping_to_an_empty_box_returns_the_whole_plan():
    plan = FloorPlan.load(MAPS / "office.geojson")
    assert plan.within(np.array([500.0, 500.0]), np.array([510.0, 510.0])) is plan
    assert FloorSequence.of(plan, [""]).within(*plan.corners).building.floors == (plan,)


def test_the_reach_of_a_walk_is_its_length():
    """Times 1.5, since strides may be underestimated."""
    pieces = tuple(Area("corridor", "", shapely.box(x, 0, x + 10, 3)) for x in range(0, 1000, 10))
    floor = FloorPlan("1", pieces, Frame())
    graph = WalkGraph(steps_of(np.full(100, 0.7), np.zeros(100)), fixes_at([0.0], [[505.0, 1.5]], 0.3), floor=floor)
    kept = graph.floor_sequence.building.floors[0].corners
    assert kept[0, 0] == pytest.approx(505 - 1.5 * 70 - 20, abs=11)
    assert kept[1, 0] == pytest.approx(505 + 1.5 * 70 + 20, abs=11)
