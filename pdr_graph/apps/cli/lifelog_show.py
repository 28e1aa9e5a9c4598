"""``pdr-graph lifelog show``: days, weeks, months, years, places and persons."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pdr_graph.apps.cli.options import AsJson, Force, Quiet
from pdr_graph.apps.cli.terminal import echo, echo_lines, echo_result
from pdr_graph.errors import count, one_line
from pdr_graph.whole_files import check_replaceable

StorePath = Annotated[Path, typer.Argument(metavar="STORE", help="The lifelog.")]
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
    Path | None, typer.Option("--out", metavar="DIR", help="Folder of page, picture and tables; default: beside STORE.")
]


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

    Prints a list or a table of at most 100 columns, and writes overview.html, overview.png and tables to a folder that
    only its owner can read; of one person's day also report.html, to play with. Several persons share one calendar.
    --person alone shows all days of that person. With --json files are written only with --out.

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
        from pdr_graph.apps.lifelog.maps import check_template  # imports matplotlib, which is slow

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

    with Store(path) as log:
        days = log.days()
    for (person, date), day in days.items():
        echo(f"{one_line(person)}  {date}  {count(len(day.recordings), 'recording')}")
