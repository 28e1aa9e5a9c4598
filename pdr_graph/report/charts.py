"""What of a walk changes with time, as the page's charts have it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pdr_graph.evaluation import circular_error, pair
from pdr_graph.plotting import FIX, GREY, RADIO, TRACK
from pdr_graph.report.columns import CENTISECOND, column, thinned
from pdr_graph.types import Array, Calibration, FixReport, Mask, Recording, Signal, Steps, Trajectory

FINE = 1e-4  # of any unit: as finely as a chart is read
UNITS = {"R_s": "", "R_d": "", "b": "°/s"}
MEANING = {"R_s": "stride scale R_s", "R_d": "turn scale R_d", "b": "gyro drift b"}
SCALE_HEIGHT = 8434.0  # [m] of air at 15 °C: by how much higher the pressure is 1/e
BAROMETER_RATE = 1.0  # [Hz] as it is drawn: faster is its noise
SHORT_STAND = 2.0  # [s] beyond which no line joins two steps
MANY = 50  # points above which a line says more than marks


def line(name: str, colour: str, time: Array, y: Array, **style: Any) -> dict[str, Any]:
    """A line over time; style: ``mode`` and whatever else ``web/content.js`` knows of a line."""
    rows = thinned(len(time))
    return {"name": name, "colour": colour, "time": column(time[rows], CENTISECOND), "y": column(y[rows], FINE)} | style


def calibration(found: Calibration, end: float) -> list[dict[str, Any]]:
    """A chart of each coefficient, by segment, with what was learnt set off from what is the prior's."""
    edges = np.append(found.start, end)
    time = np.stack([edges[:-1], edges[1:]], axis=1)
    charts = []
    for n, name in enumerate(found.names):
        factor = np.degrees(1.0) if name == "b" else 1.0
        value, sigma = factor * found.value[:, n], factor * found.sigma[:, n]
        lines = [
            _steps(said, colour, time, value, sigma, which)
            for said, colour, which in (
                ("learnt", TRACK, found.learnt[:, n]),
                ("the prior's, not learnt", GREY, ~found.learnt[:, n]),
            )
            if which.any()
        ]
        charts.append({"title": MEANING[name], "unit": UNITS[name], "lines": lines})
    return charts


def _steps(name: str, colour: str, time: Array, value: Array, sigma: Array, which: Mask) -> dict[str, Any]:
    """Segments ``(s, 2)`` of one value with ±1 sigma, None where they are not of this kind."""
    at = np.where(which, value, np.nan)
    columns = [np.column_stack([y, y, np.full(len(y), np.nan)]).ravel() for y in (at, at - sigma, at + sigma)]
    ends = np.column_stack([time, time[:, 1]]).ravel()
    y, low, high = (column(values, FINE) for values in columns)
    return {"name": name, "colour": colour, "time": column(ends, CENTISECOND), "y": y, "low": low, "high": high}


def sigma(tracks: Mapping[str, tuple[str, Trajectory]]) -> dict[str, Any]:
    """How well each track knows where it is: standard deviation per axis, the mean of both."""
    lines = [
        line(name, colour, path.time, np.sqrt(np.trace(path.covariance[:, :2, :2], axis1=1, axis2=2) / 2))
        for name, (colour, path) in tracks.items()
        if path.covariance is not None
    ]
    return {"title": "sigma of position", "unit": "m", "lines": lines, "logarithmic": True}


def errors(tracks: Mapping[str, tuple[str, Trajectory]], truth: Trajectory) -> dict[str, Any]:
    """How far each track is from the truth."""
    lines = []
    for name, (colour, path) in tracks.items():
        pairs = pair(path, truth)
        marks = {"mode": "lines+markers"} if len(pairs.time) <= MANY else {}
        lines.append(line(name, colour, pairs.time, circular_error(pairs), **marks))
    return {"title": "error", "unit": "m", "lines": lines, "from_zero": True}


def residuals(fixes: Sequence[FixReport], said: Sequence[str]) -> dict[str, Any]:
    """How far each fix is from the walk; said: of each, as the map says it."""
    time, residual, weight = np.array([(f.time, f.residual, f.weight) for f in fixes]).T
    marks = line("fixes", FIX, time, residual, mode="markers")
    marks |= {"weight": column(weight, FINE), "text": list(said)}
    return {"title": "residuals of fixes", "unit": "m", "lines": [marks], "from_zero": True}


def gait(steps: Steps) -> list[dict[str, Any]]:
    """Stride and frequency of every step; nothing where the walker stood or the recording has a gap."""
    stood = np.flatnonzero(steps.time - steps.duration > np.append(steps.start, steps.time[:-1]) + SHORT_STAND)
    walked = steps.length > 0
    time = np.insert(steps.time, stood, steps.time[stood])
    length, frequency = (
        np.insert(np.where(walked, y, np.nan), stood, np.nan) for y in (steps.length, 1 / steps.duration)
    )
    return [
        {"title": "length of steps", "unit": "m", "lines": [line("length", TRACK, time, length)]},
        {"title": "frequency of steps", "unit": "Hz", "lines": [line("frequency", TRACK, time, frequency)]},
    ]


def floors(path: Trajectory, labels: Sequence[str]) -> dict[str, Any]:
    """The floor of every row, of ``labels`` from the lowest."""
    number = {label: float(n) for n, label in enumerate(labels)}
    on = line("floor", TRACK, path.time, np.array([number.get(f, np.nan) for f in path.floor]), shape="hv")
    return {"title": "floor", "unit": "", "lines": [on], "labels": list(labels)}


def height(barometer: Signal) -> dict[str, Any]:
    """How high the barometer is above its start; the weather is in it."""
    time = np.arange(barometer.time[0], barometer.time[-1] + 1 / BAROMETER_RATE, 1 / BAROMETER_RATE)
    place = np.searchsorted(time, barometer.time, side="right") - 1
    count = np.bincount(place, minlength=len(time))
    pressure = np.bincount(place, barometer.values[:, 0], len(time))[count > 0] / count[count > 0]
    above = -SCALE_HEIGHT * np.log(pressure / pressure[0])
    return {"title": "height by the barometer", "unit": "m", "lines": [line("height", RADIO, time[count > 0], above)]}


def of_walk(
    walk: Recording,
    tracks: Mapping[str, tuple[str, Trajectory]],
    fixes: Sequence[FixReport],
    said: Sequence[str],
    found: Calibration | None,
    steps: Steps | None,
    truth: Trajectory | None,
    labels: Sequence[str],
) -> list[dict[str, Any]]:
    """All charts that there is something for; tracks: name to colour and path, the result's own first."""
    result = next(iter(tracks.values()))[1]
    charts = [sigma(tracks)]
    charts += [errors(tracks, truth)] if truth is not None else []
    charts += [residuals(fixes, said)] if fixes else []
    charts += calibration(found, float(result.time[-1])) if found is not None else []
    charts += [floors(result, labels)] if len(labels) > 1 else []
    charts += [height(walk.barometer)] if walk.barometer is not None else []
    return charts + (gait(steps) if steps is not None else [])
