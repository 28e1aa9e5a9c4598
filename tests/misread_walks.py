"""Recordings that mean something else: what an app, a spreadsheet or a person does to a text of numbers.

The estimate of such a recording is a result or one line, and its verdict is "ok" only near the truth.
"""

import collections
import math
import random
import re
import traceback
from dataclasses import replace

import numpy as np

from pdr_graph import InputError
from pdr_graph.apps.bench.data_sets import given, recorded
from pdr_graph.apps.bench.matrix import places
from pdr_graph.options import Options
from pdr_graph.walk import estimate, observe, read

SEPARATORS = re.compile(rb"[,;\t]")
FACTORS = (9.80665, 1 / 9.80665, 57.29578, 1 / 57.29578, 1e3, 1e-3, 1e6, 1e-6, -1.0, 1.1)
MOST_ROWS = 100_000


def misread(whole: bytes, chance: random.Random) -> tuple[str, bytes]:
    """A copy of a text table that means something else, and what was done to it.

    One kind of its rows (a sensor, by what they have that is no number) is changed, or the encoding of all.
    """
    lines = whole.splitlines()[:MOST_ROWS]
    if chance.random() < 0.1:
        name, encode = chance.choice(list(ENCODINGS.items()))
        return name, encode(whole)
    kinds = collections.defaultdict(list)
    for n, line in enumerate(lines):
        kinds[next((cell for cell in SEPARATORS.split(line) if not _is_number(cell)), b"")].append(n)
    key, rows = chance.choice([own for own in kinds.items() if len(own[1]) > 20] or [(b"", list(range(len(lines))))])
    cells = [SEPARATORS.split(lines[n]) for n in rows]
    separator = (SEPARATORS.search(lines[rows[0]]) or [b","])[0]
    numbers = [k for k, cell in enumerate(cells[0]) if all(k < len(row) and _is_number(row[k]) for row in cells)]
    name, change = chance.choice(list(CHANGES.items()))
    made = change(cells, numbers, chance) if len(numbers) > 1 else cells
    changed = [separator.join(row) for row in made]
    found = list(lines)
    for n, text in zip(rows, changed, strict=False):
        found[n] = text
    gone = set(rows[len(changed) :])
    found = [text for n, text in enumerate(found) if n not in gone]
    return f"{name}, {key.decode('latin-1')[:40] or 'all'}", b"\n".join(found) + b"\n"


def _is_number(cell):
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False


def _each(cells, columns, change):
    """The rows with `change` of the number in some columns; change: of value, row number."""
    found = [list(row) for row in cells]
    for n, row in enumerate(found):
        for k in columns:
            row[k] = repr(change(float(row[k]), n)).encode()
    return found


def _unit(cells, numbers, chance):
    factor = chance.choice(FACTORS)
    return _each(cells, numbers[1:], lambda value, _: value * factor)


def _axis(cells, numbers, chance):
    return _each(cells, [chance.choice(numbers[1:])], lambda value, _: -value)


def _frozen(cells, numbers, chance):
    half = len(cells) // 2
    kept = cells[half]
    return [
        row if n < half else [row[k] if k == numbers[0] else kept[k] for k in range(len(kept))]
        for n, row in enumerate(cells)
    ]


def _clock(cells, numbers, chance):
    later = chance.choice((3600, -3600, 2, -2, 0.3)) * (1000 if float(cells[0][numbers[0]]) > 1e11 else 1)
    return _each(cells, numbers[:1], lambda value, _: value + later)


def _pace(cells, numbers, chance):
    first, factor = float(cells[0][numbers[0]]), chance.choice((0.5, 0.9, 1.1, 2.0))
    return _each(cells, numbers[:1], lambda value, _: first + factor * (value - first))


def _exchanged(cells, numbers, chance):
    one, other = chance.sample(numbers, 2)
    return [[row[{one: other, other: one}.get(k, k)] for k in range(len(row))] for row in cells]


def _noisy(cells, numbers, chance):
    sizes = {k: max(abs(float(row[k])) for row in cells) for k in numbers[1:]}
    return [
        [repr(float(cell) + chance.gauss(0, sizes[k])).encode() if k in sizes else cell for k, cell in enumerate(row)]
        for row in cells
    ]


def _rounded(cells, numbers, chance):
    return _each(cells, numbers[1:], lambda value, _: float(round(value)))


def _shuffled(cells, numbers, chance):
    return chance.sample(cells, len(cells))


def _ended(cells, numbers, chance):
    return cells[: len(cells) // 2]


def _thinned(cells, numbers, chance):
    return cells[:: chance.choice((2, 5, 20))]


def _held(cells, numbers, chance):
    """Each tenth row, ten times, with times of their own: an app that polls."""
    return [
        [row[k] if k == numbers[0] else cells[n - n % 10][k] for k in range(len(cells[n - n % 10]))]
        for n, row in enumerate(cells)
    ]


def _renamed(cells, numbers, chance):
    return [[cell if k in numbers else cell[::-1] for k, cell in enumerate(row)] for row in cells]


CHANGES = {
    "another unit": _unit, "an axis turned": _axis, "frozen from half on": _frozen, "another clock": _clock,
    "another pace": _pace, "columns exchanged": _exchanged, "noise": _noisy, "whole numbers": _rounded,
    "shuffled": _shuffled, "ended at half": _ended, "thinned": _thinned, "held": _held, "renamed": _renamed,
}  # fmt: skip
ENCODINGS = {
    "UTF-16": lambda text: text.decode("latin-1").encode("utf-16"),
    "a byte order mark": lambda text: b"\xef\xbb\xbf" + text,
    "decimal commas": lambda text: text.replace(b".", b","),
    "carriage returns": lambda text: text.replace(b"\n", b"\r\n"),
    "upper case": bytes.upper,
}


ENDS = "first and last"  # what a walk is given of its truth
FEWEST_INSIDE = 0.5  # share of the truth in the 90 % region of a walk that is "ok"
WRONG = "error", "ok, outside"  # outcomes that should not be


def walks_in(folder):
    """The recordings of a folder that have a truth, by file."""
    found = {}
    for path in sorted([*folder.rglob("*.txt"), *folder.rglob("*.csv")]):
        try:
            walk = recorded(path, Options())
        except InputError:
            continue
        if given(walk, ENDS) is not None:
            found[path] = walk
    return found


def misread_walk(path, data, whole):
    """What becomes of the bytes of a recording whose truth is known: a name of it, and its text."""
    path.write_bytes(data)
    try:
        evidence = read(path, Options())
        truth = whole.truth
        moved = whole.evidence.walk.clock_origin - evidence.walk.clock_origin
        walk = given(replace(whole, evidence=evidence, truth=replace(truth, time=truth.time + moved)), ENDS)
        result = estimate(observe(walk.evidence))
        error, inside = places(result.estimate.trajectory, walk.truth, walk.noise)
    except InputError as refusal:
        return ("refused", "") if "\n" not in str(refusal) else ("error", str(refusal))
    except Exception:
        return "error", traceback.format_exc()
    state, share = result.verdict.state, np.nanmean(inside) if np.isfinite(inside).any() else 1.0
    near = "inside" if share >= FEWEST_INSIDE else "outside"
    return f"{state}, {near}", f"{np.nanmedian(error):.1f} m off, {share:.0%} in the region"
