"""The aisles of a floor, along which simulated walks lead: the links that its plan draws, else its medial axis.

Points on the walls are the seeds of a Voronoi diagram. Its edges between seeds of different walls are equally far from
both walls: the medial axis. Every corner and every recess has a branch of it; branches that lead nowhere are pruned.

The circle around a point that just touches the walls is free of walls, and so is every straight line in it. Therefore
all vertices within one circle become one node, and lines are straight from the node to the circle's rim: this removes
the kinks of the medial axis at openings without moving a line through a wall.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely
from scipy.spatial import KDTree, Voronoi

from pdr_graph.floor.network import corridor_area
from pdr_graph.geometry import length_along, peaks, wrap_angle


def aisles_of(floor):
    """Ends ``(l, 2)`` of the aisles of a floor, as numbers of their nodes; and their lines, ``(m, 2)`` each [m]."""
    drawn = floor.network
    return (drawn.links, drawn.lines) if len(drawn) else derive(corridor_area(floor.cells, floor.walkable))


NARROWEST_AISLE = 0.6  # [m] the width of a pair of shoulders; a narrower passage is a slit between shops
SEED_SPACING = NARROWEST_AISLE / 2  # [m] so that no line crosses a wall


@dataclass(frozen=True)
class Skeleton:
    """The medial axis as a graph.

    position: ``(v, 2)`` of the vertices [m]; clearance: ``(v,)`` distance to the nearest wall [m]; edges: ``(e, 2)``
    indices of vertices.
    """

    position: np.ndarray
    clearance: np.ndarray
    edges: np.ndarray

    @property
    def degree(self):
        """Number of edges ``(v,)`` at each vertex."""
        return np.bincount(self.edges.ravel(), minlength=len(self.position))

    def chains(self, stops=()):
        """The vertices of each line from one stop to the next; ends, junctions and the vertices ``stops`` are stops."""
        if not len(self.edges):
            return []
        merged = shapely.line_merge(shapely.multilinestrings(self.position[self.edges]))
        vertex, degree, chains = KDTree(self.position), self.degree, []
        for line in shapely.get_parts(merged):
            chain = np.asarray(vertex.query(shapely.get_coordinates(line))[1], dtype=np.intp)
            first = np.flatnonzero(np.isin(chain, stops))[:1]
            if degree[chain[0]] == 2 and len(first):  # a ring begins at a stop
                chain = np.append(np.roll(chain[:-1], -first[0]), chain[first])
            cuts = [0, *(np.flatnonzero(np.isin(chain[1:-1], stops)) + 1).tolist(), len(chain) - 1]
            chains += [chain[i : j + 1] for i, j in pairwise(cuts)]
        return chains

    def length(self, chain):
        """Length of the line through vertices ``chain (m,)``. [m]"""
        return float(np.hypot(*np.diff(self.position[chain], axis=0).T).sum())

    def recesses(self):
        """Branches with one free end that hardly leave the circle where they begin.

        Of a star in which all branches are recesses, the two longest are not: a hall keeps a line.
        """
        degree, found, at = self.degree, [], {}
        for chain in self.chains():
            for end in {int(chain[0]), int(chain[-1])}:
                at.setdefault(end, []).append(chain)
            if (degree[chain[[0, -1]]] == 1).sum() == 1:
                tip, base = chain[[0, -1]] if degree[chain[0]] == 1 else chain[[-1, 0]]
                reach = self.length(chain) + self.clearance[tip] - self.clearance[base]
                # a branch leaves the circle by 3 m and by half the radius: a corner of a square hall does by 0.41
                if reach < max(3.0, self.clearance[base] / 2):
                    found.append(chain)
        recesses, kept = {id(chain) for chain in found}, set()
        for star in at.values():
            if len(star) > 2 and recesses.issuperset(map(id, star)):
                kept |= {id(chain) for chain in sorted(star, key=self.length)[-2:]}
        return [chain for chain in found if id(chain) not in kept]


def skeleton(area):
    """The medial axis of a (multi)polygon [m], without passages narrower than 0.6 m and branches that lead nowhere.

    It is taken from the Voronoi diagram of points on the border.
    """
    half = NARROWEST_AISLE / 2
    area = shapely.buffer(shapely.buffer(area, -half, quad_segs=4), half, quad_segs=4)
    seeds = shapely.get_coordinates(shapely.segmentize(shapely.get_rings(shapely.get_parts(area)), SEED_SPACING))
    seeds = seeds[np.unique(np.round(seeds, 3), axis=0, return_index=True)[1]]
    if len(seeds) < 4:
        return Skeleton(np.empty((0, 2)), np.empty(0), np.empty((0, 2), dtype=np.intp))
    middle = seeds.mean(axis=0)  # large coordinates would leave too few digits
    diagram = Voronoi(seeds - middle)
    vertices = diagram.vertices + middle
    edges = np.asarray(diagram.ridge_vertices, dtype=np.intp)
    apart = np.hypot(*(seeds[diagram.ridge_points[:, 0]] - seeds[diagram.ridge_points[:, 1]]).T)
    shapely.prepare(area)
    inside = shapely.contains_xy(area, *vertices.T)
    # An edge is nearest to its two seeds where it passes between them: seeds that are farther apart than neighbours on
    # a wall keep it clear of that wall
    inner = (edges >= 0).all(axis=1) & inside[edges].all(axis=1) & (apart > NARROWEST_AISLE - SEED_SPACING / 4)
    used, edges = np.unique(edges[inner], return_inverse=True)
    position = vertices[used]
    axis = Skeleton(position, np.asarray(KDTree(seeds).query(position)[0]), edges.reshape(-1, 2))
    while recesses := axis.recesses():
        pruned = np.concatenate([np.stack([chain[:-1], chain[1:]], axis=1) for chain in recesses])
        numbers, cut = (np.sort(each, axis=1) @ (len(position), 1) for each in (axis.edges, pruned))
        axis = replace(axis, edges=axis.edges[~np.isin(numbers, cut)])
    return axis


# Constants by which a medial axis becomes a network, chosen by hand
SHORTEST_ARM = 1.0  # [m] least length of the part of a line that determines its direction
INNER = 0.9  # share of the radius of a circle that is certainly free of walls


def derive(area):
    """Ends ``(l, 2)`` and lines [m] of the aisles of a (multi)polygon, see `aisles_of`."""
    middle = skeleton(area)
    vertex, at = _hubs(middle)
    clearance, nodes, links, lines = middle.clearance[vertex], middle.position[vertex], [], []
    for chain in middle.chains(np.flatnonzero(at >= 0).tolist()):
        i, j = (int(n) for n in at[chain[[0, -1]]])
        # a shorter loop, in clearances, around something small is not an aisle
        if i != j or middle.length(chain) >= 4.0 * clearance[i]:
            links.append((i, j))
            lines.append(_straightened(middle, vertex[[i, j]], chain, area))
    leaving = [[] for _ in nodes]  # where each line leaves the circle of its node, and its direction beyond
    for link, line in zip(links, lines, strict=True):
        for n, path in zip(link, (line, line[::-1]), strict=True):
            far = np.flatnonzero(np.hypot(*(path - path[1]).T) > SHORTEST_ARM)
            far = far[far > 1]
            ahead = path[far[0]] - path[1] if len(far) else path[-1] - path[0]
            leaving[n].append((path[1].copy(), ahead / max(float(np.hypot(*ahead)), 1e-9)))
    for n, paths in enumerate(leaving):
        if len(paths) > 1:
            place, direction = (np.array(values) for values in zip(*paths, strict=True))
            nodes[n] = _crossing(nodes[n], place, direction[:, ::-1] * (-1, 1), INNER * clearance[n])
    for (i, j), line in zip(links, lines, strict=True):
        line[0], line[-1] = nodes[i], nodes[j]
    return np.array(links, dtype=int).reshape(-1, 2), lines


def _hubs(middle):
    """The vertex of each node ``(n,)``, and the node of each vertex ``(v,)``, −1 if none.

    Nodes are junctions, then bends, then ends, by decreasing clearance; each absorbs the later ones within its circle.
    A ring without a bend has a node somewhere on it.
    """
    degree, bends = middle.degree, []
    for chain in middle.chains():
        bent = _bends(middle, chain)
        bends.append(chain[:1] if degree[chain[0]] == 2 and not len(bent) else bent)
    kinds = [np.flatnonzero(degree > 2), np.concatenate([*bends, np.empty(0, np.intp)]), np.flatnonzero(degree == 1)]
    candidates = np.concatenate(kinds)
    rank = np.repeat([0, 1, 2], [len(kind) for kind in kinds])
    chosen, at = [], np.full(len(middle.position), -1)
    for v in candidates[np.lexsort((-middle.clearance[candidates], rank))].tolist():
        if at[v] < 0:
            apart = np.hypot(*(middle.position[candidates] - middle.position[v]).T)
            near = apart < INNER * middle.clearance[v]
            at[candidates[near & (at[candidates] < 0)]] = at[v] = len(chosen)
            chosen.append(v)
    return np.array(chosen, dtype=np.intp), at


def _bends(middle, chain):
    """Vertices ``(b,)`` at which a line turns most, by more than 40°, between an arm's length before and after."""
    line, interval = middle.position[chain], 0.1  # [m] at which the direction is evaluated
    walked = length_along(line)
    arm = max(SHORTEST_ARM, 1.5 * float(np.median(middle.clearance[chain])))
    period = walked[-1] if chain[0] == chain[-1] else None
    at = np.arange(0.0, walked[-1], interval) if period else np.arange(arm, walked[-1] - arm, interval)
    if len(at) < 3:
        return np.empty(0, dtype=np.intp)
    before, here, after = (
        np.stack([np.interp(s, walked, axis, period=period) for axis in line.T], axis=1)
        for s in (at - arm, at, at + arm)
    )
    heading = [np.arctan2(*(b - a).T[::-1]) for a, b in ((before, here), (here, after))]
    turned = np.abs(wrap_angle(heading[1] - heading[0]))
    rolled = int(np.argmin(turned)) if period else 0  # cut a ring where it is straight
    sharpest = peaks(np.roll(turned, -rolled), np.radians(40), max(1, arm / interval))
    return chain[np.searchsorted(walked, at[(sharpest + rolled) % len(at)]).clip(0, len(chain) - 1)]


