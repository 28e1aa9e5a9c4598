"""Ranges to anchors at surveyed positions: UWB, Wi-Fi RTT, BLE ranging.

A range is the distance to an anchor plus the anchor's bias, noise, and sometimes a detour: without line of sight the
signal takes a longer path, so these errors are positive. The noise is a mixture (Jourdan, Dardari, Win, "Position error
bound for UWB localization in dense cluttered environments", IEEE T-AES 44(2), 2008, Sec. III),

    z = d + b + ε,      p(ε) = (1 − ν) N(ε; 0, σ) + ν · exp(1 − √(1 + (ε / D)²)) / (MASS D)

with ν = RANGES.nlos and D = RANGES.detour. Its negative logarithm is the loss: a range too long by many sigmas has
almost no weight, one too short has Huber's. Their detours are exponential; ours are so far off, and level at 0, so that
the expected range is the most probable.
Position and bias of each anchor are variables (x, y, b) with the survey as prior, so that a walk can correct them.
So is the lag of all ranges, whose clock may be another device's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from pdr_graph.estimation.factors.base import (
    AnyArray,
    FactorBlock,
    Itemized,
    Locating,
    Loss,
    Refined,
    Remembered,
    RobustLoss,
    Variables,
    huber_cost,
    huber_weight,
)
from pdr_graph.estimation.factors.gnss_bias import QUARTER
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.geometry import as_points, rotation
from pdr_graph.priors import RANGES, REPORTS
from pdr_graph.types import INSTANT, KEYFRAME, TABLE, Array, Complex, Fixes, Index, RangeReport, Ranges, Steps, take

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.chain import Chain, Evaluation

NEAR_ANCHOR = 0.1  # [m] softens the distance at the anchor itself, where it has no gradient
ROUGH_EVERY, ROUGH_SIGMA = 5.0, 5.0  # [s] between rough positions; [m] of these
MASS = 1.636  # integral of exp(1 − √(1 + x²)) from 0 on


@dataclass(frozen=True)
class LongErrors(Loss):
    """Negative log of the mixture, of deviations s = (expected − measured) / σ, which are negative for long ranges.

    scale: ``(n,)`` mean detour [σ] of each range.
    """

    scale: Array

    def weight(self, deviation: Array) -> Array:
        """Huber's weight for short ranges; else the slope of the cost by the deviation, mostly by line of sight."""
        sight, detour, stretch = self._log_likelihoods(deviation)
        share = np.exp(sight - np.logaddexp(sight, detour))
        long = share + (1 - share) / (self.scale**2 * stretch)
        return np.where(deviation > 0, huber_weight(deviation), long)

    def cost(self, deviation: Array) -> Array:
        """Negative log-likelihood, 0 at the expected range; Huber's loss for short ranges."""
        sight, detour, _ = self._log_likelihoods(deviation)
        sight_at_zero, detour_at_zero, _ = self._log_likelihoods(np.zeros(len(deviation)))
        long = np.logaddexp(sight_at_zero, detour_at_zero) - np.logaddexp(sight, detour)
        return np.where(deviation > 0, huber_cost(deviation), long)

    def _log_likelihoods(self, deviation: Array) -> tuple[Array, Array, Array]:
        """Log-likelihoods of deviations ``(n,)`` [σ] with line of sight and with a detour, and √(1 + (s / scale)²)."""
        stretch = np.sqrt(1 + (deviation / self.scale) ** 2)
        detour = np.log(RANGES.nlos * np.sqrt(2 * np.pi) / (MASS * self.scale)) + 1 - stretch
        return np.log(1 - RANGES.nlos) - 0.5 * deviation**2, detour, stretch


