"""A trial of a competition, from its first request to its files: online in slots of rows, offline all at once.

Positions are ``lon,lat,floor``, or ``x,y,floor`` in the output frame.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from evaal_client import (
    CREATED,
    GOOD,
    MAXIMUM_DATA,
    OFFLINE,
    OVER,
    SOME_REJECTED,
    Api,
    RequestLog,
    State,
    UnreachableError,
)
from evaal_rows import RowStream

from pdr_graph import LONLAT, Building, Fixes, Frame, InputError, Navigator, Pose, read_trajectory
from pdr_graph.apps.replay import navigator_of
from pdr_graph.apps.report.output_files import smooth_recording
from pdr_graph.errors import one_line
from pdr_graph.io import writers
from pdr_graph.online.interface import trajectory_of
from pdr_graph.plausibility import check_initial
from pdr_graph.types import Array
from pdr_graph.walk import Options
from pdr_graph.whole_files import output_folder, write_file


class PositionFormat:
    """The format of one trial's positions.

    initial: the position where the trial begins, longitude and latitude [deg] or x and y [m]; None if it is unknown
    (then servers send 0,0,0) or ignored. default: the floor label to send if the estimate has none: that of the initial
    position, else 0.
    """

    def __init__(self, lonlat: bool, initial: str, ignored: bool = False):
        """lonlat: True for longitude and latitude; initial: the text of the initial position."""
        self.lonlat = lonlat
        cells = [] if ignored else [cell.strip() for cell in initial.replace(";", ",").split(",")]
        self.default = cells[2] if len(cells) > 2 and cells[2] else "0"
        self.initial = _position(cells, lonlat)

    def text(self, position: Array, floor: str, frame: Frame | None) -> str:
        """The text of a position ``(2,)`` [m]; empty while the frame has no longitude."""
        if not self.lonlat:
            return self.written(position, floor)
        if frame is None or not frame.georeferenced:
            return ""
        return self.written(frame.to_lonlat(position[None])[0], floor)

    def written(self, place: Array, floor: str) -> str:
        """The text of a position ``(2,)`` in the units of the format [deg] or [m]; empty if it is not finite."""
        if not np.isfinite(place).all():
            return ""
        valid = floor and floor.isascii() and floor.isprintable() and not set(floor) & set(",;")
        digits = 8 if self.lonlat else 3
        return f"{place[0]:.{digits}f},{place[1]:.{digits}f},{floor if valid else self.default}"

    def initial_fix(self, time: float, floors: tuple[str, ...]) -> Fixes:
        """The initial position as a fix at `time` [s]; no fix if it is unknown. floors: labels of the plan."""
        if self.initial is None:
            return Fixes.none()
        label = self.default if not floors or self.default in floors else ""
        # [m] per axis: the initial position is a mark on the floor; chosen by hand
        sigma, epsg = np.array([0.5]), LONLAT if self.lonlat else None
        return Fixes(np.array([time]), np.array([self.initial]), sigma, (label,), epsg, ("",))

    def check_begins_near(self, plan: Path | None, building: Building | None) -> None:
        """Raise InputError if the initial position is far from a plan, or in another frame. building: on the plan."""
        if plan is not None and building is not None:
            check_initial(plan, building, self.initial_fix(0.0, ()))


def _position(cells: list[str], lonlat: bool) -> tuple[float, float] | None:
    """The first two cells as a position; None if they are not valid, or 0,0."""
    try:
        x, y = float(cells[0]), float(cells[1])
    except (ValueError, IndexError):
        return None
    known = math.isfinite(x) and math.isfinite(y) and (x, y) != (0.0, 0.0)
    return (x, y) if known and (not lonlat or (abs(x) <= 180 and abs(y) <= 90)) else None


INTERVAL = 0.5  # [s] between positions, of which the server scores each; also of the rows of an online request
MAXIMUM_REQUESTS = 200_000  # of an online trial: more than a day


def _run_offline(
    api: Api, log: RequestLog, out: Path, options: Options, form: PositionFormat, floors: tuple[str, ...]
) -> tuple[str, tuple[str, ...]]:
    """Run an offline trial; return how it ended and what is missing, as texts. floors: labels of the plan.

    The rows are requested only once. Raises InputError if they cannot be received or used. Received rows stay in the
    log: the same command resumes.
    """
    if log.end is not None:
        raise InputError(log.path, "", f"positions that were sent ({log.end})", "a trial that has not ended")
    if log.pending:
        found = "rows that were requested and not received"
        raise InputError(log.path, "", found, "a new trial: a second request would end this one")
    if not log.sizes:
        log.ask(OFFLINE, "")
        try:
            reply = api.all_data()
        except UnreachableError as error:
            raise InputError(api.url, api.trial, str(error), "the rows, which can be requested once") from None
        if reply.code != GOOD:
            raise api.unexpected(reply)
        log.got(reply.body)
    missing = smooth_recording(log.received, out, replace(options, fixes=_write_initial(log, out, form, floors)))
    try:
        reply = api.post_estimates(_position_lines(out, form))
    except UnreachableError as error:
        return f"no answer to the positions ({error}); the same command sends them again", ("positions",)
    answer = f"{reply.code} {reply.text[:200].strip()!r}"
    if reply.code in (CREATED, SOME_REJECTED):
        log.note_end(answer)
    if reply.code != CREATED:
        accepted = "some" if reply.code == SOME_REJECTED else "none"
        missing = (*missing, f"positions: the server accepted {accepted} ({answer})")
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    summary |= {"trial": api.trial, "url": api.url, "ended": answer, "missing": list(missing)}
    writers.write_summary(out / "summary.json", summary)
    return f"{answer} to the positions", missing


def _write_initial(log: RequestLog, out: Path, form: PositionFormat, floors: tuple[str, ...]) -> Path | None:
    """Write a file of fixes with the initial position; None if it is unknown."""
    with log.received.open(encoding="ascii", errors="replace") as file:
        head = RowStream()
        head.feed(file.read(100_000))  # enough rows to find the time at which the trial begins
    fix = form.initial_fix(head.begin, floors) if head.begin is not None else Fixes.none()
    if not len(fix):
        return None
    x, y = fix.position[0].tolist()
    columns, position = ("lat,lon", f"{y:.8f},{x:.8f}") if form.lonlat else ("x,y", f"{x:.3f},{y:.3f}")
    path = out / "initial.csv"
    row = f"{fix.time[0]:.4f},{position},{fix.sigma[0]},{fix.floor[0]}"
    write_file(path, f"time,{columns},sigma,floor\n{row}\n")
    return path


def _position_lines(out: Path, form: PositionFormat) -> str:
    """The smoothed walk as ``time,position`` lines, one per INTERVAL."""
    track, path = read_trajectory(out / "trajectory.csv"), out / "trajectory.geojson"
    position = track.position
    if form.lonlat:
        if not path.is_file():
            expected = "a plan, an initial position or GNSS, or --format xy"
            raise InputError(out / "trajectory.csv", "", "positions without a longitude", expected)
        features = json.loads(path.read_text(encoding="utf-8"))["features"]
        position = np.array(features[0]["geometry"]["coordinates"])
    times = np.arange(track.time[0], track.time[-1], INTERVAL)
    x, y = (np.interp(times, track.time, position[:, axis]) for axis in (0, 1))
    row = np.searchsorted(track.time, times, side="right") - 1
    rows = zip(times, np.column_stack([x, y]), row, strict=True)
    return "".join(f"{t:.3f},{form.written(at, track.floor[n])}\n" for t, at, n in rows)


@dataclass(frozen=True)
class Ending:
    """How a trial ended. normal: True at the regular end, in time; text: for the user; missing: what is missing."""

    normal: bool
    text: str
    missing: tuple[str, ...] = ()


def run_trial(
    api: Api,
    out: Path,
    options: Options | None = None,
    lonlat: bool = True,
    ignore_initial: bool = False,
    progress: Callable[[str], object] | None = None,
    kind: Any = None,
) -> Ending:
    """Run a trial, or resume one that was interrupted, and write its files to ``out``.

    options: plan, beacons and walker; lonlat, ignore_initial: as of `PositionFormat`; progress: is called with a text
    after each request; kind: class of the navigator, by default ``Navigator``.
    Raises InputError if an input cannot be used, if there is no such trial, if it is over, if it begins far from the
    plan, or if ``out`` has the files of another one.
    """
    options = options or Options()
    create = navigator_of(options, kind=kind)
    building: Building | None = create.keywords["floor"]
    floors = building.labels if building else ()
    with closing(RequestLog(out, api.url, api.trial)) as log:
        state = _begin(api, log) if log.end is None else None
        form = PositionFormat(lonlat, log.initial or "", ignore_initial)
        form.check_begins_near(options.plan, building)
        if (state and state.offline) or log.asked[:1] == [(OFFLINE, "")]:
            text, missing = _run_offline(api, log, out, options, form, floors)
            return Ending(not missing, one_line(text), missing)
        walk = _OnlineWalk(create(), form, floors, log)
        if state and state.begun and not log.asked:
            walk.notes.append(f"the trial had begun already: its rows before {state.time:.1f} s are lost")
        normal, text = _run_online(api, log, walk, progress) if log.end is None else _online_end(log.end)
        text = one_line(text)
        with output_folder(out) as staged:
            missing = walk.write(staged, api.log())
            summary = {"trial": api.trial, "url": api.url, "ended": text, "missing": list(missing)}
            writers.write_summary(staged / "summary.json", summary | walk.describe(log))
    return Ending(normal and not missing, text, missing)


def _begin(api: Api, log: RequestLog) -> State:
    """Return the state of the trial and log its initial position, which is stated before the first request only."""
    state = api.state(tries=1)
    if log.sizes and not state.begun:
        found = f"{len(log.sizes)} requests of a trial that has not begun (reloaded on the server?)"
        raise InputError(log.path, "", found, "a new folder: another --out")
    if log.initial is None:
        log.note_initial("" if state.begun else state.position)
    return state


def _run_online(
    api: Api, log: RequestLog, walk: _OnlineWalk, progress: Callable[[str], object] | None
) -> tuple[bool, str]:
    """Send requests until the trial is over; return True for the regular end, and a text."""
    for number in count(len(log.sizes)):
        position = walk.position()
        if log.pending is None:
            log.ask(str(number), position)
        label, position = log.asked[-1]
        try:
            reply = api.next_data(label, position, INTERVAL)
        except (UnreachableError, InputError) as error:
            return False, f"{error}; the same command resumes the trial"
        if reply.code == OVER and number and State.parse(reply.text):
            log.note_end(reply.text)
            return _online_end(reply.text)
        if reply.code != GOOD:
            error = api.unexpected(reply)
            if not number:
                raise error
            return False, str(error)
        if sum(log.sizes[-1:]) + len(reply.body) > MAXIMUM_DATA or number >= MAXIMUM_REQUESTS:
            return False, f"more than {MAXIMUM_DATA} bytes or {MAXIMUM_REQUESTS} requests: a trial without an end"
        log.got(reply.body)
        walk.seconds.append(reply.seconds)
        walk.repeated += reply.tries - 1
        walk.feed(reply.text)
        if walk.empty >= 1200:  # ten minutes of a trial
            return False, f"no readable row in {walk.empty} answers, found {reply.text[:100]!r}, expected sensor rows"
        if progress:
            progress(f"{walk.stream.rows.total()} rows, {(number + 1) * INTERVAL:.0f} s of the trial")
    raise AssertionError("the loop ends by return")


def _online_end(text: str) -> tuple[bool, str]:
    """True for the regular end of an online trial, by its last state; and a text."""
    state = State.parse(text)
    if state is not None and state.timed_out:
        return False, f"the server's timeout with {state.left:.1f} s left ({state.text})"
    return True, f"the end of the trial ({text.strip()})"


class _OnlineWalk:
    """The walk of an online trial so far, and the poses that were sent.

    seconds: duration of each request of this run [s]; repeated: number of repeated requests; empty: of answers without
    a readable row since the last one with some.
    """

    def __init__(self, navigator: Navigator, form: PositionFormat, floors: tuple[str, ...], log: RequestLog):
        """Replays the slots that an interrupted client had received."""
        self.stream, self.notes = RowStream(), list[str]()
        self.seconds, self.repeated, self.empty = list[float](), 0, 0
        self._navigator, self._form, self._floors = navigator, form, floors
        self._started = False
        self._sent: list[Pose] = []
        for slot in log.slots():
            self.position()
            self.feed(slot)

    def position(self) -> str:
        """The text of the current position, to be sent; empty if there is none."""
        pose = self._navigator.pose
        if pose is None:
            return ""
        text = self._form.text(np.array([pose.x, pose.y]), pose.floor, self._navigator.frame)
        if text and (not self._sent or pose.time > self._sent[-1].time):
            self._sent.append(pose)
        return text

    def feed(self, text: str) -> None:
        """Push the events of one slot of rows into the navigator; the initial position before the first."""
        events = self.stream.feed(text)
        self.empty = 0 if events else self.empty + 1
        if not self._started and self.stream.begin is not None:
            self._started = True
            initial = self._form.initial_fix(self.stream.begin, self._floors)
            events = [initial, *events] if len(initial) else events
        for event in events:
            self._navigator.push(event)

    def write(self, out: Path, log: bytes) -> tuple[str, ...]:
        """Write all files except the summary; return what is missing. log: of the server."""
        missing: list[str] = []
        if log:
            (out / "log.txt").write_bytes(log)
        if self._sent:
            writers.write_trajectory(out / "causal.csv", trajectory_of(self._sent), 0.0)
        else:
            missing.append("causal.csv: no position was available during the trial")
        try:
            estimate = self._navigator.finish()
            writers.write_trajectory(out / "trajectory.csv", estimate.trajectory, 0.0)
            self.notes += estimate.warnings
        except (ValueError, RuntimeError) as error:  # received rows and sent positions are saved already
            missing.append(f"trajectory.csv: {error}")
        return tuple(missing)

    def describe(self, log: RequestLog) -> dict[str, Any]:
        """The entries of ``summary.json``; seconds: of the requests of this run."""
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
            "warnings": [*self.notes, *(f"{note} ({n} times)" for note, n in self.stream.notes.items())],
            "versions": {"pdr_graph": version("pdr_graph")},
        }
