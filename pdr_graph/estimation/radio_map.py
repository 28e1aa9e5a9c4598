"""Radio maps: what walks that are already smoothed heard where, and the fixes that this gives to later ones."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

from pdr_graph.errors import InputError
from pdr_graph.estimation.fingerprints import WINDOW, Scans, matched, scans_of, unlikeness
from pdr_graph.frames import Frame
from pdr_graph.geometry import interpolate, nearest
from pdr_graph.types import Array, Fixes, Index, Mask, Recording, Trajectory

LEAST_SURE = 3.0  # [m] per axis: where a walk is less certain than that, it teaches nothing
NEAR = 5.0  # [m] from a fingerprint a place is one that the map knows
ACCEPTED = (0.05, 0.95)  # of the scans at places that the map knows: less alike gives no fix, more is no surer
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
            raise ValueError(f"found {len(level)} scans along the walks, needed at least {ENOUGH}")
        limits, variance = _calibrated(level, position, floor, walk, time)
        described = Frame().describe() if frame is None else frame
        return cls(tuple(transmitters), level, position, floor, described, limits, variance)

    def fixes(self, recording: Recording) -> Fixes:
        """Where a later walk was, every `WINDOW` seconds at most: of scans that overlap, the one most like a
        fingerprint. Scans that are like none give no fix. Sigmas are `SHARED` times those of a single fix, so that
        all together say no more than they know.
        """
        scans = scans_of(recording)
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
        floor, source = tuple(found.floor[n] for n in best), ("radio map",) * len(best)
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
    limits = np.quantile(found.distance[known], ACCEPTED) if known.any() else np.zeros(2)
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
