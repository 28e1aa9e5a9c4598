"""A lifelog built: what has changed is planned, given to workers, and what they made is taken into the store.

Two stages: recordings are observed, each by itself; then each person's days are reconstructed, one after the other. The
file of what a worker made is named by all that it is made of, and the store notes that name beside the day. So a day is
made once, a new day costs a day, and after kill -9 the next build goes on.
"""

from __future__ import annotations

import platform
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, tzinfo
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from zoneinfo import ZoneInfo

from pdr_graph.errors import InputError
from pdr_graph.io.beacons import BESIDE
from pdr_graph.lifelog import files
from pdr_graph.lifelog.chains import Chain, Done, Planned, Reconstruct, past, reconstructed, rows_in, unmade
from pdr_graph.lifelog.content import content_hash, plan_hash
from pdr_graph.lifelog.fleet import Fleet, Lost, Work, fleet, packed
from pdr_graph.lifelog.observing import Observe, Seen, Sought, observed
from pdr_graph.lifelog.store import ZONE, Entry, Store

PACKAGES = ("pdr_graph", "gtsam", "numpy", "scipy")  # whose versions are noted
Told = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Outcome:
    """What a build did. built: how many days; kept: how many were up to date; failures: why days could not be built,
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
    observe, reconstruct: as of `observation.observe` and `days.reconstruct`, which they are by default.

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
    """A time zone. Raises InputError if there is none of that name."""
    if name == "UTC":
        return UTC  # where no zones are installed, too
    try:
        return ZoneInfo(name)
    except (OSError, ValueError, LookupError):
        raise InputError("--zone", "", repr(name), "a time zone, as Europe/Berlin") from None


def _not_observed(log: Store) -> list[Sought]:
    """Recordings to be observed: that never were, or not as they and what is given with them are now."""
    sought: list[Sought] = []
    for entry, found in _looked_at(log, log.entries()):
        if isinstance(found, str):
            log.put(replace(entry, refusal=found))
        elif found.key != entry.observation:
            sought.append(found)
        elif entry.refusal:
            log.put(replace(entry, refusal=""))
    return sought


def _not_there(log: Store, chains: Sequence[Chain]) -> list[Sought]:
    """Recordings to be observed again, since days are to be made of them and their observations are not there."""
    keys = {key for chain in chains for day in chain.days for _, key in day.recordings}
    gone = {key for key in keys if not (log.folder / files.OBSERVATIONS / key).exists()}
    entries = [entry for entry in log.entries() if entry.observation in gone]
    return [found for _, found in _looked_at(log, entries) if isinstance(found, Sought) and found.key in gone]


def _looked_at(log: Store, entries: Sequence[Entry]) -> Iterator[tuple[Entry, Sought | str]]:
    """Each recording with what is to be observed of it, or why that cannot be said."""
    hashes = {"plan": cache(plan_hash), "": cache(content_hash)}  # of all recordings the same ones
    for entry in entries:
        try:
            yield entry, _sought(log, entry, hashes)
        except InputError as error:
            yield entry, str(error)


def _sought(log: Store, entry: Entry, hashes: Mapping[str, Callable[[Path], str]]) -> Sought:
    """A recording and what is given with it; the key has the content of all that is read."""
    given = {name: getattr(entry, name) for name in ("plan", "fixes", "walker")}
    listed = Path(entry.path).with_name(BESIDE)
    read = given | {"list of beacons": str(listed) if listed.is_file() else ""}
    content = [(name, _hash(hashes, name, said, entry)) for name, said in read.items() if said]
    key = files.key_of(entry.hash, entry.floor, entry.begins, entry.plan, content)
    file = str(log.folder / files.OBSERVATIONS / key)
    given |= {"floor": entry.floor, "begins": entry.begins, "made_by": files.MADE_BY}
    return Sought(entry.hash, key, file, entry.path, **given)


def _hash(hashes: Mapping[str, Callable[[Path], str]], name: str, said: str, entry: Entry) -> str:
    """What a file that is given with a recording is known by."""
    try:
        return hashes.get(name, hashes[""])(Path(said))
    except OSError as error:
        raise InputError(said, "", error.strerror or str(error), f"the {name} of {entry.path}") from None


def _observe(log: Store, crew: Fleet, work: Work, sought: Sequence[Sought], told: Told) -> None:
    """Have recordings observed, and note of each what is seen."""
    entries = {entry.hash: entry for entry in log.entries()}
    tasks = packed(sought, [1] * len(sought), crew.workers)
    for done, seen in enumerate(crew.run(work, tasks), start=1):
        if isinstance(seen, Lost):
            seen = Seen(seen.item.hash, "", refusal=f"{seen.item.path}: {seen.said}")
        log.put(_noted(entries[seen.hash], seen))
        told("recordings", done, len(sought))


def _noted(entry: Entry, seen: Seen) -> Entry:
    """A recording with what is seen; what was seen of it earlier stays in force if it is refused now."""
    if seen.refusal:
        return replace(entry, refusal=seen.refusal)
    found = {"epoch": seen.epoch, "duration": seen.duration, "steps": seen.steps}
    return replace(entry, observation=seen.key, refusal="", **found)


def _days(log: Store) -> dict[tuple[str, str], dict[str, str]]:
    """Person and date of each day, in order; of each recording that began on it, in order, what was observed."""
    zone, days = zone_of(log.setting(ZONE)), defaultdict[tuple[str, str], dict[str, str]](dict)
    observed = [(entry.epoch, entry) for entry in log.entries() if entry.epoch is not None]
    for epoch, entry in sorted(observed, key=lambda pair: (pair[0], pair[1].hash)):
        date = datetime.fromtimestamp(epoch, zone).date().isoformat()
        days[entry.person, date][entry.hash] = entry.observation
    return dict(sorted(days.items()))


def _chains(log: Store, days: Mapping[tuple[str, str], Mapping[str, str]]) -> list[Chain]:
    """Each person's days from the first on that is not up to date."""
    built, planned = log.days(), defaultdict[str, list[Planned]](list)
    for (person, date), recordings in days.items():
        planned[person].append(Planned(date, tuple(recordings.items()), built.get((person, date))))
    chains = [Chain(person, tuple(its), None, str(log.folder), files.MADE_BY) for person, its in planned.items()]
    return [chain for whole in chains if (chain := unmade(whole)).days]


