"""Contradictions between the sources of a walk, and the verdict on its estimate: the reasons are data."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from math import isfinite
from typing import Any

from pdr_graph.columns import OneLineRepr
from pdr_graph.errors import count

OK, DOUBTFUL, FAILED = "ok", "doubtful", "failed"
STATES = (OK, DOUBTFUL, FAILED)  # from the best to the worst


@dataclass(frozen=True)
class Contradiction(OneLineRepr):
    """What one source of a walk says against the others, or what keeps its estimate from being determined.

    source: "fixes", "GNSS", "beacons", "plan", "stride", "start", "headings", …; against: the sources that it
    contradicts; amount, unit: how much ("sigma", "m", "share"); text: one sentence for the user; check: what the user
    should check; state: of the estimate with this contradiction, "doubtful", or "failed" if nothing is consistent.
    """

    source: str
    against: str
    amount: float
    unit: str
    text: str
    check: str
    state: str = DOUBTFUL

    def describe(self) -> dict[str, Any]:
        """Return the contradiction for `summary.json`; an unknown amount is None."""
        return asdict(self) | {"amount": self.amount if isfinite(self.amount) else None}

    def _summary(self) -> list[str]:
        return [f"{self.source} against {self.against}", f"{self.amount:.3g} {self.unit}".strip(), self.state]


@dataclass(frozen=True)
class Verdict(OneLineRepr):
    """Whether an estimate can be trusted.

    state: "ok"; "doubtful" if something contradicts something else; "failed" if nothing is consistent. reasons: the
    contradictions, empty for "ok".
    """

    state: str
    reasons: tuple[Contradiction, ...] = ()

    @classmethod
    def of(cls, reasons: Iterable[Contradiction]) -> Verdict:
        """The verdict with these reasons: the worst of their states, "ok" without any. The worst reasons come first."""
        ordered = sorted(dict.fromkeys(reasons), key=lambda reason: -STATES.index(reason.state))
        return cls(ordered[0].state if ordered else OK, tuple(ordered))

    @property
    def ok(self) -> bool:
        """True if nothing contradicts the estimate."""
        return self.state == OK

    def describe(self) -> dict[str, Any]:
        """Return the verdict for `summary.json`."""
        return {"state": self.state, "reasons": [reason.describe() for reason in self.reasons]}

    def __str__(self) -> str:
        return f"{self.state}: {'; '.join(reason.text for reason in self.reasons) or 'no reason for doubt found'}"

    def _summary(self) -> list[str]:
        return [self.state, *([count(len(self.reasons), "reason")] if self.reasons else [])]
