"""Missing fixes, outliers and contradictions: every walk ends with a trajectory and a correct status."""

from dataclasses import replace

import numpy as np
import pytest
from walks import dead_reckon, fixes_at, fixes_on, straight, wandering_walk

from pdr_graph import kalman_filter, kalman_smoother, smooth
from pdr_graph.estimation.factors.fixes import FixFactor, consistent_chains
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.gps_track import follow
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.gait.step_chunks import concatenate_steps, gap, join, shifted
from pdr_graph.geometry import unit
from pdr_graph.priors import FIXES
from pdr_graph.types import Fixes, Steps

METHODS = pytest.mark.parametrize("method", [smooth, kalman_filter, kalman_smoother])


def honest(estimate, *warnings):
    """The estimate, if it is finite, its covariance is one, and it warns of these."""
    track = estimate.trajectory
    assert np.isfinite(track.position).all()
    assert np.isfinite(track.heading).all()
    assert np.linalg.eigvalsh(track.covariance).min() > 0
    assert all(0 <= fix.weight <= 1 for fix in estimate.fixes)
    assert [text for text in warnings if not any(text in line for line in estimate.warnings)] == []
    return estimate


GUESS = "where the walk was is a guess"


def shape_error(track, steps):
    """Greatest distance [m] between a track and that of the steps, laid on it by a turn, a shift and a scale."""
    z, w = (xy[:, 0] + 1j * xy[:, 1] for xy in (dead_reckon(steps).position, track.position))
    z, w = z - z.mean(), w - w.mean()
    return np.abs(w - z * np.vdot(z, w) / np.vdot(z, z)).max()


@METHODS
def test_an_outage_of_thousands_of_steps_is_bridged(method):
    """Four fixes before, four after: exact for exact steps and fixes, with the covariance of dead reckoning."""
    n = 3000
    steps = wandering_walk(n)
    truth = dead_reckon(steps, fixes_at([0], [[50.0, -30.0]]), heading=2.0)
    rows = np.r_[0:40:10, n - 40 : n : 10]
    estimate = honest(method(WalkGraph(steps, fixes_at(truth.time[rows], truth.position[rows]))))
    sigma = np.sqrt(np.linalg.eigvalsh(estimate.trajectory.covariance[:, :2, :2])[:, -1])
    assert np.all(np.hypot(*(estimate.trajectory.position - truth.position).T) < 3 * sigma)
    assert sigma.max() > 10 * sigma[-1]


@METHODS
@pytest.mark.parametrize("by", [-60.0, 60.0], ids=["before", "after"])
def test_fixes_far_outside_the_walk_are_not_used(by, method):
    steps = wandering_walk(200)
    end = steps.start if by < 0 else steps.end
    graph = WalkGraph(steps, fixes_at([end + by, end + 2 * by], [[5.0, 5.0], [9.0, 9.0]]))
    warnings = "no position fix", "2 fixes lie outside the recording, by 60 s or more"
    estimate = honest(method(graph), *warnings)
    assert [fix.weight for fix in estimate.fixes] == [0, 0]


@METHODS
def test_the_position_after_a_long_gap_is_unknown_until_a_fix(method):
    """An hour between two walks, fixes only in the first: the second keeps its shape, with an unknown position."""
    first, second = wandering_walk(200), shifted(wandering_walk(200, seed=1), 3600.0)
    steps = join([first, second])
    estimate = honest(method(WalkGraph(steps, fixes_on(dead_reckon(first), every=20))))
    sigma = np.sqrt(estimate.trajectory.covariance[:, 0, 0])
    assert sigma[200] < 3
    assert sigma[202:].min() > 500
    assert any("gap" in text for text in steps.unknown)


@METHODS
def test_a_recording_may_end_with_a_gap(method):
    """No segment starts after it; the walk before is unchanged."""
    walk = wandering_walk(60)
    fixes = fixes_on(dead_reckon(walk), every=20)
    ended = honest(method(WalkGraph(concatenate_steps([walk, gap(walk.end, walk.end + 20.0)]), fixes)))
    alone = method(WalkGraph(walk, fixes))
    assert ended.trajectory.position[:60] == pytest.approx(alone.trajectory.position[:60], abs=0.3)


