"""Add recordings to a lifelog: find them, check that they are readable, identify them by content hash."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from pdr_graph.apps.lifelog import cache
from pdr_graph.apps.lifelog.cache import content_hash
from pdr_graph.apps.lifelog.observation import check_usable, read_inputs
from pdr_graph.apps.lifelog.store import Entry, RecordingOptions, Store
from pdr_graph.apps.lifelog.visited import Added, Summed, add_places, photos_in
from pdr_graph.errors import InputError
from pdr_graph.floor.plan_files import Building, root_of
from pdr_graph.gait.walker import Walker
from pdr_graph.io.loading import load
from pdr_graph.io.signatures import RECORDING_FORMATS, recognized
from pdr_graph.io.source import Source
from pdr_graph.io.tables import beside
from pdr_graph.plausibility import check_floors

DEFAULT_PERSON = "me"
TIME_FORM = "a time such as 2024-05-01T09:30:00+02:00"


@dataclass(frozen=True)
class AddResult(Summed):
    """Result of adding recordings: counts, and a line for each refusal.

    added: new recordings; existing: recordings that were in the lifelog already; changed: those of them that have other
    options now; skipped: files in folders that are no recordings; refused: reasons, a line each.
    """

    added: int = 0
    existing: int = 0
    changed: int = 0
    skipped: int = 0
    refused: tuple[str, ...] = ()
    places: Added = field(default_factory=Added)


def folders_of_people(folders: Sequence[Path]) -> dict[str | None, Sequence[Path]]:
    """The folders of each person in some folders, by name. Raises InputError where there are none."""
    found = defaultdict[str | None, list[Path]](list)
    for folder in folders:
        inside = folder.iterdir() if folder.is_dir() else ()
        own = sorted(inner for inner in inside if inner.is_dir() and not inner.name.startswith("."))
        if not own:
            raise InputError(folder, "", "no folder in it", "--people: a folder of recordings for each person")
        for inner in own:
            found[inner.name].append(inner)
    return dict(found)


def add(
    store: Path,
    recordings: Sequence[Path],
    options: RecordingOptions | None = None,
    *,
    person: str | None = None,
    phone: str | None = None,
    copy: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
    visited: Path | None = None,
) -> AddResult:
    """Add recordings and photos, also those in folders, to a lifelog, which is created if it does not exist.

    options, person: of all these recordings (the person is DEFAULT_PERSON by default); recordings that are in the
    lifelog already keep their present value of an option that is None. phone: name of the person's phone or tag in the
    Bluetooth logs of others. copy: keep a copy, so that the original may be deleted. progress: called with the numbers
    of recordings done and in total. visited: a table of receipts.

    Raises InputError if an option or the lifelog cannot be used; OSError of the disk.
    """
    options = _checked(person, options or RecordingOptions())
    photos = photos_in(recordings)
    found, skipped, refused = find_recordings([path for path in recordings if path not in photos], bool(photos))
    if options.begins is not None and len(found) > 1:
        raise InputError("--begins", "", f"{len(found)} recordings", "a single recording: add them one by one")
    is_new = not store.exists()
    with Store(store, new=True) as log:
        if phone is not None:
            log.put_phone(person or DEFAULT_PERSON, phone)
        known, counts = {entry.hash: entry for entry in log.entries()}, Counter[str]()
        copies = log.folder / cache.COPIES
        for done, path in enumerate(found):
            progress(done, len(found))
            try:
                entry = _entry(path.resolve(), person, options, known)
            except InputError as error:
                refused.append(str(error))
                continue
            before = known.get(entry.hash)
            counts["added" if before is None else "existing"] += 1
            counts["changed"] += before is not None and _is_changed(before, entry)
            if before is not None and Path(before.path).is_relative_to(copies):
                entry = replace(entry, path=before.path)
            elif copy:
                entry = replace(entry, path=str(_copied(Path(entry.path), copies / entry.hash)))
            known[entry.hash] = entry
            log.put(entry)
        progress(len(found), len(found))
        places = add_places(log, person or DEFAULT_PERSON, visited, photos)
    refused += places.refused
    result = AddResult(**counts, skipped=max(skipped - len(photos), 0), refused=tuple(refused), places=places)
    if is_new and phone is None and not result.added + places.new:
        store.unlink(missing_ok=True)  # all were refused: nothing is written
    return result


def _entry(path: Path, person: str | None, options: RecordingOptions, known: Mapping[str, Entry]) -> Entry:
    """The lifelog's entry for a recording. Raises InputError if it cannot be read."""
    if not str(path).isprintable():
        raise InputError(path, "", "a file name with unprintable characters", "a printable name: rename it")
    try:
        digest = content_hash(path)
        before = known.get(digest)
        entry = before or Entry(digest, DEFAULT_PERSON, "")
        options = entry.options.updated(options)
        entry = replace(entry, person=person or entry.person, path=str(path), options=options)
        if before is None or _is_changed(before, entry):
            _check(path, entry.options)
    except OSError as error:
        raise InputError(path, "", error.strerror or str(error), "a readable recording") from None
    return entry


