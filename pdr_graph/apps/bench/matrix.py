"""A matrix of data sets × what is given × methods: its file, its rows as they are made, and their statistics."""

from __future__ import annotations

import json
import time
import tomllib
from collections import defaultdict
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import cycle, groupby, product
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pdr_graph.apps.bench.data_sets import BenchWalk, given, selection, walks_of
from pdr_graph.apps.bench.methods import Method, method_of, particles, with_verdict
from pdr_graph.apps.lifelog.workers import ITEM_LIMIT, CrashedItem, LostItem, fleet
from pdr_graph.apps.report.evaluation import (
    circular_error,
    energy_score,
    log_score,
    pair,
    stated_covariance,
)
from pdr_graph.errors import InputError, one_line
from pdr_graph.geometry import REGION_90, squared_distance, squared_radius
from pdr_graph.types import Array, Trajectory
from pdr_graph.walk import Evidence, observe

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESULTS = "results.jsonl"
NAMES = "data_set", "walk", "given", "method"  # of a row
ERRORS, STATED = "errors", ("squared_distances", "log_scores", "energy_scores")  # lists of a row, a value per place
UNKNOWN = "—"
Row = dict[str, Any]
Made = TypeVar("Made")


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
        """Rows that the results lack, also rows that failed and rows of earlier versions; again: all rows.

        only: texts that a row's name contains. Raises InputError for a name that is wrong or has no data.
        """
        have = set() if again else {key_of(row) for row in self.results() if set(STATED) <= set(row)}
        for what in self.given:
            selection(what)
        wanted = [
            Missing(key, read)
            for of in self.data_sets
            for walk, read in walks_of(of, self.data, self.path.parent)
            for key in product((of,), (walk,), self.given, self.methods)
            if is_wanted(key, only)
        ]
        if not wanted:
            text = " and ".join(map(repr, only))
            raise InputError("--only", "", text, "texts of one row's name, 'data set | walk | given | method'")
        return [each for each in wanted if each.name not in have]

    def rows(
        self, missing: Sequence[Missing], workers: int = 1, time_limit: float = ITEM_LIMIT
    ) -> Generator[Row, None, None]:
        """Make missing rows and append each to the results at once; a walk may lack what is to be given: no row, then.

        workers: processes, a walk in each; time_limit: of a row in a process [s]. A row whose process crashes or hangs
        says so, and the others go on; in this process alone (``workers=1``) it ends the run.
        """
        for name in self.methods:
            method_of(name, self.commands)  # raises InputError before any work
        self.out.mkdir(parents=True, exist_ok=True)
        tasks = [tuple(walk) for _, walk in groupby(missing, key=lambda each: each.name[:2])]
        workers = min(workers, max(len(tasks), 2))  # 2: in processes
        with (self.out / RESULTS).open("a", encoding="utf-8") as file, fleet(workers, time_limit=time_limit) as crew:
            if file.tell():
                file.write("\n")  # the last line may have been cut off
            for row in crew.run(partial(_rows_of_walk, self.commands), tasks, file.tell):
                if isinstance(row, CrashedItem | LostItem):
                    row = row.item.failed(row.reason if isinstance(row, CrashedItem) else crew.lost)
                if row is not None:
                    file.write(json.dumps(row) + "\n")
                    file.flush()
                    yield row

    def results(self) -> list[Row]:
        """The last row of each name, in the order of the matrix. A line that was cut off is left out."""
        rows, path = dict[tuple[str, ...], Row](), self.out / RESULTS
        for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
            try:
                row = json.loads(line)
                rows[key_of(row)] = row
            except (ValueError, KeyError, TypeError):
                continue
        names = self.data_sets, self.given, self.methods
        place = [{name: n for n, name in enumerate(each)} for each in names]

        def order(row: Row) -> tuple[Any, ...]:
            of, walk, *rest = key_of(row)
            named = zip(place, (of, *rest), strict=True)
            return *((known.get(name, len(known)), name) for known, name in named), walk

        return sorted(rows.values(), key=order)


@dataclass(frozen=True)
class Missing:
    """A row that is to be made. name: data set, walk, what is given, method; read: reads the walk."""

    name: tuple[str, str, str, str]
    read: Callable[[], BenchWalk]

    def failed(self, reason: str) -> Row:
        """The row that says why there is no estimate."""
        return self.row | {"failed": one_line(reason)}

    @property
    def row(self) -> Row:
        """The row with its name alone."""
        return dict(zip(NAMES, self.name, strict=True))


def key_of(row: Row) -> tuple[str, ...]:
    """The name of a row: data set, walk, what is given, method."""
    return tuple(row[name] for name in NAMES)


def is_wanted(name: Sequence[str], only: Sequence[str]) -> bool:
    """True if the name of a row, "data set | walk | given | method", has all texts."""
    return all(text in " | ".join(name) for text in only)


