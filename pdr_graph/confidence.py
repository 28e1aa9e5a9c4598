"""Where a walk was with a probability of 95 %."""

from __future__ import annotations

import numpy as np
import shapely

from pdr_graph.geometry import unit
from pdr_graph.types import Array, Mask, Trajectory

CHI_SQUARE = 5.99  # of two degrees of freedom, at 95 %
THINNEST = 1e-3  # [m] half axis, below which nothing is seen
MOST_ELLIPSES = 400
CORNERS = 24


def band(trajectory: Trajectory, here: Mask) -> Array:
    """Convex polygons ``(k,)`` that together are the region: each about the 95 % ellipses of two neighbouring rows.

    here: ``(n,)`` the rows that are asked for. At most MOST_ELLIPSES of the rows are taken, evenly.
    """
    every = max(1, len(trajectory) // MOST_ELLIPSES)
    here, position = here[::every], trajectory.position[::every]
    if trajectory.covariance is None or np.count_nonzero(here) < 2:
        return np.empty(0, dtype=object)
    variance, direction = np.linalg.eigh(trajectory.covariance[::every, :2, :2])
    half_axes = np.sqrt(CHI_SQUARE * np.maximum(variance, THINNEST**2))
    circle = unit(np.linspace(0, 2 * np.pi, CORNERS, endpoint=False))
    rims = np.einsum("nij,nj,kj->nki", direction, half_axes, circle) + position[:, None]
    pairs = np.concatenate([rims[:-1], rims[1:]], axis=1)[here[:-1] & here[1:]]
    return np.asarray(shapely.convex_hull(shapely.linestrings(pairs)))
