"""What files are known by: the hash of their content."""

from __future__ import annotations

import hashlib
from pathlib import Path

from pdr_graph.io.source import Source


def content_hash(path: Path) -> str:
    """SHA-256 of a file's content; of a folder's, of the names and contents of what a reader sees in it."""
    if path.is_file():
        return _file_hash(path)
    return _joint_hash({name: path / name for name in Source(path).names})


def plan_hash(path: Path) -> str:
    """The same of a floor plan, of whose folder the maps alone count: recordings may lie there too."""
    return _joint_hash({file.name: file for file in sorted(path.glob("*.json"))}) if path.is_dir() else _file_hash(path)


def _joint_hash(files: dict[str, Path]) -> str:
    digest = hashlib.sha256()
    for name, file in files.items():
        digest.update(f"{name}\0{_file_hash(file)}\n".encode(errors="surrogateescape"))
    return digest.hexdigest()


def _file_hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
