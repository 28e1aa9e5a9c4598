"""What each position source of a walk says by itself, and how much of it the estimate used."""

from __future__ import annotations

import time as clock
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from pdr_graph.errors import count
from pdr_graph.estimation.factors.base import poses_at
from pdr_graph.estimation.factors.registry import kind_of, locating_kinds
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.optimizer import solve_robust
from pdr_graph.estimation.results import used_fixes
from pdr_graph.estimation.smoother import poses_of_rows
from pdr_graph.floor.building import Building
from pdr_graph.geometry import row_times, wrap_angle
from pdr_graph.priors import INITIAL, REPORTS, VERDICTS
from pdr_graph.types import Estimate, OneLineRepr, Trajectory

FIXES_SOURCE, PLAN_SOURCE = "fixes", "plan"  # names of sources: fixes without a receiver, and the floor plan
MOST_NAMED = 5  # beacons that a remark names


@dataclass(frozen=True)
class PositionSource(OneLineRepr):
    """One position source of a walk.

    name: the receiver of fixes, or the kind of measurement; measurements: their number without duplicates; weight: mean
    share of their information that the estimate used, 0 to 1, NaN for a plan; remark: whether the source was overruled,
    and why; track: the walk by steps, headings and this source alone, without the plan; None if it was not estimated.
    """

    name: str
    measurements: int
    weight: float
    remark: str
    track: Trajectory | None = None

    def distances(self, track: Trajectory) -> tuple[float, float]:
        """Median and largest distance [m] of the source's track from the rows of another; NaN without a track."""
        if self.track is None:
            return float("nan"), float("nan")
        apart = np.hypot(*(self.track.position - track.position).T)
        return float(np.median(apart)), float(apart.max())

    def _summary(self) -> list[str]:
        return [self.name, count(self.measurements, "measurement"), self.remark]


def position_sources(graph: WalkGraph, estimate: Estimate, seconds: float = np.inf) -> tuple[PositionSource, ...]:
    """The sources of position in an estimate of ``graph``, each with its own track; empty for fewer than two.

    seconds: computing time after which no further track is estimated [s].
    """
    tables = list(_tables(graph, estimate))
    if len(tables) + (graph.floor is not None) < 2:
        return ()
    sources, until = list[PositionSource](), clock.perf_counter() + seconds
    for name, table, reports in tables:
        track = _alone(graph, table, estimate.trajectory) if clock.perf_counter() < until else None
        sources.append(PositionSource(name, *_use(name, reports, estimate), track))
    return (*sources, *_plan(graph, estimate))


def _tables(graph: WalkGraph, estimate: Estimate) -> Iterator[tuple[str, Any, list[Any]]]:
    """Name, measurements and reports of each source."""
    reports, source = estimate.fixes, np.array(graph.fixes.source, dtype=object)
    for name in dict.fromkeys(graph.fixes.source):
        which = np.flatnonzero(source == name)
        of_source = [reports[n] for n in which.tolist()] if len(reports) == len(graph.fixes) else []
        yield name or FIXES_SOURCE, graph.fixes[which], list(used_fixes(of_source))
    for table in graph.data:
        kind = kind_of(table).name
        if kind in locating_kinds():
            yield kind, table, list(estimate.reports.get(kind, ()))


def _alone(graph: WalkGraph, table: Any, shown: Trajectory) -> Trajectory | None:
    """The walk by steps, headings and one table of measurements; None if these do not determine a position.

    shown: the walk from which the search starts if they leave the direction open.
    """
    alone = WalkGraph.of(graph.steps, [table, graph.headings.headings], prior=graph.prior)
    if not alone.positions.used.any():
        return None
    if alone.sigma_direction > INITIAL.ambiguous:
        poses = poses_at(alone.keyframe_time, shown.time, np.column_stack([shown.position, shown.heading]))
        alone = alone.associated_at(alone.start.replaced(x=poses))
    try:
        rows = poses_of_rows(solve_robust(alone))
    except RuntimeError:  # by GTSAM, for a system that it cannot solve
        return None
    return Trajectory(row_times(graph.steps), rows[:, :2], wrap_angle(rows[:, 2]), graph.floors)


def _use(name: str, reports: list[Any], estimate: Estimate) -> tuple[int, float, str]:
    """The number of a source's measurements, their mean weight, and whether the source was overruled and why."""
    size = np.array([getattr(report, "levels", 1) for report in reports], dtype=float)
    weight = np.array([getattr(report, "weight", float(not getattr(report, "misplaced", False))) for report in reports])
    if not size.sum():
        return 0, 0.0, "not used"
    rejected = [report for report, used in zip(reports, (weight >= REPORTS.rejected).tolist(), strict=True) if not used]
    remark = "used"
    if rejected:
        share = size[weight < REPORTS.rejected].sum() / size.sum()
        verb = "overruled" if share > VERDICTS.most else "used in part"
        remark = f"{verb}: {len(rejected)} of {len(reports)} rejected, {_reason(rejected)}"
    stated = [reason.text for reason in estimate.contradictions if reason.source == name]
    return int(size.sum()), float((weight * size).sum() / size.sum()), "; ".join([remark, *dict.fromkeys(stated)])


def _reason(rejected: list[Any]) -> str:
    """The reason of rejected measurements: names of beacons, else the reason with the largest residual."""
    names = list(dict.fromkeys(report.label for report in rejected if hasattr(report, "label")))
    if names:
        more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        return f"{', '.join(names[:MOST_NAMED])}{more} not where listed"
    worst = max(rejected, key=lambda report: np.nan_to_num(abs(getattr(report, "residual", 0.0))))
    return f"the worst {getattr(worst, 'reason', 'has no stated reason')}"


def _plan(graph: WalkGraph, estimate: Estimate) -> Iterator[PositionSource]:
    """The floor plan as a source; its measurements are the rows of the walk."""
    if graph.floor is None:
        return
    track, remark = estimate.trajectory, "not used: no position lies near it"
    if graph.walled:
        crossed = int(Building.around(graph.floor).crosses_wall(track.position, track.floor).sum())
        remark = f"used, {crossed} of {len(track)} rows through walls"
    yield PositionSource(PLAN_SOURCE, len(track), float("nan"), remark)
