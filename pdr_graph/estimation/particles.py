"""Where a walk may have gone: a particle filter on the plan.

Walls are local: the optimum next to a wrong aisle is a walk through that aisle. So thousands of walkers are sent off
with the errors that steps really have; walls, fixes and compass weigh them. The ancestors of those that are left are
the ways that the building admits.

As in Woodman & Harle (2008), *Pedestrian localisation for indoor environments*, with the walker's calibration
(R_s, R_d, b) as states, kept various (Liu & West 2001); as many particles as they are spread wide (Fox 2003); fixes
that may be wild, and walls that may be wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdr_graph.estimation.graph import STEPS_PER_SEGMENT, Prior, WalkGraph
from pdr_graph.estimation.particle_steps import RARE, changed_floor, stepped, stood
from pdr_graph.geometry import wrap_angle
from pdr_graph.types import Array, Index

FEWEST, MOST = 1000, 8000  # particles
PER_BIN, BIN, BIN_ANGLE = 20, 1.0, np.pi / 8  # particles for each square [m] and direction [rad] that they occupy
RESAMPLE = 0.5  # of the particles in effect
KERNEL = 0.2  # of their spread, by which copies differ in (R_s, R_d, b)
WIDE = np.array([1.5, 1.5, 2.0])  # times the prior's sigma: what is rare must not be missed
CALM = np.array([0.7, 0.7, 1.0])  # times the sigmas of a step's length, sway and turn, which state what is unknown too

LEAST_SIGMA = 1.0  # [m] of a fix: particles lie no denser
LEAST_SIGMA_DIRECTION = 0.1  # [rad] at the start
FAR, SOUGHT, LOST_PRICE = 4.0, 5, 4.0  # [σ] of a fix from all; one in so many is put there; log-odds of that
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
    ground, pieces = graph.ground, graph.pieces
    assert ground is not None, "asked for with a plan"
    random = np.random.default_rng(seed)
    turn, time = 2 * (pieces.to_end - pieces.to_middle)
    sigma, change = CALM * np.sqrt(pieces.variance), np.array(graph.prior.change)[:, None]

    state = _start(graph, times * MOST, random)
    weight = _seen(graph, 0, state)
    states, origins = [state], [np.arange(len(weight))]
    for interval, (first, last) in enumerate(zip(pieces.first.tolist(), pieces.last.tolist(), strict=True)):
        # Steps, against the walls
        for m in range(first, last + 1):
            if m in ground.changes:
                weight = weight - changed_floor(state, [way.field for way in ground.changes[m]])
            if pieces.length[m] > 0:
                state, price = stepped(state, pieces.length[m], turn[m], time[m], sigma[m], ground.field(m), random)
                weight = weight - price
            else:
                state = stood(state, turn[m], time[m], sigma[m], random)
        steps = np.count_nonzero(pieces.length[first : last + 1])
        state[3:] += np.sqrt(steps / STEPS_PER_SEGMENT) * change * random.standard_normal(state[3:].shape)

        # Fixes and compass, and who goes on
        far = _far_fix(graph, interval + 1, state)
        if far is not None:
            state, weight = _sought(graph, far, state, weight, random)
        weight = weight + _seen(graph, interval + 1, state)
        weight -= np.logaddexp.reduce(weight)
        origin = np.arange(len(weight))
        if np.exp(-np.logaddexp.reduce(2 * weight)) < RESAMPLE * len(weight):
            origin = _resampled(weight, times * _needed(state), random)
            state, weight = state[:, origin], np.full(len(origin), -np.log(len(origin)))
            state[3:] = _varied(state[3:], graph.prior, random)
        states.append(state)
        origins.append(origin)
    return Paths(_ancestors(states, origins), np.exp(weight))


def _start(graph: WalkGraph, n: int, random: np.random.Generator) -> Array:
    """Particles ``(6, n)`` at the walk's start, such that steps lead each to the first fix as it is known."""
    heading, sigma = graph.start.poses[0, 2], max(graph.sigma_direction, LEAST_SIGMA_DIRECTION)
    turned = sigma * random.standard_normal(n)
    anyhow = slice(None) if sigma > np.pi / 2 else slice(None, None, RARE)  # fixes lay a walk as a whole
    turned[anyhow] = 2 * np.pi * np.arange(n)[anyhow] / n
    drawn = random.multivariate_normal(np.zeros(3), graph.prior.covariance * np.outer(WIDE, WIDE), n).T
    c = _calibrated(drawn, graph.prior)
    used = np.flatnonzero(graph.fix_used)
    first = used[np.argmin(graph.fix_keyframe[used])]
    way = graph.track[graph.fix_keyframe[first]] * c[0] * np.exp(1j * turned)
    place = graph.fixes.position[first][:, None] + graph.fix_sigma_together[first] * random.standard_normal((2, n))
    return np.concatenate([place - [way.real, way.imag], [heading + turned], c])


