"""Moments that were spent at one place: a stop between two recordings, a place that was seen again, an encounter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from gtsam.symbol_shorthand import X

from pdr_graph.estimation.observations import Rows
from pdr_graph.geometry import pose_rotation
from pdr_graph.types import Array, Index

CLOSURE_WIDTH = 4.0  # [σ] of Geman and McClure's loss, at most 8: one in ten may be mistaken by metres


@dataclass(frozen=True)
class Closures:
    """Pairs of moments, ``l`` of them; a closure may be mistaken.

    time: ``(l, 2)`` both moments of each [s]; sigma: ``(l,)`` per axis of how far apart the two places are [m].
    walk: ``(l, 2)`` of which of several walks each moment is.
    """

    time: Array
    sigma: Array
    walk: Index

    @classmethod
    def of(cls, rows: Sequence[tuple[float, float, float]], walks: Sequence[tuple[int, int]] = ()) -> Closures:
        """Of both moments and a sigma each; all of the only walk by default."""
        table = np.array(rows, dtype=float).reshape(-1, 3)
        walk = np.array(walks, dtype=np.intp).reshape(-1, 2) if walks else np.zeros((len(table), 2), np.intp)
        return cls(table[:, :2], table[:, 2], walk)

    @classmethod
    def together(cls, parts: Sequence[Closures]) -> Closures:
        """All of them."""
        none = cls.of([])
        return cls(
            *(np.concatenate([getattr(part, name) for part in (none, *parts)]) for name in ("time", "sigma", "walk"))
        )

    def shifted(self, begins: Array) -> Closures:
        """In one time: each walk's moments later by its ``begins (w,)`` [s], all of one walk."""
        return replace(self, time=self.time + begins[self.walk], walk=np.zeros_like(self.walk))

    def seen(self, keyframe: Index, poses: Array, firmly: bool) -> Rows:
        """The closures' factors, whichever way the walkers faced: r = (p_j − p_i) / σ.

        keyframe: ``(l, 2)`` of both moments; firmly: not as if they might be mistaken. `BetweenFactorPose2` would take
        the logarithm, in which the same distance counts up to π/2 times as much where they faced opposite ways.
        """
        i, j = poses[keyframe[:, 0]], poses[keyframe[:, 1]]
        scale = self.sigma[:, None, None]
        R_i, R_j = (pose_rotation(pose[:, 2])[:, :2] / scale for pose in (i, j))
        value = (j - i)[:, :2] / self.sigma[:, None]
        wild = np.full(len(self), not firmly)
        return Rows(value, X(0) + keyframe, np.stack([-R_i, R_j], axis=1), wild, CLOSURE_WIDTH)

    def __len__(self) -> int:
        return len(self.time)