def _is_changed(before: Entry, now: Entry) -> bool:
    """True if the person or an option has changed."""
    return (before.person, before.options) != (now.person, now.options)


def find_recordings(paths: Sequence[Path], photos: bool = False) -> tuple[list[Path], int, list[str]]:
    """Find recordings in files and folders; returns them, the number of other files, and a line per refusal.

    photos: True if a folder may have photos alone.
    """
    found, skipped, refused = dict[Path, None](), 0, list[str]()
    for path in paths:
        try:
            within, other = _find_in_folder(path) if path.is_dir() else ([path], 0)
        except OSError as error:
            refused.append(str(InputError(path, "", f"{error.filename}: {error.strerror}", "readable folders")))
            continue
        found |= dict.fromkeys(within)
        skipped += other
        if not within and not photos:
            expected = "a recording, or a folder of recordings"
            refused.append(str(InputError(path, "", f"{other} files, no recording", expected)))
    return list(found), skipped, refused


def _find_in_folder(folder: Path) -> tuple[list[Path], int]:
    """Recordings in a folder (in subfolders, else the folder itself, else its files), and the number of other files."""
    entries = sorted(entry for entry in folder.iterdir() if not entry.is_symlink())
    found, skipped = list[Path](), 0
    for inner in (entry for entry in entries if entry.is_dir()):
        within, other = _find_in_folder(inner)
        found, skipped = found + within, skipped + other
    files = [entry for entry in entries if entry.is_file()]
    if not found and len(files) > 1 and _is_recording(folder):
        return [folder], 0
    own = [file for file in files if _is_recording(file)]
    return found + own, skipped + len(files) - len(own)


def _is_recording(path: Path) -> bool:
    """True if a reader recognises the format."""
    try:
        return recognized(Source(path), RECORDING_FORMATS) is not None
    except InputError:
        return path.is_file()  # a damaged zip is refused by name later; a folder of several recordings is no recording


def _check(path: Path, options: RecordingOptions) -> None:
    """Raise InputError where a recording could not be observed."""
    if any(name != "walker" for name in options.files):
        evidence = read_inputs(path, options)
        walk, fixes = evidence.walk, evidence.fixes
    else:
        walk = load(path)
        fixes = walk.fixes
    if walk.epoch is None and options.begins is None:
        raise InputError(path, "", "no date", f"a start time: give --begins with {TIME_FORM}")
    check_usable(path, walk, len(fixes))


def _checked(person: str | None, options: RecordingOptions) -> RecordingOptions:
    """The options with absolute paths. Raises InputError for an empty name, or an unreadable plan or walker file."""
    for name, value in (("person", person), ("floor", options.floor)):
        if value is not None and not (value.strip() and value.isprintable()):
            raise InputError(f"--{name}", "", repr(value), "a name")
    if options.plan is not None:
        options = replace(options, plan=root_of(options.plan))  # one file of a folder stands for the folder
    options = replace(options, **{name: path.resolve() for name, path in options.files.items()})
    if options.plan is not None:
        check_floors(options.plan, Building.load(options.plan), options.floor)
    if options.walker is not None:
        Walker.load(options.walker)
    return options


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


def time_of(text: str) -> float:
    """Parse an ISO 8601 time to Unix time [s]; without an offset it is UTC. Raises InputError."""
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        raise InputError("--begins", "", text, TIME_FORM) from None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
