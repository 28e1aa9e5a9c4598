"""Headings: walking directions, measured by a compass or stated by the user."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Self

import gtsam
import numpy as np

from pdr_graph.estimation.factors.base import EXACT, FactorBlock, Hypothesis, Measurement
from pdr_graph.estimation.factors.losses import NOISE, RobustLoss
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.geometry import wrap_angle
from pdr_graph.measurements import take
from pdr_graph.types import Array, Headings, Index, Steps

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.chain import Chain, Evaluation

OFF, SHARE = np.pi / 4, 0.14  # [rad] of a compass that is off throughout; share of such (none of 21 real headings)


@dataclass(frozen=True)
class HeadingReport:
    """How one heading was used.

    heading, sigma [rad]; residual: measured minus estimated heading [rad]; weight: share of its stated information that
    was used, 0-1.
    """

    time: float
    heading: float
    sigma: float
    residual: float
    weight: float
    reason: str


@dataclass(frozen=True, eq=False)
class HeadingFactor(Measurement):
    """Walking directions: r = wrap(θ − z + off) / σ, under Huber's loss. [heading] Sec. 3

    headings: ``h`` of them; number: ``(h,)`` permanent numbers; keyframe: ``(h,)``; off: by which all are assumed to be
    wrong [rad].
    """

    headings: Headings
    number: Index
    keyframe: Index
    off: float = 0.0

    name: ClassVar[str] = "headings"

    @classmethod
    def of(cls, headings: Headings, steps: Steps, prior: Prior, number: Index | None = None) -> HeadingFactor:
        """The headings measured during the recording."""
        inside = np.flatnonzero((headings.time >= steps.start) & (headings.time <= steps.end))
        kept = Headings(headings.time[inside], headings.heading[inside], headings.sigma[inside])
        return cls(kept, inside if number is None else number[inside], np.full(len(kept), -1))

    def keyframe_times(self) -> Array:
        """The times of the headings."""
        return self.headings.time

    def bind(self, chain: Chain) -> Self:
        """Bind every heading to its keyframe."""
        return replace(self, keyframe=chain.keyframe(self.headings.time))

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """One factor for each heading."""
        which = np.flatnonzero(self.keyframe >= 0)
        headings = take(self.headings, which)
        headings = replace(headings, heading=wrap_angle(headings.heading - self.off))
        return [heading_block(self.name, at, self.keyframe[which], headings, self.number[which])]

    def hypotheses(self, at: Evaluation) -> Sequence[Hypothesis]:
        """All headings are off by the same large angle, by iron in the building or near the phone.

        They share most of their error (`gait.compass`).
        """
        if not np.any(self.keyframe >= 0):
            return ()
        return [self._off(angle) for angle in (OFF, -OFF)]

    def _off(self, angle: float) -> Hypothesis:
        """The assumption that all headings are off by ``angle`` [rad]."""
        text = f"the compass is off by about {np.degrees(OFF):.0f}° to the {'left' if angle > 0 else 'right'}"
        check = "magnets and iron near the phone"
        return Hypothesis((replace(self, off=angle),), -float(np.log(SHARE / 2)), self.name, text, check)

    @property
    def instances(self) -> tuple[Index, Array]:
        """Numbers and times [s] of the headings that have a report."""
        which = np.flatnonzero(self.keyframe >= 0)
        return self.number[which], self.headings.time[which]

    def reports(self, at: Evaluation, which: Index | None = None) -> tuple[HeadingReport, ...]:
        """Residual, weight and reason of every heading that has a keyframe."""
        reached, [block] = np.flatnonzero(self.keyframe >= 0), at.blocks_of(self.name)
        which = np.arange(len(reached)) if which is None else which
        heading = at.state.poses[self.keyframe[reached[which]], 2]
        return heading_reports(take(self.headings, reached[which]), heading, block.weight[which])


def heading_reports(headings: Headings, heading: Array, weight: Array) -> tuple[HeadingReport, ...]:
    """Reports of headings, from the walk's heading ``(h,)`` [rad] at their times and their weight ``(h,)``."""
    residual = wrap_angle(headings.heading - heading)
    columns = (headings.time, headings.heading, headings.sigma, residual, weight)
    return tuple(
        HeadingReport(time, measured, sigma, off, share, f"{abs(off) / sigma:.1f} sigma from the walk")
        for time, measured, sigma, off, share in zip(*(column.tolist() for column in columns), strict=True)
    )


def heading_block(name: str, at: Evaluation, keyframe: Index, headings: Headings, number: Index) -> FactorBlock:
    """Factors of headings ``(h,)`` at keyframes ``(h,)``."""
    sigma = headings.sigma
    loss = RobustLoss(np.zeros(len(keyframe), dtype=bool))

    def jacobian() -> list[Array]:
        by = np.zeros((len(keyframe), 1, 3))
        by[:, 0, 2] = 1 / sigma
        return [by]

    def native(n: int) -> gtsam.NonlinearFactor:
        noise = loss.noise(n, NOISE.Isotropic.Sigma(1, sigma[n]))
        direction = gtsam.Pose2(0.0, 0.0, headings.heading[n])
        return gtsam.PoseRotationPrior2D(int(at.state.keys("x", keyframe)[n]), direction, noise)

    value = wrap_angle(at.state.poses[keyframe, 2] - headings.heading) / sigma
    return FactorBlock.uniform(
        name,
        value[:, None],
        [("x", keyframe)],
        jacobian,
        number,
        loss=loss,
        native=native,
        signature=EXACT * (headings.heading + 10 * sigma),
    )
