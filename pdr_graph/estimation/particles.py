"""Where a walk may have gone: a particle filter on the plan.

Walls are local: the optimum next to a wrong aisle is a walk through that aisle. So thousands of walkers are sent off
with the errors that steps really have, through walls at a price; fixes and compass weigh them. The ancestors of those
that are left are the ways that the building admits.

As in Woodman & Harle (2008), *Pedestrian localisation for indoor environments*, with the walker's calibration
(R_s, R_d, b) as states, kept various (Liu & West 2001); as many particles as they are spread wide (Fox 2003); fixes
that may be wild, and walls that may be wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdr_graph.estimation.graph import STEPS_PER_SEGMENT, Prior, WalkGraph
from pdr_graph.floor.distance import DistanceField
from pdr_graph.geometry import wrap_angle
from pdr_graph.types import Array, Index, Mask

FEWEST, MOST = 1000, 8000  # particles
PER_BIN, BIN, BIN_ANGLE = 20, 1.0, np.pi / 8  # particles for each square [m] and direction [rad] that they occupy
RESAMPLE = 0.5  # of the particles in effect
KERNEL = 0.2  # of their spread, by which copies differ in (R_s, R_d, b)
WIDE = np.array([1.0, 1.5, 2.0])  # times the prior's sigma: what is rare must not be missed
CALM = np.array([0.7, 0.7, 1.0])  # times the sigmas of a step's length, sway and turn, which state what is unknown too

BODY = 0.12  # [m] that the middle of a walker keeps from any wall
LOOK = 0.2  # [m] between two places at which a step is held against the walls
TRIES = 4  # to take a step otherwise that would go through a wall
WALL_PRICE = 12.0  # log-odds of a step through a wall: plans err, and two fixes can be right where they do
WITHIN_PRICE = 0.15  # of a step inside what is solid: a shop that somebody entered
CLEAR, CLEAR_PRICE = 0.8, 0.1  # [m] that people keep from walls; log-odds of a step along one
LEAST_SIGMA = 1.0  # [m] of a fix: particles lie no denser
LEAST_SIGMA_DIRECTION = 0.1  # [rad] at the start
WILD_PRICE = 8.0  # log-odds at which a fix is wild


@dataclass(frozen=True)
class Paths:
    """The ancestors of the last particles.

    state: ``(k + 1, 6, n)`` x, y [m], θ [rad], R_s, R_d, b at each keyframe; weight: ``(n,)``, sum 1.
    """

    state: Array
    weight: Array


def particle_filter(graph: WalkGraph, seed: int = 0, times: int = 1) -> Paths:
    """The walks that plan, fixes and headings admit.

    graph: with walls, and at least one fix that is used. times: as many particles as usual.
    """
    assert graph.floor is not None, "asked for with a plan"
    random = np.random.default_rng(seed)
    field, pieces = graph.floor.distance, graph.pieces
    turn, time = 2 * (pieces.to_end - pieces.to_middle)
    sigma = CALM * np.sqrt(pieces.variance)
    change = np.array(graph.prior.change)[:, None] / np.sqrt(STEPS_PER_SEGMENT)

    state = _start(graph, times * MOST, random)
    weight = _seen(graph, 0, state)
    origin = np.arange(times * MOST)
    states, origins = [state], [origin]
    for m, interval in enumerate(pieces.interval.tolist()):
        if pieces.length[m] > 0:
            state, price = _stepped(state, pieces.length[m], turn[m], time[m], sigma[m], field, random)
            state[3:] += change * random.standard_normal(state[3:].shape)
            weight = weight - price
        else:
            state = _moved(state, 0.0, turn[m], time[m], sigma[m], random)[0]
        if m != pieces.last[interval]:
            continue
        weight = weight + _seen(graph, interval + 1, state)
        weight -= np.logaddexp.reduce(weight)
        if np.exp(-np.logaddexp.reduce(2 * weight)) < RESAMPLE * len(weight):
            drawn = _resampled(weight, times * _needed(state), random)
            state, origin, weight = state[:, drawn], origin[drawn], np.full(len(drawn), -np.log(len(drawn)))
            state[3:] = _varied(state[3:], graph.prior, random)
        states.append(state)
        origins.append(origin)
        origin = np.arange(len(weight))
    return Paths(_ancestors(states, origins), np.exp(weight))


def _start(graph: WalkGraph, n: int, random: np.random.Generator) -> Array:
    """Particles ``(6, n)`` at the walk's start, such that steps lead each to the first fix as it is known."""
    heading, sigma = graph.start.poses[0, 2], max(graph.sigma_direction, LEAST_SIGMA_DIRECTION)
    turned = sigma * random.standard_normal(n) if sigma < np.pi / 2 else 2 * np.pi * np.arange(n) / n
    c = random.multivariate_normal(graph.prior.mean, graph.prior.covariance * np.outer(WIDE, WIDE), n).T
    used = np.flatnonzero(graph.fix_used)
    first = used[np.argmin(graph.fix_keyframe[used])]
    way = graph.track[graph.fix_keyframe[first]] * c[0] * np.exp(1j * turned)
    place = graph.fixes.position[first][:, None] + graph.fix_sigma[first] * random.standard_normal((2, n))
    return np.concatenate([place - [way.real, way.imag], [heading + turned], c])


