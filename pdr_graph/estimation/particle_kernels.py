"""The step of `particle_filter` compiled by numba: the same numbers to the last bit, without temporary arrays.

Numba compiles these functions once for a machine and keeps them on disk. Every constant is an argument, since it
compiles again only when this file changes. Cosines are NumPy's, whose last bits differ from those of compiled ones.
Loops are short, so that the compiler takes several particles at once.
"""
# pyright: reportMissingImports=false, reportUntypedFunctionDecorator=false

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pdr_graph.types import Array, Index

WALLS_TYPE = "Tuple((f8[::1], f8, i8[:,::1], i8, i8, i8[::1], f8[::1], i8))"  # of `DistanceField.pixel_table`
ERRORS_TYPE = "f8[:,::1], f4[::1], f4[::1]"  # random errors, cosine and sine of the course
MOTION_TYPE = "UniTuple(f8, 4)"  # `particle_filter.Motion`
COSTS = "UniTuple(f8, 5)"  # `particle_filter.costs`


@njit(f"f4[::1](f8[:,::1], i8[::1], f8[:,::1], {MOTION_TYPE})", cache=True)
def courses(state: Array, origin: Index, errors: Array, motion) -> NDArray[np.float32]:
    """Courses ``(k,)`` [rad] in the middle of a step from ``state[:, origin]`` with errors ``(3, k)``."""
    _, turn, time, _ = motion
    course = np.empty(len(origin), np.float32)
    for k in range(len(origin)):
        i = np.uint64(origin[k])
        course[k] = state[2, i] + 0.5 * (errors[2, k] + (state[4, i] * turn + state[5, i] * time))
    return course


@njit(f"Tuple((f8[::1], f8[::1], b1))(f8[::1], f8[::1], f8[::1], f8[::1], f8, {WALLS_TYPE})", cache=True)
def _clearances(x: Array, y: Array, dx: Array, dy: Array, looks: float, walls):
    """Least distance ``(k,)`` [m] along displacements, that at their ends, and False if a tile is missing."""
    corner, scale, last_pixel, rows, bits, address, pixels, missing = walls
    low_x, low_y, last_x, last_y = corner[0], corner[1], np.float64(last_pixel[0, 0]), np.float64(last_pixel[1, 0])
    least, end, lowest = np.full(len(x), np.inf), np.empty(len(x)), 0
    columns, lines = np.empty(len(x), np.int32), np.empty(len(x), np.int32)
    for look in range(1, int(looks) + 1):
        share = look / looks
        for k in range(len(x)):
            columns[k] = np.int32(min(max((share * dx[k] + x[k] - low_x) * scale, 0.0), last_x))
            lines[k] = np.int32(min(max((share * dy[k] + y[k] - low_y) * scale, 0.0), last_y))
        for k in range(len(x)):
            column, line = np.int64(columns[k]), np.int64(lines[k])
            first = address[np.uint64((column >> bits) * rows + (line >> bits))]
            lowest = min(lowest, first)
            end[k] = pixels[np.uint64(max(first + column + (line << bits), 0))]
        for k in range(len(x)):
            least[k] = min(least[k], end[k])
    return least, end, lowest != missing


@njit(
    f"Tuple((f8[:,::1], f8[::1], i8[::1], b1))(f8[:,::1], {ERRORS_TYPE}, {MOTION_TYPE}, {COSTS}, {WALLS_TYPE})",
    cache=True,
)
def first_try(state: Array, errors: Array, cos: Array, sin: Array, motion, costs, walls):
    """As `particle_filter._first_try`, and False if a tile is missing."""
    (length, turn, time, looks), (body, clear, clear_price, outside_price, _) = motion, costs
    n, after = len(cos), state.copy()
    dx, dy, price, stopped, count = np.empty(n), np.empty(n), np.empty(n), np.empty(n, np.int64), 0
    for i in range(n):
        forward, left, c, s = errors[0, i] + state[3, i] * length, errors[1, i], float(cos[i]), float(sin[i])
        dx[i], dy[i] = forward * c - left * s, forward * s + left * c
        after[0, i] += dx[i]
        after[1, i] += dy[i]
        after[2, i] += errors[2, i] + (state[4, i] * turn + state[5, i] * time)
    least, end, complete = _clearances(state[0], state[1], dx, dy, looks, walls)
    for i in range(n):
        near = max(0.0, 1 - end[i] / clear)
        price[i] = clear_price * (near * near)
        price[i] = outside_price if end[i] < body else price[i]
    for i in range(n):
        stopped[count] = i
        count += np.int64(least[i] < body)
    stopped = stopped[:count]
    still = np.zeros(count)
    begin, _, known = _clearances(state[0][stopped], state[1][stopped], still, still, 1.0, walls)
    return after, price, stopped[begin >= body], complete and known


@njit(
    f"b1(f8[:,::1], i8[::1], {ERRORS_TYPE}, {MOTION_TYPE}, {COSTS}, {WALLS_TYPE}, f8[::1], f8[:,::1], f8[::1])",
    cache=True,
)
def further_tries(
    state: Array, stopped: Index, errors: Array, cos: Array, sin: Array, motion, costs, walls, odds, after, price
):
    """As `particle_filter._further_tries`; False, and nothing written, if a tile is missing."""
    (length, turn, time, looks), body, wall_cost = motion, costs[0], costs[4]
    tries = len(odds) - 1
    origin = np.repeat(stopped, tries)
    forward, left = errors[0] + state[3][origin] * length, errors[1]
    dx, dy = forward * cos - left * sin, forward * sin + left * cos
    least, _, complete = _clearances(state[0][origin], state[1][origin], dx, dy, looks, walls)
    if not complete:
        return False
    for s in range(len(stopped)):
        i, ways = stopped[s], 0
        for k in range(s * tries, (s + 1) * tries):
            if least[k] >= body:
                ways += 1
                if ways == 1:
                    after[0, i], after[1, i] = state[0, i] + dx[k], state[1, i] + dy[k]
                    after[2, i] = state[2, i] + (errors[2, k] + (state[4, i] * turn + state[5, i] * time))
        price[i] = odds[ways] if ways else wall_cost
    return True
