"""``pdr-graph bench``: a function for each command, which imports what it uses."""

from __future__ import annotations

import csv
import io
import json
import os
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter
from cyclopts.validators import Number

from pdr_graph.apps.cli.parameters import AsJson, Count, PositiveCount, Quiet
from pdr_graph.apps.cli.terminal import echo, echo_errors, echo_lines, echo_progress, echo_result
from pdr_graph.errors import EXIT_DEGRADED, InputError, count, shows_progress

bench = App("bench", help="Data sets by methods, ours and your own, in one table.")
DataFolder = Annotated[Path | None, Parameter(help="Folder of all data; default: of MATRIX, else $PDR_GRAPH_DATA.")]
Only = Annotated[
    tuple[str, ...],
    Parameter(help="Only rows whose name, 'data set | walk | given | method', has this text; repeatable."),
]


def _data(stated: Path | None) -> Path | None:
    folder = stated or os.environ.get("PDR_GRAPH_DATA")
    return Path(folder) if folder else None


@bench.command
def ls(*, data: DataFolder = None) -> None:
    """List the data sets with their number of walks, what can be given, and our methods.

    pdr-graph bench ls --data recordings
    """
    from pdr_graph.apps.bench.data_sets import ALSO, DATA_SETS, GIVEN
    from pdr_graph.apps.bench.methods import OURS

    folder = _data(data)
    for name, walks in DATA_SETS.items():
        found = count(len(list(walks(folder))), "walk") if folder else "no folder of data"
        echo(f"{name:10} {found:>10}  {(walks.__doc__ or '').splitlines()[0]}")
    echo("own        a folder of recordings with their truth.csv; module:function (docs/bench.md)")
    echo(f"given      {'; '.join(GIVEN)}; each also with {', '.join(ALSO)}")
    echo(f"methods    {', '.join(OURS)}; module:function; [commands] that write TUM")


@bench.command
def run(
    matrix: Path,
    /,
    *,
    data: DataFolder = None,
    only: Only = (),
    again: bool = False,
    workers: PositiveCount | None = None,
    time_limit: Annotated[float, Parameter(validator=Number(gte=1))] = 900.0,
    quiet: Quiet = False,
) -> None:
    """Make the rows of a matrix that its results lack; an interrupted run goes on.

    A row that fails says why, and is tried again by the next run.

    pdr-graph bench run matrix.toml
    pdr-graph bench run matrix.toml --only ridi --only graph

    Args:
        matrix: A TOML file (docs/bench.md).
        again: Make rows anew that the results have.
        workers: Processes, a walk in each; default: number of cores.
        time_limit: Longest time of a row, in a process of its own [s].
    """
    from pdr_graph.apps.bench.matrix import RESULTS, Matrix, key_of
    from pdr_graph.apps.lifelog.workers import cores

    table = Matrix.load(matrix, _data(data))
    missing, failed, made = table.missing(only, again), 0, 0
    with closing(table.rows(missing, workers or cores(), time_limit)) as rows:
        for row in rows:
            made += 1
            failed += "failed" in row
            if shows_progress():
                text = f"{made} of at most {len(missing)} rows: {' | '.join(key_of(row))[:100]:100}"
                echo_progress(text)
    if shows_progress() and made:
        echo("", err=True)
    echo(f"{count(made, 'row')} made -> {table.out / RESULTS}")
    if failed:
        echo_errors(f"{count(failed, 'row')} failed: pdr-graph bench stats {matrix} names them")
        sys.exit(EXIT_DEGRADED)


@bench.command
def stats(
    matrix: Path,
    /,
    *,
    data: DataFolder = None,
    only: Only = (),
    csv_: Path | None = None,
    out: Path | None = None,
    worst: Count = 0,
    json_: AsJson = False,
) -> None:
    """Print the table of the results so far, with 95 % bootstrap intervals over walks.

    CSV and JSON also have the command that makes each line anew. With --worst N, a second table names the N walks of
    each line with the largest 95 % of their errors; in JSON it is `worst` of the line, as CSV it is TABLE-worst.csv.

    pdr-graph bench stats matrix.toml --csv table.csv --out errors.png --worst 5

    Args:
        matrix: A TOML file (docs/bench.md).
        csv_: The table as CSV.
        out: Picture of the errors.
        worst: Number of the walks with the largest errors that are named.
    """
    from pdr_graph.apps.bench import matrix as module
    from pdr_graph.apps.report.plotting import picture_bytes
    from pdr_graph.whole_files import write_file

    table = module.Matrix.load(matrix, _data(data))
    rows = [row for row in table.results() if module.is_wanted(module.key_of(row), only)]
    if not rows:
        raise InputError(table.out, "", "no rows", f"pdr-graph bench run {matrix} first")
    lines, far = module.statistics(rows), module.worst(rows, worst)
    command = f"pdr-graph bench run {matrix} --again --only '{{}} |' --only '| {{}} | {{}}'"
    head, whole = [*module.STATISTICS, "command"], [[*line, command.format(*line[:3])] for line in lines]
    if csv_ is not None:
        write_file(csv_, _csv([head, *whole]))
        if worst:
            write_file(csv_.with_name(f"{csv_.stem}-worst.csv"), _csv([module.WORST, *far]))
    if out is not None:
        write_file(out, picture_bytes(module.plot(rows)))
    if json_:
        named = [dict(zip(module.WORST, line, strict=True)) for line in far]
        groups = [{name: line for name, line in zip(head, cells, strict=True)} for cells in whole]
        if worst:
            groups = [
                group | {"worst": [each for each in named if all(each[n] == group[n] for n in module.GROUP)]}
                for group in groups
            ]
        echo_result(json.dumps(groups))
    echo_lines(_aligned(module.STATISTICS, lines))
    if far:
        echo_lines(_aligned(("", *module.WORST), [["worst:", *line] for line in far]))
    for row in rows:
        if "failed" in row:
            echo(f"failed: {' | '.join(module.key_of(row))}: {row['failed']}")


def _csv(lines: Sequence[Sequence[str]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()


def _aligned(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table as text, without columns of which no line knows anything."""
    columns = [column for column in zip(head, *lines, strict=True) if set(column[1:]) != {"—"}]
    width = [max(map(len, column)) for column in columns]
    return "\n".join("  ".join(map(str.ljust, line, width)).rstrip() for line in zip(*columns, strict=True))
