"""The aisles along which the walks of the experiments are simulated: scripts/aisles.py."""

from pathlib import Path

import numpy as np
import pytest
import shapely
from plans import MAPS, plan
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pdr_graph import FloorPlan
from pdr_graph.floor.network import corridor_area

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def aisles(scripts_on_path):
    import aisles

    return aisles


def streets(seed):
    """Wide and narrow streets that cross a main street at right angles, with kiosks where there is room."""
    random = np.random.default_rng(seed)
    main = shapely.box(0, -random.uniform(1, 6), 80, random.uniform(1, 6))
    across = [
        shapely.box(x, -random.uniform(0, 30), x + random.uniform(0.8, 8), random.uniform(0, 30))
        for x in np.sort(random.uniform(0, 72, 6))
    ]
    kiosks = [shapely.box(x, -0.5, x + 1.5, 0.5) for x in random.uniform(0, 78, 3)]
    turned = shapely.union_all([main, *across]) - shapely.union_all(kiosks)
    return shapely.affinity.rotate(turned, random.uniform(0, 90), origin=(0, 0))


def test_the_aisles_of_the_loop_are_the_links_that_are_drawn(aisles):
    """Within 0.1 m, as the medial axis is sampled."""
    loop = FloorPlan.load(MAPS / "loop.geojson")
    assert aisles.aisles_of(loop)[1] is loop.network.lines
    _, lines = aisles.derive(corridor_area(loop.cells, loop.walkable))
    derived, drawn = (shapely.MultiLineString(list(some)) for some in (lines, loop.network.lines))
    assert len(lines) == 4
    assert shapely.hausdorff_distance(derived, drawn, densify=0.1) < 0.15


@pytest.mark.parametrize("seed", range(12))
def test_aisles_are_walkable_and_connected(aisles, seed):
    """The aisles have as many parts as the area without passages narrower than 0.6 m."""
    ways = streets(seed)
    links, lines = aisles.derive(ways)
    assert shapely.covers(ways, shapely.MultiLineString(lines))
    ends, numbered = np.unique(links, return_inverse=True)
    joined = coo_array((np.ones(len(links)), numbered.reshape(-1, 2).T), shape=(len(ends),) * 2)
    count = connected_components(joined, directed=False)[0]
    open_enough = shapely.buffer(shapely.buffer(ways, -0.3), 0.3)
    assert count == shapely.get_num_geometries(open_enough)
    for node in ends:  # the lines that meet at a node end at one place
        places = [line[-end] for link, line in zip(links, lines, strict=True) for end in (0, 1) if link[end] == node]
        assert np.ptp(places, axis=0) == pytest.approx(0, abs=1e-9)


def test_recesses_have_no_aisle_and_dead_ends_do(aisles):
    street = shapely.box(0, 0, 40, 3)
    links, _ = aisles.derive(shapely.union_all([street, shapely.box(10, 3, 12, 4)]))
    assert len(links) == 1
    links, _ = aisles.derive(shapely.union_all([street, shapely.box(10, 3, 12, 12)]))
    assert len(links) == 3


def test_rooms_behind_doors_have_no_aisle(aisles):
    """A corridor without intersections and a room with a door."""
    hall = ("corridor", shapely.box(0, 0, 30, 2))
    room, door = ("room", shapely.box(10, 2, 20, 12)), ("door", shapely.LineString([(14, 2), (15, 2)]))
    _, (line,) = aisles.aisles_of(plan(hall, room, door))
    assert line[:, 1] == pytest.approx(1.0, abs=0.1)


def test_a_single_hall_has_at_most_one_aisle(aisles):
    assert len(aisles.aisles_of(plan(("floor", shapely.box(0, 0, 9, 6))))[0]) <= 1
    assert aisles.aisles_of(plan(("floor", shapely.box(0, 0, 0.5, 0.5))))[0].shape == (0, 2)
