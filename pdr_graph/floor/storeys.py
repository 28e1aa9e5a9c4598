"""The floors of a building in order, and how high they are."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph.errors import InputError

STOREY = 3.8  # [m] from one floor to the next where a plan does not say: offices and shops have 3.5 to 4.5
HIGHEST = 1000.0  # [m] above or below zero; no building reaches it
GROUND = ("G", "GF", "EG")
BELOW = ("B", "BF", "UG")  # letters about the number of a floor below the ground: B1, B1F, 2UG


def heights_of(path: Path, labels: Iterable[str], given: Any = None) -> dict[str, float]:
    """Height of each floor [m] by its label, lowest first.

    given: what the plan says, a height for every label; None: a storey each, in the order of their labels.
    Raises InputError for a height of no floor, a floor without a height, or one that is no number.
    """
    ordered = sorted(labels, key=_storey)
    if given is None:
        return {label: STOREY * n for n, label in enumerate(ordered)}
    place, floors = "pdr_graph.heights", ", ".join(ordered)
    if not isinstance(given, dict):
        raise InputError(path, place, repr(given), 'a height for each floor, {"1": 0.0, "2": 4.0}')
    if unknown := sorted(set(given) - set(ordered)):
        raise InputError(path, place, f"a floor {unknown[0]!r}", f"the labels of floors: {floors}")
    for label in ordered:
        if label not in given:
            raise InputError(path, place, f"no height of floor {label!r}", f"one for each of {floors}")
        if type(given[label]) not in (int, float) or not abs(given[label]) < HIGHEST:
            raise InputError(path, f"{place}.{label}", repr(given[label]), f"metres, less than {HIGHEST:g}")
    return {label: float(given[label]) for label in sorted(ordered, key=lambda label: given[label])}


def _storey(label: str) -> tuple[float, str]:
    """Where a floor comes: by its number (-2, B1, 0, EG, 1, F2, 3F, 4OG), those without one last, by name."""
    found = re.fullmatch(r"([A-Z]*) ?(-?\d{1,9}(?:\.\d{1,9})?) ?([A-Z]*)", label.strip().upper())
    if found is None:
        return (0.0 if label.strip().upper() in GROUND else np.inf), label
    before, number, after = found.groups()
    return (-float(number) if before in BELOW or after in BELOW else float(number)), label
