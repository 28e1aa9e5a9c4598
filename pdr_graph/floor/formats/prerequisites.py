"""What must hold before a plan's file is read: its size is bounded, and the library of its format is installed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pdr_graph.errors import InputError, check_not_special, install


def check_file_size(path: Path, largest: int, advice: str = "") -> None:
    """Raise InputError for a file larger than `largest` [bytes], or one without an end, such as a pipe.

    advice: what to do, appended to the message.
    """
    check_not_special(path, "a file of a floor plan")
    size = path.stat().st_size
    if size > largest:
        raise InputError(path, "", f"{size} bytes", f"at most {largest} bytes{advice and ': ' + advice}")


@contextmanager
def required_library(path: Path, noun: str, library: str) -> Iterator[None]:
    """Raise InputError where the block's import fails. noun: what the file is; library: its name on PyPI."""
    try:
        yield
    except ImportError:
        raise InputError(path, "", f"{noun} and no {library}", install("plans")) from None
