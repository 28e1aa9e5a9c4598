"""A cloud of walkers on the plan, sent off with the errors that steps really have, keyframe by keyframe.

As in Woodman & Harle (2008), *Pedestrian localisation for indoor environments*, with the walker's calibration
(R_s, R_d, b) as states, kept various (Liu & West 2001); as many particles as they are spread wide (Fox 2003); fixes
that may be wild, and walls that may be wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pdr_graph.estimation.graph import STEPS_PER_SEGMENT, Prior
from pdr_graph.estimation.particle_steps import RARE, changed_floor, stepped, stood
from pdr_graph.estimation.preintegration import Pieces
from pdr_graph.floor.distance import DistanceField
from pdr_graph.geometry import wrap_angle
from pdr_graph.types import Array, Index, Mask

PER_BIN, BIN, BIN_ANGLE = 20, 1.0, np.pi / 8  # particles for each square [m] and direction [rad] that they occupy
AMONG = 8000  # particles at most, of which so many are in a bin: fewer at most, fewer in each
RESAMPLE = 0.5  # of the particles in effect
KERNEL = 0.2  # of their spread, by which copies differ in (R_s, R_d, b)
WIDE = np.array([1.5, 1.5, 2.0])  # times the prior's sigma: what is rare must not be missed
CALM = np.array([0.7, 0.7, 1.0])  # times the sigmas of a step's length, sway and turn, which state what is unknown too
LEAST_STRIDE = 0.1  # R_s of who seems not to get on: its logarithm is asked for

LEAST_SIGMA = 1.0  # [m] of a fix: particles lie no denser
LEAST_SIGMA_DIRECTION = 0.1  # [rad] at the start
FAR, SOUGHT, LOST_PRICE = 4.0, 5, 4.0  # [σ] of a fix from all; one in so many is put there; log-odds of that
WILD_PRICE = 8.0  # log-odds at which a fix is wild


@dataclass(frozen=True)
class Seen:
    """What was measured at a keyframe.

    position: of fixes ``(f, 2)`` [m]; sigma: ``(f,)`` of each per axis [m]; wild: ``(f,)`` which are known to be;
    heading, sigma_heading: ``(h,)`` walking directions [rad].
    """

    position: Array = field(default_factory=lambda: np.empty((0, 2)))
    sigma: Array = field(default_factory=lambda: np.empty(0))
    wild: Mask = field(default_factory=lambda: np.empty(0, dtype=bool))
    heading: Array = field(default_factory=lambda: np.empty(0))
    sigma_heading: Array = field(default_factory=lambda: np.empty(0))


NOTHING = Seen()


@dataclass(frozen=True)
class Paths:
    """The ancestors of the last particles.

    state: ``(k + 1, 6, n)`` x, y [m], θ [rad], R_s, R_d, b at each keyframe; weight: ``(n,)``, sum 1.
    """

    state: Array
    weight: Array


class Cloud:
    """Particles ``(6, n)`` x, y [m], θ [rad], R_s, R_d, b, and their ancestors at the keyframes that are kept.

    prior: of (R_s, R_d, b); fewest, most: particles, as many as needed between; tiles: of distances to walls that are
    computed at once, by default all that are missing: a walk under way cannot wait for them.
    """

    def __init__(self, prior: Prior, seed: int, *, fewest: int, most: int, tiles: int | None = None):
        self.prior, self.fewest, self.most, self.tiles = prior, fewest, most, tiles
        self.random = np.random.default_rng(seed)
        self.state, self.weight = np.empty((6, 0)), np.empty(0)  # weight: its logarithm ``(n,)``
        self._change = np.array(prior.change)[:, None]
        self._steps = 0  # since the last keyframe
        self._states, self._origins = list[Array](), list[Index]()

    def begin(
        self, place: Array, sigma: float, heading: float, sigma_heading: float, way: complex = 0j, seen: Seen = NOTHING
    ) -> None:
        """The first keyframe: particles such that steps lead each to a place as it is known.

        place: ``(2,)`` ± sigma [m]; heading: at the keyframe, ± sigma_heading [rad]; way: from the keyframe to the
        place as steps have it, turned to that heading [m]; seen: at the keyframe.
        """
        n, random = self.most, self.random
        spread = max(sigma_heading, LEAST_SIGMA_DIRECTION)
        turned = spread * random.standard_normal(n)
        anyhow = slice(None) if spread > np.pi / 2 else slice(None, None, RARE)  # fixes lay a walk as a whole
        turned[anyhow] = 2 * np.pi * np.arange(n)[anyhow] / n
        drawn = random.multivariate_normal(np.zeros(3), self.prior.covariance * np.outer(WIDE, WIDE), n).T
        c = _calibrated(drawn, self.prior)
        led = way * c[0] * np.exp(1j * turned)
        start = place[:, None] + sigma * random.standard_normal((2, n)) - [led.real, led.imag]
        self.begin_at(np.concatenate([start, [heading + turned], c]))
        self.weight = _likelihood(seen, self.state)

    def begin_at(self, state: Array) -> None:
        """The first keyframe, with particles ``(6, n)`` where they are known to be."""
        n = state.shape[1]
        self.state, self.weight, self._steps = state, np.full(n, -np.log(n)), 0
        self._states, self._origins = [state], [np.arange(n)]

    def advance(
        self,
        pieces: Pieces,
        fields: Sequence[DistanceField],
        ways: Mapping[int, Sequence[DistanceField]] | None = None,
        seen: Seen = NOTHING,
    ) -> None:
        """To the next keyframe, through an interval of ``pieces``.

        fields: of each piece's floor; ways: the stairs and lifts that lead to the floor of a piece from that of the
        one before, where it is another; seen: at the keyframe.
        """
        turn, time = 2 * (pieces.to_end - pieces.to_middle)
        for m, floor in enumerate(fields):
            if ways and m in ways:
                self.change_floor(ways[m])
            self.step(float(pieces.length[m]), turn[m], time[m], pieces.variance[m], floor)
        self.close(seen)

    def change_floor(self, ways: Sequence[DistanceField]) -> None:
        """To another floor, by stairs or lifts of these fields."""
        self.weight = self.weight - changed_floor(self.state, ways)

    def step(self, length: float, turn: float, time: float, variance: Array, floor: DistanceField) -> None:
        """A piece further [m, rad, s], against the walls of a floor. variance: ``(3,)`` as of ``Pieces``."""
        sigma = CALM * np.sqrt(variance)
        if length > 0:
            self.state, price = stepped(self.state, length, turn, time, sigma, floor, self.random, self.tiles)
            self.weight = self.weight - price
            self._steps += 1
        else:
            self.state = stood(self.state, turn, time, sigma, self.random)

    def close(self, seen: Seen = NOTHING) -> None:
        """A keyframe here: fixes and compass, and who goes on."""
        state, random = self.state, self.random
        state[3:] += np.sqrt(self._steps / STEPS_PER_SEGMENT) * self._change * random.standard_normal(state[3:].shape)
        np.maximum(state[3], LEAST_STRIDE, out=state[3])
        far = _far_fix(seen, state)
        if far is not None:
            self._seek(seen, far)
        weight = self.weight + _likelihood(seen, self.state)
        weight -= np.logaddexp.reduce(weight)
        origin = np.arange(len(weight))
        if np.exp(-np.logaddexp.reduce(2 * weight)) < RESAMPLE * len(weight):
            origin = _resampled(weight, self._needed(), random)
            self.state, weight = self.state[:, origin], np.full(len(origin), -np.log(len(origin)))
            self.state[3:] = _varied(self.state[3:], self.prior, random)
        self.weight, self._steps = weight, 0
        self._states.append(self.state)
        self._origins.append(origin)

    def paths(self) -> Paths:
        """The ancestors of the last keyframe's particles, at all keyframes that are kept."""
        which = np.arange(len(self.weight))
        paths = np.empty((len(self._states), 6, len(which)))
        for k in range(len(paths) - 1, -1, -1):
            self._states[k].take(which, axis=1, out=paths[k], mode="clip")
            which = self._origins[k].take(which)
        return Paths(paths, np.exp(self.weight))

    def forget(self, count: int) -> None:
        """Let go of the first ``count`` keyframes that are kept, not of the last."""
        del self._states[:count], self._origins[:count]

    def _seek(self, seen: Seen, f: int) -> None:
        """Some of the particles put where fix ``f`` is, at a price: whether they were right, later fixes will say."""
        state, weight, n = self.state.copy(), self.weight.copy(), self.state.shape[1]
        put = np.arange(0, n, SOUGHT)
        place = self.random.standard_normal((2, len(put))) * max(seen.sigma[f], LEAST_SIGMA)
        state[:2, put] = seen.position[f][:, None] + place
        state[2, put] += self.random.uniform(-np.pi, np.pi, len(put))
        weight[put] = np.logaddexp.reduce(weight) - np.log(n) - LOST_PRICE
        self.state, self.weight = state, weight

    def _needed(self) -> int:
        """How many particles these are worth: some for each bin of place and direction that they occupy."""
        x, y, angle = np.floor(self.state[:3] / np.array([BIN, BIN, BIN_ANGLE])[:, None]).astype(np.int64)
        bins = np.unique((x << 40) + (y << 16) + angle)
        return int(np.clip(PER_BIN * self.most / AMONG * len(bins), self.fewest, self.most))


