"""Recorders in, trajectories out: one format, one file."""

from __future__ import annotations

from pathlib import Path

from pdr_graph.errors import InputError
from pdr_graph.io import indoor_location
from pdr_graph.types import Recording

READERS = (indoor_location,)


def load(path: str | Path) -> Recording:
    """A recording of any supported recorder, recognised by its content.

    Raises InputError if nothing can read it, with the place and what was needed.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(path, "", "no such file", "a recording")
    for reader in READERS:
        if reader.recognizes(path):
            return reader.read(path)
    formats = ", ".join(reader.NAME for reader in READERS)
    found = "a folder" if path.is_dir() else _first_bytes(path)
    raise InputError(path, "start of the file", found, f"a recording of a supported recorder ({formats})")


def _first_bytes(path: Path) -> str:
    with path.open("rb") as file:
        head = file.read(24)
    return f"the bytes {head!r}" if head else "an empty file"
