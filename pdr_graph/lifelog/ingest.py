"""Add recordings to a lifelog: find them, check that they are readable, identify them by content hash."""

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
from pdr_graph.lifelog import cache
from pdr_graph.lifelog.cache import content_hash
from pdr_graph.lifelog.observation import check_tells
from pdr_graph.lifelog.store import Entry, Store
from pdr_graph.types import Fixes

DEFAULT_PERSON = "me"
OPTIONS = ("person", "plan", "fixes", "walker", "floor", "begins")
TIME_FORM = "a time such as 2024-05-01T09:30:00+02:00"


@dataclass(frozen=True)
class Added:
    """Result of adding recordings: counts, and a line for each refusal.

    added: new recordings; again: already in the lifelog; changed: of those, with other options now; skipped: files in
    folders that are not recordings; refused: reasons, a line each.
    """

    added: int = 0
    again: int = 0
    changed: int = 0
    skipped: int = 0
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
    """Add recordings, also those in folders, to a lifelog, which is created if it does not exist.

    person: who made them, DEFAULT_PERSON by default; plan, fixes, walker, floor, begins: as of `observe`;
    None keeps the present value of recordings that are in the lifelog already. phone: name of the person's phone or tag
    in the Bluetooth logs of others. copy: keep a copy, so that the original may be deleted. told: progress callback
    (done, total).

    Raises InputError if an option or the lifelog cannot be used; OSError of the disk.
    """
    said = {"person": person, "plan": _plan(plan), "fixes": _path(fixes), "walker": _path(walker)}
    options = {name: value for name, value in (said | {"floor": floor, "begins": begins}).items() if value is not None}
    _check_options(options)
    found, skipped, refused = found_in(recordings)
    if begins is not None and len(found) > 1:
        raise InputError("--begins", "", f"{len(found)} recordings", "a single recording: add them one by one")
    with Store(store, new=True) as log:
        if phone is not None:
            log.carries(person or DEFAULT_PERSON, phone)
        known = {entry.hash: entry for entry in log.entries()}
        result = Added(skipped=skipped, refused=tuple(refused))
        for done, path in enumerate(found):
            told(done, len(found))
            try:
                entry = _entry(path.resolve(), options, known)
            except InputError as error:
                result = replace(result, refused=(*result.refused, str(error)))
                continue
            result = _counted(result, known.get(entry.hash), entry)
            known[entry.hash] = _kept(entry, known.get(entry.hash), log.folder / cache.COPIES, copy)
            log.put(known[entry.hash])
        told(len(found), len(found))
    return result


def _entry(path: Path, options: dict[str, Any], known: Mapping[str, Entry]) -> Entry:
    """The lifelog's entry for a recording. Raises InputError if it cannot be read."""
    if not str(path).isprintable():
        raise InputError(path, "", "a file name with unprintable characters", "a printable name: rename it")
    try:
        digest = content_hash(path)
        before = known.get(digest)
        entry = replace(before or Entry(digest, DEFAULT_PERSON, ""), path=str(path), **options)
        if before is None or _is_changed(before, entry):
            _check(path, entry)
    except OSError as error:
        raise InputError(path, "", error.strerror or str(error), "a readable recording") from None
    return entry


def _is_changed(before: Entry, now: Entry) -> bool:
    """True if an option has changed."""
    return any(getattr(before, name) != getattr(now, name) for name in OPTIONS)


def _counted(result: Added, before: Entry | None, entry: Entry) -> Added:
    if before is None:
        return replace(result, added=result.added + 1)
    return replace(result, again=result.again + 1, changed=result.changed + _is_changed(before, entry))


def _kept(entry: Entry, before: Entry | None, copies: Path, copy: bool) -> Entry:
    """The entry with its final path: of the copy, if one is requested or exists."""
    if before is not None and Path(before.path).is_relative_to(copies):
        return replace(entry, path=before.path)
    return replace(entry, path=str(_copied(Path(entry.path), copies / entry.hash))) if copy else entry


