"""Fixes of one receiver: repeated and frozen ones, and how long their errors stay alike."""

from __future__ import annotations

import numpy as np

from pdr_graph.geometry import as_complex, dead_reckon, distance_walked, interpolate
from pdr_graph.priors import RECEIVERS
from pdr_graph.types import Array, Fixes, Index, Mask, Steps


def duplicates(fixes: Fixes) -> Mask:
    """True ``(f,)`` where a receiver repeats its last position, as receivers do while they detect no motion."""
    result = np.zeros(len(fixes), dtype=bool)
    for indices in by_source(fixes, np.ones(len(fixes), dtype=bool)):
        result[indices[1:]] = (np.diff(fixes.position[indices], axis=0) == 0).all(axis=1)
    return result


def frozen(fixes: Fixes, steps: Steps) -> Mask:
    """True ``(f,)`` for the fixes of a receiver that holds its position while the steps lead away, but the first.

    Receivers do so where signals are weak (static navigation): the fixes agree with one another, and are sure.
    """
    result = np.zeros(len(fixes), dtype=bool)
    sources = by_source(fixes, np.ones(len(fixes), dtype=bool))
    if not sources:
        return result
    track = dead_reckon(steps)
    for indices in sources:
        place = as_complex(fixes.position[indices]).tolist()
        walked = as_complex(interpolate(fixes.time[indices], track.time, track.position))
        first = 0
        for n in range(1, len(indices) + 1):
            if n < len(indices) and abs(place[n] - place[first]) < RECEIVERS.still:
                continue
            if n > first + 1 and np.abs(walked[first:n] - walked[first]).max() > RECEIVERS.away:
                result[indices[first + 1 : n]] = True
            first = n
    return result


def sourced(fixes: Fixes) -> Mask:
    """True ``(f,)`` for fixes of a receiver."""
    return np.array([bool(source) for source in fixes.source], dtype=bool)


def by_source(fixes: Fixes, used: Mask) -> list[Index]:
    """The used fixes of each source that has a name, in order of time."""
    if not any(fixes.source):
        return []
    names = np.where(used, np.array(fixes.source, dtype=str), "")
    order = np.argsort(fixes.time, kind="stable")
    return [order[names[order] == name] for name in np.unique(names[names != ""])]


def drift(steps: Steps, time: Array) -> Array:
    """Drift ``(n,)`` of a receiver's errors by times ``(n,)`` [s]: at a difference of 1 their correlation is 1/e.

    Signal paths change with the place, and little where nobody moves.
    """
    return time / RECEIVERS.standing + distance_walked(steps, time) / RECEIVERS.along


def alike(drifted: Array) -> tuple[Index, Index]:
    """Begin and end ``(f,)`` of the range of fixes with about the same error as each, from their drift ``(f,)``."""
    return np.searchsorted(drifted, drifted - 1.0, side="right"), np.searchsorted(drifted, drifted + 1.0)


def independent_sigmas(fixes: Fixes, sigma: Array, used: Mask, steps: Steps) -> Array:
    """Sigmas ``(f,)`` [m] with which n fixes of the same error have the information of one."""
    result = sigma.copy()
    for indices in by_source(fixes, used):
        first, after = alike(drift(steps, fixes.time[indices]))
        result[indices] *= np.sqrt(after - first)
    return result
