"""Build a lifelog: plan what has changed, distribute it to workers, store their results.

Two stages: each recording is observed independently; then the days of each person are reconstructed in order. A task
for a worker has paths and keys, no objects. The file of a result is named by its key, the hash of its inputs, which the
store keeps with the day. Hence a day is computed once, a new day costs one day, and a build after kill -9 continues.
"""

from __future__ import annotations

import platform
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, tzinfo
from functools import lru_cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING
from zoneinfo import ZoneInfo

from pdr_graph.errors import InputError
from pdr_graph.floor.formats import plan_fingerprint
from pdr_graph.gait.walker import Profile
from pdr_graph.io.beacons import BEACON_LIST
from pdr_graph.lifelog import cache, observation
from pdr_graph.lifelog.day import Day
from pdr_graph.lifelog.observation import ObservationResult, ObservationTask, Observe, observed
from pdr_graph.lifelog.store import ZONE, Built, DayRows, Entry, Rows, Store, profile_of, profile_row, rows_of
from pdr_graph.lifelog.workers import Fleet, Lost, Work, fleet, packed
from pdr_graph.storage import decode, encode, fingerprint

if TYPE_CHECKING:
    from pdr_graph.lifelog.observation import Observation


Reconstruct = Callable[[str, str, "Mapping[str, Observation]", Profile | None], Day]  # as `reconstruct.reconstruct`


@dataclass(frozen=True)
class Planned:
    """A day to reconstruct; recordings: (hash, key of the observation), in time order.

    built: the day in the store, None if there is none.
    """

    date: str
    recordings: tuple[tuple[str, str], ...]
    built: Built | None


@dataclass(frozen=True)
class Chain:
    """Consecutive days of a person that are still to be reconstructed.

    profile: of the walker before the first of them; folder: ``STORE.d``; made_by: version of this package.
    """

    person: str
    days: tuple[Planned, ...]
    profile: Profile | None
    folder: str
    made_by: str

    @property
    def key(self) -> str:
        """Key of the first day: the hash of its inputs."""
        known = None if self.profile is None else profile_row(self.profile)
        return cache.key_of(self.person, self.days[0].date, self.days[0].recordings, known)

    @property
    def file(self) -> Path:
        """File of the rows of the first day."""
        return Path(self.folder) / cache.DAYS / self.key

    def after(self, profile: Profile | None) -> Chain:
        """The chain without its first day, and with the profile after it."""
        return replace(self, days=self.days[1:], profile=profile)


@dataclass(frozen=True)
class Done:
    """Result for a day. file: of its rows, "" if they are in the store already; failure: reason, "" if none."""

    person: str
    date: str
    file: str = ""
    failure: str = ""


def reconstructed(chains: Sequence[Chain], reconstruct: Reconstruct | None = None) -> Iterator[Done]:
    """Reconstruct days and write each to its file. reconstruct: a replacement for `reconstruct.reconstruct`, for tests.

    A day that fails is as if it had taught nothing. Raises OSError if a file cannot be written.
    """
    for chain in chains:
        while chain.days:
            day, chain = _ready(chain) or _made(chain, reconstruct)
            yield day


def unmade(chain: Chain) -> Chain:
    """The chain from its first day that is not up to date in the store."""
    while chain.days and (built := chain.days[0].built) is not None and built.key == chain.key:
        chain = chain.after(built.profile)
    return chain


def past(chain: Chain, said: str) -> tuple[list[Done], Chain]:
    """Results of a chain whose process crashed, last the day that crashed it; and the chain after that day."""
    days: list[Done] = []
    while chain.days and (ready := _ready(chain)) is not None:
        day, chain = ready
        days.append(day)
    if chain.days:
        days.append(Done(chain.person, chain.days[0].date, failure=said))
        chain = chain.after(chain.profile)
    return days, chain


def rows_in(file: Path) -> Rows | None:
    """Read the rows of a day from its file; None if it is missing or damaged."""
    return cache.read(file, lambda blob: decode(blob, DayRows).tables)


def _ready(chain: Chain) -> tuple[Done, Chain] | None:
    """Result of the first day and the chain after it, if the day is up to date already; else None."""
    rest = unmade(replace(chain, days=chain.days[:1]))
    if not rest.days:
        return Done(chain.person, chain.days[0].date), chain.after(rest.profile)
    rows = rows_in(chain.file)
    return None if rows is None else _done(chain, rows)


def _made(chain: Chain, reconstruct: Reconstruct | None) -> tuple[Done, Chain]:
    """Reconstruct the first day; returns its result and the chain after it."""
    recordings = [name for name, _ in chain.days[0].recordings]
    try:
        rows = rows_of(_day(chain, reconstruct), chain.key, recordings)
        blob = encode(DayRows(rows))
    except Exception as error:  # a failure of one day must not stop the others
        return Done(chain.person, chain.days[0].date, failure=observation.error_text(error)), chain.after(chain.profile)
    cache.write(chain.file, blob)
    return _done(chain, rows)


