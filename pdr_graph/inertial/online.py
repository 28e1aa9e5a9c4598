"""Attitude sample by sample: VQF as it was made for, causal."""

from __future__ import annotations

from typing import Any

import numpy as np
import vqf

from pdr_graph.inertial.attitude import PHONE, vertical_of
from pdr_graph.inertial.stationary import LARGEST_BIAS, SHORTEST_REST, STILL_ACCELERATION, STILL_RATE
from pdr_graph.inertial.stream import LARGEST
from pdr_graph.types import STANDARD_GRAVITY, Array, Mask

FOLLOWED = np.radians(1.0)  # [rad/s] of bias that VQF finds by itself; it stops at twice that


class Gravity:
    """Where a recorder removed it: along the axis that shook most by now, as `attitude_of` has it in the end."""

    kept = ("moments",)

    def __init__(self):
        self.moments = np.zeros((4, 4))  # sums of products of (1, x, y, z)

    @property
    def needed(self) -> bool:
        """True once it was."""
        return bool(self.moments[0, 0] > 0)

    def added(self, values: Array) -> Array:
        """Accelerations with gravity ``(n, 3)`` of some without. [m/s²]"""
        ones = np.concatenate([np.ones((len(values), 1)), values], axis=1)[(np.abs(values) < LARGEST).all(axis=1)]
        self.moments += ones.T @ ones
        count, total = self.moments[0, 0], self.moments[0, 1:]
        covariance = self.moments[1:, 1:] - np.outer(total, total) / max(count, 1.0)
        return values + STANDARD_GRAVITY * vertical_of(covariance)


class OnlineAttitude:
    """The phone's attitude as samples come in. bias: ``(3,)`` of the gyroscope that was known before [rad/s]."""

    kept = ("rested", "recent", "filter_state")

    def __init__(self, period: float, bias: Array | None = None):
        self.rested = np.zeros(3)  # [rad/s], what a rest said of the bias
        self.recent = np.empty((0, 6))  # samples of both sensors
        self._samples = max(3, round(SHORTEST_REST / period))
        options: dict[str, Any] = PHONE
        self._vqf: Any = vqf.VQF(period, **options)  # the stubs do not know that its state can be set
        if bias is not None:
            self._vqf.setBiasEstimate(np.array(bias))

    def update(self, acceleration: Array, angular_rate: Array, seen: Mask) -> tuple[Array, Array]:
        """Quaternions ``(n, 4)`` from device to world, scalar last, and angular rates ``(n, 3)`` without bias [rad/s].

        acceleration ``(n, 3)`` [m/s²]; angular_rate ``(n, 3)`` [rad/s]; seen: ``(n,)`` where the gyroscope ran: where
        not, the vertical follows the accelerometer and the bias stays.
        """
        ran = bool(seen.all())
        if ran:
            self._learn_from_rest(acceleration, angular_rate)
        else:
            angular_rate = np.where(seen[:, None], angular_rate, self.bias)
        self._vqf.setMotionBiasEstEnabled(ran)
        self._vqf.setRestBiasEstEnabled(ran)
        rate = np.ascontiguousarray(angular_rate - self.rested)
        out = self._vqf.updateBatch(rate, np.ascontiguousarray(acceleration))
        return np.roll(out["quat6D"], -1, axis=1), rate - out["bias"]

    @property
    def bias(self) -> Array:
        """Of the gyroscope, by now ``(3,)``. [rad/s]"""
        return self.rested + np.array(self._vqf.state["bias"])

    @property
    def filter_state(self) -> Array:
        """All that VQF knows."""
        return np.concatenate([np.ravel(value) for value in self._vqf.state.values()]).astype(float)

    @filter_state.setter
    def filter_state(self, state: Array) -> None:
        now = self._vqf.state
        parts = np.split(state, np.cumsum([np.size(value) for value in now.values()])[:-1])
        values = zip(now.items(), parts, strict=True)
        self._vqf.state = {
            name: part.tolist() if isinstance(value, list) else type(value)(part[0]) for (name, value), part in values
        }

    def _learn_from_rest(self, acceleration: Array, angular_rate: Array) -> None:
        """A bias that is too large for VQF to find shows at rest."""
        recent = np.concatenate([self.recent, np.concatenate([angular_rate, acceleration], axis=1)])
        self.recent = recent[-self._samples :]
        if len(self.recent) < self._samples:
            return
        mean = self.recent.mean(axis=0)
        spread = np.sqrt(np.mean((self.recent - mean) ** 2, axis=0))
        still = np.linalg.norm(spread[:3]) < STILL_RATE and np.linalg.norm(spread[3:]) < STILL_ACCELERATION
        said = mean[:3]
        if still and np.linalg.norm(said) < LARGEST_BIAS and np.linalg.norm(said - self.rested) > FOLLOWED:
            self.rested = said
            self._vqf.setBiasEstimate(np.zeros(3))
