"""The measurement kinds by the type of data that they are made from. The rest of the package names none of them.

`register` adds a kind, ours (in `pdr_graph.estimation.factors`) and those of others alike; `made_from` returns what a
type of data became in a graph.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pdr_graph.estimation.factors.base import INTERFACES, AnyArray, Locating, Measurement, Remembered
from pdr_graph.types import KEYFRAME, TABLE, Fixes, Index, Steps, declarations, declared, keyframes_of, row_columns

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.start import Prior
    from pdr_graph.floor.building import FloorSequence
    from pdr_graph.floor.paths import PathNetwork

KINDS: dict[type, tuple[Any, ...]] = {}  # type of data: the kind made from it, then kinds that are made from the first
ON_PLAN: dict[str, Any] = {}  # factors of corridors, by `Prior.corridors`
WAYS_OUTDOORS = "ways"  # in ON_PLAN: that of ways outdoors
COLLECTORS: dict[type, Any] = {}  # list of transmitters: what makes measurements of their receptions, in a live walk
RESERVED = set[str]()  # names of the kinds that are made from no data


def register(data_type: type, *kinds: type[Measurement]) -> None:
    """Let every part of the package take data of a type: graphs, live walks, journals, lifelogs, reports.

    data_type: a frozen dataclass with ``time`` [s], see `pdr_graph.types`; files know it by its name. kinds: the
    subclass of `Measurement` that is made from it, and any others that are made from the first; each has a ``name`` and
    a class method ``of(data, steps, prior, number)``, number ``(n,)`` being the permanent numbers of the rows.
    Registering the same definitions again, as in a notebook, replaces the former.

    Arrays, tuples and tables in the fields of both have a value per row; data with another number of values are refused
    with a ValueError. ``field(metadata=TABLE)`` declares what belongs to the whole. ``field(metadata=KEYFRAME)`` is the
    keyframe ``(n,)`` of each row of a kind, at which its residuals weigh particles; several per row are declared ROW.

    Raises TypeError for other classes and declarations, ValueError if a name is taken.
    """
    place = f"register, {data_type.__name__}"
    if "time" not in declarations(data_type):
        raise TypeError(f"{place}: found a type without a column of times, expected a frozen dataclass with time")
    if not getattr(data_type, "__dataclass_params__").frozen:  # noqa: B009, the type checker does not know it
        raise TypeError(f"{place}: found a dataclass that can change, expected @dataclass(frozen=True)")
    if not kinds or not all(isinstance(kind, type) and issubclass(kind, Measurement) for kind in kinds):
        raise TypeError(f"{place}: found {kinds}, expected subclasses of Measurement")
    for kind in kinds:
        if not kind.name or not callable(getattr(kind, "of", None)):
            raise TypeError(f"{place}: found {kind.__name__} without a name or of(…), expected both")
        bound = declared(kind, KEYFRAME)
        if len(bound) > 1 or declarations(kind).get("keyframe") == "":
            expected = "expected one field(metadata=KEYFRAME), or ROW for several"
            raise TypeError(f"{place}: {kind.__name__}: found keyframes {bound}, {expected}")
        for interface in (each for each in INTERFACES if not issubclass(kind, each)):
            if ignored := [name for name in vars(interface) if name[0] != "_" and name in dir(kind)]:
                expected = f"expected a subclass of {interface.__name__}"
                raise TypeError(f"{place}: found {kind.__name__}.{ignored[0]}, {expected}")
    lists, reference = declared(data_type, TABLE), getattr(data_type, "reference", None)
    if "time" in lists or declared(data_type, KEYFRAME):
        raise TypeError(f"{place}: found time declared TABLE, or a KEYFRAME, expected times of rows, and no keyframes")
    if reference is not None and (reference in lists or "label" not in lists):
        raise TypeError(f"{place}: found rows that refer to no list, expected label and the list's fields as TABLE")
    former = next((known for known in KINDS if known.__name__ == data_type.__name__), None)
    if former is not None and _definitions(former, *KINDS[former]) != _definitions(data_type, *kinds):
        raise ValueError(f"{place}: another type of this name is registered, of {former.__module__}")
    others = [kind for known, of_type in KINDS.items() if known is not former for kind in of_type]
    if taken := {kind.name for kind in kinds} & (RESERVED | {kind.name for kind in others}):
        raise ValueError(f"{place}: the name {', '.join(sorted(taken))} is taken by another kind")
    if former is not None:
        del KINDS[former]
    if not hasattr(data_type, "__len__"):
        data_type.__len__ = lambda table: len(table.time)  # type: ignore[attr-defined]
    KINDS[data_type] = kinds


def _definitions(*classes: type) -> list[tuple[str, str]]:
    """Where classes are defined."""
    return [(each.__module__, each.__qualname__) for each in classes]


def kinds_of_others() -> list[tuple[type, tuple[Any, ...]]]:
    """The types of data that are registered from outside the package, with their kinds: for another process."""
    return [(data, kinds) for data, kinds in KINDS.items() if not data.__module__.startswith("pdr_graph.")]


def kind_of(data: Any) -> type[Measurement]:
    """The kind of measurement that a type of data makes. Raises TypeError for types that are not registered."""
    return kind_of_type(type(data))


def kind_of_type(data_type: type) -> type[Measurement]:
    """The kind of measurement that is made from data of a type. Raises TypeError for types that are not registered."""
    kinds = KINDS.get(data_type)
    if kinds is None:
        names = ", ".join(sorted(known.__name__ for known in KINDS))
        raise TypeError(f"measurements: found {data_type.__name__}, expected one of {names}")
    return kinds[0]


def made_from(data_type: type, measurements: Iterable[Measurement]) -> Any:
    """The first of these kinds that is made from data of a type; None if there is none."""
    kind = kind_of_type(data_type)
    return next((measurement for measurement in measurements if isinstance(measurement, kind)), None)


def locating_kinds() -> tuple[str, ...]:
    """Names of the kinds that determine positions, beside the fixes."""
    return tuple(kinds[0].name for data, kinds in KINDS.items() if kinds[0].determines_position and data is not Fixes)


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
    kind_of(data)
    row_columns(data)  # raises ValueError where a column has another number of rows
    number, made, source = np.arange(len(data)) if number is None else number, list[Measurement](), data
    for kind in KINDS[type(data)]:
        new: Measurement = kind.of(source, steps, prior, number)
        if (keyframe := keyframes_of(new)) is not None and row_columns(new) and keyframe.ndim != 1:
            raise ValueError(f"{kind.__name__}: found keyframes of shape {keyframe.shape}, expected (n,), or ROW")
        if decisions is not None and isinstance(new, Remembered):
            new = new.continued(decisions.get(kind.name, {}))
        made.append(new)
        source = made[0]
    return made


def corridors_of(floor_sequence: FloorSequence, prior: Prior) -> list[Any]:
    """The factors of corridors that the prior asks for, not associated with the walk yet."""
    return [ON_PLAN[name].about(floor_sequence) for name in prior.corridors]


def ways_of(network: PathNetwork | None) -> list[Any]:
    """The factor of ways outdoors, none of which the walk follows yet; none without a network."""
    return [] if network is None else [ON_PLAN[WAYS_OUTDOORS].about(network)]


def ways_among(measurements: Iterable[Measurement]) -> Any:
    """The ways outdoors among these kinds; None if there are none."""
    return next((kind for kind in measurements if isinstance(kind, ON_PLAN[WAYS_OUTDOORS])), None)


def measurements_of_walk(tables: Sequence[Any], steps: Steps, prior: Prior) -> list[Measurement]:
    """The measurement kinds of all data of a walk; if no fix can be used, approximate positions by another kind."""
    kinds = [kind for table in tables for kind in measurements_of(table, steps, prior)]
    from_fixes, fixes = KINDS[Fixes], made_from(Fixes, kinds)
    if fixes is not None and fixes.used.any():
        return kinds
    rough = next((rough for kind in kinds if isinstance(kind, Locating) and len(rough := kind.rough_fixes())), None)
    if rough is None:
        return kinds
    others = [kind for kind in kinds if not isinstance(kind, from_fixes)]
    return [from_fixes[0].of(rough, steps, prior, approximate=True), *others]
