"""The factors of a walk under way, as GTSAM takes them."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X

from pdr_graph.estimation.factors import Evaluation
from pdr_graph.estimation.graph import ANY_HEADING, FRAME_SIGMA, Prior
from pdr_graph.estimation.live_fixes import SLIPPING, LiveFix
from pdr_graph.estimation.live_way import Interval
from pdr_graph.estimation.robust import HUBER_WIDTH, WILD_WIDTH
from pdr_graph.estimation.tree import Name, linear
from pdr_graph.types import Array

Factors = dict[Name, gtsam.NonlinearFactor]


def own_factors(intervals: Sequence[Interval], own: Evaluation, known: gtsam.Values) -> Factors:
    """Steps and walls of intervals, linear where they are: one factor for each."""
    pdr, wall = own.pdr, own.wall
    pressed = np.empty(0, dtype=np.intp) if wall is None else np.flatnonzero(wall.value[:, 0])
    of_pressed, factors = own.pieces.interval[pressed], Factors()
    for n, one in enumerate(intervals):
        error, blocks = pdr.value[n], [pdr.by_i[n], pdr.by_j[n], pdr.by_c[n]]
        if wall is not None and len(here := pressed[of_pressed == n]):
            rows = wall.take(here)
            error = np.append(error, rows.value[:, 0])
            beside = (rows.by_i[:, 0], rows.by_j[:, 0], rows.by_c[:, 0])
            blocks = [np.vstack(pair) for pair in zip(blocks, beside, strict=True)]
        factors["own", one.j] = linear((X(one.i), X(one.j), C(one.segment)), blocks, error, known)
    return factors


def fix_factor(fix: LiveFix) -> gtsam.NonlinearFactor:
    """A fix whose error is its own."""
    noise, estimator = gtsam.noiseModel, gtsam.noiseModel.mEstimator
    wild = fix.kind == SLIPPING
    loss = estimator.GemanMcClure.Create(WILD_WIDTH) if wild else estimator.Huber.Create(HUBER_WIDTH)
    robust = noise.Robust.Create(loss, noise.Isotropic.Sigma(2, fix.sigma))
    return gtsam.PoseTranslationPrior2D(X(fix.keyframe), fix.position, robust)


def heading_factor(keyframe: int, heading: float, sigma: float) -> gtsam.NonlinearFactor:
    """A walking direction."""
    noise = gtsam.noiseModel
    robust = noise.Robust.Create(noise.mEstimator.Huber.Create(HUBER_WIDTH), noise.Isotropic.Sigma(1, sigma))
    return gtsam.PoseRotationPrior2D(X(keyframe), gtsam.Pose2(0.0, 0.0, heading), robust)


def frame_factor(keyframe: int, pose: Array, placed: bool) -> gtsam.NonlinearFactor:
    """A loose hold on the first heading; of a walk that nothing places, what defines its frame."""
    if placed:
        any_heading = gtsam.noiseModel.Isotropic.Sigma(1, ANY_HEADING)
        return gtsam.PoseRotationPrior2D(X(keyframe), gtsam.Pose2(*pose), any_heading)
    return gtsam.PriorFactorPose2(X(keyframe), gtsam.Pose2(*pose), gtsam.noiseModel.Isotropic.Sigma(3, FRAME_SIGMA))


def calibration_factor(segment: int, mean: Array, covariance: Array) -> gtsam.NonlinearFactor:
    """What is believed of a segment's calibration beforehand."""
    return gtsam.PriorFactorVector(C(segment), mean, gtsam.noiseModel.Gaussian.Covariance(covariance))


def change_factor(segment: int, prior: Prior) -> gtsam.NonlinearFactor:
    """How a segment's calibration follows from that of the one before."""
    change = gtsam.noiseModel.Diagonal.Sigmas(np.array(prior.change))
    return gtsam.BetweenFactorVector(C(segment - 1), C(segment), np.zeros(3), change)