def _likelihood(seen: Seen, state: Array) -> Array:
    """Its logarithm ``(n,)`` of what was seen; what is wild tells nothing."""
    total = np.zeros(state.shape[1])
    for position, sigma in zip(seen.position, seen.sigma, strict=True):
        apart = np.hypot(*(state[:2] - position[:, None])) / max(sigma, LEAST_SIGMA)
        total -= np.minimum(0.5 * apart**2, WILD_PRICE)
    for heading, sigma in zip(seen.heading, seen.sigma_heading, strict=True):
        apart = wrap_angle(heading - state[2]) / sigma
        total -= np.minimum(0.5 * apart**2, WILD_PRICE)
    return total


def _far_fix(seen: Seen, state: Array) -> int | None:
    """The fix that lies far from all particles, if any: it is wild, or they are in the wrong place."""
    fixes = np.flatnonzero(~seen.wild)
    distance = [np.hypot(*(state[:2] - seen.position[f][:, None])).min() for f in fixes]
    apart = np.divide(distance, seen.sigma[fixes])
    return int(fixes[np.argmax(apart)]) if np.max(apart, initial=0.0) > FAR else None


def _resampled(weight: Array, n: int, random: np.random.Generator) -> Index:
    """Systematic resampling: which particles ``(n,)`` go on."""
    share = np.cumsum(np.exp(weight))
    return np.minimum(np.searchsorted(share, share[-1] * (np.arange(n) + random.uniform()) / n), len(weight) - 1)


