"""Pedestrian dead reckoning, start here: a recording becomes steps; steps of several parts become one walk.

Gaps in a recording become rows of length 0. Steps on stairs are as long as the treads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pdr_graph.errors import expect
from pdr_graph.gait.step_length import MODELS, StepFeatures
from pdr_graph.gait.walker import Walker
from pdr_graph.types import Array, Recording, Steps

if TYPE_CHECKING:
    from pdr_graph.gait.signals import GaitSignals
    from pdr_graph.inertial.barometer import Climbs

SIGMA_UNMEASURED_TURN = 0.3  # [rad] per step without a gyroscope: a corner every thirty steps; chosen by hand


def detect_steps(recording: Recording | list[GaitSignals], walker: Walker | None = None) -> Steps:
    """The steps of a recording: when each foot landed, the step's length, and the change of heading.

    recording: or its `gait_signals`, where they are needed for something else too; walker: whose stride model and
    profile are used, by default those of a person of 1.70 m.

    A gap in the recording is a row of length 0 with a wide sigma. Without a gyroscope turns are 0 with a wide sigma.
    ``unknown`` names what the sensors cannot measure.

    Raises InputError if there is no accelerometer.
    """
    from pdr_graph.gait.signals import gait_signals  # here, since lifelogs use steps that were detected long ago

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
    variance = np.interp(np.append(start, gait.landings.time), gait.attitude.time, gait.direction.variance)
    return np.sqrt(usual**2 + np.diff(variance))


GAP_SPEED = 1.0  # [m/s] standard deviation per axis of the displacement in a gap: the walker stands or walks
GAP_SIGMA_TURN = 1.2  # [rad] of the heading change in a gap: nearly unknown, but the optimiser still has a gradient


def gap(
    start: float, end: float, turn: float = 0.0, sigma_turn: float = GAP_SIGMA_TURN, speed: float = GAP_SPEED
) -> Steps:
    """One row of length 0 for the time between two parts of a recording [s].

    turn, sigma_turn: heading change and its standard deviation [rad]; speed: standard deviation of the displacement
    per second and axis [m/s].
    """
    long, nothing = np.array([end - start]), np.zeros(1)
    return Steps(
        start,
        end,
        time=np.array([end]),
        duration=long,
        length=nothing,
        turn=np.array([turn]),
        pause_turn=nothing,
        sigma_length=speed * long,
        sigma_turn=np.array([sigma_turn]),
    )


def join(parts: Sequence[Steps]) -> Steps:
    """Join the parts of a walk, with a `gap` between each two."""
    joined = parts[0]
    for part in parts[1:]:
        joined = append_steps(append_steps(joined, gap(joined.end, part.start)), part)
    if len(parts) > 1:
        joined = replace(joined, unknown=(*joined.unknown, f"{len(parts) - 1} gaps in the recording"))
    return joined


def append_steps(first: Steps, then: Steps) -> Steps:
    """Concatenate two chunks of a walk; the second starts where the first ends."""
    return concatenate_steps((first, then))


def concatenate_steps(chunks: Sequence[Steps]) -> Steps:
    """Concatenate at least one chunk of a walk; each starts where the one before ends."""
    names = ("time", "duration", "length", "turn", "pause_turn", "sigma_length", "sigma_turn")
    columns = {name: np.concatenate([getattr(chunk, name) for chunk in chunks]) for name in names}
    row, turned = 0, 0.0  # [rad] since the last step
    for chunk in chunks:
        if len(chunk):
            columns["turn"][row] += turned
            columns["pause_turn"][row] += turned
            turned = 0.0
        row, turned = row + len(chunk), turned + chunk.final_turn
    unknown = tuple(dict.fromkeys(line for chunk in chunks for line in chunk.unknown))
    return Steps(chunks[0].start, chunks[-1].end, **columns, final_turn=turned, unknown=unknown)


def shifted(steps: Steps, by: float) -> Steps:
    """The same walk at times that are ``by`` [s] later."""
    return replace(steps, start=steps.start + by, end=steps.end + by, time=steps.time + by)


BLONDEL = 0.63  # [m] two rises and one going: Blondel's rule
SHORTEST_GOING, LONGEST_GOING = 0.22, 0.38  # [m] depths of treads that are built
SIGMA_GOING = 0.1  # [m] of a step on stairs: landings are among them; chosen by hand


def with_stair_lengths(steps: Steps, climbs: Climbs, kinds: tuple[str, ...]) -> Steps:
    """Shorten the steps on stairs to the depth of a tread: 0.63 m less twice the rise of a step (Blondel's rule).

    climbs, kinds: height changes and their kinds from `climb_kinds`. Stride models are fitted on level ground and
    overestimate steps on stairs by half.
    """
    from pdr_graph.inertial.barometer import STAIRS

    length, sigma = steps.length.copy(), steps.sigma_length.copy()
    for start, end, height, kind in zip(climbs.start, climbs.end, climbs.height, kinds, strict=True):
        on = (steps.time > start) & (steps.time - steps.duration < end) & ~steps.is_gap
        if kind == STAIRS and on.any():
            length[on] = np.clip(BLONDEL - 2 * abs(height) / np.count_nonzero(on), SHORTEST_GOING, LONGEST_GOING)
            sigma[on] = SIGMA_GOING
    return replace(steps, length=length, sigma_length=sigma)
