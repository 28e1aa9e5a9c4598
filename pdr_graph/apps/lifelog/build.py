"""Build a lifelog: plan what has changed, distribute it to workers, store their results.

Two stages: each recording is observed independently; then the days of each person are reconstructed in order. A task
for a worker has paths and keys, no objects. The file of a result is named by its key, the hash of its inputs, which the
store keeps with the day. Hence a day is computed once, a new day costs one day, and a build after kill -9 continues
where it stopped.
"""

from __future__ import annotations

import platform
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache, partial
from importlib.metadata import version
from pathlib import Path

from pdr_graph.apps.lifelog import cache, observation
from pdr_graph.apps.lifelog.day import Day, DayRows, Rows, profile_of, profile_row, rows_of
from pdr_graph.apps.lifelog.diary import digest_file, digest_of
from pdr_graph.apps.lifelog.facts import ESTIMATE_KINDS, FORGOTTEN, Correction, forgotten_times
from pdr_graph.apps.lifelog.local_time import checked_zone, zone_named
from pdr_graph.apps.lifelog.observation import ObservationResult, ObservationTask, Observe, observe_all
from pdr_graph.apps.lifelog.store import WAYS_FILE, ZONE, Entry, Store, StoredDay
from pdr_graph.apps.lifelog.workers import ITEM_LIMIT, CrashedItem, Fleet, LostItem, Work, fleet, pack
from pdr_graph.errors import InputError, count, one_line
from pdr_graph.gait.walker import Profile
from pdr_graph.io.tables import BEACON_LIST
from pdr_graph.storage import decode, encode, fingerprint

Reconstruct = Callable[[str, str, Mapping[str, observation.Observation], Profile | None, tuple[str, str]], Day]


@dataclass(frozen=True)
class PlannedDay:
    """A day to reconstruct. recordings: (hash, key of the observation), in time order; built: the day in the store,
    None if there is none; corrections: those that change its estimate, in the order in which they were made.
    """

    date: str
    recordings: tuple[tuple[str, str], ...]
    built: StoredDay | None
    corrections: tuple[Correction, ...] = ()


@dataclass(frozen=True)
class DayChain:
    """Consecutive days of a person that are still to be reconstructed.

    profile: of the walker before the first day; folder: ``STORE.d``; version: `cache.RESULT_VERSION` of the build;
    ways: outdoors, the file and its fingerprint, "" without.
    """

    person: str
    days: tuple[PlannedDay, ...]
    profile: Profile | None
    folder: str
    version: str
    ways: tuple[str, str] = ("", "")

    @property
    def key(self) -> str:
        """Key of the first day: the hash of its inputs."""
        known = None if self.profile is None else profile_row(self.profile)
        stated = [correction.inputs for correction in self.days[0].corrections]
        more = [*([stated] if stated else []), *([self.ways[1]] if self.ways[1] else [])]
        return cache.key_of(self.person, self.days[0].date, self.days[0].recordings, known, *more)

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
            day, chain = _existing_day(chain) or _reconstructed_day(chain, reconstruct)
            yield day


def outdated_part(chain: DayChain) -> DayChain:
    """The chain from its first day that is not up to date in the store."""
    while chain.days and (built := chain.days[0].built) is not None and built.key == chain.key:
        chain = chain.after(built.profile)
    return chain


def _existing_day(chain: DayChain) -> tuple[DayResult, DayChain] | None:
    """Result of the first day and the chain after it, if the day is up to date in the store or in its file."""
    first = chain.days[0]
    rest = outdated_part(replace(chain, days=(first,)))
    if not rest.days:
        return DayResult(chain.person, first.date), chain.after(rest.profile)
    rows = _read_rows(chain.file)
    return None if rows is None else _result(chain, rows)


def _reconstructed_day(chain: DayChain, reconstruct: Reconstruct | None) -> tuple[DayResult, DayChain]:
    """Reconstruct the first day and write its rows; returns its result and the chain after it."""
    first = chain.days[0]
    try:
        cache.check_version(chain.version)
        if reconstruct is None:
            from pdr_graph.apps.lifelog.reconstruct import reconstruct  # imports all of estimation, which is slow
        observations = observation.read_observations(Path(chain.folder), first.recordings)
        if first.corrections:
            from pdr_graph.apps.lifelog.corrections import apply_to_observations

            observations = apply_to_observations(observations, first.corrections)
        day = reconstruct(chain.person, first.date, observations, chain.profile, chain.ways)
        rows = rows_of(day, chain.key, [name for name, _ in first.recordings])
        blob = encode(DayRows(rows))
    except Exception as error:  # a failure of one day must not stop the others
        failure = observation.error_text(error)
        return DayResult(chain.person, first.date, failure=failure), chain.after(chain.profile)
    cache.write(chain.file, blob)
    return _result(chain, rows)


