"""How long a navigator takes for a step, and how much memory."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

PERCENTILES = {"median": 50.0, "p95": 95.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}
EVERY = 50.0  # [s] of the walk between looks at the memory, doubled whenever there are too many
MOST_LOOKS = 200
MEGABYTE = 1e6
Result = TypeVar("Result")


class Latency:
    """Seconds per step: pushing: all that came in since the step before; posing: to ask where the walker is."""

    def __init__(self) -> None:
        self.pushing, self.posing = list[float](), list[float]()
        self.memory = list[tuple[float, float]]()  # time of the walk [s], resident [MB]
        self._since = 0.0
        self._every = EVERY

    def push(self, push: Callable[[Any], None], event: Any) -> None:
        """Do it; its time is of the step under way."""
        began = time.perf_counter()
        push(event)
        self._since += time.perf_counter() - began

    def step(self, pose: Callable[[], Result]) -> Result:
        """Ask for the pose; what was done since the step before is of this one."""
        began = time.perf_counter()
        found = pose()
        self.posing.append(time.perf_counter() - began)
        self.pushing.append(self._since)
        self._since = 0.0
        return found

    def look(self, now: float) -> None:
        """Look at the memory, if it is time to. now: of the walk. [s]"""
        if self.memory and now < self.memory[-1][0] + self._every:
            return
        if (resident := _resident()) is not None:
            self.memory.append((round(now, 1), round(resident, 2)))
        if len(self.memory) > MOST_LOOKS:
            self.memory, self._every = self.memory[::2], 2 * self._every

    def describe(self) -> dict[str, Any]:
        """As ``latency.json`` has it: milliseconds per step, megabytes."""
        return {
            "steps": len(self.pushing),
            "push": _spread(self.pushing),
            "pose": _spread(self.posing),
            "peak_memory": _peak(),
            "memory": [{"time": now, "resident": resident} for now, resident in self.memory],
            "units": {"push": "ms per step", "pose": "ms per step", "memory": "MB", "time": "s"},
        }


def _spread(seconds: list[float]) -> dict[str, float] | None:
    if not seconds:
        return None
    values = np.percentile(1000 * np.array(seconds), list(PERCENTILES.values()))
    return {name: round(value, 4) for name, value in zip(PERCENTILES, values.tolist(), strict=True)}


def _resident() -> float | None:
    """Memory of this process now [MB], where the system tells it."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") / MEGABYTE


def _peak() -> float | None:
    """The most memory that this process ever had [MB], where the system tells it."""
    try:
        import resource  # not on Windows
    except ImportError:
        return None
    unit = 1.0 if sys.platform == "darwin" else 1024.0  # [bytes]
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / MEGABYTE, 2)