def _reconstruct(log: Store, crew: Fleet, work: Work, chains: Sequence[Chain], told: Told) -> int:
    """Have days reconstructed and take them in; how many."""
    built, seen, total = 0, 0, sum(len(chain.days) for chain in chains)
    while chains:
        left: list[Chain] = []
        for made in crew.run(work, packed(chains, [len(chain.days) for chain in chains], crew.workers)):
            days, rest = past(made.item, made.said) if isinstance(made, Lost) else ([made], None)
            left += [rest] if rest is not None and rest.days else []
            for day in days:
                built, seen = built + _taken(log, day), seen + 1
                told("days", seen, total)
        chains = left
    return built


def _taken(log: Store, day: Done) -> bool:
    """True if there was a new day to be taken into the store; why it could not be made is noted."""
    rows = rows_in(Path(day.file)) if day.file else None
    if rows is not None:
        log.take(rows)
        Path(day.file).unlink()
    elif day.failure or day.file:
        log.failed(day.person, day.date, day.failure or f"{day.file}: damaged on its way")
    return rows is not None


def _tidy(log: Store) -> None:
    """Remove what is no longer of use, and what processes that were killed have left."""
    files.keep(log.folder / files.OBSERVATIONS, {entry.observation for entry in log.entries()})
    files.keep(log.folder / files.DAYS, set())
    files.keep_whole(log.folder / files.COPIES)
