"""A person's days reconstructed by a worker, one after the other: from what was observed to a file of each day's rows.

A chain has paths and keys, no objects; the only writer of the store takes the files that come of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pdr_graph.gait.profile import Profile
from pdr_graph.lifelog import files, observing
from pdr_graph.lifelog.day import Day
from pdr_graph.lifelog.rows import Rows, profile_of, profile_row, rows_of
from pdr_graph.lifelog.store import Built
from pdr_graph.online.codec import pack, unpack

if TYPE_CHECKING:
    from pdr_graph.lifelog.observation import Observation

Reconstruct = Callable[[str, str, "Mapping[str, Observation]", Profile | None], Day]  # as of days.reconstruct


@dataclass(frozen=True)
class Planned:
    """A day to be made of recordings, given by hash and key of the observation, in order of time.

    built: what is in the store, None if nothing.
    """

    date: str
    recordings: tuple[tuple[str, str], ...]
    built: Built | None


@dataclass(frozen=True)
class Chain:
    """Days of a person one after the other, from the first on that is left.

    profile: what is known of the walker before it; folder: ``STORE.d``; made_by: the version that makes them.
    """

    person: str
    days: tuple[Planned, ...]
    profile: Profile | None
    folder: str
    made_by: str

    @property
    def key(self) -> str:
        """Of the first day that is left."""
        known = None if self.profile is None else profile_row(self.profile)
        return files.key_of(self.person, self.days[0].date, self.days[0].recordings, known)

    @property
    def file(self) -> Path:
        """Of the rows of the first day that is left."""
        return Path(self.folder) / files.DAYS / self.key

    def after(self, profile: Profile | None) -> Chain:
        """The chain without its first day, after which this is known."""
        return replace(self, days=self.days[1:], profile=profile)


@dataclass(frozen=True)
class Done:
    """What became of a day. file: its rows, "" where the store has them already; failure: why there are none."""

    person: str
    date: str
    file: str = ""
    failure: str = ""


def reconstructed(chains: Sequence[Chain], reconstruct: Reconstruct | None = None) -> Iterator[Done]:
    """Reconstruct days, each into its file. reconstruct: as of `days.reconstruct`, which it is by default.

    A day that fails is as if it had taught nothing. Raises OSError if a file cannot be written.
    """
    for chain in chains:
        while chain.days:
            day, chain = _ready(chain) or _made(chain, reconstruct)
            yield day


def unmade(chain: Chain) -> Chain:
    """A chain from the first day on that the store has not as it would be made."""
    while chain.days and (built := chain.days[0].built) is not None and built.key == chain.key:
        chain = chain.after(built.profile)
    return chain


def past(chain: Chain, said: str) -> tuple[list[Done], Chain]:
    """What became of the days of a chain whose process ended, the one that ended it last; and the chain after that."""
    days: list[Done] = []
    while chain.days and (ready := _ready(chain)) is not None:
        day, chain = ready
        days.append(day)
    if chain.days:
        days.append(Done(chain.person, chain.days[0].date, failure=said))
        chain = chain.after(chain.profile)
    return days, chain


def rows_in(file: Path) -> Rows | None:
    """The rows of a day that a worker made; None if they are not there, or damaged."""
    return files.read(file, lambda blob: {table: list(map(tuple, rows)) for table, rows in unpack(blob).items()})


def _ready(chain: Chain) -> tuple[Done, Chain] | None:
    """What became of the first day and the chain after it, if it is made already."""
    rest = unmade(replace(chain, days=chain.days[:1]))
    if not rest.days:
        return Done(chain.person, chain.days[0].date), chain.after(rest.profile)
    rows = rows_in(chain.file)
    return None if rows is None else _done(chain, rows)


def _made(chain: Chain, reconstruct: Reconstruct | None) -> tuple[Done, Chain]:
    """What becomes of the first day, and the chain after it."""
    recordings = [name for name, _ in chain.days[0].recordings]
    try:
        rows = rows_of(_day(chain, reconstruct), chain.key, recordings)
        blob = pack(rows)
    except Exception as error:  # of one day: the others go on
        return Done(chain.person, chain.days[0].date, failure=observing.said_of(error)), chain.after(chain.profile)
    files.write(chain.file, blob)
    return _done(chain, rows)


def _done(chain: Chain, rows: Rows) -> tuple[Done, Chain]:
    profile = next((profile_of(row[2:]) for row in rows["profile"]), None)
    return Done(chain.person, chain.days[0].date, str(chain.file)), chain.after(profile)


def _day(chain: Chain, reconstruct: Reconstruct | None) -> Day:
    """The first day, reconstructed."""
    files.check_maker(chain.made_by)
    if reconstruct is None:
        from pdr_graph.lifelog.days import reconstruct  # it takes all of estimation
    observations = observing.observations_in(Path(chain.folder), chain.days[0].recordings)
    return reconstruct(chain.person, chain.days[0].date, observations, chain.profile)
