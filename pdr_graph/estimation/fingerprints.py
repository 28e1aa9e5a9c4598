"""What a phone's radios hear in a few seconds, and where other walks heard the like."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import cdist

from pdr_graph.types import Array, Index, Mask, Recording

WINDOW, EVERY = 4, 1  # [s] that one scan takes in, and from one to the next: a phone needs 2 to 4 s for all channels
FAINTEST = -100.0  # [dBm] as good as not heard
FEWEST = 3  # transmitters in a scan: one or two are at too many places
NEIGHBOURS = 8
AGREED = 0.8  # of the neighbours' weight on one floor: with less, the floor is not known


@dataclass(frozen=True)
class Scans:
    """What was heard in windows of `WINDOW` seconds.

    time: ``(n,)`` their middles [s]; transmitter: m names; level: ``(n, m)`` [dB] above `FAINTEST`, 0 where unheard.
    """

    time: Array
    transmitter: tuple[str, ...]
    level: Array

    def __len__(self) -> int:
        return len(self.time)

    def __getitem__(self, which: Mask | Index) -> Scans:
        return replace(self, time=self.time[which], level=self.level[which])

    def of(self, transmitters: Sequence[str]) -> Array:
        """Levels ``(n, k)`` of other transmitters; those that no scan knows were not heard."""
        column = {name: n for n, name in enumerate(self.transmitter)}
        known = [n for n, name in enumerate(transmitters) if name in column]
        level = np.zeros((len(self), len(transmitters)))
        level[:, known] = self.level[:, [column[transmitters[n]] for n in known]]
        return level


def scans_of(recording: Recording) -> Scans:
    """Beacons and access points of a recording, the mean level of each in each window."""
    parts = [part for part in (recording.bluetooth, recording.wifi) if part is not None]
    level = np.concatenate([np.empty(0), *(part.rssi for part in parts)]) - FAINTEST
    time = np.concatenate([np.empty(0), *(part.time for part in parts)])
    names = [name for part in parts for name in part.transmitter]
    known = (level > 0) & (level < -FAINTEST)  # recorders write 0 or 127 dBm where they do not know
    heard = np.flatnonzero(known & (time >= 0))  # before, the phone was anywhere
    if not len(heard):
        return Scans(np.empty(0), (), np.empty((0, 0)))
    transmitters, who = np.unique([names[n] for n in heard], return_inverse=True)
    first = np.floor(time[heard] / EVERY).astype(int)
    begin, windows = first.min() - WINDOW + 1, int(np.ptp(first)) + WINDOW
    total, count = np.zeros((2, windows, len(transmitters)))
    for earlier in range(0, WINDOW, EVERY):
        np.add.at(total, (first - earlier - begin, who), level[heard])
        np.add.at(count, (first - earlier - begin, who), 1)
    found = Scans(
        (begin + np.arange(windows)) * EVERY + WINDOW / 2, tuple(transmitters.tolist()), total / count.clip(1)
    )
    return found[(count > 0).sum(axis=1) >= FEWEST]


@dataclass(frozen=True)
class Matches:
    """Where n scans were heard. position: ``(n, 2)`` [m]; floor: label, empty where neighbours are not agreed;
    distance: ``(n,)`` of the most alike fingerprint, 0 (the same) to 1 (nothing in common).
    """

    position: Array
    floor: tuple[str, ...]
    distance: Array


def unlikeness(one: Array, other: Array) -> Array:
    """How little scans ``(q, m)`` are like others ``(n, m)``, each 0 to 1 ``(q, n)``: Σ|a − b| / Σ(a + b).

    Sørensen's distance, of 52 the best on Wi-Fi fingerprints in Torres-Sospedra et al., "Comprehensive analysis of
    distance and similarity measures for Wi-Fi fingerprinting", 2015. No transmitter, such as a phone that is carried
    about, weighs more in it than its level.
    """
    with np.errstate(invalid="ignore"):
        distance = cdist(one, other, "braycurtis").astype(np.float64)
    return np.nan_to_num(distance, nan=1.0)


def matched(distance: Array, position: Array, floor: Sequence[str]) -> Matches:
    """Scans placed among the most alike of n fingerprints, weighted by 1 / distance².

    distance: ``(q, n)``; position ``(n, 2)`` and floor of the fingerprints. Neighbours on another floor than most do
    not count.
    """
    near = np.argsort(distance, axis=1)[:, :NEIGHBOURS]
    alike = np.take_along_axis(distance, near, axis=1)
    weight = np.where(alike < 1, 1 / alike.clip(1e-3) ** 2, 0)
    labels, code = np.unique(np.asarray(floor, dtype=str), return_inverse=True)
    share = np.stack([(weight * (code[near] == n)).sum(axis=1) for n in range(len(labels))], axis=1)
    here = share.argmax(axis=1)
    agreed = share.max(axis=1) >= AGREED * weight.sum(axis=1)
    weight = weight * (code[near] == here[:, None])
    weight /= weight.sum(axis=1, keepdims=True).clip(1e-12)
    return Matches(
        np.einsum("qk,qkd->qd", weight, position[near]),
        tuple(str(labels[n]) if sure else "" for n, sure in zip(here, agreed, strict=True)),
        alike[:, 0],
    )
