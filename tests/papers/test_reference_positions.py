"""[calibration-walk] Sec. 2: reference positions on a simulated crowd."""

from functools import cache

import numpy as np
import pytest
from walks import fixes_at, straight

from pdr_graph import dead_reckon
from pdr_graph.geometry import interpolate
from pdr_graph.lab.papers.reference_positions import (
    DISTANT,
    ENCOUNTER,
    FALSE_SHARE,
    FARTHEST_FALSE,
    NEARBY,
    NEAREST_FALSE,
    REFERENCES,
    Encounters,
    Reference,
    Rule,
    closure_weights,
    distance_by,
    falsified,
    in_region,
    set_to_references,
    smoothed,
)
from pdr_graph.lab.simulation.crowd import (
    HALL,
    SWITCH_PLACES,
    TERMINAL,
    CrowdWalk,
    crowd,
)
from pdr_graph.priors import BEACONS, LOSSES, REPORTS, changed
from pdr_graph.types import Headings, Trajectory

crowd = cache(crowd)
STEPS = 20


def walker(y):
    """A walker who goes east from (0, y), with the measured steps of 0.7 m and without errors."""
    steps, start = straight(STEPS), fixes_at([0.0], [[0.0, y]], 0.5)
    east = Headings(np.zeros(1), np.zeros(1), np.full(1, 0.1), ("start",))
    return CrowdWalk(steps, dead_reckon(steps, start), start, east, fixes_at([], np.empty((0, 2))), None)


def along(y):
    return np.column_stack([0.7 * np.append(np.arange(STEPS + 1), STEPS), np.full(STEPS + 2, y)])


def test_a_walker_is_at_the_reference_and_goes_on_from_there_by_its_steps():
    one, step = walker(0.0), 8
    time, place = float(one.truth.time[step]), np.array([3.0, 4.0])
    [track] = set_to_references([one], [Reference(time, 0, place)])
    assert track.position[:step] == pytest.approx(along(0.0)[:step])
    assert track.position[step:] == pytest.approx(along(4.0)[step:] + np.array([3.0 - 0.7 * step, 0.0]))


def test_of_two_who_meet_the_one_longer_without_a_known_place_takes_the_position_of_the_other():
    walks, times = [walker(0.0), walker(9.0)], walker(0.0).truth.time
    known = [Reference(float(times[5]), 1, np.array([1.0, 1.0])), Reference(float(times[9]), 1, other=0)]
    first, second = set_to_references(walks, known)
    assert second.position[5] == pytest.approx([1.0, 1.0])
    assert first.position[9] == pytest.approx([1.0 + 4 * 0.7, 1.0])  # as far as the second has come since
    assert second.position[9] == pytest.approx([1.0 + 4 * 0.7, 1.0])


def test_a_position_that_was_taken_over_is_as_old_as_the_one_it_came_from():
    """The third was at a known place after the second, from whom the first has its position."""
    walks, times = [walker(0.0), walker(9.0), walker(20.0)], walker(0.0).truth.time.tolist()
    known = [
        Reference(times[3], 1, np.array([1.0, 1.0])),
        Reference(times[5], 2, np.array([50.0, 50.0])),
        Reference(times[9], 0, other=1),
        Reference(times[12], 0, other=2),
    ]
    first, second, _ = set_to_references(walks, known)
    assert second.position[12] == pytest.approx([1.0 + 9 * 0.7, 1.0])
    assert first.position[12] == pytest.approx([50.0 + 7 * 0.7, 50.0])


def test_the_crowd_stays_in_the_hall_and_is_at_a_switch_when_it_presses_it():
    for walk in crowd(0).walks:
        assert ((walk.truth.position > 0) & (walk.truth.position < HALL)).all()
        there = interpolate(walk.presses.time, walk.truth.time, walk.truth.position)
        assert (np.hypot(*(there - walk.presses.position).T) < 3 * walk.presses.sigma).all()
        assert {tuple(place) for place in walk.presses.position} <= {tuple(place) for place in SWITCH_PLACES}


def test_without_shadows_a_level_gives_the_true_distance(monkeypatch):
    monkeypatch.setattr("pdr_graph.lab.simulation.crowd.SHADOWING", 0.0)
    monkeypatch.setattr("pdr_graph.lab.simulation.crowd.FADING", 0.0)
    with changed(BEACONS, path_loss_sigma=(0.0, 0.0, 0.0)):
        walkers = crowd.__wrapped__(3)
    met = walkers.receptions
    true = [np.hypot(*np.diff(walkers.places(t)[pair], axis=0)[0]) for t, pair in zip(met.time, met.pair, strict=True)]
    assert distance_by(met.rssi) == pytest.approx(np.maximum(true, 0.5))


