"""What a trial needs of a navigator."""

from __future__ import annotations

from typing import Protocol

from pdr_graph.frames import Frame
from pdr_graph.online.events import Event
from pdr_graph.types import Array, Estimate


class Pose(Protocol):
    """Where the walker is: time [s], x, y [m], heading [rad], floor's label, covariance ``(3, 3)`` [m, m, rad]."""

    @property
    def time(self) -> float:
        """When [s]."""
        ...

    @property
    def x(self) -> float:
        """In the output frame [m]."""
        ...

    @property
    def y(self) -> float:
        """In the output frame [m]."""
        ...

    @property
    def heading(self) -> float:
        """Counter-clockwise from +x [rad]."""
        ...

    @property
    def floor(self) -> str:
        """The plan's label, empty where unknown."""
        ...

    @property
    def covariance(self) -> Array:
        """Of x, y and heading ``(3, 3)``."""
        ...


class Navigator(Protocol):
    """The live walk."""

    @property
    def pose(self) -> Pose | None:
        """The newest, None while there is none."""
        ...

    @property
    def frame(self) -> Frame | None:
        """Of the poses, None until a plan or a first fix tells it."""
        ...

    def push(self, event: Event) -> object:
        """Take in what was measured."""
        ...

    def finish(self) -> Estimate:
        """The whole walk, smoothed."""
        ...
