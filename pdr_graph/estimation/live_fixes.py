"""The fixes of a walk under way, and which of them can be of one walk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pdr_graph.estimation.graph import LONGEST_OVERHANG, WALKING_SPEED
from pdr_graph.estimation.optimizer import WILD
from pdr_graph.estimation.reach import ENDS, STRETCHED, WITHIN, chained
from pdr_graph.estimation.reports import reason_of
from pdr_graph.estimation.robust import HUBER_WIDTH, gripping, slipping
from pdr_graph.types import Array, Fixes, FixReport

GRIP, SLIPPING, NONE = "grip", "wild", "none"  # how a fix is believed


@dataclass
class LiveFix:
    """A fix of a walk under way.

    keyframe: its number, -1 before the steps have come so far; walked: until then [m]; believed: it is of the longest
    chain within reach; kind: how it is believed.
    """

    number: int
    time: float
    position: Array
    sigma: float
    floor: str
    source: str
    keyframe: int = -1
    walked: float = 0.0
    believed: bool = True
    kind: str = GRIP

    @property
    def reached(self) -> bool:
        """Whether the steps have come to it."""
        return self.keyframe >= 0

    def hold_at(self, time: float) -> bool:
        """Whether it counts if it must at ``time`` [s]: shortly beside it does, less exactly."""
        beside = abs(time - self.time)
        if beside <= LONGEST_OVERHANG:
            self.time, self.sigma = time, float(np.hypot(self.sigma, WALKING_SPEED * beside))
        return beside <= LONGEST_OVERHANG


def believe(fixes: Sequence[LiveFix]) -> bool:
    """Believe the longest chain of fixes within reach; whether others before its last were believed until now."""
    if not fixes:
        return False
    fixes = sorted(fixes, key=lambda fix: fix.time)
    place, sigma = np.array([fix.position for fix in fixes]), np.array([fix.sigma for fix in fixes])
    way = STRETCHED * np.array([fix.walked for fix in fixes])
    believed = chained(place, WITHIN * sigma, way, np.inf, ENDS)[1].tolist()
    newest = max(n for n, now in enumerate(believed) if now)
    turned = any(fix.believed and not now for fix, now in zip(fixes[:newest], believed, strict=False))
    for fix, now in zip(fixes, believed, strict=True):
        fix.believed = now
        fix.kind = NONE if not now and fix.kind == GRIP else fix.kind
    return turned and sum(believed) > 1


def judged(fixes: Sequence[LiveFix], place: Array) -> list[LiveFix]:
    """Those that are believed otherwise now that the walk is at ``place (f, 2)`` [m] at their time."""
    far = np.hypot(*(place - np.array([fix.position for fix in fixes])).T) > WILD * np.array([f.sigma for f in fixes])
    changed = []
    for fix, is_far in zip(fixes, far.tolist(), strict=True):
        kind = (SLIPPING if fix.believed else NONE) if is_far else GRIP
        if kind != fix.kind:
            fix.kind = kind
            changed.append(fix)
    return changed


def report(fix: LiveFix, place: Array) -> FixReport:
    """Why a fix was trusted or not, where the walk was at ``place (2,)`` [m]."""
    x, y = fix.position.tolist()
    if not fix.reached:
        reason = "outside the recording: not used"
        return FixReport(fix.time, x, y, fix.sigma, float("nan"), 0.0, reason)
    distance, wild = float(np.hypot(*(place - fix.position))), fix.kind == SLIPPING
    sigmas = np.array(distance / fix.sigma)
    weight = 0.0 if fix.kind == NONE else float(slipping(sigmas) if wild else gripping(sigmas, HUBER_WIDTH))
    reason = reason_of(float(sigmas), weight, wild)
    return FixReport(fix.time, x, y, fix.sigma, distance, weight, reason)


def as_fixes(fixes: Sequence[LiveFix]) -> Fixes:
    """As the batch takes them."""
    return Fixes(
        np.array([fix.time for fix in fixes]),
        np.array([fix.position for fix in fixes]).reshape(-1, 2),
        np.array([fix.sigma for fix in fixes]),
        tuple(fix.floor for fix in fixes),
        source=tuple(fix.source for fix in fixes),
    )
