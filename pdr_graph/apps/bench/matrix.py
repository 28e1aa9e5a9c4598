"""A matrix of data sets × what is given × methods: its file, its rows as they are made, and their statistics."""

from __future__ import annotations

import json
import time
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import cycle, groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdr_graph.apps.bench.data_sets import BenchWalk, given, walks_of
from pdr_graph.apps.bench.methods import Method, method_of, particles
from pdr_graph.apps.report.evaluation import circular_error, in_region, pair, stated_covariance
from pdr_graph.errors import InputError, one_line
from pdr_graph.types import Array, Trajectory
from pdr_graph.walk import observe

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESULTS = "results.jsonl"
Row = dict[str, Any]


@dataclass(frozen=True)
class Matrix:
    """What a matrix file says. path: of the file; out: folder of the results; data: folder of all data."""

    path: Path
    data_sets: tuple[str, ...]
    methods: tuple[str, ...] = ("graph", "filter", "pdr")
    given: tuple[str, ...] = ("recorded",)
    data: Path = Path()
    out: Path = Path("bench")
    commands: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def load(cls, path: Path, data: Path | None = None) -> Matrix:
        """Read a matrix. data: unless the file names it; both paths are from its folder. Raises InputError."""
        try:
            content = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise InputError(path, "", one_line(error.strerror or str(error)), "a matrix (docs/bench.md)") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InputError(path, "", one_line(str(error)), "TOML (docs/bench.md)") from None
        lists, texts = ("data_sets", "methods", "given"), ("data", "out")
        for key, value in content.items():
            if key in lists:
                right = isinstance(value, list) and value and all(isinstance(each, str) for each in value)
            elif key == "commands":
                right = isinstance(value, dict) and all(isinstance(each, str) for each in value.values())
            else:
                right = key in texts and isinstance(value, str)
            if not right:
                expected = f"{', '.join(lists)} as lists of texts, {' and '.join(texts)} as texts, [commands]"
                raise InputError(path, key, one_line(repr(value)), expected)
        if "data_sets" not in content:
            raise InputError(path, "data_sets", "none", "names of data sets, or folders (pdr-graph bench ls)")
        values: dict[str, Any] = {key: tuple(value) if key in lists else value for key, value in content.items()}
        folder = path.parent / content["data"] if "data" in content else data or path.parent
        return cls(path, **values | {"data": folder, "out": path.parent / content.get("out", "bench")})

    def missing(self, only: Sequence[str] = (), again: bool = False) -> list[Missing]:
        """What the results lack; again: all rows. A walk may lack what is to be given, and has no row, then.

        only: texts that a row's name contains. What failed is tried again.
        """
        have = set() if again else {key_of(row) for row in self.results() if "failed" not in row}
        missing = list[Missing]()
        for of in self.data_sets:
            for walk, read in walks_of(of, self.data, self.path.parent):
                for what in self.given:
                    keys = [(of, walk, what, method) for method in self.methods]
                    methods = tuple(key[-1] for key in keys if key not in have and is_wanted(key, only))
                    missing += [Missing((of, walk, what), read, methods)] if methods else []
        return missing

    def rows(self, missing: Iterable[Missing]) -> Iterator[Row]:
        """Make the rows that are missing, and add each to the results at once."""
        methods = {name: method_of(name, self.commands) for name in self.methods}
        self.out.mkdir(parents=True, exist_ok=True)
        with (self.out / RESULTS).open("a", encoding="utf-8") as file:
            if file.tell():
                file.write("\n")  # the last line may have been cut off
            for _, alike in groupby(missing, key=lambda each: each.name[:2]):
                walk: BenchWalk | None = None
                for each in alike:
                    walk = walk or each.read()
                    helped = given(walk, each.name[2])
                    if helped is None:
                        continue
                    for row in _scored(each.name, helped, {name: methods[name] for name in each.methods}):
                        file.write(json.dumps(row) + "\n")
                        file.flush()
                        yield row

    def results(self) -> list[Row]:
        """The last row of each name. A line that was cut off is left out, and made again."""
        rows, path = dict[tuple[str, ...], Row](), self.out / RESULTS
        for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
            try:
                row = json.loads(line)
                rows[key_of(row)] = row
            except (ValueError, KeyError, TypeError):
                continue
        return list(rows.values())


@dataclass(frozen=True)
class Missing:
    """Rows that are to be made. name: data set, walk, what is given; read: reads the walk."""

    name: tuple[str, str, str]
    read: Callable[[], BenchWalk]
    methods: tuple[str, ...]


def key_of(row: Row) -> tuple[str, ...]:
    """The name of a row: data set, walk, what is given, method."""
    return row["data_set"], row["walk"], row["given"], row["method"]


def is_wanted(name: Sequence[str], only: Sequence[str]) -> bool:
    """True if the name of a row, "data set | walk | given | method", has all texts."""
    return all(text in " | ".join(name) for text in only)


def _scored(names: tuple[str, ...], walk: BenchWalk, methods: Mapping[str, Method]) -> Iterator[Row]:
    """A row for each method: errors [m], whether each place is in the 90 % region, length and steps over the true."""
    head: Row = dict(zip(("data_set", "walk", "given"), names, strict=True))
    try:
        evidence = observe(walk.evidence)
    except InputError as error:
        yield from (head | {"method": name, "failed": one_line(str(error))} for name in methods)
        return
    steps = np.nan if evidence.steps is None else len(evidence.steps) / walk.steps
    for name, method in methods.items():
        if method is particles and evidence.building is None:
            continue
        row, began = head | {"method": name}, time.perf_counter()
        try:
            track = method(evidence)
        except Exception as error:  # a method of one's own may raise anything, and the others go on
            kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
            yield row | {"failed": one_line(f"{kind}{error}")}
            continue
        row |= {"seconds": round(time.perf_counter() - began, 3), "steps": _number(steps)}
        way = float(np.hypot(*np.diff(track.position, axis=0).T).sum())
        legs = walk.plan.crosses_wall(track.position, track.floor) if walk.plan and len(track) > 1 else np.empty(0)
        walls = legs.mean() if len(legs) else np.nan
        errors, inside = (list(map(_number, values)) for values in places(track, walk.truth, walk.noise))
        row |= {"length": _number(way / walk.length), "walls": _number(walls), "errors": errors, "inside": inside}
        yield row


