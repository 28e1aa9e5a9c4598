"""``pdr-graph lifelog``: a function for each command and each kind of correction, which imports what it uses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pdr_graph.apps.cli.options import AsJson, BeaconsPath, FixesPath, Force, Quiet, RangesPath, WalkerPath
from pdr_graph.apps.cli.serve import serve_lifelog
from pdr_graph.apps.cli.terminal import App, echo, echo_errors, echo_lines, echo_result
from pdr_graph.errors import EXIT_DEGRADED, EXIT_REFUSED, InputError, count, one_line, shows_progress
from pdr_graph.whole_files import check_replaceable

lifelog = App(
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
    kepler = "kepler"
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
    and iOS and Timeline Edits; OwnTracks .rec, Overland, GPX, KML, TCX, FIT. Overlapping exports are merged; what
    Google guessed is kept apart from the positions.

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
    echo_errors(*result.notes)
    _end(result.refused, none=not changed.new + changed.better + changed.existing + result.guesses)


@lifelog.command()
def build(
    store: StorePath,
    zone: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Time zone of the days, kept for later builds; default: local."),
    ] = None,
    paths: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="Ways outdoors that walks follow, kept for later builds; none: no ways."),
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
        result = built(store, zone, workers, scheduler, 60 * time_limit, advance, paths=paths)
    rest = f"{result.up_to_date} up to date, {len(result.failures)} failed"
    echo(f"{count(result.built, 'day')} built, {rest} -> {store}")
    if together:
        from pdr_graph.apps.lifelog.multi_day import estimate_together

        with _progress_bar() as advance:
            days = estimate_together(store, advance)
        echo(f"{count(days, 'day')} estimated together -> {store}")
    _end((*result.refusals, *result.failures, *result.unfinished))


Persons = Annotated[
    list[str] | None,
    typer.Option("--person", metavar="NAME", help="The person, several times for several; default: all."),
]
Date = Annotated[str, typer.Option(metavar="DATE", help="A day, as 2024-05-01; default: the last day.")]
Week = Annotated[str, typer.Option(metavar="WEEK", help="An ISO week, as 2024-W18.")]
Month = Annotated[str, typer.Option(metavar="MONTH", help="A month, as 2024-05.")]
Year = Annotated[str, typer.Option(metavar="YEAR", help="A year, as 2024.")]
PlaceName = Annotated[
    str, typer.Option(metavar="NAME|NUMBER", help="Only the visits to a place; default: on all days.")
]
GuessHome = Annotated[bool, typer.Option("--guess-home", help='Name the place of most nights "home?"; it is a guess.')]
ListAll = Annotated[bool, typer.Option("--all", help="List all persons and days instead.")]
Tiles = Annotated[
    str,
    typer.Option(
        metavar="URL",
        help="Map tiles behind the map, as https://tile.openstreetmap.org/{z}/{x}/{y}.png. Nothing is fetched without "
        "it; the server learns which area is drawn.",
    ),
]
Folder = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="Folder of page and tables; default: beside STORE.")
]


@lifelog.command()
def show(
    store: StorePath,
    person: Persons = None,
    date: Date = "",
    week: Week = "",
    month: Month = "",
    year: Year = "",
    place: PlaceName = "",
    guess_home: GuessHome = False,
    all_: ListAll = False,
    json_: AsJson = False,
    tiles: Tiles = "",
    out: Folder = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Show a day, week, month, year, place or person.

    Prints a list or a table of at most 100 columns, and writes overview.html and tables to a folder that only its owner
    can read. The page has a calendar, maps and tables; that of one person's day moves. Several persons share one
    calendar. --person alone shows all days of that person. With --json files are written only with --out.

    \b
    pdr-graph lifelog show days.db
    pdr-graph lifelog show days.db --date 2024-05-01 --out monday
    pdr-graph lifelog show days.db --month 2024-05 --person anna --person ben
    pdr-graph lifelog show days.db --place Office --json
    """
    if all_:
        _list_days(store)
        return
    if out is not None:
        check_replaceable(out, "overview.html", force)
    from pdr_graph.apps.lifelog.local_time import period_of
    from pdr_graph.apps.lifelog.show import Choice
    from pdr_graph.apps.lifelog.show import show as shown

    if tiles:
        from pdr_graph.apps.lifelog.maps import check_template  # imports scipy, which is slow

        check_template(tiles)
    choice = Choice(tuple(person or ()), period_of(date, week, month, year), place, guess_home)
    result = shown(store, choice, out, tiles, write=not json_ or out is not None)
    if json_:
        echo_result(result.json)
        return
    echo_lines(result.text)
    echo(f"-> {result.folder / 'overview.html'}")


