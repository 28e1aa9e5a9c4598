"""Kinds of measurements: one file, one object each. This list is all that the rest of the package knows of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pdr_graph.estimation.factors.base import AnyArray, Measurement
from pdr_graph.estimation.factors.beacon_rssi import BeaconRssiFactor
from pdr_graph.estimation.factors.fixes import FixFactor
from pdr_graph.estimation.factors.gnss_bias import GnssBias
from pdr_graph.estimation.factors.heading_prior import HeadingFactor
from pdr_graph.estimation.factors.loop_closure import LoopClosureFactor
from pdr_graph.estimation.factors.ranging import RangeFactor
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.measurements import Closures, Levels, Ranges
from pdr_graph.types import Fixes, Headings, Index, Steps

# What each type of data makes: the kind made from the data, then kinds beside it, made from the first
KINDS: dict[type, tuple[Any, ...]] = {
    Fixes: (FixFactor, GnssBias),
    Headings: (HeadingFactor,),
    Levels: (BeaconRssiFactor,),
    Closures: (LoopClosureFactor,),
    Ranges: (RangeFactor,),
}


def kind_of(data: Any) -> type[Measurement]:
    """The kind of measurement that a type of data makes. Raises TypeError for types that are not in `KINDS`."""
    kinds = KINDS.get(type(data))
    if kinds is None:
        names = ", ".join(sorted(known.__name__ for known in KINDS))
        raise TypeError(f"measurements: found {type(data).__name__}, expected one of {names}")
    return kinds[0]


def measurements_of(
    data: Any, steps: Steps, prior: Prior, number: Index | None = None, decisions: Mapping[str, AnyArray] | None = None
) -> list[Measurement]:
    """The factors of one walk from data of one type.

    number: ``(n,)`` of the instances, 0, 1, … by default; decisions: what was decided about instances before, while a
    walk goes on.
    """
    kind: Any = kind_of(data)
    own = kind.of(data, steps, prior, number)
    own = own if decisions is None else own.continued(decisions)
    return [own, *(beside.of(own, steps) for beside in KINDS[type(data)][1:])]