def _varied(c: Array, prior: Prior, random: np.random.Generator) -> Array:
    """Calibrations ``(3, n)`` somewhat beside what they are, where the prior admits it (a Metropolis move)."""
    before = _errors(c, prior)
    root = np.linalg.cholesky(np.cov(before) + 1e-12 * np.eye(3))
    after = before + KERNEL * root @ random.standard_normal(c.shape)
    information = np.linalg.inv(prior.covariance * np.outer(WIDE, WIDE))
    rise = 0.5 * (np.sum(after * (information @ after), axis=0) - np.sum(before * (information @ before), axis=0))
    return np.where(random.exponential(size=c.shape[1]) > rise, _calibrated(after, prior), c)


def _calibrated(errors: Array, prior: Prior) -> Array:
    """(R_s, R_d, b) ``(3, n)`` of errors about the prior's mean: R_s by its logarithm, or walls would favour walkers
    who hardly move.
    """
    stride, turn, drift = prior.mean
    return np.stack([stride * np.exp(errors[0]), turn + errors[1], drift + errors[2]])


def _errors(c: Array, prior: Prior) -> Array:
    """The inverse of `_calibrated`."""
    stride, turn, drift = prior.mean
    return np.stack([np.log(c[0] / stride), c[1] - turn, c[2] - drift])
