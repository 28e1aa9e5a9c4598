"""Hypotheses about sources that err: their words, their evidence, and their review while a walk goes on."""

from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace

import numpy as np
import pytest
from tiers import thorough
from walks import (
    dead_reckon,
    drawn_beside_beacons,
    drawn_with_a_receiver,
    fixes_at,
    pushed,
    pushing,
    straight,
)

from pdr_graph import WalkGraph, smooth
from pdr_graph.estimation.ambiguity.bank import Findings, HypothesisBank, contradictions, pruned, weighed
from pdr_graph.estimation.ambiguity.hypothesis import Hypothesis, Proposal
from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.estimation.live.review import compare_sources
from pdr_graph.estimation.optimizer import solve_robust
from pdr_graph.priors import DOUBTS, PRICES, changed
from pdr_graph.storage import decode, encode

GNSS = ("GNSS",)
TEXTS = [
    ("beacons swapped", ("b", "e"), (), "beacons", "the positions of b and e are swapped in the list"),
    ("beacons moved", ("b4",), (), "beacons", "b4 is not where the list says"),
    ("beacons of another place", (), (), "beacons", "the list of beacons is of another place"),
    ("beacons displaced", (), (31.0,), "beacons", "all positions in the list of beacons are off by about 31 m"),
    (
        "gnss_bias not following",
        ("A", "B"),
        (2.4,),
        "A and B",
        "the positions of A and B do not follow the walk, and are off by about 2.4 times their sigma",
    ),
    ("gnss_bias larger", GNSS, (2.0,), "GNSS", "the errors of GNSS are about 2 times what it states"),
    ("fixes wrong", (7,), (60.0, 3.0, 4.0), "fixes", "the fix at 60 s, (3, 4) m, is wrong"),
    ("headings wrong start", (), (), "start", "the start heading is wrong"),
    ("headings off to the left", (), (np.pi / 4,), "headings", "the compass is off by about 45° to the left"),
    ("plan wrong", (), (), "plan", "the floor plan does not fit the walk and the positions on it"),
    ("plan displaced", (), (7.0,), "plan", "the floor plan, or the only position on it, is displaced by about 7 m"),
]
HYPOTHESES = [Hypothesis(tuple(kind.split(" ", 1)), *described) for kind, *described, _, _ in TEXTS]


@pytest.mark.parametrize("n", range(len(TEXTS)), ids=[text for *_, text in TEXTS])
def test_what_a_user_reads_is_made_of_kind_instances_and_parameter(n):
    wording = HYPOTHESES[n].wording
    assert (wording.source, wording.text) == TEXTS[n][-2:]
    assert wording.check


def test_a_hypothesis_is_stored_without_loss():
    findings = Findings(tuple(HYPOTHESES), (replace(HYPOTHESES[0], price=5.5),))
    again = decode(encode(findings), Findings)
    assert again == findings
    assert [claim.parameter for claim in again.adopted] == [claim.parameter for claim in findings.adopted]
    assert again.possible[0].price == 5.5


def assuming(*hypotheses):
    return SimpleNamespace(assumed=hypotheses)


def test_the_sizes_of_one_claim_are_told_together_with_the_size_of_the_best():
    twice, four = (Hypothesis(("gnss_bias", "larger"), GNSS, (k,)) for k in (2.0, 4.0))
    optima = [assuming(four), assuming(twice), assuming()]
    (found,) = contradictions(optima, np.array([0.4, 0.3, 0.3]))
    assert found.amount == pytest.approx(0.7)
    assert "about 4 times" in found.text


@pytest.fixture(scope="module")
def solved():
    steps = straight(60)
    track = dead_reckon(steps)
    fixes = fixes_at(track.time[3::10], track.position[3::10], 1.0)
    return solve_robust(WalkGraph(steps, fixes))


def test_of_equal_solutions_the_first_is_kept_and_other_claims_stay(solved):
    moved, gone = (Hypothesis(("beacons", "moved"), (label,), price=price) for label, price in (("b", 1.0), ("c", 9.0)))
    one, other = weighed(solved, solved, moved), weighed(solved, solved, gone)
    assert pruned([other, one, solved, solved], DOUBTS.unlikely) == [solved, one]


