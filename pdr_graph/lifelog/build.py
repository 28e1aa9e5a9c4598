"""Build a lifelog: plan what has changed, distribute it to workers, store their results.

Two stages: each recording is observed independently; then the days of each person are reconstructed in order. A task
for a worker has paths and keys, no objects. The file of a result is named by its key, the hash of its inputs, which the
store keeps with the day. Hence a day is computed once, a new day costs one day, and a build after kill -9 continues
where it stopped.
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
from pdr_graph.lifelog.observation import ObservationResult, ObservationTask, Observe, observe_all
from pdr_graph.lifelog.store import ZONE, DayRows, Entry, Rows, Store, StoredDay, profile_of, profile_row, rows_of
from pdr_graph.lifelog.workers import CrashedItem, Fleet, Work, fleet, pack
from pdr_graph.storage import decode, encode, fingerprint

if TYPE_CHECKING:
    from pdr_graph.lifelog.observation import Observation


Reconstruct = Callable[[str, str, "Mapping[str, Observation]", Profile | None], Day]  # as `reconstruct.reconstruct`


@dataclass(frozen=True)
class PlannedDay:
    """A day to reconstruct. recordings: (hash, key of the observation), in time order; built: the day in the store,
    None if there is none.
    """

    date: str
    recordings: tuple[tuple[str, str], ...]
    built: StoredDay | None


@dataclass(frozen=True)
class DayChain:
    """Consecutive days of a person that are still to be reconstructed.

    profile: of the walker before the first day; folder: ``STORE.d``; version: `cache.RESULT_VERSION` of the build.
    """

    person: str
    days: tuple[PlannedDay, ...]
    profile: Profile | None
    folder: str
    version: str

    @property
    def key(self) -> str:
        """Key of the first day: the hash of its inputs."""
        known = None if self.profile is None else profile_row(self.profile)
        return cache.key_of(self.person, self.days[0].date, self.days[0].recordings, known)

    @property
    def file(self) -> Path:
        """File of the rows of the first day."""
        return Path(self.folder) / cache.DAYS / self.key

    def after(self, profile: Profile | None) -> DayChain:
        """The chain without its first day, and with the profile after it."""
        return replace(self, days=self.days[1:], profile=profile)


@dataclass(frozen=True)
class DayResult:
    """Result for a day. file: of its rows, "" if they are in the store already; failure: its reason, "" if none."""

    person: str
    date: str
    file: str = ""
    failure: str = ""


def reconstruct_days(chains: Sequence[DayChain], reconstruct: Reconstruct | None = None) -> Iterator[DayResult]:
    """Reconstruct days and write each to its file; yields a result per day.

    reconstruct: a replacement for `reconstruct.reconstruct`, for tests. A day that fails leaves the profile unchanged.
    Raises OSError if a file cannot be written.
    """
    for chain in chains:
        while chain.days:
            day, chain = _existing_result(chain) or _reconstruct_first(chain, reconstruct)
            yield day


def outdated_part(chain: DayChain) -> DayChain:
    """The chain from its first day that is not up to date in the store."""
    while chain.days and (built := chain.days[0].built) is not None and built.key == chain.key:
        chain = chain.after(built.profile)
    return chain


def skip_crashed(chain: DayChain, reason: str) -> tuple[list[DayResult], DayChain]:
    """Results of a chain whose process crashed, up to the day that crashed it; and the chain after that day."""
    days: list[DayResult] = []
    while chain.days and (ready := _existing_result(chain)) is not None:
        day, chain = ready
        days.append(day)
    if chain.days:
        days.append(DayResult(chain.person, chain.days[0].date, failure=reason))
        chain = chain.after(chain.profile)
    return days, chain


def read_rows(file: Path) -> Rows | None:
    """Read the rows of a day from its file; None if it is missing or damaged."""
    return cache.read(file, lambda blob: decode(blob, DayRows).tables)


def _existing_result(chain: DayChain) -> tuple[DayResult, DayChain] | None:
    """Result of the first day and the chain after it, if the day is up to date; else None."""
    rest = outdated_part(replace(chain, days=chain.days[:1]))
    if not rest.days:
        return DayResult(chain.person, chain.days[0].date), chain.after(rest.profile)
    rows = read_rows(chain.file)
    return None if rows is None else _result(chain, rows)


def _reconstruct_first(chain: DayChain, reconstruct: Reconstruct | None) -> tuple[DayResult, DayChain]:
    """Reconstruct the first day and write its rows; returns its result and the chain after it."""
    recordings = [name for name, _ in chain.days[0].recordings]
    try:
        rows = rows_of(_reconstructed_day(chain, reconstruct), chain.key, recordings)
        blob = encode(DayRows(rows))
    except Exception as error:  # a failure of one day must not stop the others
        failure = observation.error_text(error)
        return DayResult(chain.person, chain.days[0].date, failure=failure), chain.after(chain.profile)
    cache.write(chain.file, blob)
    return _result(chain, rows)


def _result(chain: DayChain, rows: Rows) -> tuple[DayResult, DayChain]:
    """Result of the first day, whose rows are in its file, and the chain after it with the profile of that day."""
    profile = next((profile_of(row[2:]) for row in rows["profile"]), None)
    return DayResult(chain.person, chain.days[0].date, str(chain.file)), chain.after(profile)


def _reconstructed_day(chain: DayChain, reconstruct: Reconstruct | None) -> Day:
    """Reconstruct the first day. Raises InputError if an observation is missing or the worker has another version."""
    cache.check_version(chain.version)
    if reconstruct is None:
        from pdr_graph.lifelog.reconstruct import reconstruct  # imports all of estimation, which is slow
    observations = observation.read_observations(Path(chain.folder), chain.days[0].recordings)
    return reconstruct(chain.person, chain.days[0].date, observations, chain.profile)


PACKAGES = ("pdr_graph", "gtsam", "numpy", "scipy")  # whose versions are stored with a build
Progress = Callable[[str, int, int], None]  # called with the name of a stage, the tasks done, and all tasks


@dataclass(frozen=True)
class BuildResult:
    """Result of a build. built: number of days built; up_to_date: number of days that needed no work; failures: why
    days failed; refusals: why recordings could not be observed, a line each.
    """

    built: int
    up_to_date: int
    failures: tuple[str, ...]
    refusals: tuple[str, ...]


def build(
    store: Path,
    zone: str | None = None,
    workers: int = 1,
    scheduler: str = "",
    progress: Progress = lambda stage, done, total: None,
    observe: Observe | None = None,
    reconstruct: Reconstruct | None = None,
) -> BuildResult:
    """Bring a lifelog up to date: observe recordings and reconstruct days where an input changed.

    zone: time zone whose midnights separate the days, stored for later builds; workers: processes on this machine;
    scheduler: address of a Dask cluster whose workers see the same paths. observe, reconstruct: replacements for
    `observation.observe` and `reconstruct.reconstruct`, for tests.

    Raises InputError if the lifelog, the zone or the scheduler cannot be used; OSError of the disk.
    """
    with Store(store) as log, fleet(workers, scheduler) as crew:
        if zone is not None:
            zone_of(zone)
            log.put_setting(ZONE, zone)
        observe_work, reconstruct_work = (
            partial(observe_all, observe=observe),
            partial(reconstruct_days, reconstruct=reconstruct),
        )
        _observe(log, crew, observe_work, _outdated_observations(log), progress)
        days = _recordings_by_day(log)
        log.begin_build(
            [own for own, built in log.days().items() if not set(built.recordings) <= set(days.get(own, ()))]
        )
        chains = _chains(log, days)
        _observe(log, crew, observe_work, _missing_observations(log, chains), progress)
        built = _reconstruct(log, crew, reconstruct_work, chains, progress)
        if built:
            log.put_versions({name: version(name) for name in PACKAGES} | {"python": platform.python_version()})
        _remove_unused_files(log)
        failures = tuple(f"{person}, {date}: {reason}" for person, date, reason in log.failures())
        refusals = tuple(entry.refusal for entry in log.entries() if entry.refusal)
    return BuildResult(built, len(days) - built - len(failures), failures, refusals)


def zone_of(name: str) -> tzinfo:
    """Look up a time zone. Raises InputError for an unknown name."""
    if name == "UTC":
        return UTC  # works without an installed time zone database
    try:
        return ZoneInfo(name)
    except (OSError, ValueError, LookupError):
        raise InputError("--zone", "", repr(name), "a time zone, as Europe/Berlin") from None


def _outdated_observations(log: Store) -> list[ObservationTask]:
    """Tasks for recordings whose observation is missing or out of date; refusals are stored."""
    sought: list[ObservationTask] = []
    for entry, found in _tasks_of(log, log.entries()):
        if isinstance(found, str):
            log.put(replace(entry, refusal=found))
        elif found.key != entry.observation:
            sought.append(found)
        elif entry.refusal:
            log.put(replace(entry, refusal=""))
    return sought


def _missing_observations(log: Store, chains: Sequence[DayChain]) -> list[ObservationTask]:
    """Tasks for recordings of out-of-date days whose observation files are missing."""
    keys = {key for chain in chains for day in chain.days for _, key in day.recordings}
    gone = {key for key in keys if not (log.folder / cache.OBSERVATIONS / key).exists()}
    entries = [entry for entry in log.entries() if entry.observation in gone]
    return [found for _, found in _tasks_of(log, entries) if isinstance(found, ObservationTask) and found.key in gone]


def _tasks_of(log: Store, entries: Sequence[Entry]) -> Iterator[tuple[Entry, ObservationTask | str]]:
    """Each recording with its task, or with the reason why it has none."""
    hashes = {"plan": lru_cache(None)(plan_fingerprint), "": lru_cache(None)(fingerprint)}  # each file once
    for entry in entries:
        try:
            yield entry, _task(log, entry, hashes)
        except InputError as error:
            yield entry, str(error)


def _task(log: Store, entry: Entry, hashes: Mapping[str, Callable[[Path], str]]) -> ObservationTask:
    """The task of a recording; its key covers the content of every file that is read."""
    options, read = entry.options, dict(entry.options.files)
    listed = Path(entry.path).with_name(BEACON_LIST)
    if "beacons" not in read and listed.is_file():
        read["list of beacons"] = listed
    content = [(name, _hash(hashes, name, path, entry)) for name, path in read.items()]
    key = cache.key_of(entry.hash, options.floor or "", options.begins, str(options.plan or ""), content)
    file = str(log.folder / cache.OBSERVATIONS / key)
    return ObservationTask(entry.hash, key, file, entry.path, options, cache.RESULT_VERSION)


def _hash(hashes: Mapping[str, Callable[[Path], str]], name: str, path: Path, entry: Entry) -> str:
    """Content hash of a file that is read with a recording; plans have a hash of their own."""
    try:
        return hashes.get(name, hashes[""])(path)
    except OSError as error:
        raise InputError(path, "", error.strerror or str(error), f"the {name} of {entry.path}") from None


def _observe(log: Store, crew: Fleet, work: Work, sought: Sequence[ObservationTask], progress: Progress) -> None:
    """Let workers observe recordings, and store each result."""
    entries = {entry.hash: entry for entry in log.entries()}
    tasks = pack(sought, [1] * len(sought), crew.workers)
    for done, seen in enumerate(crew.run(work, tasks), start=1):
        if isinstance(seen, CrashedItem):
            seen = ObservationResult(seen.item.hash, "", refusal=f"{seen.item.path}: {seen.reason}")
        log.put(_updated(entries[seen.hash], seen))
        progress("recordings", done, len(sought))


def _updated(entry: Entry, seen: ObservationResult) -> Entry:
    """The entry with the result of an observation; a refusal keeps the earlier observation."""
    if seen.refusal:
        return replace(entry, refusal=seen.refusal)
    found = {"epoch": seen.epoch, "duration": seen.duration, "steps": seen.steps}
    return replace(entry, observation=seen.key, refusal="", **found)


def _recordings_by_day(log: Store) -> dict[tuple[str, str], dict[str, str]]:
    """Map (person, date) -> {hash: key of the observation} of recordings that began on that day, both in order."""
    zone, days = zone_of(log.setting(ZONE)), defaultdict[tuple[str, str], dict[str, str]](dict)
    observe_all = [(entry.epoch, entry) for entry in log.entries() if entry.epoch is not None]
    for epoch, entry in sorted(observe_all, key=lambda pair: (pair[0], pair[1].hash)):
        date = datetime.fromtimestamp(epoch, zone).date().isoformat()
        days[entry.person, date][entry.hash] = entry.observation
    return dict(sorted(days.items()))


def _chains(log: Store, days: Mapping[tuple[str, str], Mapping[str, str]]) -> list[DayChain]:
    """The chain of each person, from the first day that is not up to date."""
    built, planned = log.days(), defaultdict[str, list[PlannedDay]](list)
    for (person, date), recordings in days.items():
        planned[person].append(PlannedDay(date, tuple(recordings.items()), built.get((person, date))))
    chains = [
        DayChain(person, tuple(its), None, str(log.folder), cache.RESULT_VERSION) for person, its in planned.items()
    ]
    return [chain for whole in chains if (chain := outdated_part(whole)).days]


def _reconstruct(log: Store, crew: Fleet, work: Work, chains: Sequence[DayChain], progress: Progress) -> int:
    """Let workers reconstruct days, and store them; returns the number of days built."""
    built, seen, total = 0, 0, sum(len(chain.days) for chain in chains)
    while chains:
        left: list[DayChain] = []
        for made in crew.run(work, pack(chains, [len(chain.days) for chain in chains], crew.workers)):
            days, rest = skip_crashed(made.item, made.reason) if isinstance(made, CrashedItem) else ([made], None)
            left += [rest] if rest is not None and rest.days else []
            for day in days:
                built, seen = built + _store_day(log, day), seen + 1
                progress("days", seen, total)
        chains = left
    return built


def _store_day(log: Store, day: DayResult) -> bool:
    """Store a day or the reason of its failure; True if a day was stored."""
    rows = read_rows(Path(day.file)) if day.file else None
    if rows is not None:
        log.put_day(rows)
        Path(day.file).unlink()
    elif day.failure or day.file:
        log.put_failure(day.person, day.date, day.failure or f"{day.file}: damaged on its way")
    return rows is not None


def _remove_unused_files(log: Store) -> None:
    """Remove unused files, and temporary files of processes that were killed."""
    cache.remove_all_but(log.folder / cache.OBSERVATIONS, {entry.observation for entry in log.entries()})
    cache.remove_all_but(log.folder / cache.DAYS, set())
    cache.remove_partial_copies(log.folder / cache.COPIES)
