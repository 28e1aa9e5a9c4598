"""What is said of input that cannot be used: one line with its place, what was found there and what was needed."""

from __future__ import annotations

from pathlib import Path

LONGEST_PART = 250  # characters; names and contents of files are their makers' and may be anything


class InputError(ValueError):
    """Input that cannot be used. Its text is one printable line: ``source, place: found …, needed …``.

    source: a file, or an option; place: in it, a line or a column; found: what is there; needed: what should be.
    """

    def __init__(self, source: str | Path, place: str, found: str, needed: str):
        where = f"{one_line(str(source))}, {one_line(place)}" if place else one_line(str(source))
        super().__init__(f"{where}: found {one_line(found)}, needed {one_line(needed)}")
        self._parts = str(source), place, found, needed

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str, str]]:
        return InputError, self._parts  # from one process to another


def expect(place: str, given: object, *kinds: type | None, instead: str = "") -> None:
    """Raise TypeError unless an argument is of one of some kinds, None among them or not.

    place: function and argument; instead: how to come by what was needed.
    """
    if any(given is None if kind is None else isinstance(given, kind) for kind in kinds):
        return
    needed = " or ".join("None" if kind is None else kind.__name__ for kind in kinds)
    raise TypeError(f"{place}: found {_kind(given)}, needed {needed}{instead and f', as of {instead}'}")


def _kind(given: object) -> str:
    """What an argument is, and itself where that is short."""
    said = one_line(repr(given)) if isinstance(given, str | Path | int | float) else ""
    return "None" if given is None else f"{type(given).__name__} {said}".strip()


def one_line(text: str) -> str:
    """A text on one line, without what a terminal would obey; the middle of a long one is left out."""
    plain = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    half = LONGEST_PART // 2
    return plain if len(plain) <= LONGEST_PART else f"{plain[:half]} … {plain[-half:]}"
