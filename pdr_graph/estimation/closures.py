"""Moments that were spent at one place: a stop between two recordings, a place that was seen again, an encounter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.types import Array, Index


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

    def __len__(self) -> int:
        return len(self.time)