def places(track: Trajectory, truth: Trajectory, noise: float) -> tuple[Array, Array]:
    """Errors [m] at the places of a truth, and 1.0 where its 90 % region has the place, else 0.0.

    noise: of the truth, per axis, which the region is widened by [m]. NaN where the track has no position, or states no
    region.
    """
    errors, inside = np.full((2, len(truth)), np.nan)
    if len(truth) and len(track):
        pairs = pair(track, truth)
        known = np.isin(truth.time, pairs.time)
        errors[known] = circular_error(pairs)
        if track.covariance is not None:
            inside[known] = in_region(pairs, stated_covariance(track, pairs.time) + noise**2 * np.eye(2))
    return errors, inside


def _number(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None


# Statistics

SCORED_AT = (50, 75, 95)  # percentiles
STATISTICS = ("data set", "given", "method", "walks", "failed", "places", "CE50 [m]", "CE75 [m]", "CE95 [m]", "in 90 %")
STATISTICS += ("across walls", "length", "steps", "seconds")


def percentiles_with_interval(groups: Sequence[Array], draws: int = 2000) -> list[str]:
    """CE50/75/95 and their 95 % bootstrap intervals: whole walks are drawn, since errors in one walk are alike."""
    random = np.random.default_rng(0)
    samples = [
        np.percentile(np.concatenate([groups[i] for i in random.integers(0, len(groups), len(groups))]), SCORED_AT)
        for _ in range(draws)
    ]
    low, high = np.percentile(samples, [2.5, 97.5], axis=0)
    values = np.percentile(np.concatenate(groups), SCORED_AT)
    return [f"{v:.2f} ({a:.2f}–{b:.2f})" for v, a, b in zip(values, low, high, strict=True)]


def grouped(rows: Iterable[Row]) -> dict[tuple[str, str, str], list[Row]]:
    """The rows of each data set, what is given and method."""
    groups = defaultdict[tuple[str, str, str], list[Row]](list)
    for row in rows:
        groups[row["data_set"], row["given"], row["method"]].append(row)
    return dict(groups)


def known(row: Row, name: str) -> Array:
    """The values of a list of a row without those that are None."""
    return np.array([value for value in row[name] if value is not None])


def statistics(rows: Iterable[Row]) -> list[list[str]]:
    """The cells of STATISTICS, a line for each group: percentiles of all places, with intervals; means of the rest."""
    lines = []
    for names, alike in grouped(rows).items():
        done = [row for row in alike if "failed" not in row]
        errors = [error for row in done if len(error := known(row, "errors"))]
        inside = np.concatenate([np.empty(0), *(known(row, "inside") for row in done)])
        walls = [row["walls"] for row in done if row.get("walls") is not None]
        due, count = sum(len(row["errors"]) for row in done), sum(map(len, errors))
        cells = [str(len(alike)), str(len(alike) - len(done)), f"{count} of {due}" if count < due else str(count)]
        cells += percentiles_with_interval(errors) if errors else ["—"] * len(SCORED_AT)
        cells.append(f"{100 * inside.mean():.0f} %" if len(inside) else "—")
        cells.append(f"{100 * np.mean(walls):.1f} %" if walls else "—")
        for name in ("length", "steps"):
            off = [100 * (row[name] - 1) for row in done if row[name] is not None]
            cells.append(f"{np.mean(off):+.1f} % (rms {np.sqrt(np.mean(np.square(off))):.1f})" if off else "—")
        cells.append(f"{np.median([row['seconds'] for row in done]):.2f}" if done else "—")
        lines.append([*names, *cells])
    return lines


def plot(rows: Iterable[Row]) -> Figure:
    """Share of the places by error, a panel for each data set and what is given, a line for each method."""
    from pdr_graph.apps.report.plotting import CYCLE, LINE_STYLES, Figure

    panels = defaultdict[tuple[str, str], dict[str, Array]](dict)
    for (of, what, method), alike in grouped(rows).items():
        errors = np.concatenate([np.empty(0), *(known(row, "errors") for row in alike if "failed" not in row)])
        if len(errors):
            panels[of, what][method] = np.sort(errors)
    if not panels:
        raise InputError("bench stats", "", "no row with places", "rows of walks whose truth has places")
    wide = min(3, len(panels))
    high = -(-len(panels) // wide)
    figure = Figure(figsize=(4.2 * wide, 3.4 * high), layout="constrained")
    grid = figure.subplots(high, wide, squeeze=False).ravel()
    for axes, (title, methods) in zip(grid, panels.items(), strict=False):
        for (name, errors), colour, dashes in zip(methods.items(), cycle(CYCLE), cycle(LINE_STYLES), strict=False):
            axes.plot(errors, np.arange(1, len(errors) + 1) / len(errors), color=colour, ls=dashes, label=name)
        axes.set_xscale("log")
        axes.set_xlabel("error [m]")
        axes.set_ylabel("share of places")
        axes.set_title(", ".join(title), fontsize=9)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    return figure
