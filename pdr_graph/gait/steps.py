"""Pedestrian dead reckoning, start here: a recording becomes steps; steps of several parts become one walk.

Gaps in a recording become rows of length 0.
"""

from __future__ import annotations

import numpy as np

from pdr_graph.errors import expect
from pdr_graph.gait.signals import GaitSignals, gait_signals
from pdr_graph.gait.step_chunks import join
from pdr_graph.gait.step_length import MODELS, StepFeatures
from pdr_graph.gait.walker import Walker
from pdr_graph.inertial.attitude import NO_GYROSCOPE
from pdr_graph.priors import MOTION
from pdr_graph.types import Recording, Steps


def detect_steps(recording: Recording | list[GaitSignals], walker: Walker | None = None) -> Steps:
    """The steps of a recording: when each foot landed, the step's length, and the change of heading.

    recording: or its `gait_signals`, where they are needed for something else too; walker: whose stride model and
    profile are used, by default those of a person of 1.70 m.

    A gap in the recording is a row of length 0 with a wide sigma. Where no gyroscope ran, turns are 0 with a wide
    sigma.
    ``unknown`` names what the sensors cannot measure.

    Raises InputError if there is no accelerometer.
    """
    expect("detect_steps, recording", recording, Recording, list, instead="load(path)")
    expect("detect_steps, walker", walker, Walker, None, instead="Walker(height=1.72)")
    walker = walker or Walker()
    steps = join([steps_of(part, walker) for part in gait_signals(recording)])
    return walker.profile.corrected(steps) if walker.profile else steps


def steps_of(gait: GaitSignals, walker: Walker, start: float | None = None) -> Steps:
    """The steps of an uninterrupted part, before correction by a profile.

    start: beginning of the part [s], before all landings; default: its first sample.
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

    rows, unmeasured = np.append(start, landings.time), np.isnan(attitude.angular_rate[:, 0])
    variance = np.interp(rows, attitude.time, gait.direction.variance)
    blind = np.diff(np.interp(rows, attitude.time, np.cumsum(unmeasured))) > 0

    return Steps(
        start=start,
        end=float(attitude.time[-1]),
        time=landings.time,
        duration=duration,
        length=length * share,
        turn=landed - before,
        pause_turn=set_off - before,
        sigma_length=sigma_length,
        sigma_turn=np.where(blind, MOTION.unmeasured_turn, np.sqrt(walker.sigma_turn**2 + np.diff(variance))),
        final_turn=float(heading[-1] - (landed[-1] if len(landed) else np.interp(start, attitude.time, heading))),
        unknown=(*attitude.unknown, *([NO_GYROSCOPE] if unmeasured[attitude.time > start].any() else [])),
    )
