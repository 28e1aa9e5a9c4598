"""The factors of a walk under way that are linearised here, and the hold on its first pose."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X

from pdr_graph.estimation import native
from pdr_graph.estimation.factors import Evaluation
from pdr_graph.estimation.graph import FRAME_SIGMA
from pdr_graph.estimation.live_way import Interval
from pdr_graph.estimation.tree import Name, linear
from pdr_graph.geometry import ANY_HEADING
from pdr_graph.types import Array

Factors = dict[Name, gtsam.NonlinearFactor]


def own_factors(intervals: Sequence[Interval], own: Evaluation, known: gtsam.Values) -> Factors:
    """Steps and walls of intervals, linear where they are: one factor for each."""
    pdr, pressed = own.pdr, np.empty(0, dtype=np.intp) if own.springs is None else np.flatnonzero(own.springs[0])
    of_pressed, factors = own.pieces.interval[pressed], Factors()
    wall = own.wall_of(pressed) if len(pressed) else None
    for n, one in enumerate(intervals):
        error, blocks = pdr.value[n], [pdr.by_i[n], pdr.by_j[n], pdr.by_c[n]]
        if wall is not None and len(here := np.flatnonzero(of_pressed == n)):
            rows = wall.take(here)
            error = np.append(error, rows.value[:, 0])
            beside = (rows.by_i[:, 0], rows.by_j[:, 0], rows.by_c[:, 0])
            blocks = [np.vstack(pair) for pair in zip(blocks, beside, strict=True)]
        factors["own", one.j] = linear((X(one.i), X(one.j), C(one.segment)), blocks, error, known)
    return factors


def frame_factor(keyframe: int, pose: Array, placed: bool) -> gtsam.NonlinearFactor:
    """A loose hold on the first heading; of a walk that nothing places, what defines its frame."""
    if placed:
        return native.hold_factor(keyframe, float(pose[2]), ANY_HEADING)
    return native.start_factor(keyframe, pose, (FRAME_SIGMA, FRAME_SIGMA, FRAME_SIGMA))
