"""Radio fingerprinting: scans, radio maps of smoothed walks and their fixes, and place recognition between walks.

[map-matching] and [calibration-walk] know one walk at a time. What a phone hears is a place's own, so that scans that
are alike tie the places where they were heard. How far apart such places are, by how unlike the scans are, is learnt
from the walks themselves, as they are known so far. Walkers shade a radio on one side, and hold it otherwise the next
day: closures of the same two walks err alike for a while, and together are worth one.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from scipy.optimize import nnls
from scipy.spatial.distance import cdist

from pdr_graph.errors import InputError
from pdr_graph.frames import Frame
from pdr_graph.geometry import interpolate, length_along, nearest
from pdr_graph.measurements import Closures
from pdr_graph.types import Array, Fixes, Index, Mask, Recording, Sightings, Trajectory

WINDOW, SCAN_INTERVAL = 4, 1  # [s] of one scan, and from one to the next: a phone needs 2 to 4 s for all channels
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
    return scans_in([part for part in (recording.bluetooth, recording.wifi) if part is not None])


def scans_in(parts: Sequence[Sightings]) -> Scans:
    """What several radios heard, the mean level of each transmitter in each window."""
    level = np.concatenate([np.empty(0), *(part.rssi for part in parts)]) - FAINTEST
    time = np.concatenate([np.empty(0), *(part.time for part in parts)])
    names = [name for part in parts for name in part.transmitter]
    known = (level > 0) & (level < -FAINTEST)  # recorders write 0 or 127 dBm where they do not know
    heard = np.flatnonzero(known & (time >= 0))  # before, the phone was anywhere
    if not len(heard):
        return Scans(np.empty(0), (), np.empty((0, 0)))
    transmitters, who = np.unique([names[n] for n in heard], return_inverse=True)
    first = np.floor(time[heard] / SCAN_INTERVAL).astype(int)
    begin, windows = first.min() - WINDOW + 1, int(np.ptp(first)) + WINDOW
    total, count = np.zeros((2, windows, len(transmitters)))
    for earlier in range(0, WINDOW, SCAN_INTERVAL):
        np.add.at(total, (first - earlier - begin, who), level[heard])
        np.add.at(count, (first - earlier - begin, who), 1)
    found = Scans(
        (begin + np.arange(windows)) * SCAN_INTERVAL + WINDOW / 2, tuple(transmitters.tolist()), total / count.clip(1)
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


LEAST_SURE = 3.0  # [m] per axis: where a walk is less certain than that, it teaches nothing
NEAR = 5.0  # [m] from a fingerprint a place is one that the map knows
ACCEPTED_SCANS = (0.05, 0.95)  # of the scans at places that the map knows: less alike gives no fix, more is no surer
FINEST = 0.5  # [m] σ of a place that was passed within seconds
APART = 10.0  # [s] of a walk's own scans left out before and after
SHARED = 1.5  # times σ is stated: a map errs alike at a place, however long one stays there
ENOUGH = 20  # scans at known places, to tell from them how good the map is
MOST_CHECKED = 1000  # scans, evenly chosen: more tell nothing new
ARRAYS = ("transmitter", "level", "position", "floor", "frame", "range", "variance")
UNREADABLE = (ValueError, KeyError, TypeError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error)


@dataclass(frozen=True)
class RadioMap:
    """Fingerprints with places, and how far off the places are that they give to other walks.

    transmitter: m identities; level: ``(n, m)`` as of `Scans`.
    position: ``(n, 2)`` where the walks were [m]; floor: n labels; frame: as `Frame.describe` says.
    range: ``(2,)`` distances of fingerprints: none is surer than at the first, beyond the last no place is known.
    variance: ``(2,)`` σ² per axis of a single fix = variance[0] + variance[1] · distance² [m²].
    """

    transmitter: tuple[str, ...]
    level: Array
    position: Array
    floor: tuple[str, ...]
    frame: dict[str, Any]
    range: Array
    variance: Array

    source: ClassVar[str] = "radio map"  # of its fixes

    def __len__(self) -> int:
        return len(self.level)

    @classmethod
    def learn(cls, walks: Sequence[tuple[Trajectory, Recording]], frame: dict[str, Any] | None = None) -> RadioMap:
        """Of walks already smoothed, all in one frame (as `Frame.describe` says; default: a local one).

        Raises ValueError if they heard too little to say how good the map is.
        """
        placed = [_placed(track, scans_of(recording)) for track, recording in walks]
        transmitters = sorted({name for scans, _, _ in placed for name in scans.transmitter})
        level = np.concatenate([np.empty((0, len(transmitters))), *(scans.of(transmitters) for scans, _, _ in placed)])
        position = np.concatenate([np.empty((0, 2)), *(at for _, at, _ in placed)])
        floor = tuple(label for _, _, labels in placed for label in labels)
        walk = np.repeat(np.arange(len(placed)), [len(scans) for scans, _, _ in placed])
        time = np.concatenate([np.empty(0), *(scans.time for scans, _, _ in placed)])
        if len(level) < ENOUGH:
            raise ValueError(f"found {len(level)} scans along the walks, expected at least {ENOUGH}")
        limits, variance = _calibrated(level, position, floor, walk, time)
        described = Frame().describe() if frame is None else frame
        return cls(tuple(transmitters), level, position, floor, described, limits, variance)

    def fixes(self, recording: Recording) -> Fixes:
        """Where a later walk was, every `WINDOW` seconds at most: of scans that overlap, the one most like a
        fingerprint. Scans that are like none give no fix. Sigmas are `SHARED` times those of a single fix, so that
        all together say no more than they know.
        """
        return self.located(scans_of(recording))

    def located(self, scans: Scans) -> Fixes:
        """The fixes of scans, as of `fixes`."""
        if not len(scans):
            return Fixes.none()
        found = matched(unlikeness(scans.of(self.transmitter), self.level), self.position, self.floor)
        best = [
            block[np.argmin(found.distance[block])]
            for block in np.split(np.arange(len(scans)), np.flatnonzero(np.diff(scans.time // WINDOW)) + 1)
        ]
        best = np.array([n for n in best if found.distance[n] <= self.range[1]], dtype=int)
        variance = self.variance[0] + self.variance[1] * found.distance[best].clip(self.range[0]) ** 2
        sigma = SHARED * np.sqrt(variance.clip(FINEST**2))
        floor, source = tuple(found.floor[n] for n in best), (self.source,) * len(best)
        return Fixes(scans.time[best], found.position[best], sigma, floor, source=source)

    def save(self, path: str | Path) -> None:
        """Write the map as a numpy archive."""
        arrays = {name: np.asarray(getattr(self, name)) for name in ARRAYS if name != "frame"}
        arrays |= {"level": self.level.astype(np.float32), "frame": np.array(json.dumps(self.frame))}
        with Path(path).open("wb") as file:  # a name without .npz stays as it is
            np.savez_compressed(file, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> RadioMap:
        """Read a map that `save` wrote. Raises InputError if it is another file, or damaged."""
        try:
            with zipfile.ZipFile(path) as archive:
                if damaged := archive.testzip():
                    raise zipfile.BadZipFile(f"a damaged {damaged}")
            with np.load(path, allow_pickle=False) as arrays:
                found = {name: arrays[name] for name in ARRAYS}
            frame = json.loads(str(found["frame"]))
        except UNREADABLE as error:
            raise InputError(path, "", f"{error}", "a radio map as pdr-graph radio-map writes it") from None
        _check(path, found, frame)
        return cls(
            tuple(found["transmitter"].tolist()),
            found["level"].astype(float),
            found["position"],
            tuple(found["floor"].tolist()),
            frame,
            found["range"],
            found["variance"],
        )


def _placed(track: Trajectory, scans: Scans) -> tuple[Scans, Array, list[str]]:
    """The scans at which the walk is known well enough, its position there ``(n, 2)``, and its floor."""
    within = (scans.time >= track.time[0]) & (scans.time <= track.time[-1])
    if track.covariance is not None:
        largest = np.linalg.eigvalsh(track.covariance[:, :2, :2])[:, -1]
        within &= np.interp(scans.time, track.time, largest) <= LEAST_SURE**2
    scans = scans[within]
    rows = nearest(track.time, scans.time)
    return scans, interpolate(scans.time, track.time, track.position), [track.floor[row] for row in rows]


def _calibrated(level: Array, position: Array, floor: Sequence[str], walk: Index, time: Array) -> tuple[Array, Array]:
    """How unlike scans at known places are, and the errors' variance: each walk by a map of the others, or, where
    no other has been where it was, of all but its own neighbourhood.
    """
    some = np.linspace(0, len(level) - 1, min(len(level), MOST_CHECKED)).astype(int)
    same = walk[some, None] == walk
    distance, apart = unlikeness(level[some], level), np.hypot(*(position[some, None] - position).transpose(2, 0, 1))
    for left_out in (same, same & (np.abs(time[some, None] - time) < APART)):
        without = np.where(left_out, 1.0, distance)
        known = np.where(left_out, np.inf, apart).min(axis=1) < NEAR
        if known.sum() >= ENOUGH:
            break
    else:
        known = without.min(axis=1) < 1  # a walk that is never twice near one place: as far as its neighbourhood
    found = matched(without, position, floor)
    limits = np.quantile(found.distance[known], ACCEPTED_SCANS) if known.any() else np.zeros(2)
    accepted = found.distance <= limits[1]
    at, error = found.distance[accepted].clip(limits[0]), (found.position - position[some])[accepted]
    return limits, variance_by_distance(at, error)


def variance_by_distance(distance: Array, error: Array) -> Array:
    """σ² = v₀ + v₁ d², the most probable for normal errors ``(n, 2)`` [m] at distances ``(n,)``: least squares of the
    squared errors, each weighed by what it is expected to be.
    """
    terms, squared = np.stack([np.ones(len(distance)), distance**2], axis=1), (error**2).mean(axis=1)
    expected = np.full(len(distance), max(squared.mean(), 1e-6))
    variance = np.array([expected[0], 0.0])
    for _ in range(20):
        variance = nnls(terms / expected[:, None], squared / expected)[0]
        expected = (terms @ variance).clip(1e-6)
    return variance


def _check(path: str | Path, found: dict[str, Array], frame: Any) -> None:
    """That the arrays of a file belong together."""
    n, m = len(found["position"]) if found["position"].ndim else 0, found["transmitter"].size
    shapes = {"level": (n, m), "position": (n, 2), "floor": (n,), "transmitter": (m,), "range": (2,), "variance": (2,)}
    for name, shape in shapes.items():
        if found[name].shape != shape:
            raise InputError(path, name, f"an array of shape {found[name].shape}", f"one of {shape}")
    for name in shapes:
        text = name in ("transmitter", "floor")
        good: Mask = np.array(found[name].dtype.kind == ("U" if text else "f"))
        if good and not text:
            good = np.isfinite(found[name]) & ((found[name] >= 0) | (name == "position"))
        if not good.all():
            raise InputError(path, name, "other values", "texts" if text else "finite numbers")
    if not n or not isinstance(frame, dict) or set(frame) != set(Frame().describe()):
        raise InputError(path, "", "an empty radio map", "fingerprints and their frame")


SCAN_SPACING = 3.0  # [m] of a walk that one scan speaks for: phones hear the same for seconds
ALONG = 30.0  # [m] of a walk in which closures to the same other walk err alike, by metres
LATER = 60.0  # [s] after which a walk sees a place *again*
ACCEPTED_PAIRS = 0.8  # of the pairs at places that are near by the walks so far: less alike ones tell nothing
USUALLY_ALIKE, USUALLY_APART = 0.3, 5.0  # [m] σ: pairs in two malls, where the walks are too little known to tell


@dataclass(frozen=True)
class _Heard:
    """Scans of all walks, thinned: walk, time [s], how far along it [m], level ``(n, m)``, position ``(n, 2)`` [m]
    and floor.
    """

    walk: Index
    time: Array
    way: Array
    level: Array
    position: Array
    floor: tuple[str, ...]


def revisits(walks: Sequence[tuple[Trajectory, Scans]]) -> Closures:
    """Closures between the moments of walks in one frame that were spent at one place.

    walks: each as it is known so far, and what was heard. Of each pair of walks, every few metres of the one that has
    them, the moment of the other that sounds most alike.
    """
    if not any(len(scans) for _, scans in walks):
        return Closures.of([])
    heard = _heard(walks)
    pairs = np.array([pair for pair in _most_alike(heard)]).reshape(-1, 3)
    one, other, distance = pairs[:, 0].astype(int), pairs[:, 1].astype(int), pairs[:, 2]
    apart = heard.position[other] - heard.position[one]
    taken, sigma = _accepted(distance, apart)
    one, other = one[taken], other[taken]
    sigma *= np.sqrt(_alike(heard.walk[one] * len(walks) + heard.walk[other], heard.way[one]))
    return Closures(
        np.stack([heard.time[one], heard.time[other]], axis=1),
        sigma,
        np.stack([heard.walk[one], heard.walk[other]], axis=1),
    )


def _accepted(distance: Array, apart: Array) -> tuple[Mask, Array]:
    """Which pairs ``(p,)`` are of one place, and the sigma of each that does [m].

    distance: ``(p,)`` how unlike their scans are; apart: ``(p, 2)`` from one to the other, by the walks so far [m].
    """
    known = np.hypot(*apart.T) < NEAR
    if known.sum() < ENOUGH:
        taken = distance < USUALLY_ALIKE
        return taken, np.full(np.count_nonzero(taken), USUALLY_APART)
    least, most = np.quantile(distance[known], [1 - ACCEPTED_PAIRS, ACCEPTED_PAIRS])
    taken = distance <= most
    at = distance[taken].clip(least)
    v_0, v_1 = variance_by_distance(at, apart[taken])
    return taken, np.sqrt((v_0 + v_1 * at**2).clip(FINEST**2))


def _alike(pair: Index, way: Array) -> Array:
    """How many closures of the same two walks err like each ``(l,)``, itself among them: together they are worth one.

    way: along one of the walks [m].
    """
    near = (pair[:, None] == pair) & (np.abs(way[:, None] - way) < ALONG)
    return near.sum(axis=1)


def _heard(walks: Sequence[tuple[Trajectory, Scans]]) -> _Heard:
    """What all walks heard, a scan every few metres."""
    thinned = [_thinned(track, scans) for track, scans in walks]
    names = sorted({name for scans in thinned for name in scans.transmitter})
    position = [interpolate(s.time, track.time, track.position) for (track, _), s in zip(walks, thinned, strict=True)]
    rows = [nearest(track.time, s.time) for (track, _), s in zip(walks, thinned, strict=True)]
    return _Heard(
        walk=np.repeat(np.arange(len(walks)), [len(scans) for scans in thinned]),
        time=np.concatenate([scans.time for scans in thinned]),
        way=np.concatenate([_way(track, scans) for (track, _), scans in zip(walks, thinned, strict=True)]),
        level=np.concatenate([scans.of(names) for scans in thinned]),
        position=np.concatenate(position),
        floor=tuple(track.floor[r] for (track, _), own in zip(walks, rows, strict=True) for r in own.tolist()),
    )


def _thinned(track: Trajectory, scans: Scans) -> Scans:
    """One scan in every few metres of the walk."""
    scans = scans[(scans.time >= track.time[0]) & (scans.time <= track.time[-1])]
    return scans[np.unique(np.floor(_way(track, scans) / SCAN_SPACING), return_index=True)[1]]


def _way(track: Trajectory, scans: Scans) -> Array:
    """How far along the walk each scan was. [m]"""
    return np.interp(scans.time, track.time, length_along(track.position))


def _most_alike(heard: _Heard) -> Iterator[tuple[int, int, float]]:
    """Of each scan the most alike one of each walk that is not earlier; and how unlike they are."""
    distance = unlikeness(heard.level, heard.level)
    floor = np.array(heard.floor)
    apart = (floor[:, None] != floor) & (floor != "")[:, None] & (floor != "")
    same = heard.walk[:, None] == heard.walk
    soon = same & (heard.time - heard.time[:, None] < LATER)
    distance = np.where(apart | soon | (heard.walk < heard.walk[:, None]), 1.0, distance)
    first = np.flatnonzero(np.diff(heard.walk, prepend=-1))
    for begin, end in zip(first.tolist(), [*first[1:].tolist(), len(heard.walk)], strict=True):
        best = begin + np.argmin(distance[:, begin:end], axis=1)
        for one in np.flatnonzero(distance[np.arange(len(best)), best] < 1).tolist():
            yield one, int(best[one]), float(distance[one, best[one]])
