"""``pdr-graph lifelog``: a function for each command and each kind of correction, which imports what it uses."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter
from cyclopts.validators import Number

from pdr_graph.apps.cli.parameters import HYPHEN, AsJson, Count, Force, PositiveCount, Quiet, only
from pdr_graph.apps.cli.serve import serve_lifelog
from pdr_graph.apps.cli.terminal import echo, echo_errors, echo_lines, echo_result
from pdr_graph.errors import (
    EXIT_DEGRADED,
    EXIT_NOTHING,
    EXIT_REFUSED,
    SILENT,
    InputError,
    count,
    one_line,
    shows_progress,
)
from pdr_graph.options import Options
from pdr_graph.whole_files import check_replaceable

lifelog = App("lifelog", help="Recordings of many days: places, activities, exports.")
Store = Annotated[Path, Parameter(help="The lifelog: one file, and STORE.d beside it.")]
LINE_PERIOD = 60.0  # [s] between two lines about the progress, where there is no terminal
RECORDED_WITH = ("plan", "fixes", "beacons", "ranges", "walker", "floor")  # options that are kept with a recording


@lifelog.command
def add(
    store: Store,
    /,
    *recordings: Path,
    person: str | None = None,
    options: Annotated[Options, only(*RECORDED_WITH)] = Options(),
    visited: Path | None = None,
    begins: str | None = None,
    phone: str | None = None,
    people: bool = False,
    copy: bool = False,
    quiet: Quiet = False,
) -> None:
    """Add recordings, photos and receipts to a lifelog; create it if it does not exist.

    A recording is added once, whatever its name. Options hold for all the RECORDINGs; a recording that is in the
    lifelog already keeps its present value of an option that is not given.

    pdr-graph lifelog add days.db walks/ --map maps/mall.geojson
    pdr-graph lifelog add days.db --visited receipts.csv ~/photos

    Args:
        recordings: Recordings: files, folders or zips; or folders full of them. Photos with a place in their EXIF tags.
        person: The person who recorded; default: me.
        visited: Receipts: CSV of place (of the diary or the plan) or lat,lon, and time or earliest,latest [,sigma].
        begins: Start of a recording without a clock, as ISO 8601; UTC without an offset.
        phone: Name of the person's phone or tag in the Bluetooth logs of others.
        people: Each RECORDING is a folder with a folder for each person, who has its name.
        copy: Copy the recordings to STORE.d; else the originals must stay.
    """
    from pdr_graph.apps.lifelog import ingest
    from pdr_graph.apps.lifelog.store import RecordingOptions

    if not recordings and visited is None:
        raise InputError("RECORDINGS", "", "nothing to add", "recordings, photos, or --visited receipts.csv")
    _check_order("add", store, recordings)
    start = None if begins is None else ingest.time_of(begins)
    kept = RecordingOptions(**{name: getattr(options, name) for name in RECORDED_WITH}, begins=start)
    if people and (person is not None or phone is not None or visited is not None):
        raise InputError("--people", "", "--person, --phone or --visited too", "the names of the folders alone")
    folders = ingest.folders_of_people(recordings) if people else {person: recordings}
    with _progress_bar() as advance:
        results = [
            ingest.add(
                store,
                own,
                kept,
                person=who,
                phone=phone,
                copy=copy,
                progress=partial(advance, who or ""),
                visited=visited,
            )
            for who, own in folders.items()
        ]
    result = sum(results[1:], results[0])
    counts = [f"{result.added} added"]
    counts += (
        [f"{result.existing} there already, {result.changed} of them with other options now"] if result.existing else []
    )
    counts += [f"{result.skipped} files skipped"] if result.skipped else []
    places = result.places
    counts += [f"{count(places.new, 'place')} of receipts and photos"] if places.new else []
    counts += [f"{count(places.existing, 'place')} there already"] if places.existing else []
    counts += [f"{count(places.unplaced, 'photo')} without place or time"] if places.unplaced else []
    echo(f"{', '.join(counts)} -> {store}")
    _end(result.refused, none=not result.added + result.existing + places.new + places.existing)


@lifelog.command(name="import")
def import_(
    store: Store,
    /,
    *files: Annotated[Path, Parameter(required=True)],
    person: str | None = None,
    zone: str | None = None,
    quiet: Quiet = False,
) -> None:
    """Import the past from Google, OwnTracks, GPX and other exports.

    The files are recognised by their content: Google Records.json, Semantic Location History, Timeline.json of Android
    and iOS and Timeline Edits; OwnTracks .rec, Overland, GPX, KML, TCX, FIT. Overlapping exports are merged; what
    Google guessed is kept apart from the positions.

    pdr-graph lifelog import days.db takeout.zip

    Args:
        files: Exports: files, folders or zips (a Google Takeout).
        person: The person; default: me.
        zone: Time zone of times that state none, as Europe/Berlin; local: that of each position; default: UTC.
    """
    from pdr_graph.apps.lifelog.past.importing import import_past

    _check_order("import", store, files)
    with _progress_bar() as advance:
        result = import_past(store, files, person, advance, zone)
    changed = result.positions
    usable = changed.new + changed.better + changed.existing + result.guesses
    counts = [count(changed.new, "new position"), f"{changed.existing} there already"]
    counts += [f"{changed.better} replaced by more accurate ones"] if changed.better else []
    counts += [f"{count(changed.days, 'day')} changed"]
    counts += [f"{result.guesses} guessed visits or activities"] if result.guesses else []
    counts += [f"{result.placed} positions from Wi-Fi scans"] if result.placed else []
    counts += [f"{count(result.skipped, 'file')} skipped"] if result.skipped else []
    echo(f"{', '.join(counts)} -> {store}" if usable else "nothing to import")
    echo_errors(*result.notes)
    _end(result.refused, none=not usable)
    if not usable:
        sys.exit(EXIT_NOTHING)


def _check_order(verb: str, store: Path, files: Sequence[Path]) -> None:
    """Raise InputError if the store is a folder, or a recording before a lifelog."""
    from pdr_graph.recovery import is_database  # it takes numpy, long to import

    named = next(filter(is_database, files), None)
    if store.is_dir() or (named and store.is_file() and not is_database(store)):
        expected = f"the lifelog first: pdr-graph lifelog {verb} {named or 'days.db'} {store}"
        raise InputError(store, "", "a folder" if store.is_dir() else "no lifelog", expected)


@lifelog.command
def build(
    store: Store,
    /,
    *,
    zone: str | None = None,
    paths: str | None = None,
    workers: PositiveCount = 1,
    scheduler: str = "",
    time_limit: Annotated[float, Parameter(validator=Number(gte=0.1))] = 15.0,
    together: bool = False,
    quiet: Quiet = False,
) -> None:
    """Bring a lifelog up to date.

    Detect the steps of new recordings, and reconstruct the days that they change. Finished days are saved: an
    interrupted build continues where it stopped.

    pdr-graph lifelog build days.db --zone Europe/Berlin --workers 2

    Args:
        zone: Time zone of the days, kept for later builds; default: local.
        paths: Ways outdoors that walks follow, kept for later builds; none: no ways.
        workers: Processes on this machine.
        scheduler: A Dask cluster, tcp://HOST:PORT (extra fleet). Its workers must see STORE.d and the recordings under
            the same paths: on other machines, a shared disk.
        time_limit: Longest time of one recording or day in a worker process, which is then ended [min].
        together: Then estimate the walks of a building or group in common graphs, thirty walks each.
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