def test_parts_with_their_own_fixes_are_placed_separately():
    """An hour and 5 km apart: no fix is an outlier, and both parts are right to a metre."""
    first, second = wandering_walk(200), shifted(wandering_walk(200, seed=1), 3600.0)
    here, there = dead_reckon(first), dead_reckon(second, fixes_at([0], [[4000.0, 3000.0]]), heading=1.0)
    fixes = Fixes.concatenate([fixes_on(here, every=20), fixes_on(there, every=20)])
    estimate = honest(smooth(WalkGraph(join([first, second]), fixes)))
    position, rows = estimate.trajectory.position, np.arange(1, 201)
    assert np.hypot(*(position[rows] - here.position[rows]).T).max() < 1
    assert np.hypot(*(position[rows + 201] - there.position[rows]).T).max() < 1
    assert min(fix.weight for fix in estimate.fixes) == 1


@pytest.mark.parametrize("every", [1, 20])
def test_inconsistent_fixes_do_not_bend_the_walk(every):
    steps = wandering_walk(200)
    rows = np.arange(0, 200, every)
    scattered = np.random.default_rng(3).uniform(-500, 500, (len(rows), 2))
    graph = WalkGraph(steps, fixes_at(dead_reckon(steps).time[rows], scattered))
    estimate = honest(smooth(graph), "contradict the steps and the other fixes", GUESS)
    assert shape_error(estimate.trajectory, steps) < 5, "of a walk of 140 m"


@pytest.mark.parametrize("off", [60.0, 200.0, 500.0])
def test_a_receiver_wrong_for_a_third_of_the_walk_is_rejected(off):
    """Its positions are all in one place, where no steps lead. The walk equals that without these fixes."""
    steps = wandering_walk(300)
    truth = dead_reckon(steps)
    fixes = fixes_on(truth, every=3, seed=1)
    wild = (np.arange(len(fixes)) >= 40) & (np.arange(len(fixes)) < 73)
    place = fixes.position[wild].mean(axis=0) + off * unit(np.array(0.7))
    lying = replace(fixes, position=np.where(wild[:, None], place, fixes.position))
    contradiction = f"{wild.sum()} of {len(fixes)} fixes contradict the steps"
    estimate, without = honest(smooth(WalkGraph(steps, lying)), contradiction), smooth(WalkGraph(steps, fixes[~wild]))
    assert [fix.weight < 0.1 for fix in estimate.fixes] == wild.tolist()
    assert np.hypot(*(estimate.trajectory.position - without.trajectory.position).T).max() < 0.3
    assert not any(GUESS in line for line in estimate.warnings)


def test_two_fixes_that_contradict_each_other_leave_a_guess():
    steps = wandering_walk(200)
    estimate = honest(smooth(WalkGraph(steps, fixes_at([1.0, 60.0], [[0.0, 0.0], [800.0, 0.0]]))), GUESS)
    assert shape_error(estimate.trajectory, steps) < 5


def test_two_sources_that_disagree_are_not_averaged():
    """They are 300 m apart: the walk follows one of them, with a warning."""
    steps = wandering_walk(200)
    fixes = fixes_on(dead_reckon(steps), every=10)
    first, second = (replace(fixes, source=(name,) * len(fixes)) for name in ("GNSS", "beacons"))
    second = replace(second, position=second.position + np.array([300.0, 0.0]))
    both = Fixes.concatenate([first, second])
    estimate = honest(smooth(WalkGraph(steps, both)), GUESS)
    believed, by_satellite = np.array([fix.weight > 0.5 for fix in estimate.fixes]), np.array(both.source) == "GNSS"
    assert sorted([believed[by_satellite].mean(), believed[~by_satellite].mean()]) == [0, 1]


@METHODS
def test_repeated_fixes_do_no_harm(method):
    steps = wandering_walk(200)
    truth = dead_reckon(steps)
    fixes = fixes_on(truth, every=20)
    estimate = honest(method(WalkGraph(steps, fixes[np.repeat(np.arange(len(fixes)), 3)])))
    assert np.hypot(*(estimate.trajectory.position - truth.position).T).max() < 0.1
    assert len(estimate.fixes) == 3 * len(fixes)


def reached(steps: Steps, fixes):
    return consistent_chains(steps, fixes, fixes.sigma, np.ones(len(fixes), dtype=bool))


def test_a_jump_there_and_back_is_an_outlier():
    steps = straight(50)
    fixes = fixes_at(np.arange(6) * 4.0, [[0, 0], [5, 0], [10, 90], [15, 90], [20, 0], [25, 0]])
    run, believed = reached(steps, fixes)
    assert run.tolist() == [0, 0, 1, 1, 2, 2]
    assert believed.tolist() == [True, True, False, False, True, True]
    shuffled = np.random.default_rng(0).permutation(6)
    assert reached(steps, fixes[shuffled])[1].tolist() == believed[shuffled].tolist(), "in any order"


