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
    BeaconReport,
    Calibration,
    Estimate,
    FixReport,
    Mask,
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
BAROMETER_RATE = 1.0  # [Hz] of the chart: faster changes are noise


def line(name: str, colour: str, time: Array, y: Array, **style: Any) -> dict[str, Any]:
    """A chart line over time [s]; style: ``mode`` and any other key that ``web/content.js`` lists for a line."""
    rows = thinned(len(time))
    return {
        "name": name,
        "colour": colour,
        "time": column(time[rows], CENTISECOND),
        "y": column(y[rows], CHART_RESOLUTION),
    } | style


def calibration_charts(calibration: Calibration, end: float) -> list[dict[str, Any]]:
    """A chart of each coefficient over the segments; prior values that were not estimated are grey."""
    edges = np.append(calibration.start, end)
    time = np.stack([edges[:-1], edges[1:]], axis=1)
    charts = []
    for n, name in enumerate(calibration.names):
        factor = np.degrees(1.0) if name == "b" else 1.0
        value, sigma = factor * calibration.value[:, n], factor * calibration.sigma[:, n]
        lines = [
            _steps(label, colour, time, value, sigma, mask)
            for label, colour, mask in (
                ("estimated", BLUE, calibration.learnt[:, n]),
                ("prior kept", GREY, ~calibration.learnt[:, n]),
            )
            if mask.any()
        ]
        charts.append({"title": MEANING[name], "unit": UNIT_OF[name], "lines": lines})
    return charts


def _steps(name: str, colour: str, time: Array, value: Array, sigma: Array, mask: Mask) -> dict[str, Any]:
    """A step line over segments ``time (s, 2)`` [s] with ±1 sigma, None where ``mask (s,)`` is False."""
    at = np.where(mask, value, np.nan)
    columns = [np.column_stack([y, y, np.full(len(y), np.nan)]).ravel() for y in (at, at - sigma, at + sigma)]
    ends = np.column_stack([time, time[:, 1]]).ravel()
    y, low, high = (column(values, CHART_RESOLUTION) for values in columns)
    return {"name": name, "colour": colour, "time": column(ends, CENTISECOND), "y": y, "low": low, "high": high}


def sigma(tracks: Mapping[str, tuple[str, Trajectory]]) -> dict[str, Any]:
    """Chart of the position standard deviation of each track: root mean variance of both axes [m]."""
    lines = []
    for name, (colour, path) in tracks.items():
        if path.covariance is not None:
            rows = thinned(len(path), CHART_ROWS)
            lines.append(line(name, colour, path.time[rows], horizontal_sigma(path.covariance[rows])))
    return {"title": "position sigma", "unit": "m", "lines": lines, "logarithmic": True}


def errors(tracks: Mapping[str, tuple[str, Trajectory]], truth: Trajectory) -> dict[str, Any]:
    """Chart of the horizontal error of each track against the truth [m]."""
    lines = []
    for name, (colour, path) in tracks.items():
        pairs = pair(path, truth)
        # many: points above which a line has no markers
        marks = {"mode": "lines+markers"} if len(pairs.time) <= 50 else {}
        lines.append(line(name, colour, pairs.time, circular_error(pairs), **marks))
    return {"title": "horizontal error", "unit": "m", "lines": lines, "from_zero": True}


def residuals(fixes: Sequence[FixReport], labels: Sequence[str]) -> dict[str, Any]:
    """Chart of the distance of each fix from the walk [m]; labels: hover text of each fix."""
    time, residual, weight = np.array([(f.time, f.residual, f.weight) for f in fixes]).T
    marks = line("fixes", RED, time, residual, mode="markers")
    marks |= {"weight": column(weight, CHART_RESOLUTION), "text": list(labels)}
    return {"title": "fix residuals", "unit": "m", "lines": [marks], "from_zero": True}