def _straightened(middle, ends, chain, area):
    """The line of a link, straight within the circles at both ends, simplified between them. [m]

    ends: ``(2,)`` vertices of its nodes; chain: ``(m,)`` vertices from one to the other.
    """
    line, half = middle.position[chain], len(chain) // 2
    outside = [np.flatnonzero(np.hypot(*(line - middle.position[v]).T) > INNER * middle.clearance[v]) for v in ends]
    first = max(int(outside[0][0]) - 1, 0) if len(outside[0]) else half
    last = min(int(outside[1][-1]) + 1, len(line) - 1) if len(outside[1]) else half
    between = line[min(first, last) : max(first, last) + 1]
    # deviation of a simplified line from the medial axis, in clearances, and at most [m]
    slack = min(0.4 * float(np.median(middle.clearance[chain])), 1.5)
    if len(between) > 2:
        simple = shapely.simplify(shapely.linestrings(between), slack)
        if not shapely.covers(area, simple):
            slack = min(slack, float(middle.clearance[chain].min()) / 2)
            simple = shapely.simplify(shapely.linestrings(between), slack)
        between = shapely.get_coordinates(simple)
    return np.concatenate([middle.position[ends[:1]], between, middle.position[ends[1:]]])


def _crossing(node, place, normal, radius):
    """Crossing ``(2,)`` [m] of the centre lines of corridors, if it is within a radius of their node; else the node.

    place, normal: ``(k, 2)`` a point of each centre line, and the unit vector across it.
    """
    square = normal.T @ normal
    if np.abs(np.linalg.det(square / len(normal))) < 0.05:  # nearly parallel
        return node
    crossing = np.linalg.solve(square, normal.T @ np.sum(normal * place, axis=1))
    return crossing if np.hypot(*(crossing - node)) < radius else node
