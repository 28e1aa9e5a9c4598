"""Aisles of real floors, see scripts/aisles.py: where people walked there is one, and none goes through a shop."""

from pathlib import Path

import numpy as np
import pytest
import shapely

from pdr_graph import FloorPlan
from pdr_graph.io.loading import load

FLOORS = ("site1/B1", "site1/F1", "site1/F2", "site2/F1", "site2/F6")


@pytest.fixture
def aisles_of(monkeypatch):
    """The lines of the aisles of a floor."""
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "scripts"))
    from aisles import aisles_of

    return lambda floor: aisles_of(floor)[1]


@pytest.fixture(scope="module")
def floors(data):
    return {name: FloorPlan.load(data / "ms_indoor20" / name) for name in FLOORS}


@pytest.mark.thorough
def test_aisles_lie_where_one_can_walk(floors, aisles_of):
    for name, floor in floors.items():
        for line in aisles_of(floor):
            assert not floor.crosses_wall(line[:-1], line[1:]).any(), name


@pytest.mark.thorough
def test_who_is_surveyed_walks_along_an_aisle(floors, data, aisles_of):
    """All within 5.5 m, 85 % within 3 m: aisles are up to 11 m wide, and their line is in the middle."""
    middle = {name: shapely.MultiLineString(aisles_of(floor)) for name, floor in floors.items()}
    apart = [
        shapely.distance(middle[name], shapely.points(load(path).truth.position))
        for name in FLOORS
        for path in sorted((data / "ms_indoor20" / name).glob("*.txt"))
    ]
    apart = np.concatenate(apart)
    assert apart.max() < 5.5
    assert np.mean(apart < 3) > 0.85


def test_an_office_with_doors_has_the_aisles_of_its_corridors(data, aisles_of):
    floor = FloorPlan.load(data / "ipin21_hcu" / "map" / "Plan4OG.geojson")
    lines = aisles_of(floor)
    assert 20 < len(lines) < 150
    rooms = shapely.union_all([cell.polygon for cell in floor.cells.cells if cell.kind == "room"])
    inside = shapely.length(shapely.intersection(shapely.MultiLineString(lines), shapely.buffer(rooms, -0.1)))
    assert inside < 0.01 * shapely.length(shapely.MultiLineString(lines))
    for line in lines:
        assert not floor.crosses_wall(line[:-1], line[1:]).any()
