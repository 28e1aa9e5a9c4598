"""Recordings into a lifelog: found, read once to see that they can be, and known by their content."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pdr_graph import io
from pdr_graph.errors import InputError
from pdr_graph.floor.building import Building
from pdr_graph.floor.formats import MICROSOFT_INFO, MICROSOFT_MAP
from pdr_graph.gait.walker import Walker
from pdr_graph.io.beacons import beside
from pdr_graph.io.source import Source
from pdr_graph.io.tables import read_fixes
from pdr_graph.lifelog import files
from pdr_graph.lifelog.content import content_hash
from pdr_graph.lifelog.observation import check_tells
from pdr_graph.lifelog.store import Entry, Store
from pdr_graph.types import Fixes

NOBODY_ELSE = "me"
OPTIONS = ("person", "plan", "fixes", "walker", "floor", "begins")
TIME_FORM = "a time such as 2024-05-01T09:30:00+02:00"


@dataclass(frozen=True)
class Added:
    """What became of recordings that were to be added. again: how many were there already; changed: how many of those
    have other options now; refused: why, a line each; passed: how many files in folders are no recordings.
    """

    added: int = 0
    again: int = 0
    changed: int = 0
    passed: int = 0
    refused: tuple[str, ...] = ()


def add(
    store: Path,
    recordings: Sequence[Path],
    person: str | None = None,
    plan: Path | None = None,
    fixes: Path | None = None,
    walker: Path | None = None,
    floor: str | None = None,
    begins: float | None = None,
    phone: str | None = None,
    copy: bool = False,
    told: Callable[[int, int], None] = lambda done, of: None,
) -> Added:
    """Add recordings, and those in folders, to a lifelog, which is made if there is none.

    person: who made them, NOBODY_ELSE by default; plan, fixes, walker, floor, begins: as of `observe`, of all of them.
    What is None stays as it was of those that are there already. phone: what the person's phone or tag is called in
    the Bluetooth logs of others. copy: keep a copy of each, so that the original may go. told: how many are done, of
    how many.

    Raises InputError if an option or the lifelog cannot be used; OSError of the disk.
    """
    said = {"person": person, "plan": _plan(plan), "fixes": _path(fixes), "walker": _path(walker)}
    options = {name: value for name, value in (said | {"floor": floor, "begins": begins}).items() if value is not None}
    _check_options(options)
    found, passed, refused = found_in(recordings)
    if begins is not None and len(found) > 1:
        raise InputError("--begins", "", f"{len(found)} recordings", "the one that began then")
    with Store(store, new=True) as log:
        if phone is not None:
            log.carries(person or NOBODY_ELSE, phone)
        known = {entry.hash: entry for entry in log.entries()}
        result = Added(passed=passed, refused=tuple(refused))
        for done, path in enumerate(found):
            told(done, len(found))
            try:
                entry = _entry(path.resolve(), options, known)
            except InputError as error:
                result = replace(result, refused=(*result.refused, str(error)))
                continue
            result = _counted(result, known.get(entry.hash), entry)
            known[entry.hash] = _kept(entry, known.get(entry.hash), log.folder / files.COPIES, copy)
            log.put(known[entry.hash])
        told(len(found), len(found))
    return result


def _entry(path: Path, options: dict[str, Any], known: Mapping[str, Entry]) -> Entry:
    """What the lifelog is to know of a recording. Raises InputError if it cannot be read."""
    if not str(path).isprintable():
        raise InputError(path, "", "a name that cannot be printed", "another")
    try:
        digest = content_hash(path)
        before = known.get(digest)
        entry = replace(before or Entry(digest, NOBODY_ELSE, ""), path=str(path), **options)
        if before is None or _is_changed(before, entry):
            _check(path, entry)
    except OSError as error:
        raise InputError(path, "", error.strerror or str(error), "a recording that can be read") from None
    return entry


def _is_changed(before: Entry, now: Entry) -> bool:
    """True if other options are said."""
    return any(getattr(before, name) != getattr(now, name) for name in OPTIONS)


def _counted(result: Added, before: Entry | None, entry: Entry) -> Added:
    if before is None:
        return replace(result, added=result.added + 1)
    return replace(result, again=result.again + 1, changed=result.changed + _is_changed(before, entry))


def _kept(entry: Entry, before: Entry | None, copies: Path, copy: bool) -> Entry:
    """The recording where it is from now on: in a copy, if one is asked for or there."""
    if before is not None and Path(before.path).is_relative_to(copies):
        return replace(entry, path=before.path)
    return replace(entry, path=str(_copied(Path(entry.path), copies / entry.hash))) if copy else entry


def found_in(paths: Sequence[Path]) -> tuple[list[Path], int, list[str]]:
    """The recordings among files and folders, each once; how many files are none; and what is refused, a line each."""
    found: dict[Path, None] = {}
    passed, refused = 0, list[str]()
    for path in paths:
        try:
            within, other = _within(path) if path.is_dir() else ([path], 0)
        except OSError as error:
            refused.append(str(InputError(path, "", f"{error.filename}: {error.strerror}", "folders that can be read")))
            continue
        found |= dict.fromkeys(within)
        passed += other
        if not within:
            refused.append(str(InputError(path, "", f"{other} files", "a recording, or a folder of recordings")))
    return list(found), passed, refused


def _within(folder: Path) -> tuple[list[Path], int]:
    """The recordings in a folder, and how many other files: those of its folders; else itself; else its files."""
    entries = sorted(entry for entry in folder.iterdir() if not entry.is_symlink())
    found, passed = list[Path](), 0
    for inner in (entry for entry in entries if entry.is_dir()):
        within, other = _within(inner)
        found, passed = found + within, passed + other
    files = [entry for entry in entries if entry.is_file()]
    if not found and len(files) > 1 and _is_recording(folder):
        return [folder], 0
    own = [file for file in files if _is_recording(file)]
    return found + own, passed + len(files) - len(own)


def _is_recording(path: Path) -> bool:
    """True if a reader takes it for one of its own."""
    try:
        source = Source(path)
        return any(reader.recognizes(source) for reader in io.READERS)
    except InputError:
        return path.is_file()  # a damaged zip: to be refused by name; a folder of several recordings is none


def _check(path: Path, entry: Entry) -> None:
    """Raise InputError where a recording could not be observed."""
    walk = io.load(path)
    if walk.epoch is None and entry.begins is None:
        raise InputError(path, "", "no date", f"--begins, {TIME_FORM}, when it was recorded")
    given = read_fixes(Path(entry.fixes), walk) if entry.fixes else Fixes.none()
    check_tells(path, walk, len(walk.fixes) + len(given))


def _check_options(options: Mapping[str, Any]) -> None:
    """Raise InputError where a name is none, or a plan or a walker cannot be read."""
    for name in ("person", "floor"):
        said = options.get(name, NOBODY_ELSE)
        if not said.strip() or not said.isprintable():
            raise InputError(f"--{name}", "", repr(said), "a name")
    if plan := options.get("plan"):
        labels, floor = Building.load(plan).labels, options.get("floor")
        if floor and floor not in labels:
            raise InputError(plan, "", f"the floors {', '.join(labels)[:80]}", f"a floor {floor!r}")
    if walker := options.get("walker"):
        Walker.load(walker)


def _copied(path: Path, folder: Path) -> Path:
    """A copy of a recording, with the list of beacons beside it; made once."""
    if not folder.is_dir():
        if path.is_file():
            listed = beside(path)
            named = {path.name: path} | ({listed.name: listed} if listed else {})
        else:
            named = {f"{path.name}/{name}": path / name for name in Source(path).names}
        files.copy(named, folder)
    return folder / path.name


def _path(path: Path | None) -> str | None:
    return str(path.resolve()) if path else None


def _plan(path: Path | None) -> str | None:
    """The folder of a Microsoft floor, whichever of its files was named."""
    return _path(path.parent if path and path.name in (MICROSOFT_MAP, MICROSOFT_INFO) else path)


def time_of(said: str) -> float:
    """Unix time [s] of an ISO 8601 time, UTC where it does not say. Raises InputError."""
    try:
        time = datetime.fromisoformat(said)
    except ValueError:
        raise InputError("--begins", "", said, TIME_FORM) from None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