def _stepped(
    state: Array,
    length: float,
    turn: float,
    time: float,
    sigma: Array,
    field: DistanceField,
    random: np.random.Generator,
) -> tuple[Array, Array]:
    """A step further ``(6, n)``, and what it costs each particle ``(n,)``.

    Who would go through a wall draws their errors again, a few times; that they had to costs them its log-odds.
    """
    looks = np.arange(1, np.ceil(length / LOOK) + 1)[:, None] / np.ceil(length / LOOK)

    def tried(state: Array) -> tuple[Array, Mask, Array]:
        after, dx, dy = _moved(state, length, turn, time, sigma, random)
        clear = field.about(state[0] + looks * dx, state[1] + looks * dy)
        return after, clear.min(axis=0) < BODY, clear[-1]

    after, blocked, clear = tried(state)
    price = np.where(clear < BODY, WITHIN_PRICE, CLEAR_PRICE * np.maximum(0.0, 1 - clear / CLEAR) ** 2)
    stopped = np.flatnonzero(blocked)
    stopped = stopped[field.about(state[0, stopped], state[1, stopped]) >= BODY]
    if len(stopped):
        others, blocked, _ = tried(np.repeat(state[:, stopped], TRIES, axis=1))
        free = np.logical_not(blocked).reshape(-1, TRIES)
        ways = free.sum(axis=1)
        got = ways > 0
        after[:, stopped[got]] = others[:, (np.arange(len(stopped)) * TRIES + free.argmax(axis=1))[got]]
        price[stopped] = np.where(got, np.log((TRIES + 1) / np.maximum(ways, 1)), WALL_PRICE)
    return after, price


def _moved(
    state: Array, length: float, turn: float, time: float, sigma: Array, random: np.random.Generator
) -> tuple[Array, Array, Array]:
    """A piece further ``(6, n)`` with errors as they come, and the way there, along x and y ``(n,)``."""
    x, y, theta, R_s, R_d, b = state
    noise = sigma[:, None] * random.standard_normal((3, len(x)))
    turned = R_d * turn + b * time + noise[2]
    course = theta + 0.5 * turned
    forward, left = R_s * length + noise[0], noise[1]
    cos, sin = np.cos(course), np.sin(course)
    dx, dy = forward * cos - left * sin, forward * sin + left * cos
    return np.stack([x + dx, y + dy, theta + turned, R_s, R_d, b]), dx, dy


def _seen(graph: WalkGraph, keyframe: int, state: Array) -> Array:
    """Log-likelihood ``(n,)`` of the fixes and headings at a keyframe; a wild one tells nothing."""
    seen = np.zeros(state.shape[1])
    for f in np.flatnonzero(graph.fix_used & (graph.fix_keyframe == keyframe)):
        apart = np.hypot(*(state[:2] - graph.fixes.position[f][:, None])) / max(graph.fix_sigma[f], LEAST_SIGMA)
        seen -= np.minimum(0.5 * apart**2, WILD_PRICE)
    for h in np.flatnonzero(graph.heading_keyframe == keyframe):
        apart = wrap_angle(graph.headings.heading[h] - state[2]) / graph.headings.sigma[h]
        seen -= np.minimum(0.5 * apart**2, WILD_PRICE)
    return seen


def _needed(state: Array) -> int:
    """How many particles ``state (6, n)`` is worth: some for each bin of place and direction that they occupy."""
    bins = np.floor(np.stack([state[0] / BIN, state[1] / BIN, state[2] / BIN_ANGLE])).astype(np.int64)
    return int(np.clip(PER_BIN * len(np.unique(bins[0] * 1000003 + bins[1] * 1009 + bins[2])), FEWEST, MOST))


def _resampled(weight: Array, n: int, random: np.random.Generator) -> Index:
    """Systematic resampling: which particles ``(n,)`` go on."""
    share = np.cumsum(np.exp(weight))
    return np.minimum(np.searchsorted(share, share[-1] * (np.arange(n) + random.uniform()) / n), len(weight) - 1)


def _varied(c: Array, prior: Prior, random: np.random.Generator) -> Array:
    """Calibrations ``(3, n)`` somewhat beside what they are, where the prior admits it (a Metropolis move)."""
    root = np.linalg.cholesky(np.cov(c) + 1e-12 * np.eye(3))
    moved = c + KERNEL * root @ random.standard_normal(c.shape)
    information = np.linalg.inv(prior.covariance * np.outer(WIDE, WIDE))
    before, after = (v - np.array(prior.mean)[:, None] for v in (c, moved))
    rise = 0.5 * (np.sum(after * (information @ after), axis=0) - np.sum(before * (information @ before), axis=0))
    return np.where(random.exponential(size=c.shape[1]) > rise, moved, c)


def _ancestors(states: list[Array], origins: list[Index]) -> Array:
    """The paths of the last particles, back through every resampling ``(k + 1, 6, n)``."""
    which = np.arange(states[-1].shape[1])
    paths = np.empty((len(states), *states[-1].shape))
    for k in range(len(states) - 1, -1, -1):
        paths[k] = states[k][:, which]
        which = origins[k][which]
    return paths
