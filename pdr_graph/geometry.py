"""Angles, plane geometry and dead reckoning."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from pdr_graph.errors import expect
from pdr_graph.types import MOST_TURNED, Array, Fixes, Index, Steps, Trajectory

ANY_HEADING = np.pi / np.sqrt(3)  # [rad] standard deviation of a direction that nobody knows


def wrap_angle(angle: Array | float) -> Array:
    """An angle in [-π, π). [rad]"""
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


def interpolate(at: Array, time: Array, values: Array) -> Array:
    """Rows ``(m, k)`` at ``at (m,)`` of ``values (n, k)`` at ``time (n,)``: linear between, held beyond the ends."""
    return np.stack([np.interp(at, time, axis) for axis in values.T], axis=1)


def nearest(sorted_times: Array, time: Array) -> Index:
    """Which of the sorted times is nearest to each of ``time (m,)``; the earlier of two that are as near."""
    last = len(sorted_times) - 1
    after = np.clip(np.searchsorted(sorted_times, time), min(1, last), last)
    before = np.maximum(after - 1, 0)
    return np.where(time - sorted_times[before] <= np.abs(sorted_times[after] - time), before, after)


def unit(angle: Array) -> Array:
    """Unit vectors ``(…, 2)`` at the given angles ``(…,)`` [rad] from +x."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def length_along(line: Array) -> Array:
    """Length of a line ``(n, 2)`` up to each of its points ``(n,)``. [m]"""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])


def turn_between(one: Array, other: Array) -> float:
    """The angle from one way ``(2,)`` to another, counter-clockwise. [rad]"""
    return float(np.arctan2(one[0] * other[1] - one[1] * other[0], one @ other))


def rotation(angle: Array | float) -> Array:
    """Rotation matrices ``(…, 2, 2)`` by the given angles ``(…,)`` [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def pose_rotation(heading: Array) -> Array:
    """From a pose's own axes (forward, left, turn) to (x, y, heading): matrices ``(n, 3, 3)``."""
    R = np.zeros((len(heading), 3, 3))
    R[:, :2, :2] = rotation(heading)
    R[:, 2, 2] = 1.0
    return R


def compose(first: Rotation, second: Rotation) -> Rotation:
    """Products of n rotations by n or by one: `Rotation`'s own takes ten times as long on many."""
    a, b = first.as_quat().reshape(-1, 4).T, second.as_quat().reshape(-1, 4).T
    vector = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3], axis=0)
    return Rotation.from_quat(np.vstack([vector, a[3] * b[3] - np.sum(a[:3] * b[:3], axis=0)]).T)


def courses(steps: Steps) -> Array:
    """The direction half-way through each step ``(n,)``, from that at the start. [rad]"""
    before = np.concatenate([[0.0], np.cumsum(steps.turn)[:-1]])
    return before + (steps.turn + steps.pause_turn) / 2


def walked(steps: Steps, time: Array, length: Array | None = None) -> Array:
    """How far the steps have led ``(m,)`` [m] by ``time (m,)``; length: ``(n,)`` of each [m], if not their own."""
    length = steps.length if length is None else length
    return np.interp(time, row_times(steps)[:-1], np.append(0.0, np.cumsum(length)))


def dead_reckon(steps: Steps, start: Fixes | None = None, heading: float = 0.0) -> Trajectory:
    """The track that the steps alone draw: [heading] Sec. 1, p_k = p_{k-1} + L_k (cos θ_k, sin θ_k).

    θ_k is the direction half-way through the step, where the paper takes the step's one heading: in a turn the
    foot follows the chord. The track starts at the first of ``start`` (or the origin), heading ``heading`` [rad].

    Returns ``n + 2`` rows: the start, the end of each step, the end of the recording.
    """
    expect("dead_reckon, steps", steps, Steps, instead="detect_steps(recording)")
    expect("dead_reckon, start", start, Fixes, None, instead="fixes[0]")
    if not abs(heading) <= MOST_TURNED:
        raise ValueError(f"dead_reckon, heading: found {heading}, needed radians")
    theta = heading + np.concatenate([[0.0], np.cumsum(steps.turn)])
    origin = np.zeros(2) if start is None or not len(start) else start.position[0]
    moves = steps.length[:, None] * unit(heading + courses(steps))
    track = origin + np.concatenate([np.zeros((1, 2)), np.cumsum(moves, axis=0)])
    return Trajectory(
        time=row_times(steps),
        position=np.concatenate([track, track[-1:]]),
        heading=wrap_angle(np.append(theta, theta[-1] + steps.final_turn)),
        floor=("",) * (len(steps) + 2),
    )


def row_times(steps: Steps) -> Array:
    """Times ``(n + 2,)`` of a trajectory's rows: the start, the end of each step, the end. [s]"""
    return np.concatenate([[steps.start], steps.time, [steps.end]])


def resample(trajectory: Trajectory, rate: float) -> Trajectory:
    """The trajectory at ``rate`` [Hz] from its first row on, with its last row; position is linear between rows."""
    start, end = trajectory.time[0], trajectory.time[-1]
    time = np.append(start + np.arange(np.ceil((end - start) * rate)) / rate, end)
    after = np.searchsorted(trajectory.time, time)
    floor = tuple(trajectory.floor[i] for i in np.minimum(after, len(trajectory) - 1))

    def between(values: Array) -> Array:
        flat = values.reshape(len(values), -1)
        return interpolate(time, trajectory.time, flat).reshape(-1, *values.shape[1:])

    covariance = None if trajectory.covariance is None else between(trajectory.covariance)
    heading = wrap_angle(between(np.unwrap(trajectory.heading)))
    return Trajectory(time, between(trajectory.position), heading, floor, covariance)
