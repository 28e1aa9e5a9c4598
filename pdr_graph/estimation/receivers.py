"""What the fixes of one receiver have in common: a slowly varying offset, and a lag behind the other sensors.

[gps-dr] leaves the *systematic* error of GPS open. Most of a phone's error stays the same from epoch to epoch (indoors
it is correlated 0.9 after a second, 0.5 after ten), so that a minute of epochs is worth a few fixes, not sixty. With
g = (g_x, g_y, lag) of the source as it was then, a fix of stated sigma σ says

    z = p − R(θ) v lag + σ₀ (g_x, g_y) + white noise of variance WHITE² σ₀² + n (σ² − σ₀²)

v the walking velocity seen from the body, in the mean over LATELY. (g_x, g_y) is a Gauss–Markov process of unit
variance, lag a slow random walk; both are linear between nodes NODE apart at most. Paths of the signals change with the
place, and little where nobody moves: the process goes by its `drift`, in which 1 is the time in which it is correlated.
σ₀ is the least sigma of those n fixes that err alike; what worse ones among them have beyond it they share as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from gtsam.symbol_shorthand import G, X

from pdr_graph.estimation.observations import Rows
from pdr_graph.geometry import pose_rotation, rotation, walked
from pdr_graph.types import Array, Complex, Fixes, Index, Mask, Steps

STANDING, ALONG = 120.0, 30.0  # [s] and [m] walked in which errors stay alike: satellites move, and so do walkers
WHITE = 0.3  # of the stated sigma
NODE = 5.0  # [s]
LAG, LAG_CHANGE = 1.0, 0.02  # [s] before any measurement; [s/√s]
LATELY = 2.0  # [s]
QUARTER = rotation(np.pi / 2)


@dataclass(frozen=True)
class Receivers:
    """The fixes of sources whose errors are alike for a while; ``f`` fixes, ``m`` nodes.

    fix: ``(f,)`` which they are; keyframe: ``(f,)``; position: ``(f, 2)`` [m]; offset, white: ``(f,)`` sigmas of what
    they share and do not [m]; velocity: ``(f, 2)`` [m/s] ahead and to the left, of late.
    node, share: ``(f,)`` the node before each, and how far it is on to the next.
    keep: ``(m,)`` share of the node before that is left, 0 of the first of a source; time_before: ``(m,)`` [s] since.
    """

    fix: Index
    keyframe: Index
    position: Array
    offset: Array
    white: Array
    velocity: Array
    node: Index
    share: Array
    keep: Array
    time_before: Array

    def seen(self, poses: Array, g: Array, wild: Mask) -> Rows:
        """The fixes' factors at ``poses (k + 1, 3)`` and ``g (m, 3)``; wild: of all fixes."""
        pose, scale = poses[self.keyframe], self.white[:, None]
        share = self.share[:, None]
        now = (1 - share) * g[self.node] + share * g[self.node + 1]
        R = pose_rotation(pose[:, 2])[:, :2, :2]
        ahead = np.einsum("fij,fj->fi", R, self.velocity)
        value = (pose[:, :2] - ahead * now[:, 2:] + self.offset[:, None] * now[:, :2] - self.position) / scale

        by_pose, by_now = np.zeros((len(pose), 2, 3)), np.zeros((len(pose), 2, 3))
        by_pose[:, :, :2] = R / scale[:, :, None]
        by_pose[:, :, 2] = -(ahead @ QUARTER.T) * now[:, 2:] / scale
        by_now[:, [0, 1], [0, 1]] = (self.offset / self.white)[:, None]
        by_now[:, :, 2] = -ahead / scale
        share = share[:, :, None]
        by = np.stack([by_pose, (1 - share) * by_now, share * by_now], axis=1)
        keys = np.stack([X(0) + self.keyframe, G(0) + self.node, G(0) + self.node + 1], axis=1)
        return Rows(value, keys, by, wild[self.fix])

    def kept(self, g: Array) -> tuple[Rows, Rows]:
        """What each source begins with, and how each node follows from the one before."""
        first, later = np.flatnonzero(self.keep == 0), np.flatnonzero(self.keep)
        root = np.diag([1.0, 1.0, 1 / LAG])
        begun = Rows(g[first] @ root, G(0) + first[:, None], np.tile(root, (len(first), 1, 1, 1)))

        share = self.keep[later, None] * [1, 1, 0] + [0, 0, 1]
        change = np.sqrt(1 - self.keep[later] ** 2)
        sigma = np.stack([change, change, LAG_CHANGE * np.sqrt(self.time_before[later])], axis=1)
        by = np.stack([np.eye(3) / sigma[:, :, None], -np.eye(3) * (share / sigma)[:, :, None]], axis=1)
        return begun, Rows((g[later] - share * g[later - 1]) / sigma, G(0) + np.stack([later, later - 1], axis=1), by)


