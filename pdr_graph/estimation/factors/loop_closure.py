"""Loop closures: two moments at one place.

Sources are a stop between two recordings, a recognised place, an encounter of two people.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from pdr_graph.estimation.factors.base import GAUSSIAN, FactorBlock, Refined, RobustLoss, Stage, WeighsPoses
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.geometry import pose_rotation
from pdr_graph.priors import LOSSES
from pdr_graph.types import ROW, Array, Closures, Index, Steps

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.chain import Chain, Evaluation

FIRM, DOUBTED, UNBOUND = "firm", "doubted", "unbound"  # without robust loss, with it, without factors


@dataclass(frozen=True, eq=False)
class LoopClosureFactor(Refined, WeighsPoses):
    """Pairs of moments at one place, with any headings: r = (p_j − p_i) / σ.

    ``BetweenFactorPose2`` uses the logarithm, which weighs the same distance up to π/2 times as much if the headings
    are opposite.

    closures: ``l`` of them; number: ``(l,)`` permanent numbers; keyframe: ``(l, 2)`` of both moments; hold: FIRM
    without robust loss, DOUBTED with it, UNBOUND without factors.
    """

    closures: Closures
    number: Index
    keyframe: Index = field(metadata=ROW)
    hold: str = DOUBTED

    name: ClassVar[str] = "closures"

    @classmethod
    def of(cls, closures: Closures, steps: Steps, prior: Prior, number: Index | None = None) -> LoopClosureFactor:
        """The closures of one walk."""
        number = np.arange(len(closures)) if number is None else number
        return cls(closures, number, np.full((len(closures), 2), -1))

    def keyframe_times(self) -> Array:
        """Both times of each closure."""
        return self.closures.time.ravel()

    def bind(self, chain: Chain) -> Self:
        """Bind both moments of every closure to their keyframes."""
        return replace(self, keyframe=chain.keyframe(self.closures.time.ravel()).reshape(-1, 2))

    def staged(self, stage: Stage) -> Self:
        """Firm in a rough search, doubted in a final one."""
        return replace(self, hold=FIRM if stage is Stage.ROUGH else DOUBTED)

    def alternatives(self) -> Sequence[Self]:
        """All closures firm, or none used: the optimum near a firm closure hides the other."""
        return [replace(self, hold=hold) for hold in (FIRM, UNBOUND)] if len(self.closures) else []

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """One factor for each closure both of whose moments are in the walk."""
        which = np.flatnonzero((self.keyframe >= 0).all(axis=1) & (self.hold != UNBOUND))
        keyframe, sigma = self.keyframe[which], self.closures.sigma[which]
        i, j = at.state.poses[keyframe[:, 0]], at.state.poses[keyframe[:, 1]]

        def jacobian() -> list[Array]:
            R_i, R_j = (pose_rotation(pose[:, 2])[:, :2] / sigma[:, None, None] for pose in (i, j))
            return [-R_i, R_j]

        loss = GAUSSIAN if self.hold == FIRM else RobustLoss(np.ones(len(which), dtype=bool), LOSSES.closure)
        value = (j - i)[:, :2] / sigma[:, None]
        variables = [("x", keyframe[:, 0]), ("x", keyframe[:, 1])]
        return [FactorBlock.uniform(self.name, value, variables, jacobian, self.number[which], loss=loss)]

    def pose_costs(self, keyframe: int) -> None:
        """A pose at one moment does not determine how far it is from that at another."""

    def standing_variance(self, interval: int) -> float:
        """Variance of a closure of both ends of an interval [m²]: a pause.

        If the walker did walk on during such a gap, the start that is aligned with the fixes leads to the optimum.
        """
        bound = np.flatnonzero((self.keyframe == (interval, interval + 1)).all(axis=1))
        return float(self.closures.sigma[bound].min()) ** 2 if len(bound) else np.inf
