"""Where the phone was taken otherwise in mid-walk: it turned, and the walker did not, or not so far."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdr_graph.gait.forward import at_step_frequency, push
from pdr_graph.geometry import wrap_angle
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.inertial.windows import runs
from pdr_graph.types import Array, Complex

TILTING = 0.25  # [rad/s] of the device's vertical, over a stride: faster than a carried phone tilts
REHELD = 0.5  # [rad] by which the vertical then ends elsewhere in the device: it is held otherwise
FAST, WITHIN = 0.7, 1.0  # [rad] of turn within [s]: a corner, or a wrist
STEPS_BESIDE = 8  # before and after a turn that are asked which way they went
TOLD_APART = 1.1  # [rad] between ahead before and after; on real walks without a re-hold up to 1.0
TURNED = 0.6  # [rad] by gait, during a re-hold; less is taken for straight on
COHERENT = 0.65  # of forward and vertical; less says nothing of whether the phone was turned at all
LESS_COHERENT = 0.45  # nor of how far the walker turned when it was


@dataclass(frozen=True)
class Rehold:
    """first, last: its samples; turn: what the walker turned meanwhile [rad]."""

    first: int
    last: int
    turn: float


Spans = list[tuple[int, int]]  # first and last samples


def reholds(attitude: Attitude, up: Array, heading: Array, step: float) -> list[Rehold]:
    """Every re-hold of a walk.

    up: ``(n, 3)`` the vertical in the device without gait; heading: ``(n,)`` as if there were none [rad].
    """
    return decided(attitude, heading, step, *suspected(up, heading, step, attitude.period))


def suspected(up: Array, heading: Array, step: float, period: float) -> tuple[Spans, Spans]:
    """Where the device came to another tilt, and other turns that a wrist could have made."""
    tilted = _to_another_tilt(up, step, period)
    return tilted, [span for span in _fast_turns(heading, period) if not _meets(span, tilted)]


def decided(attitude: Attitude, heading: Array, step: float, tilted: Spans, fast: Spans) -> list[Rehold]:
    """Which of the suspected were re-holds, and what the walker turned meanwhile, by the steps before and after."""
    if not tilted and not fast:
        return []
    gait = _Gait(*at_step_frequency(attitude, heading, step), round(step / attitude.period))
    found = [Rehold(*span, _of_walker(gait, heading, span)) for span in tilted]
    return found + [Rehold(*span, _of_walker(gait, heading, span)) for span in fast if _in_hand(gait, heading, span)]


@dataclass(frozen=True)
class _Gait:
    """level, vertical: accelerations ``(n,)`` as of `at_step_frequency`; step: in samples."""

    level: Complex
    vertical: Complex
    step: int

    def moved(self, first: int, last: int, steps: int, coherent: float) -> float:
        """By how much ahead came to lie elsewhere in the device, so many steps before and after; NaN if unclear."""
        before, after = slice(max(0, first - steps * self.step), first), slice(last, last + steps * self.step)
        if first < STEPS_BESIDE * self.step or last + STEPS_BESIDE * self.step > len(self.level):
            return np.nan
        ahead = [push(self.level[s], self.vertical[s]) for s in (before, after)]
        if np.min(np.abs(ahead)) < coherent:
            return np.nan
        return float(np.angle(ahead[1] * np.conj(ahead[0])))


def _to_another_tilt(up: Array, step: float, period: float) -> Spans:
    """Where the vertical comes to lie elsewhere in the device."""
    samples = max(1, round(step / period))
    found = []
    for first, after in np.transpose(runs(np.linalg.norm(np.gradient(up, axis=0), axis=1) > TILTING * period)).tolist():
        begin, end = max(0, first - samples), min(len(up) - 1, after - 1 + samples)
        if np.arccos(np.clip(up[begin] @ up[end], -1, 1)) > REHELD:
            found.append((begin, end))
    return found


def _of_walker(gait: _Gait, heading: Array, span: tuple[int, int]) -> float:
    """What the walker turned in a re-hold, by where gait comes from; straight on where it does not say otherwise."""
    turn = float(wrap_angle(heading[span[1]] - heading[span[0]] + gait.moved(*span, 2 * STEPS_BESIDE, LESS_COHERENT)))
    return turn if abs(turn) > TURNED else 0.0


def _fast_turns(heading: Array, period: float) -> Spans:
    """Turns that a wrist could have made."""
    samples = max(1, round(WITHIN / period))
    fast = runs(np.abs(heading[samples:] - heading[:-samples]) > FAST)
    return [(first, after - 1 + samples) for first, after in np.transpose(fast).tolist()]


def _in_hand(gait: _Gait, heading: Array, span: tuple[int, int]) -> bool:
    """True of a turn after which what brakes and drives the walker comes from elsewhere in the device, and from as far
    round as it turned: at a corner gait may be misread, but seldom as just the corner.
    """
    turned, moved = heading[span[1]] - heading[span[0]], gait.moved(*span, STEPS_BESIDE, COHERENT)
    return -moved * np.sign(turned) > TOLD_APART and abs(turned + moved) < TURNED


def _meets(one: tuple[int, int], others: Spans) -> bool:
    return any(one[0] < other[1] and other[0] < one[1] for other in others)
