"""Robust losses: the weight of a factor with a large residual.

A loss is a function of the deviation s of a factor, in sigmas; its weight w(s) = ρ'(s) / s is the share of the factor's
information that is used. Huber's never reaches 0 and has one minimum. Geman and McClure's tends to 0 far off, and is
used only for outliers from a first optimum.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from pdr_graph.priors import LOSSES
from pdr_graph.types import Array, Mask

if TYPE_CHECKING:
    import gtsam


def huber_weight(deviation: Array, width: float | None = None) -> Array:
    """Huber's weight ``(n,)`` at deviations ``(n,)`` [σ]: full up to ``width``."""
    return np.minimum(1.0, (width or LOSSES.huber) / np.maximum(np.abs(deviation), 1e-9))


def geman_mcclure_weight(deviation: Array, width: float | None = None) -> Array:
    """Geman and McClure's weight ``(n,)`` at deviations ``(n,)`` [σ]: it tends to 0 far off."""
    square = (width or LOSSES.geman_mcclure) ** 2
    return (square / (square + deviation**2)) ** 2


class Loss:
    """Half the squared deviation: errors are Gaussian."""

    def weight(self, deviation: Array) -> Array:
        """Weights ``(n,)`` at deviations ``(n,)`` [σ]."""
        return np.ones(len(deviation))

    def cost(self, deviation: Array) -> Array:
        """Costs ``(n,)`` at deviations ``(n,)`` [σ]."""
        return 0.5 * deviation**2

    def noise(self, n: int, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base | None:
        """GTSAM's noise model of factor ``n`` with this loss, None if GTSAM has none; noise: its Gaussian model.

        The export puts a loss that GTSAM does not have into the residual.
        """
        return noise if type(self) is Loss else None


GAUSSIAN = Loss()


@dataclass(frozen=True)
class RobustLoss(Loss):
    """Huber's loss, and Geman and McClure's for outliers.

    outlier: ``(n,)``; width: of Geman and McClure's [σ].
    """

    outlier: Mask
    width: float = field(default_factory=lambda: LOSSES.geman_mcclure)

    def weight(self, deviation: Array) -> Array:
        """Weights ``(n,)`` at deviations ``(n,)`` [σ]."""
        return np.where(self.outlier, geman_mcclure_weight(deviation, self.width), huber_weight(deviation))

    def cost(self, deviation: Array) -> Array:
        """Costs ``(n,)`` at deviations ``(n,)`` [σ]."""
        far, square = np.abs(deviation), deviation**2
        inlier = np.where(far > LOSSES.huber, LOSSES.huber * (far - LOSSES.huber / 2), square / 2)
        return np.where(self.outlier, 0.5 * self.width**2 * square / (self.width**2 + square), inlier)

    def noise(self, n: int, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
        """GTSAM's noise model of factor ``n``."""
        import gtsam

        robust, estimator = gtsam.noiseModel.Robust, gtsam.noiseModel.mEstimator
        if self.outlier[n]:
            return robust.Create(estimator.GemanMcClure.Create(self.width), noise)
        return robust.Create(estimator.Huber.Create(LOSSES.huber), noise)
