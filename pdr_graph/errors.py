"""What is said of input that cannot be used: one line with the file, the place, what was found and what was needed."""

from __future__ import annotations

from pathlib import Path

LONGEST_PART = 250  # characters; names and contents of files are their makers' and may be anything


class InputError(ValueError):
    """Input that cannot be used. Its text is one printable line: ``file, place: found …, needed …``."""

    def __init__(self, source: str | Path, place: str, found: str, needed: str):
        where = f"{one_line(str(source))}, {one_line(place)}" if place else one_line(str(source))
        super().__init__(f"{where}: found {one_line(found)}, needed {one_line(needed)}")
        self._parts = str(source), place, found, needed

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str, str]]:
        return InputError, self._parts  # from one process to another


def one_line(text: str) -> str:
    """A text on one line, without what a terminal would obey; the middle of a long one is left out."""
    plain = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    half = LONGEST_PART // 2
    return plain if len(plain) <= LONGEST_PART else f"{plain[:half]} … {plain[-half:]}"
