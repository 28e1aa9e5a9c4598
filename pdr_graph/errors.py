"""Texts of one line, errors for bad input among them: source, place, found, expected. Exit codes, progress, TOML."""

from __future__ import annotations

import re
import signal
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

PASSWORD = re.compile(r"(://[^/@\s:]*:)[^/@\s]*@")  # in an address
LONGEST_PART = 300  # characters of a message's part: file names and contents are untrusted and may be very long


class InputError(ValueError):
    """Input that cannot be used. Its text is one printable line: ``source, place: found …, expected …``.

    source: the file or the option; place: the line or the column in it, may be empty; found: what is there;
    expected: what should be there.
    """

    def __init__(self, source: str | Path, place: str, found: str, expected: str):
        where = f"{one_line(str(source))}, {one_line(place)}" if place else one_line(str(source))
        super().__init__(f"{where}: found {one_line(found)}, expected {one_line(expected)}")
        self._parts = str(source), place, found, expected

    @property
    def wrong(self) -> str:
        """The text without the source and the place."""
        return f"found {one_line(self._parts[2])}, expected {one_line(self._parts[3])}"

    def renamed(self, old: str, new: str) -> InputError:
        """The same error with a file's name in the source replaced."""
        source, *rest = self._parts
        return InputError(source.replace(old, new), *rest)

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str, str]]:
        return InputError, self._parts  # pickling: workers raise it in another process


INTERRUPTIONS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class Interrupted(BaseException):
    """Ctrl-C, or a request of the system to end: the number of the signal. Only the command line raises it.

    It is no KeyboardInterrupt: for that, libraries have words of their own.
    """


def expect(place: str, argument: object, *kinds: type | None, instead: str = "") -> None:
    """Raise TypeError unless `argument` is of one of the types `kinds`; None among them allows None.

    place: function and argument; instead: code that makes an object of the expected type.
    """
    if any(argument is None if kind is None else isinstance(argument, kind) for kind in kinds):
        return
    expected = " or ".join("None" if kind is None else kind.__name__ for kind in kinds)
    value = one_line(repr(argument)) if isinstance(argument, str | Path | int | float) else ""
    found = "None" if argument is None else f"{type(argument).__name__} {value}".strip()
    raise TypeError(f"{place}: found {found}, expected {expected}{instead and f', as of {instead}'}")


def one_line(text: str) -> str:
    """`text` on one line, without control characters and passwords of addresses; … for the middle of a long text."""
    plain = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    plain = PASSWORD.sub(r"\1…@", plain)
    half = LONGEST_PART // 2
    return plain if len(plain) <= LONGEST_PART else f"{plain[:half]} … {plain[-half:]}"


def quoted(content: bytes) -> str:
    """The first bytes of a file as text in quotes, those of a binary one as hexadecimal digits."""
    text = content.decode("utf-8", "ignore")
    is_text = len(text.encode()) > len(content) - 4 and all(c.isprintable() or c.isspace() for c in text)
    return repr(text) if is_text else f"the bytes {content[:16].hex(' ')}"


def printable(text: str) -> str:
    """`text` with � for each character that is not printable: control characters, and bytes that are not UTF-8."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def count(number: int, noun: str) -> str:
    """A number of things as a text: ``1 fix``, ``12 fixes``, ``2 stairs``."""
    return f"{number} {noun}{'' if number == 1 or noun.endswith('s') else 'es' if noun.endswith('x') else 's'}"


def slow_rate(rate: float) -> str:
    """The end of a message about a slow sensor that guesses the cause; empty if none is evident. rate: [Hz].

    Usual rates are 10 to 1000 Hz; a thousandth of one is seen if milliseconds are read as seconds.
    """
    return " (milliseconds in a column of seconds?)" if 0.01 <= rate <= 1 else ""


def install(extra: str) -> str:
    """The command that installs an extra."""
    return f"pip install '.[{extra}]' in the folder of pdr_graph"


def percent(probability: float) -> str:
    """A probability as a text: ``43 %``; "less than 1 %", "more than 99 %" instead of a rounded 0 or 100 %."""
    if 0 < probability < 0.005:
        return "less than 1 %"
    return "more than 99 %" if 0.995 <= probability < 1 else f"{100 * probability:.0f} %"


# Exit codes: nothing to import; bad input; finished without a part, which summary.json names
EXIT_NOTHING, EXIT_REFUSED, EXIT_DEGRADED = 1, 2, 3
PAGES = ("report.html", "figure.png")  # results for a person to open, the most complete first


def first_look(folder: Path) -> Path:
    """The file in a folder of results to open first: the report, else a figure, else the folder itself."""
    return next((folder / page for page in PAGES if (folder / page).exists()), folder)


SILENT = ContextVar("SILENT", default=False)
"""True while a command prints nothing but errors and what `--json` asks for."""


def shows_progress() -> bool:
    """True if standard error is a terminal and the command is not silent."""
    return sys.stderr.isatty() and not SILENT.get()


@dataclass
class Stages:
    """Wall time of each stage [s]; on a terminal, the stage under way is shown."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time one stage."""
        started = time.perf_counter()
        if shows_progress():
            from rich.console import Console

            with Console(stderr=True).status(f"{name} …"):
                yield
        else:
            yield
        self.seconds[name] = round(time.perf_counter() - started, 4)


LARGEST_TOML = 1_000_000  # [bytes]
LONG_NAME = re.compile(rb"""(?:\.\s*[\w"'-]{1,100}\s*){20}""")  # tables in tables, whose cost grows with the square


def check_not_special(path: Path, expected: str) -> None:
    """Raise InputError for a pipe, a socket, a terminal or another device: reading one may never end.

    expected: what the file should be. A path that does not exist passes.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise InputError(path, "", "neither a file nor a folder", expected)


def read_toml(path: str | Path) -> dict[str, Any]:
    """The tables of a TOML file. Raises InputError if it cannot be read or parsed, or is too large."""
    check_not_special(Path(path), "a TOML file")
    try:
        with Path(path).open("rb") as file:
            content = file.read(LARGEST_TOML + 1)
        if len(content) > LARGEST_TOML:
            raise InputError(path, "", f"more than {LARGEST_TOML} bytes", "a TOML file written by hand")
        if LONG_NAME.search(content):
            raise InputError(path, "", "a name of more than 20 parts", "names of one or two parts")
        return tomllib.loads(content.decode())
    except InputError:
        raise
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(path, "", str(error), "a TOML file") from None
