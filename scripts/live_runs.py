"""A walk through the live navigator, and the causal filter fed from the same steps and headings."""

import gc
import time as clock
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pdr_graph import WalkGraph, kalman_filter
from pdr_graph.gait.step_chunks import concatenate_steps
from pdr_graph.geometry import interpolate
from pdr_graph.online.interface import Pose, Samples, trajectory_of
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Fixes, Headings, Steps, Trajectory

LAG = 60.0  # [s]


class LoggingNavigator(Navigator):
    """A navigator that logs what its front end gives: chunks of certain steps, and headings as they are set.

    headings: rows of number, time [s], heading and sigma [rad]; an infinite sigma removes that number.
    """

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.chunks, self.headings, self.fixes = list[Steps](), list[tuple](), list[Fixes]()
        self.walked = 0.0  # by the certain steps [m]
        self._set, self._graph.set_heading = self._graph.set_heading, self._log_heading
        self._append, self._graph.extend = self._graph.extend, self._log_steps

    def push(self, event):
        """Push an event; headings and fixes among them are logged."""
        if isinstance(event, Headings):
            rows = zip(event.time, event.heading, event.sigma, strict=True)
            self.headings += [(len(self.headings) + n, *row) for n, row in enumerate(rows)]
        elif isinstance(event, Fixes):
            self.fixes.append(event)
        super().push(event)

    def _log_heading(self, number, time, heading, sigma):
        self.headings.append((number, time, heading, sigma))
        self._set(number, time, heading, sigma)

    def _log_steps(self, steps, floor):
        self.chunks.append(steps)
        self.walked += float(steps.length.sum())
        self._append(steps, floor)

    @property
    def provisional(self):
        """The steps that may still change; None if there are none."""
        return self._tail


@dataclass(frozen=True)
class Ask:
    """A pose that was asked for, and what was known then.

    time: of the newest sample [s]; pose: None before there is one; anchored: False while only its shape is known, not
    where it is; display: ``(2,)`` place that is drawn [m], None without; walked: length of all steps so far [m];
    chunks, headings, fixes: how many of each the front end had given; reached: end of the certain steps [s]; tail:
    provisional steps; cpu, wall: seconds of the pushes since the last one, and of the pose.
    """

    time: float
    pose: Pose | None
    anchored: bool
    display: np.ndarray | None
    walked: float
    chunks: int
    headings: int
    fixes: int
    reached: float
    tail: Steps | None
    state: str
    restarts: int
    cpu: float
    wall: float


@dataclass(frozen=True)
class Run:
    """A walk as the navigator followed it.

    smoothed: with a lag, at the end; chunks, headings, fixes: all that there were.
    """

    asks: list[Ask]
    smoothed: Trajectory
    chunks: list[Steps]
    headings: list[tuple]
    fixes: list[Fixes]

    @cached_property
    def shown(self):
        """The asks whose pose has a place."""
        return [ask for ask in self.asks if ask.anchored]

    @cached_property
    def current(self):
        """Of the shown ones, the last of each pose's time; their times increase."""
        time = np.array([ask.pose.time for ask in self.shown])
        later = np.append(np.minimum.accumulate(time[::-1])[::-1][1:], np.inf)
        return [ask for ask, last in zip(self.shown, time < later, strict=True) if last]

    @property
    def causal(self):
        """The current poses at the times that they are of."""
        return trajectory_of([ask.pose for ask in self.current])

    def filtered(self, time):
        """Positions ``(n, 2)`` [m] by the causal filter at some times [s], from what was known when the pose of that
        time was asked for; NaN where there was nothing. It runs again for every change of the headings.
        """
        position = np.full((len(time), 2), np.nan)
        if not self.current:
            return position
        pose_time = np.array([ask.pose.time for ask in self.current])
        which = np.minimum(np.searchsorted(pose_time, time), len(pose_time) - 1)
        known = np.array([(ask.headings, min(ask.fixes, 1)) for ask in self.current])[which]
        for version in np.unique(known, axis=0):
            rows = np.flatnonzero((known == version).all(axis=1))
            track = self._filter_of(self.current[which[rows].max()])
            if track is not None:
                position[rows] = interpolate(time[rows], track.time, track.position)
        return position

    def _filter_of(self, ask):
        chunks = [*self.chunks[: ask.chunks], *([] if ask.tail is None else [ask.tail])]
        if not chunks:
            return None
        rows = {number: row for number, *row in self.headings[: ask.headings]}
        rows = np.array(sorted(row for row in rows.values() if np.isfinite(row[2]))).reshape(-1, 3)
        fixes = Fixes.concatenate(self.fixes[: ask.fixes])
        graph = WalkGraph(concatenate_steps(chunks), fixes, headings=Headings(*rows.T))
        return kalman_filter(graph).trajectory


def followed(case, lag=LAG):
    """The run of a case; the pose is asked for after each packet of acceleration, or each step."""
    epoch = None if case.recording is None else case.recording.epoch
    nav = LoggingNavigator(case.plan, lag=lag, frame=case.frame, beacons=case.beacons, epoch=epoch)
    events, asks, taken = list(case.events()), [], np.zeros(2)
    gc.collect()
    gc.freeze()  # otherwise a full garbage collection takes 30 ms of some step
    for event in events:
        began = clocks()
        nav.push(event)
        taken += clocks() - began
        if isinstance(event, Steps) or (isinstance(event, Samples) and event.sensor == "accelerometer"):
            began = clocks()
            pose = nav.pose
            taken += clocks() - began
            asks.append(ask_of(nav, float(event.time[-1]), pose, taken))
            nav.review()  # an idle moment
            taken = np.zeros(2)
    gc.unfreeze()
    return Run(asks, nav.finish().trajectory, nav.chunks, nav.headings, nav.fixes)


def clocks():
    """CPU time of this thread, and wall time. [s]"""
    return np.array([clock.thread_time(), clock.perf_counter()])


def ask_of(nav, time, pose, taken):
    """What is known of a navigator whose pose was just asked for."""
    status, tail = nav.status, nav.provisional
    nowhere = status.state == "no absolute position" or (status.state == "waiting" and not status.fixes)
    return Ask(
        time=time,
        pose=pose,
        anchored=pose is not None and not nowhere,
        display=None if pose is None or pose.display is None else np.array(pose.display),
        walked=nav.walked + (0.0 if tail is None else float(tail.length.sum())),
        chunks=len(nav.chunks),
        headings=len(nav.headings),
        fixes=len(nav.fixes),
        reached=nav.chunks[-1].end if nav.chunks else -np.inf,
        tail=tail,
        state=status.state,
        restarts=status.restarts,
        cpu=float(taken[0]),
        wall=float(taken[1]),
    )
