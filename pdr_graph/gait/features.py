"""What of each step tells its length."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pdr_graph.gait.gait import Gait
from pdr_graph.types import Array

SMOOTHING = 0.05  # [s] of the Gaussian over the vertical acceleration
WINDOW = 2.0  # [s] about a landing over which the spectrum is taken
BANDS = np.linspace(0.0, 5.0, 5)  # [Hz] [calibration-walk] has four between 0 and 5 Hz; their edges are not published


@dataclass(frozen=True)
class StepFeatures:
    """Of the n steps of a part of a recording; each is worked out when first asked for."""

    gait: Gait

    @property
    def amplitude(self) -> Array:
        """Of |a|, peak to peak ``(n,)``. [m/s²]"""
        return self.gait.landings.amplitude

    @property
    def period(self) -> Array:
        """Duration of a step ``(n,)``. [s]"""
        return self.gait.landings.period

    @cached_property
    def turn(self) -> Array:
        """Heading change over the step ``(n,)``. [rad]"""
        return self._turned(self.period)

    @cached_property
    def bend(self) -> Array:
        """Half of the heading change over the stride: without the body's sway from step to step ``(n,)``. [rad]"""
        return self._turned(2 * self.period) / 2

    @property
    def vertical(self) -> Array:
        """Vertical acceleration, peak to peak ``(n,)``. [m/s²]"""
        return self._lifts[:, 0]

    @property
    def lift(self) -> Array:
        """Time from the foot's lift to its landing, the vertical acceleration's lowest and highest ``(n,)``. [s]"""
        return self._lifts[:, 1]

    @cached_property
    def power(self) -> Array:
        """Of |a| about each landing, in four bands of 0–5 Hz ``(n, 4)``. [m²/s⁴]"""
        attitude = self.gait.attitude
        magnitude = np.linalg.norm(attitude.acceleration, axis=1)
        count = min(max(4, round(WINDOW / attitude.period)), len(magnitude))
        middle = np.searchsorted(attitude.time, self.gait.landings.time)
        first = np.clip(middle - count // 2, 0, len(magnitude) - count)
        windows = magnitude[first[:, None] + np.arange(count)]
        taper = np.hanning(count)
        level = (windows - windows.mean(axis=1, keepdims=True)) * taper
        spectrum = np.abs(np.fft.rfft(level, axis=1)) ** 2 / (taper**2).sum() / count
        band = np.digitize(np.fft.rfftfreq(count, attitude.period), BANDS) - 1
        return np.stack([spectrum[:, band == b].sum(axis=1) for b in range(len(BANDS) - 1)], axis=1)

    def _turned(self, duration: Array) -> Array:
        landed, time, heading = self.gait.landings.time, self.gait.attitude.time, self.gait.direction.heading
        return np.interp(landed, time, heading) - np.interp(landed - duration, time, heading)

    @cached_property
    def _lifts(self) -> Array:
        attitude, landings = self.gait.attitude, self.gait.landings
        up = attitude.R_world_device.apply(attitude.acceleration)[:, 2]
        smooth = gaussian_filter1d(up, SMOOTHING / attitude.period)
        found = np.zeros((len(landings), 2))
        for n, (landed, period) in enumerate(zip(landings.time, landings.period, strict=True)):
            first, middle, last = np.searchsorted(attitude.time, landed + period * np.array([-0.8, -0.3, 0.3]))
            high = middle + int(np.argmax(smooth[middle : last + 1])) if middle < len(smooth) else len(smooth) - 1
            low = first + int(np.argmin(smooth[first : high + 1]))
            found[n] = smooth[high] - smooth[low], max(high - low, 1) * attitude.period
        return found