@lifelog.command
def show(
    store: Store,
    /,
    *,
    person: tuple[str, ...] = (),
    date: str = "",
    week: str = "",
    month: str = "",
    year: str = "",
    place: str = "",
    guess_home: bool = False,
    all_: bool = False,
    json_: AsJson = False,
    tiles: str = "",
    out: Path | None = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Show a day, week, month, year, place or person.

    Prints a list or a table of at most 100 columns, and writes overview.html and tables to a folder that only its owner
    can read. The page has a calendar, maps and tables; that of one person's day moves. Several persons share one
    calendar. --person alone shows all days of that person. With --json files are written only with --out.

    pdr-graph lifelog show days.db
    pdr-graph lifelog show days.db --date 2024-05-01 --out monday
    pdr-graph lifelog show days.db --month 2024-05 --person anna --person ben
    pdr-graph lifelog show days.db --place Office --json

    Args:
        person: The person, several times for several; default: all.
        date: A day, as 2024-05-01; default: the last day.
        week: An ISO week, as 2024-W18.
        month: A month, as 2024-05.
        year: A year, as 2024.
        place: Only the visits to a place, by name or number; default: on all days.
        guess_home: Name the place of most nights "home?"; it is a guess.
        all_: List all persons and days instead.
        tiles: Map tiles behind the map, as https://tile.openstreetmap.org/{z}/{x}/{y}.png. Nothing is fetched without
            it; the server learns which area is drawn.
        out: Folder of page and tables; default: beside STORE.
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
    choice = Choice(person, period_of(date, week, month, year), place, guess_home)
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


@lifelog.command
def export(
    store: Store,
    /,
    *,
    out: Path,
    format_: Literal["gpx", "geojson", "kepler", "csv", "parquet"] = "gpx",
    person: str | None = None,
    from_: str = "",
    to: str = "",
    cut: Annotated[tuple[str, ...], HYPHEN] = (),
    blur: Annotated[tuple[str, ...], HYPHEN] = (),
    quiet: Quiet = False,
) -> None:
    """Export days as GPX, GeoJSON, CSV or GeoParquet.

    --cut leaves out private places. GeoParquet is for trackintel and movingpandas; kepler is GeoJSON for kepler.gl.

    pdr-graph lifelog export days.db --out days.gpx --cut 35.0001,135.0002,200

    Args:
        out: A folder for a file per day, or one file for all days.
        format_: csv and parquet require a folder; parquet needs the extra geo.
        person: The person; default: the only one, or all.
        from_: The first day; default: the first of all.
        to: The last day; default: the last of all.
        cut: Leave out everything near a place: LAT,LON,RADIUS in metres, a name on a plan, or a GeoJSON file of areas.
            Use the same text for a place in all exports. Repeatable.
        blur: Coarsen times and positions near a place, given as for --cut; repeatable.
    """
    from pdr_graph.apps.lifelog.export import export_days

    written, notes = export_days(store, out, format_, person, from_, to, cut, blur)
    echo_errors(*notes)
    echo(f"{count(len(written), 'file')} -> {out}")


def _end(refused: Sequence[str], none: bool = False) -> None:
    """Print each refused input on a line and exit with an error code. none: True if there was no other input."""
    echo_errors(*refused)
    if refused:
        sys.exit(EXIT_REFUSED if none else EXIT_DEGRADED)


def _progress_lines() -> Callable[[str, int, int], None]:
    """A function that prints a line a minute: what is done of a stage, and when it ends at the mean pace so far."""
    began, last = dict[str, tuple[float, int]](), [time.monotonic()]

    def advance(stage: str, done: int, of: int) -> None:
        now = time.monotonic()
        start, before = began.setdefault(stage, (now, done))
        if now - last[0] < LINE_PERIOD or done >= of or SILENT.get():
            return
        last[0] = now
        end = ""
        if done > before:
            left = datetime.now() + timedelta(seconds=(now - start) * (of - done) / (done - before))
            end = f", ends about {left:%Y-%m-%d %H:%M}"
        echo_errors(f"{stage or 'recordings'}: {done} of {of}{end}")

    return advance


@contextmanager
def _progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """A function that shows the progress of a stage: name, number done, total; a bar on a terminal, else lines."""
    if not shows_progress():
        yield _progress_lines()
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


lifelog.command(serve_lifelog, name="serve")

correct = App("correct", help="Correct days; corrections can be listed and undone.")
lifelog.command(correct)

Person = Annotated[str | None, Parameter(help="The person; default: the only one.")]
Time = Annotated[str, Parameter("TIME", help='Local time, as "2024-05-01 09:30", of the entry.')]
From = Annotated[str, Parameter("FROM", help='Local time, as "2024-05-01 09:30".')]
To = Annotated[str, Parameter("TO", help="Local time.")]


@correct.command
def was_at(
    store: Store,
    time: Time,
    place: Annotated[str, HYPHEN],
    /,
    *,
    radius: float | None = None,
    person: Person = None,
) -> None:
    """State where the person was at TIME.

    TIME is in a stay or in a time without data.

    The place enters the estimate instead of the positions recorded then.

    pdr-graph lifelog correct was-at days.db "2024-05-01 13:10" 48.1372,11.5755

    Args:
        place: LAT,LON or the name of a place.
        radius: Standard deviation of the place per axis [m]; default: 15.
    """
    from pdr_graph.apps.lifelog.revision import state_place

    _print(state_place(store, time, place, radius, person))


@correct.command
def merge(store: Store, start: From, end: To, /, *, person: Person = None) -> None:
    """Make one stay of all entries from FROM to TO.

    pdr-graph lifelog correct merge days.db "2024-05-01 09:30" "2024-05-01 12:05"
    """
    from pdr_graph.apps.lifelog import revision

    _print(revision.merge(store, start, end, person))


@correct.command
def split(store: Store, time: Time, /, *, person: Person = None) -> None:
    """Split the entry at TIME in two.

    pdr-graph lifelog correct split days.db "2024-05-01 10:45"
    """
    from pdr_graph.apps.lifelog import revision

    _print(revision.split(store, time, person))


@correct.command
def was(store: Store, start: From, end: To, mode: str, /, *, person: Person = None) -> None:
    """State what the person did from FROM to TO.

    A ride, a walk or a stop.

    pdr-graph lifelog correct was days.db "2024-05-01 08:40" "2024-05-01 09:05" bus

    Args:
        mode: bus, car, train, tram, ferry, bicycle, plane, ride, walk or stop.
    """
    from pdr_graph.apps.lifelog.revision import state_mode

    _print(state_mode(store, start, end, mode, person))


@correct.command
def not_me(store: Store, start: From, end: To, /, *, person: Person = None) -> None:
    """State that somebody else carried the phone from FROM to TO.

    This time is shown as no data.

    pdr-graph lifelog correct not-me days.db "2024-05-01 18:00" "2024-05-01 19:30"
    """
    from pdr_graph.apps.lifelog.revision import state_not_me

    _print(state_not_me(store, start, end, person))


@correct.command
def name(
    store: Store,
    place: Annotated[str, HYPHEN],
    called: Annotated[str, Parameter("NAME")],
    /,
    *,
    radius: float | None = None,
    person: Person = None,
) -> None:
    """Name a place.

    pdr-graph lifelog correct name days.db "2024-05-01 13:10" "the library"

    Args:
        place: LAT,LON, or the local time of a stay there.
        called: What to call it.
        radius: Radius of the place [m]; default: 75.
    """
    from pdr_graph.apps.lifelog.revision import name_place

    _print(name_place(store, place, called, radius, person))


@correct.command
def forget(
    store: Store,
    start: From | None = None,
    end: To | None = None,
    /,
    *,
    person: Person = None,
    everything: bool = False,
    recording: str | None = None,
    place: Annotated[str | None, HYPHEN] = None,
    radius: float | None = None,
) -> None:
    """Delete the time from FROM to TO for good, or all times at a place.

    No byte of it remains in the lifelog and its files.

    Recordings that are added again stay without it. Your own files are not touched: they are named.

    pdr-graph lifelog correct forget days.db "2024-05-01 18:00" "2024-05-01 19:00"
    pdr-graph lifelog correct forget days.db --place "the library"
    pdr-graph lifelog correct forget days.db --person ben --everything

    Args:
        everything: All of the --person.
        recording: One recording, by path or hash, and what was made of it.
        place: All times at a place, by name, number or LAT,LON, and its name; of all days.
        radius: Radius of that place [m]; default: 100.
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


@correct.command(name="list")
def list_(store: Store, /, *, person: Person = None) -> None:
    """List all corrections, numbered, with the time when each was made.

    pdr-graph lifelog correct list days.db
    """
    from pdr_graph.apps.lifelog.revision import listing

    _print(listing(store, person))


@correct.command
def undo(store: Store, number: Annotated[Count, Parameter("N")], /) -> None:
    """Undo a correction. What was deleted does not come back.

    pdr-graph lifelog correct undo days.db 3

    Args:
        number: Number of the correction, as in list.
    """
    from pdr_graph.apps.lifelog import revision

    _print(revision.undo(store, number))


def _print(lines: Iterable[str]) -> None:
    for line in lines:
        echo(line)