def test_of_two_equal_chains_the_one_without_a_rejected_fix_is_consistent():
    """The first two fixes, or the last two, are 90 m off: only that the walk has rejected one of them tells which."""
    steps = straight(50)
    fixes = fixes_at(np.arange(4) * 4.0, [[0, 0], [5, 0], [10, 90], [15, 90]])
    used, share = np.ones(4, dtype=bool), np.array([1.0, FIXES.rejected, 1.0, 1.0])
    assert consistent_chains(steps, fixes, fixes.sigma, used)[1].tolist() == [True, True, False, False]
    assert consistent_chains(steps, fixes, fixes.sigma, used, share)[1].tolist() == [False, False, True, True]


def test_a_fix_that_a_chain_passes_over_does_not_count_for_it():
    """The third can be reached from the first alone: a chain through it has two fixes, the other three."""
    fixes = fixes_at([0.0, 6.0, 16.0, 22.0], [[0, 0], [8, 0], [8, 30], [30, 0]])
    run, believed = reached(straight(50), fixes)
    assert run.tolist() == [0, 0, 1, 2]
    assert believed.tolist() == [True, True, False, True]


def by_bus(n=60):
    """Fixes every second at 10 m/s."""
    return fixes_at(np.arange(float(n)), np.column_stack([10.0 * np.arange(n), np.zeros(n)]), 5.0)


@pytest.mark.parametrize("off", [100.0, 1000.0])
def test_without_steps_a_jump_there_and_back_is_skipped_and_reported(off):
    fixes = by_bus()
    fixes.position[30:33, 1] = off
    estimate = honest(follow(fixes), "3 of 60 fixes are too far to be reached in time")
    assert np.abs(estimate.trajectory.position[:, 1]).max() == 0
    assert [round(fix.weight) for fix in estimate.fixes] == [1] * 30 + [0] * 3 + [1] * 27
    assert estimate.fixes[31].residual == pytest.approx(off)


def test_without_steps_a_flight_is_accepted():
    """Thirty fixes before and after it: the person travelled, however fast."""
    fixes = by_bus()
    fixes.position[30:] += 500_000.0
    estimate = honest(follow(fixes))
    assert all(fix.weight > 0.99 for fix in estimate.fixes)
    assert not estimate.warnings


def test_without_steps_standing_is_a_warning():
    """Indoors a short walk and the wander of a receiver look alike."""
    wander = np.random.default_rng(0).normal(0, 5.0, (240, 2))
    honest(follow(fixes_at(np.arange(240.0), wander, 5.0)), "for 4 of 4 min: classified as standing")
    assert not any("standing" in line for line in follow(by_bus(240)).warnings)


def test_without_steps_the_worse_of_two_simultaneous_fixes_is_not_used():
    fixes = Fixes.concatenate([by_bus(), fixes_at([30.0], [[300.0, 400.0]], 50.0)])
    estimate = honest(follow(fixes))
    assert estimate.fixes[31].reason.startswith("a better fix at the same time")
    assert np.abs(estimate.trajectory.position[:, 1]).max() == 0


def test_an_outlier_just_within_reach_does_not_split_the_chain():
    """22.2 m back is within reach of the fix before (5 σ of both and the way), and the next is not of it."""
    steps = straight(100)
    track = dead_reckon(steps)
    place = track.position[::2].copy()
    place[20, 0] -= 22.2
    graph = WalkGraph(steps, fixes_at(track.time[::2], place, 3.0))
    assert len(np.unique(graph.positions.run)) == 2
    assert graph.positions.consistent.all()


def test_a_misplaced_start_is_recognised_by_the_fixes_after_it():
    """A start 8 m off that says half a metre; fixes of 1.5 m follow."""
    steps = wandering_walk(150, 3)
    truth = dead_reckon(steps, fixes_at([0], [[20.0, 10.0]]))
    after = fixes_on(truth[5:], every=25, sigma=1.5, seed=3)
    start = fixes_at(truth.time[:1], truth.position[:1] + np.array([8.0, 0.0]), 0.5)
    estimate = smooth(WalkGraph(steps, Fixes.concatenate([start, after])))
    [wrong] = estimate.contradictions
    assert wrong.source == "fixes"
    assert "the fix at 0 s" in wrong.text
    assert np.hypot(*(estimate.trajectory.position - truth.position).T).max() < 5.0
    assert estimate.fixes[0].weight == 0


