"""A recording as the messages that Sensor Logger pushes while it records: for tests and load measurements."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from pdr_graph.io.validation import RADIUS_68
from pdr_graph.lab.simulation.recorders import bearing
from pdr_graph.types import LONLAT, STANDARD_GRAVITY, Array, Recording

STREAM_NAMES = {"accelerometer": "accelerometeruncalibrated", "linear_acceleration": "accelerometer"}


def batches(walk: Recording, period: float = 1.0, ios: bool = False) -> list[list[dict[str, Any]]]:
    """The samples of each message, in order of time; period: of the messages [s]; ios: its signs and g.

    Times are the recording's epoch and on, else 2024-01-01 and on, in nanoseconds.
    """
    epoch = round((walk.epoch or 1_704_067_200.0) * 1e9)
    rows = list[tuple[float, dict[str, Any]]]()
    for sensor, signal in walk.signals.items():
        keys = ("pressure",) if sensor == "barometer" else ("x", "y", "z")
        factor = -1 / STANDARD_GRAVITY if ios and "acceler" in sensor else 1.0
        rows += _samples(STREAM_NAMES.get(sensor, sensor), signal.time, signal.values * factor, keys, epoch)
    fixes = walk.fixes
    if len(fixes) and fixes.epsg == LONLAT:
        motion = np.nan_to_num(np.column_stack([fixes.speed, bearing(fixes.course)]), nan=-1.0)  # unknown
        values = np.column_stack([fixes.position[:, ::-1], RADIUS_68 * fixes.sigma, motion])
        names = "latitude", "longitude", "horizontalAccuracy", "speed", "bearing"
        rows += _samples("location", fixes.time, values, names, epoch)
    rows.sort(key=lambda row: row[0])
    groups = dict[int, list[dict[str, Any]]]()
    for time, sample in rows:
        groups.setdefault(int(max(time, 0.0) // period), []).append(sample)
    return [groups[number] for number in sorted(groups)]


def _samples(
    name: str, time: Array, values: Array, keys: Sequence[str], epoch: int
) -> list[tuple[float, dict[str, Any]]]:
    return [
        (t, {"name": name, "time": epoch + round(t * 1e9), "values": dict(zip(keys, row, strict=True))})
        for t, row in zip(time.tolist(), values.tolist(), strict=True)
    ]


def message(session: str, number: int, payload: Sequence[dict[str, Any]], device: str = "simulated") -> bytes:
    """The body of one message."""
    content = {"messageId": number, "sessionId": session, "deviceId": device, "payload": list(payload)}
    return json.dumps(content).encode()
