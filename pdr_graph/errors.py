"""What is said of input that cannot be used: one line with the file, the place, what was found and what was needed."""

from __future__ import annotations

from pathlib import Path


class InputError(ValueError):
    """Input that cannot be used. Its text is one line: ``file, place: found …, needed …``."""

    def __init__(self, source: str | Path, place: str, found: str, needed: str):
        where = f"{source}, {place}" if place else f"{source}"
        super().__init__(" ".join(f"{where}: found {found}, needed {needed}".split()))