def _seen(graph: WalkGraph, keyframe: int, state: Array) -> Array:
    """Log-likelihood ``(n,)`` of the fixes and headings at a keyframe; a wild one tells nothing."""
    seen = np.zeros(state.shape[1])
    for f in np.flatnonzero(graph.fix_used & (graph.fix_keyframe == keyframe)):
        apart = np.hypot(*(state[:2] - graph.fixes.position[f][:, None])) / max(
            graph.fix_sigma_together[f], LEAST_SIGMA
        )
        seen -= np.minimum(0.5 * apart**2, WILD_PRICE)
    for h in np.flatnonzero(graph.heading_keyframe == keyframe):
        apart = wrap_angle(graph.headings.heading[h] - state[2]) / graph.headings.sigma[h]
        seen -= np.minimum(0.5 * apart**2, WILD_PRICE)
    return seen


def _far_fix(graph: WalkGraph, keyframe: int, state: Array) -> int | None:
    """The fix at a keyframe that lies far from all particles, if any: it is wild, or they are in the wrong place."""
    fixes = np.flatnonzero(graph.fix_used & ~graph.fix_wild & (graph.fix_keyframe == keyframe))
    distance = [np.hypot(*(state[:2] - graph.fixes.position[f][:, None])).min() for f in fixes]
    apart = np.divide(distance, graph.fix_sigma_together[fixes])
    return int(fixes[np.argmax(apart)]) if np.max(apart, initial=0.0) > FAR else None


def _sought(graph: WalkGraph, f: int, state: Array, weight: Array, random: np.random.Generator) -> tuple[Array, Array]:
    """Some of the particles put where fix ``f`` is, at a price: whether they were right, later fixes will say."""
    state, weight, n = state.copy(), weight.copy(), state.shape[1]
    put = np.arange(0, n, SOUGHT)
    place = random.standard_normal((2, len(put))) * max(graph.fix_sigma_together[f], LEAST_SIGMA)
    state[:2, put] = graph.fixes.position[f][:, None] + place
    state[2, put] += random.uniform(-np.pi, np.pi, len(put))
    weight[put] = np.logaddexp.reduce(weight) - np.log(n) - LOST_PRICE
    return state, weight


def _needed(state: Array) -> int:
    """How many particles ``state (6, n)`` is worth: some for each bin of place and direction that they occupy."""
    x, y, angle = np.floor(state[:3] / np.array([BIN, BIN, BIN_ANGLE])[:, None]).astype(np.int64)
    bins = np.unique((x << 40) + (y << 16) + angle)
    return int(np.clip(PER_BIN * len(bins), FEWEST, MOST))


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


def _ancestors(states: list[Array], origins: list[Index]) -> Array:
    """The paths of the last particles, back through every resampling ``(k + 1, 6, n)``."""
    which = np.arange(states[-1].shape[1])
    paths = np.empty((len(states), *states[-1].shape))
    for k in range(len(states) - 1, -1, -1):
        paths[k] = states[k][:, which]
        which = origins[k][which]
    return paths
