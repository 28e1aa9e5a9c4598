"""Fixes of a radio map while a walk goes on, made of what Wi-Fi and Bluetooth hear."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from pdr_graph.estimation.fingerprinting import SCAN_INTERVAL, WINDOW, RadioMap, scans_in
from pdr_graph.types import Array, Fixes, Sightings


class ScanCollector:
    """The fixes of a radio map while a walk goes on, block of scans by block; a `Collector`."""

    def __init__(self, radio_map: RadioMap, listener: Callable[[Fixes], None]):
        self._map, self._listener = radio_map, listener
        self._names: dict[str, int] = {name: n for n, name in enumerate(radio_map.transmitter)}
        self._heard = np.empty((0, 3))  # time, transmitter, rssi; any that the map does not know by a number of its own
        self._block = -np.inf  # the last that was located

    def collect(self, data: Any) -> bool:
        """Take what a radio heard."""
        if not isinstance(data, Sightings):
            return False
        names = [self._names.setdefault(name, len(self._names)) for name in data.transmitter]
        heard = np.column_stack([data.time, names, data.rssi])
        self._heard = np.concatenate([self._heard, heard[np.isfinite(heard).all(axis=1)]])
        return len(data) > 0

    def due(self, until: float, walked: object) -> Iterator[Fixes]:
        """The fixes of the blocks of scans that are complete until a moment [s], each once."""
        complete = (until - 1.5 * WINDOW + SCAN_INTERVAL) // WINDOW  # its last scan ends half a window after it
        if complete <= self._block or not len(self._heard):
            return
        time, who, rssi = self._heard.T
        known = list(self._names)
        scans = scans_in([Sightings(time, tuple(known[n] for n in who.astype(int).tolist()), rssi)])
        block = scans.time // WINDOW
        fixes = self._map.located(scans[(block > self._block) & (block <= complete)])
        self._block = min(complete, block.max(initial=self._block))
        self.forget((self._block + 0.5) * WINDOW)
        if len(fixes):
            self._listener(fixes)
            yield fixes

    def complete(self, steps: object) -> tuple[()]:
        """None beside those that `due` has told: a fix is a measurement like any other."""
        return ()

    def forget(self, before: float) -> None:
        """Drop what was heard before a moment [s]."""
        self._heard = self._heard[self._heard[:, 0] >= before]

    def checkpoint(self) -> dict[str, Any]:
        """What it keeps, as arrays by name."""
        names = "\n".join(list(self._names)[len(self._map.transmitter) :]).encode()
        return {"heard": self._heard, "block": np.array(self._block), "names": np.frombuffer(names, np.uint8)}

    def restore(self, checkpoint: Mapping[str, Array]) -> None:
        """Go on from a checkpoint, with the same map."""
        self._heard, self._block = checkpoint["heard"].reshape(-1, 3), float(checkpoint["block"])
        names = checkpoint["names"].astype(np.uint8).tobytes().decode()
        for name in filter(None, names.split("\n")):
            self._names.setdefault(name, len(self._names))
