"""What a recording tells of its walker before any model of stride or north: attitude, landings, direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdr_graph.gait.detection import walking_steps
from pdr_graph.gait.direction import Direction, walking_direction
from pdr_graph.gait.gaps import uninterrupted
from pdr_graph.gait.landings import Landings
from pdr_graph.inertial.attitude import Attitude, attitude_of
from pdr_graph.types import Recording


@dataclass(frozen=True)
class Gait:
    """An uninterrupted part of a recording. step: usual duration of a step [s]; direction: straight on if unknown."""

    recording: Recording
    attitude: Attitude
    landings: Landings
    step: float
    direction: Direction


def gait_of(recording: Recording) -> list[Gait]:
    """One of each uninterrupted part. Raises InputError if there is no accelerometer."""
    return [_of_part(part) for part in uninterrupted(recording)]


def _of_part(recording: Recording) -> Gait:
    attitude = attitude_of(recording)
    landings = walking_steps(attitude.time, attitude.acceleration)
    step = landings.usual_step
    if attitude.angular_rate is None:
        nothing = np.zeros(len(attitude.time))
        return Gait(recording, attitude, landings, step, Direction(nothing, nothing))
    return Gait(recording, attitude, landings, step, walking_direction(attitude, step))
