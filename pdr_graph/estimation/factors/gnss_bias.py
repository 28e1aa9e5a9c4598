"""The common error of one receiver's fixes: a slowly varying offset, and a lag behind the other sensors.

[gps-dr] leaves the *systematic* error of GPS open. Most of a phone's error stays the same from epoch to epoch (indoors
its correlation is 0.9 after a second, 0.5 after ten), so a minute of epochs has the information of a few fixes, not of
sixty. With g = (g_x, g_y, lag) of the source at its time, a fix of stated sigma σ is modelled as

    z = p − R(θ) v lag + σ₀ (g_x, g_y) + white noise of variance WHITE² σ₀² + n (σ² − σ₀²)

with v the walking velocity in the body's axes, averaged over LATELY. (g_x, g_y) is a Gauss–Markov process of unit
variance, lag a slow random walk; both are linear between nodes NODE apart. The process runs in units of `drift`, with
correlation length 1. σ₀ is the least sigma of the n fixes with the same error; the excess of worse ones among them is
common to them as well.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from pdr_graph.estimation.factors.base import FactorBlock, Measurement, Variables
from pdr_graph.estimation.factors.fixes import ALONG, FixFactor, alike, by_source, drift
from pdr_graph.estimation.factors.losses import RobustLoss
from pdr_graph.geometry import pose_rotation, rotation
from pdr_graph.types import Array, Complex, Index, Steps

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.chain import Chain, Evaluation

WHITE = 0.3  # share of white noise in the stated sigma
NODE = 5.0  # [s] between nodes
LAG, LAG_CHANGE = 1.0, 0.02  # prior sigma of the lag [s]; its random walk [s/√s]
LATELY = 2.0  # [s] over which the velocity is averaged
AMBLE = 1.0  # [m/s] assumed after the last step, until the next node
SOURCES, NODES_PER_SOURCE = 2**20, 2**34  # ranges of node numbers, so that those of a source do not depend on others
QUARTER = rotation(np.pi / 2)


@dataclass(frozen=True, eq=False)
class GnssBias(Measurement):
    """Offset and lag of each receiver along the walk; none before the second pass.

    fixes, steps: of the walk; velocity: ``(k + 1, 2)`` of the walk at its keyframes [m/s], see `velocities`.
    fix: ``(f,)`` indices of the biased fixes; offset, white: ``(f,)`` sigmas of common and independent error [m];
    node: ``(f,)`` row of the node before each; share: ``(f,)`` position between this node and the next, 0 to 1.
    node_number: ``(m,)``; node_time: ``(m,)`` [s]; keep: ``(m,)`` correlation with the node before, 0 for the first of
    a source; elapsed: ``(m,)`` time since the node before [s].
    """

    fixes: FixFactor
    steps: Steps
    velocity: Array
    fix: Index
    offset: Array
    white: Array
    node: Index
    share: Array
    node_number: Index
    node_time: Array
    keep: Array
    elapsed: Array

    name: ClassVar[str] = "gnss_bias"
    symbol: ClassVar[str] = "g"

    @classmethod
    def of(cls, fixes: FixFactor, steps: Steps) -> GnssBias:
        """The biases of the receivers whose fixes are marked as biased."""
        sources = by_source(fixes.fixes, fixes.biased)
        parts = [_nodes(fixes.fixes.time[indices], steps, fixes.fixes.source[indices[0]]) for indices in sources]
        none = ((np.empty(0, np.intp), np.empty(0), np.empty(0, np.intp), np.empty(0), np.empty(0), np.empty(0)),)
        node, share, number, time, keep, elapsed = ([*column] for column in zip(*(parts or none), strict=True))
        first = np.cumsum([0] + [len(n) for n in number[:-1]])
        offset, white = _sigmas(fixes, sources, steps)
        joined = np.concatenate(sources) if sources else np.empty(0, np.intp)
        rows = np.concatenate([n + f for n, f in zip(node, first, strict=True)])
        rest = (np.concatenate(column) for column in (share, number, time, keep, elapsed))
        return cls(fixes, steps, np.empty((0, 2)), joined, offset[joined], white[joined], rows, *rest)

    def refined(self, at: Evaluation) -> GnssBias:
        """Model the common errors of the fixes that the second pass marks as biased."""
        fixes = self.fixes.refined(at)
        return self if fixes is self.fixes else self.of(fixes, self.steps)

    def bind(self, chain: Chain) -> Self:
        """Bind every fix to its keyframe, and compute the velocity there."""
        return replace(self, fixes=self.fixes.bind(chain), velocity=velocities(*chain.track, chain.time))

    def variables(self, poses: Array) -> Sequence[Variables]:
        """A node (g_x, g_y [-], lag [s]) every NODE seconds in which there are fixes."""
        if not len(self.node_number):
            return ()
        needed = np.full(len(self.node_number), -np.inf)
        for rows in (self.node, self.node + 1):
            np.maximum.at(needed, rows, self.fixes.fixes.time[self.fix])
        return (Variables(self.symbol, self.node_number, np.zeros((len(self.node_number), 3)), needed),)

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """Factors of the fixes, the prior of each source's first node, and the process from node to node."""
        return [self._fixes(at), *self._process(at)] if len(self.fix) else ()

    def _fixes(self, at: Evaluation) -> FactorBlock:
        reached = np.flatnonzero(self.fixes.keyframe[self.fix] >= 0)
        fix, node, share = self.fix[reached], self.node[reached], self.share[reached, None]
        offset, white = self.offset[reached], self.white[reached]
        g, keyframe = at.state[self.symbol], self.fixes.keyframe[fix]
        pose, now = at.state.poses[keyframe], (1 - share) * g[node] + share * g[node + 1]
        R = pose_rotation(pose[:, 2])[:, :2, :2]
        ahead = np.einsum("fij,fj->fi", R, self.velocity[keyframe])
        shifted = pose[:, :2] - ahead * now[:, 2:] + offset[:, None] * now[:, :2]
        value = (shifted - self.fixes.fixes.position[fix]) / white[:, None]

        def jacobian() -> list[Array]:
            by_pose, by_now = np.zeros((len(pose), 2, 3)), np.zeros((len(pose), 2, 3))
            by_pose[:, :, :2] = R / white[:, None, None]
            by_pose[:, :, 2] = -(ahead @ QUARTER.T) * now[:, 2:] / white[:, None]
            by_now[:, [0, 1], [0, 1]] = (offset / white)[:, None]
            by_now[:, :, 2] = -ahead / white[:, None]
            return [by_pose, (1 - share[:, :, None]) * by_now, share[:, :, None] * by_now]

        variables = (("x", keyframe), (self.symbol, node), (self.symbol, node + 1))
        loss = RobustLoss(self.fixes.outlier[fix])
        tenths = 10 * (np.log(white) + np.log(offset))
        return FactorBlock.uniform(
            FixFactor.name, value, variables, jacobian, self.fixes.number[fix], loss=loss, signature=tenths
        )

    def _process(self, at: Evaluation) -> list[FactorBlock]:
        g = at.state[self.symbol]
        first, later = np.flatnonzero(self.keep == 0), np.flatnonzero(self.keep)
        root = np.diag([1.0, 1.0, 1 / LAG])
        begin = FactorBlock.uniform(
            f"{self.name}.begin",
            g[first] @ root,
            [(self.symbol, first)],
            lambda: [np.tile(root, (len(first), 1, 1))],
            self.node_number[first],
            tolerance=None,
            prior=True,
        )
        share = self.keep[later, None] * [1, 1, 0] + [0, 0, 1]
        change = np.sqrt(1 - self.keep[later] ** 2)
        sigma = np.stack([change, change, LAG_CHANGE * np.sqrt(self.elapsed[later])], axis=1)
        follow = FactorBlock.uniform(
            f"{self.name}.change",
            (g[later] - share * g[later - 1]) / sigma,
            [(self.symbol, later), (self.symbol, later - 1)],
            lambda: [np.eye(3) / sigma[:, :, None], -np.eye(3) * (share / sigma)[:, :, None]],
            self.node_number[later],
            tolerance=None,
            signature=20 * self.keep[later],
            prior=True,
        )
        return [begin, follow]


