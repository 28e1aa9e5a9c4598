"""Encounters: two people whose phones heard each other were near each other then ([calibration-walk] Sec. 2)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from pdr_graph.estimation.beacons import LOSS
from pdr_graph.estimation.closures import Closures
from pdr_graph.types import Sightings

FAINTEST = -85.0  # [dBm] beyond which bodies and reflections say more than the distance, some ten metres
NEAREST = 1.5  # [m] per axis: nobody is told apart nearer than that
EVERY = 15.0  # [s] in which one encounter counts: what shades two people stays for as long


@dataclass(frozen=True)
class Carried:
    """A phone on a walk. person: whose; epoch: Unix time at 0 [s]; start, end: of the walk [s]; heard: by Bluetooth."""

    person: str
    epoch: float
    start: float
    end: float
    heard: Sightings | None


def encounters(walks: Sequence[Carried], phones: Mapping[str, str]) -> Closures:
    """Moments at which people met, on walks of any days.

    phones: whose phone or tag a transmitter is, by the name that others' logs have of it. Where it is heard loudly, its
    owner is as far as a usual phone's path loss says.
    """
    rows, which = list[tuple[float, float, float]](), list[tuple[int, int]]()
    for (n, one), (m, other) in permutations(enumerate(walks), 2):
        if one.person != other.person and one.heard is not None:
            met = list(_met(one, one.heard, other, phones))
            rows += met
            which += [(n, m)] * len(met)
    return Closures.of(rows, which)


def _met(
    one: Carried, heard: Sightings, other: Carried, phones: Mapping[str, str]
) -> Iterator[tuple[float, float, float]]:
    """Both moments and a sigma [m] of each time at which one phone heard the other, the loudest of a while."""
    own = np.array([phones.get(name) == other.person for name in heard.transmitter], dtype=bool)
    later = one.epoch - other.epoch
    during = (heard.time + later >= other.start) & (heard.time + later <= other.end)
    rows = np.flatnonzero(own & during & (heard.rssi >= FAINTEST) & (heard.time >= one.start) & (heard.time <= one.end))
    loudest = rows[np.argsort(-heard.rssi[rows], kind="stable")]
    for row in loudest[np.unique(heard.time[loudest] // EVERY, return_index=True)[1]]:
        time, distance = float(heard.time[row]), 10 ** ((LOSS[0] - heard.rssi[row]) / (10 * LOSS[1]))
        yield time, time + later, max(NEAREST, distance / np.sqrt(2))
