"""Velocities by a network of the user's own: its contract, the windows that it reads, and what it returns.

The contract is the shape of RoNIN's ResNet (Herath, Yan, Furukawa, *RoNIN: Robust Neural Inertial Navigation in the
Wild*, ICRA 2020, Sec. IV): an ONNX model with one input ``[N, 6, 200]``, a second of samples at 200 Hz: angular rate
[rad/s], then acceleration with gravity [m/s²], both turned into a level frame with z up whose x axis points anywhere,
but always the same axis (a game rotation vector). Output: mean velocity of the second ``[N, 2]`` in that frame [m/s];
optionally, second, log σ of each component ``[N, 2]``, as TLIO states it (Liu et al., RA-L 2020, Sec. IV-B).
No network is shipped.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pdr_graph.errors import InputError, count, one_line
from pdr_graph.geometry import interpolate
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.priors import LEARNED
from pdr_graph.types import Array, Index, Rows

if TYPE_CHECKING:
    from numpy.typing import NDArray

RATE, SAMPLES, CHANNELS = 200.0, 200, 6  # [Hz] and size of a window, the contract
WINDOW_STEP = 20  # samples from one window to the next: 10 Hz
WINDOWS_AT_ONCE = 1024  # windows in one run of the network: 5 MB
FASTEST = 10.0  # [m/s] beyond which an output is no velocity of a walker


@dataclass(frozen=True)
class Velocities(Rows, row="velocity"):
    """Level velocities of a walker by a network, ``n`` rows in order of time, between which they are linear.

    time: ``(n,)`` [s]; velocity: ``(n, 2)`` [m/s], in a level frame whose x axis points anywhere and turns with the
    gyroscope's drift alone; sigma: ``(n, 2)`` [m/s]; frame: ``(n,)`` number of that frame: a gap in the recording
    begins another.
    """

    time: Array
    velocity: Array
    sigma: Array
    frame: Index


class Network:
    """A network of the user's own, see above. Raises InputError if it cannot be run or has another shape."""

    def __init__(self, path: str | Path):
        try:
            import onnxruntime
        except ImportError:
            raise InputError(path, "", "a network, and no onnxruntime", "pip install '.[learned]' in a clone") from None
        self.path = Path(path)
        if not self.path.is_file():
            raise InputError(path, "", "no such file", "a network as ONNX")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.log_severity_level = 1, 4  # the same sums on any machine; raised anyway
        try:
            self._session = onnxruntime.InferenceSession(self.path.read_bytes(), options, ["CPUExecutionProvider"])
        except Exception as error:  # each of its errors is a class of its own
            raise InputError(path, "", one_line(str(error)), "a network as ONNX in one file") from None
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1 or inputs[0].type != "tensor(float)" or not _fits(inputs[0].shape, (CHANNELS, SAMPLES)):
            found = ", ".join(f"{each.shape} of {each.type}" for each in inputs)
            expected = f"one input [N, {CHANNELS}, {SAMPLES}] of tensor(float): gyroscope, accelerometer at 200 Hz"
            raise InputError(path, "input", found, expected)
        if not 1 <= len(outputs) <= 2 or not all(_fits(each.shape, (2,)) for each in outputs):
            self._refuse([each.shape for each in outputs])
        self._input, first = inputs[0].name, inputs[0].shape[0]
        self._batch = first if isinstance(first, int) else WINDOWS_AT_ONCE

    def __call__(self, windows: NDArray[np.float32]) -> tuple[Array, Array | None]:
        """Velocities ``(n, 2)`` [m/s] in windows ``(n, 6, 200)``, and log σ ``(n, 2)``, None if it states none."""
        parts = list[list[Array]]()
        for first in range(0, len(windows), self._batch):
            part = windows[first : first + self._batch]
            padded = np.concatenate([part, np.zeros((-len(part) % self._batch, *part.shape[1:]), part.dtype)])
            full = part if self._batch == WINDOWS_AT_ONCE else padded
            try:
                made: Any = self._session.run(None, {self._input: np.ascontiguousarray(full)})
            except Exception as error:
                expected = f"a network that runs on [{len(full)}, {CHANNELS}, {SAMPLES}]"
                raise InputError(self.path, "", one_line(str(error)), expected) from None
            if any(np.shape(each) != (len(full), 2) for each in made):
                self._refuse([list(np.shape(each)) for each in made])
            parts.append([np.asarray(each, dtype=float)[: len(part)] for each in made])
        velocity, *sigma = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        return velocity, sigma[0] if sigma else None

    def _refuse(self, shapes: list[Any]) -> None:
        expected = "[N, 2], the velocity [m/s], or also [N, 2], its log σ"
        raise InputError(self.path, "output", ", ".join(map(str, shapes)), expected)


