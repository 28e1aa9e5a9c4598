"""Fixes of one receiver, whose errors are correlated in time."""

from dataclasses import replace

import numpy as np
import pytest
from walks import PERIOD, dead_reckon, fixes_at, pushing, steps_of

from pdr_graph.apps.report.evaluation import coverage
from pdr_graph.estimation.factors.fixes import FixFactor, drift
from pdr_graph.estimation.factors.gnss_bias import NODE_EVERY, GnssBias
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.estimation.optimizer import optimize
from pdr_graph.estimation.smoother import smooth
from pdr_graph.frames import enu
from pdr_graph.geometry import interpolate, unit
from pdr_graph.priors import PRICES, RECEIVERS, changed
from pdr_graph.types import LONLAT, Fixes, Steps


def named(fixes, source="GNSS"):
    return replace(fixes, source=(source,) * len(fixes))


def meander(n=300, seed=0):
    """Steps of a walk with many turns: a lag is not to be confused with an offset."""
    random = np.random.default_rng(seed)
    turn = np.where(np.arange(n) % 15 == 14, random.choice([-1, 1], n) * np.pi / 2, 0.0)
    return steps_of(np.full(n, 0.7), turn, sigma_length=0.2)


def gauss_markov(steps, time, random):
    """A process of unit variance ``(n, 2)``, correlated as a receiver's errors on a walk."""
    keep = np.exp(-np.diff(drift(steps, time), prepend=0.0))
    process = random.normal(0, 1, (len(time), 2))
    for i in range(1, len(time)):
        process[i] = keep[i] * process[i - 1] + np.sqrt(1 - keep[i] ** 2) * process[i]
    return process


def biased(graph):
    """The graph with what a receiver's fixes have in common, all of which are held."""
    fixes = graph.positions
    fixes = fixes.classified(fixes.outlier, fixes.used)
    gnss = GnssBias.of(fixes, graph.steps).bind(graph.chain)
    replaced = {FixFactor.name: fixes, GnssBias.name: gnss}
    return graph._with_variables(tuple(replaced.get(kind.name, kind) for kind in graph.measurements))


def test_a_minute_of_correlated_fixes_is_worth_a_few():
    """While standing, the position is the generalised least-squares mean of the fixes; an offset throughout adds."""
    time, sigma = np.arange(0, 61, NODE_EVERY), 3.0
    standing = Steps(0.0, 60.0, *np.empty((6, 0)), sigma_turn=np.empty(0))
    errors = sigma * gauss_markov(standing, time, np.random.default_rng(2))
    with changed(PRICES, astray=100.0):
        estimate = smooth(WalkGraph(standing, named(fixes_at(time, errors, sigma))))

    alike = np.exp(-np.abs(time[:, None] - time) / RECEIVERS.standing)
    weight = np.linalg.solve(sigma**2 * (alike + RECEIVERS.white**2 * np.eye(len(time))), np.ones(len(time)))
    assert estimate.trajectory.position[0] == pytest.approx(weight @ errors / weight.sum(), abs=0.01)
    variance = 1 / weight.sum() + (RECEIVERS.throughout * sigma) ** 2
    assert estimate.trajectory.covariance[0, 0, 0] == pytest.approx(variance, rel=0.01)


