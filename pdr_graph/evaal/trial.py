"""A trial of a competition, from its first request to its files: online row by row, offline all at once.

Positions are ``lon,lat,floor``, or ``x,y,floor`` in the output frame.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph.errors import InputError, one_line
from pdr_graph.evaal.client import CREATED, GOOD, OFFLINE, OVER, SOME_REJECTED, Api, RequestLog, State, UnreachableError
from pdr_graph.evaal.row_stream import RowStream
from pdr_graph.frames import Frame
from pdr_graph.io import writers
from pdr_graph.io.tables import read_trajectory
from pdr_graph.online.interface import Georeferenced, Pose, trajectory_of
from pdr_graph.types import LONLAT, Array, Fixes

INITIAL_SIGMA = 0.5  # [m] per axis: someone stands on a mark
GROUND = "0"  # the floor that is sent where none is known


class PositionFormat:
    """How one trial's positions are written.

    initial: where the trial begins, longitude and latitude [deg] or x and y [m], None if that is not known (a server
    that does not know says 0,0,0) or to be ignored. default: the floor's label where the estimate has none, that of
    the initial position, else 0.
    """

    def __init__(self, lonlat: bool, initial: str, ignored: bool = False):
        self.lonlat = lonlat
        cells = [] if ignored else [cell.strip() for cell in initial.replace(";", ",").split(",")]
        self.default = cells[2] if len(cells) > 2 and cells[2] else GROUND
        self.initial = _place(cells, lonlat)

    def text(self, position: Array, floor: str, frame: Frame | None) -> str:
        """A position ``(2,)`` [m]; empty while it has no longitude."""
        if not self.lonlat:
            return self.written(position, floor)
        if frame is None or not frame.georeferenced:
            return ""
        return self.written(frame.to_lonlat(position[None])[0], floor)

    def written(self, place: Array, floor: str) -> str:
        """A place ``(2,)`` in [deg] or [m] and its floor, as a server can read them; empty if it is none."""
        if not np.isfinite(place).all():
            return ""
        legible = floor and floor.isascii() and floor.isprintable() and not set(floor) & set(",;")
        digits = 8 if self.lonlat else 3
        return f"{place[0]:.{digits}f},{place[1]:.{digits}f},{floor if legible else self.default}"

    def initial_fix(self, time: float, floors: tuple[str, ...]) -> Fixes:
        """The initial position, none if it is unknown. floors: of the plan, empty without one."""
        if self.initial is None:
            return Fixes.none()
        label = self.default if not floors or self.default in floors else ""
        sigma, epsg = np.array([INITIAL_SIGMA]), LONLAT if self.lonlat else None
        return Fixes(np.array([time]), np.array([self.initial]), sigma, (label,), epsg)


def _place(cells: list[str], lonlat: bool) -> tuple[float, float] | None:
    try:
        x, y = float(cells[0]), float(cells[1])
    except (ValueError, IndexError):
        return None
    known = math.isfinite(x) and math.isfinite(y) and (x, y) != (0.0, 0.0)
    return (x, y) if known and (not lonlat or (abs(x) <= 180 and abs(y) <= 90)) else None


INTERVAL = 0.5  # [s] between the positions that are sent, as competitions score them
HEAD = 100_000  # characters of rows that tell when a trial begins


def answer(
    api: Api,
    log: RequestLog,
    out: Path,
    smoothed: Callable[[Path, Path | None], tuple[str, ...]],
    form: PositionFormat,
    floors: tuple[str, ...],
) -> tuple[str, tuple[str, ...]]:
    """How the trial ended, in words, and what could not be had. Arguments as of `run_trial`.

    Raises InputError if the rows cannot be had or used. Rows that came are kept: the same command goes on from them.
    """
    if log.end is not None:
        raise InputError(log.path, "", f"positions that were sent ({log.end})", "a trial that has not ended")
    _receive(api, log)
    missing = smoothed(log.received, _initial(log, out, form, floors))
    try:
        reply = api.post_estimates(_lines(out, form))
    except UnreachableError as error:
        return f"no answer to the positions ({error}); the same command sends them again", ("positions",)
    said = f"{reply.code} {reply.text[:200].strip()!r}"
    if reply.code in (CREATED, SOME_REJECTED):
        log.note_end(said)
    if reply.code != CREATED:
        missing = (*missing, f"positions: the server took {'some' if reply.code == SOME_REJECTED else 'none'} ({said})")
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    summary |= {"trial": api.trial, "url": api.url, "ended": said, "missing": list(missing)}
    writers.write_summary(out / "summary.json", summary)
    return f"{said} to the positions", missing


def _receive(api: Api, log: RequestLog) -> None:
    """All rows, asked for once and never again."""
    if log.pending:
        found = "rows that were asked for and did not come"
        raise InputError(log.path, "", found, "a trial that is new: a second request would end this one")
    if log.sizes:
        return
    log.ask(OFFLINE, "")
    try:
        reply = api.all_data()
    except UnreachableError as error:
        raise InputError(api.url, api.trial, str(error), "the rows, which can be asked for once") from None
    if reply.code != GOOD:
        raise api.refusal(reply)
    log.got(reply.body)


def _initial(log: RequestLog, out: Path, form: PositionFormat, floors: tuple[str, ...]) -> Path | None:
    """A file of fixes with the initial position, None where that is unknown."""
    with log.received.open(encoding="ascii", errors="replace") as file:
        begin = RowStream()
        begin.feed(file.read(HEAD))
    fix = form.initial_fix(begin.begin, floors) if begin.begin is not None else Fixes.none()
    if not len(fix):
        return None
    x, y = fix.position[0].tolist()
    place = f"{y:.8f},{x:.8f}" if form.lonlat else f"{x:.3f},{y:.3f}"
    columns = "time,lat,lon,sigma,floor" if form.lonlat else "time,x,y,sigma,floor"
    path = out / "initial.csv"
    path.write_text(f"{columns}\n{fix.time[0]:.4f},{place},{fix.sigma[0]},{fix.floor[0]}\n", encoding="utf-8")
    return path


def _lines(out: Path, form: PositionFormat) -> str:
    """The smoothed walk as the server takes it, a position each half second."""
    track = read_trajectory(out / "trajectory.csv")
    place = _lonlat(out) if form.lonlat else track.position
    times = np.arange(track.time[0], track.time[-1], INTERVAL)
    x, y = (np.interp(times, track.time, place[:, axis]) for axis in (0, 1))
    row = np.searchsorted(track.time, times, side="right") - 1
    rows = zip(times, np.column_stack([x, y]), row, strict=True)
    return "".join(f"{t:.3f},{form.written(at, track.floor[n])}\n" for t, at, n in rows)


def _lonlat(out: Path) -> Array:
    path = out / "trajectory.geojson"
    if not path.is_file():
        expected = "a plan, an initial position or GNSS, or --format xy"
        raise InputError(out / "trajectory.csv", "", "positions without a longitude", expected)
    features = json.loads(path.read_text(encoding="utf-8"))["features"]
    return np.array(features[0]["geometry"]["coordinates"])


HORIZON = 0.5  # [s] of rows at a time: competitions take positions at 2 Hz


@dataclass(frozen=True)
class Ending:
    """How a trial ended. normal: by the server's word and in time; said: in words; missing: what could not be had."""

    normal: bool
    said: str
    missing: tuple[str, ...] = ()


