"""What a recording tells of its walker before any model of stride or north: attitude, landings, direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdr_graph.gait.detection import walking_steps
from pdr_graph.gait.direction import Direction, walking_direction
from pdr_graph.gait.forward import forward_acceleration, forward_axis
from pdr_graph.gait.gaps import uninterrupted
from pdr_graph.gait.landings import Landings
from pdr_graph.inertial.attitude import Attitude, attitude_of
from pdr_graph.types import Array, Mask, Recording


@dataclass(frozen=True)
class Gait:
    """An uninterrupted part of a recording. direction: straight on if unknown."""

    recording: Recording
    attitude: Attitude
    landings: Landings
    direction: Direction

    @property
    def walking(self) -> Mask:
        """When the walker was under way ``(n,)``, at the attitude's samples."""
        return self.landings.under_way(self.attitude.time)

    @property
    def forward(self) -> Array:
        """Acceleration along the walking direction ``(n,)``. [m/s²]"""
        ahead = forward_axis(self.attitude, self.direction.heading, self.walking, self.landings.usual_step)
        return forward_acceleration(self.attitude, self.direction.heading, ahead)


def gait_of(recording: Recording | list[Gait]) -> list[Gait]:
    """One of each uninterrupted part, unless that is what is given. Raises InputError without an accelerometer."""
    return [_of_part(part) for part in uninterrupted(recording)] if isinstance(recording, Recording) else recording


def _of_part(recording: Recording) -> Gait:
    attitude = attitude_of(recording)
    landings = walking_steps(attitude.time, attitude.acceleration)
    nothing = np.zeros(len(attitude.time))
    seen = attitude.angular_rate is not None
    direction = walking_direction(attitude, landings.usual_step) if seen else Direction(nothing, nothing)
    return Gait(recording, attitude, landings, direction)
