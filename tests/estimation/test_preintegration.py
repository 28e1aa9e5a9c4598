"""Preintegration against a step-by-step composition of poses, and its covariance against random draws."""

import gtsam
import numpy as np
import pytest
from walks import PERIOD, wandering_walk

from pdr_graph.estimation.factors.chain import SIGMA_STILL, bridge, cut, preintegrate
from pdr_graph.priors import MOTION
from pdr_graph.types import Steps

C = np.array([1.12, 0.97, 0.004])


def composed(steps: Steps, first: int, last: int) -> gtsam.Pose2:
    """Steps ``first`` to ``last`` one after the other: half the turn, the step, the other half."""
    pose = gtsam.Pose2()
    for k in range(first, last):
        half = (C[1] * steps.turn[k] + C[2] * PERIOD) / 2
        pose = pose.compose(gtsam.Pose2(0, 0, half)).compose(gtsam.Pose2(C[0] * steps.length[k], 0, half))
    return pose


def test_increments_are_the_composition_of_steps():
    """Exact in c: any calibration, not a linearisation about one."""
    steps = wandering_walk(37)
    pieces = cut(steps, np.empty(0))
    delta = preintegrate(pieces, np.tile(C, (len(pieces.first), 1))).delta
    for first, last in zip(pieces.first, pieces.last, strict=True):
        for m in range(first, min(last, 36) + 1):
            pose = composed(steps, first, m + 1)
            assert delta[m] == pytest.approx([pose.x(), pose.y(), pose.theta()], abs=1e-12)


def test_every_fix_has_a_keyframe_that_splits_its_step():
    steps = wandering_walk(20)
    at = np.array([0.0, 1.0, 4.4, 4.41, steps.end])
    pieces = cut(steps, at)
    assert np.isin(at, pieces.keyframe_time).all()
    assert pieces.length.sum() == pytest.approx(steps.length.sum())
    assert np.diff(pieces.keyframe_time).min() > 0
    assert np.bincount(pieces.interval).max() <= 10
    in_step_2 = (pieces.interval == 0) & (pieces.length > 0)
    expected = steps.length[0] + steps.length[1] * (1.0 - PERIOD) / PERIOD
    assert pieces.length[in_step_2].sum() == pytest.approx(expected)


def test_a_pause_has_no_displacement_but_its_turn():
    steps = wandering_walk(3)
    time = steps.time + np.array([0.0, 10.0, 10.0])
    paused = Steps(
        0.0, 13.0, time, steps.duration, steps.length, steps.turn, np.array([0, 0.2, 0]), *[np.full(3, 0.05)] * 2, 0.3
    )
    pieces = cut(paused, np.array([5.0]))
    still = pieces.length == 0
    assert np.isclose(pieces.length.sum(), steps.length.sum())
    turned = pieces.to_end[0, pieces.last].sum()
    assert turned == pytest.approx(steps.turn.sum() + 0.3)
    before_the_fix = 2 * (pieces.to_end - pieces.to_middle)[0, still][0]
    assert before_the_fix == pytest.approx(0.2 * (5.0 - time[0]) / (time[1] - PERIOD - time[0]))


def test_derivatives_by_c_are_central_differences():
    pieces = cut(wandering_walk(25), np.array([3.3]))
    by_c = preintegrate(pieces, np.tile(C, (len(pieces.first), 1))).by_c
    for n in range(3):
        step = np.eye(3)[n] * 1e-6
        ahead, behind = (preintegrate(pieces, np.tile(c, (len(pieces.first), 1))).delta for c in (C + step, C - step))
        assert by_c[:, :, n] == pytest.approx((ahead - behind) / 2e-6, abs=1e-6)


def drawn_partial_sums(steps: Steps, draws: int) -> np.ndarray:
    """Δ_k of noisy steps, ``(draws, n, 3)``: each with its own error of length, sway and turn."""
    random = np.random.default_rng(0)
    out = np.zeros((draws, len(steps), 3))
    position, theta = np.zeros((draws, 2)), np.zeros(draws)
    for k in range(len(steps)):
        wander = random.normal(0, steps.sigma_turn[k], draws)
        course = theta + (steps.turn[k] + wander) / 2
        along = steps.length[k] + random.normal(0, np.hypot(steps.sigma_length[k], SIGMA_STILL), draws)
        across = random.normal(0, np.hypot(MOTION.lateral, SIGMA_STILL), draws)
        c, s = np.cos(course), np.sin(course)
        position = position + np.stack([along * c - across * s, along * s + across * c], axis=1)
        theta = theta + steps.turn[k] + wander
        out[:, k, :2], out[:, k, 2] = position, theta
    return out


def test_covariances_are_those_of_random_draws():
    """Q and the gains of nine steps from 40 000 draws; a covariance's entries are then good to about 2 %."""
    steps = wandering_walk(9, seed=4)
    pieces = cut(steps, np.array([steps.time[-1]]))
    increments = preintegrate(pieces, np.tile([1.0, 1.0, 0.0], (len(pieces.first), 1)))
    spread = bridge(pieces, increments)
    draws = drawn_partial_sums(steps, 40_000)
    draws -= draws.mean(axis=0)
    Q = np.linalg.inv(spread.root[0].T @ spread.root[0])
    sample_Q = np.einsum("di,dj->ij", draws[:, 8], draws[:, 8]) / len(draws)
    scale = np.sqrt(np.diag(Q))
    assert (sample_Q - Q) / np.outer(scale, scale) == pytest.approx(np.zeros((3, 3)), abs=0.04)
    for k in (2, 5):
        cross = np.einsum("di,dj->ij", draws[:, k], draws[:, 8]) / len(draws)
        left = draws[:, k] - draws[:, 8] @ spread.gain[k].T
        assert (spread.gain[k] @ Q - cross) / np.outer(scale, scale) == pytest.approx(np.zeros((3, 3)), abs=0.04)
        sample_spread = np.einsum("di,dj->ij", left, left) / len(draws)
        assert sample_spread == pytest.approx(spread.spread[k], abs=0.04 * np.diag(spread.spread[k]).max())
