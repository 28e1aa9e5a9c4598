"""Radio fingerprinting: scans, radio maps of smoothed walks and their fixes, and place recognition between walks.

[map-matching] and [calibration-walk] estimate one walk at a time. Radio signals are characteristic of a place, so
similar scans connect the places where they were received. The distance between such places, as a function of the
dissimilarity of the scans, is learnt from the present estimates of the walks. Bodies shade a radio on one side, and it
is held differently the next day: closures of the same two walks have correlated errors, and together have the
information of a single scan.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from scipy.optimize import nnls
from scipy.spatial.distance import cdist

from pdr_graph.errors import InputError
from pdr_graph.frames import Frame
from pdr_graph.geometry import interpolate, length_along, nearest
from pdr_graph.io.source import Source
from pdr_graph.priors import SCANS
from pdr_graph.types import Array, Closures, Fixes, Index, Mask, Recording, Sightings, Trajectory, appended, take
from pdr_graph.whole_files import write_file

FEWEST_SCANS = 20  # at mapped places, by which the errors of a map are estimated
MOST_LEVELS = 20_000  # that are stored: some minutes where 100 transmitters are heard
LONGEST_SPAN = 600.0  # [s] of the walk whose levels are stored: the scans are a table of windows times transmitters


@dataclass(frozen=True)
class Scans:
    """Received levels in windows of `SCANS.window` seconds, one a second.

    time: ``(n,)`` their middles [s]; transmitter: m names; level: ``(n, m)`` dB above `SCANS.faintest` to the power of
    `SCANS.exponent`, 0 if not received. Strong levels are then most of a scan: they change most from place to place
    (powed levels, Torres-Sospedra et al. 2015).
    """

    time: Array
    transmitter: tuple[str, ...]
    level: Array

    def __len__(self) -> int:
        return len(self.time)

    def __getitem__(self, which: Mask | Index) -> Scans:
        return replace(self, time=self.time[which], level=self.level[which])

    def of(self, transmitters: Sequence[str]) -> Array:
        """Levels ``(n, k)`` of a list of transmitters; 0 for those that are not in these scans."""
        column = {name: n for n, name in enumerate(self.transmitter)}
        shared = [n for n, name in enumerate(transmitters) if name in column]
        level = np.zeros((len(self), len(transmitters)))
        level[:, shared] = self.level[:, [column[transmitters[n]] for n in shared]]
        return level


def scans_of(recording: Recording) -> Scans:
    """Beacons and access points of a recording, the mean level of each in each window."""
    return scans_in([part for part in (recording.bluetooth, recording.wifi) if part is not None])


def scans_in(parts: Sequence[Sightings]) -> Scans:
    """The mean level of each transmitter in each window, from several radios."""
    level = np.concatenate([np.empty(0), *(part.rssi for part in parts)]) - SCANS.faintest
    time = np.concatenate([np.empty(0), *(part.time for part in parts)])
    names = [name for part in parts for name in part.transmitter]
    valid = (level > 0) & (level < -SCANS.faintest)  # recorders write 0 or 127 dBm for unknown levels
    rows = np.flatnonzero(valid & (time >= 0))  # without levels cached from before the recording
    if not len(rows):
        return Scans(np.empty(0), (), np.empty((0, 0)))
    transmitters, column = np.unique([names[n] for n in rows], return_inverse=True)
    first = np.floor(time[rows]).astype(int)
    begin, windows = first.min() - SCANS.window + 1, int(np.ptp(first)) + SCANS.window
    total, count = np.zeros((2, windows, len(transmitters)))
    for earlier in range(SCANS.window):
        np.add.at(total, (first - earlier - begin, column), level[rows])
        np.add.at(count, (first - earlier - begin, column), 1)
    scans = Scans(
        begin + np.arange(windows) + SCANS.window / 2,
        tuple(transmitters.tolist()),
        (total / count.clip(1)) ** SCANS.exponent,
    )
    return scans[(count > 0).sum(axis=1) >= SCANS.fewest]


def unlikeness(first: Array, second: Array) -> Array:
    """Distances ``(q, n)`` from 0 to 1 of scans ``(q, m)`` from others ``(n, m)``: Σ|a − b| / Σ(a + b).

    Sørensen's distance, the best of 52 on Wi-Fi fingerprints in Torres-Sospedra et al., "Comprehensive analysis of
    distance and similarity measures for Wi-Fi fingerprinting", 2015. The influence of a transmitter, such as another
    phone, is limited by its level.
    """
    with np.errstate(invalid="ignore"):
        distance = cdist(first, second, "braycurtis").astype(np.float64)
    return np.nan_to_num(distance, nan=1.0)


def matched(distance: Array, position: Array, floor: Sequence[str]) -> tuple[Array, tuple[str, ...], Array]:
    """Positions of scans as the mean of the most similar of n fingerprints, weighted by 1 / distance².

    distance: ``(q, n)``; position ``(n, 2)`` and floor of the fingerprints. Neighbours that are not on the most
    frequent floor have weight 0. Returns positions ``(q, 2)`` [m]; labels of floors, empty where neighbours do not
    agree; distances ``(q,)`` to the most similar fingerprint, 0 (the same) to 1 (nothing in common).
    """
    near = np.argsort(distance, axis=1)[:, : SCANS.neighbours]
    alike = np.take_along_axis(distance, near, axis=1)
    weight = np.where(alike < 1, 1 / alike.clip(1e-3) ** 2, 0)
    labels, code = np.unique(np.asarray(floor, dtype=str), return_inverse=True)
    share = np.stack([(weight * (code[near] == n)).sum(axis=1) for n in range(len(labels))], axis=1)
    here = share.argmax(axis=1)
    agreed = share.max(axis=1) >= SCANS.agreed * weight.sum(axis=1)
    weight = weight * (code[near] == here[:, None])
    weight /= weight.sum(axis=1, keepdims=True).clip(1e-12)
    floors = tuple(str(labels[n]) if sure else "" for n, sure in zip(here, agreed, strict=True))
    return np.einsum("qk,qkd->qd", weight, position[near]), floors, alike[:, 0]


MOST_CHECKED = 1000  # scans for that, evenly chosen
MAP_VERSION = 2  # of the file: levels with an exponent, and recordings
ARRAYS = ("transmitter", "level", "position", "floor", "recording", "time", "frame", "range", "variance")
PLACE, MOST_AT_PLACE = 2.0, 20  # [m] squares, in which the newest are kept: as a dozen walks leave there
UNREADABLE_MAP = (ValueError, KeyError, TypeError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error)
UNREADABLE_MAP += (MemoryError,)  # numpy allocates what the header of an array states
LARGEST_MAP = 500_000_000  # [bytes] unpacked: 60 000 fingerprints of 2000 transmitters


@dataclass(frozen=True)
class RadioMap:
    """Fingerprints with positions, and the error model of fixes from them.

    transmitter: m identities; level: ``(n, m)`` see `Scans`.
    position: ``(n, 2)`` of the walks [m]; floor: n labels; frame: as of `Frame.describe`.
    recording: ``(n,)`` number of the one that it is from, in the order in which they were added; time: ``(n,)`` in it
    [s].
    range: ``(2,)`` distances: below the first, σ is constant; beyond the second there is no fix.
    variance: ``(2,)`` σ² per axis of a single fix = variance[0] + variance[1] · distance² [m²].
    """

    transmitter: tuple[str, ...]
    level: Array
    position: Array
    floor: tuple[str, ...]
    recording: Index
    time: Array
    frame: dict[str, Any]
    range: Array
    variance: Array

    source: ClassVar[str] = "radio map"  # of its fixes

    def __len__(self) -> int:
        return len(self.level)

    @classmethod
    def learn(
        cls,
        walks: Sequence[tuple[Trajectory, Recording]],
        frame: dict[str, Any] | None = None,
        known: RadioMap | None = None,
    ) -> RadioMap:
        """Learn a map from smoothed walks in one frame (as of `Frame.describe`; default: that of ``known``, or a local
        one).

        known: a map to which they are added. Of each place the newest fingerprints are kept, so that a map does not
        grow with its walks, and forgets what was moved or switched off.

        Raises ValueError if they have too few scans to estimate the errors of the map, or are not in its frame.
        """
        described = frame or (Frame().describe() if known is None else known.frame)
        if known is not None and known.frame != described:
            raise ValueError(f"found the frame {described}, expected that of the map, {known.frame}")
        parts = [] if known is None else [_Fingerprints.of_map(known)]
        first = 0 if known is None else 1 + int(known.recording.max())
        parts += [_Fingerprints.along(track, scans_of(heard), n) for n, (track, heard) in enumerate(walks, first)]
        if (found := sum(len(part.scans) for part in parts)) < FEWEST_SCANS:
            raise ValueError(f"found {found} scans along the walks, expected at least {FEWEST_SCANS}")
        placed = _Fingerprints.joined(parts).newest()
        scans, floor = placed.scans, tuple(placed.floor.tolist())
        limits, variance = _calibrated(placed)
        where = placed.position, floor, placed.recording, scans.time
        return cls(scans.transmitter, scans.level, *where, described, limits, variance)

    def fixes(self, recording: Recording) -> Fixes:
        """Fixes of a later walk, at most one per `SCANS.window` seconds: of overlapping scans, the most similar to a
        fingerprint. Scans that resemble none give no fix. Sigmas are `SCANS.shared` times those of a single fix, since
        the errors of fixes at one place are correlated.
        """
        return self.located(scans_of(recording))

    def located(self, scans: Scans) -> Fixes:
        """The fixes of scans, see `fixes`."""
        if not len(scans):
            return Fixes.none()
        position, floor, distance = matched(
            unlikeness(scans.of(self.transmitter), self.level), self.position, self.floor
        )
        blocks = np.split(np.arange(len(scans)), np.flatnonzero(np.diff(scans.time // SCANS.window)) + 1)
        best = np.array([block[np.argmin(distance[block])] for block in blocks], dtype=int)
        best = best[distance[best] <= self.range[1]]
        variance = self.variance[0] + self.variance[1] * distance[best].clip(self.range[0]) ** 2
        sigma = SCANS.shared * np.sqrt(variance.clip(SCANS.finest**2))
        floors, source = tuple(floor[n] for n in best), (self.source,) * len(best)
        return Fixes(scans.time[best], position[best], sigma, floors, source=source)

    def collector(self, listener: Callable[[Fixes], None]) -> ScanCollector:
        """What makes fixes of the scans of a walk under way; listener: is called with each."""
        return ScanCollector(self, listener)

    def save(self, path: str | Path) -> None:
        """Write the map as a numpy archive."""
        arrays = {name: np.asarray(getattr(self, name)) for name in ARRAYS if name != "frame"}
        arrays |= {"level": self.level.astype(np.float32), "frame": np.array(json.dumps(self.frame))}
        arrays["version"] = np.array(MAP_VERSION)
        archive = io.BytesIO()
        np.savez_compressed(archive, allow_pickle=False, **arrays)
        write_file(path, archive.getvalue())

    @classmethod
    def load(cls, path: str | Path) -> RadioMap:
        """Read a map that `save` wrote. Raises InputError if it is another file, damaged or larger than LARGEST_MAP."""
        files = Source(Path(path), "radio map")
        if (size := sum(files.size(name) for name in files.names)) > LARGEST_MAP:
            raise InputError(path, "", f"{size} bytes unpacked", f"at most {LARGEST_MAP}: fewer fingerprints")
        try:
            with zipfile.ZipFile(path) as archive:
                if damaged := archive.testzip():
                    raise zipfile.BadZipFile(f"a damaged {damaged}")
            with np.load(path, allow_pickle=False) as arrays:
                if (version := int(arrays["version"]) if "version" in arrays else 1) != MAP_VERSION:
                    found, expected = f"{version}", f"{MAP_VERSION}: make it again by pdr-graph radio-map"
                    raise InputError(path, "version", found, expected)
                stored = {name: arrays[name] for name in ARRAYS}
            frame = json.loads(str(stored["frame"]))
        except UNREADABLE_MAP as error:
            raise InputError(path, "", f"{error}", "a radio map as pdr-graph radio-map writes it") from None
        _check(path, stored, frame)
        return cls(
            tuple(stored["transmitter"].tolist()),
            stored["level"].astype(float),
            stored["position"],
            tuple(stored["floor"].tolist()),
            stored["recording"],
            stored["time"],
            frame,
            stored["range"],
            stored["variance"],
        )


@dataclass(frozen=True)
class _Fingerprints:
    """Scans with their places: position ``(n, 2)`` [m], floor ``(n,)`` labels, recording ``(n,)`` its number."""

    scans: Scans
    position: Array
    floor: Array
    recording: Index

    @classmethod
    def along(cls, track: Trajectory, scans: Scans, number: int) -> _Fingerprints:
        """The scans at which a walk is certain enough; number: of the recording."""
        within = (scans.time >= track.time[0]) & (scans.time <= track.time[-1])
        if track.covariance is not None:
            largest = np.linalg.eigvalsh(track.covariance[:, :2, :2])[:, -1]
            within &= np.interp(scans.time, track.time, largest) <= SCANS.least_sure**2
        scans = scans[within]
        floor = np.array([track.floor[row] for row in nearest(track.time, scans.time)], dtype=str)
        position = interpolate(scans.time, track.time, track.position)
        return cls(scans, position, floor, np.full(len(scans), number))

    @classmethod
    def of_map(cls, known: RadioMap) -> _Fingerprints:
        """The fingerprints of a map."""
        scans = Scans(known.time, known.transmitter, known.level)
        return cls(scans, known.position, np.array(known.floor, dtype=str), known.recording)

    @classmethod
    def joined(cls, parts: Sequence[_Fingerprints]) -> _Fingerprints:
        """All parts, with the transmitters that any of them received."""
        names = tuple(sorted({name for part in parts for name in part.scans.transmitter}))
        time = np.concatenate([part.scans.time for part in parts])
        scans = Scans(time, names, np.concatenate([part.scans.of(names) for part in parts]))
        others = ("position", "floor", "recording")
        return cls(scans, *(np.concatenate([getattr(part, name) for part in parts]) for name in others))

    def newest(self) -> _Fingerprints:
        """The last MOST_AT_PLACE of each place, and the transmitters that these received."""
        square = np.column_stack([np.floor(self.position / PLACE), np.unique(self.floor, return_inverse=True)[1]])
        place = np.unique(square, axis=0, return_inverse=True)[1].ravel()
        order = np.argsort(place, kind="stable")
        later = np.searchsorted(place[order], place[order], side="right") - np.arange(len(order))
        kept = np.sort(order[later <= MOST_AT_PLACE])
        level = self.scans.level[kept]
        heard = np.flatnonzero(level.any(axis=0))
        names = tuple(self.scans.transmitter[n] for n in heard.tolist())
        scans = Scans(self.scans.time[kept], names, level[:, heard])
        return _Fingerprints(scans, self.position[kept], self.floor[kept], self.recording[kept])


def _calibrated(placed: _Fingerprints) -> tuple[Array, Array]:
    """`RadioMap.range` and `RadioMap.variance` by cross-validation: each walk with a map of the others or, if these
    were elsewhere, of everything except the neighbourhood in time.
    """
    level, position, walk, time = placed.scans.level, placed.position, placed.recording, placed.scans.time
    some = np.linspace(0, len(level) - 1, min(len(level), MOST_CHECKED)).astype(int)
    same = walk[some, None] == walk
    distance, apart = unlikeness(level[some], level), np.hypot(*(position[some, None] - position).transpose(2, 0, 1))
    apart[placed.floor[some, None] != placed.floor] = np.inf
    for left_out in (same, same & (np.abs(time[some, None] - time) < SCANS.apart)):
        without = np.where(left_out, 1.0, distance)
        near = np.where(left_out, np.inf, apart).min(axis=1) < SCANS.near
        if near.sum() >= FEWEST_SCANS:
            break
    else:
        near = without.min(axis=1) < 1  # a walk that visits no place twice: all scans with something in common
    place, _, closest = matched(without, position, placed.floor.tolist())
    limits = np.quantile(closest[near], SCANS.accepted) if near.any() else np.zeros(2)
    accepted = closest <= limits[1]
    at, error = closest[accepted].clip(limits[0]), (place - position[some])[accepted]
    return limits, variance_by_distance(at, error)


def variance_by_distance(distance: Array, error: Array) -> Array:
    """(v₀, v₁) of σ² = v₀ + v₁ d² by maximum likelihood for normal errors ``(n, 2)`` [m] at distances ``(n,)``.

    Computed as least squares of the squared errors, re-weighted by their expectation.
    """
    terms, squared = np.stack([np.ones(len(distance)), distance**2], axis=1), (error**2).mean(axis=1)
    expected = np.full(len(distance), max(squared.mean(), 1e-6))
    variance = np.array([expected[0], 0.0])
    for _ in range(20):
        variance = nnls(terms / expected[:, None], squared / expected)[0]
        expected = (terms @ variance).clip(1e-6)
    return variance


def _check(path: str | Path, arrays: dict[str, Array], frame: Any) -> None:
    """Raise InputError if the arrays of a file do not fit together."""
    n, m = len(arrays["position"]) if arrays["position"].ndim else 0, arrays["transmitter"].size
    shapes = {"level": (n, m), "position": (n, 2), "floor": (n,), "transmitter": (m,), "range": (2,), "variance": (2,)}
    shapes |= {"recording": (n,), "time": (n,)}
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise InputError(path, name, f"an array of shape {arrays[name].shape}", f"one of {shape}")
    for name in shapes:
        text = name in ("transmitter", "floor")
        good: Mask = np.array(arrays[name].dtype.kind == ("U" if text else "i" if name == "recording" else "f"))
        if good and not text:
            good = np.isfinite(arrays[name]) & ((arrays[name] >= 0) | (name in ("position", "time")))
        if not good.all():
            raise InputError(path, name, "other values", "texts" if text else "finite numbers")
    if not n or not isinstance(frame, dict) or set(frame) != set(Frame().describe()):
        raise InputError(path, "", "an empty radio map", "fingerprints and their frame")


@dataclass(frozen=True)
class _WalkScans:
    """Thinned scans of all walks: walk, time [s], distance along it [m], level ``(n, m)``, position ``(n, 2)`` [m] and
    floor.
    """

    walk: Index
    time: Array
    way: Array
    level: Array
    position: Array
    floor: tuple[str, ...]

    @classmethod
    def of(cls, walks: Sequence[tuple[Trajectory, Scans]]) -> _WalkScans:
        """The scans of all walks, one per SCANS.scan_spacing."""
        thinned, way, position, floor = list[Scans](), list[Array](), list[Array](), list[str]()
        for track, scans in walks:
            inside = scans[(scans.time >= track.time[0]) & (scans.time <= track.time[-1])]
            along = np.interp(inside.time, track.time, length_along(track.position))
            kept = np.unique(np.floor(along / SCANS.scan_spacing), return_index=True)[1]
            thinned.append(inside[kept])
            way.append(along[kept])
            position.append(interpolate(inside.time[kept], track.time, track.position))
            floor += [track.floor[row] for row in nearest(track.time, inside.time[kept]).tolist()]
        names = sorted({name for scans in thinned for name in scans.transmitter})
        return cls(
            walk=np.repeat(np.arange(len(walks)), [len(scans) for scans in thinned]),
            time=np.concatenate([scans.time for scans in thinned]),
            way=np.concatenate(way),
            level=np.concatenate([scans.of(names) for scans in thinned]),
            position=np.concatenate(position),
            floor=tuple(floor),
        )


def revisits(walks: Sequence[tuple[Trajectory, Scans]]) -> Closures:
    """Closures between moments at one place, by similar scans of walks in one frame.

    walks: the present estimate of each, with its scans. For each pair of walks, every few metres of the first are
    matched to the most similar scan of the second.
    """
    if not any(len(scans) for _, scans in walks):
        return Closures.of([])
    scans = _WalkScans.of(walks)
    pairs = np.array([pair for pair in _most_alike(scans)]).reshape(-1, 3)
    first, second, distance = pairs[:, 0].astype(int), pairs[:, 1].astype(int), pairs[:, 2]
    apart = scans.position[second] - scans.position[first]
    accepted, sigma = _accepted(distance, apart)
    first, second = first[accepted], second[accepted]
    sigma *= np.sqrt(_alike(scans.walk[first] * len(walks) + scans.walk[second], scans.way[first]))
    return Closures(
        np.stack([scans.time[first], scans.time[second]], axis=1),
        sigma,
        np.stack([scans.walk[first], scans.walk[second]], axis=1),
    )


def _accepted(distance: Array, apart: Array) -> tuple[Mask, Array]:
    """Mask ``(p,)`` of the pairs at one place, and the sigma [m] of each of these.

    distance: ``(p,)`` between their scans, 0 to 1; apart: ``(p, 2)`` between their positions by the estimates [m].
    """
    near = np.hypot(*apart.T) < SCANS.near
    if near.sum() < FEWEST_SCANS:
        accepted = distance < SCANS.usually_alike
        return accepted, np.full(np.count_nonzero(accepted), SCANS.near)
    least, most = np.quantile(distance[near], [1 - SCANS.accepted_pairs, SCANS.accepted_pairs])
    accepted = distance <= most
    at = distance[accepted].clip(least)
    v_0, v_1 = variance_by_distance(at, apart[accepted])
    return accepted, np.sqrt((v_0 + v_1 * at**2).clip(SCANS.finest**2))


def _alike(pair: Index, way: Array) -> Array:
    """Number of closures ``(l,)`` with the same error as each, including itself: the same walks within ALONG.

    way: distance along one of the walks [m].
    """
    number = np.zeros(len(pair), dtype=int)
    order = np.argsort(pair, kind="stable")
    for own in np.split(order, np.flatnonzero(np.diff(pair[order])) + 1):
        number[own] = (np.abs(way[own, None] - way[own]) < SCANS.along).sum(axis=1)
    return number


def _most_alike(scans: _WalkScans) -> Iterator[tuple[int, int, float]]:
    """For each scan, the most similar scan of each walk that is not earlier; indices of both, and their distance."""
    floor = np.array(scans.floor)
    first = np.flatnonzero(np.diff(scans.walk, prepend=-1))
    for begin, end in zip(first.tolist(), [*first[1:].tolist(), len(scans.walk)], strict=True):
        own = slice(begin, end)
        distance = unlikeness(scans.level, scans.level[own])
        apart = (floor[:, None] != floor[own]) & (floor != "")[:, None] & (floor[own] != "")
        soon = (scans.walk[:, None] == scans.walk[own]) & (scans.time[own] - scans.time[:, None] < SCANS.later)
        distance[apart | soon | (scans.walk[own] < scans.walk[:, None])] = 1.0
        best = begin + np.argmin(distance, axis=1)
        closest = distance[np.arange(len(best)), best - begin]
        for row in np.flatnonzero(closest < 1).tolist():
            yield row, int(best[row]), float(closest[row])


class ScanCollector:
    """Makes fixes of a radio map on a walk under way, one per block of scans; listener: is called with each.

    It is a `Collector` of `estimation/live/window.py`.
    """

    def __init__(self, radio_map: RadioMap, listener: Callable[[Fixes], None]):
        self._map, self._listener = radio_map, listener
        self._received = Sightings(np.empty(0), (), np.empty(0))
        self._block = -np.inf  # the last block with a fix

    def collect(self, received: Sightings, radio: str) -> None:
        """Store the levels of all transmitters of either radio."""
        levels = Sightings(received.time, received.transmitter, received.rssi)
        finite = take(levels, np.isfinite(levels.time) & np.isfinite(levels.rssi))
        self._received = take(appended(self._received, finite), slice(-MOST_LEVELS, None))

    def due(self, until: float, walked: object) -> Iterator[Fixes]:
        """Yield, once, the fixes of the blocks of scans that are complete until ``until`` [s]."""
        self.forget(max((self._block + 0.5) * SCANS.window, until - LONGEST_SPAN))
        # Its last scan ends half a window after it
        complete = (until - 1.5 * SCANS.window + 1) // SCANS.window
        if complete <= self._block or not len(self._received):
            return
        scans = scans_in([self._received])
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
        self._received = take(self._received, self._received.time >= before)
