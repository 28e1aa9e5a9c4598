"""Stages of a command: their times, and whether they are shown: on a terminal, unless ``--quiet`` or ``--json``."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

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
