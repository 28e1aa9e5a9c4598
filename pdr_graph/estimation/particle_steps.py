"""One step of many particles, and what walls, doors and stairs have against it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pdr_graph.floor.distance import DistanceField
from pdr_graph.floor.regions import OUTSIDE_PRICE, WALL_COST
from pdr_graph.types import Array, Mask

BODY = 0.12  # [m] that the middle of a walker keeps from any wall
LOOK = 0.24  # [m] between two places at which a step is held against the walls: twice BODY, so that none is missed
MOST_LOOKS = 100  # of a step, however far somebody says that it went
DOUBTED, RARE = 0.2, 4  # [rad] of a turn that may be the phone's: for one in four it was any
TRIES = 4  # to take a step otherwise that would go through a wall
CLEAR, CLEAR_PRICE = 0.8, 0.1  # [m] that people keep from walls; log-odds of a step along one
STAIRS_SIGMA = 1.0  # [m] from stairs or a lift, as far as a barometer knows when


def stepped(
    state: Array,
    length: float,
    turn: float,
    time: float,
    sigma: Array,
    field: DistanceField,
    random: np.random.Generator,
    tiles: int | None = None,
) -> tuple[Array, Array]:
    """A step further ``(6, n)``, and what it costs each particle ``(n,)``.

    Who would go through a wall draws their errors again, a few times; that they had to costs them its log-odds.
    state: ``(6, n)`` x, y [m], θ [rad], R_s, R_d, b; sigma: ``(3,)`` of length, sway [m] and turn [rad].
    tiles: of the field that are computed at once, see there.
    """
    count = min(np.ceil(length / LOOK), MOST_LOOKS)
    looks = np.arange(1, count + 1)[:, None] / count

    def tried(state: Array) -> tuple[Array, Mask, Array]:
        after, way = _moved(state, length, turn, time, sigma, random)
        places = looks * way[:, None]
        places += state[:2, None]
        clear = field.about(places, tiles)
        return after, clear.min(axis=0) < BODY, clear[-1]

    after, blocked, clear = tried(state)
    price = CLEAR_PRICE * np.square(np.maximum(0.0, 1 - clear / CLEAR))
    if not blocked.any():
        return after, price
    price[clear < BODY] = OUTSIDE_PRICE
    stopped = np.flatnonzero(blocked)
    stopped = stopped[field.about(state[:2, stopped], tiles) >= BODY]
    if len(stopped):
        others, blocked, _ = tried(np.repeat(state[:, stopped], TRIES, axis=1))
        free = np.logical_not(blocked).reshape(-1, TRIES)
        ways = free.sum(axis=1)
        got = ways > 0
        after[:, stopped[got]] = others[:, (np.arange(len(stopped)) * TRIES + free.argmax(axis=1))[got]]
        price[stopped] = np.where(got, np.log((TRIES + 1) / np.maximum(ways, 1)), WALL_COST)
    return after, price


def stood(state: Array, turn: float, time: float, sigma: Array, random: np.random.Generator) -> Array:
    """A pause further ``(6, n)``: the phone may have turned."""
    return _moved(state, 0.0, turn, time, sigma, random)[0]


def changed_floor(state: Array, ways: Sequence[DistanceField]) -> Array:
    """What it costs each particle ``(n,)`` to come to another floor where it is, by stairs or lifts of these fields."""
    if not ways:
        return np.zeros(state.shape[1])
    outside = -np.max([way.about(state[:2]) for way in ways], axis=0)
    return np.minimum(0.5 * np.square(np.maximum(0.0, outside) / STAIRS_SIGMA), WALL_COST)


def _moved(
    state: Array, length: float, turn: float, time: float, sigma: Array, random: np.random.Generator
) -> tuple[Array, Array]:
    """A piece further ``(6, n)`` with errors as they come, and the way there ``(2, n)`` [m]."""
    noise = random.standard_normal((3, state.shape[1]))
    noise *= sigma[:, None]
    forward, left, turned = noise
    if sigma[2] > DOUBTED:
        turned[::RARE] = random.uniform(-np.pi, np.pi, len(turned[::RARE]))
    turned += state[4] * turn + state[5] * time
    forward += state[3] * length
    course = (state[2] + 0.5 * turned).astype(np.float32)  # to 1e-6 of a turn; six times as fast
    cos, sin = np.cos(course).astype(float), np.sin(course).astype(float)
    way = np.stack([forward * cos - left * sin, forward * sin + left * cos])
    after = state.copy()
    after[:2] += way
    after[2] += turned
    return after, way
