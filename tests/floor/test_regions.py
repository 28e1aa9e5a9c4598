"""Regions: the parts that doors divide, and which of them a walk is in."""

import numpy as np
import pytest
import shapely
from plans import plan

from pdr_graph.floor.cells import NOWHERE
from pdr_graph.priors import REGIONS

HALL = ("corridor", "hall", shapely.box(0, 0, 20, 3))
AISLE = ("corridor", "aisle", shapely.box(8, -6, 11, 0))
ROOMS = (("room", "A", shapely.box(0, 3.12, 9.94, 9)), ("room", "B", shapely.box(10.06, 3.12, 20, 9)))
DOOR_OF_A = ("door", "", shapely.box(4, 2.95, 5, 3.2))
HALLS_REGION, A, B = 0, 1, 2


@pytest.fixture(scope="module")
def regions():
    return plan(HALL, AISLE, *ROOMS, DOOR_OF_A).regions


def track(*corners, step=0.25):
    """Points along the line through corners ``(n, 2)``."""
    line = shapely.LineString(corners)
    return shapely.get_coordinates(shapely.line_interpolate_point(line, np.arange(0, line.length, step)))


def test_all_corridors_are_one_region_and_every_room_is_one(regions):
    assert len(regions) == 3
    assert shapely.area(regions.polygons) == pytest.approx([60 + 18, 9.94 * 5.88, 9.94 * 5.88], abs=0.1)
    assert regions.joins.tolist() == [[True, True, False]], "A's door joins it to the hall"


def test_a_plan_without_cells_is_one_region():
    floor = plan(("floor", "", shapely.box(0, 0, 30, 20)), ("shop", "", shapely.box(5, 5, 10, 10)))
    assert len(floor.regions) == 1
    assert floor.regions.along(track((1, 1), (20, 1)))[0].tolist() == [0] * 76


WALKS = {
    "through a door": ([(1, 1.5), (4.5, 1.5), (4.5, 6)], HALLS_REGION, A, REGIONS.door_cost),
    "through the wall of a room without a door": ([(15, 1.5), (15, 8)], HALLS_REGION, B, REGIONS.wall_cost),
    "from a room with a door into one without": ([(4.5, 6), (18, 6)], A, B, REGIONS.wall_cost),
}


@pytest.mark.parametrize("name", WALKS)
def test_a_change_of_region_has_the_cost_of_what_is_between(regions, name):
    corners, begin, end, cost = WALKS[name]
    region, price = regions.along(track(*corners))
    assert (region[0], region[-1]) == (begin, end)
    assert np.count_nonzero(np.diff(region)) == 1
    assert price == pytest.approx(cost)


def test_one_step_into_a_room_does_not_change_the_region(regions):
    """The track errs by half a metre, and there is no door."""
    strays = track((8, 1.5), (18, 1.5))
    strays[20:22, 1] = 3.5
    region, price = regions.along(strays)
    assert set(region) == {HALLS_REGION}
    assert price == 0


def test_a_walk_far_from_all_regions_is_in_none_at_low_cost(regions):
    region, price = regions.along(track((100, 100), (110, 100)))
    assert set(region) == {NOWHERE}
    assert price == pytest.approx(REGIONS.outside_price * len(region))


def test_the_field_of_a_region_is_negative_beyond_a_thin_wall(regions):
    """The field of all walls is positive on both sides of a wall of 12 cm."""
    beyond = np.array([[15.0, 3.5], [15.0, 5.0]])
    assert np.all(regions.field((HALLS_REGION,)).at(beyond)[0] < -0.3)
    assert np.all(regions.field((B,)).at(beyond)[0] > 0.3)


def test_the_field_of_two_regions_is_open_at_their_door(regions):
    both = regions.field((HALLS_REGION, A))
    assert both.at(np.array([[4.5, 3.06]]))[0] > 0, "in the door"
    through = both.at(np.column_stack([np.full(9, 4.5), np.linspace(2, 4, 9)]))[0]
    assert through.min() > 0.2, "half a door, as a grid of 25 cm has it"
    assert both.at(np.array([[15.0, 5.0]]))[0] < 0, "in the third region"


def test_the_walls_at_a_change_of_region_are_those_of_both(regions):
    points = track((4.5, 1.0), (4.5, 6))
    fields, which, price = regions.walls_along(points)
    assert price == pytest.approx(REGIONS.door_cost)
    used = [fields[w] for w in which]
    assert used[0] is regions.field((HALLS_REGION,))
    assert used[-1] is regions.field((A,))
    assert regions.field((HALLS_REGION, A)) in used
