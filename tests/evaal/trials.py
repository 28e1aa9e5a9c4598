"""Helpers to run a trial with a navigator that echoes the last fix."""

import json

import numpy as np
import pytest
from evaal_client import Api
from evaal_rows import RowStream
from evaal_trial import INTERVAL, run_trial

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
        time, x, y = np.array([(pose.time, pose.x, pose.y) for pose in self._poses]).T
        floors, covariance = tuple(pose.floor for pose in self._poses), np.tile(np.eye(3), (len(time), 1, 1))
        track = Trajectory(time, np.column_stack([x, y]), 0 * time, floors, covariance)
        return Estimate(track, track, None, {}, 0, 0.0, True)


def rows_of(text):
    return [row for row in text.splitlines() if row and not row.startswith(("%", "POSI"))]


def run(url, out, trial="t", lonlat=True, ignored=False, pauses=None):
    """How a trial ends, and its navigator. pauses: a list, to which each pause [s] is added instead of made."""
    echo, api = Echo(), Api(url, trial, [].append if pauses is None else pauses.append)
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
