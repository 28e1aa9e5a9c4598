"""Hypotheses about what a source of a walk gets wrong: their identity, their prices, and their words for the user.

A hypothesis is the same claim in every solution and every review if its kind and its instances are equal; how large the
error is may differ. Wording are made from it on output only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from pdr_graph.types import Index

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.base import Measurement, State


@dataclass(frozen=True)
class Hypothesis:
    """An assumption about how a source errs beyond what it states. Equal if it is the same claim.

    kind: the measurement kind, or "plan", and the type of error; instances: labels of beacons, permanent numbers of
    fixes, names of receivers; parameter: how large the error is, and for a fix its time and place.
    price: see above, with the normaliser of wider priors [nats]; changes: names of the measurement kinds that the
    hypothesis changes; estimate: what the walk then says about it, for the user; lasting: it holds for the whole walk,
    beyond the minutes that a review knows.
    """

    kind: tuple[str, str]
    instances: tuple[str | int, ...] = ()
    parameter: tuple[float, ...] = field(default=(), compare=False)
    price: float = field(default=0.0, compare=False)
    changes: tuple[str, ...] = field(default=(), compare=False)
    estimate: tuple[float, ...] = field(default=(), compare=False)
    lasting: bool = field(default=True, compare=False)

    @property
    def label(self) -> str:
        """The claim for programs."""
        return ": ".join(self.kind)

    @property
    def wording(self) -> Wording:
        """What the hypothesis says, for the user."""
        return WORDINGS[self.kind[0]](self)

    def numbered(self, numbers: Mapping[str, Index]) -> Hypothesis:
        """Replace row numbers among the instances by permanent numbers ``(n,)``, which are given by kind."""
        of_rows = numbers.get(self.kind[0])
        if of_rows is None:
            return self
        instances = tuple(int(of_rows[n]) if isinstance(n, int) else n for n in self.instances)
        return replace(self, instances=instances)


@dataclass(frozen=True)
class Wording:
    """A hypothesis for the user. source: its name; text: what errs; check: what to check, "" if nothing."""

    source: str
    text: str
    check: str = ""


@dataclass(frozen=True)
class Proposal:
    """A hypothesis to be solved.

    measurements: the kinds that it changes, under the hypothesis; start: where the search starts, by default at the
    walk so far; fresh: symbols of the variables that do not keep their values.
    anew: the search starts as the first search did.
    another_walker: the walk has the other prior of `Prior.another`, and its measurements are classified anew.
    """

    hypothesis: Hypothesis
    measurements: tuple[Measurement, ...]
    start: State | None = None
    fresh: tuple[str, ...] = ()
    anew: bool = False
    another_walker: bool = False


WORDINGS: dict[str, Callable[[Hypothesis], Wording]] = {}


def wording_of(kind: str) -> Callable[[Callable[[Hypothesis], Wording]], Callable[[Hypothesis], Wording]]:
    """Decorate the function that words all hypotheses about one kind."""

    def registered(function: Callable[[Hypothesis], Wording]) -> Callable[[Hypothesis], Wording]:
        WORDINGS[kind] = function
        return function

    return registered