def test_evidence_is_cost_information_and_price(solved):
    """A fix left out: the walk's cost falls, it is less certain, and its price is paid."""
    bank = HypothesisBank(solved)
    fixes = solved.graph.positions
    without = fixes.classified(fixes.outlier, fixes.held & (fixes.number != 2))
    new = bank.solve(solved, Proposal(Hypothesis(("fixes", "wrong"), (2,), (0.0, 0.0, 0.0), 6.0), (without,)))
    information = new.solution.log_determinant - solved.solution.log_determinant
    assert information < 0
    assert new.surprise == pytest.approx(new.at.surprise + information + 6.0)
    assert [claim.changes for claim in new.assumed] == [("fixes",)]


def fix_wrong(number):
    return Hypothesis(("fixes", "wrong"), (number,), (60.0, 3.0, 4.0))


def off(factor, name="GNSS"):
    return Hypothesis(("gnss_bias", "larger"), (name,), (factor,), price=factor)


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


# While a walk goes on

STEPS = 160


def swapped(seed=0):
    """A walk beside beacons whose list has the two that are farthest apart swapped."""
    steps, fixes, levels, truth = drawn_beside_beacons(STEPS, seed, wrong=0.5)
    apart = np.hypot(*(levels.position[:, None] - levels.position).transpose(2, 0, 1))
    a, b = np.unravel_index(np.argmax(apart), apart.shape)
    position = levels.position.copy()
    position[[a, b]] = position[[b, a]]
    return steps, [fixes, replace(levels, position=position)], truth, {levels.label[a], levels.label[b]}


@cache
def plainly_followed(walk):
    steps, data, *_ = walk()
    return pushed(LiveSmoother(lag=30.0), steps, *data)


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
    live = pushed(LiveSmoother(lag=30.0), steps, fixes, levels)
    assert live.ambiguity.findings.contradictions == ()
    assert not any(claim.kind[0] == "beacons" for claim in live.ambiguity.findings.adopted)


def with_a_receiver():
    steps, fixes, _ = drawn_with_a_receiver(120, 1)
    return steps, [fixes]


@pytest.mark.parametrize("walk", [thorough(swapped), with_a_receiver])
def test_idle_moments_change_nothing(walk):
    """A review between pushes: the same walk, bit by bit."""
    steps, data, *_ = walk()
    plain, rested = plainly_followed(walk), LiveSmoother(lag=30.0)
    for _ in pushing(rested, steps, *data):
        rested.review()
    assert rested.ambiguity.findings.same_decisions(plain.ambiguity.findings)
    assert np.array_equal(rested.graph.window.pose, plain.graph.window.pose)
    assert np.array_equal(rested.graph.excess.covariance, plain.graph.excess.covariance)


def test_a_lone_receiver_has_the_batchs_region():
    """Nothing tells how far off it is: the variance stated at the last keyframe is the batch's, not the solver's."""
    steps, fixes, _ = drawn_with_a_receiver(160, 2)
    with changed(PRICES, astray=0.7):
        live = pushed(LiveSmoother(), steps, fixes)
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


def test_the_past_that_is_compared_is_bounded_and_may_be_forgotten_before_the_answer():
    """It has no more than DOUBTS.span, and no older measurement; decisions name rows that are not there any more.

    A silence of minutes between a question and its answer, or a late fix, may change the rows of the history.
    """
    steps, fixes, _ = drawn_with_a_receiver(300, 3)
    live = pushed(LiveSmoother(lag=30.0), steps, fixes)
    history, findings = live.ambiguity.history, Findings((replace(fix_wrong(0), changes=("fixes",)),))
    question = history.question(live.graph.window.times[-1], live.graph.prior, findings, {}, False)
    graph = question.args[0]()
    assert graph.steps.end - graph.steps.start < DOUBTS.span + 2
    assert graph.fixes.time.min() > graph.steps.start - 10

    numbers = history.log.all_numbers(np.inf)["fixes"].tolist()
    history.log.forget(np.inf)
    assert numbers[0] > 0
    assert set(question().decisions["fixes"]["number"].tolist()) <= set(numbers)
