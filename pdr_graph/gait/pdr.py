"""Pedestrian dead reckoning, the page that tells the story: a recording becomes steps."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.gait.detection import peak_pairs
from pdr_graph.gait.direction import Direction, walking_direction
from pdr_graph.gait.gaps import join, uninterrupted
from pdr_graph.gait.length import REFERENCE_HEIGHT, inverted_pendulum
from pdr_graph.inertial.attitude import Attitude, attitude_of
from pdr_graph.settings import read_toml
from pdr_graph.types import Array, Recording, Steps

UNSEEN_TURN = 0.3  # [rad] per step without a gyroscope: a corner every thirty steps


@dataclass(frozen=True)
class Walker:
    """What is known of the walker.

    height: stature [m].
    sigma_turn: heading error that one step adds [rad]; the walking direction wanders about the phone's.
    """

    height: float = REFERENCE_HEIGHT
    sigma_turn: float = 0.02

    @classmethod
    def load(cls, path: str | Path) -> Walker:
        """Read ``walker.toml``: the fields of this class as ``name = number``, all optional."""
        given = read_toml(path)
        known = {f.name for f in fields(cls)}
        for name, value in given.items():
            if name not in known:
                raise InputError(path, name, "an unknown name", "one of " + ", ".join(sorted(known)))
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 3:
                raise InputError(path, name, repr(value), "a number between 0 and 3 (metres, radians)")
        return cls(**given)


def detect_steps(recording: Recording, walker: Walker | None = None) -> Steps:
    """The steps in a recording: when each foot landed, how far it went, and how the heading changed.

    Where the recording has a gap, a row of length 0 says that the walker went nobody knows where.

    Without a gyroscope turns are unknown, 0 with a wide sigma; what else a sensor did not tell is in ``unknown``.

    Raises InputError if there is no accelerometer.
    """
    walker = walker or Walker()
    return join([_uninterrupted_steps(part, walker) for part in uninterrupted(recording)])


def _uninterrupted_steps(recording: Recording, walker: Walker) -> Steps:
    # Attitude of the phone
    attitude = attitude_of(recording)

    # When the feet landed
    landings = peak_pairs(attitude.time, attitude.acceleration)
    since_last = np.diff(landings.time, prepend=attitude.time[0])
    duration = np.minimum(landings.period, since_last)

    # How far
    length, sigma_length = inverted_pendulum(landings.amplitude, landings.period, walker.height)
    share = duration / landings.period  # below 1 only where the recording starts in mid-step

    # Which way
    step = float(np.median(landings.period)) if len(landings.time) else 0.5
    direction = _direction(attitude, step)
    heading = direction.heading
    landed = np.interp(landings.time, attitude.time, heading)
    set_off = np.interp(landings.time - duration, attitude.time, heading)
    before = np.concatenate([heading[:1], landed[:-1]])

    return Steps(
        start=float(attitude.time[0]),
        end=float(attitude.time[-1]),
        time=landings.time,
        duration=duration,
        length=length * share,
        turn=landed - before,
        pause_turn=set_off - before,
        sigma_length=sigma_length,
        sigma_turn=_sigma_turn(attitude, direction, landings.time, walker),
        final_turn=float(heading[-1] - landed[-1]) if len(landed) else float(heading[-1] - heading[0]),
        unknown=attitude.unknown,
    )


def _direction(attitude: Attitude, step: float) -> Direction:
    """The walking direction; straight on where nothing tells. step: usual duration [s]."""
    if attitude.angular_rate is None:
        return Direction(np.zeros(len(attitude.time)), np.zeros(len(attitude.time)))
    return walking_direction(attitude, step)


def _sigma_turn(attitude: Attitude, direction: Direction, landed: Array, walker: Walker) -> Array:
    """Standard deviation ``(n,)`` of each step's turn. [rad]"""
    usual = walker.sigma_turn if attitude.angular_rate is not None else UNSEEN_TURN
    doubt = np.interp(landed, attitude.time, direction.variance)
    return np.sqrt(usual**2 + np.diff(doubt, prepend=0.0))
