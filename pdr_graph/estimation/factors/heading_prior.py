"""Headings: walking directions, measured by a compass or stated by the user."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from pdr_graph.estimation.ambiguity.hypothesis import Hypothesis, Proposal, Wording, wording_of
from pdr_graph.estimation.factors.base import (
    AnyArray,
    Doubted,
    FactorBlock,
    Itemized,
    Remembered,
    RobustLoss,
    WeighsPoses,
)
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.geometry import ANY_HEADING, wrap_angle
from pdr_graph.priors import COMPASS, PARTICLES, PRICES
from pdr_graph.types import KEYFRAME, START, Array, Headings, Index, Steps, take

if TYPE_CHECKING:
    import gtsam

    from pdr_graph.estimation.factors.chain import Chain, Evaluation


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
class HeadingFactor(Itemized, Remembered, Doubted, WeighsPoses):
    """Walking directions: r = wrap(θ − z + off) / σ, under Huber's loss. [heading] Sec. 3

    headings: ``h`` of them; number: ``(h,)`` permanent numbers; keyframe: ``(h,)``; off: by which those of the compass
    are assumed to be wrong [rad]; wrong_start: the start heading is assumed to be wrong.
    """

    headings: Headings
    number: Index
    keyframe: Index = field(metadata=KEYFRAME)
    off: float = 0.0
    wrong_start: bool = False

    name: ClassVar[str] = "headings"

    @classmethod
    def of(cls, headings: Headings, steps: Steps, prior: Prior, number: Index | None = None) -> HeadingFactor:
        """The headings measured during the recording."""
        inside = np.flatnonzero((headings.time >= steps.start) & (headings.time <= steps.end))
        return cls(take(headings, inside), inside if number is None else number[inside], np.full(len(inside), -1))

    def keyframe_times(self) -> Array:
        """The times of the headings."""
        return self.headings.time

    def bind(self, chain: Chain) -> Self:
        """Bind every heading to its keyframe."""
        return replace(self, keyframe=chain.keyframe(self.headings.time))

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """One factor for each heading."""
        return [heading_block(self.name, at, *self._bound)]

    @cached_property
    def _bound(self) -> tuple[Index, Headings, Index]:
        """Keyframes ``(h,)`` of the headings that have one, what is assumed of these headings, and their numbers."""
        which = np.flatnonzero(self.keyframe >= 0)
        headings = take(self.headings, which)
        started = headings.stated
        heading = wrap_angle(headings.heading - np.where(started, 0.0, self.off))
        sigma = np.where(started & self.wrong_start, ANY_HEADING, headings.sigma)
        return self.keyframe[which], replace(headings, heading=heading, sigma=sigma), self.number[which]

    def pose_costs(self, keyframe: int) -> HeadingCosts | None:
        """The headings at a keyframe."""
        here = self.keyframe == keyframe
        return HeadingCosts(self.headings.heading[here], self.headings.sigma[here]) if here.any() else None

    def hypotheses(self, at: Evaluation, by_others: Callable[[], Evaluation] | None) -> Sequence[Proposal]:
        """All compass headings are off by a large angle, by iron; the start heading is wrong.

        Compass headings share most of their error (`gait.compass`).
        """
        started, bound, found = self.headings.stated, self.keyframe >= 0, list[Proposal]()
        if np.any(bound & ~started):
            for side, angle in (("left", COMPASS.off), ("right", -COMPASS.off)):
                kind = (self.name, f"off to the {side}")
                off = Hypothesis(kind, parameter=(COMPASS.off,), price=PRICES.compass_off)
                found.append(Proposal(off, (replace(self, off=angle),)))
        if not np.any(bound & started):
            return found
        price = PRICES.wrong_start + float(np.log(ANY_HEADING / self.headings.sigma[started][0]))  # with its normaliser
        without = Proposal(Hypothesis((self.name, "wrong start"), price=price), (replace(self, wrong_start=True),))
        found.append(without)
        apart = [replace(proposal, start=by_others().state) for proposal in found] if by_others else []
        return [*found, *apart]

    def decisions(self) -> dict[str, AnyArray]:
        """Whether the start heading is wrong, if there is one."""
        return {"wrong_start": np.array([self.wrong_start])} if self.headings.stated.any() else {}

    def continued(self, decisions: Mapping[str, AnyArray]) -> Self:
        """Take over whether the start heading is wrong."""
        return replace(self, wrong_start=bool(decisions["wrong_start"][0])) if "wrong_start" in decisions else self

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


@dataclass(frozen=True)
class HeadingCosts:
    """Costs of poses by walking directions. heading, sigma: ``(h,)`` [rad]."""

    heading: Array
    sigma: Array

    def costs(self, state: Array) -> Iterable[Array]:
        """Half the squared difference in sigmas from each heading."""
        for heading, sigma in zip(self.heading, self.sigma, strict=True):
            apart = wrap_angle(heading - state[2]) / sigma
            yield np.minimum(0.5 * apart**2, PARTICLES.outlier_price)

    def place_sought(self, state: Array) -> None:
        """Headings determine no place."""


@wording_of(HeadingFactor.name)
def _wording(hypothesis: Hypothesis) -> Wording:
    """The start heading is wrong, or the compass is off."""
    if hypothesis.kind[1] == "wrong start":
        check = "the start heading: clockwise from north, in degrees, of the first step"
        return Wording(START, "the start heading is wrong", check)
    (angle,) = np.degrees(hypothesis.parameter)
    text = f"the compass is {hypothesis.kind[1].replace('off', f'off by about {angle:.0f}°')}"
    return Wording(HeadingFactor.name, text, "magnets and iron near the phone")


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
        import gtsam

        noise = loss.noise(n, gtsam.noiseModel.Isotropic.Sigma(1, sigma[n]))
        direction = gtsam.Pose2(0.0, 0.0, headings.heading[n])
        return gtsam.PoseRotationPrior2D(int(at.state.keys("x", keyframe)[n]), direction, noise)

    value = wrap_angle(at.state.poses[keyframe, 2] - headings.heading) / sigma
    variables = [("x", keyframe)]
    more = {"loss": loss, "native": native, "constants": np.column_stack([headings.heading, sigma])}
    return FactorBlock.uniform(name, value[:, None], variables, jacobian, number, **more)