def test_one_in_ten_encounters_is_falsified_by_a_walker_who_was_elsewhere():
    walkers = crowd(0)
    met = DISTANT.encounters(walkers)
    with_false, false = falsified(walkers, met, 1)
    assert false.mean() == pytest.approx(FALSE_SHARE, abs=4 * np.sqrt(FALSE_SHARE / len(met)))
    assert (with_false.pair[~false] == met.pair[~false]).all()
    assert (with_false.pair[false] < TERMINAL).all()
    for n in np.flatnonzero(false):
        one, other = walkers.places(met.time[n])[with_false.pair[n]]
        assert NEAREST_FALSE < np.hypot(*(one - other)) < FARTHEST_FALSE


def test_the_region_holds_nine_in_ten_draws_of_its_covariance():
    random, n = np.random.default_rng(0), 4000
    covariance = np.tile(np.array([[4.0, 1.5, 0.0], [1.5, 1.0, 0.0], [0.0, 0.0, 1.0]]), (n, 1, 1))
    time, nothing = np.arange(n, dtype=float), np.zeros(n)
    drawn = random.multivariate_normal(np.zeros(2), covariance[0, :2, :2], n)
    inside = in_region(Trajectory(time, drawn, nothing), Trajectory(time, 0 * drawn, nothing, covariance=covariance))
    assert inside.mean() == pytest.approx(0.9, abs=4 * np.sqrt(0.09 / n))


def test_an_encounter_at_the_width_of_the_loss_keeps_a_quarter_of_its_weight():
    """Geman and McClure: (w² / (w² + s²))² at s = w."""
    tracks, time = [dead_reckon(straight(STEPS), fixes_at([0.0], [[0.0, y]])) for y in (0.0, 4.0 * 3.0)], np.ones(1)
    assert LOSSES.closure == 4.0
    met = Encounters(time, np.array([[0, 1]]), np.array([-60.0]), np.array([3.0]))
    assert closure_weights(tracks, met) == pytest.approx(0.25)
    assert closure_weights(tracks[:1] * 2, met) == pytest.approx(1.0)


def between_walkers(rule, seed=0):
    met = rule.encounters(crowd(seed))
    return met.only(~met.with_terminal)


@cache
def graph_with(rule, seed=0):
    return smoothed(crowd(seed), (ENCOUNTER,), between_walkers(rule, seed))


def median(tracks, seed=0):
    truths = [walk.truth for walk in crowd(seed).walks]
    errors = [np.hypot(*(a.position - b.position).T) for a, b in zip(tracks, truths, strict=True)]
    return np.median(np.concatenate(errors))


def share_in_region(tracks, seed=0):
    walks = crowd(seed).walks
    return np.mean([in_region(walk.truth, track).mean() for walk, track in zip(walks, tracks, strict=True)])


def extent(tracks, seed=0):
    pairs = [(track.position, walk.truth.position) for track, walk in zip(tracks, crowd(seed).walks, strict=True)]
    return np.mean([np.sqrt(a.var(axis=0).sum() / b.var(axis=0).sum()) for a, b in pairs])


def test_close_encounters_halve_the_error_of_a_known_start_and_the_region_holds():
    none = between_walkers(Rule("none", np.inf, 1.0))
    start = smoothed(crowd(0), (ENCOUNTER,), none)
    assert median(graph_with(NEARBY)) < 0.6 * median(start)
    assert share_in_region(graph_with(NEARBY)) > 0.85


@pytest.mark.thorough
def test_encounters_across_the_hall_contract_the_walks_and_the_region_does_not_hold():
    """A closure says that two walkers were at one place: it pulls them together, however wide its sigma."""
    distant = graph_with(Rule("distant", -75.0, 1.5))
    assert extent(distant) < 0.92 < 0.95 < extent(graph_with(NEARBY))
    assert share_in_region(distant) < 0.7


@pytest.mark.thorough
def test_with_other_references_false_encounters_lose_their_weight_and_the_region_holds():
    walkers = crowd(0, 120.0)
    met = NEARBY.encounters(walkers)
    with_false, false = falsified(walkers, met, 2)
    tracks = smoothed(walkers, REFERENCES, with_false)
    between = ~with_false.with_terminal
    weight, false = closure_weights(tracks, with_false.only(between)), false[between]
    assert np.count_nonzero(false) > 0
    assert weight[false].max() < REPORTS.rejected < np.median(weight[~false])
    inside = [in_region(walk.truth, track).mean() for walk, track in zip(walkers.walks, tracks, strict=True)]
    assert np.mean(inside) > 0.85
