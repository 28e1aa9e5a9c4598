"""Rows of a person's past: positions, receptions of Wi-Fi, guesses of other programs; what makes a row invalid."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pdr_graph.errors import count
from pdr_graph.io.past_day import CM, E7, MS, NO_ACCURACY, POSITION, SIGHTING, Rows
from pdr_graph.io.validation import float_of, iso_time
from pdr_graph.lifelog.facts import Guess
from pdr_graph.lifelog.observation import LATEST_EPOCH
from pdr_graph.types import Array, Mask, OneLineRepr

PATH_ACCURACY = 113.0  # [m] 68 % radius of a point of Google's processed path, sigma 75 m per axis; chosen by hand


@dataclass(frozen=True)
class Batch(OneLineRepr):
    """Some rows of a file. positions: of POSITION; sightings: of SIGHTING; left_out: number of invalid positions by
    reason; notes: warnings, a line each.
    """

    positions: Rows = field(default_factory=lambda: np.empty(0, POSITION))
    sightings: Rows = field(default_factory=lambda: np.empty(0, SIGHTING))
    guesses: tuple[Guess, ...] = ()
    left_out: Counter[str] = field(default_factory=Counter[str])
    notes: tuple[str, ...] = ()

    def _summary(self) -> list[str]:
        parts = [count(len(self.positions), "position"), count(len(self.sightings), "reception")]
        return [*parts, count(len(self.guesses), "guess"), f"{self.left_out.total()} left out"]


FIRST_TIME = 315_964_800.0  # [s] Unix time of 1980-01-06, the first of GPS
UNITS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))  # a larger Unix time is in ns, µs, ms


def in_seconds(time: Array) -> Array:
    """Unix times ``(n,)`` [s], whatever of s, ms, µs and ns each is in."""
    scale = np.ones(len(time))
    for least, unit in UNITS:
        scale = np.where((np.abs(time) >= least) & (scale == 1), unit, scale)
    return time * scale


def valid_positions(time: Array, lat: Array, lon: Array, accuracy: Array, source: Any) -> Batch:
    """The valid positions, and how many are invalid for which reason.

    time: ``(n,)`` Unix times [s, ms, µs or ns]; lat, lon: [deg]; accuracy: 68 % radius [m], not above 0 or NaN if
    unknown; each NaN where missing. source: number in SOURCES, of all or ``(n,)``.
    """
    time = in_seconds(time)
    with np.errstate(invalid="ignore"):
        tests: dict[str, Mask] = {
            "no time": ~np.isfinite(time),
            "no position": ~(np.isfinite(lat) & np.isfinite(lon)),
            "a time before 1980 or after 2200": ~((time >= FIRST_TIME) & (time < LATEST_EPOCH)),
            "latitude and longitude swapped?": (np.abs(lat) > 90) & (np.abs(lat) <= 180) & (np.abs(lon) <= 90),
            "a latitude beyond 90° or a longitude beyond 180°": ~((np.abs(lat) <= 90) & (np.abs(lon) <= 180)),
            "latitude 0, longitude 0": (lat == 0) & (lon == 0),
            "a negative accuracy": accuracy < 0,
        }
        stated = (accuracy > 0) & np.isfinite(accuracy)
    valid, left_out = np.ones(len(time), bool), Counter[str]()
    for reason, fails in tests.items():
        if (new := int((fails & valid).sum())) > 0:
            left_out[reason] = new
        valid &= ~fails
    rows = np.zeros(int(valid.sum()), POSITION)
    rows["time"], rows["lat"], rows["lon"] = (
        np.rint(values[valid] * unit) for values, unit in ((time, MS), (lat, E7), (lon, E7))
    )
    # largest accuracy [m]: no two points on earth are farther apart than twice this
    radius = np.clip(np.rint(np.where(stated, np.minimum(accuracy, 10_000_000.0), 0)[valid] * CM), 1, None)
    rows["accuracy"] = np.where(stated[valid], radius, NO_ACCURACY)
    rows["source"] = source[valid] if isinstance(source, np.ndarray) else source
    return Batch(rows, left_out=left_out)


def unix_times(texts: Sequence[Any]) -> Array:
    """Unix times ``(n,)`` [s] of ISO 8601 texts (UTC without an offset), or numbers in s, ms, µs or ns; else NaN."""
    try:  # UTC as Google writes it, all at once
        if {text[-1] for text in texts} == {"Z"}:
            return np.array([text[:-1] for text in texts], "datetime64[ms]").astype(float) / MS
    except (ValueError, TypeError, LookupError):
        pass
    return np.array([unix_time(text) for text in texts], float)


def unix_time(value: Any) -> float:
    """Unix time [s] of one ISO 8601 text or number; NaN if it is neither."""
    number = float_of(value)
    if math.isfinite(number):
        return float(in_seconds(np.array([number]))[0])
    return iso_time(value)


def guess(source: str, kind: str, times: tuple[Any, Any], name: Any, place: tuple[float, float], share: Any) -> Guess:
    """A guess from untrusted values; its times are NaN if they are invalid.

    times: start and stop, as of `unix_time`; place: latitude and longitude [deg]; share: probability from 0 to 1.
    """
    start, stop = (unix_time(time) for time in times)
    if not (FIRST_TIME <= start <= stop < LATEST_EPOCH):
        start = stop = math.nan
    lat, lon = place if abs(place[0]) <= 90 and abs(place[1]) <= 180 else (math.nan, math.nan)
    probability = float_of(share)
    probability = probability if 0 <= probability <= 1 else math.nan
    # longest name: characters of a guess's name
    text = "".join(c for c in name if c.isprintable())[:200] if isinstance(name, str) else ""
    return Guess(source, start, stop, kind, text, lat, lon, probability)


def with_guesses(batch: Batch, guesses: Sequence[Guess]) -> Batch:
    """The batch with the guesses whose times are valid; the others are counted."""
    valid = tuple(item for item in guesses if math.isfinite(item.start))
    lost = Counter({"a visit or activity without a valid time": len(guesses) - len(valid)})
    return Batch(batch.positions, batch.sightings, valid, +(batch.left_out + lost))
