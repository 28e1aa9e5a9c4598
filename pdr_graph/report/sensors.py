"""How well each sensor recorded: rate, holes, stuck and clipped samples; and what a missing one would have told."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdr_graph.io.door import INERTIAL, are_gaps
from pdr_graph.types import Array, Recording, Sightings, Signal

TELLS = {  # what is not known of a walk without it
    "accelerometer": "steps",
    "gyroscope": "turns",
    "magnetometer": "the direction of the walk where fixes are few",
    "barometer": "changes of floor",
}
STILL_INERTIAL, STILL = 1.0, 10.0  # [s] of exactly the same value beyond which a sensor was stuck: noise alone moves it
CLIPPED = 3  # samples in a row at a sensor's own extreme: a peak that was not cut off has one, two by rounding


@dataclass(frozen=True)
class Health:
    """One sensor.

    samples; rate [Hz], by the usual interval; recorded: share of its time without gaps; gaps, the longest of them [s];
    stuck: longest time without any change, if that is too long [s]; clipped: samples cut off at the extremes of an
    inertial sensor.
    """

    samples: int
    rate: float
    recorded: float
    gaps: int
    longest_gap: float
    stuck: float
    clipped: int

    @property
    def ailments(self) -> tuple[str, ...]:
        """What is wrong with it, in words; nothing of one that is well."""
        said = {
            f"{self.gaps} gap{'s' * (self.gaps != 1)}, the longest of {self.longest_gap:.1f} s": self.gaps > 0,
            f"the same value for {self.stuck:.1f} s": self.stuck > 0,
            f"{self.clipped} samples cut off at the end of its range": self.clipped > 0,
        }
        return tuple(text for text, holds in said.items() if holds)


def health(name: str, signal: Signal) -> Health:
    """What the samples of a sensor, at least one, tell of it."""
    inertial, rate = name in INERTIAL, signal.rate
    interval, gap = np.diff(signal.time), are_gaps(signal)
    axes = signal.values.T.copy()  # each in one piece, as it is read
    moved = np.append(True, np.logical_or.reduce(axes[:, 1:] != axes[:, :-1]))
    since = signal.time[np.maximum.accumulate(np.where(moved, np.arange(len(moved)), 0))]
    still, lasted = float(np.max(signal.time - since)), float(np.ptp(signal.time))
    return Health(
        samples=len(signal),
        rate=rate,
        recorded=1.0 - float(interval[gap].sum()) / lasted if lasted else 1.0,
        gaps=int(gap.sum()),
        longest_gap=float(interval[gap].max(initial=0.0)),
        stuck=still if still > (STILL_INERTIAL if inertial else STILL) else 0.0,
        clipped=sum(_clipped(axis) for axis in axes) if inertial else 0,
    )


def _clipped(values: Array) -> int:
    """How many samples of one axis are in runs at its largest or smallest value, while the sensor moved."""
    if np.ptp(values) == 0:
        return 0
    edge = np.flatnonzero(
        np.diff(np.concatenate([[False], (values == values.max()) | (values == values.min()), [False]]))
    )
    length = edge[1::2] - edge[::2]
    return int(length[length >= CLIPPED].sum())


def table(walk: Recording) -> tuple[list[str], list[list[str]]]:
    """Head and rows of the page's table: sensors first, then radios and the recording's own fixes."""
    missing = [name for name in TELLS if name not in walk.signals]
    if "linear_acceleration" in walk.signals and "accelerometer" in missing:
        missing.remove("accelerometer")
    rows = [_row(name, signal, walk.notes) for name, signal in walk.signals.items()]
    rows += [[name, "not recorded", "", "", f"without it, nothing told {TELLS[name]}"] for name in missing]
    rows += [_radio(name, heard) for name, heard in (("Bluetooth", walk.bluetooth), ("Wi-Fi", walk.wifi)) if heard]
    if len(walk.fixes):
        rows.append(["positions of its own", f"{len(walk.fixes):,}", _often(walk.fixes.time), "", ""])
    return ["sensor", "samples", "rate", "recorded", "remarks"], rows


def _row(name: str, signal: Signal, notes: tuple[str, ...]) -> list[str]:
    found = health(name, signal)
    noted = [note.removeprefix(f"{name}: ") for note in notes if note.startswith(f"{name}: ") and " gaps, " not in note]
    remarks = "; ".join([*found.ailments, *noted]) or "well"
    plain = name.replace("_", " ")
    return [plain, f"{found.samples:,}", f"{found.rate:.1f} Hz", f"{found.recorded:.1%}", remarks]


def _radio(name: str, heard: Sightings) -> list[str]:
    return [name, f"{len(heard):,}", _often(heard.time), "", f"{len(set(heard.transmitter))} transmitters"]


def _often(time: Array) -> str:
    lasted = float(np.ptp(time))
    return f"{len(time) / lasted:.2g} a second" if lasted else ""