@dataclass(frozen=True)
class Entry:
    """What takes part in a trial.

    navigator: makes that of an online trial; smoothed: writes the walk of an offline one from its recording and a file
    of fixes, and returns what is missing; position_format: of the positions, by the initial one; floors: the plan's
    labels; progress: is told how far the trial is.
    """

    navigator: Callable[[], Georeferenced]
    smoothed: Callable[[Path, Path | None], tuple[str, ...]]
    position_format: Callable[[str], PositionFormat]
    floors: tuple[str, ...] = ()
    progress: Callable[[str], object] | None = None


def run_trial(api: Api, out: Path, entry: Entry) -> Ending:
    """Run a trial, or resume one that was interrupted, and write its files to ``out``.

    Raises InputError if there is no such trial, it is over, or ``out`` is of another one.
    """
    with closing(RequestLog(out, api.url, api.trial)) as log:
        state = _begin(api, log) if log.end is None else None
        form = entry.position_format(log.initial or "")
        if (state and state.offline) or log.asked[:1] == [(OFFLINE, "")]:
            said, missing = answer(api, log, out, entry.smoothed, form, entry.floors)
            return Ending(not missing, one_line(said), missing)
        walk = _Walk(entry.navigator(), form, entry.floors, log)
        if state and state.begun and not log.asked:
            walk.notes.append(f"the trial was under way: its rows before {state.time:.1f} s are lost")
        normal, said = _ask_on(api, log, walk, entry.progress) if log.end is None else _ended(log.end)
        said, missing = one_line(said), walk.write(out, api.log())
        about = {"trial": api.trial, "url": api.url, "ended": said, "missing": list(missing)}
        writers.write_summary(out / "summary.json", about | walk.describe(log))
    return Ending(normal and not missing, said, missing)