def test_a_slow_offset_does_not_bend_the_walk():
    """The shape of the walk comes from the steps; fixes with a common error hardly change it."""
    bent = []
    for seed in range(6):
        steps, random = meander(300, seed), np.random.default_rng(seed)
        truth = dead_reckon(steps)
        time = np.arange(1.0, steps.end, 1.0)
        errors = 3.0 * gauss_markov(steps, time, random)
        fixes = fixes_at(time, interpolate(time, truth.time, truth.position) + errors, 3.0)
        tracks = [smooth(WalkGraph(steps, used)).trajectory for used in (fixes, named(fixes))]
        shape = [np.std(track.position - truth.position) for track in tracks]
        bent.append(shape[1] / shape[0])
    assert np.mean(bent) < 0.8


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_receiver_that_smooths_does_not_shrink_the_walk(share):
    """It follows half of the way from its mean over a minute to the walker: 66 % of the length without `behind`."""
    lengths = []
    for seed in range(4):
        steps, random = meander(210, seed), np.random.default_rng(seed)
        truth, time = dead_reckon(steps), np.arange(1.0, steps.end, 1.0)
        true = interpolate(time, truth.time, truth.position)
        mean = true.copy()
        for n in range(1, len(time)):
            mean[n] = mean[n - 1] + (true[n] - mean[n - 1]) / 60.0
        errors = 2.0 * gauss_markov(steps, time, random) + random.normal(0, 1.2, true.shape)
        fixes = named(fixes_at(time, true + share * (mean - true) + errors, 4.0))
        track = smooth(WalkGraph(steps, fixes)).trajectory
        lengths.append(np.hypot(*np.diff(track.position, axis=0).T).sum() / steps.length.sum())
    assert min(lengths) > 0.85
    assert max(lengths) < 1.12


def test_fixes_by_longitude_and_latitude_are_a_receivers():
    """As the tutorials print it: at 1 Hz with correlated errors, 90 % of the poses are in the 90 % region."""
    inside = []
    for seed in range(4):
        steps, random = meander(300, seed), np.random.default_rng(seed)
        truth, time = dead_reckon(steps), np.arange(1.0, steps.end, 1.0)
        errors = 4.0 * gauss_markov(steps, time, random)
        place = interpolate(time, truth.time, truth.position) + errors
        frame = enu(48.0, 11.0)
        fixes = Fixes(time, frame.to_lonlat(place), np.full(len(time), 4.0), epsg=LONLAT)
        assert set(fixes.source) == {"GNSS"}
        inside.append(coverage(smooth(WalkGraph(steps, frame.place(fixes))).trajectory, truth))
    assert np.mean(inside) > 0.87
    assert Fixes(0.0, (11.0, 48.0), 4.0, epsg=LONLAT, source=("",)).source == ("",), "unless the user says otherwise"


def test_the_lag_of_a_receiver_is_estimated():
    """Positions are two seconds late on a walk with many turns; the estimate is less late."""
    steps = meander(300)
    truth = dead_reckon(steps)
    time = np.arange(4.0, steps.end, 1.0)
    late = named(fixes_at(time, interpolate(time - 2.0, truth.time, truth.position), 2.0))

    def error():
        return np.hypot(*(smooth(WalkGraph(steps, late)).trajectory.position - truth.position).T).mean()

    graph = biased(WalkGraph(steps, late))
    lag = optimize(graph, graph.start).state["g"][:, 2]
    assert 0.5 < np.median(lag) < 2.5
    aware = error()
    with changed(RECEIVERS, lag=1e-3):
        assert aware < 0.8 * error()


def test_a_part_of_a_walk_begins_with_the_velocity_that_the_walk_has_there():
    """Else each part that leaves a window states that its receiver is not late, and the lag ends near 0."""
    steps = meander(60)
    time, truth = np.arange(4.0, steps.end, 1.0), dead_reckon(steps)
    graph = biased(WalkGraph(steps, named(fixes_at(time, interpolate(time, truth.time, truth.position), 2.0))))
    [whole] = [kind for kind in graph.measurements if kind.name == GnssBias.name]
    part = whole.bind(replace(graph.chain, heading=graph.chain.direction).after(20))
    assert part.velocity == pytest.approx(whole.velocity[20:])


@pytest.mark.parametrize("lag", [0.0, 2.0])
def test_the_lag_that_a_receiver_has_shown_is_kept_when_its_fixes_leave_the_window(lag):
    steps = meander(300)
    truth = dead_reckon(steps)
    time = np.arange(4.0, steps.end, 1.0)
    fixes = named(fixes_at(time, interpolate(time - lag, truth.time, truth.position), 2.0))
    live = LiveSmoother(lag=20.0)
    for _ in pushing(live, steps, fixes):
        pass
    assert live.graph.at.state["g"][-1, 2] == pytest.approx(lag, abs=0.5)


