"""Numbers as a page has them: whole multiples of a unit, each as its difference from the one before.

A row of a track is some twenty bytes instead of eighty, so that a day's walks are no larger than the script that draws
them.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Any

import numpy as np

from pdr_graph.types import Array, Index

CENTIMETRE, CENTISECOND, CENTIRADIAN, PERCENT = 0.01, 0.01, 0.01, 0.01  # as finely as anybody sees
MOST_ROWS = 20_000  # of one track or line: 20 to each pixel of a wide screen
MOST_MARKS = 4_000  # fixes on a map: each is an element of the page


def column(values: Array, unit: float) -> dict[str, Any]:
    """Values ``(n,)``, None where one is NaN."""
    whole = np.round(np.asarray(values, dtype=float) / unit)
    known = np.isfinite(whole)
    steps = np.full(len(whole), None, dtype=object)
    steps[known] = np.diff(whole[known].astype(np.int64), prepend=0).tolist()
    return {"unit": unit, "steps": steps.tolist()}


def runs(values: Sequence[int]) -> list[list[int]]:
    """Values, each with how often it follows itself."""
    return [[value, len(list(same))] for value, same in groupby(values)]


def thinned(rows: int, most: int = MOST_ROWS) -> Index:
    """Which rows are shown of so many: all, or evenly ``most`` of them, the first and the last among them."""
    return np.unique(np.linspace(0, rows - 1, min(rows, most)).round().astype(np.intp))