def _fits(shape: list[Any], expected: tuple[int, ...]) -> bool:
    """True if a shape of a model, in which a name is any size, can be a batch of ``expected``."""
    sizes = shape[1:] if shape else []
    return len(sizes) == len(expected) and all(
        a == b or not isinstance(a, int) for a, b in zip(sizes, expected, strict=True)
    )


def windows_of(attitude: Attitude) -> tuple[Array, NDArray[np.float32]]:
    """Middles ``(n,)`` [s] of the windows of an uninterrupted part, and their samples ``(n, 6, 200)``.

    Where the gyroscope did not run, samples are NaN.
    """
    time = np.arange(attitude.time[0], attitude.time[-1], 1 / RATE)
    world = [attitude.R_world_device.apply(each) for each in (attitude.angular_rate, attitude.acceleration)]
    samples = interpolate(time, attitude.time, np.concatenate(world, axis=1))
    if len(time) < SAMPLES:
        return np.empty(0), np.empty((0, CHANNELS, SAMPLES), dtype=np.float32)
    windows = sliding_window_view(samples.astype(np.float32), SAMPLES, axis=0)[::WINDOW_STEP]
    return time[: len(time) - SAMPLES + 1 : WINDOW_STEP] + SAMPLES / 2 / RATE, windows


def learned_velocities(attitudes: Iterable[Attitude], network: Network) -> tuple[Velocities, tuple[str, ...]]:
    """The velocities of a walk by a network, and a line for windows without a usable velocity, which are left out.

    attitudes: of its uninterrupted parts. The first and the last half second of a part have the velocity beside them.
    """
    parts, lost, every = list[Velocities](), 0, 0
    for frame, attitude in enumerate(attitudes):
        time, windows = windows_of(attitude)
        whole = np.flatnonzero(np.isfinite(windows[:, 0]).all(axis=1))  # the gyroscope ran
        if len(whole) < len(time):
            time, windows = time[whole], windows[whole]
        if not len(time):
            continue
        velocity, log_sigma = network(windows)
        stated = np.full_like(velocity, LEARNED.sigma) if log_sigma is None else np.exp(np.clip(log_sigma, -20, 20))
        known = np.isfinite(velocity) & np.isfinite(stated) & (np.abs(velocity) < FASTEST)
        rows = np.flatnonzero(np.all(known, axis=1))
        lost, every = lost + len(velocity) - len(rows), every + len(velocity)
        if not len(rows):
            continue
        rows = np.concatenate([rows[:1], rows, rows[-1:]])
        time = np.concatenate([[time[rows[0]] - 0.5], time[rows[1:-1]], [time[rows[-1]] + 0.5]])
        parts.append(Velocities(time, velocity[rows], stated[rows], np.full(len(rows), frame)))
    notes = (f"network: {lost} of {count(every, 'window')} have no usable velocity and are left out",) if lost else ()
    if not parts:
        none = Velocities(np.empty(0), np.empty((0, 2)), np.empty((0, 2)), np.empty(0, dtype=np.intp))
        return none, (*notes, "network: no velocity of this walk, so that it is not used")
    names = ("time", "velocity", "sigma", "frame")
    return Velocities(*(np.concatenate([getattr(part, name) for part in parts]) for name in names)), notes
