"""Several walks in one graph: of one person on many days, or of a group.

The walks follow one another in the time of one walk's steps, with a row between each two that leads anywhere; so the
graph of a walk is that of many. Closures bind them: places seen again, encounters. Where each walk is by itself known,
by `smooth`, the optimum of all together is sought from there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from typing import TypeVar

import numpy as np

from pdr_graph.estimation.covariance import covariance_of_ends
from pdr_graph.estimation.factors.base import State
from pdr_graph.estimation.factors.fixes import LONGEST_OVERHANG, WALKING_SPEED
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.optimizer import Optimum, near_start
from pdr_graph.estimation.results import prior_sigma
from pdr_graph.gait.steps import append_steps, gap, shifted
from pdr_graph.geometry import interpolate, nearest, row_times, wrap_angle
from pdr_graph.measurements import Closures, by_type, with_offset
from pdr_graph.types import INSTANT, Array, Calibration, Estimate, Fixes, Headings, Trajectory

BETWEEN = 3600.0  # [s] of the common time from one walk to the next
ANYWHERE = 1e4 / BETWEEN  # [m/s]: the next walk begins anywhere within ten kilometres
ANY_TURN = 30.0  # [rad]
Data = TypeVar("Data")


def smooth_together(graphs: Sequence[WalkGraph], alone: Sequence[Estimate], closures: Closures) -> list[Estimate]:
    """The most probable walks given all measurements in ``graphs`` and ``closures`` between them.

    graphs: in one frame, on one plan or without; alone: each as it is by itself, to start from; closures: `walk` says
    of which of them. Beacons of one label are one, and all phones hear them alike.
    """
    begins = np.cumsum([0.0] + [graph.steps.end - graph.steps.start + BETWEEN for graph in graphs[:-1]])
    begins -= [graph.steps.start for graph in graphs]
    joint = _joint(graphs, begins, closures)
    found = near_start(joint.associated_at(_start(joint, alone, begins)))
    return list(_parted(found, graphs, alone, begins.tolist()))


def _joint(graphs: Sequence[WalkGraph], begins: Array, closures: Closures) -> WalkGraph:
    """One graph of all walks."""
    steps = [shifted(graph.steps, by) for graph, by in zip(graphs, begins, strict=True)]
    whole = steps[0]
    for own in steps[1:]:
        between = gap(whole.end, own.start, 0.0, ANY_TURN, ANYWHERE)
        whole = append_steps(append_steps(whole, between), own)
    floors = [graph.floors for graph in graphs]
    labels = [*floors[0][:-1], *(label for own in floors[1:] for label in own[:-1]), floors[-1][-1]]
    bound = [
        replace(own, walk=np.full_like(own.walk, n)) for n, graph in enumerate(graphs) for own in _of(graph, Closures)
    ]
    tables = [
        with_offset(table, by)
        for graph, by in zip(graphs, begins, strict=True)
        for table in graph.data
        if not isinstance(table, (Fixes, Headings, Closures))
    ]
    return WalkGraph(
        whole,
        Fixes.concatenate([_within(graph).shifted(by) for graph, by in zip(graphs, begins, strict=True)]),
        headings=Headings.concatenate(
            [graph.headings.headings.shifted(by) for graph, by in zip(graphs, begins, strict=True)]
        ),
        floor=graphs[0].floor,
        floors=labels,
        measurements=(*by_type(tables), Closures.concatenate([closures, *bound]).shifted(begins)),
        prior=graphs[0].prior,
        others=[(own.start, graph.prior) for own, graph in zip(steps[1:], graphs[1:], strict=True)],
    )


def _of(graph: WalkGraph, kind: type[Data]) -> Iterator[Data]:
    """What was measured of one kind."""
    return (one for one in graph.data if isinstance(one, kind))


def _start(joint: WalkGraph, alone: Sequence[Estimate], begins: Array) -> State:
    """Every walk where it is by itself."""
    time = np.concatenate([one.trajectory.time + by for one, by in zip(alone, begins, strict=True)])
    position = np.concatenate([one.trajectory.position for one in alone])
    heading = np.concatenate([np.unwrap(one.trajectory.heading) for one in alone])
    at = joint.keyframe_time
    poses = interpolate(at, time, np.column_stack([position, heading]))
    told = [(one.calibration, by) for one, by in zip(alone, begins, strict=True) if one.calibration is not None]
    c_time = np.concatenate([c.start + by for c, by in told])
    c = np.concatenate([c.value for c, _ in told])
    first = at[joint.chain.segment_first]
    return joint.start.replaced(x=poses, c=c[np.searchsorted(c_time, first + 1e-3, side="right") - 1])


def _within(graph: WalkGraph) -> Fixes:
    """The fixes of a walk, one shortly outside the recording at its end: beyond, the next walk is not far."""
    fixes, steps = graph.given, graph.steps
    held = np.clip(fixes.time, steps.start, steps.end)
    near = np.abs(held - fixes.time) <= LONGEST_OVERHANG
    sigma = np.hypot(fixes.sigma, WALKING_SPEED * (held - fixes.time))
    return replace(fixes, time=held, sigma=sigma)[near]


def _parted(
    found: Optimum, graphs: Sequence[WalkGraph], alone: Sequence[Estimate], begins: Sequence[float]
) -> Iterator[Estimate]:
    """Each of the walks, as all together have it. begins: in the common time [s]."""
    times = [row_times(graph.steps) for graph in graphs]
    poses, covariance, of_c = _rows(found, np.concatenate([t + by for t, by in zip(times, begins, strict=True)]))
    reports, c = iter(found.graph.positions.reports(found.at)), found.state.c
    cuts = np.cumsum([len(time) for time in times])[:-1]
    parts = zip(graphs, alone, begins, times, np.split(poses, cuts), np.split(covariance, cuts), strict=True)
    for graph, one, by, time, own, its_covariance in parts:
        track = Trajectory(time, own[:, :2], wrap_angle(own[:, 2]), graph.floors, its_covariance)
        fixes = tuple(replace(r, time=r.time - by) for r in islice(reports, len(_within(graph))))
        calibration = _calibration(found.graph, graph, by, c, of_c)
        reached = {"iterations": found.iterations, "cost": found.cost, "converged": found.converged}
        yield replace(
            one, trajectory=track, calibration=calibration, reports={**one.reports, "fixes": fixes}, **reached
        )


def _rows(found: Optimum, time: Array) -> tuple[Array, Array, Array]:
    """Poses ``(n, 3)`` and their covariances ``(n, 3, 3)`` in the output axes, at the start and at ends of pieces; and
    the covariances of c.
    """
    pieces, at = found.graph.pieces, found.at
    which = nearest(pieces.keyframe_time[pieces.interval] + pieces.to_end[1], time[1:])
    covariance, of_c = covariance_of_ends(at, found.net, which)
    return np.concatenate([at.pose_i[:1], at.ends[which]]), covariance, of_c


def _calibration(joint: WalkGraph, graph: WalkGraph, by: float, c: Array, covariance: Array) -> Calibration:
    """What all together taught of one walk's walker."""
    start = joint.keyframe_time[joint.chain.segment_first] - by
    own = np.flatnonzero((start > graph.steps.start - INSTANT) & (start < graph.steps.end))
    return Calibration(start[own], c[own], covariance[own], prior_sigma(graph.prior, np.arange(len(own))))