def _done(chain: Chain, rows: Rows) -> tuple[Done, Chain]:
    profile = next((profile_of(row[2:]) for row in rows["profile"]), None)
    return Done(chain.person, chain.days[0].date, str(chain.file)), chain.after(profile)


def _day(chain: Chain, reconstruct: Reconstruct | None) -> Day:
    """Reconstruct the first day. Raises InputError if an observation is missing."""
    cache.check_maker(chain.made_by)
    if reconstruct is None:
        from pdr_graph.lifelog.reconstruct import reconstruct  # imports all of estimation, which is slow
    observations = observation.observations_in(Path(chain.folder), chain.days[0].recordings)
    return reconstruct(chain.person, chain.days[0].date, observations, chain.profile)


PACKAGES = ("pdr_graph", "gtsam", "numpy", "scipy")  # packages whose versions are stored
Told = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Outcome:
    """Result of a build. built: number of days built; kept: number up to date; failures: reasons of failed days,
    and refusals: why recordings could not be observed, a line each.
    """

    built: int
    kept: int
    failures: tuple[str, ...]
    refusals: tuple[str, ...]


def build(
    store: Path,
    zone: str | None = None,
    workers: int = 1,
    scheduler: str = "",
    told: Told = lambda stage, done, of: None,
    observe: Observe | None = None,
    reconstruct: Reconstruct | None = None,
) -> Outcome:
    """Bring a lifelog up to date.

    zone: whose midnights part the days, from now on; workers: processes on this machine; scheduler: address of a Dask
    cluster, whose workers see the same paths; told: stage, how many are done, of how many.
    observe, reconstruct: as of `observation.observe` and `reconstruct.reconstruct`, which they are by default.

    Raises InputError if the lifelog, the zone or the scheduler cannot be used; OSError of the disk.
    """
    with Store(store) as log, fleet(workers, scheduler) as crew:
        if zone is not None:
            zone_of(zone)
            log.set(ZONE, zone)
        seeing, making = partial(observed, observe=observe), partial(reconstructed, reconstruct=reconstruct)
        _observe(log, crew, seeing, _not_observed(log), told)
        days = _days(log)
        log.begin([own for own, built in log.days().items() if not set(built.recordings) <= set(days.get(own, ()))])
        chains = _chains(log, days)
        _observe(log, crew, seeing, _not_there(log, chains), told)
        built = _reconstruct(log, crew, making, chains, told)
        if built:
            log.built_with({name: version(name) for name in PACKAGES} | {"python": platform.python_version()})
        _tidy(log)
        failures = tuple(f"{person}, {date}: {said}" for person, date, said in log.failures())
        refusals = tuple(entry.refusal for entry in log.entries() if entry.refusal)
    return Outcome(built, len(days) - built - len(failures), failures, refusals)


def zone_of(name: str) -> tzinfo:
    """Look up a time zone. Raises InputError for an unknown name."""
    if name == "UTC":
        return UTC  # works without an installed time zone database
    try:
        return ZoneInfo(name)
    except (OSError, ValueError, LookupError):
        raise InputError("--zone", "", repr(name), "a time zone, as Europe/Berlin") from None


def _not_observed(log: Store) -> list[ObservationTask]:
    """Tasks for recordings whose observation is missing or out of date."""
    sought: list[ObservationTask] = []
    for entry, found in _looked_at(log, log.entries()):
        if isinstance(found, str):
            log.put(replace(entry, refusal=found))
        elif found.key != entry.observation:
            sought.append(found)
        elif entry.refusal:
            log.put(replace(entry, refusal=""))
    return sought


def _not_there(log: Store, chains: Sequence[Chain]) -> list[ObservationTask]:
    """Tasks for recordings of out-of-date days whose observation files are missing."""
    keys = {key for chain in chains for day in chain.days for _, key in day.recordings}
    gone = {key for key in keys if not (log.folder / cache.OBSERVATIONS / key).exists()}
    entries = [entry for entry in log.entries() if entry.observation in gone]
    return [found for _, found in _looked_at(log, entries) if isinstance(found, ObservationTask) and found.key in gone]


def _looked_at(log: Store, entries: Sequence[Entry]) -> Iterator[tuple[Entry, ObservationTask | str]]:
    """Each recording with its task, or with the reason for which there is none."""
    hashes = {"plan": lru_cache(None)(plan_fingerprint), "": lru_cache(None)(fingerprint)}  # each file once
    for entry in entries:
        try:
            yield entry, _sought(log, entry, hashes)
        except InputError as error:
            yield entry, str(error)


