"""Chunks of steps: gaps between them, and walks put together from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pdr_graph.errors import count
from pdr_graph.priors import MOTION
from pdr_graph.types import INSTANT, STEP_COLUMNS, Array, Steps


def gap(
    start: float,
    end: float,
    turn: float = 0.0,
    sigma_turn: float | None = None,
    speed: float | None = None,
    rows: Array | None = None,
) -> Steps:
    """The time between two parts of a recording [s]: a row of length 0, or one to each of the times `rows` within.

    turn, sigma_turn: heading change and its standard deviation [rad]; speed: standard deviation of the displacement
    per second and axis [m/s]. Several rows have the displacement of one, divided among them; the last has the turn.
    """
    within = [] if rows is None else rows[(rows > start + INSTANT) & (rows < end - INSTANT)]
    time = np.unique(np.append(within, end))
    duration, nothing = np.diff(time, prepend=start), np.zeros(len(time))
    share = duration / (end - start)
    speed, last = MOTION.gap_speed if speed is None else speed, time == end
    return Steps(
        start,
        end,
        time=time,
        duration=duration,
        length=nothing,
        turn=turn * last,
        pause_turn=nothing,
        sigma_length=speed * (end - start) * np.sqrt(share),
        sigma_turn=np.where(last, MOTION.gap_turn if sigma_turn is None else sigma_turn, MOTION.standing_turn),
    )


def gap_ends(steps: Steps) -> Array:
    """Times at which gaps end [s]; consecutive rows of length 0 are one gap."""
    goes_on = np.append(np.abs(steps.time[:-1] - (steps.time - steps.duration)[1:]) <= INSTANT, False)
    return steps.time[steps.is_gap & ~(goes_on & np.append(steps.is_gap[1:], False))]


def join(parts: Sequence[Steps]) -> Steps:
    """Join the parts of a walk, with a `gap` between each two."""
    joined = parts[0]
    for part in parts[1:]:
        joined = append_steps(append_steps(joined, gap(joined.end, part.start)), part)
    if len(parts) > 1:
        joined = replace(joined, unknown=(*joined.unknown, f"steps in {count(len(parts) - 1, 'gap')} of the recording"))
    return joined


def append_steps(first: Steps, then: Steps) -> Steps:
    """Concatenate two chunks of a walk; the second starts where the first ends."""
    return concatenate_steps((first, then))


def concatenate_steps(chunks: Sequence[Steps]) -> Steps:
    """Concatenate at least one chunk of a walk; each starts where the chunk before ends."""
    columns = {name: np.concatenate([getattr(chunk, name) for chunk in chunks]) for name in STEP_COLUMNS}
    row, turned = 0, 0.0  # [rad] since the last step
    for chunk in chunks:
        if len(chunk):
            columns["turn"][row] += turned
            columns["pause_turn"][row] += turned
            turned = 0.0
        row, turned = row + len(chunk), turned + chunk.final_turn
    unknown = tuple(dict.fromkeys(line for chunk in chunks for line in chunk.unknown))
    stepless, missing = sum(chunk.stepless for chunk in chunks), sum(chunk.missing for chunk in chunks)
    times: dict[str, Any] = {"final_turn": turned, "stepless": stepless, "missing": missing}
    return Steps(chunks[0].start, chunks[-1].end, **columns, **times, unknown=unknown)


def shifted(steps: Steps, by: float) -> Steps:
    """The same walk at times that are ``by`` [s] later."""
    return replace(steps, start=steps.start + by, end=steps.end + by, time=steps.time + by)