def velocities(track: Complex, heading: Array, time: Array) -> Array:
    """Mean velocity ``(k + 1, 2)`` [m/s] of a dead-reckoned track over LATELY, forward and to the left.

    track: ``(k + 1,)`` [m]; heading: ``(k + 1,)`` [rad]; time: ``(k + 1,)`` [s].
    """
    way = (track - np.interp(time - LATELY, time, track)) * np.exp(-1j * heading) / LATELY
    return np.stack([way.real, way.imag], axis=1)


def _sigmas(fixes: FixFactor, sources: Sequence[Index], steps: Steps) -> tuple[Array, Array]:
    """Sigmas ``(f,)`` [m] of the common and of the independent error of every fix."""
    offset, white = fixes.sigma.copy(), fixes.sigma.copy()
    for indices in sources:
        first, after = alike(drift(steps, fixes.fixes.time[indices]))
        offset[indices] = [fixes.sigma[indices[a:b]].min() for a, b in zip(first, after, strict=True)]
        beyond = fixes.sigma[indices] ** 2 - offset[indices] ** 2
        white[indices] = np.sqrt(WHITE**2 * offset[indices] ** 2 + (after - first) * beyond)
    return offset, white


def _nodes(time: Array, steps: Steps, source: str) -> tuple[Index, Array, Index, Array, Array, Array]:
    """Nodes around a source's fixes at ``time (f,)``, at multiples of NODE, so that they do not depend on a window.

    Returns per fix the row of the node before and the share to the next; per node its number, time, correlation with
    the node before, and the time since.
    """
    before = np.floor(time / NODE).astype(np.intp)
    grid = np.unique([before, before + 1]).astype(np.intp)
    at = (NODE * grid).astype(np.float64)
    node = np.searchsorted(grid, before)
    beyond = np.maximum(at - steps.end, 0.0) * AMBLE / ALONG
    kept = np.exp(-np.diff(drift(steps, at) + beyond, prepend=0.0))
    keep = np.where(np.arange(len(at)) > 0, kept, 0.0)
    elapsed = np.diff(at, prepend=at[0]).astype(np.float64)
    number = (zlib.crc32(source.encode()) % SOURCES) * NODES_PER_SOURCE + NODES_PER_SOURCE // 2 + grid
    return node, (time - at[node]) / NODE, number, at, keep, elapsed
