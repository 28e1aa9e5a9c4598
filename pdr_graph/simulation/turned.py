"""A recording as if the phone had been turned about the vertical in mid-walk: a re-hold put into a real walk."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from pdr_graph.types import Array, Recording, Signal

WITHIN = 0.7  # [s]


def turned_in_hand(recording: Recording, up: Array, begin: float, angle: float) -> Recording:
    """What the phone would have logged, had a hand turned it by ``angle`` [rad] from ``begin`` [s] on.

    up: ``(3,)`` the vertical in the device then. Only accelerometer and gyroscope are turned.
    """

    def felt(signal: Signal | None, own_rate: float) -> Signal | None:
        if signal is None:
            return None
        share = (signal.time - begin) / WITHIN
        values = Rotation.from_rotvec(-angle * np.clip(share, 0, 1)[:, None] * up).apply(signal.values)
        turning = own_rate * angle / WITHIN * ((share > 0) & (share < 1))
        return Signal(signal.time, values + turning[:, None] * up)

    return replace(
        recording, accelerometer=felt(recording.accelerometer, 0.0), gyroscope=felt(recording.gyroscope, 1.0)
    )
