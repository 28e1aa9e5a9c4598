"""Hypotheses about what a source of a walk gets wrong: their identity, their prices, and their words for the user.

A hypothesis is the same claim in every solution and every review if its kind and its instances are equal; how large the
error is may differ. Wording are made from it on output only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import log
from typing import TYPE_CHECKING

from pdr_graph.types import Index

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.base import Measurement, State

# Prices [nats]: negative log odds of the error, before a measurement is seen, against a source without it
WORSE = ((2.0, 0.7), (5.0, 2.3))  # a receiver that is off throughout by 2 or 5 times what it states: 1 in 2, 1 in 10
LARGER = ((2.0, 1.5), (4.0, 3.0))  # all errors of a receiver are 2 or 4 times what it states: 1 in 5, 1 in 20
WRONG_LIST = 5.5  # two entries of a list of beacons are swapped, one is elsewhere, or all: 1 in 250; judgement
WRONG_ORIGIN = 1.0  # a list is displaced as a whole: as probable as a receiver that is as far off throughout
WRONG_FIX = 6.0  # a fix is wrong: 1 in 100, that lies anywhere within about 5 sigma
WRONG_START = -log(0.1)  # the start heading of a user is wrong: 1 in 10; judgement
COMPASS_OFF = -log(0.07)  # a compass is off to one side throughout: 7 in 100; of 21 real headings none was
WRONG_PLAN = 6.0  # a plan does not fit, at least; right walls add 0 to 4.5 nats on 60 simulated and 45 real walks
ADDED_BY_WALLS = 0.25  # [nats] the same per measurement, of long walks and frequent fixes: those that the walls amount
# to, and the cost without walls; right walls add 0.12 to 0.19 in laps of 12 min and more, and where fixes at 1 Hz have
# correlated errors; 0.3 to 2.3 where the plan is 3 m or more beside many fixes
DISPLACED_PLAN = 3.0  # a plan, or the only position on it, is some metres off; then walks cost 0 to 5 nats, simulated


@dataclass(frozen=True)
class Hypothesis:
    """An assumption about how a source errs beyond what it states. Equal if it is the same claim.

    kind: the measurement kind, or "plan", and the type of error; instances: labels of beacons, permanent numbers of
    fixes, names of receivers; parameter: how large the error is, and for a fix its time and place.
    price: see above, with the normaliser of wider priors [nats]; changes: names of the measurement kinds that the
    hypothesis changes.
    """

    kind: tuple[str, str]
    instances: tuple[str | int, ...] = ()
    parameter: tuple[float, ...] = field(default=(), compare=False)
    price: float = field(default=0.0, compare=False)
    changes: tuple[str, ...] = field(default=(), compare=False)

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
    """

    hypothesis: Hypothesis
    measurements: tuple[Measurement, ...]
    start: State | None = None
    fresh: tuple[str, ...] = ()


WORDINGS: dict[str, Callable[[Hypothesis], Wording]] = {}


def wording_of(kind: str) -> Callable[[Callable[[Hypothesis], Wording]], Callable[[Hypothesis], Wording]]:
    """Decorate the function that words all hypotheses about one kind."""

    def registered(function: Callable[[Hypothesis], Wording]) -> Callable[[Hypothesis], Wording]:
        WORDINGS[kind] = function
        return function

    return registered
