"""Rows of many numbers with fixed decimals, equal to the byte to those of Python's ``%.4f``, in a fraction of the time.

Four characters are one 32-bit word, which is looked up. Where a text is shorter it has zero bytes, removed at the end.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pdr_graph.types import Array

Words = NDArray[np.uint32]
GROUP = 4  # digits of a word
THOUSANDS = 10**GROUP
LARGEST = 1e12  # of numbers
UNCERTAIN = 1e-6  # distance from a half, in units of the last digit, at which rounding is left to Python


def text_rows(columns: Sequence[Words]) -> bytes:
    """Rows of text, one to a line, from their columns by `decimals`."""
    parts = [*columns, _words(b"\n")[None]]
    rows = np.empty((len(columns[0]), sum(part.shape[1] for part in parts)), np.uint32)
    begin = 0
    for part in parts:
        rows[:, begin : begin + part.shape[1]] = part
        begin += part.shape[1]
    return rows.tobytes().translate(None, b"\0")


def decimals(values: Array, places: int, before: bytes = b"") -> Words:
    """Numbers ``(n,)`` with ``places`` decimals as the characters ``(n, w)`` of a column, each after a text ``before``.

    Raises ValueError for finite numbers that are not below LARGEST.
    """
    finite = np.isfinite(values)
    size = np.where(finite, np.abs(values), 0.0)
    if not np.all(size < LARGEST):
        raise ValueError(f"found numbers up to {size.max()}, expected less than {LARGEST:.0e}")
    whole = np.floor(size)
    scaled = (size - whole) * 10**places  # the difference is exact, so that the product alone is rounded
    carry, fraction = np.divmod(np.rint(scaled).astype(np.int64), 10**places)
    signs = zip(_words(before + b"-"), _words(before + b"\0"), strict=True)
    columns = [np.where(np.signbit(values), minus, plus) for minus, plus in signs]
    columns += [*_whole_number(whole.astype(np.int64) + carry), *_words(b"."), *_digits(fraction, places)]
    texts = np.empty((len(values), len(columns)), np.uint32)
    for place, column in enumerate(columns):
        texts[:, place] = column
    by_python = ~finite | (np.abs(scaled - np.floor(scaled) - 0.5) < UNCERTAIN)
    for row in np.flatnonzero(by_python).tolist():
        text = before + b"%.*f" % (places, values[row])
        texts[row] = _words(text.ljust(GROUP * len(columns), b"\0"))
    return texts


def _words(text: bytes) -> Words:
    """A text as words."""
    return np.frombuffer(text + bytes(-len(text) % GROUP), np.uint32)


_CHARACTERS = (np.arange(THOUSANDS)[:, None] // [1000, 100, 10, 1] % 10 + ord("0")).astype(np.uint8)
_LEADING = np.arange(THOUSANDS)[:, None] < [1000, 100, 10, 0]
FULL = _words(_CHARACTERS.tobytes())  # the texts of 0000 to 9999
SHORT = _words(np.where(_LEADING, 0, _CHARACTERS).astype(np.uint8).tobytes())  # the same without leading zeros


def _groups(numbers: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    """The last ``count`` groups of four digits of whole numbers, the highest first."""
    groups = list[NDArray[np.int64]]()
    for _ in range(count):
        numbers, group = np.divmod(numbers, THOUSANDS)
        groups.insert(0, group)
    return groups


def _whole_number(numbers: NDArray[np.int64]) -> list[Words]:
    """The digits of whole numbers without leading zeros."""
    count = -(-len(str(numbers.max(initial=0))) // GROUP)
    columns = list[Words]()
    for place, group in enumerate(_groups(numbers, count)):
        unit = THOUSANDS ** (count - 1 - place)
        column = np.where(numbers >= THOUSANDS * unit, FULL[group], SHORT[group])
        columns.append(np.where(numbers >= unit, column, 0) if unit > 1 else column)
    return columns


def _digits(numbers: NDArray[np.int64], count: int) -> list[Words]:
    """The last ``count`` digits of whole numbers."""
    groups = _groups(numbers * 10 ** (-count % GROUP), -(-count // GROUP))  # the last ends with zeros that are cut
    columns = [FULL[group] for group in groups]
    if count % GROUP:
        columns[-1] = _words((b"\xff" * (count % GROUP)).ljust(GROUP, b"\0")) & columns[-1]
    return columns
