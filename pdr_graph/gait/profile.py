"""A walker's own calibration: the three coefficients of [calibration-walk] Sec. 3.3 and how well they are known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.types import Array, Steps

COEFFICIENTS = ("E_length", "E_straight", "E_corner")


@dataclass(frozen=True)
class Profile:
    """How a walker's steps and turns differ from what the models say.

    E_length: distance error per metre [-]; E_straight: heading error per metre walked [rad/m]; E_corner: turn error per
    turn [-]. covariance: ``(3, 3)`` of the three in this order; residual: of the walk that told them, root mean square
    distance from where it is known to have been [m]; speed: at which it was walked, by the models [m/s].
    """

    E_length: float
    E_straight: float
    E_corner: float
    covariance: Array
    residual: float
    speed: float

    def corrected(self, steps: Steps) -> Steps:
        """The steps of the same walker: [calibration-walk] Eqs. (8), (9), E_straight on the uncorrected length."""
        drift = self.E_straight * steps.length
        return replace(
            steps,
            length=(1 + self.E_length) * steps.length,
            turn=(1 + self.E_corner) * steps.turn + drift,
            pause_turn=(1 + self.E_corner) * steps.pause_turn,
            sigma_length=np.where(steps.length > 0, 1 + self.E_length, 1.0) * steps.sigma_length,
            final_turn=(1 + self.E_corner) * steps.final_turn,
        )
