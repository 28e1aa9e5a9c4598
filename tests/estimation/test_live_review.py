"""While a walk goes on, its sources are compared as in the batch: wrong lists are found, what stays open is stated."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from test_one_engine import started, walking
from walks import drawn_beside_beacons, drawn_with_a_receiver

from pdr_graph import smooth
from pdr_graph.estimation.ambiguity.bank import Findings, HypothesisBank
from pdr_graph.estimation.ambiguity.hypothesis import Hypothesis
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.live.finalization import Excess
from pdr_graph.estimation.live.review import compare_sources
from pdr_graph.priors import DOUBTS

STEPS = 160


def swapped(seed=0):
    """A walk beside beacons whose list has the two that are farthest apart swapped."""
    steps, fixes, levels, truth = drawn_beside_beacons(STEPS, seed, wrong=0.5)
    apart = np.hypot(*(levels.position[:, None] - levels.position).transpose(2, 0, 1))
    a, b = np.unravel_index(np.argmax(apart), apart.shape)
    position = levels.position.copy()
    position[[a, b]] = position[[b, a]]
    return steps, [fixes, replace(levels, position=position)], truth, {levels.label[a], levels.label[b]}


def followed(steps, data, lag=30.0, between=None):
    live = started(None, lag)
    for n in range(len(steps)):
        walking(live, steps, data, begin=n, end=n + 1)
        if between:
            live = between(live) or live
    return live


@cache
def plainly_followed(walk):
    steps, data, *_ = walk()
    return followed(steps, data)


def test_a_swapped_pair_is_found_while_the_walk_goes_on():
    """Before its end the places of the two are exchanged, the contradiction names both, and the window is right."""
    _, _, truth, labels = swapped()
    live = plainly_followed(swapped)
    assert [reason.source for reason in live.ambiguity.findings.contradictions] == ["beacons"]
    assert all(label in live.ambiguity.findings.contradictions[0].text for label in labels)
    (beacons,) = [kind for kind in live.graph.factors.measurements if kind.name == "beacons"]
    moved = {
        label
        for label, at, listed in zip(beacons.listed.label, beacons.position, beacons.listed.position, strict=True)
        if (at != listed).any()
    }
    assert moved == labels
    end = truth.position[np.searchsorted(truth.time, live.graph.window.times[-1])]
    assert np.hypot(*(live.graph.window.pose[-1, :2] - end)) < 4.0


def test_a_correct_list_stays_as_it_is():
    steps, fixes, levels, _ = drawn_beside_beacons(STEPS, 0, wrong=0.5)
    live = followed(steps, [fixes, levels])
    assert live.ambiguity.findings.contradictions == ()
    assert not any(claim.kind[0] == "beacons" for claim in live.ambiguity.findings.adopted)


def with_a_receiver():
    steps, fixes, _ = drawn_with_a_receiver(120, 1)
    return steps, [fixes]


@pytest.mark.parametrize("walk", [swapped, with_a_receiver])
def test_idle_moments_change_nothing(walk):
    """A review between pushes: the same walk, bit by bit."""
    steps, data, *_ = walk()

    def idle(live):
        live.review()

    plain, rested = plainly_followed(walk), followed(steps, data, between=idle)
    assert rested.ambiguity.findings.same_decisions(plain.ambiguity.findings)
    assert np.array_equal(rested.graph.window.pose, plain.graph.window.pose)
    assert np.array_equal(rested.graph.excess.covariance, plain.graph.excess.covariance)


def test_a_lone_receiver_has_the_batchs_region():
    """Nothing tells how far off it is: the variance stated at the last keyframe is the batch's, not the solver's."""
    steps, fixes, _ = drawn_with_a_receiver(160, 2)
    live = followed(steps, [fixes], lag=np.inf)
    batch = smooth(WalkGraph(steps, fixes)).trajectory.covariance[-1, :2, :2]
    stated, solved = live.graph.covariance(-1)[:2, :2], live.graph.solved_covariance(-1)[:2, :2]
    assert np.trace(stated) == pytest.approx(np.trace(batch), rel=0.25)
    assert np.trace(solved) < 0.7 * np.trace(batch)
    assert np.trace(live.output.belief().covariance[:2, :2]) == pytest.approx(np.trace(stated), rel=0.3)


def test_an_adopted_assumption_stays_without_evidence_and_goes_against_it():
    """A pair once found swapped, in a past without its levels, and in one in which the list is right."""
    steps, (fixes, levels), _, _ = swapped()
    first = compare_sources(partial(WalkGraph, steps, fixes, levels=levels), Findings(), {}, False)
    assert len(first.findings.adopted) == 1
    silent = replace(levels, time=levels.time[:4], beacon=levels.beacon[:4], rssi=levels.rssi[:4])
    later = compare_sources(partial(WalkGraph, steps, fixes, levels=silent), first.findings, first.decisions, False)
    assert later.findings.same_decisions(first.findings)
    right = replace(levels, position=drawn_beside_beacons(STEPS, 0, wrong=0.5)[2].position)
    places = np.column_stack([levels.position, np.zeros(len(levels.position))])
    wrong = {"beacons": first.decisions["beacons"] | {"position": levels.position, "prior": places}}
    after = compare_sources(partial(WalkGraph, steps, fixes, levels=right), first.findings, wrong, False)
    assert after.findings.adopted == ()


def fix_wrong(number):
    return Hypothesis(("fixes", "wrong"), (number,), (60.0, 3.0, 4.0))


def off(factor, name="GNSS"):
    return Hypothesis(("gnss_bias", "throughout"), (name,), (factor,), price=factor)


def displaced(by):
    return Hypothesis(("beacons", "displaced"), (), (by,), 5.5, ("beacons",))


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        (Hypothesis(("beacons", "moved"), ("b4",)), Hypothesis(("beacons", "moved"), ("b6",)), False),
        (Hypothesis(("beacons", "moved"), ("b4",)), Hypothesis(("beacons", "swapped"), ("b4",)), False),
        (fix_wrong(7), fix_wrong(8), False),
        (displaced(44.0), displaced(41.0), True),
        (off(2.0), off(5.0), True),
        (off(2.0), off(2.0, "Wi-Fi"), False),
    ],
)
def test_hypotheses_are_the_same_claim_if_only_the_size_of_the_error_differs(one, other, same):
    assert (one == other) == same
    assert len({one, other}) == 2 - same


def test_row_numbers_of_a_hypothesis_become_permanent():
    numbers = {"fixes": np.array([40, 41, 45]), "beacons": np.array([3])}
    assert fix_wrong(2).numbered(numbers) == fix_wrong(45)
    assert Hypothesis(("beacons", "moved"), ("b4",)).numbered(numbers).instances == ("b4",)
    assert off(2.0).numbered(numbers) == off(2.0)


@pytest.mark.parametrize("competed", [True, False])
def test_what_competes_with_an_adopted_hypothesis_stays_possible(monkeypatch, competed):
    """Either the list or the receiver is off: the list fits better by 1.3 nats, although the receiver was adopted.

    If the list was not possible when the receiver was adopted, the older evidence is for the receiver alone.
    """
    steps, (fixes, levels), _, _ = swapped()
    list_off, receiver_off = displaced(31.0), replace(off(5.0), changes=())

    def explained(bank):
        costs = {list_off: 0.0, receiver_off: 1.3}
        first = bank.first
        bank.members = [replace(first, assumed=(h,), burden=first.burden + cost) for h, cost in costs.items()]
        return bank

    monkeypatch.setattr(HypothesisBank, "explain", explained)
    rivals = (displaced(29.0),) * competed + (receiver_off,)
    before = Findings((receiver_off,), rivals)
    found = compare_sources(partial(WalkGraph, steps, fixes, levels=levels), before, {}, False).findings
    (contradiction,) = found.contradictions
    if competed:
        assert found.adopted == (list_off,)
        assert contradiction.amount == pytest.approx(1 / (1 + np.exp(-1.3)), abs=0.001)
        assert set(found.possible) == set(rivals)
    else:
        assert found.adopted == (receiver_off,)
        assert contradiction.amount > 0.99


def test_the_past_that_is_compared_is_bounded():
    """There are no more than those of DOUBTS.span, and no older measurement."""
    steps, fixes, _ = drawn_with_a_receiver(300, 3)
    live = followed(steps, [fixes])
    graph = live.ambiguity.history.question(live.graph.window.times[-1], live.graph.prior, Findings(), {}, False).args[
        0
    ]()
    assert graph.steps.end - graph.steps.start < DOUBTS.span + 2
    assert graph.fixes.time.min() > graph.steps.start - 10


def test_decisions_name_rows_that_are_dropped_before_the_answer_is_used():
    """A silence of minutes between a question and its answer, or a late fix, may change the rows of the history."""
    steps, fixes, _ = drawn_with_a_receiver(300, 3)
    live = followed(steps, [fixes])
    before = Findings((replace(fix_wrong(0), changes=("fixes",)),))
    question = live.ambiguity.history.question(live.graph.window.times[-1], live.graph.prior, before, {}, False)
    numbers = live.ambiguity.history.log.all_numbers(np.inf)["fixes"].tolist()
    live.ambiguity.history.log.forget(np.inf)
    assert numbers[0] > 0
    assert set(question().decisions["fixes"]["number"].tolist()) <= set(numbers)


def test_excess_is_constant_beyond_its_times():
    excess = Excess(np.array([1.0, 2.0]), np.array([np.eye(3), 3 * np.eye(3)]))
    assert excess.at(np.array([0.0, 1.5, 9.0]))[:, 0, 0] == pytest.approx([1.0, 2.0, 3.0])
