"""Trajectories in TUM's format, as evo and SLAM programs write them: ``time x y z qx qy qz qw``, no header."""

from __future__ import annotations

import re

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.io.delimited import TextRows
from pdr_graph.types import Array, Trajectory

COLUMNS = 8
NUMBER = r"[-+]?[\d.]+(?:[eE][-+]?\d+)?"
ROW = re.compile(rf"(?:[ \t\r]*(?:#[^\n]*)?\n)*[ \t]*{NUMBER}(?:[ \t]+{NUMBER}){{{COLUMNS - 1}}}[ \t\r]*(?:\n|\Z)")
NO_ROTATION = 1e-9  # largest part of a quaternion that turns about no axis


def is_tum(text: str) -> bool:
    """True if the first line that is no comment has eight numbers between spaces."""
    return ROW.match(text) is not None


def read_tum(where: str, text: str) -> Trajectory:
    """The poses of a text; heading is the rotation about z [rad], NaN if no row has a rotation.

    where: name of the file in messages. Raises InputError naming the line.
    """
    lines = [" ".join(line.split()) for line in text.splitlines()]
    numbers = [n for n, line in enumerate(lines, 1) if line and not line.startswith("#")]
    table = TextRows(where, [lines[n - 1] for n in numbers], numbers, " ").floats(range(COLUMNS), False)
    wrong = np.flatnonzero(~np.isfinite(table).all(axis=1))
    if len(wrong):
        raise InputError(where, f"line {numbers[wrong[0]]}", "a value that is no number", "time x y z qx qy qz qw")
    back = np.flatnonzero(np.diff(table[:, 0]) <= 0)
    if len(back):
        row = int(back[0]) + 1
        found = f"{table[row, 0]:.6f} after {table[row - 1, 0]:.6f}"
        raise InputError(where, f"line {numbers[row]}, time", found, "times that increase from row to row")
    return Trajectory(table[:, 0], table[:, 1:3], _yaw(table[:, 4:]), ("",) * len(table))


def _yaw(quaternion: Array) -> Array:
    """Rotations about z ``(n,)`` [rad] of quaternions x, y, z, w ``(n, 4)``; NaN if none of them rotates."""
    x, y, z, w = quaternion.T
    if np.abs(quaternion[:, :3]).max(initial=0.0) < NO_ROTATION:
        return np.full(len(quaternion), np.nan)
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
