"""A navigator for tests of the journal: its state shows lost, repeated or reordered events."""

from dataclasses import dataclass

import numpy as np

from pdr_graph.online.interface import Pose, Samples, Scan
from pdr_graph.types import Estimate, Fixes, FixReport, Steps, Trajectory

WINDOW = 30  # rows that may still change


@dataclass(frozen=True)
class Status:
    issues: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()


class Rows:
    """What both navigators have. rows: (time, x, y) of the poses that are not finalised."""

    rows: list

    def review(self):
        """Nothing to do."""

    @property
    def pose(self):
        return Pose(*self.rows[-1], 0.0, "", np.eye(3)) if self.rows else None

    @property
    def trajectory(self):
        return track(self.rows)

    def finalized(self):
        older, self.rows = self.rows[:-WINDOW], self.rows[-WINDOW:]
        return track(older)


class StandIn(Rows):
    """Turns a point by what an event says and shifts it, so that nothing is forgotten and the order tells."""

    status = Status()

    def __init__(self):
        self.place, self.count = 0j, 0
        self.rows = []  # time, x, y

    def push(self, event):
        if isinstance(event, Fixes) and len(event) == 0:
            self.place = np.nan  # half taken in
            raise ValueError("no fix at all")
        values = np.sin(np.concatenate([np.ravel(part) for part in numbers(event)]))
        self.place = self.place * np.exp(1j * values.mean()) + values[-1]
        self.count += 1
        self.rows.append((0.5 * self.count, self.place.real, self.place.imag))

    @property
    def steps(self):
        return self.count

    def finish(self):
        return Estimate(self.trajectory, self.trajectory, None, {}, 0, 0.0, True)


class Metronome(Rows):
    """A step of 0.7 m to the east each half a second of the accelerometer's samples; a fix tells where that was."""

    status = Status(("the compass is broken",))

    def __init__(self, floor=None, *, lag=60.0, **options):
        self.steps, self.lag, self.rows, self.fixes = 0, lag, [], []

    def push(self, event):
        if isinstance(event, Samples) and event.sensor == "accelerometer":
            for time in event.time.tolist():
                if not self.rows:
                    self.rows.append((time, 0.0, 0.0))
                elif time >= self.rows[-1][0] + 0.5:
                    self.rows.append((time, self.rows[-1][1] + 0.7, self.rows[-1][2]))
                    self.steps += 1
        elif isinstance(event, Fixes) and self.rows:
            x, y = event.position[-1].tolist()
            self.rows[-1] = (self.rows[-1][0], x, y)
            self.fixes.append(FixReport(float(event.time[-1]), x, y, 3.0, 0.0, 1.0, "it is so"))

    def finish(self):
        return Estimate(self.trajectory, self.trajectory, None, {"fixes": tuple(self.fixes)}, 0, 0.0, True)


def numbers(event):
    match event:
        case Samples():
            return event.time, event.values
        case Fixes():
            return event.time, event.position, event.sigma
        case Scan():
            return event.heard.time, event.heard.rssi
        case Steps():
            return event.time, event.length, event.turn


def table(rows):
    return np.array(rows).reshape(-1, 3)


def track(rows):
    rows, n = table(rows), len(rows)
    return Trajectory(rows[:, 0], rows[:, 1:], np.full(n, np.nan), ("1",) * n, np.tile(np.eye(3), (n, 1, 1)))


def event(number):
    """The event of a number, the same every time: samples, and now and then a fix."""
    noise = np.random.default_rng(number)
    time = number / 40 + np.sort(noise.uniform(0, 0.1, 10))
    if number % 20 == 7:
        return Fixes(time[:1], noise.normal(size=(1, 2)), np.array([3.0]), ("1",), source=("gnss",))
    return Samples("accelerometer", time, noise.normal(size=(10, 3)))
