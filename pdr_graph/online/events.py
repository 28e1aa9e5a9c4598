"""What comes in while a person walks, in order of arrival.

A fix is ``Fixes`` of one row or of several, steps of another front end are ``Steps``; times are seconds of one clock,
any, that does not jump.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pdr_graph.errors import expect
from pdr_graph.types import Array, Fixes, Recording, Sightings, Steps

PACKET = 0.1  # [s] of samples that a phone hands over at once


@dataclass(frozen=True)
class Samples:
    """Of one sensor. sensor: its name, as of ``Recording.signals``; time: ``(n,)`` [s]; values: as of ``Signal``."""

    sensor: str
    time: Array
    values: Array


@dataclass(frozen=True)
class Scan:
    """What a radio heard. radio: "bluetooth" or "wifi"."""

    radio: str
    heard: Sightings


Event = Samples | Fixes | Scan | Steps


def events_of(recording: Recording, packet: float = PACKET) -> Iterator[Event]:
    """A recording as it would have come in: samples in packets, then what was measured meanwhile.

    packet: what a phone hands over at once [s].
    """
    expect("events_of, recording", recording, Recording, instead="load(path)")
    arriving: list[tuple[float, int, Event]] = []
    for sensor, signal in recording.signals.items():
        packets = _packets(signal.time, packet)
        arriving += [(time, 0, Samples(sensor, signal.time[rows], signal.values[rows])) for time, rows in packets]
    for radio, heard in (("bluetooth", recording.bluetooth), ("wifi", recording.wifi)):
        if heard is not None:
            packets = _packets(heard.time, packet)
            arriving += [(time, 1, Scan(radio, _some(heard, rows))) for time, rows in packets]
    arriving += [(time, 2, recording.fixes[rows]) for time, rows in _packets(recording.fixes.time, packet)]
    for _, _, event in sorted(arriving, key=lambda one: one[:2]):
        yield event


def _packets(time: Array, packet: float) -> Iterator[tuple[float, slice]]:
    """When each packet of times ``(n,)``, in order, is complete [s], and its rows."""
    number = np.floor(time / packet).astype(np.int64)
    bounds = np.flatnonzero(np.diff(number, prepend=number[:1] - 1, append=number[-1:] + 1)).tolist()
    for begin, end in pairwise(bounds):
        yield float(number[begin] + 1) * packet, slice(begin, end)


def _some(heard: Sightings, rows: slice) -> Sightings:
    return Sightings(heard.time[rows], heard.transmitter[rows], heard.rssi[rows], heard.minor[rows])
