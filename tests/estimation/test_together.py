"""Several walks in one graph, bound by closures."""

from dataclasses import replace

import numpy as np
import pytest
from walks import drawn_from_the_model, fixes_at

from pdr_graph import WalkGraph, smooth
from pdr_graph.estimation.multi_walk import smooth_together
from pdr_graph.priors import WALKER, changed
from pdr_graph.types import Closures, Estimate

SIGMA_CLOSURE = 1.0  # [m]
FAR = np.array([300.0, 0.0])  # [m]


def drawn(n, seed, shift=(0.0, 0.0)):
    """A walk drawn from the model, somewhere else."""
    steps, fixes, truth = drawn_from_the_model(n, seed)
    shift = np.array(shift)
    return steps, replace(fixes, position=fixes.position + shift), replace(truth, position=truth.position + shift)


def met(seed, n=90, wrong=1.0):
    """Two walks that were within a closure's sigma of one place, each in its middle."""
    steps, fixes, truth = drawn(n, 2 * seed)
    there = drawn(n, 2 * seed + 1)[2]
    at = n // 2
    off = np.random.default_rng(seed).normal(0, wrong * SIGMA_CLOSURE, 2)
    other = drawn(n, 2 * seed + 1, truth.position[at] - there.position[at] + off)
    return (steps, fixes, truth), other, Closures.of([(truth.time[at], other[2].time[at], SIGMA_CLOSURE)], [(0, 1)])


class Both:
    """Two graphs and their closure, passed as one through the NEES of others."""

    def __init__(self, graphs, closures):
        self.graphs, self.closures = graphs, closures


def one_that_met(seed, wrong=1.0):
    (steps, _, truth), (others, fixes, _), closures = met(seed, wrong=wrong)
    start = fixes_at(truth.time[:1], truth.position[:1] + np.random.default_rng(seed + 999).normal(0, 1.5, (1, 2)), 1.5)
    end = fixes_at(truth.time[-1:], truth.position[-1:] + np.random.default_rng(seed + 99).normal(0, 9.0, (1, 2)), 9.0)
    few = type(start).concatenate([start, end])
    return Both([WalkGraph(steps, few), WalkGraph(others, fixes)], closures), truth


def one_that_met_far_off(seed):
    return one_that_met(seed, wrong=5.0)


def first_of_both(both) -> Estimate:
    return smooth_together(both.graphs, [smooth(graph) for graph in both.graphs], both.closures)[0]


def together(walks, closures):
    graphs = [WalkGraph(steps, fixes) for steps, fixes, _ in walks]
    return smooth_together(graphs, [smooth(graph) for graph in graphs], closures)


def error(estimate, truth):
    return np.hypot(*(estimate.trajectory.position - truth.position).T)


def test_unconnected_walks_equal_their_separate_solutions():
    """To 2 cm and 8 % of the covariance or 40 cm²: what joins them is loose, and segments are cut elsewhere."""
    walks = [drawn(60, seed) for seed in range(3)]
    with changed(WALKER, drifting=1e-9):  # else it is asked of each walk, or of all, whether the gyroscope drifts far
        alone = [smooth(WalkGraph(steps, fixes)) for steps, fixes, _ in walks]
        joined = together(walks, Closures.of([]))
    for estimate, other in zip(alone, joined, strict=True):
        assert other.trajectory.time == pytest.approx(estimate.trajectory.time, abs=1e-6)
        assert np.abs(estimate.trajectory.position - other.trajectory.position).max() < 0.02
        assert other.trajectory.covariance == pytest.approx(estimate.trajectory.covariance, rel=0.08, abs=4e-3)
        assert other.calibration.value[-1] == pytest.approx(estimate.calibration.value[-1], abs=0.01)
        residuals = [fix.residual for fix in estimate.fixes]
        assert [fix.residual for fix in other.fixes] == pytest.approx(residuals, abs=0.01)
        assert [fix.time for fix in other.fixes] == pytest.approx([fix.time for fix in estimate.fixes])


def test_a_walk_without_fixes_is_placed_by_its_encounters():
    steps, fixes, truth = drawn(120, 5)
    met_at, no_fixes = np.arange(10, 120, 20), fixes_at([], np.empty((0, 2)))
    alike = drawn(120, 5)  # the same way on another day, of which nobody knows where it was
    closures = Closures.of([(truth.time[k], truth.time[k], SIGMA_CLOSURE) for k in met_at], [(0, 1)] * len(met_at))
    first, second = together([(steps, fixes, truth), (steps, no_fixes, truth)], closures)
    assert np.median(error(second, alike[2])) < 2 * np.median(error(first, truth)) + SIGMA_CLOSURE


def test_a_wrong_link_loses_its_weight():
    """One of six links is wrong by 300 m: the error grows by less than a metre."""
    steps, fixes, truth = drawn(120, 7)
    at = np.arange(10, 120, 20)
    moved = replace(truth, position=truth.position + FAR)
    elsewhere = replace(fixes, position=fixes.position + FAR)
    wrong = Closures.of([(truth.time[k], truth.time[k], SIGMA_CLOSURE) for k in at[:1]], [(0, 1)])
    alone = smooth(WalkGraph(steps, elsewhere))
    _, other = together([(steps, fixes, truth), (steps, elsewhere, moved)], wrong)
    assert np.abs(other.trajectory.position - alone.trajectory.position).max() < 1.0
