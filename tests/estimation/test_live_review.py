"""While a walk goes on, its sources are compared as in the batch: wrong lists are found, what stays open is stated."""

import re
from copy import deepcopy
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from test_one_engine import started, walking
from walks import drawn_beside_beacons, drawn_with_a_receiver

from pdr_graph import smooth
from pdr_graph.estimation.factors.base import Hypothesis
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.live import review
from pdr_graph.estimation.live.history import SPAN
from pdr_graph.estimation.live.review import Assumption, Excess, Findings, Question
from pdr_graph.storage import decode, encode

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
    assert not any("list" in text for text in live.ambiguity.findings.texts)


def with_a_receiver():
    steps, fixes, _ = drawn_with_a_receiver(120, 1)
    return steps, [fixes]


@pytest.mark.parametrize("walk", [swapped, with_a_receiver])
def test_idle_moments_and_checkpoints_change_nothing(walk):
    """A review between pushes, and a state that was encoded and restored after each 40th step: the same walk."""
    steps, data, *_ = walk()
    count = iter(range(10**6))

    def idle(live):
        live.review()

    def restored(live):
        if next(count) % 40:
            return live
        again = started(None, 30.0)
        again.restore(deepcopy(live.checkpoint()))
        return again

    plain = plainly_followed(walk)
    rested, resumed = (followed(steps, data, between=between) for between in (idle, restored))
    for other, limit in ((rested, 0.0), (resumed, 0.6)):  # linearised elsewhere, at sigmas of 5 m
        assert other.ambiguity.findings.texts == plain.ambiguity.findings.texts
        assert np.abs(other.graph.window.pose - plain.graph.window.pose)[:, :2].max() <= limit
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
    first = Question(partial(WalkGraph, steps, fixes, levels=levels), Findings(), {}, False).answer()
    assert len(first.findings.texts) == 1
    silent = replace(levels, time=levels.time[:4], beacon=levels.beacon[:4], rssi=levels.rssi[:4])
    later = Question(partial(WalkGraph, steps, fixes, levels=silent), first.findings, first.decisions, False).answer()
    assert later.findings.texts == first.findings.texts
    right = replace(levels, position=drawn_beside_beacons(STEPS, 0, wrong=0.5)[2].position)
    places = np.column_stack([levels.position, np.zeros(len(levels.position))])
    wrong = {"beacons": first.decisions["beacons"] | {"position": levels.position, "prior": places}}
    after = Question(partial(WalkGraph, steps, fixes, levels=right), first.findings, wrong, False).answer()
    assert after.findings.texts == frozenset()


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("b4 is not where the list says", "b6 is not where the list says", False),
        ("the fix at 60 s, (3, 4) m, is wrong", "the fix at 90 s, (3, 4) m, is wrong", False),
        ("all positions in the list of beacons are off by about 44 m", "{} 41 m", True),
        ("GNSS is off throughout by up to 2 times what it states", "{} 5 times what it states", True),
    ],
)
def test_assumptions_are_the_same_if_only_the_size_of_the_error_differs(one, other, same):
    """Evidence for one beacon or fix is none for another whose name has other digits."""
    other = other.format(re.split(r" \d", one)[0])
    assert (review._sizeless(one) == review._sizeless(other)) == same


@pytest.mark.parametrize("competed", [True, False])
def test_what_competes_with_an_adopted_assumption_stays_possible(monkeypatch, competed):
    """Either the list or the receiver is off: the list fits better by 1.3 nats, although the receiver was adopted.

    If the list was not possible when the receiver was adopted, the older evidence is for the receiver alone.
    """
    steps, (fixes, levels), _, _ = swapped()
    off = {
        "list": Hypothesis((), 5.5, "beacons", "the list is off by about 31 m", "the list"),
        "receiver": Hypothesis((), 5.5, "fixes", "the receiver is off", "the receiver"),
    }

    def explained(first):
        costs = {"list": 0.0, "receiver": 1.3}
        return [replace(first, assumed=(off[name],), burden=first.burden + cost) for name, cost in costs.items()]

    monkeypatch.setattr(review, "explanations", explained)
    rivals = ("the list is off by about # m",) * competed + ("the receiver is off",)
    before = Findings((Assumption.of(off["receiver"]),), (), rivals)
    found = Question(partial(WalkGraph, steps, fixes, levels=levels), before, {}, False).answer().findings
    (contradiction,) = found.contradictions
    if competed:
        assert found.texts == {"the list is off by about 31 m"}
        assert contradiction.amount == pytest.approx(1 / (1 + np.exp(-1.3)), abs=0.001)
        assert set(found.rivals) == set(rivals)
    else:
        assert found.texts == {"the receiver is off"}
        assert contradiction.amount > 0.99


def test_a_review_is_encoded_without_loss():
    steps, data, *_ = swapped()
    answer = Question(partial(WalkGraph.of, steps, data), Findings(), {}, False).answer()
    again = decode(encode(answer), type(answer))
    assert again.findings == answer.findings
    assert np.array_equal(again.excess.covariance, answer.excess.covariance)


def test_the_past_that_is_compared_is_bounded():
    """There are no more than those of SPAN, and no older measurement."""
    steps, fixes, _ = drawn_with_a_receiver(300, 3)
    live = followed(steps, [fixes])
    graph = live.ambiguity.history.question(
        live.graph.window.times[-1], live.graph.prior, Findings(), {}, False
    ).graph()
    assert graph.steps.end - graph.steps.start < SPAN + 2
    assert graph.fixes.time.min() > graph.steps.start - 10


def test_decisions_name_rows_that_are_dropped_before_the_answer_is_used():
    """A silence of minutes between a question and its answer, or a late fix, may change the rows of the history."""
    steps, fixes, _ = drawn_with_a_receiver(300, 3)
    live = followed(steps, [fixes])
    before = Findings((Assumption(("fixes",), 5.5, "", "", ""),))
    question = live.ambiguity.history.question(live.graph.window.times[-1], live.graph.prior, before, {}, False)
    numbers = live.ambiguity.history.log.numbers("fixes").tolist()
    live.ambiguity.history.log.forget(np.inf)
    assert numbers[0] > 0
    assert set(question.answer().decisions["fixes"]["number"].tolist()) <= set(numbers)


def test_excess_is_constant_beyond_its_times():
    excess = Excess(np.array([1.0, 2.0]), np.array([np.eye(3), 3 * np.eye(3)]))
    assert excess.at(np.array([0.0, 1.5, 9.0]))[:, 0, 0] == pytest.approx([1.0, 2.0, 3.0])
