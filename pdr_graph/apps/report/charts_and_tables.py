"""Charts and tables of a walk report, with data quality per sensor: rate, gaps, stuck and clipped samples."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from pdr_graph.apps.report.evaluation import circular_error, pair
from pdr_graph.apps.report.page import CENTISECOND, RADIO, column, thinned
from pdr_graph.errors import count
from pdr_graph.geometry import horizontal_sigma
from pdr_graph.io.validation import are_gaps, clipped
from pdr_graph.notebook_html import BLUE, GREY, RED
from pdr_graph.types import (
    INERTIAL,
    Array,
    Calibration,
    Estimate,
    FixReport,
    Recording,
    Sightings,
    Signal,
    Steps,
    Trajectory,
)

CHART_ROWS = 2000  # of a curve without jumps: 4 per pixel
CHART_RESOLUTION = 1e-4  # in the unit of the chart; finer than a screen shows
UNIT_OF = {"R_s": "", "R_d": "", "b": "°/s"}
MEANING = {"R_s": "stride scale R_s", "R_d": "turn scale R_d", "b": "gyro drift b"}


def line(name: str, colour: str, time: Array, y: Array, **style: Any) -> dict[str, Any]:
    """A chart line over time [s]; style: ``mode`` and any other key that ``web/content.js`` lists for a line."""
    rows = thinned(len(time))
    drawn = {"time": column(time[rows], CENTISECOND), "y": column(y[rows], CHART_RESOLUTION)}
    return {"name": name, "colour": colour} | drawn | style


def chart(title: str, unit: str, *lines: dict[str, Any], **style: Any) -> dict[str, Any]:
    """A chart of some lines; style: any other key that ``web/content.js`` lists for a chart."""
    return {"title": title, "unit": unit, "lines": list(lines)} | style


def calibration_charts(calibration: Calibration, end: float) -> list[dict[str, Any]]:
    """A chart of each coefficient over the segments with ±1 sigma; prior values that were not estimated are grey."""
    edges = np.append(calibration.start, end)
    ends = np.column_stack([edges[:-1], edges[1:], edges[1:]]).ravel()
    charts = []
    for n, name in enumerate(calibration.names):
        factor = np.degrees(1.0) if name == "b" else 1.0
        value, sigma = factor * calibration.value[:, n], factor * calibration.sigma[:, n]
        learnt, lines = calibration.learnt[:, n], []
        for label, colour, mask in (("estimated", BLUE, learnt), ("prior kept", GREY, ~learnt)):
            if mask.any():
                at = np.where(mask, value, np.nan)
                gap = np.full(len(at), np.nan)
                y, low, high = (np.column_stack([c, c, gap]).ravel() for c in (at, at - sigma, at + sigma))
                band = {"low": column(low, CHART_RESOLUTION), "high": column(high, CHART_RESOLUTION)}
                lines.append(line(label, colour, ends, y, **band))
        charts.append(chart(MEANING[name], UNIT_OF[name], *lines))
    return charts


def sigma(tracks: Mapping[str, tuple[str, Trajectory]]) -> dict[str, Any]:
    """Chart of the position standard deviation of each track: root mean variance of both axes [m]."""
    lines = []
    for name, (colour, path) in tracks.items():
        if path.covariance is not None:
            rows = thinned(len(path), CHART_ROWS)
            lines.append(line(name, colour, path.time[rows], horizontal_sigma(path.covariance[rows])))
    return chart("position sigma", "m", *lines, logarithmic=True)


def errors(tracks: Mapping[str, tuple[str, Trajectory]], truth: Trajectory) -> dict[str, Any]:
    """Chart of the horizontal error of each track against the truth [m]; few points have markers."""
    lines = []
    for name, (colour, path) in tracks.items():
        pairs = pair(path, truth)
        marks = {"mode": "lines+markers"} if len(pairs.time) <= FEW else {}
        lines.append(line(name, colour, pairs.time, circular_error(pairs), **marks))
    return chart("horizontal error", "m", *lines, from_zero=True)


def residuals(fixes: Sequence[FixReport], labels: Sequence[str]) -> dict[str, Any]:
    """Chart of the distance of each fix from the walk [m]; labels: hover text of each fix."""
    time, residual, weight = np.array([(f.time, f.residual, f.weight) for f in fixes]).T
    style = {"mode": "markers", "weight": column(weight, CHART_RESOLUTION), "text": list(labels)}
    return chart("fix residuals", "m", line("fixes", RED, time, residual, **style), from_zero=True)


def gait(steps: Steps) -> list[dict[str, Any]]:
    """Charts of step length [m] and step frequency [Hz], broken where the walker stands or the recording has a gap."""
    # a line is broken at pauses of more than 2 s between steps
    stood = np.flatnonzero(steps.time - steps.duration > np.append(steps.start, steps.time[:-1]) + 2.0)
    time = np.insert(steps.time, stood, steps.time[stood])
    charts = []
    for name, unit, y in (("length", "m", steps.length), ("frequency", "Hz", 1 / steps.duration)):
        broken = np.insert(np.where(steps.is_gap, np.nan, y), stood, np.nan)
        charts.append(chart(f"step {name}", unit, line(name, BLUE, time, broken)))
    return charts


def floors(path: Trajectory, labels: Sequence[str]) -> dict[str, Any]:
    """Chart of the floor over time; labels: of the floors, the lowest first."""
    number = {label: float(n) for n, label in enumerate(labels)}
    on = line("floor", BLUE, path.time, np.array([number.get(f, np.nan) for f in path.floor]), shape="hv")
    return chart("floor", "", on, labels=list(labels))


def height(barometer: Signal) -> dict[str, Any]:
    """Chart of the barometric height above the start [m], not corrected for weather; means of each second."""
    second = np.floor(barometer.time - barometer.time[0]).astype(int)
    number = np.bincount(second)
    heard = number > 0
    pressure = np.bincount(second, barometer.values[:, 0])[heard] / number[heard]
    above = -8434.0 * np.log(pressure / pressure[0])  # scale height [m] of air at 15 °C
    return chart("barometric height", "m", line("height", RADIO, barometer.time[0] + np.flatnonzero(heard), above))


PURPOSE = {  # what each sensor is required for
    "accelerometer": "steps",
    "gyroscope": "turns",
    "magnetometer": "absolute heading where fixes are sparse",
    "barometer": "floor changes",
}


@dataclass(frozen=True)
class Health:
    """Data quality of one sensor.

    samples: count; rate: from the median interval [Hz]; recorded: share of the duration without gaps; gaps: count;
    longest_gap: [s]; stuck: longest time without any change [s], 0 if that is normal; clipped: samples clipped at the
    extremes of an inertial sensor.
    """

    samples: int
    rate: float
    recorded: float
    gaps: int
    longest_gap: float
    stuck: float
    clipped: int

    @property
    def issues(self) -> tuple[str, ...]:
        """One text per issue; empty for a sensor without issues."""
        texts = {
            f"{count(self.gaps, 'gap')}, longest {self.longest_gap:.1f} s": self.gaps,
            f"stuck at one value for {self.stuck:.1f} s": self.stuck,
            f"{self.clipped} samples clipped at the end of the range": self.clipped,
        }
        return tuple(text for text, amount in texts.items() if amount)


def health(name: str, signal: Signal) -> Health:
    """Assess the data quality of a sensor from its samples, of which there must be at least one."""
    inertial, rate = name in INERTIAL, signal.rate
    interval, gap = np.diff(signal.time), are_gaps(signal)
    axes = signal.values.T.copy()  # contiguous, for speed
    moved = np.append(True, np.logical_or.reduce(axes[:, 1:] != axes[:, :-1]))
    since = signal.time[np.maximum.accumulate(np.where(moved, np.arange(len(moved)), 0))]
    # noise alone changes a sensor within that time
    still, duration = float(np.max(signal.time - since)), float(np.ptp(signal.time))
    return Health(
        samples=len(signal),
        rate=rate,
        recorded=1.0 - float(interval[gap].sum()) / duration if duration else 1.0,
        gaps=int(gap.sum()),
        longest_gap=float(interval[gap].max(initial=0.0)),
        stuck=still if still > (1.0 if inertial else 10.0) else 0.0,
        clipped=sum(clipped(axis) for axis in axes) if inertial else 0,
    )


def sensor_rows(walk: Recording) -> tuple[list[str], list[list[str]]]:
    """Head and rows of the sensor table: sensors, then radios, then fixes in the recording."""
    rows = []
    for name, signal in walk.signals.items():
        quality, start = health(name, signal), f"{name}: "
        noted = [note.removeprefix(start) for note in walk.notes if note.startswith(start) and " gaps, " not in note]
        shown = f"{quality.samples:,}", f"{quality.rate:.1f} Hz", f"{quality.recorded:.1%}"
        rows.append([name.replace("_", " "), *shown, "; ".join([*quality.issues, *noted]) or "ok"])
    for name, purpose in PURPOSE.items():
        if name not in walk.signals and not (name == "accelerometer" and "linear_acceleration" in walk.signals):
            rows.append([name, "no data", "", "", f"required for {purpose}"])
    for name, data in (("Bluetooth", walk.bluetooth), ("Wi-Fi", walk.wifi), ("fixes in the recording", walk.fixes)):
        if data is not None and len(data):
            duration = float(np.ptp(data.time))
            remark = f"{len(set(data.transmitter))} transmitters" if isinstance(data, Sightings) else ""
            rate = f"{len(data) / duration:.2g} Hz" if duration else ""
            rows.append([name, f"{len(data):,}", rate, "", remark])
    return ["sensor", "samples", "rate", "recorded", "remarks"], rows


OWN_TABLE = ("fixes", "beacons", "headings")  # kinds of measurement with a table of their own
MAXIMUM_REPORTS = 200  # rows shown of a kind of measurement
FEW = 50  # points up to which a line has markers
Table = dict[str, Any]


def table(
    title: str,
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    moments: Sequence[float] = (),
    closed: bool = False,
    note: str = "",
) -> Table:
    """A table of text cells; moments: time of each row for the slider [s]; closed: folded at first; note: above it."""
    closed = closed or len(rows) > 30  # open rows: rows up to which a table is shown open
    return {"title": title, "note": note, "head": head, "rows": rows, "moments": moments, "open": not closed}


def walk_tables(
    walk: Recording, fixes: Sequence[FixReport], estimate: Estimate, summary: Mapping[str, Any]
) -> Iterator[Table]:
    """All tables for which there is data, beside the scores; fixes: those of the estimate that are shown."""
    if estimate.calibration is not None:
        yield _calibration(estimate.calibration)
    yield table("Sensors", *sensor_rows(walk))
    if fixes:
        yield _fixes(fixes, len(estimate.fixes))
    if estimate.beacons:
        rows = [
            [b.label, f"{b.levels}", f"{b.residual:.1f}", metres(b.x), metres(b.y), b.reason] for b in estimate.beacons
        ]
        yield table("Beacons", ["beacon", "observations", "residual [dB]", "x [m]", "y [m]", "status"], rows)
    if headings := estimate.reports.get("headings"):
        yield _headings(headings, summary["frame"]["kind"] != "local")
    for kind, reports in estimate.reports.items():
        if reports and kind not in OWN_TABLE:
            yield measurement_table(kind, reports)
    if summary["climbs"]:
        starts = [climb["start"] - walk.clock_origin for climb in summary["climbs"]]
        rows = [
            [clock(start), clock(climb["end"] - walk.clock_origin), f"{climb['height']:+.1f}", climb["kind"]]
            for start, climb in zip(starts, summary["climbs"], strict=True)
        ]
        yield table("Floor changes", ["from", "to", "height [m]", "by"], rows, starts)
    yield _processing(summary)


def _calibration(calibration: Calibration) -> Table:
    """Calibration of walker and gyroscope at the end of the walk."""
    value, sigma = calibration.value[-1], calibration.sigma[-1]
    prior, observable = calibration.prior_sigma[-1], calibration.learnt[-1]
    rows = []
    for name, known, *numbers in zip(calibration.names, observable, value, sigma, prior, strict=True):
        shown = np.degrees(numbers) if UNIT_OF[name] else numbers
        unit = f" [{UNIT_OF[name]}]" if UNIT_OF[name] else ""
        status = "estimated" if known else "not observable from this walk; prior kept"
        rows.append([MEANING[name] + unit, *(f"{number:.4f}" for number in shown), status])
    return table("Estimated calibration", ["coefficient", "value", "sigma", "prior sigma", "status"], rows)


def _fixes(fixes: Sequence[FixReport], count: int) -> Table:
    """The fixes that are shown of ``count``."""
    rows = [
        [clock(f.time), metres(f.x), metres(f.y), metres(f.sigma), metres(f.residual), f"{f.weight:.2f}", f.reason]
        for f in fixes
    ]
    head = ["time", "x [m]", "y [m]", "sigma [m]", "residual [m]", "weight", "reason"]
    note = f"{len(fixes):,} of {count:,} fixes, evenly spaced." if count > len(fixes) else ""
    return table("Fixes", head, rows, [round(f.time, 2) for f in fixes], note=note)


def _headings(reports: Sequence[Any], north: bool) -> Table:
    """The headings, clockwise from north, or from +y in a frame without north."""
    rows = [
        [
            clock(h.time),
            f"{(90 - np.degrees(h.heading)) % 360:.0f}",
            f"{np.degrees(h.sigma):.0f}",
            f"{round(-np.degrees(h.residual)):+d}",
            f"{h.weight:.2f}",
            h.reason,
        ]
        for h in reports
    ]
    head = ["time", f"heading [° from {'north' if north else '+y'}]", "sigma [°]", "residual [°]", "weight", "reason"]
    return table("Headings", head, rows, [round(float(h.time), 2) for h in reports])


def measurement_table(kind: str, reports: Sequence[Any]) -> Table:
    """A table of one kind of measurement, a row for each report (a dataclass), with a summary as its note.

    Columns are the fields of the dataclass. Where it has them: ``time`` [s] comes first and sets the slider; the note
    has the mean absolute ``residual`` and the share of measurements of a ``weight`` below a half.
    """
    names = sorted((field.name for field in fields(reports[0])), key=lambda name: name != "time")
    shown = reports[:MAXIMUM_REPORTS]
    moments = [round(float(report.time), 2) for report in shown] if names[0] == "time" else []
    rows = [[_plain(getattr(report, name)) for name in names] for report in shown]
    for row, moment in zip(rows, moments, strict=False):
        row[0] = clock(moment)
    cut = f", the first {MAXIMUM_REPORTS} shown" if len(reports) > len(shown) else ""
    notes = [count(len(reports), "measurement") + cut]
    residual = np.array([getattr(report, "residual", np.nan) for report in reports], dtype=float)
    if (known := residual[np.isfinite(residual)]).size:
        notes.append(f"mean |residual| {np.abs(known).mean():.3g}")
    if "weight" in names:
        notes.append(f"weight < 0.5: {np.mean([report.weight < 0.5 for report in reports]):.0%}")
    return table(kind.replace("_", " ").capitalize(), names, rows, moments, note="; ".join(notes))


def _processing(summary: Mapping[str, Any]) -> Table:
    """Run times, settings, frame, optimum and versions."""
    rows = [[f"{stage} [s]", f"{seconds:.2f}"] for stage, seconds in summary["seconds"].items()]
    flat = [*_flat(summary["settings"]), *_flat(summary["frame"]), *summary["optimum"].items()]
    rows += [[name.replace("_", " "), _plain(value)] for name, value in flat]
    rows += [[name, version] for name, version in summary["versions"].items()]
    return table("Processing", ["item", "value"], rows, closed=True)


def _flat(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Names and values of all settings that are not None; nested ones as "outer: inner"."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from ((f"{name}: {inner}", leaf) for inner, leaf in _flat(value))
        elif value is not None:
            yield name, value


def _plain(value: Any) -> str:
    """A value as text; empty for None and NaN."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}" if np.isfinite(value) else ""
    return "" if value is None else str(value)


def metres(value: float) -> str:
    """A length or coordinate [m]; empty for NaN."""
    return f"{value:.2f}" if np.isfinite(value) else ""


def clock(seconds: float) -> str:
    """Seconds since the start as h:mm:ss: "1:02:03", "4:05"."""
    sign, whole = "-" if seconds < -0.5 else "", abs(round(seconds))
    hours, minutes = whole // 3600, whole // 60 % 60
    return f"{sign}{hours}:{minutes:02d}:{whole % 60:02d}" if hours else f"{sign}{minutes}:{whole % 60:02d}"