def _rows_of_walk(commands: Mapping[str, str], missing: Sequence[Missing]) -> Iterator[Row | None]:
    """The row of each item, all of one walk, which is read once; None where the walk lacks what is to be given."""
    walk, unread = _tried(missing[0].read)
    for what, alike in groupby(missing, key=lambda each: each.name[2]):
        helped, evidence, reason = None, None, unread
        if walk is not None:
            helped, reason = _tried(partial(given, walk, what))
        if helped is not None:
            evidence, reason = _tried(partial(observe, helped.evidence))
        for each in alike:
            row = None
            if helped is not None and evidence is not None:
                method = method_of(each.name[3], commands)
                row, reason = _tried(partial(_row, each, helped, evidence, method))
            yield each.failed(reason) if reason else row


def _tried(make: Callable[[], Made]) -> tuple[Made | None, str]:
    """What a function returns, and why it returned nothing."""
    try:
        return make(), ""
    except Exception as error:  # a data set or method of one's own may raise anything, and the others go on
        kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
        return None, one_line(f"{kind}{error}") or "an error without a text"


def _row(each: Missing, walk: BenchWalk, evidence: Evidence, method: Method) -> Row | None:
    """The scores of a method at each place, its verdict, length and steps over the true; None without its plan."""
    if method is particles and evidence.building is None:
        return None
    began = time.perf_counter()
    track, verdict, whole = with_verdict(each.name[3], method, evidence)
    seconds = round(time.perf_counter() - began, 3)
    steps = np.nan if evidence.steps is None else len(evidence.steps) / walk.steps
    way = float(np.hypot(*np.diff(whole().position, axis=0).T).sum())
    legs = walk.plan.crosses_wall(track.position, track.floor) if walk.plan and len(track) > 1 else np.empty(0)
    walls = legs.mean() if len(legs) else np.nan
    row = each.row | {"seconds": seconds, "verdict": verdict, "steps": _number(steps), "walls": _number(walls)}
    scores = {name: list(map(_number, values)) for name, values in scores_at(track, walk.truth, walk.noise).items()}
    return row | {"length": _number(way / walk.length)} | scores


def scores_at(track: Trajectory, truth: Trajectory, noise: float) -> dict[str, Array]:
    """Error [m], squared Mahalanobis distance, log score [nats] and energy score [m] at the places of a truth, each
    ``(n,)``, by the names of ERRORS and STATED.

    noise: of the truth, per axis, whose covariance is added to the stated one [m]. NaN where the track has no position,
    or states no covariance.
    """
    scores = {name: np.full(len(truth), np.nan) for name in (ERRORS, *STATED)}
    if len(truth) and len(track):
        pairs = pair(track, truth)
        known = np.isin(truth.time, pairs.time)
        scores[ERRORS][known] = circular_error(pairs)
        if track.covariance is not None:
            error = pairs.estimate - pairs.truth
            covariance = stated_covariance(track, pairs.time) + noise**2 * np.eye(2)
            for name, score in zip(STATED, (squared_distance, log_score, energy_score), strict=True):
                scores[name][known] = score(error, covariance)
    return scores


def places(track: Trajectory, truth: Trajectory, noise: float) -> tuple[Array, Array]:
    """Errors [m] at the places of a truth, and 1.0 where its 90 % region has the place, else 0.0.

    noise, and NaN: as for `scores_at`.
    """
    scores = scores_at(track, truth, noise)
    errors, squared = scores[ERRORS], scores[STATED[0]]
    return errors, np.where(np.isnan(squared), np.nan, squared < REGION_90)