def _list_days(path: Path) -> None:
    """Print a line per person and day of a lifelog."""
    from pdr_graph.apps.lifelog.store import Store

    with Store(path, reads=True) as log:
        days = log.days()
    for (person, date), day in days.items():
        echo(f"{one_line(person)}  {date}  {count(len(day.recordings), 'recording')}")


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

    --cut leaves out private places. GeoParquet is for trackintel and movingpandas; kepler is GeoJSON for kepler.gl.

    \b
    pdr-graph lifelog export days.db --out days.gpx --cut 35.0001,135.0002,200
    """
    from pdr_graph.apps.lifelog.export import export_days

    written, notes = export_days(store, out, str(format_), person, from_, to, cut or (), blur or ())
    echo_errors(*notes)
    echo(f"{count(len(written), 'file')} -> {out}")


def _end(refused: Sequence[str], none: bool = False) -> None:
    """Print each refused input on a line and exit with an error code. none: True if there was no other input."""
    echo_errors(*refused)
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

correct = App(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Correct days; corrections can be listed and undone.",
)

OnePerson = Annotated[str | None, typer.Option(metavar="NAME", help="The person; default: the only one.")]
From = Annotated[str, typer.Argument(metavar="FROM", help='Local time, as "2024-05-01 09:30".')]
To = Annotated[str, typer.Argument(metavar="TO", help="Local time.")]
At = Annotated[str, typer.Argument(metavar="TIME", help='Local time, as "2024-05-01 09:30", of the entry.')]
NEGATIVE = {"ignore_unknown_options": True}  # latitudes below 0 are arguments


@correct.command("was-at", context_settings=NEGATIVE)
def was_at(
    store: StorePath,
    time: At,
    place: Annotated[str, typer.Argument(metavar="PLACE", help="LAT,LON or the name of a place.")],
    radius: Annotated[
        float | None, typer.Option(metavar="M", help="Standard deviation of the place per axis; default: 15.")
    ] = None,
    person: OnePerson = None,
) -> None:
    """State where the person was at TIME.

    TIME is in a stay or in a time without data.

    The place enters the estimate instead of the positions recorded then.

    \b
    pdr-graph lifelog correct was-at days.db "2024-05-01 13:10" 48.1372,11.5755
    """
    from pdr_graph.apps.lifelog.revision import state_place

    _print(state_place(store, time, place, radius, person))


@correct.command("merge")
def merge(store: StorePath, start: From, end: To, person: OnePerson = None) -> None:
    """Make one stay of all entries from FROM to TO.

    \b
    pdr-graph lifelog correct merge days.db "2024-05-01 09:30" "2024-05-01 12:05"
    """
    from pdr_graph.apps.lifelog import revision

    _print(revision.merge(store, start, end, person))


@correct.command("split")
def split(store: StorePath, time: At, person: OnePerson = None) -> None:
    """Split the entry at TIME in two.

    \b
    pdr-graph lifelog correct split days.db "2024-05-01 10:45"
    """
    from pdr_graph.apps.lifelog import revision

    _print(revision.split(store, time, person))


@correct.command("was")
def was(
    store: StorePath,
    start: From,
    end: To,
    mode: Annotated[
        str, typer.Argument(metavar="MODE", help="bus, car, train, tram, ferry, bicycle, plane, ride, walk or stop.")
    ],
    person: OnePerson = None,
) -> None:
    """State what the person did from FROM to TO.

    A ride, a walk or a stop.

    \b
    pdr-graph lifelog correct was days.db "2024-05-01 08:40" "2024-05-01 09:05" bus
    """
    from pdr_graph.apps.lifelog.revision import state_mode

    _print(state_mode(store, start, end, mode, person))


@correct.command("not-me")
def not_me(store: StorePath, start: From, end: To, person: OnePerson = None) -> None:
    """State that somebody else carried the phone from FROM to TO.

    This time is shown as no data.

    \b
    pdr-graph lifelog correct not-me days.db "2024-05-01 18:00" "2024-05-01 19:30"
    """
    from pdr_graph.apps.lifelog.revision import state_not_me

    _print(state_not_me(store, start, end, person))


@correct.command("name", context_settings=NEGATIVE)
def name(
    store: StorePath,
    place: Annotated[str, typer.Argument(metavar="PLACE", help="LAT,LON, or the local time of a stay there.")],
    called: Annotated[str, typer.Argument(metavar="NAME", help="What to call it.")],
    radius: Annotated[float | None, typer.Option(metavar="M", help="Radius of the place; default: 75.")] = None,
    person: OnePerson = None,
) -> None:
    """Name a place.

    \b
    pdr-graph lifelog correct name days.db "2024-05-01 13:10" "the library"
    """
    from pdr_graph.apps.lifelog.revision import name_place

    _print(name_place(store, place, called, radius, person))


@correct.command("forget")
def forget(
    store: StorePath,
    start: Annotated[str | None, typer.Argument(metavar="FROM", help='Local time, as "2024-05-01 09:30".')] = None,
    end: Annotated[str | None, typer.Argument(metavar="TO", help="Local time.")] = None,
    person: OnePerson = None,
    everything: Annotated[bool, typer.Option("--everything", help="All of the --person.")] = False,
    recording: Annotated[
        str | None, typer.Option(metavar="PATH|HASH", help="One recording, and what was made of it.")
    ] = None,
    place: Annotated[
        str | None,
        typer.Option(metavar="NAME|NUMBER|LAT,LON", help="All times at a place, and its name; of all days."),
    ] = None,
    radius: Annotated[float | None, typer.Option(metavar="M", help="Radius of that place; default: 100.")] = None,
) -> None:
    """Delete the time from FROM to TO for good, or all times at a place.

    No byte of it remains in the lifelog and its files.

    Recordings that are added again stay without it. Your own files are not touched: they are named.

    \b
    pdr-graph lifelog correct forget days.db "2024-05-01 18:00" "2024-05-01 19:00"
    pdr-graph lifelog correct forget days.db --place "the library"
    pdr-graph lifelog correct forget days.db --person ben --everything
    """
    from pdr_graph.apps.lifelog import revision

    span = [text for text in (start, end) if text is not None]
    several = bool(span) + everything + (recording is not None) + (place is not None) != 1
    if len(span) == 2 and not several:
        _print(revision.forget(store, span[0], span[1], person))
    elif place is not None and not several:
        _print(revision.forget_place(store, place, radius, person))
    elif everything and person is not None and not several:
        _print(revision.forget_person(store, person))
    elif recording is not None and not several:
        _print(revision.forget_recording(store, recording))
    else:
        expected = "FROM and TO, or --place PLACE, or --person NAME --everything, or --recording PATH"
        raise InputError("forget", "", "another combination of arguments", expected)


@correct.command("list")
def list_(store: StorePath, person: OnePerson = None) -> None:
    """List all corrections, numbered, with the time when each was made.

    \b
    pdr-graph lifelog correct list days.db
    """
    from pdr_graph.apps.lifelog.revision import listing

    _print(listing(store, person))


@correct.command("undo")
def undo(
    store: StorePath,
    number: Annotated[int, typer.Argument(metavar="N", help="Number of the correction, as in list.")],
) -> None:
    """Undo a correction. What was deleted does not come back.

    \b
    pdr-graph lifelog correct undo days.db 3
    """
    from pdr_graph.apps.lifelog import revision

    _print(revision.undo(store, number))


def _print(lines: Iterable[str]) -> None:
    for line in lines:
        echo(line)


lifelog.add_typer(correct, name="correct")