def _sought(log: Store, entry: Entry, hashes: Mapping[str, Callable[[Path], str]]) -> ObservationTask:
    """The task of a recording; its key covers the content of every file that is read."""
    options, read = entry.options, dict(entry.options.files)
    listed = Path(entry.path).with_name(BEACON_LIST)
    if "beacons" not in read and listed.is_file():
        read["list of beacons"] = listed
    content = [(name, _hash(hashes, name, path, entry)) for name, path in read.items()]
    key = cache.key_of(entry.hash, options.floor or "", options.begins, str(options.plan or ""), content)
    file = str(log.folder / cache.OBSERVATIONS / key)
    return ObservationTask(entry.hash, key, file, entry.path, options, cache.MADE_BY)


def _hash(hashes: Mapping[str, Callable[[Path], str]], name: str, path: Path, entry: Entry) -> str:
    """Content hash of a file that belongs to a recording."""
    try:
        return hashes.get(name, hashes[""])(path)
    except OSError as error:
        raise InputError(path, "", error.strerror or str(error), f"the {name} of {entry.path}") from None


def _observe(log: Store, crew: Fleet, work: Work, sought: Sequence[ObservationTask], told: Told) -> None:
    """Let workers observe recordings, and store each result."""
    entries = {entry.hash: entry for entry in log.entries()}
    tasks = packed(sought, [1] * len(sought), crew.workers)
    for done, seen in enumerate(crew.run(work, tasks), start=1):
        if isinstance(seen, Lost):
            seen = ObservationResult(seen.item.hash, "", refusal=f"{seen.item.path}: {seen.reason}")
        log.put(_noted(entries[seen.hash], seen))
        told("recordings", done, len(sought))


def _noted(entry: Entry, seen: ObservationResult) -> Entry:
    """Update a recording with the result; a refusal keeps the earlier observation."""
    if seen.refusal:
        return replace(entry, refusal=seen.refusal)
    found = {"epoch": seen.epoch, "duration": seen.duration, "steps": seen.steps}
    return replace(entry, observation=seen.key, refusal="", **found)


def _days(log: Store) -> dict[tuple[str, str], dict[str, str]]:
    """Map (person, date) -> recordings that began on that day, both in order."""
    zone, days = zone_of(log.setting(ZONE)), defaultdict[tuple[str, str], dict[str, str]](dict)
    observed = [(entry.epoch, entry) for entry in log.entries() if entry.epoch is not None]
    for epoch, entry in sorted(observed, key=lambda pair: (pair[0], pair[1].hash)):
        date = datetime.fromtimestamp(epoch, zone).date().isoformat()
        days[entry.person, date][entry.hash] = entry.observation
    return dict(sorted(days.items()))


def _chains(log: Store, days: Mapping[tuple[str, str], Mapping[str, str]]) -> list[Chain]:
    """Chain of each person, from the first day that is not up to date."""
    built, planned = log.days(), defaultdict[str, list[Planned]](list)
    for (person, date), recordings in days.items():
        planned[person].append(Planned(date, tuple(recordings.items()), built.get((person, date))))
    chains = [Chain(person, tuple(its), None, str(log.folder), cache.MADE_BY) for person, its in planned.items()]
    return [chain for whole in chains if (chain := unmade(whole)).days]


def _reconstruct(log: Store, crew: Fleet, work: Work, chains: Sequence[Chain], told: Told) -> int:
    """Let workers reconstruct days and store them; returns their number."""
    built, seen, total = 0, 0, sum(len(chain.days) for chain in chains)
    while chains:
        left: list[Chain] = []
        for made in crew.run(work, packed(chains, [len(chain.days) for chain in chains], crew.workers)):
            days, rest = past(made.item, made.reason) if isinstance(made, Lost) else ([made], None)
            left += [rest] if rest is not None and rest.days else []
            for day in days:
                built, seen = built + _taken(log, day), seen + 1
                told("days", seen, total)
        chains = left
    return built


def _taken(log: Store, day: Done) -> bool:
    """Store a day or the reason for its failure; True if a new day was stored."""
    rows = rows_in(Path(day.file)) if day.file else None
    if rows is not None:
        log.take(rows)
        Path(day.file).unlink()
    elif day.failure or day.file:
        log.failed(day.person, day.date, day.failure or f"{day.file}: damaged on its way")
    return rows is not None


def _tidy(log: Store) -> None:
    """Remove unused files, and temporary files of processes that were killed."""
    cache.keep(log.folder / cache.OBSERVATIONS, {entry.observation for entry in log.entries()})
    cache.keep(log.folder / cache.DAYS, set())
    cache.keep_whole(log.folder / cache.COPIES)
