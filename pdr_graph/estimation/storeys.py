"""The floors that a building may have: those of its plan or, without one, storeys of one unknown height."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pdr_graph.types import Array

STOREY, SPREAD = 3.5, 0.2  # [m] and of its logarithm: flats 2.7, offices 3.3–4.2, shops 5
SCALES, SCALE_SPREAD = np.linspace(0.82, 1.18, 19), 0.08  # of a plan's heights: nominal ones, air of another warmth
TRIED: Array = STOREY * np.exp(SPREAD * np.linspace(-2.5, 2.5, 26))  # [m]
# "-2", "0"; "F1", "L2", "1F" and below them "B1", "B2F", with no floor 0 between
NUMERIC = re.compile(r"(?P<basement>B?)(?P<letter>[FL]?)(?P<number>-?\d+)(?P<behind>F?)", re.IGNORECASE)


class FloorHeights(Protocol):
    """What is needed to know of a building: its floors' labels, and their heights ``(f,)`` [m], rising."""

    @property
    def labels(self) -> tuple[str, ...]:
        """From the lowest up."""
        ...

    @property
    def heights(self) -> Array:
        """Of the floors."""
        ...


@dataclass(frozen=True)
class Storeys:
    """Floors from the lowest up: labels, "" where it has no name; heights ``(f,)`` [m].

    begin: index of the floor on which the walk began, None where its label does not tell; cost: how unusual they are.
    """

    labels: tuple[str, ...]
    heights: Array
    begin: int | None
    cost: float = 0.0


def of_building(building: FloorHeights, start: str) -> list[Storeys]:
    """The floors of a plan, their heights scaled in several ways: a plan or a barometer errs on all floors alike."""
    labels, heights = building.labels, np.asarray(building.heights, dtype=float)
    begin = labels.index(start) if start in labels else None
    return [Storeys(labels, s * heights, begin, float(0.5 * ((s - 1) / SCALE_SPREAD) ** 2)) for s in SCALES]


def unknown(start: str, seen: tuple[str, ...], reach: float) -> list[Storeys]:
    """Storeys of likely heights, named in the manner of the start's label or, without one, of the first one seen.

    seen: labels that fixes gave; reach: how far up or down [m] climbs led. Of labels without a number one is known,
    of the storey on which the walk began.
    """
    named = [label for label in (start, *seen) if label] or [""]
    numbers = {label: n for label in reversed(named) if (n := _number(label, named[0])) is not None}
    begin = numbers.get(start) if numbers else 0
    known = numbers.values() or [0]
    found = []
    for height in TRIED:
        margin = int(np.ceil(reach / height)) + 1
        storeys = range(min(known) - margin, max(known) + margin + 1)
        names = {n: _name(n, named[0]) for n in storeys} if numbers else {0: named[0]}
        names |= {n: label for label, n in numbers.items()}
        first = None if begin is None else begin - storeys[0]
        unusual = 0.5 * (np.log(height / STOREY) / SPREAD) ** 2
        labels = tuple(names.get(n, "") for n in storeys)
        found.append(Storeys(labels, height * np.array(storeys, dtype=float), first, float(unusual)))
    return found


def _number(label: str, manner: str) -> int | None:
    """How many storeys above the ground, of a label like ``manner``; None for any other."""
    match, like = NUMERIC.fullmatch(label), NUMERIC.fullmatch(manner)
    if not match or not like or _lettered(match) != _lettered(like):
        return None
    number = int(match["number"])
    if match["basement"]:
        return -number
    return number - 1 if _lettered(match) and number > 0 else number


def _name(storey: int, manner: str) -> str:
    """The label of a storey in the manner of another's."""
    like = NUMERIC.fullmatch(manner)
    if not like or not _lettered(like):
        return str(storey)
    behind = like["behind"]
    letter = like["letter"] or ("" if behind else "F")
    return f"{letter}{storey + 1}{behind}" if storey >= 0 else f"B{-storey}{behind}"


def _lettered(match: re.Match[str]) -> bool:
    return bool(match["basement"] or match["letter"] or match["behind"])
