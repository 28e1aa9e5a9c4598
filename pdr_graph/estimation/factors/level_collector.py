"""Mean levels of beacons on a walk under way."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from pdr_graph.estimation.factors.beacon_rssi import levels_along, mean_levels
from pdr_graph.estimation.factors.preintegration import DECIMALS
from pdr_graph.measurements import Levels
from pdr_graph.priors import BEACONS
from pdr_graph.types import Array, Beacons, Index, Sightings, Steps, minor_number

MOST_RECEPTIONS = 100_000  # that are stored: an hour of a receiver that hears 25 a second


class LevelCollector:
    """Makes mean levels of surveyed beacons on a walk under way; a `Collector`. beacons: in the frame of the walk.

    A stretch ends after BEACONS.stretch metres, or after BEACONS.longest_stretch seconds.
    """

    def __init__(self, beacons: Beacons):
        self._beacons = beacons
        surveyed = np.isfinite(beacons.position[:, 0])
        self._by_name = {name.lower(): m for m, name in enumerate(beacons.name) if surveyed[m]}
        self._by_minor = {minor_number(name): m for name, m in self._by_name.items()}
        self._waiting = np.empty((0, 3))  # time [s], beacon, rssi [dBm] of the stretches that are not complete
        self._window = np.empty((0, 3))  # the same of all advertisements in the window
        self._met = dict[int, int]()  # beacons in the order in which they were first received, and their places in it

    def collect(self, received: Sightings, radio: str) -> bool:
        """Store advertisements; True if any is of a surveyed beacon.

        Those of other radios are not: an access point may have the address of a beacon.
        """
        if radio != "bluetooth":
            return False
        minors = received.minor or ("",) * len(received)
        rows = []
        for time, name, minor, rssi in zip(
            received.time.tolist(), received.transmitter, minors, received.rssi.tolist(), strict=True
        ):
            beacon = self._by_name.get(name.lower(), self._by_minor.get(minor) if minor else None)
            if beacon is not None and np.isfinite([time, rssi]).all():
                rows.append((time, beacon, rssi))
        table = np.array(rows).reshape(-1, 3)
        self._waiting = np.vstack([self._waiting, table])[-MOST_RECEPTIONS:]
        self._window = np.vstack([self._window, table])[-MOST_RECEPTIONS:]
        return len(rows) > 0

    def due(self, until: float, walked: Callable[[Array], Array]) -> Iterable[Levels]:
        """Yield, once, the levels of the stretches that are complete until ``until`` [s]."""
        time = self._waiting[:, 0]
        if not len(time) or time.min() > until:
            return
        stretch, now = walked(time) // BEACONS.stretch, float(walked(np.array([until]))[0] // BEACONS.stretch)
        complete = (time <= until) & ((stretch < now) | (time < until - BEACONS.longest_stretch))
        if complete.any():
            time, beacon, rssi = self._waiting[complete].T
            for m in beacon.astype(int).tolist():
                self._met.setdefault(m, len(self._met))
            levels = mean_levels(stretch[complete].astype(np.intp), time, beacon.astype(np.intp), rssi, self._beacons)
            yield self._among_met(levels, np.unique(beacon.astype(np.intp)))
        self._waiting = self._waiting[~complete]

    def _among_met(self, levels: Levels, received: Index) -> Levels:
        """The levels, renumbered in the table of all received beacons. received: ``(m,)`` those of ``levels``."""
        row = np.array([self._met[m] for m in received.tolist()])
        met, beacons = np.array(list(self._met)), self._beacons
        return Levels(
            time=np.round(levels.time, DECIMALS),
            beacon=row[levels.beacon],
            rssi=levels.rssi,
            label=tuple(beacons.label[m] for m in met),
            position=beacons.position[met],
            sigma=beacons.sigma[met],
        )

    def complete(self, steps: Steps) -> Iterable[Levels]:
        """The levels of the window, as the batch makes them."""
        time, beacon, rssi = self._window.T
        names = tuple(self._beacons.name[int(m)] for m in beacon)
        levels = levels_along(Sightings(time, names, rssi), self._beacons, steps)
        return [levels] if len(levels) else []

    def forget(self, before: float) -> None:
        """Drop advertisements from before ``before`` [s]."""
        self._window = self._window[self._window[:, 0] >= before]
