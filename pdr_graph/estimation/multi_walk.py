"""Several walks in one graph: of one person on many days, or of a group.

The steps of the walks are concatenated on one time axis, with a gap of unknown displacement between each two, so that
the graph of one walk serves for many. Closures connect them: recognised places, encounters. The search for the joint
optimum starts from the separate solutions by `smooth`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from pdr_graph.estimation.factors.base import State
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.linear_system import covariance_of_ends
from pdr_graph.estimation.optimizer import Optimum, near_start
from pdr_graph.estimation.results import prior_sigma
from pdr_graph.gait.step_chunks import append_steps, gap, shifted
from pdr_graph.geometry import interpolate, nearest, row_times, wrap_angle
from pdr_graph.priors import FIXES
from pdr_graph.types import (
    INSTANT,
    Array,
    Calibration,
    Closures,
    Estimate,
    Fixes,
    Headings,
    Trajectory,
    by_type,
    with_offset,
)

BETWEEN = 3600.0  # [s] between two walks on the common time axis
ANYWHERE_SPEED = 1e4 / BETWEEN  # [m/s] sigma of the speed there: the next walk starts anywhere within ten kilometres
ANY_TURN = 30.0  # [rad] sigma of the turn there


def smooth_together(graphs: Sequence[WalkGraph], alone: Sequence[Estimate], closures: Closures) -> list[Estimate]:
    """The most probable walks given all measurements in ``graphs`` and ``closures`` between them.

    graphs: in one frame, on one plan or without; alone: the separate solution of each; closures: with the indices of
    their walks. Beacons of one label are the same beacon, with the same path loss for all phones.
    """
    begins = np.cumsum([0.0] + [graph.steps.end - graph.steps.start + BETWEEN for graph in graphs[:-1]])
    begins -= [graph.steps.start for graph in graphs]
    solved = [
        graph if estimate.graph is None else estimate.graph for graph, estimate in zip(graphs, alone, strict=True)
    ]
    joint = _joint(graphs, begins, closures, [graph.prior for graph in solved])
    optimum = near_start(joint.associated_at(_start(joint, alone, begins)))
    return list(_parted(optimum, graphs, alone, begins.tolist()))


def _joint(graphs: Sequence[WalkGraph], begins: Array, closures: Closures, priors: Sequence[Prior]) -> WalkGraph:
    """One graph of all walks. begins: offset of each walk's time [s]; priors: of their walkers."""
    steps = [shifted(graph.steps, by) for graph, by in zip(graphs, begins, strict=True)]
    whole = steps[0]
    for walk_steps in steps[1:]:
        between = gap(whole.end, walk_steps.start, 0.0, ANY_TURN, ANYWHERE_SPEED)
        whole = append_steps(append_steps(whole, between), walk_steps)
    labels = [*(label for graph in graphs for label in graph.floors[:-1]), graphs[-1].floors[-1]]
    bound = [
        replace(table, walk=np.full_like(table.walk, n))
        for n, graph in enumerate(graphs)
        for table in graph.data
        if isinstance(table, Closures)
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
        prior=priors[0],
        others=[(walk_steps.start, prior) for walk_steps, prior in zip(steps[1:], priors[1:], strict=True)],
    )


def _start(joint: WalkGraph, alone: Sequence[Estimate], begins: Array) -> State:
    """The separate solutions as initial state."""
    time = np.concatenate([estimate.trajectory.time + by for estimate, by in zip(alone, begins, strict=True)])
    position = np.concatenate([estimate.trajectory.position for estimate in alone])
    heading = np.concatenate([np.unwrap(estimate.trajectory.heading) for estimate in alone])
    at = joint.keyframe_time
    poses = interpolate(at, time, np.column_stack([position, heading]))
    calibrations = [
        (estimate.calibration, by)
        for estimate, by in zip(alone, begins, strict=True)
        if estimate.calibration is not None
    ]
    c_time = np.concatenate([c.start + by for c, by in calibrations])
    c = np.concatenate([c.value for c, _ in calibrations])
    first = at[joint.chain.segment_first]
    return joint.start.replaced(x=poses, c=c[np.searchsorted(c_time, first + 1e-3, side="right") - 1])


def _within(graph: WalkGraph) -> Fixes:
    """The fixes of a walk; a fix shortly outside the recording is moved to its end, away from the next walk."""
    fixes, steps = graph.fixes, graph.steps
    time = np.clip(fixes.time, steps.start, steps.end)
    near = np.abs(time - fixes.time) <= FIXES.longest_overhang
    sigma = np.hypot(fixes.sigma, FIXES.walking_speed * (time - fixes.time))
    return replace(fixes, time=time, sigma=sigma)[near]


def _parted(
    optimum: Optimum, graphs: Sequence[WalkGraph], alone: Sequence[Estimate], begins: Sequence[float]
) -> Iterator[Estimate]:
    """The estimate of each walk from the joint optimum. begins: offset of each walk's time [s]."""
    times = [row_times(graph.steps) for graph in graphs]
    pieces, at = optimum.graph.pieces, optimum.at
    time = np.concatenate([t + by for t, by in zip(times, begins, strict=True)])
    which = nearest(pieces.keyframe_time[pieces.interval] + pieces.to_end[1], time[1:])
    poses = np.concatenate([at.pose_i[:1], at.ends[which]])
    covariance = covariance_of_ends(at, optimum.solution, which)
    segment_start = optimum.graph.keyframe_time[optimum.graph.chain.segment_first]
    reports, c = iter(optimum.graph.positions.reports(optimum.at)), optimum.state.c
    of_c = optimum.solution.joint(("c", np.arange(len(c))))
    cuts = np.cumsum([len(time) for time in times])[:-1]
    parts = zip(graphs, alone, begins, times, np.split(poses, cuts), np.split(covariance, cuts), strict=True)
    for graph, estimate, by, time, walk_poses, its_covariance in parts:
        track = Trajectory(time, walk_poses[:, :2], wrap_angle(walk_poses[:, 2]), graph.floors, its_covariance)
        fixes = tuple(replace(r, time=r.time - by) for r in islice(reports, len(_within(graph))))
        start = segment_start - by
        rows = np.flatnonzero((start > graph.steps.start - INSTANT) & (start < graph.steps.end))
        prior = prior_sigma(graph.prior, np.arange(len(rows)))
        calibration = Calibration(start[rows], c[rows], of_c[rows], prior, graph.prior.usual)
        reached = {"iterations": optimum.iterations, "cost": optimum.cost, "converged": optimum.converged}
        yield replace(
            estimate, trajectory=track, calibration=calibration, reports={**estimate.reports, "fixes": fixes}, **reached
        )
