"""Climbs by kind: stairs, lift, escalator, ramp or a pressure draught; and the length of steps on stairs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdr_graph.inertial.barometer import Climbs
from pdr_graph.types import Array, Steps

STAIRS, LIFT, ESCALATOR, RAMP, DRAUGHT = "stairs", "lift", "escalator", "ramp", "draught"
WALKED = 0.5  # of a climb's time, spent on steps
# Rise of a step [m]: treads are 0.14–0.20, flights with their landings half of that, two at a time 0.36; the
# steepest ramp for wheelchairs, of 1 in 12, gives 0.055. Two at a time and stairs that move are not told apart.
STEEPEST_RAMP, HIGHEST_STAIRS, HIGHEST_STEP = 0.055, 0.25, 0.5
SLOWEST_LIFT = 0.42  # [m/s]; escalators of 0.5–0.65 m/s at 30–35° rise by 0.25–0.37


def kinds(steps: Steps, climbs: Climbs) -> tuple[str, ...]:
    """Of each climb whether it was stairs, a lift, an escalator, a ramp, or a draught.

    A draught is a change of pressure that no walker could have made: half a metre a step.
    """
    seconds = climbs.end - climbs.start
    walked = _walked(steps, climbs)
    rate = np.abs(climbs.height) / seconds
    a_step = np.abs(climbs.height) / np.maximum(_count(steps, climbs), 1)
    on_foot = walked > WALKED * seconds
    kind = np.where(
        on_foot,
        np.select(
            [a_step > HIGHEST_STEP, a_step > HIGHEST_STAIRS, a_step > STEEPEST_RAMP], [DRAUGHT, ESCALATOR, STAIRS], RAMP
        ),
        np.where(rate > SLOWEST_LIFT, LIFT, ESCALATOR),
    )
    return tuple(str(k) for k in kind)


def _walked(steps: Steps, climbs: Climbs) -> Array:
    """Time ``(c,)`` [s] that was spent on steps during each climb."""
    knots = np.stack([steps.time - steps.duration, steps.time], axis=1).ravel()
    spent = np.repeat(np.append(0.0, np.cumsum(steps.duration)), 2)[1:-1]
    return _between(climbs, knots, spent)


def _count(steps: Steps, climbs: Climbs) -> Array:
    """Steps ``(c,)`` made during each climb, with shares of those at its ends."""
    knots = np.stack([steps.time - steps.duration, steps.time], axis=1).ravel()
    return _between(climbs, knots, np.repeat(np.arange(len(steps) + 1.0), 2)[1:-1])


def _between(climbs: Climbs, knots: Array, total: Array) -> Array:
    if not len(knots):
        return np.zeros(len(climbs))
    return np.interp(climbs.end, knots, total) - np.interp(climbs.start, knots, total)


STRIDE = 0.63  # [m] two rises and one going
SHALLOWEST, DEEPEST = 0.22, 0.38  # [m] goings that are built
SIGMA = 0.1  # [m] of a step: landings are among them


def with_stair_lengths(steps: Steps, climbs: Climbs, kinds: tuple[str, ...]) -> Steps:
    """The steps, those on stairs as long as a tread: 0.63 m less twice what a step rises (Blondel's rule).

    A stride model knows of walking on the level only, and takes stairs for half as long again as they are.
    """
    length, sigma = steps.length.copy(), steps.sigma_length.copy()
    for start, end, height, kind in zip(climbs.start, climbs.end, climbs.height, kinds, strict=True):
        on = (steps.time > start) & (steps.time - steps.duration < end) & ~steps.is_gap
        if kind == STAIRS and on.any():
            length[on] = np.clip(STRIDE - 2 * abs(height) / np.count_nonzero(on), SHALLOWEST, DEEPEST)
            sigma[on] = SIGMA
    return replace(steps, length=length, sigma_length=sigma)
