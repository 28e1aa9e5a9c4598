"""Drifts of the gyroscope about the vertical, measured against the magnetic field over a stretch of the walk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from pdr_graph.estimation.factors.base import FactorBlock, Itemized, RobustLoss
from pdr_graph.estimation.factors.chain import Chain, Evaluation
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.types import KEYFRAME, Array, Drifts, Index, Steps, take


@dataclass(frozen=True)
class DriftReport:
    """How one measured drift was used.

    drift, sigma [rad/s]; residual: measured minus estimated drift [rad/s]; weight: share of its stated information that
    was used, 0-1.
    """

    time: float
    drift: float
    sigma: float
    residual: float
    weight: float
    reason: str


@dataclass(frozen=True, eq=False)
class DriftFactor(Itemized):
    """Drifts of the gyroscope: r = (b_s − z) / σ, under Huber's loss, s the calibration segment of its time.

    A factor also names the keyframe at its time, without a derivative, so that it leaves a window with the keyframe.

    drifts: ``d`` of them; number: ``(d,)`` permanent numbers; keyframe: ``(d,)``.
    """

    drifts: Drifts
    number: Index
    keyframe: Index = field(metadata=KEYFRAME)

    name: ClassVar[str] = "drifts"

    @classmethod
    def of(cls, drifts: Drifts, steps: Steps, prior: Prior, number: Index | None = None) -> Self:
        """The drifts measured during the recording."""
        inside = np.flatnonzero((drifts.time >= steps.start) & (drifts.time <= steps.end))
        return cls(take(drifts, inside), inside if number is None else number[inside], np.full(len(inside), -1))

    @property
    def determines_drift(self) -> bool:
        """True if there are any."""
        return len(self.drifts) > 0

    def keyframe_times(self) -> Array:
        """The times of the drifts."""
        return self.drifts.time

    def bind(self, chain: Chain) -> Self:
        """Bind every drift to its keyframe."""
        return replace(self, keyframe=chain.keyframe(self.drifts.time))

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """One factor for each drift; none of a chain without steps, which has no calibration segment yet."""
        which, segment = self._bound, at.chain.segment
        if not len(segment):
            which, segment = which[:0], np.zeros(1, dtype=np.intp)
        keyframe, sigma = self.keyframe[which], self.drifts.sigma[which]
        segment = segment[np.maximum(keyframe - 1, 0)]

        def jacobian() -> list[Array]:
            by_pose, by_c = np.zeros((2, len(which), 1, 3))
            by_c[:, 0, 2] = 1 / sigma
            return [by_pose, by_c]

        value = (at.state.c[segment, 2] - self.drifts.drift[which]) / sigma
        loss, variables = RobustLoss(np.zeros(len(which), dtype=bool)), [("x", keyframe), ("c", segment)]
        return [FactorBlock.uniform(self.name, value[:, None], variables, jacobian, self.number[which], loss=loss)]

    @property
    def _bound(self) -> Index:
        """The drifts that have a keyframe."""
        return np.flatnonzero(self.keyframe >= 0)

    @property
    def instances(self) -> tuple[Index, Array]:
        """Numbers and times [s] of the drifts that have a report."""
        return self.number[self._bound], self.drifts.time[self._bound]

    def reports(self, at: Evaluation, which: Index | None = None) -> tuple[DriftReport, ...]:
        """Residual, weight and reason of every drift that has a keyframe."""
        [block] = at.blocks_of(self.name)
        which = np.arange(len(block)) if which is None else which
        drifts, off = take(self.drifts, self._bound[which]), -block.residual[which]
        columns = (drifts.time, drifts.drift, drifts.sigma, off * drifts.sigma, block.weight[which], np.abs(off))
        rows = zip(*(column.tolist() for column in columns), strict=True)
        return tuple(
            DriftReport(time, drift, sigma, residual, weight, f"{sigmas:.1f} sigma from the walk")
            for time, drift, sigma, residual, weight, sigmas in rows
        )
