"""Live step detector: the landings of `walking_steps` as samples arrive."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import correlate1d

from pdr_graph import storage
from pdr_graph.gait.candidate_stream import CandidateStream
from pdr_graph.gait.step_detection import Bout, Candidates, decimation, steadiness
from pdr_graph.geometry import gaussian_weights
from pdr_graph.priors import BOUT, CANDIDATE
from pdr_graph.types import Array


@dataclass(frozen=True)
class DetectorCheckpoint:
    """The state of a `StepDetector`."""

    period: float
    start: float
    look_ahead: float
    decided: float
    bout: Bout
    samples: Array
    first: int
    count: int
    smoothed: Array
    smoothed_first: int
    smoothed_final: int
    pending: Array


class StepDetector:
    """Detects steps as samples arrive; the result equals that of `walking_steps` on the whole recording.

    period: between samples [s]; start: time of the first sample [s]; look_ahead: duration of the samples after a
    landing that are used for its rhythm and amplitude [s]. A step is certain 3 s after that. A shorter look-ahead than
    the default misses or adds a step now and then.

    Candidates are evaluated only when one of them may have become certain, and for `provisional`.
    """

    def __init__(self, period: float, start: float = 0.0, look_ahead: float | None = None):
        self.period, self.start = period, start
        self.look_ahead = CANDIDATE.look_ahead if look_ahead is None else look_ahead
        self.decided = -np.inf  # time since the start up to which steps are certain [s]
        self.bout = Bout()
        self.samples, self.first, self.count = np.empty((0, 3)), 0, 0  # the last ones, number of the first, and of all
        self.smoothed = np.empty((0, 2))  # as `smoothed_magnitude`, from number `smoothed_first` on
        self.smoothed_first, self.smoothed_final = 0, 0  # samples before the latter are final
        self.pending = np.empty((0, 5))  # candidates after `decided`
        self._origin = 0  # number of the smoothed sample from which the times of candidates are counted
        self._evaluated = 0  # number of samples at the last evaluation
        self._stream: CandidateStream | None = None
        self._gravity, self._gravity_first = np.empty((3, 0)), 0  # smoothed and final, and number of the first sample

    def update(self, acceleration: Array) -> tuple[Array, Array]:
        """Add samples ``(n, 3)``; returns times ``(m,)`` [s] and amplitudes of newly certain steps."""
        self.samples = np.concatenate([self.samples, acceleration])
        self.count += len(acceleration)
        until = self.count * self.period - BOUT.future - self.look_ahead
        self._origin = max(0, int((self.decided - BOUT.past) / self._sampling)) if self.decided > 0 else 0
        if until > 0 and (self._stream is None or self._stream.is_due(self.decided, until)):
            self._evaluate()
        return self._decide(until)

    def finish(self) -> tuple[Array, Array]:
        """Times [s] and amplitudes of the last steps: no more samples follow."""
        self._evaluate()
        return self._decide(np.inf)

    def provisional(self) -> tuple[Array, Array]:
        """Times [s] and amplitudes of the steps after the certain ones, which later samples may still change."""
        self._evaluate()
        landed, amplitude = replace(self.bout).steps(_candidates(self.pending))
        return self.start + landed, amplitude

    @property
    def earliest(self) -> float:
        """Earliest time at which a new landing can still be found. [s]"""
        late = [time for time, _ in self.bout.waiting if time > self.decided - BOUT.late]
        return self.start + min([self.decided, *late])

    def checkpoint(self) -> DetectorCheckpoint:
        """The complete state; after `restore` the results are equal."""
        self._evaluate()
        return storage.checkpoint(self, DetectorCheckpoint)

    @classmethod
    def restored(cls, checkpoint: DetectorCheckpoint) -> StepDetector:
        """A detector that continues from a checkpoint."""
        detector = cls(checkpoint.period, checkpoint.start, checkpoint.look_ahead)
        storage.restore(detector, checkpoint)
        detector._origin, detector._evaluated = detector.smoothed_first, detector.count
        detector._gravity_first = detector.first
        return detector

    @property
    def _sampling(self) -> float:
        """Interval between smoothed samples. [s]"""
        return self.period * decimation(self.period)

    def _decide(self, until: float) -> tuple[Array, Array]:
        """Times and amplitudes of the steps up to ``until`` [s] after the start among the pending candidates."""
        self.decided = max(self.decided, until)
        if not len(self.pending) or self.pending[0, 0] > until:
            return np.empty(0), np.empty(0)
        certain = self.pending[:, 0] <= until
        landed, amplitude = self.bout.steps(_candidates(self.pending[certain]))
        self.pending = self.pending[~certain]
        return self.start + landed, amplitude

    def _evaluate(self) -> None:
        """Find the candidates after the certain time among all samples, unless none are new."""
        if self._evaluated == self.count or self._sampling > CANDIDATE.slowest:
            return
        self._evaluated = self.count
        self._smooth()
        if self._stream is None:
            self._stream = CandidateStream(self._sampling, self.look_ahead, self.smoothed_first)
        smooth, steady = self.smoothed.T
        self._stream.update(smooth, self._smooth_final)
        found = self._stream.candidates(steady, self.decided, self._origin)
        self.pending = np.stack(list(vars(found).values()), axis=1)
        drop = self._origin - self.smoothed_first  # no later step depends on earlier samples
        self.smoothed, self.smoothed_first = self.smoothed[drop:], self._origin
        self._stream.forget(self._origin)

    @property
    def _smooth_final(self) -> int:
        """Number of the first smoothed |a| that later samples may change."""
        reach = len(gaussian_weights(CANDIDATE.smoothing / self.period)) // 2
        return max(self.smoothed_first, (self.count - 1 - reach) // decimation(self.period) + 1)

    def _smooth(self) -> None:
        """Smooth the new samples, and the last ones again: their smoothed values depend on later samples."""
        stride = decimation(self.period)
        reach = int(CANDIDATE.reach / self.period / stride) + 1
        final = self.smoothed[: self.smoothed_final - self.smoothed_first]
        fresh = np.stack([self._magnitude(self.smoothed_final), self._steadiness(self.smoothed_final)], axis=1)
        self.smoothed = np.concatenate([final, fresh])
        self.smoothed_final = max(self.smoothed_final, self.smoothed_first + len(self.smoothed) - reach)
        drop = max(0, self.smoothed_final - reach - self.first // stride) * stride
        self.samples, self.first = self.samples[drop:], self.first + drop

    def _magnitude(self, begin: int) -> Array:
        """Smoothed |a| ``(m,)`` from smoothed sample ``begin`` on. [m/s²]"""
        weights, stride = gaussian_weights(CANDIDATE.smoothing / self.period), decimation(self.period)
        first = max(self.first, begin * stride - len(weights) // 2)
        smooth = correlate1d(np.linalg.norm(self.samples[first - self.first :], axis=1), weights)
        return smooth[begin * stride - first :: stride]

    def _steadiness(self, begin: int) -> Array:
        """Steadiness of the vertical ``(m,)`` from smoothed sample ``begin`` on."""
        weights, stride = gaussian_weights(CANDIDATE.tilt_smoothing / self.period), decimation(self.period)
        reach, known = len(weights) // 2, self._gravity_first + self._gravity.shape[1]
        first = max(self.first, known - reach)
        fresh = correlate1d(self.samples[first - self.first :].T.copy(), weights, axis=1)[:, known - first :]
        gravity = np.concatenate([self._gravity, fresh], axis=1)
        drop = max(0, begin * stride - round(CANDIDATE.tilt_window / self.period) - self._gravity_first)
        self._gravity_first += drop
        self._gravity = gravity[:, drop : max(drop, self.count - reach - self._gravity_first + drop)]
        return steadiness(gravity[:, drop:], self.period)[begin * stride - self._gravity_first :: stride]


def _candidates(rows: Array) -> Candidates:
    """Candidates of rows ``(c, 5)``."""
    *columns, bodily = rows.T
    return Candidates(*columns, bodily=bodily > 0)
