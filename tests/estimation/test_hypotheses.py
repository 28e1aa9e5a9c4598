"""Hypotheses about sources that err: what the user reads, and which solutions of a bank remain."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from walks import dead_reckon, fixes_at, steps_of

from pdr_graph import WalkGraph
from pdr_graph.estimation.ambiguity.bank import Findings, HypothesisBank, contradictions, pruned, weighed
from pdr_graph.estimation.ambiguity.hypothesis import Hypothesis, Proposal
from pdr_graph.estimation.optimizer import solve_robust
from pdr_graph.priors import DOUBTS
from pdr_graph.storage import decode, encode

GNSS = ("GNSS",)
TEXTS = [
    (Hypothesis(("beacons", "swapped"), ("b", "e")), "beacons", "the positions of b and e are swapped in the list"),
    (Hypothesis(("beacons", "moved"), ("b4",)), "beacons", "b4 is not where the list says"),
    (Hypothesis(("beacons", "of another place")), "beacons", "the list of beacons is of another place"),
    (
        Hypothesis(("beacons", "displaced"), parameter=(31.0,)),
        "beacons",
        "all positions in the list of beacons are off by about 31 m",
    ),
    (
        Hypothesis(("gnss_bias", "throughout"), ("GNSS", "Wi-Fi"), (5.0,)),
        "GNSS and Wi-Fi",
        "GNSS and Wi-Fi is off throughout by up to 5 times what it states",
    ),
    (Hypothesis(("gnss_bias", "larger"), GNSS, (2.0,)), "GNSS", "the errors of GNSS are about 2 times what it states"),
    (
        Hypothesis(("fixes", "wrong"), (7,), (60.0, 3.0, 4.0)),
        "fixes",
        "the fix at 60 s, (3, 4) m, is wrong",
    ),
    (Hypothesis(("headings", "wrong start")), "start", "the start heading is wrong"),
    (
        Hypothesis(("headings", "off to the left"), parameter=(np.pi / 4,)),
        "headings",
        "the compass is off by about 45° to the left",
    ),
    (Hypothesis(("plan", "wrong")), "plan", "the floor plan does not fit the walk and the positions on it"),
    (
        Hypothesis(("plan", "displaced"), parameter=(7.0,)),
        "plan",
        "the floor plan, or the only position on it, is displaced by about 7 m",
    ),
]


@pytest.mark.parametrize(("hypothesis", "source", "text"), TEXTS, ids=lambda one: str(one)[:40])
def test_what_a_user_reads_is_made_of_kind_instances_and_parameter(hypothesis, source, text):
    wording = hypothesis.wording
    assert (wording.source, wording.text) == (source, text)
    assert wording.check


def test_a_receiver_that_is_off_by_twice_what_it_states_is_usual():
    assert not Hypothesis(("gnss_bias", "throughout"), GNSS, (2.0,)).wording.check


def test_a_hypothesis_is_stored_without_loss():
    findings = Findings(tuple(hypothesis for hypothesis, _, _ in TEXTS), (replace(TEXTS[0][0], price=5.5),))
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


def test_a_size_that_needs_no_check_adds_nothing():
    twice, five = (Hypothesis(("gnss_bias", "throughout"), GNSS, (k,)) for k in (2.0, 5.0))
    assert contradictions([assuming(twice), assuming(five)], np.array([0.7, 0.3])) == ()


@pytest.fixture(scope="module")
def solved():
    steps = steps_of(np.full(60, 0.7), np.zeros(60))
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