def _number(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None


# Statistics

SCORED_AT = (50, 75, 95)  # percentiles
LEVELS = (50, 90, 99)  # [%] of the regions whose coverage is counted
GROUP = "data set", "given", "method"
COVERAGE_COLUMNS = tuple(f"in {level} %" for level in LEVELS)
LOW = 0.6  # share of a walk's places in the 90 % region, up to which the walk is counted
STATISTICS = (
    *(*GROUP, "walks", "failed", "places"),
    *("CE50 [m]", "CE75 [m]", "CE95 [m]", *COVERAGE_COLUMNS, "log score [nats]", "energy score [m]"),
    *(f"walks up to {100 * LOW:.0f} % in 90 %", "across walls", "length", "steps", "seconds"),
)
WORST = (*GROUP, "walk", "places", "CE50 [m]", "CE95 [m]", "in 90 %", "log score [nats]", "verdict")


def with_intervals(
    groups: Sequence[Array], statistic: Callable[[Array], Array], formats: Sequence[str], draws: int = 2000
) -> list[str]:
    """Numbers of all places with 95 % bootstrap intervals: whole walks are drawn, since errors in one walk are alike.

    groups: of each walk, a row for each place; formats: of the numbers, whose interval is without a unit.
    """
    random = np.random.default_rng(0)
    samples = [
        statistic(np.concatenate([groups[i] for i in random.integers(0, len(groups), len(groups))]))
        for _ in range(draws)
    ]
    numbers = zip(formats, statistic(np.concatenate(groups)), *np.percentile(samples, [2.5, 97.5], axis=0), strict=True)
    return [
        f"{form.format(value)} ({form.format(low).split()[0]}–{form.format(high).split()[0]})"
        for form, value, low, high in numbers
    ]


def error_percentiles(errors: Array) -> Array:
    """The percentiles SCORED_AT [m] of errors ``(n,)``."""
    return np.percentile(errors, SCORED_AT)


def calibration(stated: Array) -> Array:
    """Coverage [%] at LEVELS, mean log score and mean energy score of places ``(n, 3)`` with the columns STATED."""
    squared, *scores = stated.T
    covered = [100 * np.mean(squared < squared_radius(level / 100)) for level in LEVELS]
    return np.array([*covered, *(score.mean() for score in scores)])


CE_FORMATS = ("{:.2f}",) * len(SCORED_AT)
CALIBRATION_FORMATS = (*("{:.0f} %",) * len(LEVELS), "{:.2f}", "{:.2f}")


def grouped(rows: Iterable[Row]) -> dict[tuple[str, str, str], list[Row]]:
    """The rows of each data set, what is given and method."""
    groups = defaultdict[tuple[str, str, str], list[Row]](list)
    for row in rows:
        groups[row["data_set"], row["given"], row["method"]].append(row)
    return dict(groups)


def known(row: Row, name: str) -> Array:
    """The values of a list of a row without those that are None; none for a row that lacks the list."""
    return np.array([value for value in row.get(name, ()) if value is not None])


def stated(row: Row) -> Array:
    """The columns STATED ``(n, 3)`` at the places for which a row has a covariance; none if it lacks a column."""
    columns = [known(row, name) for name in STATED]
    return np.column_stack(columns if all(map(len, columns)) else [np.empty(0)] * len(STATED))


def low_walks(regions: Sequence[Array]) -> str:
    """How many walks have at most LOW of their places in the 90 % region, and how many would by chance alone, were each
    place in it with a probability of 90 %, independent of the others.
    """
    from scipy.stats import binom

    size = np.array(list(map(len, regions)))
    inside = np.array([np.sum(each[:, 0] < REGION_90) for each in regions])
    chance = binom.cdf(np.floor(LOW * size + 1e-9), size, 0.9).sum()
    return f"{np.sum(inside <= LOW * size + 1e-9)} (by chance {chance:.1f})"


def statistics(rows: Iterable[Row]) -> list[list[str]]:
    """The cells of STATISTICS, a line for each group, with intervals for errors, coverage and scores; means of the
    rest. "—" where no row has the number.
    """
    lines = []
    for names, alike in grouped(rows).items():
        done = [row for row in alike if "failed" not in row]
        errors = [error for row in done if len(error := known(row, ERRORS))]
        regions = [each for row in done if len(each := stated(row))]
        walls = [row["walls"] for row in done if row.get("walls") is not None]
        due, count = sum(len(row[ERRORS]) for row in done), sum(map(len, errors))
        cells = [str(len(alike)), str(len(alike) - len(done)), f"{count} of {due}" if count < due else str(count)]
        cells += with_intervals(errors, error_percentiles, CE_FORMATS) if errors else [UNKNOWN] * len(CE_FORMATS)
        cells += (
            with_intervals(regions, calibration, CALIBRATION_FORMATS)
            if regions
            else [UNKNOWN] * len(CALIBRATION_FORMATS)
        )
        cells.append(low_walks(regions) if regions else UNKNOWN)
        cells.append(f"{100 * np.mean(walls):.1f} %" if walls else UNKNOWN)
        for name in ("length", "steps"):
            off = [100 * (row[name] - 1) for row in done if row[name] is not None]
            cells.append(f"{np.mean(off):+.1f} % (rms {np.sqrt(np.mean(np.square(off))):.1f})" if off else UNKNOWN)
        cells.append(f"{np.median([row['seconds'] for row in done]):.2f}" if done else UNKNOWN)
        lines.append([*names, *cells])
    return lines


def worst(rows: Iterable[Row], number: int) -> list[list[str]]:
    """The cells of WORST for so many walks of each group, those with the largest 95 % of their errors first."""
    lines = []
    for names, alike in grouped(rows).items():
        placed = [(error, row) for row in alike if len(error := known(row, ERRORS))]
        placed.sort(key=lambda pair: -np.percentile(pair[0], 95))
        for error, row in placed[:number]:
            regions = stated(row)
            shares = (
                [form.format(value) for form, value in zip(CALIBRATION_FORMATS, calibration(regions), strict=True)]
                if len(regions)
                else [UNKNOWN] * len(CALIBRATION_FORMATS)
            )
            at = [f"{value:.2f}" for value in np.percentile(error, [50, 95])]
            verdict = row.get("verdict") or UNKNOWN
            lines.append([*names, row["walk"], str(len(error)), *at, shares[1], shares[3], verdict])
    return lines


def plot(rows: Iterable[Row]) -> Figure:
    """Share of the places by error, a panel for each data set and what is given, a line for each method."""
    from pdr_graph.apps.report.plotting import CYCLE, LINE_STYLES, Figure

    panels = defaultdict[tuple[str, str], dict[str, Array]](dict)
    for (of, what, method), alike in grouped(rows).items():
        errors = np.concatenate([np.empty(0), *(known(row, ERRORS) for row in alike if "failed" not in row)])
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