def gait(steps: Steps) -> list[dict[str, Any]]:
    """Charts of step length [m] and step frequency [Hz], broken where the walker stands or the recording has a gap."""
    # longest pause [s] between steps; a line is broken at longer pauses
    stood = np.flatnonzero(steps.time - steps.duration > np.append(steps.start, steps.time[:-1]) + 2.0)
    walked = ~steps.is_gap
    time = np.insert(steps.time, stood, steps.time[stood])
    length, frequency = (
        np.insert(np.where(walked, y, np.nan), stood, np.nan) for y in (steps.length, 1 / steps.duration)
    )
    return [
        {"title": "step length", "unit": "m", "lines": [line("length", BLUE, time, length)]},
        {"title": "step frequency", "unit": "Hz", "lines": [line("frequency", BLUE, time, frequency)]},
    ]


def floors(path: Trajectory, labels: Sequence[str]) -> dict[str, Any]:
    """Chart of the floor over time; labels: of the floors, the lowest first."""
    number = {label: float(n) for n, label in enumerate(labels)}
    on = line("floor", BLUE, path.time, np.array([number.get(f, np.nan) for f in path.floor]), shape="hv")
    return {"title": "floor", "unit": "", "lines": [on], "labels": list(labels)}


def height(barometer: Signal) -> dict[str, Any]:
    """Chart of the barometric height above the start [m], not corrected for weather."""
    time = np.arange(barometer.time[0], barometer.time[-1] + 1 / BAROMETER_RATE, 1 / BAROMETER_RATE)
    place = np.searchsorted(time, barometer.time, side="right") - 1
    count = np.bincount(place, minlength=len(time))
    pressure = np.bincount(place, barometer.values[:, 0], len(time))[count > 0] / count[count > 0]
    # scale height [m] of air at 15 °C: pressure falls to 1/e over this height
    above = -8434.0 * np.log(pressure / pressure[0])
    return {"title": "barometric height", "unit": "m", "lines": [line("height", RADIO, time[count > 0], above)]}


def walk_charts(
    walk: Recording,
    tracks: Mapping[str, tuple[str, Trajectory]],
    fixes: Sequence[FixReport],
    fix_labels: Sequence[str],
    calibration: Calibration | None,
    steps: Steps | None,
    truth: Trajectory | None,
    labels: Sequence[str],
) -> list[dict[str, Any]]:
    """All charts for which there is data; tracks: name -> (colour, path), the result first."""
    result = next(iter(tracks.values()))[1]
    charts = [sigma(tracks)]
    charts += [errors(tracks, truth)] if truth is not None else []
    charts += [residuals(fixes, fix_labels)] if fixes else []
    charts += calibration_charts(calibration, float(result.time[-1])) if calibration is not None else []
    charts += [floors(result, labels)] if len(labels) > 1 else []
    charts += [height(walk.barometer)] if walk.barometer is not None else []
    return charts + (gait(steps) if steps is not None else [])


PURPOSE = {  # what each sensor is required for
    "accelerometer": "steps",
    "gyroscope": "turns",
    "magnetometer": "absolute heading where fixes are sparse",
    "barometer": "floor changes",
}
STUCK_INERTIAL, STUCK = 1.0, 10.0  # [s] of exactly the same value above which a sensor is stuck: noise alone changes it


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
            f"{self.gaps} gap{'s' * (self.gaps != 1)}, longest {self.longest_gap:.1f} s": self.gaps > 0,
            f"stuck at one value for {self.stuck:.1f} s": self.stuck > 0,
            f"{self.clipped} samples clipped at the end of the range": self.clipped > 0,
        }
        return tuple(text for text, holds in texts.items() if holds)


