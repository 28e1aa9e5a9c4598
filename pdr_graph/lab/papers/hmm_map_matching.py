"""Newson & Krumm, *Hidden Markov map matching through noise and sparseness* (ACM SIGSPATIAL GIS 2009): a baseline.

States are places on ways near a fix. Emission: N(distance; σ). Transition: exponential in how much the route between
two places differs from the straight line between the fixes. Fixes within 2 σ of the one before are left out; where no
route joins the places, a new search begins. It has no steps: between fixes the walker goes along the shortest route
at constant speed. This is also what Valhalla and OSRM match by. Here places are points on ways every 4 m.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from pdr_graph.floor.paths import PathNetwork
from pdr_graph.geometry import interpolate, length_along
from pdr_graph.types import Array, Fixes, Index

BETA = 5.0  # [m] mean difference between route and straight line
REACH = 4.0  # [σ] from a fix to the places that are tried, beside a point's spacing
DETOUR, BESIDE = 2.0, 100.0  # longest route: multiple of the straight line, and [m]


def hmm_match(network: PathNetwork, fixes: Fixes, time: Array) -> Array:
    """Matched places ``(n, 2)`` at times ``(n,)`` [m]; of fixes near no way, the fix itself."""
    used, last = list[int](), None
    for n, place in enumerate(fixes.position):
        if last is None or np.hypot(*(place - last)) > 2 * fixes.sigma[n]:
            used.append(n)
            last = place
    points = network.points.within(fixes.position[used], np.full(len(used), 300.0))
    p = len(points.place)
    graph = coo_array((points.length, (points.edges[:, 0], points.edges[:, 1])), shape=(p, p)).tocsr()
    known, corners = list[float](), list[Array]()
    here, cost, links = np.empty(0, np.intp), np.empty(0), list[tuple[Index, Index, Array, int]]()

    def traced() -> None:
        """Append the best route of the part that ends here."""
        state, parts = int(np.argmin(cost)), list[tuple[Array, int, int]]()
        for n, (source, chosen, before, _) in zip(range(len(links) - 1, -1, -1), links[::-1], strict=True):
            to, state = links[n + 1][0][state] if n + 1 < len(links) else here[state], int(chosen[state])
            chain = [int(to)]
            while chain[-1] != source[state]:
                chain.append(int(before[state, chain[-1]]))
            parts.append((points.place[chain[::-1]], links[n][3], n))
        for line, fix, _ in parts[::-1]:
            begin, end = fixes.time[used[fix - 1]], fixes.time[used[fix]]
            walked = length_along(line)
            share = walked / walked[-1] if walked[-1] else np.linspace(0, 1, len(line))
            known.extend((begin + (end - begin) * share).tolist())
            corners.extend(line)

    for k, n in enumerate(used):
        distance = np.hypot(*(points.place - fixes.position[n]).T)
        there = np.flatnonzero(distance < REACH * fixes.sigma[n] + 4.0)
        emission = (distance[there] / fixes.sigma[n]) ** 2 / 2
        if len(here) and len(there):
            straight = float(np.hypot(*(fixes.position[n] - fixes.position[used[k - 1]])))
            limit = DETOUR * straight + BESIDE
            route, before = dijkstra(graph, directed=False, indices=here, limit=limit, return_predecessors=True)
            total = cost[:, None] + np.abs(route[:, there] - straight) / BETA
            if np.isfinite(total).any():
                joined = np.isfinite(total.min(axis=0))
                there, total, emission = there[joined], total[:, joined], emission[joined]
                links.append((here, total.argmin(axis=0), before, k))
                here, cost = there, total.min(axis=0) + emission
                continue
        if links:
            traced()
        elif len(known) == 0 or known[-1] < fixes.time[n]:
            known.append(float(fixes.time[n]))
            corners.append(fixes.position[n])
        here, cost, links = there, emission, []
    if links:
        traced()
    order = np.argsort(known, kind="stable")
    return interpolate(time, np.array(known)[order], np.array(corners)[order])
