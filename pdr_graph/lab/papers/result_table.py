"""A table of an experiment of a paper: its published figures beside ours."""

from __future__ import annotations

from dataclasses import dataclass

FIRST_SEED = 100_000  # of the simulated walks of published tables; tune on those from 0 on


@dataclass(frozen=True)
class ResultTable:
    """Rows of an experiment.

    name: of the table, without spaces; title: what was measured, and the paper's section; header: names of the columns,
    units in brackets; rows: cells as they are printed, the paper's published figure in brackets behind ours or in a row
    of its own; note: how ours differs from the paper, and why.
    """

    name: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
