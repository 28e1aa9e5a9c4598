"""Several walks in one graph: of one person on many days, or of a group.

The walks follow one another in the time of one walk's steps, with a row between each two that leads anywhere; so the
graph of a walk is that of many. Closures bind them: places seen again, encounters. Where each walk is by itself known,
by `smooth`, the optimum of all together is sought from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

import numpy as np
from gtsam.symbol_shorthand import C

from pdr_graph.estimation.beacons import Levels
from pdr_graph.estimation.closures import Closures
from pdr_graph.estimation.covariance import CovarianceBlocks, covariance_of_pieces, covariance_of_start
from pdr_graph.estimation.graph import LONGEST_OVERHANG, WALKING_SPEED, State, WalkGraph
from pdr_graph.estimation.optimizer import Optimum, near_start
from pdr_graph.estimation.reports import fix_reports, prior_sigma
from pdr_graph.gait.gaps import follow, gap, later
from pdr_graph.geometry import interpolate, nearest, row_times, wrap_angle
from pdr_graph.types import INSTANT, Array, Calibration, Estimate, Fixes, FixReport, Headings, Trajectory

BETWEEN = 3600.0  # [s] of the common time from one walk to the next
ANYWHERE = 1e4 / BETWEEN  # [m/s]: the next walk begins anywhere within ten kilometres
ANY_TURN = 30.0  # [rad]


def smooth_together(graphs: Sequence[WalkGraph], alone: Sequence[Estimate], closures: Closures) -> list[Estimate]:
    """The most probable walks given all measurements in ``graphs`` and ``closures`` between them.

    graphs: in one frame, on one plan or without; alone: each as it is by itself, to start from; closures: `walk` says
    of which of them. Beacons of one label are one, and all phones hear them alike.
    """
    begins = np.cumsum([0.0] + [graph.steps.end - graph.steps.start + BETWEEN for graph in graphs[:-1]])
    begins -= [graph.steps.start for graph in graphs]
    joint = _joint(graphs, begins, closures)
    found = near_start(joint.following(_start(joint, alone, begins)))
    reports = iter(_reports(found))
    return [
        _part(found, graph, one, by, list(islice(reports, len(_within(graph)))))
        for graph, one, by in zip(graphs, alone, begins.tolist(), strict=True)
    ]


def _joint(graphs: Sequence[WalkGraph], begins: Array, closures: Closures) -> WalkGraph:
    """One graph of all walks."""
    steps = [later(graph.steps, by) for graph, by in zip(graphs, begins, strict=True)]
    whole = steps[0]
    for own in steps[1:]:
        between = gap(whole.end, own.start, 0.0, ANY_TURN, ANYWHERE)
        whole = follow(follow(whole, between), own)
    floors = [graph.floors for graph in graphs]
    labels = [*floors[0][:-1], *(label for own in floors[1:] for label in own[:-1]), floors[-1][-1]]
    bound = [replace(graph.closures, walk=np.full_like(graph.closures.walk, n)) for n, graph in enumerate(graphs)]
    return WalkGraph(
        whole,
        Fixes.together([_within(graph).later(by) for graph, by in zip(graphs, begins, strict=True)]),
        headings=_headings([graph.headings for graph in graphs], begins),
        floor=graphs[0].floor,
        floors=labels,
        levels=_levels([graph.levels for graph in graphs], begins),
        closures=Closures.together([closures, *bound]).shifted(begins),
        prior=graphs[0].prior,
        others=[(own.start, graph.prior) for own, graph in zip(steps[1:], graphs[1:], strict=True)],
    )


def _start(joint: WalkGraph, alone: Sequence[Estimate], begins: Array) -> State:
    """Every walk where it is by itself."""
    time = np.concatenate([one.trajectory.time + by for one, by in zip(alone, begins, strict=True)])
    position = np.concatenate([one.trajectory.position for one in alone])
    heading = np.concatenate([np.unwrap(one.trajectory.heading) for one in alone])
    at = joint.pieces.keyframe_time
    poses = interpolate(at, time, np.column_stack([position, heading]))
    told = [(one.calibration, by) for one, by in zip(alone, begins, strict=True) if one.calibration is not None]
    c_time = np.concatenate([c.start + by for c, by in told])
    c = np.concatenate([c.value for c, _ in told])
    first = at[np.flatnonzero(np.diff(joint.segment, prepend=-1))]
    return replace(joint.start, poses=poses, c=c[np.searchsorted(c_time, first + 1e-3, side="right") - 1])


def _within(graph: WalkGraph) -> Fixes:
    """The fixes of a walk, one shortly outside the recording at its end: beyond, the next walk is not far."""
    fixes, steps = graph.given, graph.steps
    held = np.clip(fixes.time, steps.start, steps.end)
    near = np.abs(held - fixes.time) <= LONGEST_OVERHANG
    sigma = np.hypot(fixes.sigma, WALKING_SPEED * (held - fixes.time))
    return replace(fixes, time=held, sigma=sigma)[near]


def _reports(found: Optimum) -> tuple[FixReport, ...]:
    """Of the fixes of all walks."""
    graph, distance = found.graph, found.graph.fix_distance(found.values)
    weight = graph.fix_weight(found.values)
    return fix_reports(graph, distance, distance / graph.fix_sigma, weight, "the walk")


def _part(found: Optimum, graph: WalkGraph, alone: Estimate, by: float, reports: Sequence[FixReport]) -> Estimate:
    """One of the walks, as all together have it; by: when it begins in the common time [s]."""
    time = row_times(graph.steps)
    poses, covariance = _poses(found, time + by)
    track = Trajectory(time, poses[:, :2], wrap_angle(poses[:, 2]), graph.floors, covariance)
    return replace(
        alone,
        trajectory=track,
        calibration=_calibration(found, graph, by),
        fixes=tuple(replace(report, time=report.time - by) for report in reports),
        iterations=found.iterations,
        cost=found.cost,
        converged=found.converged,
    )


def _poses(found: Optimum, time: Array) -> tuple[Array, Array]:
    """Poses ``(n, 3)`` and their covariances ``(n, 3, 3)`` in the output axes, at the ends of pieces of the walks."""
    graph, own = found.graph, found.own
    blocks, pieces = CovarianceBlocks(found.net), graph.pieces
    ends = pieces.keyframe_time[pieces.interval] + pieces.to_end[1]
    which = nearest(ends, time)
    keys = [(x, x + 1, c) for x, c in zip(*graph.keys, strict=True)]
    poses, covariance = own.poses.value[which], covariance_of_pieces(blocks, keys, own, which)
    if time[0] < ends[0] / 2 + pieces.keyframe_time[0] / 2:
        poses[0], covariance[0] = own.pose_i[0], covariance_of_start(blocks, own)[0]
    return poses, covariance


def _calibration(found: Optimum, graph: WalkGraph, by: float) -> Calibration:
    """What all together taught of one walk's walker."""
    joint, blocks = found.graph, CovarianceBlocks(found.net)
    first = np.flatnonzero(np.diff(joint.segment, prepend=-1))
    start = joint.pieces.keyframe_time[first] - by
    own = np.flatnonzero((start > graph.steps.start - INSTANT) & (start < graph.steps.end))
    value, covariance = State.of(found.values).c[own], blocks.joint([(C(s),) for s in own.tolist()])
    return Calibration(start[own], value, covariance, prior_sigma(graph.prior, np.arange(len(own))))


def _headings(parts: Sequence[Headings], begins: Array) -> Headings:
    time = np.concatenate([part.time + by for part, by in zip(parts, begins, strict=True)])
    return Headings(time, *(np.concatenate([getattr(part, name) for part in parts]) for name in ("heading", "sigma")))


def _levels(parts: Sequence[Levels | None], begins: Array) -> Levels | None:
    """What all walks heard of beacons; one label is one beacon."""
    heard = [(part, by) for part, by in zip(parts, begins, strict=True) if part is not None]
    if not heard:
        return None
    first: dict[str, tuple[Levels, int]] = {}
    for part, _ in heard:
        for m, label in enumerate(part.label):
            first.setdefault(label, (part, m))
    number = {label: n for n, label in enumerate(first)}
    return Levels(
        np.concatenate([part.time + by for part, by in heard]),
        np.concatenate([np.array([number[label] for label in part.label])[part.beacon] for part, _ in heard]),
        np.concatenate([part.rssi for part, _ in heard]),
        tuple(first),
        np.array([part.position[m] for part, m in first.values()]),
        np.array([part.sigma[m] for part, m in first.values()]),
    )