def found_in(paths: Sequence[Path]) -> tuple[list[Path], int, list[str]]:
    """Find recordings in files and folders; returns them, the number of other files, and a line per refusal."""
    found: dict[Path, None] = {}
    skipped, refused = 0, list[str]()
    for path in paths:
        try:
            within, other = _within(path) if path.is_dir() else ([path], 0)
        except OSError as error:
            refused.append(str(InputError(path, "", f"{error.filename}: {error.strerror}", "readable folders")))
            continue
        found |= dict.fromkeys(within)
        skipped += other
        if not within:
            refused.append(
                str(InputError(path, "", f"{other} files, no recording", "a recording, or a folder of recordings"))
            )
    return list(found), skipped, refused


def _within(folder: Path) -> tuple[list[Path], int]:
    """Recordings in a folder (in subfolders, else the folder itself, else its files), and the number of other files."""
    entries = sorted(entry for entry in folder.iterdir() if not entry.is_symlink())
    found, skipped = list[Path](), 0
    for inner in (entry for entry in entries if entry.is_dir()):
        within, other = _within(inner)
        found, skipped = found + within, skipped + other
    files = [entry for entry in entries if entry.is_file()]
    if not found and len(files) > 1 and _is_recording(folder):
        return [folder], 0
    own = [file for file in files if _is_recording(file)]
    return found + own, skipped + len(files) - len(own)


def _is_recording(path: Path) -> bool:
    """True if a reader recognises the format."""
    try:
        source = Source(path)
        return any(reader.recognizes(source) for reader in io.READERS)
    except InputError:
        return path.is_file()  # a damaged zip: to be refused by name; a folder of several recordings is none


def _check(path: Path, entry: Entry) -> None:
    """Raise InputError where a recording could not be observed."""
    walk = io.load(path)
    if walk.epoch is None and entry.begins is None:
        raise InputError(path, "", "no date", f"a start time: give --begins with {TIME_FORM}")
    given = read_fixes(Path(entry.fixes), walk) if entry.fixes else Fixes.none()
    check_tells(path, walk, len(walk.fixes) + len(given))


def _check_options(options: Mapping[str, Any]) -> None:
    """Raise InputError for an empty name, or an unreadable plan or walker file."""
    for name in ("person", "floor"):
        said = options.get(name, DEFAULT_PERSON)
        if not said.strip() or not said.isprintable():
            raise InputError(f"--{name}", "", repr(said), "a name")
    if plan := options.get("plan"):
        labels, floor = Building.load(plan).labels, options.get("floor")
        if floor and floor not in labels:
            raise InputError(plan, "", f"the floors {', '.join(labels)[:80]}", f"a floor {floor!r}")
    if walker := options.get("walker"):
        Walker.load(walker)


def _copied(path: Path, folder: Path) -> Path:
    """Copy a recording with its list of beacons, unless the copy exists; returns the path of the copy."""
    if not folder.is_dir():
        if path.is_file():
            listed = beside(path)
            named = {path.name: path} | ({listed.name: listed} if listed else {})
        else:
            named = {f"{path.name}/{name}": path / name for name in Source(path).names}
        cache.copy(named, folder)
    return folder / path.name


def _path(path: Path | None) -> str | None:
    return str(path.resolve()) if path else None


def _plan(path: Path | None) -> str | None:
    """Path of a plan; for a file of a Microsoft floor its folder."""
    return _path(path.parent if path and path.name in (MICROSOFT_MAP, MICROSOFT_INFO) else path)


def time_of(said: str) -> float:
    """Parse an ISO 8601 time to Unix time [s]; without an offset it is UTC. Raises InputError."""
    try:
        time = datetime.fromisoformat(said)
    except ValueError:
        raise InputError("--begins", "", said, TIME_FORM) from None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