def receivers(
    fixes: Fixes, used: Mask, sigma: Array, keyframe: Index, velocity: Array, steps: Steps
) -> Receivers | None:
    """The used fixes that name a source, None without any.

    Of all fixes: sigma ``(f,)`` [m]; keyframe ``(f,)``. velocity: ``(k + 1, 2)`` of `velocities`.
    """
    of_source = list(_by_source(fixes, used))
    if not of_source:
        return None
    offset, white = sigma.copy(), sigma.copy()
    for own in of_source:
        first, after = _alike(drift(steps, fixes.time[own]))
        offset[own] = [sigma[own[a:b]].min() for a, b in zip(first, after, strict=True)]
        beyond = sigma[own] ** 2 - offset[own] ** 2
        white[own] = np.sqrt(WHITE**2 * offset[own] ** 2 + (after - first) * beyond)
    nodes = [_nodes(fixes.time[own], steps) for own in of_source]
    node, share, keep, time_before = (list(column) for column in zip(*nodes, strict=True))
    first = np.cumsum([0] + [len(k) for k in keep[:-1]])
    joined = np.concatenate(of_source)
    return Receivers(
        fix=joined,
        keyframe=keyframe[joined],
        position=fixes.position[joined],
        offset=offset[joined],
        white=white[joined],
        velocity=velocity[keyframe[joined]],
        node=np.concatenate([n + f for n, f in zip(node, first, strict=True)]),
        share=np.concatenate(share),
        keep=np.concatenate(keep),
        time_before=np.concatenate(time_before),
    )


def velocities(track: Complex, heading: Array, time: Array) -> Array:
    """Mean velocity ``(k + 1, 2)`` [m/s] over LATELY, ahead and to the left, of a dead-reckoned track.

    track: ``(k + 1,)`` [m]; heading: ``(k + 1,)`` [rad]; time: ``(k + 1,)`` [s].
    """
    way = (track - np.interp(time - LATELY, time, track)) * np.exp(-1j * heading) / LATELY
    return np.stack([way.real, way.imag], axis=1)


def repeated(fixes: Fixes) -> Mask:
    """True ``(f,)`` where a receiver says again what it said last: it holds its position while it thinks it is still,
    or has seen nothing new.
    """
    result = np.zeros(len(fixes), dtype=bool)
    for own in _by_source(fixes, np.ones(len(fixes), dtype=bool)):
        result[own[1:]] = (np.diff(fixes.position[own], axis=0) == 0).all(axis=1)
    return result


def together(fixes: Fixes, sigma: Array, used: Mask, steps: Steps) -> Array:
    """Sigmas ``(f,)`` [m] with which fixes that err alike count for what they are worth, each taken for independent."""
    result = sigma.copy()
    for own in _by_source(fixes, used):
        first, after = _alike(drift(steps, fixes.time[own]))
        result[own] *= np.sqrt(after - first)
    return result


def drift(steps: Steps, time: Array) -> Array:
    """How far errors have changed ``(n,)`` by some times: apart by 1, they are correlated 1/e."""
    return time / STANDING + walked(steps, time) / ALONG


def _by_source(fixes: Fixes, used: Mask) -> Iterator[Index]:
    """Of each source that has a name, the used fixes in order of time."""
    names = np.where(used, np.array(fixes.sources, dtype=str), "")
    order = np.argsort(fixes.time, kind="stable")
    for name in np.unique(names[names != ""]):
        yield order[names[order] == name]


def _alike(drifted: Array) -> tuple[Index, Index]:
    """The first fix that errs like each of a source's ``(f,)``, in order of time, and the one after the last."""
    return np.searchsorted(drifted, drifted - 1.0, side="right"), np.searchsorted(drifted, drifted + 1.0)


def _nodes(time: Array, steps: Steps) -> tuple[Index, Array, Array, Array]:
    """Of one source's fixes, at ``time (f,)``, nodes and shares; of each node what is kept and the time before."""
    at = np.array(list(_node_times(time)))
    node = np.clip(np.searchsorted(at, time, side="right") - 1, 0, len(at) - 2)
    span = np.diff(at)[node]
    before = np.diff(at, prepend=at[0])
    keep = np.where(before > 0, np.exp(-np.diff(drift(steps, at), prepend=0.0)), 0.0)
    return node, (time - at[node]) / span, keep, before


def _node_times(time: Array) -> Iterator[float]:
    """Of the fixes' times, some that lie apart; at least two, the last not before the last fix."""
    last = -np.inf
    for t in time.tolist():
        if t >= last + NODE:
            last = t
            yield t
    if time[-1] > last or time[-1] < time[0] + NODE:
        yield last + NODE
