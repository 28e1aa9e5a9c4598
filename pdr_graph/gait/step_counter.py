"""Steps of a phone's or a watch's own counter: a number at some times, and no other sensor of motion."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from pdr_graph.gait.walker import MODELS, Walker
from pdr_graph.inertial.attitude import NO_GYROSCOPE
from pdr_graph.priors import MOTION, STEP
from pdr_graph.types import Signal, Steps, take


def counted_steps(counter: Signal, walker: Walker) -> Steps | None:
    """The steps between the readings of a counter, evenly in time; None if it did not count.

    counter: ``(n, 1)`` number of steps since any moment; where it falls it was reset. Lengths are those of the walker's
    stride model by height or cadence, else by height. Turns are 0 with the sigma of a walk without a gyroscope.
    A reading that counts more steps than a person can make in its time keeps those that fit.
    """
    waited = np.diff(counter.time)
    rise = np.minimum(np.diff(counter.values[:, 0]).round().clip(0), np.floor(waited / STEP.shortest)).astype(int)
    if not rise.any():
        return None
    spread = np.repeat(waited / np.maximum(rise, 1), rise)
    first = np.repeat(np.cumsum(rise) - rise, rise)
    time = np.repeat(counter.time[:-1], rise) + (np.arange(len(spread)) - first + 1) * spread
    duration = np.minimum(spread, STEP.usual)
    nothing = np.zeros(len(time))
    model, constants = ("cadence", walker.constants) if walker.stride == "cadence" else ("height", {})
    features = SimpleNamespace(period=duration, turn=nothing)
    length, sigma_length = MODELS[model](features, height=walker.height, **constants)
    return Steps(
        start=float(counter.time[0]),
        end=float(counter.time[-1]),
        time=time,
        duration=duration,
        length=length,
        turn=nothing,
        pause_turn=nothing,
        sigma_length=sigma_length,
        sigma_turn=np.full(len(time), MOTION.unmeasured_turn),
        unknown=(NO_GYROSCOPE,),
    )


def one_by_one(steps: Steps) -> list[Steps]:
    """The steps as chunks of a step each, from the end of the step before, as a live counter gives them."""
    ends = np.append(steps.time[:-1], steps.end).tolist()
    spans = zip([steps.start, *ends], ends, strict=False)
    return [replace(take(steps, slice(n, n + 1)), start=start, end=end) for n, (start, end) in enumerate(spans)]
