"""Our own step detector: from an accelerometer alone, in hand, pocket, bag or on a swinging arm, live or afterwards.

Whatever does not repeat itself as gait does (`rhythm`), tilts the phone to and fro, or lifts it higher than a body
bobs, is no step: shaking, gestures, vehicles, standing about.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from pdr_graph.gait.landings import LONGEST_STEP, Landings
from pdr_graph.gait.rhythm import LOOK_AHEAD, REACH, Candidates, candidates, candidates_of, every, felt
from pdr_graph.types import Array

CLOSEST_SHARE = 0.55  # of a step's duration, between two
REGULAR, STILL_REGULAR = 0.7, 0.1  # correlation with the step or stride before: to set out, and to go on
VIGOROUS, VIGOROUS_REGULAR = 1.5, 0.5  # [m/s²] from which on less is enough to set out: who browses is irregular
PUSH_OFF = 0.6  # of the steps that follow: a weaker first one is no landing yet
FEWEST = 4  # steps; less is a gesture
LATE = 6.0  # [s] after which it is too late to say that somebody walked
PAST, FUTURE = 8.0, 3.0  # [s] of samples before a landing that it may depend on; and after it, beyond the look-ahead


def walking_steps(time: Array, acceleration: Array, look_ahead: float = LOOK_AHEAD) -> Landings:
    """The landings of a whole recording.

    time ``(n,)`` [s] uniform; acceleration ``(n, 3)`` with gravity [m/s²]; look_ahead: see `StepDetector`.
    """
    start, period = float(time[0]), float(time[-1] - time[0]) / (len(time) - 1)
    landed, amplitude = Bout().steps(candidates(acceleration, period, look_ahead))
    return Landings.at(start + landed, amplitude, start)


class StepDetector:
    """Steps as the samples come in, the same as of the whole recording.

    period: between samples [s]; start: time of the first [s]; look_ahead: [s] after a landing whose rhythm and vigour
    count too; a step is certain FUTURE later than that. Less than the default costs a step here and there.
    """

    kept = ("decided", "bout", "samples", "first", "taken", "felt", "felt_first", "settled", "open")

    def __init__(self, period: float, start: float = 0.0, look_ahead: float = LOOK_AHEAD):
        self.period, self.start, self.look_ahead = period, start, look_ahead
        self.decided = -np.inf  # [s] after the start, up to which steps are certain
        self.bout = Bout()
        self.samples, self.first, self.taken = np.empty((0, 3)), 0, 0  # the last of them, and which they are
        self.felt, self.felt_first, self.settled = np.empty((0, 2)), 0, 0  # what was felt, up to where for good
        self.open = np.empty((0, 5))  # candidates after what is decided

    def update(self, acceleration: Array) -> tuple[Array, Array]:
        """Take in samples ``(n, 3)``; times ``(m,)`` [s] and amplitudes ``(m,)`` of the steps that are certain now."""
        self.samples = np.concatenate([self.samples, acceleration])
        self.taken += len(acceleration)
        self._feel()
        return self._decide(self.taken * self.period - FUTURE - self.look_ahead)

    def finish(self) -> tuple[Array, Array]:
        """The last steps, when no more samples come."""
        return self._decide(np.inf)

    def provisional(self) -> tuple[Array, Array]:
        """Times and amplitudes of the steps after those that are certain, as far as can be said by now."""
        *columns, bodily = self.open.T
        landed, amplitude = replace(self.bout).steps(Candidates(*columns, bodily=bodily > 0))
        return self.start + landed, amplitude

    @property
    def earliest(self) -> float:
        """Before this no landing can be found any more. [s]"""
        late = [time for time, _ in self.bout.waiting if time > self.decided - LATE]
        return self.start + min([self.decided, *late])

    def _feel(self) -> None:
        """What is felt of the new samples, and of the last ones anew: it changes with those that follow them."""
        if not len(self.samples):
            return
        stride = every(self.period)
        reach = int(REACH / self.period / stride) + 1
        fresh = np.stack(felt(self.samples, self.period), axis=1)
        first = self.first // stride
        self.felt = np.concatenate([self.felt[: self.settled - self.felt_first], fresh[self.settled - first :]])
        self.settled = max(self.settled, first + len(fresh) - reach)
        drop = max(0, self.settled - reach - first)
        self.samples, self.first = self.samples[drop * stride :], self.first + drop * stride

    def _decide(self, until: float) -> tuple[Array, Array]:
        """What lies before ``until`` [s] after the start, and was not decided before."""
        sampling = self.period * every(self.period)
        found = candidates_of(self.felt[:, 0], self.felt[:, 1], sampling, self.look_ahead)
        found = replace(found, time=found.time + self.felt_first * sampling)
        landed, amplitude = self.bout.steps(found[(found.time > self.decided) & (found.time <= until)])
        self.decided = max(self.decided, until)
        self.open = np.stack([values[found.time > self.decided] for values in vars(found).values()], axis=1)
        if np.isfinite(until):  # no later step depends on more than PAST
            drop = max(0, int((until - PAST) / sampling) - self.felt_first)
            self.felt, self.felt_first = self.felt[drop:], self.felt_first + drop
        return self.start + landed, amplitude


_Steps = list[tuple[float, float]]  # times and amplitudes


@dataclass
class Bout:
    """Who sets out is believed once their steps are regular; then every step counts until they stop."""

    walking: bool = False
    last: float = -np.inf
    waiting: _Steps = field(default_factory=list)

    kept: ClassVar = ("walking", "last", "waiting")

    def steps(self, found: Candidates) -> tuple[Array, Array]:
        """Times ``(m,)`` and amplitudes ``(m,)`` of the steps among the next candidates."""
        columns = (values.tolist() for values in vars(found).values())
        certain = [one for candidate in zip(*columns, strict=True) for one in self._take(*candidate)]
        time, amplitude = np.array(certain).reshape(-1, 2).T
        return time, amplitude

    def _take(self, time: float, step: float, amplitude: float, regular: float, bodily: bool) -> _Steps:
        """The next candidate; the steps that are certain with it."""
        if not bodily:
            self.walking, self.waiting, self.last = False, [], -np.inf
            return []
        if regular < STILL_REGULAR or time - self.last < CLOSEST_SHARE * step:
            return []
        if time - self.last > LONGEST_STEP:
            self.walking, self.waiting = False, []
        self.last = time
        self.waiting = [one for one in self.waiting if one[0] > time - LATE] + [(time, amplitude)]
        if not self.walking and regular > (VIGOROUS_REGULAR if amplitude > VIGOROUS else REGULAR):
            self._set_out()
        if not self.walking:
            return []
        certain, self.waiting = self.waiting, []
        return certain

    def _set_out(self) -> None:
        if len(self.waiting) >= FEWEST:
            usual = float(np.median([amplitude for _, amplitude in self.waiting]))
            self.waiting = self.waiting[int(self.waiting[0][1] < PUSH_OFF * usual) :]
            self.walking = True
