"""A step of particles between walls: where they go, and its cost.

A particle that would cross a wall draws its errors again. NumPy's functions say what a step is; those that numba has
compiled (`particle_kernels`, extra ``fast``) take their place when many particles have moved, and return the same bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from types import ModuleType
from typing import NamedTuple

import numpy as np

from pdr_graph.floor.distance_field import DistanceField
from pdr_graph.priors import PARTICLES, REGIONS, WALLS
from pdr_graph.types import Array, Index

MOST_LOOKS = 100  # points of a step, however long
LOAD_AFTER = 2_500_000  # particles moved by NumPy, at 0.25 µs more each, after which loading numba would have paid

Motion = tuple[float, float, float, float]  # of a step: length [m], turn [rad], time [s], points tested against walls


class Walls(NamedTuple):
    """The walls of a floor; at_once, tiles: see `DistanceField.approximate`."""

    field: DistanceField
    at_once: int | None = None
    tiles: Index | None = None

    def distance(self, places: Array) -> Array:
        """Distance ``(…)`` [m] of places ``(2, …)`` from the nearest wall."""
        return self.field.approximate(places, self.at_once, self.tiles)


class Compiled:
    """The compiled functions, from when loading them would have paid: most walks are too short for them."""

    def __init__(self) -> None:
        self.functions: ModuleType | None = None
        self.moved = 0  # particles by NumPy, in this process

    def for_particles(self, count: int, may_load: bool) -> ModuleType | None:
        """The compiled functions to move ``count`` particles, None for NumPy's; may_load: if it is time to."""
        if self.moved < LOAD_AFTER:
            self.moved += count
            if may_load and self.moved >= LOAD_AFTER:
                self.load()
        return self.functions

    def load(self) -> None:
        """Load the functions, in 0.4 s, or 4 s where numba never compiled them.

        NumPy's remain without numba, or where it has no folder for what it compiles.
        """
        self.moved = LOAD_AFTER
        with suppress(Exception):  # numba raises what it likes, and is not needed
            from pdr_graph.estimation import particle_kernels

            self.functions = particle_kernels


COMPILED = Compiled()


def costs() -> tuple[float, ...]:
    """The numbers that the compiled functions take: body [m], margin [m], and three prices [log-odds]."""
    return WALLS.body, WALLS.margin, PARTICLES.clear_price, REGIONS.outside_price, REGIONS.wall_cost


def stepped(
    state: Array, length: float, turn: float, time: float, sigma: Array, walls: Walls, random: np.random.Generator
) -> tuple[Array, Array]:
    """States ``(6, n)`` after a step, and its cost ``(n,)`` for each particle.

    A particle that would cross a wall draws its errors again, up to PARTICLES.tries times, at the cost of the log-odds.
    state: ``(6, n)`` x, y [m], θ [rad], R_s, R_d, b; sigma: ``(3,)`` of length, sway [m] and turn [rad].
    """
    state = np.ascontiguousarray(state)
    motion = length, float(turn), float(time), float(min(np.ceil(length / (2 * WALLS.body)), MOST_LOOKS))
    kernels = COMPILED.for_particles(state.shape[1], may_load=walls.at_once is None)
    errors = _errors(state.shape[1], sigma, random)
    after, price, stopped = (kernels and _first_compiled(kernels, state, errors, motion, walls)) or _first_try(
        state, errors, motion, walls
    )
    if len(stopped):
        errors = _errors(PARTICLES.tries * len(stopped), sigma, random)
        further = state, stopped, errors, motion, walls, after, price
        if not (kernels and _further_compiled(kernels, *further)):
            _further_tries(*further)
    return after, price


def stood(state: Array, turn: float, time: float, sigma: Array, random: np.random.Generator) -> Array:
    """States ``(6, n)`` after a pause, in which the phone may have turned."""
    return _moved(state, _errors(state.shape[1], sigma, random), (0.0, turn, time, 0.0))[0]


def changed_floor(state: Array, ways: Sequence[DistanceField]) -> Array:
    """Cost ``(n,)`` of a change of floor at each particle's place, by stairs or lifts with these fields."""
    if not ways:
        return np.zeros(state.shape[1])
    outside = -np.max([way.approximate(state[:2]) for way in ways], axis=0)
    return np.minimum(0.5 * np.square(np.maximum(0.0, outside) / PARTICLES.stairs_sigma), REGIONS.wall_cost)


