"""A walk whose receivers are assumed to be off throughout follows from the solved walk, as if it were solved again."""

from dataclasses import replace

import numpy as np
import pytest
from walks import dead_reckon, fixes_at, steps_of

from pdr_graph import smooth
from pdr_graph.estimation import hypotheses
from pdr_graph.estimation.changed_prior import with_changed_prior
from pdr_graph.estimation.covariance import covariance_of_ends
from pdr_graph.estimation.factors.gnss_bias import GnssBias
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.optimizer import continued, optimize, solve_robust
from pdr_graph.geometry import interpolate
from pdr_graph.types import Fixes


def walk(offset, other=0):
    """A walk of 300 steps with a receiver that is off by `offset` [m], and some positions of another one."""
    random, n = np.random.default_rng(3), 300
    steps = steps_of(np.full(n, 0.7), np.where(np.arange(n) % 15 == 14, random.choice([-1, 1], n) * np.pi / 2, 0.0))
    truth = dead_reckon(steps)
    time = np.arange(1.0, steps.end, 1.0)
    errors = random.normal([offset, 0.0], 0.5, (len(time), 2))
    gnss = fixes_at(time, interpolate(time, truth.time, truth.position) + errors, 3.0)
    sure = fixes_at(truth.time[10 : 10 + 40 * other : 40], truth.position[10 : 10 + 40 * other : 40], 1.0)
    both = [np.concatenate([getattr(f, name) for f in (gnss, sure)]) for name in ("time", "position", "sigma")]
    rows = len(both[0])
    return WalkGraph(steps, Fixes(*both, ("",) * rows, source=("GNSS",) * len(gnss) + ("",) * len(sure)))


def assumed(graph, number):
    """The solved walk, its graph under the assumption of this number, and where the search would start."""
    old = solve_robust(graph)
    hypothesis = old.graph.find(GnssBias).hypotheses(old.at)[number]
    changed = old.graph.assuming(hypothesis.measurements)
    return old, changed, continued(changed.start, old.state), hypothesis.prior


@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize("other", [0, 7])
def test_walk_determinant_and_covariance_are_those_of_the_solved_walk(number, other):
    old, graph, start, prior = assumed(walk(2.0, other), number)
    derived, solved = with_changed_prior(old, graph, start, prior), optimize(graph, start)
    solved = optimize(graph, solved.state)  # linearised at the optimum
    assert derived.state.poses == pytest.approx(solved.state.poses, abs=2e-3)
    assert derived.cost == pytest.approx(solved.cost, abs=1e-3)
    assert derived.solution.log_determinant == pytest.approx(solved.solution.log_determinant, abs=0.02)
    rows = np.arange(len(graph.pieces.length))
    ours, theirs = (covariance_of_ends(one.at, one.solution, rows) for one in (derived, solved))
    assert ours[0] == pytest.approx(theirs[0], rel=0.01, abs=1e-3 * theirs[0].max())
    assert ours[1] == pytest.approx(theirs[1], rel=0.01, abs=1e-6)
    off = np.abs(derived.state["o"] - old.state["o"])[0, :2].max()
    assert off > 0.1 if other else off < 1e-3  # [σ]; nothing but another source can say how far a receiver is off


def test_a_walk_that_does_not_follow_linearly_is_solved_again():
    """Heavy outliers and a large step: the cost does not fall as predicted."""
    old, graph, start, prior = assumed(walk(2.0, 7), 1)
    shifted = replace(start, arrays={**start.arrays, "o": start["o"] + 50.0})
    assert with_changed_prior(old, graph, shifted, prior) is None


def test_few_fixes_of_a_receiver_are_solved_again():
    """Their offset is no border of the elimination, so that its covariance with all others is not at hand."""
    steps = steps_of(np.full(30, 0.7), np.zeros(30))
    track = dead_reckon(steps)
    fixes = replace(fixes_at(track.time[3:28:8], track.position[3:28:8], 3.0), source=("GNSS",) * 4)
    assert with_changed_prior(*assumed(WalkGraph(steps, fixes), 0)) is None


def test_the_estimate_is_that_with_every_assumption_solved(monkeypatch):
    graph = walk(3.0, 7)
    ours = smooth(graph)
    monkeypatch.setattr(hypotheses, "with_changed_prior", lambda *_: None)
    theirs = smooth(graph)
    assert ours.trajectory.position == pytest.approx(theirs.trajectory.position, abs=0.01)
    assert ours.trajectory.covariance == pytest.approx(theirs.trajectory.covariance, rel=0.02, abs=2e-3)
    assert [c.text for c in ours.contradictions] == [c.text for c in theirs.contradictions]