def test_duplicate_epochs_are_not_used_twice():
    """A receiver repeats its position while it detects no motion; every fix keeps its place in the report."""
    steps = meander(60)
    track = dead_reckon(steps)
    held = np.repeat(track.position[:20:4], 4, axis=0)
    estimate = smooth(WalkGraph(steps, named(fixes_at(track.time[:20], held, 3.0))))
    again = ["duplicate epoch" in report.reason for report in estimate.fixes]
    assert again == [n % 4 != 0 for n in range(20)]


def test_a_single_fix_of_a_receiver_is_enough():
    """The walk is at most as far ahead of it as receivers are late."""
    steps = meander(30)
    estimate = smooth(WalkGraph(steps, named(fixes_at([PERIOD], [[5.0, 5.0]], 3.0))))
    assert np.hypot(*(estimate.trajectory.position[1] - 5.0)) == pytest.approx(RECEIVERS.lag * 0.7 / 2.0, abs=0.1)


def test_two_receivers_have_separate_offsets():
    """One errs to the east, one to the west; the walk follows neither alone."""
    steps = meander(100)
    truth = dead_reckon(steps)
    place, east = truth.position[::5], np.array([4.0, 0.0])
    both = Fixes(
        np.tile(truth.time[::5], 2),
        np.concatenate([place + east, place - east]),
        np.full(2 * len(place), 4.0),
        ("",) * (2 * len(place)),
        source=("one",) * len(place) + ("other",) * len(place),
    )
    graph = biased(WalkGraph(steps, both))
    state, gnss = optimize(graph, graph.start).state, graph.find(GnssBias)
    sources = [both.source[gnss.fix[gnss.node == m][0]] for m in np.flatnonzero(gnss.keep == 0)]
    offset, half = state["g"][:, 0], len(state["g"]) // 2
    offset = offset if sources == ["one", "other"] else np.roll(offset, half)
    assert (np.sign(offset) == np.repeat([1, -1], half)).all()
    assert state.poses[:, 0].mean() == pytest.approx(graph.start.poses[:, 0].mean(), abs=0.5)


def test_sigmas_grow_with_the_number_of_correlated_fixes():
    """A minute of epochs must not count as sixty independent fixes."""
    places = np.random.default_rng(0).normal(size=(600, 2))
    fixes = named(fixes_at(np.arange(600.0), places, 3.0))
    standing = Steps(0.0, 600.0, *np.empty((6, 0)), sigma_turn=np.empty(0))
    sigma = FixFactor.of(fixes, standing, Prior()).independent_sigma
    assert sigma[300] == pytest.approx(3.0 * np.sqrt(2 * RECEIVERS.standing), rel=0.02)
    independent = replace(fixes, source=())
    assert (FixFactor.of(independent, standing, Prior()).independent_sigma == 3.0).all()


def test_errors_decorrelate_sooner_while_walking():
    steps = meander(300)
    walking = drift(steps, np.array([10.0, 70.0]))
    assert np.diff(walking)[0] > 2 * 60.0 / RECEIVERS.standing


def test_worse_fixes_beside_a_good_one_share_its_error():
    """A minute of fixes of 20 m that all lie 20 m to the east does not outvote one of 2 m."""
    steps, east = meander(120), np.array([20.0, 0.0])
    truth = dead_reckon(steps)
    time = np.arange(1.0, steps.end, 1.0)
    fixes, good = fixes_at(time, interpolate(time, truth.time, truth.position) + east, 20.0), len(time) // 2
    fixes.sigma[good], fixes.position[good] = 2.0, fixes.position[good] - east
    track = smooth(WalkGraph(steps, named(fixes))).trajectory
    row = np.argmin(np.abs(truth.time - time[good]))
    assert np.hypot(*(track.position[row] - truth.position[row])) < 4.0