def _result(chain: DayChain, rows: Rows) -> tuple[DayResult, DayChain]:
    """Result of the first day, whose rows are in its file, and the chain after it with the profile of that day."""
    profile = next((profile_of(row[2:]) for row in rows["profile"]), None)
    return DayResult(chain.person, chain.days[0].date, str(chain.file)), chain.after(profile)


def _read_rows(file: Path) -> Rows | None:
    """Read the rows of a day from its file; None if it is missing or damaged."""
    return cache.read(file, lambda blob: decode(blob, DayRows).tables)


NO_PATHS = "none"  # in place of the file of ways
PACKAGES = ("pdr_graph", "gtsam", "numpy", "scipy")  # whose versions are stored with a build
Progress = Callable[[str, int, int], None]  # called with the name of a stage, the tasks done, and all tasks


@dataclass(frozen=True)
class BuildResult:
    """Result of a build. built: number of days built; up_to_date: number of days that needed no work.

    failures: why days failed; refusals: why recordings could not be observed; unfinished: what is left to the next
    build because the workers were lost; a line each.
    """

    built: int
    up_to_date: int
    failures: tuple[str, ...]
    refusals: tuple[str, ...]
    unfinished: tuple[str, ...] = ()


def build(
    store: Path,
    zone: str | None = None,
    workers: int = 1,
    scheduler: str = "",
    time_limit: float = ITEM_LIMIT,
    progress: Progress = lambda stage, done, total: None,
    observe: Observe = observation.observe,
    reconstruct: Reconstruct | None = None,
    paths: str | None = None,
) -> BuildResult:
    """Bring a lifelog up to date: observe recordings and reconstruct days where an input changed.

    zone: time zone whose midnights separate the days, LOCAL for that of each place, stored for later builds;
    workers: processes on this machine; scheduler: address of a Dask cluster whose workers see the same paths;
    time_limit: of a recording or a day in a worker process [s]. observe, reconstruct: replacements for
    `observation.observe` and `reconstruct.reconstruct`, for tests; paths: file of ways outdoors that walks follow,
    stored for later builds, NO_PATHS for none.

    Raises InputError if the lifelog, the zone or the scheduler cannot be used; OSError of the disk.
    """
    with Store(store, thorough=True) as log, fleet(workers, scheduler, time_limit) as crew:
        if zone is not None:
            log.put_setting(ZONE, checked_zone(zone))
        if paths is not None:
            log.put_setting(WAYS_FILE, _checked_ways(paths))
        observe_work = partial(observe_all, observe=observe)
        reconstruct_work = partial(reconstruct_days, reconstruct=reconstruct)

        # Recordings whose observation is missing or out of date
        sought = list[ObservationTask]()
        for entry, found in _tasks_of(log, log.entries()):
            if isinstance(found, ObservationTask) and found.key != entry.observation:
                sought.append(found)
            elif entry.refusal != (refusal := found if isinstance(found, str) else ""):
                log.put(replace(entry, refusal=refusal))
        unobserved = _observe(log, crew, observe_work, sought, progress)

        # Days that are out of date, for which observations may be needed again whose files are missing
        days = recordings_by_day(log)
        log.begin_build(
            [own for own, built in log.days().items() if not set(built.recordings) <= set(days.get(own, ()))]
        )
        chains = [chain for whole in day_chains(log, days) if (chain := outdated_part(whole)).days]
        keys = {key for chain in chains for day in chain.days for _, key in day.recordings}
        gone = {key for key in keys if not (log.folder / cache.OBSERVATIONS / key).exists()}
        entries = [entry for entry in log.entries() if entry.observation in gone]
        again = [task for _, task in _tasks_of(log, entries) if isinstance(task, ObservationTask) and task.key in gone]
        unobserved += _observe(log, crew, observe_work, again, progress)
        built, unbuilt = _reconstruct(log, crew, reconstruct_work, chains, progress)
        if built:
            log.put_versions({name: version(name) for name in PACKAGES} | {"python": platform.python_version()})

        # Files that nothing refers to, and temporary files of processes that were killed
        cache.remove_all_but(log.folder / cache.OBSERVATIONS, {entry.observation for entry in log.entries()})
        cache.remove_all_but(log.folder / cache.DAYS, set())
        cache.remove_all_but(log.folder / cache.DIGESTS, {digest_file(log.folder, *own).name for own in log.days()})
        cache.remove_partial_copies(log.folder / cache.COPIES)
        failures = tuple(f"{person}, {date}: {reason}" for person, date, reason in log.failures())
        refusals = tuple(entry.refusal for entry in log.entries() if entry.refusal)
    up_to_date = len(days) - built - len(failures) - len(unbuilt)
    return BuildResult(built, up_to_date, failures, refusals, unfinished_lines(crew.lost, unobserved, unbuilt))


