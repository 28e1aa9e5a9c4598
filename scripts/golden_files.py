"""Numbers and texts of an output file, their SHA-256 hashes, and how far two versions of a file differ."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

VARYING = frozenset({"seconds", "versions", "push", "pose", "peak_memory", "memory"})  # keys that differ in every run
PROSE = frozenset({"reason", "warnings", "missing", "units", "ended"})  # keys of texts that are no identifiers
NAMES = re.compile(r"<(name|desc|type)>(.*?)<")  # the texts of a GPX file
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
METRES_PER_DEGREE = 111_320.0
SHOWN = 3  # differences of a file that are printed

Row = dict[str, str]


@dataclass(frozen=True)
class Rules:
    """Keys to leave out, and names of the new version with the names that they had in the recorded one."""

    ignored: frozenset[str] = VARYING
    renamed: Mapping[str, str] = field(default_factory=dict)

    def translate(self, text: str) -> str:
        """The text with the recorded names."""
        for new, old in self.renamed.items():
            text = re.sub(rf"(?<![\w-]){re.escape(new)}(?![\w-])", old, text)
        return text

    def text(self, path: Path) -> str:
        """The file's text with the recorded names."""
        return self.translate(path.read_text(encoding="utf-8", errors="replace"))


@dataclass
class Content:
    """The values of a file by their place in it. Identifiers count as numbers, prose does not."""

    numbers: dict[str, float | str] = field(default_factory=dict)
    texts: dict[str, str] = field(default_factory=dict)

    def hashes(self) -> dict[str, str]:
        """SHA-256 of the numbers and of the texts; the order of keys does not matter."""
        return {name: sha256(json.dumps(sorted(values.items())).encode()) for name, values in vars(self).items()}


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def read(path: Path, rules: Rules) -> Content:
    """Split a file into numbers and texts by its suffix. Of a table or track each line counts as numbers."""
    if path.suffix == ".npz":
        return Content(_arrays(path))
    text = rules.text(path)
    lines = text.splitlines()
    match path.suffix:
        case ".json" | ".geojson":
            return _split(json.loads(text), rules.ignored)
        case ".toml":
            return Content(_split(tomllib.loads(text), rules.ignored).numbers, _by_line(re.findall(r"#.*", text)))
        case ".gpx":
            names = [name for _, name in NAMES.findall(text)]
            return Content({**_by_line(NAMES.sub(r"<\1><", text).splitlines())}, _by_line(names))
        case ".printed":
            return Content({"exit status": lines[0]}, _by_line(lines[1:]))
        case _:
            return Content({**_by_line(lines)})


def _split(value: Any, ignored: frozenset[str]) -> Content:
    content = Content()
    for place, key, leaf in _leaves(value, "", "", ignored):
        if isinstance(leaf, str) and (" " in leaf or key in PROSE):
            content.numbers[place], content.texts[place] = "a text", leaf
        else:
            numeric = isinstance(leaf, int | float) and not isinstance(leaf, bool)
            content.numbers[place] = float(leaf) if numeric else str(leaf)
    return content


def _leaves(value: Any, place: str, key: str, ignored: frozenset[str]) -> Iterator[tuple[str, str, Any]]:
    """The place, the key and the value of every leaf of a JSON value; an empty list or object is one."""
    if isinstance(value, dict) and value:
        for name, inner in value.items():
            if name not in ignored:
                yield from _leaves(inner, f"{place}.{name}" if place else name, name, ignored)
    elif isinstance(value, list) and value:
        for i, inner in enumerate(value):
            yield from _leaves(inner, f"{place}[{i}]", key, ignored)
    else:
        yield place, key, value


def _arrays(path: Path) -> dict[str, float | str]:
    with np.load(path, allow_pickle=False) as arrays:
        return {name: f"{a.dtype} {a.shape} {sha256(a.tobytes())}" for name, a in arrays.items()}


def _by_line(lines: Iterable[str]) -> dict[str, str]:
    return {f"line {i}": line for i, line in enumerate(lines, 1)}


@dataclass(frozen=True)
class Difference:
    """How a file differs from the recorded one: numbers and texts in words, "" where they are the same.

    size: the largest difference of a number, in metres for positions; infinite where the structure differs.
    """

    size: float = 0.0
    numbers: str = ""
    texts: str = ""


