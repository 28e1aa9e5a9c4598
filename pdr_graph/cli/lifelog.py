"""``pdr-graph lifelog``: a function for each command, which imports what it uses."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pdr_graph.cli.options import BeaconsPath, FixesPath, RangesPath, WalkerPath
from pdr_graph.errors import EXIT_DEGRADED, EXIT_REFUSED, count, first_look, one_line

lifelog = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Recordings of many days: places, activities, exports.",
)

StorePath = Annotated[Path, typer.Argument(metavar="STORE", help="The lifelog: one file, and STORE.d beside it.")]
RecordingPaths = Annotated[
    list[Path],
    typer.Argument(metavar="RECORDING...", help="Recordings: files, folders or zips; or folders full of them."),
]

Person = Annotated[str | None, typer.Option(metavar="NAME", help="The person; default: the only one, or all.")]


class ExportFormat(StrEnum):
    """File formats of exported days."""

    gpx = "gpx"
    geojson = "geojson"
    csv = "csv"


@lifelog.command()
def add(
    store: StorePath,
    recordings: RecordingPaths,
    person: Annotated[str | None, typer.Option(metavar="NAME", help="The person who recorded; default: me.")] = None,
    map_: Annotated[Path | None, typer.Option("--map", metavar="PLAN", help="The floor plan of the place.")] = None,
    fixes: FixesPath = None,
    beacons: BeaconsPath = None,
    ranges: RangesPath = None,
    walker: WalkerPath = None,
    floor: Annotated[str | None, typer.Option(metavar="LABEL", help="The floor where the walks begin.")] = None,
    begins: Annotated[
        str | None,
        typer.Option(metavar="ISO8601", help="Start of a recording without a clock; UTC without an offset."),
    ] = None,
    phone: Annotated[
        str | None,
        typer.Option(metavar="ID", help="Name of the person's phone or tag in the Bluetooth logs of others."),
    ] = None,
    copy: Annotated[
        bool, typer.Option("--copy", help="Copy the recordings to STORE.d; else the originals must stay.")
    ] = False,
) -> None:
    """Add recordings to a lifelog, which is created if it does not exist.

    A recording is added once, whatever its name. Options hold for all the RECORDINGs; a recording that is in the
    lifelog already keeps its present value of an option that is not given.

    \b
    pdr-graph lifelog add days.db walks/ --map maps/mall.geojson
    """
    from pdr_graph.lifelog import ingest
    from pdr_graph.lifelog.store import RecordingOptions

    start = None if begins is None else ingest.time_of(begins)
    options = RecordingOptions(map_, fixes, beacons, ranges, walker, floor, start)
    with _progress_bar() as advance:
        result = ingest.add(
            store, recordings, options, person=person, phone=phone, copy=copy, progress=partial(advance, "")
        )
    counts = [f"{result.added} added"]
    counts += (
        [f"{result.existing} there already, {result.changed} of them with other options now"] if result.existing else []
    )
    counts += [f"{result.skipped} files skipped"] if result.skipped else []
    typer.echo(f"{', '.join(counts)} -> {store}")
    _end(result.refused, none=not result.added + result.existing)


@lifelog.command()
def build(
    store: StorePath,
    zone: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Time zone of the days, kept for later builds; first default: UTC."),
    ] = None,
    workers: Annotated[int, typer.Option(metavar="N", min=1, help="Processes on this machine.")] = 1,
    scheduler: Annotated[
        str,
        typer.Option(
            metavar="tcp://HOST:PORT",
            help="A Dask cluster (extra fleet). Its workers must see STORE.d and the recordings under the same paths: "
            "on other machines, a shared disk.",
        ),
    ] = "",
    together: Annotated[
        bool,
        typer.Option(
            "--together",
            help="Then estimate all walks of a building or group in one graph; cost grows with the history.",
        ),
    ] = False,
) -> None:
    """Bring a lifelog up to date.

    Detect the steps of new recordings, and reconstruct the days that they change. Finished days are saved: an
    interrupted build continues where it stopped.

    \b
    pdr-graph lifelog build days.db --zone Europe/Berlin --workers 2
    """
    from pdr_graph.lifelog.build import build as built

    with _progress_bar() as advance:
        result = built(store, zone, workers, scheduler, advance)
    typer.echo(f"{result.built} days built, {result.up_to_date} up to date, {len(result.failures)} failed -> {store}")
    if together:
        from pdr_graph.lifelog.multi_day import estimate_together

        typer.echo(f"{estimate_together(store)} days estimated together -> {store}")
    _end((*result.refusals, *result.failures))


@lifelog.command()
def show(
    store: StorePath,
    person: Person = None,
    date: Annotated[
        str | None, typer.Option(metavar="DATE", help="For example 2024-05-01; default: the last day.")
    ] = None,
    all_: Annotated[bool, typer.Option("--all", help="List all persons and days instead.")] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder of report, table and map; default: STORE's name-shown."),
    ] = None,
) -> None:
    """Show the activities and places of a person on a day.

    Prints the timeline, and writes a report, a table and a map to a folder that only its owner can read.

    \b
    pdr-graph lifelog show days.db
    pdr-graph lifelog show days.db --date 2024-05-01 --out monday
    """
    if all_:
        _list_days(store)
        return
    from pdr_graph.lifelog.report import show_day  # imports matplotlib, which is slow

    folder = out or Path(f"{store.stem}-shown")
    typer.echo(show_day(store, person, date, folder), nl=False)
    typer.echo(f"-> {first_look(folder)}")


def _list_days(path: Path) -> None:
    """Print a line per person and day of a lifelog."""
    from pdr_graph.lifelog.store import Store

    with Store(path) as log:
        days = log.days()
    for (person, date), day in days.items():
        typer.echo(f"{one_line(person)}  {date}  {count(len(day.recordings), 'recording')}")


@lifelog.command()
def export(
    store: StorePath,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR|FILE", help="A folder for a file per day, or one file for all days.")
    ],
    format_: Annotated[ExportFormat, typer.Option("--format", help="csv requires a DIR.")] = ExportFormat.gpx,
    person: Person = None,
    from_: Annotated[
        str, typer.Option("--from", metavar="DATE", help="The first day; default: the first of all.")
    ] = "",
    to: Annotated[str, typer.Option(metavar="DATE", help="The last day; default: the last of all.")] = "",
    cut: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PLACE",
            help="Leave out everything near a place: LAT,LON,RADIUS in metres, a name on a plan, or a GeoJSON file of "
            "areas. Use the same text for a place in all exports.",
        ),
    ] = None,
    blur: Annotated[
        list[str] | None, typer.Option(metavar="PLACE", help="Coarsen times and positions near a place.")
    ] = None,
) -> None:
    """Export days as GPX, GeoJSON or CSV, without private places.

    \b
    pdr-graph lifelog export days.db --out days.gpx --cut 35.0001,135.0002,200
    """
    from pdr_graph.lifelog.export import export_days

    written, notes = export_days(store, out, str(format_), person, from_, to, cut or (), blur or ())
    for line in notes:
        typer.echo(f"pdr-graph: {line}", err=True)
    typer.echo(f"{len(written)} files -> {out}")


def _end(refused: Sequence[str], none: bool = False) -> None:
    """Print each refused input on a line and exit with an error code. none: True if there was no other input."""
    for line in refused:
        typer.echo(f"pdr-graph: {line}", err=True)
    if refused:
        raise typer.Exit(EXIT_REFUSED if none else EXIT_DEGRADED)


@contextmanager
def _progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """A function that shows a progress bar on a terminal: name of the stage, number done, total."""
    if not sys.stderr.isatty():
        yield lambda stage, done, of: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        tasks = {}

        def advance(stage: str, done: int, of: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage)
            progress.update(tasks[stage], completed=done, total=of)

        yield advance
