"""The measurement kinds: one file and one class each. The rest of the package loops over `KINDS` and names none."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pdr_graph.estimation.factors.base import AnyArray, Measurement
from pdr_graph.estimation.factors.beacon_rssi import BeaconRssiFactor
from pdr_graph.estimation.factors.corridor import CorridorFactor
from pdr_graph.estimation.factors.fixes import FixFactor
from pdr_graph.estimation.factors.gnss_bias import GnssBias
from pdr_graph.estimation.factors.heading_prior import HeadingFactor
from pdr_graph.estimation.factors.loop_closure import LoopClosureFactor
from pdr_graph.estimation.factors.ranging import RangeFactor
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.factors.turns import TurnFactor
from pdr_graph.floor.building import FloorSequence
from pdr_graph.measurements import Closures, Levels, Ranges
from pdr_graph.types import Fixes, Headings, Index, Steps

# Type of data: the kind made from it, then kinds that are made from the first
KINDS: dict[type, tuple[Any, ...]] = {
    Fixes: (FixFactor, GnssBias),
    Headings: (HeadingFactor,),
    Levels: (BeaconRssiFactor,),
    Closures: (LoopClosureFactor,),
    Ranges: (RangeFactor,),
}

CORRIDORS = {"directions": CorridorFactor, "turns": TurnFactor}  # by `Prior.corridors`


def kind_of(data: Any) -> type[Measurement]:
    """The kind of measurement that a type of data makes. Raises TypeError for types that are not in `KINDS`."""
    kinds = KINDS.get(type(data))
    if kinds is None:
        names = ", ".join(sorted(data_type.__name__ for data_type in KINDS))
        raise TypeError(f"measurements: found {type(data).__name__}, expected one of {names}")
    return kinds[0]


def measurements_of(
    data: Any,
    steps: Steps,
    prior: Prior,
    number: Index | None = None,
    decisions: Mapping[str, Mapping[str, AnyArray]] | None = None,
) -> list[Measurement]:
    """The measurement kinds of one walk from data of one type.

    number: ``(n,)`` permanent numbers of the instances, 0, 1, … by default; decisions: earlier decisions, by
    kind, for a walk under way.
    """
    kind: Any = kind_of(data)
    measurement = _continued(kind.of(data, steps, prior, number), decisions)
    return [measurement, *(_continued(beside.of(measurement, steps), decisions) for beside in KINDS[type(data)][1:])]


def corridors_of(floor_sequence: FloorSequence, prior: Prior) -> list[Measurement]:
    """The factors of corridors that the prior asks for, not associated with the walk yet."""
    return [CORRIDORS[name].about(floor_sequence) for name in prior.corridors]


def _continued(kind: Measurement, decisions: Mapping[str, Mapping[str, AnyArray]] | None) -> Measurement:
    return kind if decisions is None else kind.continued(decisions.get(kind.name, {}))