def _errors(count: int, sigma: Array, random: np.random.Generator) -> Array:
    """Random errors ``(3, count)`` of length, sway [m] and turn [rad]; of some any turn, if it may be the phone's."""
    errors = random.standard_normal((3, count))
    errors *= sigma[:, None]
    if sigma[2] > PARTICLES.doubted:
        any_turn = errors[2, :: PARTICLES.rare]
        any_turn[:] = random.uniform(-np.pi, np.pi, len(any_turn))
    return errors


def _first_try(state: Array, errors: Array, motion: Motion, walls: Walls) -> tuple[Array, Array, Index]:
    """States ``(6, n)`` after a step, its cost ``(n,)``, and which particles a wall stopped that were not in one."""
    after, way = _moved(state, errors, motion)
    clear = _clearances(state, way, motion, walls)
    price = PARTICLES.clear_price * np.square(np.maximum(0.0, 1 - clear[-1] / WALLS.margin))
    price[clear[-1] < WALLS.body] = REGIONS.outside_price
    stopped = np.flatnonzero(clear.min(axis=0) < WALLS.body)
    if len(stopped):
        stopped = stopped[walls.distance(state[:2, stopped]) >= WALLS.body]
    return after, price, stopped


def _further_tries(
    state: Array, stopped: Index, errors: Array, motion: Motion, walls: Walls, after: Array, price: Array
) -> None:
    """Replace ``after`` and ``price`` of stopped particles by the first of PARTICLES.tries further steps that is
    free.
    """
    before = np.repeat(state[:, stopped], PARTICLES.tries, axis=1)
    others, way = _moved(before, errors, motion)
    free = (_clearances(before, way, motion, walls).min(axis=0) >= WALLS.body).reshape(-1, PARTICLES.tries)
    ways = free.sum(axis=1)
    got = ways > 0
    after[:, stopped[got]] = others[:, (np.arange(len(stopped)) * PARTICLES.tries + free.argmax(axis=1))[got]]
    price[stopped] = np.where(got, PARTICLES.odds[ways], REGIONS.wall_cost)


def _moved(state: Array, errors: Array, motion: Motion) -> tuple[Array, Array]:
    """States ``(6, n)`` after a piece with errors ``(3, n)``, and the displacement ``(2, n)`` [m]."""
    length, turn, time, _ = motion
    forward, left = errors[0] + state[3] * length, errors[1]
    turned = errors[2] + (state[4] * turn + state[5] * time)
    course = (state[2] + 0.5 * turned).astype(np.float32)  # to 1e-6 of a turn; six times as fast
    cos, sin = np.cos(course).astype(float), np.sin(course).astype(float)
    way = np.stack([forward * cos - left * sin, forward * sin + left * cos])
    after = state.copy()
    after[:2] += way
    after[2] += turned
    return after, way


def _clearances(state: Array, way: Array, motion: Motion, walls: Walls) -> Array:
    """Distance ``(looks, n)`` [m] from the walls along displacements ``way (2, n)`` [m]."""
    looks = motion[-1]
    places = (np.arange(1, looks + 1)[:, None] / looks) * way[:, None]
    places += state[:2, None]
    return walls.distance(places)


def _first_compiled(
    kernels: ModuleType, state: Array, errors: Array, motion: Motion, walls: Walls
) -> tuple[Array, Array, Index] | None:
    """As `_first_try`; None where tiles of the distance field are missing, which only that computes."""
    course = kernels.courses(state, np.arange(state.shape[1]), errors, motion)
    table = walls.field.pixel_table(walls.tiles)
    after, price, stopped, complete = kernels.first_try(
        state, errors, np.cos(course), np.sin(course), motion, costs(), table
    )
    return (after, price, stopped) if complete else None


def _further_compiled(
    kernels: ModuleType,
    state: Array,
    stopped: Index,
    errors: Array,
    motion: Motion,
    walls: Walls,
    after: Array,
    price: Array,
) -> bool:
    """As `_further_tries`; False where tiles of the distance field are missing."""
    course = kernels.courses(state, np.repeat(stopped, PARTICLES.tries), errors, motion)
    cos, sin, table = np.cos(course), np.sin(course), walls.field.pixel_table(walls.tiles)
    return kernels.further_tries(state, stopped, errors, cos, sin, motion, costs(), table, PARTICLES.odds, after, price)
