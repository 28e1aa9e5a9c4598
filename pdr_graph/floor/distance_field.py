"""Signed distance to the nearest wall, computed where the walk is."""

from __future__ import annotations

from threading import Lock

import numpy as np
import shapely

from pdr_graph.priors import PLANS
from pdr_graph.types import Array, Index

NODE_SPACING = 0.25  # [m] between grid nodes: bilinear error of 0.05 m at the 99th percentile
NODES = 33  # per side of a tile, whose border nodes it shares with its neighbours: 8 m
BLOCKS = 3  # per side of a tile, for each of which the walls nearby are sought
PAIRS = 1000  # pairs of a block and a wall
TILE = NODE_SPACING * (NODES - 1)
PIXEL_BITS = 6
PIXELS = 1 << PIXEL_BITS  # per side of a tile, for `DistanceField.approximate`
NOT_COMPUTED = np.iinfo(np.intp).min  # address of a tile that was not computed
OPEN_DISTANCE = 1.0  # [m] to the walls in a tile that is not computed yet
STORING = Lock()  # held while tiles are stored: a walk and what is computed beside it share a field
SURROUNDING_TILES = 13  # around the plan that have a place in the table: a walk may leave the plan


class DistanceField:
    """Distance [m] to the nearest wall, positive where one can walk, negative inside walls and outside the floor.

    Distances are exact at the nodes of a grid and bilinear between them. Nodes are computed in tiles when a walk first
    comes near, so that the cost does not depend on the size of the floor.
    """

    def __init__(self, walkable: shapely.Geometry, barriers: shapely.Geometry | None = None):
        """walkable: (multi)polygon where one can walk; barriers: lines in it that are walls. [m]"""
        half = PLANS.narrowest / 2
        # corners per metre of walls: a finer outline is a curve that was cut into pieces
        if shapely.get_num_coordinates(walkable) > 20.0 * shapely.length(walkable):
            walkable = shapely.simplify(walkable, 0.01)
        self._walkable = shapely.buffer(shapely.buffer(walkable, -half), half, join_style="mitre")
        if shapely.is_empty(self._walkable):
            raise ValueError(f"no walkable area wider than {PLANS.narrowest} m")
        lines = shapely.get_rings(shapely.get_parts(self._walkable))
        if barriers is not None:
            lines = np.concatenate([lines, shapely.get_parts(shapely.line_merge(barriers))])
        corners = [shapely.get_coordinates(line) for line in lines]
        self._ends = np.concatenate([np.stack([c[:-1], c[1:]], axis=1) for c in corners])
        self._tree = shapely.STRtree(np.asarray(shapely.linestrings(self._ends)))
        low, high = shapely.bounds(self._walkable).reshape(2, 2)
        self._corner = (np.floor(low / TILE) - SURROUNDING_TILES) * TILE
        self._columns, self._rows = (np.ceil((high - self._corner) / TILE).astype(int) + SURROUNDING_TILES).tolist()
        self._slot = np.full((self._columns, self._rows), -1)  # of each tile in storage
        self._last_pixel = PIXELS * np.array([[self._columns], [self._rows]]) - 1
        # Address of each tile's pixels in storage, less that of its pixels in the whole grid
        self._address = np.full(self._columns * self._rows, NOT_COMPUTED)
        self._count = 0  # of tiles in storage
        self._tiles = np.empty((0, NODES, NODES))
        self._pixels = np.empty((0, PIXELS, PIXELS))
        shapely.prepare(self._walkable)
        shapely.contains_xy(self._walkable, *shapely.bounds(self._walkable)[:2])  # completes it, for several threads

    def at(self, points: Array) -> tuple[Array, Array]:
        """Distance ``(n,)`` [m] and its gradient ``(n, 2)`` at points ``(n, 2)`` [m]."""
        nodes = (points - self._corner) / NODE_SPACING
        node = np.clip(nodes.astype(np.intp), 0, (NODES - 1) * np.array([self._columns, self._rows]) - 1)
        tile, (ix, iy) = node // (NODES - 1), (node % (NODES - 1)).T
        slot = self._slots(tile)
        fx, fy = (nodes - node).T
        d00, d10 = self._tiles[slot, iy, ix], self._tiles[slot, iy, ix + 1]
        d01, d11 = self._tiles[slot, iy + 1, ix], self._tiles[slot, iy + 1, ix + 1]
        distance = (d00 * (1 - fx) + d10 * fx) * (1 - fy) + (d01 * (1 - fx) + d11 * fx) * fy
        by_x = (d10 - d00) * (1 - fy) + (d11 - d01) * fy
        by_y = (d01 - d00) * (1 - fx) + (d11 - d10) * fx
        return distance, np.stack([by_x, by_y], axis=1) / NODE_SPACING

    def exact(self, points: Array) -> Array:
        """Distance ``(n,)`` [m] at a few points ``(n, 2)`` [m], without the grid."""
        distance = np.empty(len(points))
        (which, _), nearest = self._tree.query_nearest(shapely.points(points), return_distance=True, all_matches=False)
        distance[which] = nearest
        return np.where(shapely.contains_xy(self._walkable, *points.T), distance, -distance)

    def no_tiles(self) -> Index:
        """The tiles of a user of `approximate` who has none yet."""
        return np.full_like(self._address, NOT_COMPUTED)

    def approximate(self, places: Array, at_once: int | None = None, tiles: Index | None = None) -> Array:
        """Distance ``(…)`` [m] at places ``(2, …)`` [m], accurate to 0.1 m: that of a pixel of 0.125 m.

        at_once: most tiles that are computed in this call, where most of the places are; in other tiles the distance is
        1 m for now. tiles: of this user, from `no_tiles`, so that tiles that others compute make no difference. For a
        thousand places most of the time goes into calling numpy, so that there are few calls and they work in place.
        """
        scaled = places.reshape(2, -1) - self._corner[:, None]
        scaled *= PIXELS / TILE
        pixel = scaled.astype(np.intp)
        np.maximum(pixel, 0, out=pixel)
        np.minimum(pixel, self._last_pixel, out=pixel)
        tile, row = pixel >> PIXEL_BITS
        tile *= self._rows
        tile += row
        known = self._address if tiles is None else tiles
        address = known.take(tile)
        if address.min(initial=0) == NOT_COMPUTED:
            missing, wanted = np.unique(tile[address == NOT_COMPUTED], return_counts=True)
            missing = missing[np.argsort(-wanted)[:at_once]]
            self._slots(np.stack(np.divmod(missing, self._rows), axis=1))
            known[missing] = self._address[missing]
            address = known.take(tile)
        address += pixel[0]
        pixel[1] <<= PIXEL_BITS
        address += pixel[1]
        distance = self._pixels.take(address, mode="clip")
        if at_once is not None:
            distance[address < 0] = OPEN_DISTANCE
        return distance.reshape(places.shape[1:])

    def _slots(self, tile: Index) -> Index:
        """Slots ``(n,)`` of tiles ``(n, 2)`` in storage; missing tiles are computed first."""
        slot = self._slot[tile[:, 0], tile[:, 1]]
        if (slot < 0).any():
            self._store(np.unique(tile[slot < 0], axis=0))
            slot = self._slot[tile[:, 0], tile[:, 1]]
        return slot

    def _store(self, missing: Index) -> None:
        """Compute and store tiles ``(n, 2)``."""
        tiles = np.stack([self._compute(t) for t in missing])
        with STORING:
            self._keep(missing, tiles)

    def _keep(self, missing: Index, tiles: Array) -> None:
        """Store tiles ``(n, 2)`` of distances; a reader finds a tile only when it is complete."""
        x, y = missing.T
        slot = self._count + np.arange(len(missing))
        self._count += len(missing)
        if self._count > len(self._tiles):  # storage doubles: otherwise a long walk would copy it for every tile
            more = 2 * self._count - len(self._tiles)
            self._tiles = np.concatenate([self._tiles, np.empty((more, NODES, NODES))])
            self._pixels = np.concatenate([self._pixels, np.empty((more, PIXELS, PIXELS))])
        self._tiles[slot] = tiles
        self._pixels[slot] = _pixels(tiles)
        self._slot[x, y] = slot
        self._address[x * self._rows + y] = (slot << 2 * PIXEL_BITS) - (((y << PIXEL_BITS) + x) << PIXEL_BITS)

    def _compute(self, tile: Index) -> Array:
        """Exact signed distances ``(NODES, NODES)`` at the nodes of one tile, rows along y. [m]"""
        x, y = (self._corner + tile * TILE)[:, None] + np.arange(NODES) * NODE_SPACING
        distance = self._distances(x, y)
        inside = np.empty(distance.shape, dtype=bool)
        # No wall is between neighbours of which one is farther from all walls than from the other; 1 % for rounding
        first = np.ones(distance.shape, dtype=bool)
        first[:, 1:] = np.maximum(distance[:, 1:], distance[:, :-1]) < 1.01 * NODE_SPACING
        row, column = np.nonzero(first)
        inside[first] = shapely.contains_xy(self._walkable, x[column], y[row])
        same_as = np.maximum.accumulate(np.where(first, np.arange(NODES), 0), axis=1)
        return np.where(np.take_along_axis(inside, same_as, axis=1), distance, -distance)

    def _distances(self, x: Array, y: Array) -> Array:
        """Distance ``(NODES, NODES)`` [m] of the nodes at x, y ``(NODES,)`` [m] from the nearest wall.

        Block by block of nodes: what is nearest to any of them lies within their diagonal of what is nearest to the
        middle one.
        """
        x, y = x.reshape(BLOCKS, -1), y.reshape(BLOCKS, -1)
        middle = x.shape[1] // 2
        row, column = np.divmod(np.arange(BLOCKS**2), BLOCKS)
        middles = shapely.points(x[column, middle], y[row, middle])
        (which, _), nearest = self._tree.query_nearest(middles, return_distance=True, all_matches=False)
        reach = np.empty(len(row))
        reach[which] = nearest + np.sqrt(2) * NODE_SPACING * x.shape[1]
        block, wall = self._tree.query(middles, predicate="dwithin", distance=reach)
        least = np.full((len(row), len(x.T), len(y.T)), np.inf)
        for begin in range(0, len(block), PAIRS):  # many walls in one place are no reason to need memory
            some, walls = block[begin : begin + PAIRS], wall[begin : begin + PAIRS]
            apart = _from_segments(x[column[some], None, :], y[row[some], :, None], self._ends[walls])
            here, start = np.unique(some, return_index=True)
            least[here] = np.minimum(least[here], np.minimum.reduceat(apart, start))
        return least.reshape(BLOCKS, BLOCKS, *least.shape[1:]).swapaxes(1, 2).reshape(NODES, NODES)


