"""Walks whose turns were not measured: their shape is that of the fixes, wherever those are dense."""

import numpy as np
import pytest

from pdr_graph import WalkGraph, smooth
from pdr_graph.estimation.factors.base import POSE
from pdr_graph.estimation.initialization import along_fixes
from pdr_graph.estimation.optimizer import continued, optimize
from pdr_graph.geometry import as_complex, interpolate
from pdr_graph.priors import MOTION
from pdr_graph.types import Fixes, Steps

STEPS, LENGTH, PERIOD, SIGMA = 360, 0.75, 0.55, 3.0


def corners(seed):
    """Steps without turns, fixes each second, and the true walk: straight for 15 to 40 m, then a corner or back."""
    noise = np.random.default_rng(seed)
    time, turn, corner = PERIOD * np.arange(STEPS + 1), np.zeros(STEPS), 0
    while (corner := corner + int(noise.integers(20, 50))) < STEPS:
        turn[corner] = noise.choice([-1, 1]) * np.pi / 2 * noise.choice([1, 1, 2])
    heading = np.cumsum(turn)
    place = np.concatenate([[[0, 0]], np.cumsum(LENGTH * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)])
    at = np.arange(0.0, time[-1])
    fixes = Fixes(at, interpolate(at, time, place) + noise.normal(0, SIGMA, (len(at), 2)), np.full(len(at), SIGMA))
    flat, wide = np.zeros(STEPS), np.full(STEPS, MOTION.unmeasured_turn)
    length = LENGTH * np.exp(noise.normal(0, 0.05, STEPS)) / 1.1
    columns = {"duration": np.full(STEPS, PERIOD), "length": length, "turn": flat, "pause_turn": flat}
    steps = Steps(0.0, time[-1], time[1:], **columns, sigma_length=0.1 * length, sigma_turn=wide, final_turn=0.0)
    return steps, fixes, time, place, np.unwrap(np.append(heading[:1], heading))


def test_the_search_ends_where_it_ends_from_the_true_walk():
    """From a straight line it ended at walks up to 40 nats less probable, some after 70 iterations."""
    worse = []
    for seed in range(8):
        steps, fixes, time, place, heading = corners(seed)
        graph = WalkGraph(steps, fixes)
        found = smooth(graph)
        assert found.converged
        off = np.hypot(*(interpolate(time, found.trajectory.time, found.trajectory.position) - place).T)
        assert np.median(off) < 2, "fixes of 3 m per axis, corners each half minute"
        true = np.column_stack([interpolate(graph.chain.time, time, place), np.interp(graph.chain.time, time, heading)])
        at_truth = graph.start.replaced(**{POSE: true})
        refined = graph.refined(optimize(graph, at_truth).at)
        worse.append(found.cost - optimize(refined, continued(refined.start, at_truth)).cost)
    assert np.median(worse) < 2
    assert np.max(worse) < 15


def test_the_line_about_a_time_is_that_of_weighted_least_squares():
    noise = np.random.default_rng(0)
    at = np.sort(noise.uniform(0, 300, 300))
    fix, weight = as_complex(noise.normal(0, 50, (300, 2))), noise.uniform(0.5, 2, 300)
    time = np.array([20.0, 100.0, 280.0])
    place, heading = along_fixes(time, np.round(at), fix, weight)
    for t, p, h in zip(time, place, heading, strict=True):
        root = np.sqrt(weight * np.exp(-0.5 * ((np.round(at) - t) / 8.0) ** 2))
        line = np.linalg.lstsq(root[:, None] * np.stack([at**0, np.round(at) - t], axis=1), root * fix, rcond=None)[0]
        assert p == pytest.approx(line[0], abs=0.3), "the kernel is cut at three sigma"
        assert h == pytest.approx(np.angle(line[1]), abs=0.05)
    assert np.isnan(along_fixes(np.array([100.0]), np.array([0.0, 60.0, 120.0]), fix[:3], weight[:3])[1]).all()
