"""The magnetic field as it is measured, and the phone's own iron: both as the samples come in."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from pdr_graph.inertial.magnetometer import TILTED, Iron, measured_field, refined, unknown_iron
from pdr_graph.inertial.stream import SensorStream
from pdr_graph.types import Array, Signal

PACKETS, KEPT = 20, 60.0  # that wait to be looked at, and [s] of samples that are kept for who asks late
LONGEST_APART = 120.0  # [s] between the latest sample and what is asked for
SAMPLES, EVERY = 600, 0.5  # the last ones that tell of iron, and [s] between them
ROUNDS = 3  # of the fit each time, which goes on from where it was


class LiveField:
    """What a magnetometer measured in the last minute."""

    kept = ("stream", "some", "up", "iron")

    def __init__(self):
        self.stream = SensorStream()
        self.some, self.up = np.empty((0, 3)), np.empty((0, 3))  # [µT] in the device, and the vertical in it
        self.iron = np.empty((0, 3))  # rows of hard, soft and sigma, once there is a fit

    def push(self, time: Array, values: Array) -> None:
        """Samples at times ``(n,)`` [s], as of `Signal`."""
        self.stream.push(time, values)
        if len(self.stream.arrived) >= PACKETS:
            self.take_in()

    def take_in(self) -> None:
        """Look at what was pushed."""
        self.stream.take_in(self.stream.offset)
        self.stream.forget(self.stream.last - KEPT)

    def at(self, time: Array, R_world_device: Rotation) -> Array:
        """The field ``(n, 3)`` in device axes at the next times ``(n,)``, evenly spaced; 0 where there is none. [µT]"""
        self.take_in()
        if not len(self.stream.time) or not len(time):
            return np.zeros((len(time), 3))
        if abs(self.stream.last - time[-1]) > LONGEST_APART:  # it stopped, or what came first had a wild time
            self.stream = SensorStream()
            return np.zeros((len(time), 3))
        field = measured_field(Signal(self.stream.time, self.stream.values), time)
        few = max(1, round(EVERY * len(time) / (time[-1] - time[0] + 1e-9)))
        up = R_world_device.inv().apply([0.0, 0.0, 1.0])
        some = np.flatnonzero(np.any(field, axis=1))[::few]
        self.some = np.concatenate([self.some, field[some]])[-SAMPLES:]
        self.up = np.concatenate([self.up, up[some]])[-SAMPLES:]
        return field

    def without_iron(self, field: Array, magnitude: float) -> Array:
        """The field ``(n, 3)`` around the phone of a measured one, where its tilt has told of iron. [µT]"""
        if not len(self.up) or np.linalg.norm(self.up.mean(axis=0)) >= TILTED:
            return field
        iron = Iron(self.iron[0], self.iron[1:4], self.iron[4]) if len(self.iron) else unknown_iron(self.some)
        for _ in range(ROUNDS):
            iron = refined(iron, self.some, magnitude)
        self.iron = np.vstack([iron.hard, iron.soft, iron.sigma])
        return np.where(np.any(field, axis=1)[:, None], iron.corrected(field), 0.0) if iron.known else field
