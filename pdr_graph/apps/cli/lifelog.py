"""``pdr-graph lifelog``: a function for each command, which imports what it uses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pdr_graph.apps.cli.lifelog_corrections import correct
from pdr_graph.apps.cli.lifelog_show import show
from pdr_graph.apps.cli.options import BeaconsPath, FixesPath, Quiet, RangesPath, WalkerPath
from pdr_graph.apps.cli.serve import serve_lifelog
from pdr_graph.apps.cli.terminal import App, echo
from pdr_graph.errors import EXIT_DEGRADED, EXIT_REFUSED, count, shows_progress

lifelog = App(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Recordings of many days: places, activities, exports.",
)
lifelog.add_typer(correct, name="correct")

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
    parquet = "parquet"


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
    quiet: Quiet = False,
) -> None:
    """Add recordings to a lifelog; create it if it does not exist.

    A recording is added once, whatever its name. Options hold for all the RECORDINGs; a recording that is in the
    lifelog already keeps its present value of an option that is not given.

    \b
    pdr-graph lifelog add days.db walks/ --map maps/mall.geojson
    """
    from pdr_graph.apps.lifelog import ingest
    from pdr_graph.apps.lifelog.store import RecordingOptions

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
    echo(f"{', '.join(counts)} -> {store}")
    _end(result.refused, none=not result.added + result.existing)


@lifelog.command("import")
def import_(
    store: StorePath,
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Exports: files, folders or zips (a Google Takeout).")
    ],
    person: Annotated[str | None, typer.Option(metavar="NAME", help="The person; default: me.")] = None,
    quiet: Quiet = False,
) -> None:
    """Import the past from Google, OwnTracks, GPX and other exports.

    The files are recognised by their content: Google Records.json, Semantic Location History, Timeline.json of Android
    and iOS and Timeline Edits; OwnTracks .rec, Overland, GPX, KML, FIT. Overlapping exports are merged; what Google
    guessed is kept apart from the positions.

    \b
    pdr-graph lifelog import days.db takeout.zip
    """
    from pdr_graph.apps.lifelog.past.importing import import_past

    with _progress_bar() as advance:
        result = import_past(store, files, person, advance)
    changed = result.positions
    counts = [count(changed.new, "new position"), f"{changed.existing} there already"]
    counts += [f"{changed.better} replaced by more accurate ones"] if changed.better else []
    counts += [f"{count(changed.days, 'day')} changed"]
    counts += [f"{result.guesses} guessed visits or activities"] if result.guesses else []
    counts += [f"{result.placed} positions from Wi-Fi scans"] if result.placed else []
    counts += [f"{count(result.skipped, 'file')} skipped"] if result.skipped else []
    echo(f"{', '.join(counts)} -> {store}")
    for line in result.notes:
        echo(f"pdr-graph: {line}", err=True)
    _end(result.refused, none=not changed.new + changed.better + changed.existing + result.guesses)


@lifelog.command()
def build(
    store: StorePath,
    zone: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Time zone of the days, kept for later builds; default: local."),
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
    time_limit: Annotated[
        float,
        typer.Option(
            metavar="MINUTES",
            min=0.1,
            help="Longest time of one recording or day in a worker process, which is then ended.",
        ),
    ] = 15.0,
    together: Annotated[
        bool,
        typer.Option(
            "--together",
            help="Then estimate the walks of a building or group in common graphs, thirty walks each.",
        ),
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Bring a lifelog up to date.

    Detect the steps of new recordings, and reconstruct the days that they change. Finished days are saved: an
    interrupted build continues where it stopped.

    \b
    pdr-graph lifelog build days.db --zone Europe/Berlin --workers 2
    """
    from pdr_graph.apps.lifelog.build import build as built

    with _progress_bar() as advance:
        result = built(store, zone, workers, scheduler, 60 * time_limit, advance)
    rest = f"{result.up_to_date} up to date, {len(result.failures)} failed"
    echo(f"{count(result.built, 'day')} built, {rest} -> {store}")
    if together:
        from pdr_graph.apps.lifelog.multi_day import estimate_together

        with _progress_bar() as advance:
            days = estimate_together(store, advance)
        echo(f"{count(days, 'day')} estimated together -> {store}")
    _end((*result.refusals, *result.failures, *result.unfinished))


lifelog.command()(show)


@lifelog.command()
def export(
    store: StorePath,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR|FILE", help="A folder for a file per day, or one file for all days.")
    ],
    format_: Annotated[
        ExportFormat, typer.Option("--format", help="csv and parquet require a DIR; parquet needs the extra geo.")
    ] = ExportFormat.gpx,
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
    quiet: Quiet = False,
) -> None:
    """Export days as GPX, GeoJSON, CSV or GeoParquet.

    --cut leaves out private places. GeoParquet is for trackintel and movingpandas.

    \b
    pdr-graph lifelog export days.db --out days.gpx --cut 35.0001,135.0002,200
    """
    from pdr_graph.apps.lifelog.export import export_days

    written, notes = export_days(store, out, str(format_), person, from_, to, cut or (), blur or ())
    for line in notes:
        echo(f"pdr-graph: {line}", err=True)
    echo(f"{count(len(written), 'file')} -> {out}")


def _end(refused: Sequence[str], none: bool = False) -> None:
    """Print each refused input on a line and exit with an error code. none: True if there was no other input."""
    for line in refused:
        echo(f"pdr-graph: {line}", err=True)
    if refused:
        raise typer.Exit(EXIT_REFUSED if none else EXIT_DEGRADED)


@contextmanager
def _progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """A function that shows a progress bar on a terminal: name of the stage, number done, total."""
    if not shows_progress():
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


lifelog.command("serve")(serve_lifelog)