@dataclass(frozen=True, eq=False)
class RangeFactor(Itemized, Refined, Remembered, Locating):
    """Ranges to anchors: r = (|a − (p + R(θ) w(τ))| + b − z) / σ, with where the walker was τ before, w.

    ranges: ``n`` of them, to ``m`` anchors; number: ``(n,)`` permanent numbers; keyframe: ``(n,)``
    track, time: ``(k,)`` of dead-reckoned keyframes; ahead: ``(n,)`` the walker's direction there at each range
    detours: use the mixture above; False for a first optimum with Huber's loss.
    """

    ranges: Ranges
    number: Index
    keyframe: Index = field(metadata=KEYFRAME)
    track: Complex = field(metadata=TABLE)
    time: Array = field(metadata=TABLE)
    ahead: Complex
    detours: bool = False

    name: ClassVar[str] = "ranges"
    symbol: ClassVar[str] = "r"
    symbol_lag: ClassVar[str] = "l"
    determines_position: ClassVar[bool] = True

    @classmethod
    def of(cls, ranges: Ranges, steps: Steps, prior: Prior, number: Index | None = None) -> RangeFactor:
        """The ranges measured during the recording."""
        number = np.arange(len(ranges)) if number is None else number
        inside = np.flatnonzero((ranges.time >= steps.start) & (ranges.time <= steps.end))
        none = np.empty(0, dtype=np.complex128)
        return cls(take(ranges, inside), number[inside], np.full(len(inside), -1), none, np.empty(0), none)

    def keyframe_times(self) -> Array:
        """The times of the ranges."""
        return self.ranges.time

    def bind(self, chain: Chain) -> Self:
        """Bind every range to its keyframe, and keep what was walked before and after."""
        keyframe, (track, heading) = chain.keyframe(self.ranges.time), chain.track
        return replace(self, keyframe=keyframe, track=track, time=chain.time, ahead=np.exp(1j * heading[keyframe]))

    def variables(self, poses: Array) -> Sequence[Variables]:
        """Position and bias (x, y, b) [m] of each anchor with ranges; the lag τ [s] of their clock."""
        lag = np.zeros((min(len(self._met), 1), 3))
        return (
            Variables(self.symbol, self._met, self._surveyed, np.full(len(self._met), np.inf)),
            Variables(self.symbol_lag, np.arange(len(lag)), lag, np.full(len(lag), np.inf)),
        )

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """Factors of the ranges, and priors of the anchors from the survey and of the lag."""
        which = np.flatnonzero(self.keyframe >= 0)
        keyframe, m = self.keyframe[which], np.searchsorted(self._met, self.ranges.anchor[which])
        pose, anchor, sigma = at.state.poses[keyframe], at.state[self.symbol][m], self.ranges.sigma[which]
        clock = np.zeros(len(which), dtype=np.intp)
        behind, velocity = self._behind(which, at.state[self.symbol_lag][clock, 0])
        R = rotation(pose[:, 2])
        behind, velocity = np.einsum("nij,nj->ni", R, behind), np.einsum("nij,nj->ni", R, velocity)
        gap = anchor[:, :2] - pose[:, :2] - behind
        distance = np.sqrt(np.sum(gap**2, axis=1) + NEAR_ANCHOR**2)
        value = (distance + anchor[:, 2] - self.ranges.range[which]) / sigma

        def jacobian() -> list[Array]:
            towards = gap / distance[:, None]
            in_body = np.einsum("nji,nj->ni", R, towards)
            turned = -np.sum(towards * (behind @ QUARTER.T), axis=1)
            by_pose = np.column_stack([-in_body, turned]) / sigma[:, None]
            by_anchor = np.column_stack([towards, np.ones(len(pose))]) / sigma[:, None]
            by_lag = np.column_stack([np.sum(towards * velocity, axis=1), *np.zeros((2, len(pose)))]) / sigma[:, None]
            return [by_pose[:, None], by_anchor[:, None], by_lag[:, None]]

        loss = LongErrors(RANGES.detour / sigma) if self.detours else RobustLoss(np.zeros(len(which), dtype=bool))
        variables = [("x", keyframe), (self.symbol, m), (self.symbol_lag, clock)]
        ranges = FactorBlock.uniform(self.name, value[:, None], variables, jacobian, self.number[which], loss=loss)
        place, off = self.ranges.position_sigma[self._met], at.state[self.symbol] - self._surveyed
        widths = np.stack([place, place, np.full(len(place), RANGES.bias)], axis=1)
        anchors = self.symbol, np.arange(len(place))
        lag = at.state[self.symbol_lag]
        clocks, usual = (self.symbol_lag, np.arange(len(lag))), np.full_like(lag, RANGES.lag)
        surveyed = FactorBlock.prior_of(f"{self.name}.anchor", anchors, off, widths, self._met)
        return [ranges, surveyed, FactorBlock.prior_of(f"{self.name}.lag", clocks, lag, usual, clocks[1])]

    def _behind(self, which: Index, late: Array) -> tuple[Array, Array]:
        """Where the walker was ``late (n,)`` [s] before, and the velocity [m/s] there: forward and to the left."""
        place, time, back = self.track, self.time, self.ahead[which].conj()
        now, then = self.ranges.time[which], self.ranges.time[which] - late
        after = np.searchsorted(time, then)
        inside, after = (after > 0) & (after < len(time)), np.clip(after, 1, len(time) - 1)
        velocity = inside * (place[after] - place[after - 1]) / np.maximum(time[after] - time[after - 1], INSTANT)
        moved = np.interp(then, time, place) - np.interp(now, time, place)
        return as_points(moved * back), as_points(velocity * back)

    @cached_property
    def _met(self) -> Index:
        """Indices ``(a,)`` of the anchors with ranges."""
        return np.unique(self.ranges.anchor)

    @property
    def _surveyed(self) -> Array:
        return np.column_stack([self.ranges.position[self._met], np.zeros(len(self._met))])

    def refined(self, at: Evaluation) -> Self:
        """Model detours in the second pass."""
        return self if self.detours else replace(self, detours=True)

    def continued(self, decisions: Mapping[str, AnyArray]) -> Self:
        """Model detours at once, since a live walk starts near its optimum; a detour is weighed anew at every state."""
        return replace(self, detours=True)

    def rough_fixes(self) -> Fixes:
        """A rough position per ROUGH_EVERY: trilaterated with three anchors or more, else at the nearest anchor."""
        bins, rough = np.floor(self.ranges.time / ROUGH_EVERY), list[tuple[float, float, float, float]]()
        for bin_number in np.unique(bins):
            ranges = take(self.ranges, np.flatnonzero(bins == bin_number))
            nearest, anchors = int(np.argmin(ranges.range)), ranges.position[ranges.anchor]
            place, sigma = anchors[nearest], float(ranges.range[nearest]) + ROUGH_SIGMA
            if len(np.unique(ranges.anchor)) >= 3:
                place, sigma = _trilaterated(anchors, ranges), ROUGH_SIGMA
            rough.append((float(ranges.time.mean()), *place.tolist(), sigma))
        time, x, y, sigma = np.array(rough).reshape(-1, 4).T
        return Fixes(time, np.column_stack([x, y]), sigma)

    @property
    def instances(self) -> tuple[Index, Array]:
        """Numbers and times of the ranges."""
        return self.number, self.ranges.time

    def reports(self, at: Evaluation, which: Index | None = None) -> tuple[RangeReport, ...]:
        """Residual, weight and reason of every range."""
        [block] = at.blocks_of(self.name)
        place = {number: n for n, number in enumerate(block.number.tolist())}
        reports = []
        for n in np.arange(len(self.number)) if which is None else which:
            number = int(self.number[n])
            label, sigma = self.ranges.label[self.ranges.anchor[n]], float(self.ranges.sigma[n])
            residual, weight, reason = np.nan, 0.0, "outside the recording: not used"
            if number in place:
                residual, weight = float(block.residual[place[number]]) * sigma, float(block.weight[place[number]])
                long = "longer" if residual < 0 else "shorter"
                detour = ": no line of sight" if weight < REPORTS.accepted and residual < 0 else ""
                reason = f"{abs(residual):.2f} m {long} than from the walk{detour}"
            time, measured = float(self.ranges.time[n]), float(self.ranges.range[n])
            reports.append(RangeReport(time, label, measured, sigma, -residual, weight, reason))
        return tuple(reports)


def _trilaterated(anchors: Array, ranges: Ranges) -> Array:
    """The trilaterated position ``(2,)`` [m], with a robust loss against long ranges. anchors: ``(n, 2)`` of each."""
    from scipy.optimize import least_squares  # here, since few walks have ranges and it takes time to load

    def off(place: Array) -> Array:
        return (np.hypot(*(anchors - place).T) - ranges.range) / ranges.sigma

    return np.asarray(least_squares(off, anchors.mean(axis=0), loss="cauchy").x)
