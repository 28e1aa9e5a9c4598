"""Candidate landings of the last seconds, as samples arrive: only what later samples may change is computed again.

Every stage of `candidates_in_magnitude` depends on samples to either side. Up to some second before the last sample its
output is final and is stored; after that it is computed at each update as for a recording that ends there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import correlate1d

from pdr_graph.gait.step_detection import (
    DURATIONS,
    LAGS,
    NO_CANDIDATES,
    SHORTEST_SIGNAL,
    Candidates,
    at_frequency,
    best_duration,
    longest_reach,
    maxima,
    strong_maxima,
)
from pdr_graph.geometry import gaussian_weights
from pdr_graph.priors import CANDIDATE
from pdr_graph.types import Array, Index

MARGIN = 1e-6  # [s] rounding of a time that is counted from another sample


class WindowSums:
    """Sums of the products of a signal with itself and of its squares, in windows as those of `_correlations`."""

    def __init__(self, sampling: float):
        self.lags = np.maximum(1, np.round(LAGS / sampling)).astype(int)
        self.size = max(1, round(CANDIDATE.window / sampling))
        self.after = self.lags - self.lags // 2  # from the middle of a product to its later sample
        self.first = 0  # number of the sample before which `sums` begin
        self.sums = np.zeros((2 * len(LAGS), 1))  # of all samples before one

    @property
    def reach(self) -> int:
        """Number of samples after one on which its correlations depend."""
        return self.size - self.size // 2 + int(self.after.max())

    def extend(self, level: Array, begin: int) -> None:
        """Add samples, of which the first has number ``begin``; level: these after the longest lag of earlier ones."""
        past = int(self.lags[-1])
        now, at = level[past:], past + np.arange(len(level) - past)
        earlier = level[at - self.lags[:, None]]
        power = earlier**2 / 2 + now**2 / 2
        if begin < past:
            power[begin + at - past < self.lags[:, None]] = 0.0  # there is no earlier sample
        kept = self.sums[:, : begin - self.first + 1]
        new = np.cumsum(np.concatenate([earlier * now, power]), axis=1)
        self.sums = np.concatenate([kept, kept[:, -1:] + new], axis=1)

    def correlations(self, begin: int, end: int) -> tuple[Array, Array]:
        """Correlation ``(k, n)`` with the signal a step and a stride earlier, at the samples [begin, end)."""
        low = np.arange(begin, end) - self.size // 2 - self.first + self.after[:, None]
        last, rows = self.sums.shape[1] - 1, np.arange(len(LAGS))[:, None] * self.sums.shape[1]
        high = rows + np.minimum(low + self.size, last)
        low = rows + np.clip(low, 0, last)
        flat = self.sums.reshape(-1)
        products, powers = flat[: flat.size // 2], flat[flat.size // 2 :]
        product, power = products[high] - products[low], powers[high] - powers[low]
        correlation = product / (power + 1e-4 * self.size)
        return correlation[: len(DURATIONS)], correlation[len(DURATIONS) :]

    def forget(self, before: int) -> None:
        """Drop the sums that no correlation at a sample from ``before`` on depends on."""
        drop = before - self.size // 2 - self.first
        if drop > 0:
            self.first += drop
            self.sums = self.sums[:, drop:] - self.sums[:, drop : drop + 1]


class CandidateStream:
    """The candidates among the last samples of the smoothed |a|.

    sampling: between samples [s]; look_ahead: as of `candidates`; first: number of the first stored sample.
    level, which, regularity, wave: of the stored samples, as in `candidates_in_magnitude`; they are final before the
    samples ``level_final``, ``which_final`` and ``wave_final``. certain: times of final maxima before ``certain_from``.
    """

    def __init__(self, sampling: float, look_ahead: float, first: int):
        self.sampling, self.look_ahead, self.first = sampling, look_ahead, first
        self.windowed = WindowSums(sampling)
        self.windowed.first = first
        self.past = int(self.windowed.lags[-1])
        self.reach = longest_reach(sampling)
        self.late = round((CANDIDATE.look_ahead - look_ahead) / sampling)
        self.level = np.zeros(self.past)  # begins so many samples before `first`
        self.which, self.regularity = np.empty(0, dtype=np.intp), np.empty(0)
        self.wave = np.empty(0, dtype=complex)
        self.level_final = self.which_final = self.wave_final = self.certain_from = first
        self.certain: list[float] = []  # times [s] of final maxima since sample 0

    def update(self, smooth: Array, final: int) -> None:
        """Compute all stages anew that depend on new samples.

        smooth: all stored samples and the new ones; final: number of the first that later samples may change.
        """
        end = self.first + len(smooth)
        self._update_level(smooth)
        self._update_rhythm(end)
        which = self.available(self.wave_final, end)
        level = np.append(self.level[self.wave_final - self.first + self.past - self.reach :], np.zeros(self.reach))
        fresh = at_frequency(level, self.which[which - self.first], self.sampling)
        self.wave = np.concatenate([self.wave[: self.wave_final - self.first], fresh])

        smoothing = len(gaussian_weights(CANDIDATE.level / self.sampling)) // 2
        self.level_final = max(self.level_final, final - smoothing)
        self.which_final = max(self.which_final, self.level_final - self.windowed.reach)
        self.wave_final = max(self.wave_final, min(self.which_final + self.late, self.level_final - self.reach))
        self._update_certain()

    def _update_level(self, smooth: Array) -> None:
        weights = gaussian_weights(CANDIDATE.level / self.sampling)
        known = self.level_final - self.first
        begin = max(0, known - len(weights) // 2)
        fresh = smooth[begin:] - correlate1d(smooth[begin:], weights)
        self.level = np.concatenate([self.level[: self.past + known], fresh[known - begin :]])
        self.windowed.extend(self.level[known:], self.level_final)

    def _update_rhythm(self, end: int) -> None:
        which, regularity = best_duration(*self.windowed.correlations(self.which_final, end))
        known = self.which_final - self.first
        self.which = np.concatenate([self.which[:known], which])
        self.regularity = np.concatenate([self.regularity[:known], regularity])

    def available(self, begin: int, end: int) -> Index:
        """Numbers of the samples whose rhythm is used at the samples [begin, end): so early is it known there."""
        return np.maximum(np.arange(begin, end) - self.late, self.first)

    def candidates(self, steadiness: Array, after: float, origin: int) -> Candidates:
        """The candidates after a time [s] since sample 0. steadiness: ``(n,)`` of the stored samples.

        origin: number of the sample from which their times are counted first.
        """
        end = self.first + len(self.wave)
        if (end - origin) * self.sampling < SHORTEST_SIGNAL:
            return NO_CANDIDATES
        begin = max(origin, self._sample(after) - round(CANDIDATE.look_ahead / self.sampling) - 1)
        rhythm, rows = self.available(begin, end) - self.first, slice(begin - self.first, None)
        signals = self.wave[rows], self.which[rhythm], self.regularity[rhythm], steadiness[rows]
        found = strong_maxima(*signals, self.sampling, self.look_ahead, begin - origin)
        found = replace(found, time=found.time + origin * self.sampling)
        return found[found.time > after]

    def is_due(self, after: float, until: float) -> bool:
        """False if it is certain that no candidate lies between two times [s] since sample 0."""
        if until > (self.wave_final - 1) * self.sampling:
            return True
        return any(after - MARGIN < time <= until + MARGIN for time in self.certain)

    def _update_certain(self) -> None:
        """Update the times of the maxima that are final and may become candidates."""
        known = self.certain_from - self.first
        peaks, time = maxima(self.wave[known : self.wave_final - self.first], self.sampling, self.certain_from)
        high = 2 * np.abs(self.wave[known + peaks]) > CANDIDATE.weakest
        self.certain = [t for t in self.certain if t >= self.first * self.sampling] + time[high].tolist()
        self.certain_from = max(self.certain_from, self.wave_final - 1)

    def _sample(self, time: float) -> int:
        """Number of the last sample before a time [s]."""
        return max(self.first, int(time / self.sampling)) if time > 0 else self.first

    def forget(self, first: int) -> None:
        """Drop the samples before number ``first``."""
        drop = first - self.first
        if drop > 0:
            self.first = first
            self.level, self.wave = self.level[drop:], self.wave[drop:]
            self.which, self.regularity = self.which[drop:], self.regularity[drop:]
            self.windowed.forget(self.which_final)
