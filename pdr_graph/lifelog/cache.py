"""Files beside a lifelog's store: their owner's alone, whole or not there, named by the hash of their inputs.

The name of such a file is its key, the hash of all that goes into it. So who finds it there need not make it: a build
that follows one that was killed, or a worker that is given the task of one that died.
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


def content_hash(path: Path) -> str:
    """SHA-256 of a file's content; of a folder's, of the names and contents of what a reader sees in it."""
    if path.is_file():
        return _file_hash(path)
    return _joint_hash({name: path / name for name in Source(path).names})


def _joint_hash(files: dict[str, Path]) -> str:
    digest = hashlib.sha256()
    for name, file in files.items():
        digest.update(f"{name}\0{_file_hash(file)}\n".encode(errors="surrogateescape"))
    return digest.hexdigest()


def _file_hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


MADE_BY = f"{version('pdr_graph')}, 3"  # raise the number whenever observations or days come out otherwise
OBSERVATIONS, DAYS, COPIES = "observations", "days", "recordings"  # folders in STORE.d
UNDER_WAY = ".part"  # how a name ends while the file is being written
Made = TypeVar("Made")


def key_of(*of: Any) -> str:
    """The name of what this version makes of these numbers, texts and lists of them."""
    return hashlib.sha256(json.dumps([MADE_BY, *of]).encode()).hexdigest()


def check_maker(version: str) -> None:
    """Raise InputError in a worker of another version than that which is to make something."""
    if version != MADE_BY:
        raise InputError("--scheduler", "a worker", f"pdr_graph {MADE_BY}", f"{version}, as here")


def read(file: Path, made: Callable[[bytes], Made]) -> Made | None:
    """What is made of a file's bytes; None if there is none, or `made` raises ValueError: a power cut damaged it."""
    try:
        return made(file.read_bytes())
    except (FileNotFoundError, ValueError):
        return None


def write(path: Path, content: bytes) -> None:
    """Write a file. Raises OSError of the disk; then there is none, or the one that was there."""
    make_folder(path.parent)
    handle, name = tempfile.mkstemp(UNDER_WAY, dir=path.parent)  # 0600, and of this process alone
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(name, path)
    except OSError as error:
        Path(name).unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from None


def copy(files: Mapping[str, Path], folder: Path) -> None:
    """Copies of files under their new names, in a folder that is not there yet. Raises OSError of the disk."""
    make_folder(folder.parent)
    part = Path(tempfile.mkdtemp(UNDER_WAY, dir=folder.parent))
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
    """A folder and those that it is in, each its owner's alone where it is new."""
    if not path.is_dir():
        make_folder(path.parent)
        path.mkdir(mode=0o700, exist_ok=True)


def keep(folder: Path, names: set[str]) -> None:
    """Remove all files but these from a folder, if there is one."""
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.name not in names:
            path.unlink(missing_ok=True)


def keep_whole(folder: Path) -> None:
    """Remove the copies that were being made when their process was killed."""
    for path in folder.glob(f"*{UNDER_WAY}"):
        shutil.rmtree(path, ignore_errors=True)