def health(name: str, signal: Signal) -> Health:
    """Assess the data quality of a sensor from its samples, of which there must be at least one."""
    inertial, rate = name in INERTIAL, signal.rate
    interval, gap = np.diff(signal.time), are_gaps(signal)
    axes = signal.values.T.copy()  # contiguous, for speed
    moved = np.append(True, np.logical_or.reduce(axes[:, 1:] != axes[:, :-1]))
    since = signal.time[np.maximum.accumulate(np.where(moved, np.arange(len(moved)), 0))]
    still, duration = float(np.max(signal.time - since)), float(np.ptp(signal.time))
    return Health(
        samples=len(signal),
        rate=rate,
        recorded=1.0 - float(interval[gap].sum()) / duration if duration else 1.0,
        gaps=int(gap.sum()),
        longest_gap=float(interval[gap].max(initial=0.0)),
        stuck=still if still > (STUCK_INERTIAL if inertial else STUCK) else 0.0,
        clipped=sum(clipped(axis) for axis in axes) if inertial else 0,
    )


def sensor_rows(walk: Recording) -> tuple[list[str], list[list[str]]]:
    """Head and rows of the sensor table: sensors, then radios, then fixes in the recording."""
    missing = [name for name in PURPOSE if name not in walk.signals]
    if "linear_acceleration" in walk.signals and "accelerometer" in missing:
        missing.remove("accelerometer")
    rows = [_row(name, signal, walk.notes) for name, signal in walk.signals.items()]
    rows += [[name, "no data", "", "", f"required for {PURPOSE[name]}"] for name in missing]
    radios = (("Bluetooth", walk.bluetooth), ("Wi-Fi", walk.wifi))
    rows += [_radio(name, received) for name, received in radios if received]
    if len(walk.fixes):
        rows.append(["fixes in the recording", f"{len(walk.fixes):,}", _rate(walk.fixes.time), "", ""])
    return ["sensor", "samples", "rate", "recorded", "remarks"], rows


def _row(name: str, signal: Signal, notes: tuple[str, ...]) -> list[str]:
    """The table row of one sensor, with its issues and the notes of the reader."""
    quality = health(name, signal)
    noted = [note.removeprefix(f"{name}: ") for note in notes if note.startswith(f"{name}: ") and " gaps, " not in note]
    remarks = "; ".join([*quality.issues, *noted]) or "ok"
    plain = name.replace("_", " ")
    return [plain, f"{quality.samples:,}", f"{quality.rate:.1f} Hz", f"{quality.recorded:.1%}", remarks]


def _radio(name: str, received: Sightings) -> list[str]:
    return [name, f"{len(received):,}", _rate(received.time), "", f"{len(set(received.transmitter))} transmitters"]


def _rate(time: Array) -> str:
    duration = float(np.ptp(time))
    return f"{len(time) / duration:.2g} Hz" if duration else ""


ESTIMATED, KEPT_PRIOR = "estimated", "not observable from this walk; prior kept"
OWN_TABLE = ("fixes", "beacons", "headings")  # kinds of measurement with a table of their own
MAXIMUM_REPORTS = 200  # rows shown of a kind of measurement
HALF = 0.5  # weight below which a measurement is mostly ignored
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
    walk: Recording,
    fixes: Sequence[FixReport],
    estimate: Estimate,
    summary: Mapping[str, Any],
) -> list[Table]:
    """All tables for which there is data, beside the scores; fixes: those of the estimate that are shown."""
    tables = [_calibration(estimate.calibration)] if estimate.calibration is not None else []
    tables += [table("Sensors", *sensor_rows(walk))]
    tables += [_fixes(fixes, len(estimate.fixes))] if fixes else []
    tables += [_beacons(estimate.beacons)] if estimate.beacons else []
    north, headings = summary["frame"]["kind"] != "local", estimate.reports.get("headings")
    tables += [_headings(headings, north)] if headings else []
    tables += [
        measurement_table(kind, rows) for kind, rows in estimate.reports.items() if rows and kind not in OWN_TABLE
    ]
    tables += [_climbs(summary["climbs"], walk.clock_origin)] if summary["climbs"] else []
    return [*tables, _processing(summary)]


