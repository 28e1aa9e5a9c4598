"""The factors that GTSAM has itself, as the graph of a whole walk and that of one under way take them."""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X

from pdr_graph.estimation.robust import HUBER_WIDTH, WILD_WIDTH
from pdr_graph.types import Array

NOISE = gtsam.noiseModel
ESTIMATOR = gtsam.noiseModel.mEstimator


def robustly(
    noise: gtsam.noiseModel.Base, wild: bool, flat: float = 0.0, wild_width: float = WILD_WIDTH
) -> gtsam.noiseModel.Base:
    """Huber's loss, or none within ``flat`` sigmas; what is wild lets go (Geman and McClure's)."""
    if wild:
        return NOISE.Robust.Create(ESTIMATOR.GemanMcClure.Create(wild_width), noise)
    return NOISE.Robust.Create(
        ESTIMATOR.L2WithDeadZone.Create(flat) if flat else ESTIMATOR.Huber.Create(HUBER_WIDTH), noise
    )


def fix_factor(
    keyframe: int, position: Array, sigma: float, wild: bool = False, flat: float = 0.0
) -> gtsam.NonlinearFactor:
    """A fix ``(2,)`` whose error is its own [m]."""
    return gtsam.PoseTranslationPrior2D(X(keyframe), position, robustly(NOISE.Isotropic.Sigma(2, sigma), wild, flat))


def heading_factor(keyframe: int, heading: float, sigma: float) -> gtsam.NonlinearFactor:
    """A walking direction [rad]."""
    towards = gtsam.Pose2(0.0, 0.0, heading)
    return gtsam.PoseRotationPrior2D(X(keyframe), towards, robustly(NOISE.Isotropic.Sigma(1, sigma), wild=False))


def hold_factor(keyframe: int, heading: float, sigma: float) -> gtsam.NonlinearFactor:
    """A hold on a heading [rad], for when nothing else determines it."""
    return gtsam.PoseRotationPrior2D(X(keyframe), gtsam.Pose2(0.0, 0.0, heading), NOISE.Isotropic.Sigma(1, sigma))


def start_factor(keyframe: int, pose: Array, sigmas: tuple[float, float, float]) -> gtsam.NonlinearFactor:
    """A pose ``(3,)`` that defines the frame of a walk that nothing places [m, m, rad]."""
    return gtsam.PriorFactorPose2(X(keyframe), gtsam.Pose2(*pose), NOISE.Diagonal.Sigmas(np.array(sigmas)))


def calibration_factor(segment: int, mean: Array, covariance: Array) -> gtsam.NonlinearFactor:
    """What is believed of a segment's (R_s, R_d, b) beforehand."""
    return gtsam.PriorFactorVector(C(segment), mean, NOISE.Gaussian.Covariance(covariance))


def change_factor(segment: int, sigmas: tuple[float, float, float]) -> gtsam.NonlinearFactor:
    """How a segment's calibration follows from that of the one before."""
    return gtsam.BetweenFactorVector(C(segment - 1), C(segment), np.zeros(3), NOISE.Diagonal.Sigmas(np.array(sigmas)))
