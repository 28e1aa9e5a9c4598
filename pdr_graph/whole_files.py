"""Output files that are written as a whole or not at all, whatever ends the process or fills the disk.

New files are written under another name, forced to the disk and then renamed. A lock on the folder tells a second
process that the first still writes; the system releases it when a process ends.
"""

from __future__ import annotations

import os
import shutil
import signal
import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from pdr_graph.errors import INTERRUPTIONS, InputError, count

UNFINISHED = ".unfinished"  # folder of the files of a run, in its output folder; ending of a single file
LAST = "summary.json"  # the file that says that a folder is complete
PRIVATE_FOLDER = 0o700
LOCK_OF_FOLDER = f"{UNFINISHED}.lock"  # file in a folder, where folders cannot be locked
LOCKED_BYTE = 2**31 - 2  # beyond all files and the bytes that SQLite locks: Windows refuses to read a locked byte


def _module(name: str) -> Any:
    """A module of the standard library; None where the system does not have it."""
    with suppress(ImportError):
        return import_module(name)
    return None


fcntl, msvcrt = _module("fcntl"), _module("msvcrt")  # of Linux and macOS; of Windows


@contextmanager
def output_folder(out: Path, private: bool = False, without: Collection[str] = ()) -> Iterator[Path]:
    """A folder for the files of `out`: they take their places there when the block ends without an exception.

    Otherwise `out` stays as it was. private: for its owner alone; without: names of files that are removed when the new
    ones take their places. Raises InputError if another process writes to `out`; OSError of the disk.
    """
    made = [path for path in (out, *out.parents) if not path.exists()]
    for path in reversed(made):
        path.mkdir(PRIVATE_FOLDER if private else 0o777, exist_ok=True)
    if not out.is_dir():
        raise NotADirectoryError(20, "not a folder", str(out))
    try:
        handle = _opened(out)
        try:
            lock(handle, out)
            staged = out / UNFINISHED
            shutil.rmtree(staged, ignore_errors=True)  # of a process that was killed
            try:
                staged.mkdir(PRIVATE_FOLDER if private else 0o777)
                yield staged
                files = [path for path in staged.rglob("*") if path.is_file()]
                for file in files:
                    _to_disk(file)
                with uninterrupted():
                    for name in without:
                        (out / name).unlink(missing_ok=True)
                    for file in sorted(files, key=lambda file: file.name == LAST):
                        target = out / file.relative_to(staged)
                        target.parent.mkdir(parents=True, exist_ok=True)
                        file.replace(target)
                _to_disk(out)
            finally:
                with uninterrupted():
                    shutil.rmtree(staged, ignore_errors=True)
        finally:
            os.close(handle)
            with suppress(OSError):  # another process has it
                (out / LOCK_OF_FOLDER).unlink()
    except BaseException as error:
        for folder in made:  # innermost first; those with other files stay
            with suppress(OSError):
                folder.rmdir()
        if isinstance(error, OSError):
            where = str(error.filename or out).replace(f"{os.sep}{UNFINISHED}", "", 1)
            raise OSError(error.errno, error.strerror or str(error), where) from None
        raise


def check_replaceable(out: Path, mark: str = LAST, force: bool = False, inputs: Collection[Path] = ()) -> None:
    """Raise InputError for a folder with files that pdr-graph did not write, unless `force`.

    An empty folder passes, and one with an earlier result, with other folders alone, or with ``inputs`` of the command.
    mark: a file of each result; if it is the summary, that it names pdr_graph counts, since other programs write such a
    file too.
    """
    if force or not out.is_dir():
        return
    known = {path.resolve() for path in inputs}
    files = (path for path in out.iterdir() if not path.name.startswith(".") and not path.is_dir())
    names = sorted(path.name for path in files if path.resolve() not in known)
    earlier = mark in names and (mark != LAST or b"pdr_graph" in (out / mark).read_bytes())
    if names and not earlier:
        found = f"a folder with {count(len(names), 'other file')} ({', '.join(names[:3])[:80]})"
        expected = "a new or empty folder, or an earlier result (--force writes there anyway)"
        raise InputError(out, "--out", found, expected)


def write_file(path: str | Path, content: str | bytes, private: bool = False, durable: bool = True) -> None:
    r"""Write one output file; an earlier file of that name is replaced by the whole new one, or stays.

    Texts are UTF-8; bytes of a file name in them that are not UTF-8 become escapes: \udcff. private: for its owner
    alone; durable: return when the content is on the disk, so that a power cut does not lose it. Raises OSError of the
    disk.
    """
    data = content if isinstance(content, bytes) else content.encode("utf-8", errors="backslashreplace")
    path = Path(os.path.realpath(path))  # a link is followed, not replaced
    if path.exists() and not path.is_file():
        path.write_bytes(data)  # a device or a pipe has no earlier content
        return
    part = path.with_name(f".{path.name}.{threading.get_native_id()}{UNFINISHED}")  # of this thread alone
    try:
        try:
            with open(part, "wb", opener=lambda name, how: os.open(name, how, 0o600 if private else 0o666)) as f:
                f.write(data)
                if durable:
                    f.flush()
                    os.fsync(f.fileno())
            part.replace(path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
        if durable:
            _to_disk(path.parent)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None


def _opened(folder: Path) -> int:
    """A handle to lock a folder by; Windows opens no folder, so there it is that of a file in it."""
    try:
        return os.open(folder, os.O_RDONLY)
    except PermissionError:
        return os.open(folder / LOCK_OF_FOLDER, os.O_CREAT | os.O_RDWR)


def lock(handle: int, path: Path) -> None:
    """Lock an open file until it is closed. Raises InputError if another process has the lock."""
    if not locked(handle):
        expected = "another name, or the end of that process"
        raise InputError(path, "", "another process that writes to it", expected)


def locked(handle: int) -> bool:
    """Lock an open file until it is closed; False if another process has the lock.

    True too on a file system without locks, as of some networks: files are whole all the same.
    """
    try:
        if fcntl is not None:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        elif msvcrt is not None:
            here = os.lseek(handle, 0, os.SEEK_CUR)
            try:
                os.lseek(handle, LOCKED_BYTE, os.SEEK_SET)
                msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
            finally:
                os.lseek(handle, here, os.SEEK_SET)
    except OSError as error:
        return not isinstance(error, PermissionError if fcntl is None else BlockingIOError)
    return True


def _to_disk(path: Path) -> None:
    """Force a file or the names in a folder to the disk, so that a power cut does not lose them.

    Windows opens no folder, and forces to the disk only what is open for writing.
    """
    try:
        handle = os.open(path, os.O_RDONLY if msvcrt is None else os.O_RDWR)
    except PermissionError:
        if path.is_dir():
            return
        raise
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Ctrl-C and requests to end the process take effect after the block."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals interrupt the main thread alone
        return
    arrived = list[int]()
    before = {number: signal.signal(number, lambda number, _: arrived.append(number)) for number in INTERRUPTIONS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        if arrived:
            signal.raise_signal(arrived[0])
