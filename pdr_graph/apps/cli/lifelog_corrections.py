"""``pdr-graph lifelog correct``: a function for each kind of correction, which imports what it uses."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from pdr_graph.apps.cli.terminal import App, echo
from pdr_graph.errors import InputError

correct = App(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Correct days; corrections can be listed and undone.",
)

StorePath = Annotated[Path, typer.Argument(metavar="STORE", help="The lifelog.")]
Person = Annotated[str | None, typer.Option(metavar="NAME", help="The person; default: the only one.")]
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
    person: Person = None,
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
def merge(store: StorePath, start: From, end: To, person: Person = None) -> None:
    """Make one stay of all entries from FROM to TO.

    \b
    pdr-graph lifelog correct merge days.db "2024-05-01 09:30" "2024-05-01 12:05"
    """
    from pdr_graph.apps.lifelog import revision

    _print(revision.merge(store, start, end, person))


@correct.command("split")
def split(store: StorePath, time: At, person: Person = None) -> None:
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
        str, typer.Argument(metavar="MODE", help="bus, car, train, tram, ferry, bicycle, ride, walk or stop.")
    ],
    person: Person = None,
) -> None:
    """State what the person did from FROM to TO.

    A ride, a walk or a stop.

    \b
    pdr-graph lifelog correct was days.db "2024-05-01 08:40" "2024-05-01 09:05" bus
    """
    from pdr_graph.apps.lifelog.revision import state_mode

    _print(state_mode(store, start, end, mode, person))


@correct.command("not-me")
def not_me(store: StorePath, start: From, end: To, person: Person = None) -> None:
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
    person: Person = None,
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
    person: Person = None,
    everything: Annotated[bool, typer.Option("--everything", help="All of the --person.")] = False,
    recording: Annotated[
        str | None, typer.Option(metavar="PATH|HASH", help="One recording, and what was made of it.")
    ] = None,
) -> None:
    """Delete the time from FROM to TO for good.

    No byte of it remains in the lifelog and its files.

    Recordings that are added again stay without it. Your own files are not touched: they are named.

    \b
    pdr-graph lifelog correct forget days.db "2024-05-01 18:00" "2024-05-01 19:00"
    pdr-graph lifelog correct forget days.db --person ben --everything
    """
    from pdr_graph.apps.lifelog import revision

    span = [text for text in (start, end) if text is not None]
    if len(span) == 2 and not everything and recording is None:
        _print(revision.forget(store, span[0], span[1], person))
    elif not span and everything and person is not None and recording is None:
        _print(revision.forget_person(store, person))
    elif not span and not everything and recording is not None:
        _print(revision.forget_recording(store, recording))
    else:
        expected = "FROM and TO, or --person NAME --everything, or --recording PATH"
        raise InputError("forget", "", "another combination of arguments", expected)


@correct.command("list")
def list_(store: StorePath, person: Person = None) -> None:
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
