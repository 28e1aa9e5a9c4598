"""Where the phone was taken otherwise in mid-walk: it turned, and the walker did not, or not so far."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from pdr_graph.gait.forward import at_step_frequency, push
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.types import Array, Mask

TILTING = 0.25  # [rad/s] of the device's vertical, over a stride: faster than a carried phone tilts
REHELD = 0.5  # [rad] by which the vertical then ends elsewhere in the device: it is held otherwise
FAST, WITHIN = 0.7, 1.0  # [rad] of turn within [s]: a corner, or a wrist
STEPS_BESIDE = 8  # before and after a turn that are asked which way they went
TOLD_APART = 1.1  # [rad] between ahead before and after; on real walks without a re-hold up to 1.0
COHERENT = 0.65  # of forward and vertical; less says nothing


@dataclass(frozen=True)
class Rehold:
    """first, last: its samples; turn: what the walker turned meanwhile [rad]."""

    first: int
    last: int
    turn: float


def reholds(attitude: Attitude, steady: Rotation, heading: Array, step: float) -> list[Rehold]:
    """Every re-hold of a walk. steady: the attitude without gait; heading: ``(n,)`` as if there were none [rad]."""
    tilted = _to_another_tilt(steady, step, attitude.period)
    return tilted + [r for r in _about_the_vertical(attitude, heading, step) if not _meets(r, tilted)]


def _to_another_tilt(steady: Rotation, step: float, period: float) -> list[Rehold]:
    """The vertical comes to lie elsewhere in the device; the walker is supposed to have gone straight on."""
    samples = max(1, round(step / period))
    up = steady.inv().apply([0.0, 0.0, 1.0])
    found = []
    for first, after in _runs(np.linalg.norm(np.gradient(up, axis=0), axis=1) > TILTING * period):
        begin, end = max(0, first - samples), min(len(up) - 1, after - 1 + samples)
        if np.arccos(np.clip(up[begin] @ up[end], -1, 1)) > REHELD:
            found.append(Rehold(begin, end, 0.0))
    return found


def _about_the_vertical(attitude: Attitude, heading: Array, step: float) -> list[Rehold]:
    """A fast turn after which what brakes and drives the walker comes from elsewhere in the device.

    By as much as that did, it was the phone that was turned; the rest is the walker's.
    """
    samples, beside = max(1, round(WITHIN / attitude.period)), round(STEPS_BESIDE * step / attitude.period)
    turned = np.abs(heading[samples:] - heading[:-samples]) > FAST
    if not turned.any():
        return []
    level, vertical = at_step_frequency(attitude, heading, step)
    found = []
    for first, after in _runs(turned):
        last = after - 1 + samples
        if first < beside or last + beside > len(heading):
            continue
        ahead = [push(level[s], vertical[s]) for s in (slice(first - beside, first), slice(last, last + beside))]
        turn, in_hand = float(heading[last] - heading[first]), -float(np.angle(ahead[1] * np.conj(ahead[0])))
        if np.min(np.abs(ahead)) > COHERENT and in_hand * np.sign(turn) > TOLD_APART:
            found.append(Rehold(first, last, turn - in_hand))
    return found


def _meets(one: Rehold, others: list[Rehold]) -> bool:
    return any(one.first < other.last and other.first < one.last for other in others)


def _runs(mask: Mask) -> zip[tuple[int, int]]:
    """First sample and the one after the last of each run of True."""
    edges = np.diff(mask.astype(int), prepend=0, append=0)
    return zip(np.flatnonzero(edges > 0).tolist(), np.flatnonzero(edges < 0).tolist(), strict=True)
