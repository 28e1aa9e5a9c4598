"""Files beside a lifelog's store: readable by their owner alone, written atomically, named by the hash of their inputs.

The name of such a file is its key, the hash of all its inputs. A file that exists is therefore up to date: a build that
follows a killed one, or a worker that takes over a task, need not compute it again.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

from pdr_graph.errors import InputError
from pdr_graph.io.source import Source
from pdr_graph.whole_files import UNFINISHED, write_file


def content_hash(path: Path) -> str:
    """SHA-256 of a file's content; for a folder, of the names and contents of the files that a reader sees in it."""
    if path.is_file():
        return _file_hash(path)
    digest = hashlib.sha256()
    for name in Source(path).names:
        digest.update(f"{name}\0{_file_hash(path / name)}\n".encode(errors="surrogateescape"))
    return digest.hexdigest()


def _file_hash(path: Path) -> str:
    """SHA-256 of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


RESULT_VERSION = f"{version('pdr_graph')}, 8"  # raise the number whenever observations or days change
OBSERVATIONS, DAYS, DIGESTS, COPIES = "observations", "days", "digests", "recordings"  # folders in STORE.d
PARTIAL = ".part"  # suffix of a copy while it is being written
Value = TypeVar("Value")


def key_of(*inputs: Any) -> str:
    """Hash of inputs (numbers, texts, and lists of them) and of this version: the name of the file of a result."""
    return hashlib.sha256(json.dumps([RESULT_VERSION, *inputs]).encode()).hexdigest()


def check_version(version: str) -> None:
    """Raise InputError in a worker whose version differs from that of the build."""
    if version != RESULT_VERSION:
        raise InputError("--scheduler", "a worker", f"pdr_graph {RESULT_VERSION}", f"{version}, as here")


def read(file: Path, decode: Callable[[bytes], Value]) -> Value | None:
    """Decode a file's bytes; None if there is no file, or `decode` raises ValueError because a power cut damaged it."""
    try:
        return decode(file.read_bytes())
    except (FileNotFoundError, ValueError):
        return None


def write(path: Path, content: bytes, durable: bool = False) -> None:
    """Write a file atomically, with its folders. Raises OSError of the disk; an earlier file is then unchanged.

    durable: return when the content is on the disk, so that a power cut does not lose it.
    """
    make_folder(path.parent)
    write_file(path, content, private=True, durable=durable)


def copy(files: Mapping[str, Path], folder: Path) -> None:
    """Copy files under new names into a folder, which must not exist. Raises OSError of the disk."""
    make_folder(folder.parent)
    part = Path(tempfile.mkdtemp(PARTIAL, dir=folder.parent))
    try:
        for name, source in files.items():
            make_folder((part / name).parent)
            shutil.copyfile(source, part / name)
            (part / name).chmod(0o600)
        os.replace(part, folder)
    except OSError:
        shutil.rmtree(part, ignore_errors=True)
        raise


def make_folder(path: Path) -> None:
    """Create a folder and its parents, accessible to the owner alone."""
    if not path.is_dir():
        make_folder(path.parent)
        path.mkdir(mode=0o700, exist_ok=True)


def names(folder: Path) -> set[str]:
    """Names of the files in a folder that are completely written; none if it does not exist."""
    found = os.listdir(folder) if folder.is_dir() else ()
    return {name for name in found if not name.endswith((PARTIAL, UNFINISHED))}


def remove_all_but(folder: Path, names: set[str]) -> None:
    """Remove all files but those of these names from a folder, if it exists."""
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.name not in names:
            path.unlink(missing_ok=True)


def remove_partial_copies(folder: Path) -> None:
    """Remove copies that were not finished because their process was killed."""
    for path in folder.glob(f"*{PARTIAL}"):
        shutil.rmtree(path, ignore_errors=True)
