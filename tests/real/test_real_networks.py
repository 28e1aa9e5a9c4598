"""Networks of real floors: where people walked there is a link, and no link goes through a shop."""

import numpy as np
import pytest
import shapely

from pdr_graph import FloorPlan
from pdr_graph.io.loading import load

FLOORS = ("site1/B1", "site1/F1", "site1/F2", "site2/F1", "site2/F6")


def as_lines(network):
    return shapely.multilinestrings([shapely.linestrings(line) for line in network.lines])


@pytest.fixture(scope="module")
def floors(data):
    return {name: FloorPlan.load(data / "ms_indoor20" / name) for name in FLOORS}


@pytest.mark.thorough
def test_links_lie_where_one_can_walk(floors):
    for name, floor in floors.items():
        for line in floor.network.lines:
            assert not floor.crosses_wall(line[:-1], line[1:]).any(), name


@pytest.mark.thorough
def test_who_is_surveyed_walks_along_a_link(floors, data):
    """All within 5.5 m, 85 % within 3 m: aisles are up to 11 m wide, and a link is in the middle."""
    apart = [
        shapely.distance(as_lines(floors[name].network), shapely.points(load(path).truth.position))
        for name in FLOORS
        for path in sorted((data / "ms_indoor20" / name).glob("*.txt"))
    ]
    apart = np.concatenate(apart)
    assert apart.max() < 5.5
    assert np.mean(apart < 3) > 0.85


def test_an_office_with_doors_has_the_network_of_its_corridors(data):
    floor = FloorPlan.load(data / "ipin21_hcu" / "map" / "Plan4OG.geojson")
    network = floor.network
    assert 20 < len(network) < 150
    rooms = shapely.union_all([cell.polygon for cell in floor.cells.cells if cell.kind == "room"])
    inside = shapely.length(shapely.intersection(as_lines(network), shapely.buffer(rooms, -0.1)))
    assert inside < 0.01 * shapely.length(as_lines(network))
    for line in network.lines:
        assert not floor.crosses_wall(line[:-1], line[1:]).any()