def compare(old: Path, new: Path, rules: Rules) -> Difference:
    """Compare a new version of a file with the recorded one."""
    was, now = read(old, Rules(rules.ignored)), read(new, rules)
    texts = _listed(was.texts, now.texts)
    if was.numbers == now.numbers:
        return Difference(texts=texts)
    if old.suffix == ".csv":
        return Difference(*_compare_tables(_rows(old, Rules()), _rows(new, rules)), texts)
    places = was.numbers.keys() | now.numbers.keys()
    size = max(difference(was.numbers.get(place), now.numbers.get(place), place) for place in places)
    return Difference(size, f"{_listed(was.numbers, now.numbers)}; largest {size:.3g}", texts)


def _listed(old: Mapping[str, object], new: Mapping[str, object]) -> str:
    """The first differences of two files, and how many there are."""
    places = [place for place in {**old, **new} if old.get(place) != new.get(place)]
    shown = [f"{place}: {_short(old.get(place))} -> {_short(new.get(place))}" for place in places[:SHOWN]]
    more = [f"{len(places) - SHOWN} more"] if len(places) > SHOWN else []
    return "; ".join(shown + more)


def _short(value: object, longest: int = 70) -> str:
    text = "nothing" if value is None else str(value)
    return text if len(text) <= longest else f"{text[:longest]}…"


def difference(old: object, new: object, place: str = "") -> float:
    """The difference of two values, or of the numbers in two texts; infinite if anything else differs.

    Degrees of latitude and longitude are converted to metres.
    """
    if old == new:
        return 0.0
    was, now = str(old), str(new)
    if NUMBER.sub("0", was) != NUMBER.sub("0", now):
        return math.inf
    largest = max(abs(float(a) - float(b)) for a, b in zip(NUMBER.findall(was), NUMBER.findall(now), strict=True))
    degrees = "coordinates" in place or place.startswith(("lat", "lon")) or 'lat="' in was
    return largest * (METRES_PER_DEGREE if degrees else 1.0)


def _rows(path: Path, rules: Rules) -> list[Row]:
    """The rows of a table."""
    return list(csv.DictReader(rules.text(path).splitlines(), restval=""))


def _compare_tables(old: list[Row], new: list[Row]) -> tuple[float, str]:
    """The largest difference of two tables, and in words: by column, rows matched by time."""
    was, now = _by_time(old), _by_time(new)
    pairs = [(was[time], now[time]) for time in was if time in now]
    columns = dict.fromkeys(name for row in (*old[:1], *new[:1]) for name in row)
    sizes = {name: max((difference(a.get(name), b.get(name), name) for a, b in pairs), default=0.0) for name in columns}
    unmatched = len(was.keys() ^ now.keys()) + abs(len(old) - len(new) - len(was) + len(now))
    words = [f"{unmatched} rows without a counterpart"] if unmatched else []
    words += _positions_and_sigmas(pairs) + [f"{name} {size:.3g}" for name, size in sizes.items() if size]
    return max(math.inf if unmatched else 0.0, *sizes.values()), ", ".join(words)


def _by_time(rows: list[Row]) -> dict[str, Row]:
    """The rows by their time, of an outing if the table has several; by number if there is no time."""
    return {row.get("outing", "") + row.get("time", row.get("start", str(i))): row for i, row in enumerate(rows)}


def _positions_and_sigmas(pairs: list[tuple[Row, Row]]) -> list[str]:
    """The largest distance of two positions, and the largest relative difference of two sigmas."""
    shared = pairs[0][0].keys() & pairs[0][1].keys() if pairs else set()
    if not {"x", "y"} <= shared:
        return []
    distance = max(math.hypot(difference(a["x"], b["x"]), difference(a["y"], b["y"])) for a, b in pairs)
    sigmas = [(a[name], b[name]) for a, b in pairs for name in shared if name.startswith("sigma") and a[name]]
    ratio = max((difference(a, b) / max(float(a), 1e-9) for a, b in sigmas), default=0.0)
    return [f"position {distance:.3g} m", f"sigma {100 * ratio:.3g} %"]