# What the second pass and the search for alternatives make of each fix, at poses that the test chooses

MEADOW = straight(60)
EVERY = 8  # steps between the fixes on it


def on_the_meadow(off=(), sigma=1.0):
    """A graph of fixes every few steps of a straight walk, some of them off by so much [m] to the left."""
    track = dead_reckon(MEADOW)
    place = track.position[:-1:EVERY].copy()
    for n, metres in dict(off).items():
        place[n, 1] += metres
    return WalkGraph(MEADOW, fixes_at(track.time[:-1:EVERY], place, sigma))


def along_the_truth(graph, left=0.0):
    """The evaluation of a graph along the straight walk, or so far [m] to the left of it."""
    track, time = dead_reckon(MEADOW), graph.keyframe_time
    y = np.full(len(time), left)
    poses = np.column_stack([np.interp(time, track.time, track.position[:, 0]), y, np.zeros(len(time))])
    return graph.evaluate(graph.start.replaced(x=poses))


@pytest.mark.parametrize("sigma", [0.4, 3.0])
def test_a_fix_is_an_outlier_beyond_so_many_of_its_sigmas(sigma):
    """One is just within and one just beyond: in the second pass, and where a walk goes on."""
    limit = FIXES.outlier * sigma
    graph = on_the_meadow({2: 0.95 * limit, 5: 1.05 * limit}, sigma)
    fixes, at = graph.positions, along_the_truth(graph)
    assert fixes.consistent.all(), "steps lead from each to the next"
    for classified in (fixes.refined(at), fixes.reclassified(at)):
        assert np.flatnonzero(classified.outlier).tolist() == [5]


@pytest.mark.parametrize(("left", "held"), [(0.0, False), (80.0, True)])
def test_a_run_outside_the_chain_is_used_if_the_first_optimum_is_near_it(left, held):
    """Two fixes 80 m aside are no part of the longest chain; a walk that leads there by other measurements has them."""
    graph = on_the_meadow({3: 80.0, 4: 80.0})
    assert graph.positions.consistent.tolist() == [True] * 3 + [False] * 2 + [True] * 3
    fixes = graph.positions.refined(along_the_truth(graph, left))
    assert fixes.held[3:5].tolist() == [held] * 2
    assert fixes.held[fixes.consistent].all()


def test_a_fix_without_a_keyframe_has_no_factor():
    graph = on_the_meadow()
    assert len(graph.positions.independent) == len(graph.fixes)
    assert not len(FixFactor.of(graph.fixes, MEADOW, Prior()).independent)


@pytest.mark.parametrize("known", ["", "outlier", "wrong"])
def test_fixes_that_leave_the_chain_contradict_it_unless_they_were_rejected_before(known):
    """The two were consistent with the others in a window in which the fixes after them were still to come."""
    fixes = on_the_meadow({3: 80.0, 4: 80.0}).positions
    before = {"number": fixes.number, "consistent": np.ones(len(fixes), dtype=bool)}
    rejected = {name: ~fixes.consistent & (name == known) for name in ("outlier", "wrong")}
    assert fixes.contradicts(before | rejected) == (known == "")


def test_a_fix_is_doubted_from_the_distance_that_so_many_fixes_rarely_reach():
    """The farthest of f fixes is doubted where f exp(−d² / 2) [d in sigmas] is below FIXES.doubtful."""
    rare = np.sqrt(2 * np.log(8 / FIXES.doubtful))
    found = {}
    for share in (0.95, 1.05):
        graph = on_the_meadow({4: share * rare})
        found[share] = len(graph.positions.hypotheses(along_the_truth(graph), None))
    assert found == {0.95: 0, 1.05: 3}, "that fix, and those beside it"


def test_without_a_doubted_fix_those_beside_it_count_again():
    """The walk may have followed it, so that those beside it in time became outliers; it alone is marked as wrong."""
    graph = on_the_meadow({4: 8.0})
    fixes = graph.positions.rejected(np.array([3, 6]))
    proposals = fixes.hypotheses(along_the_truth(graph), None)
    assert sorted(proposal.hypothesis.instances for proposal in proposals) == [(4,), (5,)]
    [without] = next(proposal.measurements for proposal in proposals if proposal.hypothesis.instances == (4,))
    assert np.flatnonzero(without.wrong).tolist() == [4]
    assert np.flatnonzero(~without.held).tolist() == [4]
    assert np.flatnonzero(without.outlier).tolist() == [6], "it is not beside the wrong one"
