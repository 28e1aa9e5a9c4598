"""Delete times, recordings or persons from a lifelog, so that no byte of them is left in its files.

What is deleted: rows of the store, observations, copies of recordings, days that are not stored yet. A recording with
data inside and outside of a deleted time is cut: its observation keeps the rest, its copy is deleted. The deleted time
itself is kept as a fact, so that recordings that are added or read again are cut, too.
"""

from __future__ import annotations

import shutil
import time as clock
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from pdr_graph.errors import InputError, count, one_line
from pdr_graph.lifelog import build, cache
from pdr_graph.lifelog.facts import ALWAYS, FORGOTTEN, NAME, Correction, forgotten_times
from pdr_graph.lifelog.observation import (
    DELETED,
    is_usable,
    read_observation,
    step_count,
    to_bytes,
    without_times,
    zone_at_start,
)
from pdr_graph.lifelog.past.past_days import FOLDER as PAST
from pdr_graph.lifelog.past.past_days import PastDays, cut_past
from pdr_graph.lifelog.revision import OpenDiary, person_of
from pdr_graph.lifelog.store import TOGETHER, Entry, Store

PAGES = ("overview.html", "report.html")  # of a folder that ``lifelog show`` writes beside the store by default


def forget(store: Path, start: str, end: str, person: str | None = None) -> list[str]:
    """Delete all that a lifelog holds of a person's time; returns the lines to print.

    start, end: local times. Raises InputError if they or the lifelog cannot be used; OSError of the disk: what is
    missing is then deleted by calling it again.
    """
    with Store(store) as log:
        diary = OpenDiary.of(log, person)
        who, span = diary.person, diary.span(start, end)
        fact = Correction(0, who, clock.time(), FORGOTTEN, *span)
        if fact.span not in forgotten_times(log.corrections(who)):  # else it was interrupted, and goes on
            log.put_correction(fact)
        dates = _dates(log, who, *fact.span)
        cut_past(log, who, *fact.span)
        touched = [entry for entry in log.entries() if entry.person == who and entry.overlaps(*fact.span)]
        removed = [entry for entry in touched if not _cut(log, entry, forgotten_times(log.corrections(who)))]
        _remove(log, removed)
        for correction in log.corrections(who):
            _trim(log, correction, fact)
        log.delete_days((who, date) for date in dates)
        _clean(log)
        build.observe_new(log, who)
        lines = [f"deleted of {one_line(who)}: {diary.statement(fact).removesuffix(': deleted')}"]
        lines.append(f"{count(len(touched), 'recording')} had data then, {len(removed)} of them nothing else")
        kept = {entry.hash for entry in touched} - {entry.hash for entry in removed}
        now = [date for (name, date), own in build.recordings_by_day(log).items() if name == who and kept & own.keys()]
        lines += _rebuilt(log, who, {*dates, *now})
        log.compact()
        return lines + _still_there(log, touched) + _named_places(log, who)


def forget_recording(store: Path, recording: str) -> list[str]:
    """Delete a recording, by its path or the beginning of its content hash, and the days made of it."""
    with Store(store) as log:
        path = str(Path(recording).resolve())
        found = [e for e in log.entries() if e.path == path or (len(recording) >= 8 and e.hash.startswith(recording))]
        if len(found) != 1:
            expected = "the path or content hash of one recording of the lifelog"
            raise InputError("RECORDING", "", f"{count(len(found), 'recording')} by {recording!r}", expected)
        [entry] = found
        dates = [
            date for (who, date), day in log.days().items() if who == entry.person and entry.hash in day.recordings
        ]
        _remove(log, found)
        log.delete_days((entry.person, date) for date in dates)
        _clean(log)
        lines = ["deleted: one recording", *_rebuilt(log, entry.person, dates)]
        log.compact()
        return lines + _still_there(log, found)


def forget_person(store: Path, person: str) -> list[str]:
    """Delete all of a person: recordings, days, corrections, phones."""
    with Store(store) as log:
        who = person_of(log, person)
        found = [entry for entry in log.entries() if entry.person == who]
        _remove(log, found)
        log.delete_person(who)
        shutil.rmtree(PastDays(log, who).folder, ignore_errors=True)
        _clean(log)
        log.compact()
        return [f"deleted: {one_line(who)}, {count(len(found), 'recording')}", *_still_there(log, found)]


