"""Fixes of a radio map from Wi-Fi and Bluetooth scans of a walk under way."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from pdr_graph.estimation.fingerprinting import RadioMap, scans_in
from pdr_graph.priors import SCANS
from pdr_graph.types import Fixes, Sightings

MOST_RECEPTIONS = 20_000  # that are stored: some minutes where 100 transmitters are heard
LONGEST_SPAN = 600.0  # [s] of the walk whose levels are stored: the scans are a table of windows times transmitters


class ScanCollector:
    """Makes fixes of a radio map, one per block of scans; a `Collector`. listener: is called with each."""

    def __init__(self, radio_map: RadioMap, listener: Callable[[Fixes], None]):
        self._map, self._listener = radio_map, listener
        self._names: dict[str, int] = {name: n for n, name in enumerate(radio_map.transmitter)}
        self._received = np.empty((0, 3))  # time [s], transmitter number, rssi [dBm]
        self._block = -np.inf  # the last block with a fix

    def collect(self, received: Sightings, radio: str) -> bool:
        """Store the levels of all transmitters of either radio; True if there are any."""
        names = [self._names.setdefault(name, len(self._names)) for name in received.transmitter]
        rows = np.column_stack([received.time, names, received.rssi])
        self._received = np.concatenate([self._received, rows[np.isfinite(rows).all(axis=1)]])[-MOST_RECEPTIONS:]
        if len(self._names) > len(self._map.transmitter) + MOST_RECEPTIONS:
            self._forget_names()
        return len(received) > 0

    def due(self, until: float, walked: object) -> Iterator[Fixes]:
        """Yield, once, the fixes of the blocks of scans that are complete until ``until`` [s]."""
        self.forget(max((self._block + 0.5) * SCANS.window, until - LONGEST_SPAN))
        # Its last scan ends half a window after it
        complete = (until - 1.5 * SCANS.window + SCANS.interval) // SCANS.window
        if complete <= self._block or not len(self._received):
            return
        time, transmitter, rssi = self._received.T
        names = list(self._names)
        scans = scans_in([Sightings(time, tuple(names[n] for n in transmitter.astype(int).tolist()), rssi)])
        block = scans.time // SCANS.window
        fixes = self._map.located(scans[(block > self._block) & (block <= complete)])
        self._block = min(complete, block.max(initial=self._block))
        self.forget((self._block + 0.5) * SCANS.window)
        if len(fixes):
            self._listener(fixes)
            yield fixes

    def complete(self, steps: object) -> tuple[()]:
        """Empty: the log stores the fixes that `due` yielded."""
        return ()

    def forget(self, before: float) -> None:
        """Drop levels received before ``before`` [s]."""
        self._received = self._received[self._received[:, 0] >= before]

    def _forget_names(self) -> None:
        """Drop the transmitters that are neither in the map nor among the stored levels."""
        stored, names = set(self._received[:, 1].astype(int).tolist()), list(self._names)
        kept = [n for n in range(len(names)) if n < len(self._map.transmitter) or n in stored]
        self._received[:, 1] = np.searchsorted(kept, self._received[:, 1])
        self._names = {names[n]: row for row, n in enumerate(kept)}
