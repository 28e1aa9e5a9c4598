"""``pdr-graph lifelog``: a function for each command, which loads what it needs."""

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
from pdr_graph.errors import DegradedExit, RefusedExit, first_look

lifelog = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Recordings of many days and people, and what they tell.",
)

StorePath = Annotated[Path, typer.Argument(metavar="STORE", help="The lifelog: one file, and STORE.d beside it.")]
RecordingPaths = Annotated[
    list[Path],
    typer.Argument(metavar="RECORDING...", help="Recordings: files, folders or zips; or folders full of them."),
]

Person = Annotated[str | None, typer.Option(metavar="NAME", help="Whose; default: the only one, or all.")]


class Form(StrEnum):
    """What days are exported as."""

    gpx = "gpx"
    geojson = "geojson"
    csv = "csv"


@lifelog.command()
def add(
    store: StorePath,
    recordings: RecordingPaths,
    person: Annotated[str | None, typer.Option(metavar="NAME", help="Whose they are; default: me.")] = None,
    map_: Annotated[
        Path | None, typer.Option("--map", metavar="PLAN", help="The floor plan of where they were.")
    ] = None,
    fixes: FixesPath = None,
    beacons: BeaconsPath = None,
    ranges: RangesPath = None,
    walker: WalkerPath = None,
    floor: Annotated[str | None, typer.Option(metavar="LABEL", help="The floor where they begin.")] = None,
    begins: Annotated[
        str | None,
        typer.Option(metavar="ISO8601", help="When a recording began that does not say; UTC without an offset."),
    ] = None,
    phone: Annotated[
        str | None,
        typer.Option(metavar="ID", help="What their phone or tag is called in the Bluetooth logs of others."),
    ] = None,
    copy: Annotated[
        bool, typer.Option("--copy", help="Keep a copy in STORE.d, so that the original may go; else it has to stay.")
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
    with _bar() as advance:
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
        typer.Option(metavar="NAME", help="The time zone whose midnights part the days, from now on; UTC at first."),
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
            "--together", help="Then all walks of a building or a group in one graph: as long as its history."
        ),
    ] = False,
) -> None:
    """Bring a lifelog up to date.

    Find the steps of new recordings, and reconstruct the days that they change. What is done is kept: a build that was
    interrupted goes on where it was.

    \b
    pdr-graph lifelog build days.db --zone Europe/Berlin --workers 2
    """
    from pdr_graph.lifelog.build import build as built

    with _bar() as advance:
        result = built(store, zone, workers, scheduler, advance)
    typer.echo(f"{result.built} days built, {result.kept} up to date, {len(result.failures)} failed -> {store}")
    if together:
        from pdr_graph.lifelog.multi_day import bind

        typer.echo(f"{bind(store)} days estimated together -> {store}")
    _end((*result.refusals, *result.failures))


@lifelog.command()
def show(
    store: StorePath,
    person: Person = None,
    date: Annotated[str | None, typer.Option(metavar="DATE", help="As 2024-05-01; default: the last day.")] = None,
    all_: Annotated[bool, typer.Option("--all", help="Only list the persons and days that there are.")] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="For the day as page, table and map; default: STORE's name-shown."),
    ] = None,
) -> None:
    """Show what somebody did on a day.

    When, what, how far, and where: the list, and a folder with pictures of it that only its owner can read.

    \b
    pdr-graph lifelog show days.db
    pdr-graph lifelog show days.db --date 2024-05-01 --out monday
    """
    from pdr_graph.lifelog.show import listed, show_day

    if all_:
        typer.echo(listed(store), nl=False)
        return
    folder = out or Path(f"{store.stem}-shown")
    typer.echo(show_day(store, person, date, folder), nl=False)
    typer.echo(f"-> {first_look(folder)}")


@lifelog.command()
def export(
    store: StorePath,
    out: Annotated[Path, typer.Option("--out", metavar="DIR|FILE", help="A file for each day, or one for all.")],
    format_: Annotated[Form, typer.Option("--format", help="CSV needs a DIR.")] = Form.gpx,
    person: Person = None,
    from_: Annotated[str, typer.Option("--from", metavar="DATE", help="The first day; default: of all.")] = "",
    to: Annotated[str, typer.Option(metavar="DATE", help="The last day; default: of all.")] = "",
    cut: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PLACE",
            help="Leave out what is near it: LAT,LON,RADIUS in metres, a name on a plan, or a GeoJSON file of areas. "
            "Say the same place in the same words every time.",
        ),
    ] = None,
    blur: Annotated[
        list[str] | None, typer.Option(metavar="PLACE", help="Say only roughly when one was where near it.")
    ] = None,
) -> None:
    """Write days as GPX, GeoJSON or CSV.

    Without the places that are to stay private.

    \b
    pdr-graph lifelog export days.db --out days.gpx --cut 35.0001,135.0002,200
    """
    from pdr_graph.lifelog.export import give

    written, said = give(store, out, str(format_), person, from_, to, cut or (), blur or ())
    for line in said:
        typer.echo(f"pdr-graph: {line}", err=True)
    typer.echo(f"{len(written)} files -> {out}")


def _end(refused: Sequence[str], none: bool = False) -> None:
    """Say what was refused, a line each. none: nothing else was there."""
    for line in refused:
        typer.echo(f"pdr-graph: {line}", err=True)
    if refused:
        raise typer.Exit(RefusedExit if none else DegradedExit)


@contextmanager
def _bar() -> Iterator[Callable[[str, int, int], None]]:
    """On a terminal, a bar for each stage: its name, how many are done, of how many."""
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
