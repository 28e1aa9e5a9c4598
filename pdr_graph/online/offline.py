"""An offline trial of a competition: its rows, which can be had once, the walk they tell, and the positions back."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.io import writers
from pdr_graph.io.tables import read_trajectory
from pdr_graph.online.evaal import CREATED, GOOD, SOME_REJECTED, Api, UnreachableError
from pdr_graph.online.form import Form
from pdr_graph.online.request_log import OFFLINE, RequestLog
from pdr_graph.online.rows import RowStream
from pdr_graph.types import Array, Fixes

INTERVAL = 0.5  # [s] between the positions that are sent, as competitions score them
HEAD = 100_000  # characters of rows that tell when a trial begins


def answer(
    api: Api,
    log: RequestLog,
    out: Path,
    smoothed: Callable[[Path, Path | None], tuple[str, ...]],
    form: Form,
    floors: tuple[str, ...],
) -> tuple[str, tuple[str, ...]]:
    """How the trial ended, in words, and what could not be had. Arguments as of `trial.take_part`.

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


def _initial(log: RequestLog, out: Path, form: Form, floors: tuple[str, ...]) -> Path | None:
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


def _lines(out: Path, form: Form) -> str:
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
        needed = "a plan, an initial position or GNSS, or --format xy"
        raise InputError(out / "trajectory.csv", "", "positions without a longitude", needed)
    features = json.loads(path.read_text(encoding="utf-8"))["features"]
    return np.array(features[0]["geometry"]["coordinates"])
