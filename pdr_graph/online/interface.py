"""Interfaces of live estimators: events in the order of arrival as input, poses as output; for journal and replay.

A fix is ``Fixes`` of one or several rows; steps of another front end are ``Steps``. Times are in seconds on any one
clock without jumps.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol, TypeAlias

import numpy as np
import shapely
from shapely import affinity

from pdr_graph.errors import count, expect
from pdr_graph.estimation.factors.registry import KINDS
from pdr_graph.estimation.kalman import GaussianMixture
from pdr_graph.estimation.live.finalization import TrajectoryRows
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import confidence_ellipse, horizontal_sigma, protection_level, wrap_angle
from pdr_graph.priors import REPORTS
from pdr_graph.types import (
    SENSORS,
    Array,
    Estimate,
    Measured,
    OneLineRepr,
    Recording,
    Sensor,
    Sightings,
    Steps,
    Trajectory,
    last_time,
    take,
    time_span,
    unknown_sensor,
)

PACKET = 0.1  # [s] of samples that a phone delivers at once
NO_DATA = "no data received"  # issue of a missing sensor
NO_STEPS = "no steps can be detected, so that there are the fixes alone"


@dataclass(frozen=True)
class Samples(OneLineRepr, row="sample"):
    """Samples of one sensor.

    sensor: a `Sensor`, or its name; time: ``(n,)`` [s], or one time; values: as in `Signal`, or those of one sample:
    ``Samples("accelerometer", 0.01, (0, 0, 9.8))``, ``Samples("barometer", 0.01, 1013.2)``.
    """

    sensor: str
    time: Array
    values: Array

    def __post_init__(self) -> None:
        """Lift one sample to arrays of one row. Raises ValueError for an unknown sensor."""
        if isinstance(self.sensor, Sensor):
            object.__setattr__(self, "sensor", self.sensor.value)
        if self.sensor not in SENSORS:
            raise ValueError(f"Samples.sensor: {unknown_sensor(self.sensor)}")
        if isinstance(self.time, float | int | np.number):
            object.__setattr__(self, "time", np.array([self.time], dtype=float))
            object.__setattr__(self, "values", np.asarray(self.values, dtype=float).reshape(1, -1))

    def _summary(self) -> list[str]:
        return [repr(self.sensor), count(len(self.time), "sample"), *time_span(self)]


@dataclass(frozen=True)
class Scan(OneLineRepr):
    """Signals received by one radio.

    radio: "bluetooth" or "wifi"; heard: transmitters and levels, or those of one reception:
    ``Scan("wifi", Sightings(12.0, "aa:bb:cc:dd:ee:ff", -60))``.
    """

    radio: str
    heard: Sightings

    def __post_init__(self) -> None:
        """Lift one reception to arrays of one row."""
        one: Any = self.heard
        if isinstance(one.time, float | int | np.number):
            lifted = Sightings(np.array([one.time], dtype=float), (one.transmitter,), np.array([one.rssi], dtype=float))
            object.__setattr__(self, "heard", lifted)

    def _summary(self) -> list[str]:
        return [repr(self.radio), *self.heard._summary()]


Event: TypeAlias = Samples | Scan | Steps | Measured
"""What `Navigator.push` takes: samples of a sensor, a scan of a radio, steps of another front end, or a table of
measurements of a registered type."""


def event_types() -> tuple[type, ...]:
    """The types of events; measurements of all types that are registered by now."""
    return (Samples, Scan, Steps, *KINDS)


def events_of(recording: Recording, packet: float = PACKET) -> Iterator[Event]:
    """Yield a recording as live events: packets of samples, each followed by the measurements of the same time.

    packet: duration of a packet [s].
    """
    expect("events_of, recording", recording, Recording, instead="load(path)")
    arriving: list[tuple[float, int, Event]] = []
    for sensor, signal in recording.signals.items():
        packets = _packets(signal.time, packet)
        arriving += [(time, 0, Samples(sensor, signal.time[rows], signal.values[rows])) for time, rows in packets]
    for radio, heard in (("bluetooth", recording.bluetooth), ("wifi", recording.wifi)):
        if heard is not None:
            packets = _packets(heard.time, packet)
            arriving += [(time, 1, Scan(radio, take(heard, rows))) for time, rows in packets]
    arriving += [(time, 2, recording.fixes[rows]) for time, rows in _packets(recording.fixes.time, packet)]
    for table in recording.measurements:
        complete = last_time(table)
        order = np.argsort(complete, kind="stable")
        packets = _packets(complete[order], packet)
        arriving += [(time, 3, take(table, order[rows])) for time, rows in packets]
    for _, _, event in sorted(arriving, key=lambda row: row[:2]):
        yield event


def _packets(time: Array, packet: float) -> Iterator[tuple[float, slice]]:
    """The end [s] and the rows of each packet of sorted times ``(n,)`` [s]."""
    number = np.floor(time / packet).astype(np.int64)
    bounds = np.flatnonzero(np.diff(number, prepend=number[:1] - 1, append=number[-1:] + 1)).tolist()
    for begin, end in pairwise(bounds):
        yield float(number[begin] + 1) * packet, slice(begin, end)


@dataclass(frozen=True)
class Mode(OneLineRepr):
    """One of the ways that remain, and the pose on it.

    probability: of this way; x, y [m]; heading [rad]; covariance: ``(3, 3)``.
    """

    probability: float
    x: float
    y: float
    heading: float
    covariance: Array

    def _summary(self) -> list[str]:
        return [f"{self.probability:.0%}", f"({self.x:.2f}, {self.y:.2f}) m", f"heading {self.heading:.2f} rad"]


@dataclass(frozen=True)
class Pose(OneLineRepr):
    """The current pose of the walker, in the walkable area of a plan: the expectation over all ways that remain.

    Once the direction is certain it is that of one way; the others are those of particles elsewhere on the plan.

    time [s]; x, y [m]; heading [rad]; floor: the plan's label, empty where unknown; covariance: ``(3, 3)`` of
    (x, y, heading) in the output axes [m, m, rad], of all ways together; modes: the ways, the most probable first;
    display: x, y [m] for a map, which follows a jump of the pose within 2 s; placed: False while no measurement has
    told a position, so that it is relative to the start.
    """

    time: float
    x: float
    y: float
    heading: float
    floor: str
    covariance: Array
    modes: tuple[Mode, ...] = ()
    display: tuple[float, float] | None = None
    placed: bool = True

    @property
    def sigma(self) -> float:
        """Standard deviation of the position per axis [m], root mean square of both axes; NaN before any position."""
        return float(horizontal_sigma(self.covariance)) if self.placed else float("nan")

    def region(self, probability: float = 0.9, plan: FloorPlan | None = None) -> shapely.Geometry:
        """The ellipse that holds the position with a probability, as a polygon [m]; on a plan, its walkable part.

        Empty where no position is known. Raises ValueError unless the probability lies between 0 and 1.
        """
        if not self.placed:
            return shapely.Polygon()
        major, minor, angle = confidence_ellipse(self.covariance, probability)
        circle = shapely.Point(0.0, 0.0).buffer(1.0)
        ellipse = affinity.rotate(affinity.scale(circle, max(major, 0.01), max(minor, 0.01)), angle, use_radians=True)
        region = affinity.translate(ellipse, self.x, self.y)
        return region if plan is None else shapely.intersection(region, plan.walkable)

    def protection(self, probability: float = 0.95) -> tuple[float, float]:
        """Distances along and across the heading that hold the error with a probability [m]."""
        along, across = protection_level(self.covariance[None], np.array([self.heading]), probability)[0].tolist()
        return along, across

    def _summary(self) -> list[str]:
        place = f"({self.x:.2f}, {self.y:.2f}) m ± {self.sigma:.2f} m"
        floor = [f"floor {self.floor!r}"] if self.floor else []
        return [f"{self.time:.2f} s", place, f"heading {self.heading:.2f} rad", *floor]


def modes_of(ways: GaussianMixture) -> tuple[Mode, ...]:
    """The ways of a mixture with their probabilities, the most probable first."""
    modes = []
    for n in np.argsort(-ways.log_weight, kind="stable").tolist():
        probability, (x, y, heading) = float(np.exp(ways.log_weight[n])), ways.mean[n, :3].tolist()
        if probability >= REPORTS.least_reported or not modes:
            modes.append(Mode(probability, x, y, float(wrap_angle(heading)), ways.covariance[n, :3, :3]))
    return tuple(modes)


def trajectory_of(poses: Sequence[Pose]) -> Trajectory:
    """The trajectory of consecutive poses."""
    return Trajectory(
        time=np.array([pose.time for pose in poses]),
        position=np.array([(pose.x, pose.y) for pose in poses]).reshape(-1, 2),
        heading=np.array([pose.heading for pose in poses]),
        floor=tuple(pose.floor for pose in poses),
        covariance=np.array([pose.covariance for pose in poses]).reshape(-1, 3, 3),
    )


class Status(Protocol):
    """State of a navigator. issues: present problems; unknown: what the sensors do not measure; a line each."""

    @property
    def issues(self) -> tuple[str, ...]: ...  # noqa: D102

    @property
    def unknown(self) -> tuple[str, ...]: ...  # noqa: D102


class LiveEstimator(Protocol):
    """A navigator: takes events in order of arrival; returns the current pose and the walk smoothed so far."""

    def push(self, event: Event) -> None:
        """Process an event. Bad data becomes an issue in the status; after an exception the event was not used."""
        ...

    def review(self) -> None:
        """Do long computations that are due, in an idle moment; the results are the same without."""
        ...

    @property
    def pose(self) -> Pose | None:
        """The causal pose, None before there is one."""
        ...

    @property
    def steps(self) -> int:
        """Number of steps so far, with the provisional ones."""
        ...

    @property
    def trajectory(self) -> Trajectory:
        """The walk smoothed so far."""
        ...

    @property
    def status(self) -> Status:
        """The present state."""
        ...

    def finish(self) -> Estimate:
        """End the walk and return its estimate."""
        ...


def trajectory_of_rows(parts: Sequence[TrajectoryRows]) -> Trajectory:
    """The trajectory of rows that follow one another."""
    if not parts:
        return Trajectory(np.empty(0), np.empty((0, 2)), np.empty(0), (), np.empty((0, 3, 3)))
    rows = TrajectoryRows.joined(parts)
    heading = wrap_angle(rows.pose[:, 2])
    return Trajectory(rows.time, rows.pose[:, :2], heading, tuple(rows.floor), rows.covariance)