def _checked_ways(paths: str) -> str:
    """The setting of a file of ways outdoors. Raises InputError if it has none."""
    if paths == NO_PATHS:
        return ""
    from pdr_graph.floor.paths import PathNetwork  # with the readers of its formats

    PathNetwork.load(path := Path(paths).resolve())
    return str(path)


def ways_of(log: Store) -> tuple[str, str]:
    """The file of ways outdoors, and its fingerprint, "" without. Raises InputError if it is gone."""
    if not (file := log.setting(WAYS_FILE)):
        return "", ""
    if not Path(file).is_file():
        raise InputError(file, "", "no such file", f"the ways that --paths named, or --paths {NO_PATHS}")
    return file, fingerprint(Path(file))


def _tasks_of(log: Store, entries: Sequence[Entry]) -> Iterator[tuple[Entry, ObservationTask | str]]:
    """Each recording with its task, or with the reason why it has none.

    The key of a task covers the content of every file that is read.
    """
    hashes = {"plan": lru_cache(None)(observation.plan_hash), "": lru_cache(None)(fingerprint)}  # each file once
    for entry in entries:
        options, read, content = entry.options, dict(entry.options.files), list[tuple[str, str]]()
        listed = Path(entry.path).with_name(BEACON_LIST)
        if "beacons" not in read and listed.is_file():
            read["list of beacons"] = listed
        try:
            for name, path in read.items():
                try:
                    content.append((name, hashes.get(name, hashes[""])(path)))
                except OSError as error:
                    expected = f"the {name} of {entry.path}"
                    raise InputError(path, "", error.strerror or str(error), expected) from None
        except InputError as error:
            yield entry, str(error)
            continue
        key = cache.key_of(entry.hash, options.floor or "", options.begins, str(options.plan or ""), content)
        file = str(log.folder / cache.OBSERVATIONS / key)
        forgotten = forgotten_times(log.corrections(entry.person))
        yield entry, ObservationTask(entry.hash, key, file, entry.path, options, cache.RESULT_VERSION, forgotten)


def observe_new(log: Store, person: str) -> None:
    """Observe recordings of a person that have no observation yet, in this process, and store each result."""
    new = [entry for entry in log.entries() if entry.person == person and not entry.observation]
    tasks = [found for _, found in _tasks_of(log, new) if isinstance(found, ObservationTask)]
    _observe(log, Fleet(), observe_all, tasks, lambda stage, done, total: None)


def _observe(log: Store, crew: Fleet, work: Work, sought: Sequence[ObservationTask], progress: Progress) -> list[str]:
    """Let workers observe recordings, and store each result; returns the recordings left by a lost fleet.

    A recording that is refused keeps its earlier observation.
    """
    entries = {entry.hash: entry for entry in log.entries()}
    keys, done, left = {task.key for task in sought}, 0, list[str]()

    def written() -> int:
        number = len(keys & cache.names(log.folder / cache.OBSERVATIONS))
        progress("recordings", max(done, number), len(sought))
        return number

    for seen in crew.run(work, pack(sought, [1] * len(sought), crew.workers), written):
        if isinstance(seen, LostItem):
            if not Path(seen.item.file).exists():
                left.append(seen.item.path)
                continue
            [seen] = work((seen.item,))  # reads the file
        elif isinstance(seen, CrashedItem):
            seen = ObservationResult(seen.item.hash, "", {}, f"{seen.item.path}: {seen.reason}")
        entry = replace(entries[seen.hash], refusal=seen.refusal, **seen.columns)
        log.put(entry if seen.refusal else replace(entry, observation=seen.key))
        done += 1
        progress("recordings", done, len(sought))
    return left


def recordings_by_day(log: Store) -> dict[tuple[str, str], dict[str, str]]:
    """Map (person, date) -> {hash: key of the observation} of recordings that began on that day, both in order.

    Dates are those of the zone that was chosen, else of where the recording, or the last one with a position, began.
    """
    fixed, days = log.setting(ZONE), defaultdict[tuple[str, str], dict[str, str]](dict)
    observed = [(entry.epoch, entry) for entry in log.entries() if entry.epoch is not None]
    observed.sort(key=lambda pair: (pair[0], pair[1].hash))
    last = {entry.person: entry.zone for _, entry in reversed(observed) if entry.zone}  # at first, that of the first
    for epoch, entry in observed:
        last[entry.person] = entry.zone or last.get(entry.person, "")
        date = datetime.fromtimestamp(epoch, zone_named(fixed or last[entry.person])).date().isoformat()
        days[entry.person, date][entry.hash] = entry.observation
    return dict(sorted(days.items()))


