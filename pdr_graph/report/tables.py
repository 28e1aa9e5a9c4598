"""The tables of a walk's report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from pdr_graph.evaluation import evaluate
from pdr_graph.floor.building import Building
from pdr_graph.report import sensors
from pdr_graph.report.charts import MEANING
from pdr_graph.types import BeaconReport, Calibration, FixReport, Recording, Trajectory

SCORES = {  # where `evaluate` has it: what it is, its unit
    ("ce", "p50"): ("CE50: distance that half of the moments are below", "m"),
    ("ce", "p75"): ("CE75", "m"),
    ("ce", "p95"): ("CE95", "m"),
    ("he", "p50"): ("HE50: heading", "rad"),
    ("eag",): ("EAG: distance by the time to the nearer end", "m/s"),
    ("ve",): ("VE: speed", "m/s"),
    ("ca",): ("CA: most frequent error, ahead and aside", "m"),
    ("oe",): ("OE: share of steps that leave the walkable area", ""),
    ("fe",): ("FE: share on the right floor", ""),
    ("n",): ("moments with a truth", ""),
}
MOST_OPEN = 30  # rows of a table that is shown unasked
Table = dict[str, Any]


def table(
    title: str, head: Sequence[str], rows: Sequence[Sequence[str]], moments: Sequence[float] = (), shut: bool = False
) -> Table:
    """Cells are text; moments: of each row, what the slider is set to by it [s]; shut: shown when it is asked for."""
    shut = shut or len(rows) > MOST_OPEN
    return {"title": title, "head": head, "rows": rows, "moments": moments, "open": not shut}


def of_walk(
    walk: Recording,
    fixes: Sequence[FixReport],
    beacons: Sequence[BeaconReport],
    calibration: Calibration | None,
    scores: Table | None,
    summary: Mapping[str, Any],
) -> list[Table]:
    """All tables that there is something for."""
    found = [scores] if scores is not None else []
    found += [_calibration(calibration)] if calibration is not None else []
    found += [table("Sensors", *sensors.table(walk))]
    found += [_fixes(fixes)] if fixes else []
    found += [_beacons(beacons)] if beacons else []
    found += [_climbs(summary["climbs"], walk.clock_origin)] if summary["climbs"] else []
    return [*found, _run(summary)]


def scored(tracks: Mapping[str, Trajectory], truth: Trajectory, building: Building | None) -> Table | None:
    """The metrics of each track; None where no moment has a truth."""
    scores = [_evaluated(path, truth, building) for path in tracks.values()]
    if not scores[0]["n"]:
        return None
    rows = [[said, unit, *(_score(own, where) for own in scores)] for where, (said, unit) in SCORES.items()]
    return table("Against the truth", ["error", "unit", *tracks], [row for row in rows if any(row[2:])])


def _evaluated(path: Trajectory, truth: Trajectory, building: Building | None) -> Mapping[str, Any]:
    """The metrics of one track; one that knows no floor, as dead reckoning does not, is not scored for it."""
    scores = evaluate(path, truth, building)
    return scores if any(path.floor) else {**scores, "fe": None}


def _score(scores: Mapping[str, Any], where: tuple[str, ...]) -> str:
    value: Any = scores
    for name in where:
        value = value[name] if value is not None else None
    return "" if value is None else f"{value:d}" if isinstance(value, int) else f"{value:.3f}"


def _calibration(found: Calibration) -> Table:
    """What is known of walker and gyro at the end of the walk."""
    value, sigma, prior, learnt = found.value[-1], found.sigma[-1], found.prior_sigma[-1], found.learnt[-1]
    names = [MEANING[name] + (" [rad/s]" if name == "b" else "") for name in found.names]
    rows = [
        [name, f"{v:.4f}", f"{s:.4f}", f"{p:.4f}", "learnt" if known else "the prior's: the walk does not tell it"]
        for name, v, s, p, known in zip(names, value, sigma, prior, learnt, strict=True)
    ]
    return table("What the walk taught, at its end", ["coefficient", "value", "sigma", "sigma before", ""], rows)


def _fixes(fixes: Sequence[FixReport]) -> Table:
    rows = [
        [clock(f.time), metres(f.x), metres(f.y), metres(f.sigma), metres(f.residual), f"{f.weight:.2f}", f.reason]
        for f in fixes
    ]
    head = ["time", "x [m]", "y [m]", "sigma [m]", "residual [m]", "weight", "reason"]
    return table("Fixes", head, rows, [round(f.time, 2) for f in fixes])


def _beacons(beacons: Sequence[BeaconReport]) -> Table:
    rows = [[b.label, f"{b.levels}", f"{b.residual:.1f}", metres(b.x), metres(b.y), b.reason] for b in beacons]
    return table("Beacons", ["beacon", "heard", "residual [dB]", "x [m]", "y [m]", ""], rows)


def _climbs(climbs: Sequence[Mapping[str, Any]], clock_origin: float) -> Table:
    starts = [climb["start"] - clock_origin for climb in climbs]
    rows = [
        [clock(start), clock(climb["end"] - clock_origin), f"{climb['height']:+.1f}", climb["kind"]]
        for start, climb in zip(starts, climbs, strict=True)
    ]
    return table("Up and down", ["from", "to", "height [m]", "on"], rows, starts)


def _run(summary: Mapping[str, Any]) -> Table:
    """How the result was made."""
    rows = [[f"{stage}, seconds", f"{seconds:.2f}"] for stage, seconds in summary["seconds"].items()]
    rows += [[name.replace("_", " "), _plain(value)] for name, value in _flat(summary["settings"])]
    rows += [[name.replace("_", " "), _plain(value)] for name, value in _flat(summary["frame"])]
    rows += [[name, _plain(value)] for name, value in summary["optimum"].items()]
    rows += [[name, value] for name, value in summary["versions"].items()]
    return table("How it was made", ["what", "how"], rows, shut=True)


def _flat(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Settings that are set, and what they are made of."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from ((f"{name}: {inner}", found) for inner, found in _flat(value))
        elif value is not None:
            yield name, value


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def metres(value: float) -> str:
    """A length or place [m]; nothing of what is not known."""
    return f"{value:.2f}" if np.isfinite(value) else ""


def clock(seconds: float) -> str:
    """A time since the start as a clock has it: "1:02:03", "4:05"."""
    sign, whole = "-" if seconds < -0.5 else "", abs(round(seconds))
    hours, minutes = whole // 3600, whole // 60 % 60
    return f"{sign}{hours}:{minutes:02d}:{whole % 60:02d}" if hours else f"{sign}{minutes}:{whole % 60:02d}"
