"""Pedestrian dead reckoning, the page that tells the story: a recording becomes steps."""

from __future__ import annotations

import numpy as np

from pdr_graph.errors import expect
from pdr_graph.gait.signals import GaitSignals, gait_signals, join
from pdr_graph.gait.step_length import MODELS, StepFeatures
from pdr_graph.gait.walker import Walker
from pdr_graph.types import Array, Recording, Steps

SIGMA_UNMEASURED_TURN = 0.3  # [rad] per step without a gyroscope: a corner every thirty steps


def detect_steps(recording: Recording | list[GaitSignals], walker: Walker | None = None) -> Steps:
    """The steps in a recording: when each foot landed, how far it went, and how the heading changed.

    recording: or what `gait_signals` made of it, where that is wanted for other things too.

    Where the recording has a gap, a row of length 0 says that the walker went nobody knows where.

    Without a gyroscope turns are unknown, 0 with a wide sigma; what else a sensor did not tell is in ``unknown``.

    Raises InputError if there is no accelerometer.
    """
    expect("detect_steps, recording", recording, Recording, list, instead="load(path)")
    expect("detect_steps, walker", walker, Walker, None, instead="Walker(height=1.72)")
    walker = walker or Walker()
    steps = join([steps_of(part, walker) for part in gait_signals(recording)])
    return walker.profile.corrected(steps) if walker.profile else steps


def steps_of(gait: GaitSignals, walker: Walker, start: float | None = None) -> Steps:
    """The steps of an uninterrupted part, before any profile.

    start: [s] where not its first sample; the landings are later.
    """
    # When the feet landed
    attitude, landings = gait.attitude, gait.landings
    start = float(attitude.time[0]) if start is None else start
    since_last = np.diff(landings.time, prepend=start)
    duration = np.minimum(landings.period, since_last)

    # How far
    length, sigma_length = MODELS[walker.stride](StepFeatures(gait), height=walker.height, **walker.constants)
    share = duration / landings.period  # below 1 only where the recording starts in mid-step

    # Which way
    heading = gait.direction.heading
    landed = np.interp(landings.time, attitude.time, heading)
    set_off = np.interp(landings.time - duration, attitude.time, heading)
    before = np.append(np.interp(start, attitude.time, heading), landed[:-1])[: len(landed)]

    return Steps(
        start=start,
        end=float(attitude.time[-1]),
        time=landings.time,
        duration=duration,
        length=length * share,
        turn=landed - before,
        pause_turn=set_off - before,
        sigma_length=sigma_length,
        sigma_turn=_sigma_turn(gait, walker, start),
        final_turn=float(heading[-1] - (landed[-1] if len(landed) else np.interp(start, attitude.time, heading))),
        unknown=attitude.unknown,
    )


def _sigma_turn(gait: GaitSignals, walker: Walker, start: float) -> Array:
    """Standard deviation ``(n,)`` of each step's turn. [rad]"""
    usual = walker.sigma_turn if gait.attitude.angular_rate is not None else SIGMA_UNMEASURED_TURN
    doubt = np.interp(np.append(start, gait.landings.time), gait.attitude.time, gait.direction.variance)
    return np.sqrt(usual**2 + np.diff(doubt))