def _from_segments(x: Array, y: Array, ends: Array) -> Array:
    """Distance ``(p, …)`` [m] of points at x, y ``(p, …)`` from segments ``(p, 2, 2)``, as GEOS computes it."""
    (ax, ay), (bx, by) = ends.transpose(1, 2, 0)[..., None, None]
    dx, dy, to_x, to_y = bx - ax, by - ay, x - ax, y - ay
    square = dx * dx + dy * dy
    square[square == 0.0] = 1.0
    share = (to_x * dx + to_y * dy) / square
    to_end = np.where(share <= 0.0, to_x * to_x + to_y * to_y, np.square(x - bx) + np.square(y - by))
    beside = np.abs((dy * to_x - dx * to_y) / square) * np.sqrt(square)
    return np.where((share > 0.0) & (share < 1.0), beside, np.sqrt(to_end))


def _pixels(tiles: Array) -> Array:
    """Bilinear means ``(n, PIXELS, PIXELS)`` in the quarters of the grid squares of tiles ``(n, NODES, NODES)``."""
    for axis in (1, 2):
        low, high = np.take(tiles, range(NODES - 1), axis), np.take(tiles, range(1, NODES), axis)
        halves = np.stack([0.75 * low + 0.25 * high, 0.25 * low + 0.75 * high], axis=axis + 1)
        shape = [*tiles.shape]
        shape[axis] = PIXELS
        tiles = halves.reshape(shape)
    return tiles
