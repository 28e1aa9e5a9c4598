"""Values and their derivatives, of many factors at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdr_graph.types import Array, Index


@dataclass(frozen=True)
class Linearised:
    """Values ``(k, r)`` and their derivatives by x_i, x_j and c, each ``(k, r, 3)``."""

    value: Array
    by_i: Array
    by_j: Array
    by_c: Array

    def times(self, matrix: Array) -> Linearised:
        """``matrix (k, q, r)`` times values and derivatives."""
        value = np.einsum("kqr,kr->kq", matrix, self.value)
        return Linearised(value, matrix @ self.by_i, matrix @ self.by_j, matrix @ self.by_c)

    def take(self, rows: Index) -> Linearised:
        """The rows with these indices."""
        return Linearised(self.value[rows], self.by_i[rows], self.by_j[rows], self.by_c[rows])