def day_chains(log: Store, days: Mapping[tuple[str, str], Mapping[str, str]]) -> list[DayChain]:
    """The chain of all days of each person; days: as of `recordings_by_day`."""
    built, planned = log.days(), defaultdict[str, list[PlannedDay]](list)
    corrections, entries = log.corrections(), {entry.hash: entry for entry in log.entries()}
    for (person, date), recordings in days.items():
        stated = tuple(
            c
            for c in corrections
            if c.person == person
            and c.kind in ESTIMATE_KINDS
            and any(entries[name].overlaps(*c.span) for name in recordings)
            and (c.kind == FORGOTTEN or any(entries[name].steps for name in recordings))
        )
        planned[person].append(PlannedDay(date, tuple(recordings.items()), built.get((person, date)), stated))
    rest = None, str(log.folder), cache.RESULT_VERSION, ways_of(log)
    return [DayChain(person, tuple(its), *rest) for person, its in planned.items()]


def touched_dates(log: Store, person: str, start: float, end: float) -> list[str]:
    """Dates of the stored days of a person with a recording that touches a time (Unix times [s])."""
    touched = {entry.hash for entry in log.entries() if entry.person == person and entry.overlaps(start, end)}
    return [date for (who, date), day in log.days().items() if who == person and touched & set(day.recordings)]


def rebuild_dates(log: Store, person: str, dates: Collection[str]) -> tuple[list[DayResult], int]:
    """Reconstruct days of a person where they are out of date, in this process, from observations that exist.

    Returns a result per day, and the number of this person's days that are left to the next build: days that were never
    built, and later days if the profile of the walker has changed.
    """
    results, days = list[DayResult](), recordings_by_day(log)
    for chain in (whole for whole in day_chains(log, days) if whole.person == person):
        profile = None
        for day in chain.days:
            one = replace(chain, days=(day,), profile=profile)
            if day.date in dates and outdated_part(one).days:
                result, one = _existing_day(one) or _reconstructed_day(one, None)
                store_day(log, result)
                results.append(result)
                profile = one.profile
            elif day.built is not None:
                profile = day.built.profile
    left = [outdated_part(whole) for whole in day_chains(log, days) if whole.person == person]
    return results, sum(len(chain.days) for chain in left)


def _reconstruct(
    log: Store, crew: Fleet, work: Work, chains: Sequence[DayChain], progress: Progress
) -> tuple[int, list[tuple[str, str]]]:
    """Let workers reconstruct days, and store them; returns the number of days built, and those a lost fleet left."""
    built, seen, total = 0, 0, sum(len(chain.days) for chain in chains)

    def written() -> int:
        number = seen + len(cache.names(log.folder / cache.DAYS))
        progress("days", min(number, total), total)
        return number

    while chains and not crew.lost:
        left: list[DayChain] = []
        for made in crew.run(work, pack(chains, [len(chain.days) for chain in chains], crew.workers), written):
            days = [made]
            if isinstance(made, CrashedItem | LostItem):
                days, rest = list[DayResult](), made.item
                while rest.days and (ready := _existing_day(rest)) is not None:
                    day, rest = ready
                    days.append(day)
                if rest.days and isinstance(made, CrashedItem):
                    days.append(DayResult(rest.person, rest.days[0].date, failure=made.reason))
                    rest = rest.after(rest.profile)
                left += [rest] if rest.days else []
            for day in days:
                built, seen = built + store_day(log, day), seen + 1
                progress("days", seen, total)
        chains = left
    return built, [(chain.person, day.date) for chain in chains for day in chain.days]


def store_day(log: Store, day: DayResult) -> bool:
    """Store a day or the reason of its failure; True if a day was stored."""
    rows = _read_rows(Path(day.file)) if day.file else None
    if rows is not None:
        log.put_day(rows)
        Path(day.file).unlink()
        digest_of(log, day.person, day.date, log.day_hash(day.person, day.date))  # what `show` needs first
    elif day.failure or day.file:
        log.put_failure(day.person, day.date, day.failure or f"{day.file}: damaged on its way")
    return rows is not None


def unfinished_lines(reason: str, recordings: Sequence[str], days: Sequence[tuple[str, str]]) -> tuple[str, ...]:
    """A line for the recordings that were not observed, and one for the days (person, date) that were not built."""
    lines, most = list[str](), 5  # recordings named
    if recordings:
        more = [f"and {len(recordings) - most} more"] if len(recordings) > most else []
        names = ", ".join([*recordings[:most], *more])
        lines.append(f"{reason}: {count(len(recordings), 'recording')} not observed, left to the next build: {names}")
    if days:
        dates = defaultdict[str, list[str]](list)
        for person, date in sorted(days):
            dates[person].append(date)
        names = ", ".join(
            f"{one_line(person)} {own[0]}" + (f" to {own[-1]} ({len(own)})" if len(own) > 1 else "")
            for person, own in dates.items()
        )
        lines.append(f"{reason}: {count(len(days), 'person-day')} not built, left to the next build: {names}")
    return tuple(lines)
