"""Whether a command shows its progress: on a terminal, unless ``--quiet`` or ``--json`` silence it."""

from __future__ import annotations

import sys
from contextvars import ContextVar

SILENT = ContextVar("SILENT", default=False)
"""True while a command prints nothing but errors and what `--json` asks for."""


def shows_progress() -> bool:
    """True if standard error is a terminal and the command is not silent."""
    return sys.stderr.isatty() and not SILENT.get()
