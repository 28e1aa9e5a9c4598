"""Facts beside the estimate: what a person states about times and places, and what other programs guessed.

A correction holds for a time, not for a row of a day, so it survives every rebuild.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from pdr_graph.apps.lifelog.day import STANDING, VEHICLE, WALKING
from pdr_graph.types import OneLineRepr

AT, MERGE, SPLIT, MODE, NOT_ME, PLACE_NAME, FORGOTTEN = "at", "merge", "split", "mode", "not me", "name", "forgotten"
VISITED = "visited"  # by a receipt or a photo, which may be wrong
CORRECTION_KINDS = (AT, MERGE, SPLIT, MODE, NOT_ME, PLACE_NAME, FORGOTTEN, VISITED)
# Kinds that change the estimate of a walk with steps; the others change only its timeline
ESTIMATE_KINDS = (AT, MODE, NOT_ME, FORGOTTEN, VISITED)
# [m/s] mean speed between two positions from which it was a flight, and [m] its shortest: a flight of an hour without
# data has 80 m/s from gate to gate, a train without a stop 70 m/s
SLOWEST_FLIGHT, SHORTEST_FLIGHT, AEROPLANE = 75.0, 100_000.0, "plane"
# What a person calls a time -> the activity that the estimate assumes then
MODE_ACTIVITIES = {
    **dict.fromkeys(("bus", "car", "train", "tram", "ferry", "bicycle", AEROPLANE, "ride"), VEHICLE),
    "walk": WALKING,
    "stop": STANDING,
}
VISIT, ACTIVITY, END = "visit", "activity", "end"  # kinds of guesses
LEAST_RIDE_SPEED = 2.5  # [m/s] of a way whose kind is unknown; chosen by hand
ALWAYS = float("-inf"), float("inf")  # start and end of a correction that holds for a place, at all times


@dataclass(frozen=True)
class Correction(OneLineRepr):
    """A statement of a person.

    number: in the store, 0 before it is there; made: Unix time of the statement [s]; kind: one of CORRECTION_KINDS.
    start, end: the time for which it holds (Unix times [s]), equal for a split, ALWAYS for a named place.
    value: ``latitude``, ``longitude`` [deg], ``radius`` [m] (the standard deviation per axis) and ``name`` of a place,
    of one by another source also this ``source``; or the ``mode``; empty for kinds that need none.
    """

    number: int
    person: str
    made: float
    kind: str
    start: float
    end: float
    value: Mapping[str, float | str] = field(default_factory=dict, hash=False)

    @property
    def row(self) -> tuple[Any, ...]:
        """The correction by columns of its table; number: NULL before it is stored."""
        return (self.number or None, self.person, self.made, self.kind, self.start, self.end, self.content)

    @property
    def content(self) -> str:
        """Its value as JSON, with the keys in order."""
        return json.dumps(dict(self.value), sort_keys=True, ensure_ascii=False)

    @classmethod
    def of_row(cls, row: Sequence[Any]) -> Correction:
        """The correction from a row of its table. Raises ValueError if the row is invalid."""
        number, person, made, kind, start, end, content = row
        value = json.loads(content)
        if kind not in CORRECTION_KINDS or not isinstance(value, dict) or not start <= end:
            raise ValueError(f"correction {number}: found kind {kind!r}, from {start} to {end}, {content!r}")
        return cls(number, person, made, kind, start, end, value)

    @property
    def inputs(self) -> list[Any]:
        """What an estimate depends on, without the number and the time of the statement."""
        return [self.kind, self.start, self.end, self.content]

    @property
    def span(self) -> tuple[float, float]:
        """Start and end of the time for which it holds (Unix times [s])."""
        return self.start, self.end

    def touches(self, start: float, end: float) -> bool:
        """True if it holds at some time from `start` to `end` (Unix times [s])."""
        return self.start <= end and self.end >= start

    @property
    def place(self) -> tuple[float, float]:
        """Latitude and longitude [deg]."""
        return float(self.value["latitude"]), float(self.value["longitude"])

    @property
    def radius(self) -> float:
        """Standard deviation per axis of the place, or the radius of a named place [m]."""
        return float(self.value["radius"])

    def text(self, key: str) -> str:
        """A text of its value, "" if it has none."""
        return str(self.value.get(key, ""))

    def _summary(self) -> list[str]:
        return [f"{self.number}", repr(self.person), self.kind, f"{self.start:.0f} to {self.end:.0f} s", self.content]


def forgotten_times(corrections: Iterable[Correction]) -> tuple[tuple[float, float], ...]:
    """Start and end of each time that a person has deleted (Unix times [s])."""
    return tuple(c.span for c in corrections if c.kind == FORGOTTEN)


@dataclass(frozen=True)
class Guess(OneLineRepr):
    """What another program guessed about a time; no estimate reads it, the diary shows it where nothing was recorded.

    source: the program; start, stop: Unix times [s]; kind: VISIT, ACTIVITY, or END of an activity, a moment.
    name: of the place or activity, "" if unknown; latitude, longitude: of the place, or of the start of an activity
    [deg], NaN if unknown; probability: as the program states it, NaN if it does not.
    """

    source: str
    start: float
    stop: float
    kind: str
    name: str = ""
    latitude: float = math.nan
    longitude: float = math.nan
    probability: float = math.nan

    @classmethod
    def of_row(cls, row: Sequence[Any]) -> Guess:
        """The guess of a row of its table, where NaN is NULL."""
        values: list[Any] = [math.nan if value is None else value for value in row]
        return cls(*values)

    @property
    def text(self) -> str:
        """The program, the name and the probability, as "Google Timeline: HOME, 78 %"."""
        share = "" if math.isnan(self.probability) else f"{self.probability:.0%}"
        return f"{self.source}: {', '.join(filter(None, [self.name, share])) or self.kind}"

    def activity(self, speed: float) -> str:
        """The activity that it means, by its name, else by a speed [m/s]."""
        name = self.name.upper().replace(" ", "_")
        if name in ("STILL", "WALKING", "WALK", "ON_FOOT", "RUNNING"):
            return STANDING if name == "STILL" else WALKING
        unknown = name.startswith("UNKNOWN") or not name
        return VEHICLE if not unknown or speed > LEAST_RIDE_SPEED else WALKING

    def _summary(self) -> list[str]:
        when = datetime.fromtimestamp(self.start, UTC).isoformat(timespec="seconds")
        return [self.kind, repr(self.name), when, f"{self.stop - self.start:.0f} s", f"{self.probability:.2f}"]
