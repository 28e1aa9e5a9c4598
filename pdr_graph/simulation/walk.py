"""A plain simulated walk: somebody follows a route with a phone held before the chest.

Enough to exercise the whole pipeline through its front door. What it leaves out (other ways to hold a phone, sensors
that fail, fixes that lie together) makes it easier than a real walk.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from pdr_graph.geometry import wrap_angle
from pdr_graph.types import Array

RATE = 50.0  # [Hz]
GRAVITY = 9.81  # [m/s²]
SPEED = 1.3  # [m/s]
CADENCE = 1.85  # [steps/s]
CORNER = 0.45  # [s] over which a corner is rounded
PITCH = 0.6  # [rad] by which the phone's top is raised
GYRO_BIAS = np.array([0.003, -0.002, 0.002])  # [rad/s]
GYRO_NOISE, ACCELEROMETER_NOISE = 0.005, 0.08  # [rad/s], [m/s²] per sample
SWAY, WANDER = 0.05, 0.05  # [rad] of the phone about the walking direction: with each stride, and slowly


@dataclass(frozen=True)
class SimulatedWalk:
    """What the phone felt, and the truth.

    time: ``(n,)`` [s]; acceleration, angular_rate: ``(n, 3)`` device axes; position: ``(n, 2)`` [m]; heading: ``(n,)``;
    landings: ``(s,)`` when a foot landed [s].
    """

    time: Array
    acceleration: Array
    angular_rate: Array
    position: Array
    heading: Array
    landings: Array


def walk_along(route: Array, seed: int = 0) -> SimulatedWalk:
    """Somebody walks along ``route (k, 2)`` [m], standing still for two seconds before and after."""
    random = np.random.default_rng(seed)

    # The body: a speed that comes and goes, corners rounded
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(route, axis=0).T))])
    duration = length[-1] / SPEED + 4.0
    time = np.arange(round(duration * RATE)) / RATE
    walking = gaussian_filter1d(((time > 2.0) & (time < duration - 2.0)).astype(float), 0.25 * RATE)
    pace = walking * (1.0 + _slow(random, len(time), 8.0, 0.06))
    way = np.cumsum(pace) / pace.sum() * length[-1]
    position = np.stack([np.interp(way, length, axis) for axis in route.T], axis=1)
    position = gaussian_filter1d(position, CORNER * RATE, axis=0, mode="nearest")
    velocity = np.gradient(position, 1 / RATE, axis=0)
    heading = _heading(velocity, route)

    # The gait: bounce and surge at each step, sway at each stride
    steps = np.cumsum(pace * CADENCE) / RATE
    bounce = 3.2 * pace**2 * (np.cos(2 * np.pi * steps) + 0.25 * np.cos(4 * np.pi * steps + 0.8))
    surge = 1.3 * pace**2 * np.sin(2 * np.pi * steps)
    forward = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    horizontal = np.gradient(velocity, 1 / RATE, axis=0) + surge[:, None] * forward
    world = np.column_stack([horizontal, bounce + GRAVITY])

    # The phone: its y axis forward and raised, swaying and wandering about the walking direction
    yaw = heading + SWAY * pace * np.sin(np.pi * steps) + _slow(random, len(time), 10.0, WANDER)
    R_world_device = Rotation.from_euler("ZX", np.column_stack([yaw - np.pi / 2, np.full(len(yaw), PITCH)]))
    turned = (R_world_device[:-1].inv() * R_world_device[1:]).as_rotvec() * RATE
    return SimulatedWalk(
        time=time,
        acceleration=R_world_device.inv().apply(world) + random.normal(0, ACCELEROMETER_NOISE, (len(time), 3)),
        angular_rate=np.concatenate([turned[:1], turned]) + GYRO_BIAS + random.normal(0, GYRO_NOISE, (len(time), 3)),
        position=position,
        heading=heading,
        landings=np.interp(np.arange(1, steps[-1]), steps, time),
    )


def _heading(velocity: Array, route: Array) -> Array:
    """The direction of motion; of the route's ends where nobody moves. [rad]"""
    moving = np.hypot(*velocity.T) > 0.05
    first, last = np.arctan2(*(route[1] - route[0])[::-1]), np.arctan2(*(route[-1] - route[-2])[::-1])
    index = np.flatnonzero(moving)
    known = np.unwrap(np.arctan2(velocity[index, 1], velocity[index, 0]))
    ends = known[0] + wrap_angle(first - known[0]), known[-1] + wrap_angle(last - known[-1])
    return np.interp(np.arange(len(velocity)), index, known, left=float(ends[0]), right=float(ends[1]))


def _slow(random: np.random.Generator, count: int, seconds: float, sigma: float) -> Array:
    """Smooth noise of standard deviation ``sigma`` that changes over ``seconds``."""
    noise = gaussian_filter1d(random.normal(size=count), seconds * RATE / 2)
    return sigma * noise / noise.std()


def write(walk: SimulatedWalk, folder: Path, epoch: float = 1.7e9, seed: int = 0) -> None:
    """Write ``walk.txt`` (Indoor Location Competition format), ``fixes.csv`` and ``truth.csv`` to ``folder``.

    A fix every ten seconds, off by 1.5 m per axis; the third is wild, 12 m off, as stray fixes are.
    """
    random = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    every = slice(0, None, round(10 * RATE))
    at, sigma = walk.time[every], 1.5
    fixes = walk.position[every] + random.normal(0, sigma, (len(at), 2))
    fixes[2] += (8.5, 8.5)
    rows = [f"{epoch + t:.3f},{x:.3f},{y:.3f},{sigma}" for t, (x, y) in zip(at, fixes, strict=True)]
    (folder / "fixes.csv").write_text("\n".join(["time,x,y,sigma", *rows]) + "\n")
    truth = zip(walk.time[::10], walk.position[::10], walk.heading[::10], strict=True)
    rows = [f"{epoch + t:.3f},{x:.4f},{y:.4f},{wrap_angle(heading):.5f}" for t, (x, y), heading in truth]
    (folder / "truth.csv").write_text("\n".join(["time,x,y,heading", *rows]) + "\n")
    (folder / "walk.txt").write_text("\n".join(_recording_lines(walk, epoch)) + "\n")


def _recording_lines(walk: SimulatedWalk, epoch: float) -> list[str]:
    lines = [f"#\tstartTime:{epoch * 1000:.0f}", "#\tSiteID:simulated\tSiteName:simulated\tFloorName:1"]
    milliseconds = np.round((epoch + walk.time) * 1000).astype(int)
    waypoints = set(range(0, len(walk.time), round(8 * RATE)))
    for n, t in enumerate(milliseconds):
        for kind, (x, y, z) in (("ACCELEROMETER", walk.acceleration[n]), ("GYROSCOPE", walk.angular_rate[n])):
            lines.append(f"{t}\tTYPE_{kind}\t{x:.6f}\t{y:.6f}\t{z:.6f}\t3")
        if n in waypoints:
            lines.append(f"{t}\tTYPE_WAYPOINT\t{walk.position[n, 0]:.4f}\t{walk.position[n, 1]:.4f}")
    return [*lines, f"#\tendTime:{milliseconds[-1]}"]
