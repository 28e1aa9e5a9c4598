"""A recording's sensors on one uniform time grid, as every attitude method wants them."""

from __future__ import annotations

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.geometry import interpolate
from pdr_graph.types import Array, Recording, Signal

SHORTEST_WALK = 1.0  # [s]
LONGEST_BRIDGED = 1.0  # [s] of missing samples that are interpolated: a step or two
LEAST_GRAVITY, MOST_GRAVITY = 7.0, 13.0  # [m/s²] median |a|; walking raises it a little, other units by far
MOST_SAMPLES = 40_000_000  # a day at 400 Hz


def on_one_grid(recording: Recording, *names: str) -> tuple[Array, float, list[Array]]:
    """Times ``(n,)`` and the period between them [s], and the named sensors' samples ``(n, 3)``, accelerometer first.

    Raises InputError if a sensor is missing, gravity is not in the accelerometer's samples, or they have less than a
    second in common.
    """
    signals = [_required(recording, name) for name in names]
    _check_gravity(recording, signals[0])
    time, period = _uniform_grid(recording, signals)
    return time, period, [interpolate(time, signal.time, signal.values) for signal in signals]


def _required(recording: Recording, name: str) -> Signal:
    signal = recording.signals.get(name)
    if signal is None or len(signal) < 2:
        raise InputError(recording.source, name, "no samples", "its samples over the whole walk")
    return signal


def _check_gravity(recording: Recording, accelerometer: Signal) -> None:
    gravity = float(np.median(np.linalg.norm(accelerometer.values, axis=1)))
    if not LEAST_GRAVITY < gravity < MOST_GRAVITY:
        needed = "about 9.8 m/s²: metres per second squared, gravity not removed"
        raise InputError(recording.source, "accelerometer", f"a median magnitude of {gravity:.2f}", needed)


def _uniform_grid(recording: Recording, signals: list[Signal]) -> tuple[Array, float]:
    """The common span of the signals, at the rate of the first."""
    start, end = max(s.time[0] for s in signals), min(s.time[-1] for s in signals)
    if end - start < SHORTEST_WALK:
        found = f"{max(end - start, 0):.2f} s that its sensors have in common"
        raise InputError(recording.source, "", found, f"at least {SHORTEST_WALK:.0f} s")
    intervals = np.diff(signals[0].time)
    samples = round((end - start) / float(np.median(intervals[intervals > 0]))) + 1
    if samples > MOST_SAMPLES:
        found = f"{end - start:.0f} s, {samples} samples at their usual interval"
        raise InputError(recording.source, "accelerometer", found, f"up to {MOST_SAMPLES}: are its times in seconds?")
    return np.linspace(start, end, samples), (end - start) / (samples - 1)