def test_a_frozen_receiver_is_not_used_until_it_moves_again():
    steps, random = steps_of(np.full(220, 0.7), np.zeros(220)), np.random.default_rng(5)
    time = np.arange(1.0, 120.0, 1.0)
    true = interpolate(time, dead_reckon(steps).time, dead_reckon(steps).position)
    place = true + 3.0 * gauss_markov(steps, time, random) + random.normal(0, 1.0, (len(time), 2))
    held = (time > 30) & (time < 80)
    place[held] = place[np.argmax(held)] + random.normal(0, 0.2, (held.sum(), 2))
    estimate = smooth(WalkGraph(steps, named(fixes_at(time, place, 3.0))))
    unused = [fix for fix in estimate.fixes if "held its position" in fix.reason]
    assert any("held its position" in warning for warning in estimate.warnings)
    assert {fix.time for fix in unused} == set(np.arange(32.0, 80.0))
    assert all(fix.weight == 0 for fix in unused)
    assert np.abs(estimate.trajectory.position[-1] - dead_reckon(steps).position[-1]).max() < 8.0


def test_standing_still_is_not_frozen():
    time = np.arange(0.0, 60.0, 1.0)
    standing = Steps(0.0, 60.0, *np.empty((6, 0)), sigma_turn=np.empty(0))
    fixes = named(fixes_at(time, np.random.default_rng(1).normal(0, 0.2, (len(time), 2)), 3.0))
    assert WalkGraph(standing, fixes).positions.used.all()


def test_scattered_outliers_are_no_scatter_of_the_receiver():
    """A quarter of the fixes are 50 to 500 m off, each elsewhere: these are rejected, the others are used."""
    steps, random = meander(150), np.random.default_rng(3)
    time = np.arange(1.0, steps.end, 1.0)
    place = interpolate(time, dead_reckon(steps).time, dead_reckon(steps).position) + random.normal(
        0, 1, (len(time), 2)
    )
    wild = random.permutation(len(time)) < 0.27 * len(time)
    place[wild] += random.uniform(50, 500, (wild.sum(), 1)) * unit(random.uniform(0, 2 * np.pi, wild.sum()))
    fixes = smooth(WalkGraph(steps, named(fixes_at(time, place, 3.0)))).fixes
    assert np.array_equal([fix.weight < 0.1 for fix in fixes], wild)


def test_a_receiver_that_scatters_more_than_it_states_gets_a_region_as_wide_as_its_errors():
    """Stated a third of the sigma, the region is about that of the right one."""

    def radius(stated):
        steps, random = meander(), np.random.default_rng(3)
        time = np.arange(1.0, steps.end, 1.0)
        true = interpolate(time, dead_reckon(steps).time, dead_reckon(steps).position)
        errors = 3.0 * gauss_markov(steps, time, random) + random.normal(0, 1.2, (len(time), 2))
        estimate = smooth(WalkGraph(steps, named(fixes_at(time, true + errors, stated))))
        return np.sqrt(np.linalg.det(estimate.trajectory.covariance[:, :2, :2])).mean() ** 0.5

    assert radius(1.0) == pytest.approx(radius(3.0), rel=0.25)


def test_errors_larger_than_stated_are_assumed_where_the_fixes_lie_so():
    """Fixes every four seconds, in the first half 12 m beside the walk, in the second on it; the start is known."""
    steps, random = meander(), np.random.default_rng(2)
    time = np.arange(2.0, steps.end, 4.0)
    true = interpolate(time, dead_reckon(steps).time, dead_reckon(steps).position)
    errors = random.normal(0, 2.0, (len(time), 2)) + np.where(time < steps.end / 2, 12.0, 0.0)[:, None] * [0, 1]
    known = fixes_at([0.0], [[0.0, 0.0]], 0.5)
    estimate = smooth(WalkGraph(steps, Fixes.concatenate([known, named(fixes_at(time, true + errors, 3.0), "Wi-Fi")])))
    assert any("errors of Wi-Fi are about" in reason.text for reason in estimate.contradictions)
    off = estimate.trajectory.position - dead_reckon(steps).position
    square = np.einsum("ni,nij,nj->n", off, np.linalg.inv(estimate.trajectory.covariance[:, :2, :2]), off)
    assert np.mean(square < 4.61) > 0.85  # the 90 % region


