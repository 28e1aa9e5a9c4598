"""Files of settings that users write."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from pdr_graph.errors import InputError


def read_toml(path: str | Path) -> dict[str, Any]:
    """The tables of a TOML file. Raises InputError, however it is broken."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(path, "", str(error), "a TOML file") from None
