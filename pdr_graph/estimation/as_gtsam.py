"""A walk's graph as GTSAM knows it, each own factor a ``CustomFactor``: for its optimisers, iSAM2 and checks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from pdr_graph.estimation.factors import Evaluation, evaluate, guarded
from pdr_graph.estimation.linearised import Linearised
from pdr_graph.estimation.turns import Turns
from pdr_graph.types import Array

if TYPE_CHECKING:
    from pdr_graph.estimation.graph import WalkGraph

UNIT = gtsam.noiseModel.Unit.Create


def as_gtsam(graph: WalkGraph) -> gtsam.NonlinearFactorGraph:
    """All factors; own ones are whitened, and guarded (measured facts of the design, 3)."""
    whole = gtsam.NonlinearFactorGraph(graph.native)
    for interval in range(len(graph.segment)):
        for factor in _steps_and_walls(graph, interval):
            whole.add(factor)
    for factor in (*(_turns(graph.turns) if graph.turns else ()), *_observed(graph)):
        whole.add(factor)
    return whole


def _steps_and_walls(graph: WalkGraph, i: int) -> Iterator[gtsam.CustomFactor]:
    """The factors of x_i, x_j and c of one interval: its steps, the walls along them, the corner of a turn."""
    x, c = (keys[i] for keys in graph.keys)
    keys = (x, x + 1, c)
    pieces, bridge = graph.pieces.only(i), graph.bridge.only(graph.pieces, i)
    here = slice(int(graph.pieces.first[i]), int(graph.pieces.last[i]) + 1)
    walls, turns = graph.walls and graph.walls.only(here), graph.turns and graph.turns.only(here)

    def at(values: gtsam.Values) -> Evaluation:
        ends = (values.atPose2(k) for k in keys[:2])
        pose_i, pose_j = (np.array([[pose.x(), pose.y(), pose.theta()]]) for pose in ends)
        return evaluate(pieces, bridge, pose_i, pose_j, values.atVector(c)[None], walls, turns)

    def pdr(values: gtsam.Values) -> tuple[Array, list[Array]]:
        return _rows(at(values).pdr)

    def wall(values: gtsam.Values) -> tuple[Array, list[Array]]:
        return _rows(at(values).wall)

    def corner(values: gtsam.Values) -> tuple[Array, list[Array]]:
        return _rows(at(values).corner)

    yield guarded("PDR", UNIT(3), keys, pdr)
    if walls:
        yield guarded("wall", UNIT(len(pieces.length)), keys, wall)
    if turns:
        yield guarded("intersection", UNIT(4 * len(turns)), keys, corner)


def _rows(own: Linearised | None) -> tuple[Array, list[Array]]:
    """All rows of a residual and their derivatives, as one factor's."""
    assert own is not None, "there is such a factor"
    return own.value.ravel(), [by.reshape(-1, 3) for by in (own.by_i, own.by_j, own.by_c)]


def _turns(turns: Turns) -> Iterator[gtsam.CustomFactor]:
    """The heading change of each turn, between the poses before and after it."""
    for n in range(len(turns)):
        keys = X(int(turns.before[n])), X(int(turns.after[n]))
        own = replace(turns.take(np.array([n])), before=np.array([0]), after=np.array([1]))

        def turned(values: gtsam.Values, keys=keys, own=own) -> tuple[Array, list[Array]]:
            value, slope = own.turned(np.array([values.atPose2(k).theta() for k in keys]))
            by_after = np.array([[0.0, 0.0, slope[0]]])
            return value, [-by_after, by_after]

        yield guarded("turn", UNIT(1), keys, turned)


def _observed(graph: WalkGraph) -> Iterator[gtsam.CustomFactor]:
    """What receivers and beacons saw, and closures."""
    for kind, rows in enumerate(graph.observed(graph.initial_values())):
        for n, keys in enumerate(rows.keys.tolist()):

            def seen(values: gtsam.Values, kind=kind, n=n) -> tuple[Array, list[Array]]:
                rows = graph.observed(values)[kind]
                return rows.value[n], list(rows.by[n])

            yield guarded("receiver", rows.noise(n), keys, seen)