def _calibration(calibration: Calibration) -> Table:
    """Calibration of walker and gyroscope at the end of the walk."""
    value, sigma = calibration.value[-1], calibration.sigma[-1]
    prior, observable = calibration.prior_sigma[-1], calibration.learnt[-1]
    rows = []
    for name, known, *numbers in zip(calibration.names, observable, value, sigma, prior, strict=True):
        shown = np.degrees(numbers) if UNIT_OF[name] else numbers
        unit = f" [{UNIT_OF[name]}]" if UNIT_OF[name] else ""
        rows.append([MEANING[name] + unit, *(f"{number:.4f}" for number in shown), ESTIMATED if known else KEPT_PRIOR])
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


def _beacons(beacons: Sequence[BeaconReport]) -> Table:
    rows = [[b.label, f"{b.levels}", f"{b.residual:.1f}", metres(b.x), metres(b.y), b.reason] for b in beacons]
    return table("Beacons", ["beacon", "observations", "residual [dB]", "x [m]", "y [m]", "status"], rows)


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
    rows = [[_cell(name, getattr(report, name)) for name in names] for report in shown]
    moments = [round(float(report.time), 2) for report in shown] if names[0] == "time" else []
    cut = f", the first {MAXIMUM_REPORTS} shown" if len(reports) > len(shown) else ""
    notes = [count(len(reports), "measurement") + cut]
    if "residual" in names:
        residual = np.abs([report.residual for report in reports])
        notes += (
            [f"mean |residual| {np.mean(residual[np.isfinite(residual)]):.3g}"] if np.isfinite(residual).any() else []
        )
    if "weight" in names:
        notes.append(f"weight < {HALF}: {np.mean([report.weight < HALF for report in reports]):.0%}")
    return table(kind.replace("_", " ").capitalize(), names, rows, moments, note="; ".join(notes))


def _cell(name: str, value: Any) -> str:
    """A field of a report as text; empty for None and NaN."""
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return ""
    return clock(value) if name == "time" else _plain(value)


def _climbs(climbs: Sequence[Mapping[str, Any]], clock_origin: float) -> Table:
    starts = [climb["start"] - clock_origin for climb in climbs]
    rows = [
        [clock(start), clock(climb["end"] - clock_origin), f"{climb['height']:+.1f}", climb["kind"]]
        for start, climb in zip(starts, climbs, strict=True)
    ]
    return table("Floor changes", ["from", "to", "height [m]", "by"], rows, starts)


def _processing(summary: Mapping[str, Any]) -> Table:
    """Run times, settings, frame, optimum and versions."""
    rows = [[f"{stage} [s]", f"{seconds:.2f}"] for stage, seconds in summary["seconds"].items()]
    rows += [[name.replace("_", " "), _plain(value)] for name, value in _flat(summary["settings"])]
    rows += [[name.replace("_", " "), _plain(value)] for name, value in _flat(summary["frame"])]
    rows += [[name, _plain(value)] for name, value in summary["optimum"].items()]
    rows += [[name, value] for name, value in summary["versions"].items()]
    return table("Processing", ["item", "value"], rows, closed=True)


def _flat(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Names and values of all settings that are not None; nested ones as "outer: inner"."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from ((f"{name}: {inner}", leaf) for inner, leaf in _flat(value))
        elif value is not None:
            yield name, value


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def metres(value: float) -> str:
    """A length or coordinate [m] with two decimals; empty for NaN."""
    return f"{value:.2f}" if np.isfinite(value) else ""


def clock(seconds: float) -> str:
    """Seconds since the start as h:mm:ss: "1:02:03", "4:05"."""
    sign, whole = "-" if seconds < -0.5 else "", abs(round(seconds))
    hours, minutes = whole // 3600, whole // 60 % 60
    return f"{sign}{hours}:{minutes:02d}:{whole % 60:02d}" if hours else f"{sign}{minutes}:{whole % 60:02d}"