def _begin(api: Api, log: RequestLog) -> State:
    """How the trial stands, and a note of where it begins, which the server tells before the first request only."""
    state = api.state(tries=1)
    if log.sizes and not state.begun:
        found = f"{len(log.sizes)} requests, though the trial has not begun"
        raise InputError(log.path, "", found, "another --out: it was reloaded")
    if log.initial is None:
        log.note_initial("" if state.begun else state.position)
    return state


def _ask_on(api: Api, log: RequestLog, walk: _Walk, progress: Callable[[str], object] | None) -> tuple[bool, str]:
    """Request after request until the trial is over; whether it ended as it should, and in words."""
    for number in count(len(log.sizes)):
        position = walk.position()
        if log.pending is None:
            log.ask(str(number), position)
        label, position = log.asked[-1]
        try:
            reply = api.next_data(label, position, HORIZON)
        except (UnreachableError, InputError) as error:
            return False, f"{error}; the same command goes on from here"
        if reply.code == OVER and number and State.parse(reply.text):
            log.note_end(reply.text)
            return _ended(reply.text)
        if reply.code != GOOD:
            refusal = api.refusal(reply)
            if not number:
                raise refusal
            return False, str(refusal)
        log.got(reply.body)
        walk.seconds.append(reply.seconds)
        walk.repeated += reply.tries - 1
        walk.take(reply.text)
        if progress:
            progress(f"{walk.stream.rows.total()} rows, {(number + 1) * HORIZON:.0f} s of the trial")
    raise AssertionError("requests end by an answer")


def _ended(text: str) -> tuple[bool, str]:
    state = State.parse(text)
    if state is not None and state.timed_out:
        return False, f"the server's timeout with {state.left:.1f} s left ({state.text})"
    return True, f"the end of the trial ({text.strip()})"


class _Walk:
    """The walk of an online trial as far as it is known, and what was sent of it."""

    def __init__(self, navigator: Georeferenced, form: PositionFormat, floors: tuple[str, ...], log: RequestLog):
        """What an interrupted client had received is taken in again, slot by slot, as it came."""
        self.stream, self.notes = RowStream(), list[str]()
        self.seconds, self.repeated = list[float](), 0
        self._navigator, self._form, self._floors = navigator, form, floors
        self._started = False
        self._sent: list[Pose] = []
        for slot in log.slots():
            self.position()
            self.take(slot)

    def position(self) -> str:
        """That of the newest pose, to be sent; empty while there is none."""
        pose = self._navigator.pose
        if pose is None:
            return ""
        text = self._form.text(np.array([pose.x, pose.y]), pose.floor, self._navigator.frame)
        if text and (not self._sent or pose.time > self._sent[-1].time):
            self._sent.append(pose)
        return text

    def take(self, text: str) -> None:
        """The rows of one slot; with the first comes where the trial begins."""
        events = self.stream.feed(text)
        if not self._started and self.stream.begin is not None:
            self._started = True
            initial = self._form.initial_fix(self.stream.begin, self._floors)
            events = [initial, *events] if len(initial) else events
        for event in events:
            self._navigator.push(event)

    def write(self, out: Path, log: bytes) -> tuple[str, ...]:
        """All files but the summary; what could not be had."""
        missing: list[str] = []
        if log:
            (out / "log.txt").write_bytes(log)
        if self._sent:
            writers.write_trajectory(out / "causal.csv", trajectory_of(self._sent), 0.0)
        else:
            missing.append("causal.csv: no position was known in time")
        try:
            estimate = self._navigator.finish()
            writers.write_trajectory(out / "trajectory.csv", estimate.trajectory, 0.0)
            self.notes += estimate.warnings
        except (ValueError, RuntimeError) as error:  # what was received and sent is safe
            missing.append(f"trajectory.csv: {error}")
        return tuple(missing)

    def describe(self, log: RequestLog) -> dict[str, Any]:
        """What ``summary.json`` says. Seconds are of this run's requests."""
        call = np.array(self.seconds or [0.0])
        frame = self._navigator.frame
        return {
            "initial": log.initial or None,
            "requests": len(log.sizes),
            "repeated": self.repeated,
            "seconds": {"median": float(np.median(call)), "p99": float(np.quantile(call, 0.99)), "max": call.max()},
            "rows": dict(self.stream.rows),
            "unread": dict(self.stream.unread),
            "poses": len(self._sent),
            "frame": None if frame is None else frame.describe(),
            "warnings": [*self.notes, *(f"{said} ({n} times)" for said, n in self.stream.notes.items())],
            "versions": {"pdr_graph": version("pdr_graph")},
        }
