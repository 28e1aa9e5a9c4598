"""Where a walker is, and what a navigator must offer to be journalled and replayed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from pdr_graph.frames import Frame
from pdr_graph.online.events import Event
from pdr_graph.types import Array, Estimate, Trajectory


@dataclass(frozen=True)
class Pose:
    """Where the walker is now.

    time [s]; x, y [m]; heading [rad]; floor: the plan's label, empty where unknown; covariance: ``(3, 3)`` of
    (x, y, heading) in the output axes [m, m, rad].
    """

    time: float
    x: float
    y: float
    heading: float
    floor: str
    covariance: Array


def trajectory_of(poses: Sequence[Pose]) -> Trajectory:
    """Poses one after the other."""
    return Trajectory(
        time=np.array([pose.time for pose in poses]),
        position=np.array([(pose.x, pose.y) for pose in poses]).reshape(-1, 2),
        heading=np.array([pose.heading for pose in poses]),
        floor=tuple(pose.floor for pose in poses),
        covariance=np.array([pose.covariance for pose in poses]).reshape(-1, 3, 3),
    )


class Status(Protocol):
    """How well a navigator does. ailments: what is amiss now, a line each."""

    @property
    def ailments(self) -> tuple[str, ...]: ...  # noqa: D102


class Live(Protocol):
    """A navigator: events in, in order of arrival; a pose at once, and the walk smoothed so far."""

    def push(self, event: Event) -> None:
        """Take in an event. Bad data lowers the status; an exception means that the event was not taken."""
        ...

    @property
    def pose(self) -> Pose | None:
        """The causal pose, None before there is one."""
        ...

    @property
    def steps(self) -> int:
        """How many steps there have been, those that may still turn out not to be any among them."""
        ...

    @property
    def trajectory(self) -> Trajectory:
        """The walk smoothed so far; of a journalled navigator those rows that `settled` has not yet handed out."""
        ...

    @property
    def status(self) -> Status:
        """How well it does."""
        ...

    def finish(self) -> Estimate:
        """The walk, no more events coming."""
        ...


class Placed(Live, Protocol):
    """A navigator whose poses have a place on earth."""

    @property
    def frame(self) -> Frame | None:
        """That of the poses, None before anything defines it."""
        ...


class Journalled(Live, Protocol):
    """A navigator that a journal can keep."""

    def snapshot(self) -> dict[str, Any]:
        """All that the rest of the walk depends on, as `codec.pack` takes it; `settled` rows are not part of it."""
        ...

    def settled(self) -> Trajectory:
        """The rows that will not change any more, each handed out once and then forgotten."""
        ...