def _dates(log: Store, person: str, start: float, end: float) -> list[str]:
    """Dates of the stored days of a person with a recording that touches a time (Unix times [s])."""
    own = {entry.hash for entry in log.entries() if entry.person == person and entry.overlaps(start, end)}
    return [date for (who, date), day in log.days().items() if who == person and own & set(day.recordings)]


def _cut(log: Store, entry: Entry, spans: Sequence[tuple[float, float]]) -> bool:
    """Cut the observation of a recording and delete its copy; False if nothing remains of it."""
    file = log.folder / cache.OBSERVATIONS / entry.observation
    observation = read_observation(file)
    if observation is None:  # a build reads the recording again, if it still exists, and cuts it then
        file.unlink(missing_ok=True)
        return Path(entry.path).exists()
    cut = without_times(observation, spans, DELETED)
    if cut is None or not is_usable(cut):
        return False
    if cut is not observation:
        cache.write(file, to_bytes(cut))
        zone = zone_at_start(cut)
        log.put(replace(entry, epoch=cut.epoch, duration=cut.duration, steps=step_count(cut), zone=zone))
        _delete_copy(log, entry)
    return True


def _remove(log: Store, entries: Iterable[Entry]) -> None:
    """Delete recordings with their observations and copies."""
    for entry in entries:
        if entry.observation:
            (log.folder / cache.OBSERVATIONS / entry.observation).unlink(missing_ok=True)
        _delete_copy(log, entry)
        log.delete(entry.hash)


def _delete_copy(log: Store, entry: Entry) -> None:
    """Delete what ``STORE.d`` holds of a recording beside its observation."""
    shutil.rmtree(log.folder / cache.COPIES / entry.hash, ignore_errors=True)
    if Path(entry.path).is_relative_to(log.folder):
        Path(entry.path).unlink(missing_ok=True)


def _trim(log: Store, correction: Correction, fact: Correction) -> None:
    """Delete a correction of a deleted time; one that holds longer keeps the rest."""
    start, end = fact.span
    if correction.kind == FORGOTTEN or correction.span == ALWAYS or not correction.touches(start, end):
        return
    if start <= correction.start and correction.end <= end:
        log.delete_correction(correction.number)
        return
    begin = end if start <= correction.start < end else correction.start
    after = start if start < correction.end <= end else correction.end
    log.put_correction(replace(correction, start=begin, end=after))


def _clean(log: Store) -> None:
    """Delete files that nothing refers to, and rewrite the store without what was deleted."""
    log.put_setting(TOGETHER, "")
    cache.remove_all_but(log.folder / cache.OBSERVATIONS, {entry.observation for entry in log.entries()})
    for folder in (cache.DAYS, cache.DIGESTS):
        cache.remove_all_but(log.folder / folder, set())
    for folder in (cache.COPIES, PAST):
        cache.remove_partial_copies(log.folder / folder)
    log.compact()


def _rebuilt(log: Store, person: str, dates: Collection[str]) -> list[str]:
    """Rebuild deleted days from what remains; returns a line per day."""
    results, later = build.rebuild_dates(log, person, dates)
    lines = [f"{one_line(r.person)}, {r.date}: {r.failure or 'rebuilt'}" for r in results]
    return lines + ([f"{count(later, 'day')} to build: pdr-graph lifelog build {log.path}"] if later else [])


def _still_there(log: Store, entries: Iterable[Entry]) -> list[str]:
    """A line for each file outside of the lifelog that still has the deleted data."""
    files = [path for e in entries for path in (Path(e.path), *(e.options.files.get(n) for n in ("fixes", "ranges")))]
    beside = sorted(log.path.resolve().parent.glob(f"{log.path.stem}-*"))
    shown = [folder for folder in beside if any((folder / page).exists() for page in PAGES)]
    there = dict.fromkeys(str(path) for path in (*files, *shown) if path is not None and path.exists())
    return [f"still on your disk: {one_line(path)}" for path in there]


def _named_places(log: Store, person: str) -> list[str]:
    """A line if named places remain, which hold at all times."""
    number = sum(c.kind == NAME for c in log.corrections(person))
    return [f"{count(number, 'place')} with a name remain: pdr-graph lifelog correct list"] if number else []
