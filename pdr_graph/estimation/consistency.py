"""Consistency of an estimate: do its sources agree? The verdict on a walk, offline and live."""

from __future__ import annotations

from pdr_graph.contradiction import FAILED, Contradiction, Verdict
from pdr_graph.estimation.results import is_a_guess, used_fixes
from pdr_graph.types import Estimate


def verdict(estimate: Estimate) -> Verdict:
    """The verdict on an estimate: its own contradictions, and those that its reports show."""
    return Verdict.of((*estimate.contradictions, *_rejected_fixes(estimate)))


def _rejected_fixes(estimate: Estimate) -> tuple[Contradiction, ...]:
    if not used_fixes(estimate.fixes) or not is_a_guess(estimate.fixes):
        return ()
    text = "half of the fixes contradict the steps and one another: where the walk was is a guess"
    return (Contradiction("fixes", "the steps and one another", 0.5, "share", text, "the fixes", FAILED),)
