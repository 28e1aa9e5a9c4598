"""What an object knows, as plain numbers for a journal, and back.

An object names its attributes in ``kept``: numbers, arrays, lists of pairs, and others with such a list.
"""

from __future__ import annotations

from typing import Any

import numpy as np


def state_of(one: Any) -> dict[str, Any]:
    """Numbers and arrays by name, ``part.name`` those of a part."""
    state = {}
    for name in one.kept:
        value = getattr(one, name)
        inner = {f"{name}.{inner}": v for inner, v in state_of(value).items()} if hasattr(value, "kept") else None
        state |= inner if inner is not None else {name: np.array(value) if isinstance(value, list) else value}
    return state


def restore(one: Any, state: dict[str, Any], prefix: str = "") -> None:
    """Make an object what it was."""
    for name in one.kept:
        now = getattr(one, name)
        if hasattr(now, "kept"):
            restore(now, state, f"{prefix}{name}.")
        else:
            setattr(one, name, _like(now, state[prefix + name]))


def _like(now: Any, value: Any) -> Any:
    if isinstance(now, np.ndarray):
        return np.array(value, dtype=now.dtype).reshape(-1, *now.shape[1:])
    if isinstance(now, list):
        return [tuple(row) for row in np.asarray(value, dtype=float).reshape(-1, 2).tolist()]
    return type(now)(np.asarray(value).item())
