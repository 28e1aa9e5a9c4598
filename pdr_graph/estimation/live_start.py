"""Where a walk under way began, and which way it went: the batch smoother is asked, until it is sure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from gtsam.symbol_shorthand import X

from pdr_graph.estimation.beacons import Levels
from pdr_graph.estimation.covariance import CovarianceBlocks
from pdr_graph.estimation.graph import AMBIGUOUS, Prior, State, WalkGraph
from pdr_graph.estimation.initial import sigma_direction
from pdr_graph.estimation.live_fixes import GRIP, NONE, SLIPPING, LiveFix, as_fixes
from pdr_graph.estimation.optimizer import Optimum, probabilities, solutions, ways
from pdr_graph.estimation.reports import SURE
from pdr_graph.floor.building import Building
from pdr_graph.geometry import interpolate
from pdr_graph.types import Array, Headings, Steps

LONG = 15.0  # [s] of a walk that a plan can tell from others: on a shorter one a compass that errs fits some aisle
POINTED, BESIDE_WALLS = 0.5, 0.35  # [rad] of the direction at the end, below which it is linearised about


@dataclass(frozen=True)
class Laid:
    """The most probable walk so far.

    time: ``(m + 1,)`` of the ends of its pieces [s]; pose: ``(m + 1, 3)`` there; segment_start: ``(s,)`` [s]; c:
    ``(s, 3)``; sure: no other way is likely, and its direction is known.
    """

    time: Array
    pose: Array
    segment_start: Array
    c: Array
    sure: bool

    def at(self, time: Array) -> Array:
        """Poses ``(n, 3)`` at some times."""
        return interpolate(time, self.time, np.column_stack([self.pose[:, :2], np.unwrap(self.pose[:, 2])]))

    def calibration(self, time: float) -> Array:
        """(R_s, R_d, b) at a moment [s]."""
        return self.c[max(int(np.searchsorted(self.segment_start, time)) - 1, 0)]


def lay(
    steps: Steps,
    fixes: Sequence[LiveFix],
    headings: Headings,
    levels: Levels | None,
    building: Building | None,
    floors: Sequence[str],
    prior: Prior,
) -> Laid:
    """The walk of these steps; the fixes are told how they are believed."""
    labels = None if building is None else floors
    graph = WalkGraph(
        steps, as_fixes(fixes), headings=headings, floor=building, floors=labels, levels=levels, prior=prior
    )
    found = solutions(graph)
    best, way = found[0], ways(found)
    held, wild = best.graph.fix_held.tolist(), best.graph.fix_wild.tolist()
    for fix, is_held, is_wild in zip(fixes, held, wild, strict=not best.graph.by_proximity):
        fix.kind = NONE if not is_held else SLIPPING if is_wild else GRIP
    certain = float(probabilities(found, way)[way == 0].sum()) > SURE
    told = not best.graph.walls or _by_fixes(graph) < AMBIGUOUS or steps.end - steps.start > LONG
    return _laid(best, certain and told)


def _by_fixes(graph: WalkGraph) -> float:
    """How well the fixes alone determine the direction of the walk. [rad]"""
    used = graph.fix_believed
    at_fixes = graph.track[graph.fix_keyframe[used]]
    return sigma_direction(at_fixes, graph.fix_sigma_together[used], float(np.sum(graph.pieces.length)))


def _laid(best: Optimum, certain: bool) -> Laid:
    pieces, own, segment = best.graph.pieces, best.own, best.graph.segment
    ends = pieces.keyframe_time[:-1][pieces.interval] + pieces.to_end[1]
    last = CovarianceBlocks(best.net).joint([(X(len(segment)),)])[0]
    return Laid(
        time=np.append(pieces.keyframe_time[0], ends),
        pose=np.vstack([own.pose_i[:1], own.poses.value]),
        segment_start=pieces.keyframe_time[np.flatnonzero(np.diff(segment, prepend=-1))],
        c=State.of(best.values).c,
        sure=bool(certain and last[2, 2] < (BESIDE_WALLS if best.graph.walls else POINTED) ** 2),
    )
