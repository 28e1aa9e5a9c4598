"""A trial of a competition, from its first request to its files: online row by row, offline all at once."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph.errors import InputError, one_line
from pdr_graph.io import writers
from pdr_graph.online import offline
from pdr_graph.online.contract import Placed, Pose, trajectory_of
from pdr_graph.online.evaal import GOOD, OVER, Api, State, UnreachableError
from pdr_graph.online.form import Form
from pdr_graph.online.request_log import OFFLINE, RequestLog
from pdr_graph.online.rows import RowStream

HORIZON = 0.5  # [s] of rows at a time: competitions take positions at 2 Hz


@dataclass(frozen=True)
class Ending:
    """How a trial ended. normal: by the server's word and in time; said: in words; missing: what could not be had."""

    normal: bool
    said: str
    missing: tuple[str, ...] = ()


def take_part(
    api: Api,
    out: Path,
    navigator: Callable[[], Placed],
    smoothed: Callable[[Path, Path | None], tuple[str, ...]],
    form: Callable[[str], Form],
    floors: tuple[str, ...] = (),
    progress: Callable[[str], object] | None = None,
) -> Ending:
    """Take part in a trial, or go on with one that was interrupted, and write its files to ``out``.

    navigator: makes that of an online trial. smoothed: writes the walk of an offline one to ``out``, from its
    recording and a file of fixes, and says what is missing. form: of the positions, by the initial one. floors: the
    plan's labels.

    Raises InputError if there is no such trial, it is over, or ``out`` is of another one.
    """
    with closing(RequestLog(out, api.url, api.trial)) as log:
        state = _begin(api, log) if log.end is None else None
        if (state and state.offline) or log.asked[:1] == [(OFFLINE, "")]:
            said, missing = offline.answer(api, log, out, smoothed, form(log.initial or ""), floors)
            return Ending(not missing, one_line(said), missing)
        walk = _Walk(navigator(), form(log.initial or ""), floors, log)
        if state and state.begun and not log.asked:
            walk.notes.append(f"the trial was under way: its rows before {state.time:.1f} s are lost")
        normal, said = _ask_on(api, log, walk, progress) if log.end is None else _ended(log.end)
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

    def __init__(self, navigator: Placed, form: Form, floors: tuple[str, ...], log: RequestLog):
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
