"""Helpers to run a trial with a navigator that echoes the last fix."""

import json

import numpy as np
import pytest

from pdr_graph.apps.evaal.client import Api
from pdr_graph.apps.evaal.trial import INTERVAL, RowStream, run_trial
from pdr_graph.frames import Frame, enu
from pdr_graph.io.loading import load
from pdr_graph.online.interface import Pose, Samples, Scan
from pdr_graph.types import LONLAT, Estimate, Fixes, Trajectory


class Echo:
    """A navigator whose pose is the last fix."""

    def __init__(self, *_, **__):
        self.events, self.pose, self.frame, self._poses = [], None, None, []

    def push(self, event):
        self.events.append(event)
        if isinstance(event, Fixes):
            metric = event.epsg is None
            if self.frame is None:
                self.frame = Frame() if metric else enu(*event.position[0, ::-1])
            placed = self.frame.place(event)
            for t, (x, y), floor in zip(placed.time, placed.position, placed.floor, strict=True):
                self.pose = Pose(float(t), float(x), float(y), 0.0, floor, np.eye(3))
                self._poses.append(self.pose)

    def finish(self):
        if not self._poses:
            raise ValueError("no fix came")
        rows = self._poses
        position = np.array([(p.x, p.y) for p in rows])
        floors = tuple(p.floor for p in rows)
        track = Trajectory(np.array([p.time for p in rows]), position, np.zeros(len(rows)), floors)
        track = Trajectory(track.time, position, track.heading, floors, np.tile(np.eye(3), (len(rows), 1, 1)))
        return Estimate(track, track, None, {}, 0, 0.0, True)


def rows_of(text):
    return [row for row in text.splitlines() if row and not row.startswith(("%", "POSI"))]


def no_pauses(pauses=None):
    """A sleep that returns at once and notes its duration."""
    return (lambda seconds: None) if pauses is None else pauses.append


def run(url, out, trial="t", echo=None, lonlat=True, ignored=False, pauses=None):
    echo = Echo() if echo is None else echo
    api = Api(url, trial, no_pauses(pauses))
    return run_trial(api, out, lonlat=lonlat, ignore_initial=ignored, kind=lambda **_: echo), echo


def received(out):
    return (out / "received.txt").read_text(encoding="ascii").splitlines()


def summary(out):
    return json.loads((out / "summary.json").read_text(encoding="utf-8"))


def assert_same_as_loaded(path, within):
    walk, stream, events = load(path), RowStream(), []
    rows = sorted(rows_of(path.read_text(errors="replace")), key=lambda row: float(row.split(";")[1]))
    times = np.array([float(row.split(";")[1]) for row in rows])
    ends = np.searchsorted(times, np.arange(times[0], times[-1] + INTERVAL, INTERVAL) + INTERVAL)
    for begin, end in zip([0, *ends], ends, strict=False):
        events += stream.feed("\n".join(rows[begin:end]))
    worst = 0.0
    for name, signal in walk.signals.items():
        mine = [e for e in events if isinstance(e, Samples) and e.sensor == name]
        assert np.concatenate([e.values for e in mine]) == pytest.approx(signal.values), name
        apart = np.concatenate([e.time for e in mine]) - walk.clock_origin - signal.time
        worst = max(worst, float(np.abs(apart).max()))
    assert worst < within
    fixes = [e for e in events if isinstance(e, Fixes)]
    assert all(f.epsg == LONLAT and f.source == ("GNSS",) * len(f) for f in fixes)
    assert np.concatenate([f.position for f in fixes]) == pytest.approx(walk.fixes.position)
    assert np.concatenate([f.sigma for f in fixes]) == pytest.approx(walk.fixes.sigma)
    for radio in ("bluetooth", "wifi"):
        heard = [e.heard for e in events if isinstance(e, Scan) and e.radio == radio]
        assert sum((h.transmitter for h in heard), ()) == getattr(walk, radio).transmitter
        assert sum((h.minor for h in heard), ()) == getattr(walk, radio).minor
    return worst
