"""Gaussian hypotheses about one walker, and what a measurement makes of them.

A direction that nobody knows, or a compass only roughly, is too wide for one linearisation: as many extended Kalman
filters as there are directions to try stand side by side, and measurements decide between them. What lies beyond a
hypothesis' gate does not move it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.estimation.robust import HUBER_WIDTH, gripping
from pdr_graph.geometry import wrap_angle
from pdr_graph.types import Array, Index

DIRECTIONS = 12
FAR = 1e3  # [m, rad] standard deviation of a position or direction that nobody knows
GATE = 5.0  # [σ] of a measurement, χ² of 25, beyond which it is refused: the graph, too, lets go of fixes there
HOPELESS = 1e-6  # probability at which a hypothesis is given up
EXACT = 1e-3  # [rad] as which a narrow direction is taken when its neighbours' probability is asked for
SAME = 1.0  # [σ] from the best within which another hypothesis says the same


@dataclass(frozen=True)
class Bank:
    """Hypotheses, each an extended Kalman filter.

    mean: ``(h, 6)`` x, y, θ, R_s, R_d, b; covariance: ``(h, 6, 6)``; log_weight: ``(h,)`` log of the probability;
    origin: ``(h,)`` the hypothesis, before any measurement of this moment, that each one was.
    """

    mean: Array
    covariance: Array
    log_weight: Array
    origin: Index

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def best(self) -> int:
        """The most probable hypothesis."""
        return int(np.argmax(self.log_weight))

    def summary(self) -> tuple[Array, Array]:
        """Mean ``(6,)`` of the most probable hypothesis, and the covariance ``(6, 6)`` of all about it."""
        if len(self) == 1:
            return self.mean[0], self.covariance[0]
        apart = _apart(self.mean, self.mean[self.best])
        spread = self.covariance + apart[:, :, None] * apart[:, None, :]
        return self.mean[self.best], np.einsum("h,hij->ij", np.exp(self.log_weight), spread)

    def take(self, rows: Index) -> Bank:
        """Some of the hypotheses, their probabilities made to sum to 1."""
        log_weight = self.log_weight[rows]
        log_weight = log_weight - np.logaddexp.reduce(log_weight)
        return Bank(self.mean[rows], self.covariance[rows], log_weight, self.origin[rows])


@dataclass(frozen=True)
class Surprise:
    """How a measurement met each hypothesis: ``(h,)`` how many sigmas off, and the weight that it was given."""

    sigmas: Array
    weight: Array


def measured(bank: Bank, H: Array, gap: Array, R: Array, share: float = 1.0) -> tuple[Bank, Surprise]:
    """The bank after a measurement, with Huber's weight up to the gate and none beyond.

    H: ``(d, 6)`` how the measurement depends on the state; gap: ``(h, d)`` measured less expected; R: ``(d, d)``;
    share: of its information that others do not say too. What is off for one is judged by R alone.
    A gap beyond the gate counts against a hypothesis as one at the gate: a wild fix decides nothing.
    """
    seen = H @ bank.covariance
    expected = seen @ H.T
    S = expected + R
    sigmas = np.sqrt(np.einsum("hi,hij,hj->h", gap, np.linalg.inv(S), gap))
    weight = np.where(sigmas < GATE, gripping(sigmas, HUBER_WIDTH), 0.0)
    log_weight = bank.log_weight - _cost(sigmas) - 0.5 * np.log(np.linalg.det(S))

    weighted = expected + R / np.where(weight > 0, share * weight, 1.0)[:, None, None]
    K = (weight > 0)[:, None, None] * seen.transpose(0, 2, 1) @ np.linalg.inv(weighted)
    covariance = bank.covariance - K @ seen
    mean = bank.mean + np.einsum("hij,hj->hi", K, gap)
    covariance = (covariance + covariance.transpose(0, 2, 1)) / 2
    return Bank(mean, covariance, log_weight - np.logaddexp.reduce(log_weight), bank.origin), Surprise(sigmas, weight)


def thinned(bank: Bank) -> Bank:
    """Without hypotheses that became hopeless, and with those that say what the best says counted as it."""
    if len(bank) == 1:
        return bank
    pose = _apart(bank.mean, bank.mean[bank.best])[:, :3]
    apart = np.einsum("hi,ij,hj->h", pose, np.linalg.inv(bank.covariance[bank.best, :3, :3]), pose)
    same = apart < SAME**2
    keep = ~same & (bank.log_weight > np.log(HOPELESS))
    keep[bank.best] = True
    log_weight = bank.log_weight.copy()
    log_weight[bank.best] = np.logaddexp.reduce(log_weight[same])
    return replace(bank, log_weight=log_weight).take(np.flatnonzero(keep))


def by_direction(one: Bank) -> Bank:
    """One hypothesis whose direction is not well known, as DIRECTIONS narrow ones around the circle.

    Together they are the Gaussian that it was, with Huber's tails: those far from a direction that a compass told are
    kept, with little probability. The first is in the direction that it had.
    """
    V, width = one.covariance[0, 2, 2], np.pi / DIRECTIONS
    off = np.asarray(wrap_angle(np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)))
    wider, by_heading = max(V - width**2, 0.0), one.covariance[0, 2] / V
    narrow = one.covariance[0] - wider * np.outer(by_heading, by_heading)
    all_round = np.zeros(DIRECTIONS, dtype=np.intp)
    log_weight = -_cost(np.abs(off) / np.sqrt(max(wider, EXACT**2)))
    log_weight -= np.logaddexp.reduce(log_weight)
    return Bank(one.mean + off[:, None] * by_heading, np.tile(narrow, (DIRECTIONS, 1, 1)), log_weight, all_round)


def _cost(sigmas: Array) -> Array:
    """What a gap of so many sigmas has against a hypothesis: Huber's loss up to the gate, no more beyond."""
    return 0.5 * np.minimum(sigmas, HUBER_WIDTH) ** 2 + HUBER_WIDTH * (np.clip(sigmas, HUBER_WIDTH, GATE) - HUBER_WIDTH)


def _apart(mean: Array, other: Array) -> Array:
    """Differences ``(h, 6)`` of states, that of headings wrapped."""
    apart = mean - other
    apart[:, 2] = wrap_angle(apart[:, 2])
    return apart
