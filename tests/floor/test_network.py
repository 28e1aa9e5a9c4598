"""The walkable network as a plan draws it, and as derived from polygons."""

import numpy as np
import pytest
import shapely
from plans import MAPS, plan
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pdr_graph import FloorPlan
from pdr_graph.floor.network import derive

W, X, Y = 2.5, 45.0, 28.0  # [m] of maps/loop.geojson


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


def test_the_derived_network_of_the_loop_equals_the_drawn_one():
    """Within 0.1 m, as the medial axis is sampled."""
    drawn = FloorPlan.load(MAPS / "loop.geojson").network
    nodes, corners, links, _ = derive(shapely.box(0, 0, X, Y) - shapely.box(W, W, X - W, Y - W))
    order = [int(np.argmin(np.hypot(*(nodes - n).T))) for n in drawn.nodes]
    assert sorted(order) == list(range(len(nodes)))
    assert nodes[order] == pytest.approx(drawn.nodes, abs=0.1)
    for mine, theirs in zip(corners[order], drawn.corners, strict=True):
        apart = np.hypot(*(mine[:, None] - theirs[None]).T)
        assert apart.min(axis=0).max() < 0.15
    renumbered = {frozenset(order.index(n) for n in link) for link in links.tolist()}
    assert renumbered == {frozenset(link) for link in drawn.links.tolist()}


@pytest.mark.parametrize("seed", range(12))
def test_links_are_walkable_and_connected(seed):
    """The network has as many parts as the area without passages narrower than 0.6 m."""
    ways = streets(seed)
    nodes, _, links, lines = derive(ways)
    assert shapely.covers(ways, shapely.multilinestrings([shapely.linestrings(line) for line in lines]))
    count = connected_components(coo_array((np.ones(len(links)), links.T), shape=(len(nodes),) * 2), directed=False)[0]
    open_enough = shapely.buffer(shapely.buffer(ways, -0.3), 0.3)
    assert count == shapely.get_num_geometries(open_enough)
    for (i, j), line in zip(links, lines, strict=True):
        assert line[[0, -1]] == pytest.approx(nodes[[i, j]])


def test_a_crossing_of_two_corridors_has_the_corners_of_both():
    ways = shapely.union_all([shapely.box(-20, -1, 20, 1), shapely.box(-1.5, -20, 1.5, 20)])
    nodes, corners, links, _ = derive(ways)
    (crossing,) = np.flatnonzero(np.bincount(links.ravel()) == 4)
    assert nodes[crossing] == pytest.approx([0, 0], abs=0.1)
    assert np.sort(np.abs(corners[crossing]), axis=0) == pytest.approx(np.tile([1.5, 1.0], (4, 1)), abs=0.15)
    assert np.isnan(np.delete(corners, crossing, axis=0)).all(), "a dead end has no corners"


def test_recesses_have_no_links_and_dead_ends_do():
    street = shapely.box(0, 0, 40, 3)
    _, _, links, _ = derive(shapely.union_all([street, shapely.box(10, 3, 12, 4)]))
    assert len(links) == 1
    _, _, links, _ = derive(shapely.union_all([street, shapely.box(10, 3, 12, 12)]))
    assert len(links) == 3


def test_rooms_behind_doors_are_not_part_of_the_network():
    """A corridor without intersections and a room with a door: the network is that of the corridor."""
    hall = ("corridor", shapely.box(0, 0, 30, 2))
    room, door = ("room", shapely.box(10, 2, 20, 12)), ("door", shapely.LineString([(14, 2), (15, 2)]))
    network = plan(hall, room, door).network
    assert len(network) == 1
    assert network.lines[0][:, 1] == pytest.approx(1.0, abs=0.1)


def test_links_follow_the_corridors_if_no_line_is_drawn():
    crossing = ("intersection", shapely.box(-1, -1, 1, 1))
    ways = [("corridor", shapely.box(1, -1, 20, 1)), ("corridor", shapely.box(-1, 1, 1, 15))]
    network = plan(crossing, *ways).network
    assert len(network.nodes) == 3
    assert len(network) == 2
    assert np.sort(network.nodes, axis=0) == pytest.approx(np.array([[0, 0], [0, 0], [20, 15]]), abs=0.01)


def test_a_single_hall_has_at_most_one_link():
    network = plan(("floor", shapely.box(0, 0, 9, 6))).network
    assert len(network.links) <= 1
    assert plan(("floor", shapely.box(0, 0, 0.5, 0.5))).network.nodes.shape == (0, 2)