def test_errors_k_times_as_large_cost_their_price_and_the_normaliser_of_every_error():
    """Two axes of each fix, of each node of the offset and of the offset throughout: k^−2 in the density of each."""
    steps, random = meander(), np.random.default_rng(2)
    time = np.arange(2.0, steps.end, 4.0)
    true = interpolate(time, dead_reckon(steps).time, dead_reckon(steps).position)
    graph = biased(WalkGraph(steps, named(fixes_at(time, true + random.normal(0, 9.0, true.shape), 3.0))))
    gnss = graph.find(GnssBias)
    proposals = gnss.hypotheses(graph.evaluate(graph.start), None)
    larger = {p.hypothesis.parameter[0]: p.hypothesis.price for p in proposals if p.hypothesis.kind[1] == "larger"}
    errors = len(time) + len(gnss.node_number) + 1
    assert larger == pytest.approx({k: price + 2 * errors * np.log(k) for k, price in PRICES.larger})


def test_a_receiver_that_does_not_follow_has_wider_priors_and_pays_their_normaliser():
    """Of the offset throughout in two axes, and of the share that is not followed, at most all of the walk."""
    steps = meander()
    time = np.arange(2.0, steps.end, 4.0)
    true = interpolate(time, dead_reckon(steps).time, dead_reckon(steps).position)
    graph = biased(WalkGraph(steps, named(fixes_at(time, true, 3.0))))
    at = graph.evaluate(graph.start)
    [proposal] = [p for p in graph.find(GnssBias).hypotheses(at, None) if p.hypothesis.kind[1] == "not following"]
    lost = graph.assuming(proposal.measurements)

    def sigmas(graph):
        [prior] = graph.evaluate(graph.start).blocks_of("gnss_bias.throughout")
        return 1 / np.abs(np.diag(prior.jacobian()[0]))

    usual, unusual = sigmas(graph), sigmas(lost)
    assert usual[:2] == pytest.approx(RECEIVERS.throughout * 3.0)
    assert unusual[:2] == pytest.approx(RECEIVERS.astray * 3.0)
    assert usual[2] <= unusual[2] <= 1.0
    assert proposal.hypothesis.price == pytest.approx(PRICES.astray + np.log(np.prod(unusual / usual)))


@pytest.mark.parametrize(("not_following", "larger"), [(True, 1.0), (False, 3.0), (True, 3.0)])
def test_a_decision_about_receivers_holds_for_later_fixes(not_following, larger):
    """A smoother that goes on from an earlier decision models the same errors."""
    steps = meander()
    time = np.arange(1.0, steps.end, 1.0)
    graph = WalkGraph(
        steps, named(fixes_at(time, interpolate(time, dead_reckon(steps).time, dead_reckon(steps).position), 3.0))
    )
    as_stated = GnssBias.of(graph.positions, graph.steps)
    decided = as_stated._times(larger)
    later = as_stated.continued((decided._without_following() if not_following else decided).decisions())
    assert later.not_following == later.courses.wrong == not_following
    assert later.larger == larger
    assert later.sigma == pytest.approx(larger * as_stated.sigma)


def test_receivers_as_they_state_need_no_decision():
    steps = meander()
    graph = WalkGraph(steps, named(fixes_at([1.0, 9.0], [[0.0, 0.0], [3.0, 0.0]], 3.0)))
    assert GnssBias.of(graph.positions, graph.steps).decisions() == {}


def test_a_receiver_that_scatters_for_a_while_is_trusted_again():
    """Live: twenty seconds of fixes as rough as a sigma of 12 m would be, then as stated, 3 m."""
    steps, random = meander(), np.random.default_rng(3)
    time = np.arange(1.0, 100.0, 1.0)
    true = interpolate(time, dead_reckon(steps).time, dead_reckon(steps).position)
    errors = random.normal(0, 1, (len(time), 2)) * np.where(time < 20, 3.6, 0.6)[:, None]
    live, wider = LiveSmoother(), [1.0]
    for _ in pushing(live, steps, named(fixes_at(time, true + errors, 3.0))):
        decided = live.graph.decisions.get("fixes", {})
        wider += decided["widened"][-1:].tolist() if decided else []
    assert max(wider) > 2.0
    assert wider[-1] == pytest.approx(1.0, abs=0.2)
