"""Accuracy metrics of the PDR Benchmark Standardization Committee (draft ISO/IEC 21134), and tables of them.

Each metric is one function of paired samples. CE, HE, EAG and VE equal the committee's evaluation-tools with
``nearest`` pairing; ``docs/results/metrics.md`` lists where CA and OE follow the definition and the tool does not.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph.errors import InputError, count, expect, one_line
from pdr_graph.floor.building import Building
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import REGION_90, interpolate, nearest, rotation, squared_distance, wrap_angle
from pdr_graph.io.tables import clock_hint, read_trajectory
from pdr_graph.types import Array, Mask, OneLineRepr, Trajectory

TOLERANCE = 0.5  # [s] between a truth sample and the estimate paired with it, as in the committee's tools
SCORED_DIRECTIONS = 360  # of the energy score; the integrand is smooth and periodic: twice as many change nothing


@dataclass(frozen=True)
class Pairs(OneLineRepr, row="pair"):
    """Truth samples and the estimate at the same times.

    time: ``(n,)`` [s]; truth, estimate: positions ``(n, 2)`` [m]; truth_heading, estimate_heading: ``(n,)`` [rad];
    truth_floor, estimate_floor: labels ``(n,)``; start, end: of the whole truth [s].
    """

    time: Array
    truth: Array
    estimate: Array
    truth_heading: Array
    estimate_heading: Array
    truth_floor: np.ndarray
    estimate_floor: np.ndarray
    start: float
    end: float

    def where(self, mask: Mask) -> Pairs:
        """The pairs where ``mask (n,)`` is True."""
        columns: dict[str, Any] = {n: value[mask] for n, value in vars(self).items() if isinstance(value, np.ndarray)}
        return replace(self, **columns)

    @property
    def same_floor(self) -> Mask:
        """``(n,)`` False where both floors are known and differ."""
        known = (self.truth_floor != "") & (self.estimate_floor != "")
        return ~known | (self.truth_floor == self.estimate_floor)


def pair(estimate: Trajectory, truth: Trajectory, pairing: str = "linear") -> Pairs:
    """Pair each truth sample with the estimate; samples without an estimate within 0.5 s are left out.

    pairing: ``linear`` interpolates between the rows of the estimate, and uses the end rows up to 0.5 s beyond its
        ends; ``nearest`` uses the row nearest in time, the earlier of two, as the committee's tools do.
    """
    if pairing not in ("linear", "nearest"):
        raise ValueError(f"evaluate, pairing: found {pairing!r}, expected 'linear' or 'nearest'")
    t = truth.time
    row = nearest(estimate.time, t)
    if pairing == "nearest":
        position, heading = estimate.position[row], estimate.heading[row]
        within = np.abs(estimate.time[row] - t) <= TOLERANCE
    else:
        position = interpolate(t, estimate.time, estimate.position)
        sine, cosine = (np.interp(t, estimate.time, f(estimate.heading)) for f in (np.sin, np.cos))
        heading = np.arctan2(sine, cosine)
        within = (t >= estimate.time[0] - TOLERANCE) & (t <= estimate.time[-1] + TOLERANCE)
    columns = truth.position, position, truth.heading, heading
    floors = (np.array(labels, dtype=object) for labels in (truth.floor, estimate.floor))
    true_floor, floor = floors
    return Pairs(t, *columns, true_floor, floor[row], float(t[0]), float(t[-1])).where(within)


def circular_error(pairs: Pairs) -> Array:
    """CE ``(n,)`` [m]: horizontal distance."""
    return np.hypot(*(pairs.estimate - pairs.truth).T)


def heading_error(pairs: Pairs) -> Array:
    """HE ``(n,)`` [rad]: absolute heading difference of the samples with both headings."""
    error = np.abs(wrap_angle(pairs.estimate_heading - pairs.truth_heading))
    return error[np.isfinite(error)]


def error_accumulation_gradient(pairs: Pairs) -> Array:
    """EAG ``(n,)`` [m/s]: error divided by the time to the nearer end of the segment without absolute position.

    The segment is the whole truth, from s to f: EAG = CE / min(t − s, f − t). Samples within 1 s of an end are left
    out, where the divisor is too small. The error at s is not subtracted.
    """
    elapsed = np.minimum(pairs.time - pairs.start, pairs.end - pairs.time)
    used = elapsed >= 1.0
    return circular_error(pairs)[used] / elapsed[used]


def velocity_error(pairs: Pairs) -> Array:
    """VE ``(n,)`` [m/s]: |speed of the truth − speed of the estimate|, each the mean over t ± 0.5 s.

    As in the committee's tool, speeds are between consecutive pairs, and 0 for the first.
    """
    return np.abs(_speed(pairs.time, pairs.truth) - _speed(pairs.time, pairs.estimate))


def _speed(time: Array, position: Array) -> Array:
    """Mean speed over t ± 0.5 s at each sample ``(n,)`` [m/s]."""
    distance = np.hypot(*np.diff(position, axis=0, prepend=position[:1]).T)
    total = np.concatenate([[0.0], np.cumsum(distance / np.diff(time, prepend=time[0] - 1.0))])
    first, last = np.searchsorted(time, time - 0.5, side="left"), np.searchsorted(time, time + 0.5, side="right")
    return (total[last] - total[first]) / (last - first)


def circular_accuracy(pairs: Pairs) -> float:
    """CA [m]: distance from 0 of the most frequent error, in the walker's axes (forward, left).

    The mode of a Gaussian kernel density of the errors, of at most a thousand of them, evenly spaced. NaN with fewer
    than three samples with a heading.
    """
    known = np.isfinite(pairs.estimate_heading)
    to_walker = rotation(-pairs.estimate_heading[known])
    errors = np.einsum("nij,nj->ni", to_walker, (pairs.truth - pairs.estimate)[known])
    if len(errors) < 3:
        return float("nan")
    # maximum kernels: errors of which the density is the sum: time grows with their square
    return float(np.hypot(*_mode(errors[:: -(-len(errors) // 1000)])))


def _mode(points: Array) -> Array:
    """The mode ``(2,)`` of the kernel density of points ``(n, 2)``; their mean if all are on one line.

    Mean shift (Fukunaga and Hostetler 1975) from the point of the highest density, kernel width by Scott's rule.
    """
    width = np.cov(points.T) * len(points) ** (-1 / 3)
    variance, axes = np.linalg.eigh(width)
    if variance[0] <= 1e-12 * variance[1]:
        return points.mean(axis=0)
    white = points @ axes / np.sqrt(variance)
    square = np.sum(white**2, axis=1)
    distance = square[:, None] + square - 2 * white @ white.T
    mode = white[np.argmax(np.exp(-0.5 * distance).sum(axis=1))]
    for _ in range(500):  # far more than it takes
        before, weight = mode, np.exp(-0.5 * np.sum((white - mode) ** 2, axis=1))
        mode = weight @ white / weight.sum()
        if np.hypot(*(mode - before)) < 1e-6:  # kernel widths
            break
    return axes @ (mode * np.sqrt(variance))


def obstacle_error(estimate: Trajectory, floor: FloorPlan | Building) -> float:
    """OE, 0–1: share of rows from which the line to the next leaves the walkable area of the floor."""
    rows = np.append(np.arange(len(estimate)), len(estimate) - 1)
    labels = [estimate.floor[row] for row in rows.tolist()]
    return float(np.mean(Building.around(floor).crosses_wall(estimate.position[rows], labels)))


def floor_share(pairs: Pairs) -> float:
    """FE, 0–1: share of samples on the correct floor, of those with a known true floor; NaN if there are none."""
    known = pairs.truth_floor != ""
    return float(np.mean(pairs.truth_floor[known] == pairs.estimate_floor[known])) if known.any() else float("nan")


def evaluate(
    estimate: Trajectory, truth: Trajectory, floor: FloorPlan | Building | None = None, pairing: str = "linear"
) -> dict[str, Any]:
    """All metrics by name, as ``pdr-graph evaluate --json`` prints them; None where one cannot be computed.

    estimate, truth: in one frame and on one clock; floor: the plan, for OE; pairing: "linear" or "nearest", see `pair`.
    CE, EAG and CA use the samples on the correct floor, as far as floors are known. ``n`` is the number of truth
    samples with an estimate; it may be 0. Raises ValueError if the clocks differ.
    """
    expect("evaluate, estimate", estimate, Trajectory, instead="smooth(graph).trajectory")
    expect("evaluate, truth", truth, Trajectory, instead="read_trajectory(path, recording)")
    expect("evaluate, floor", floor, FloorPlan, Building, None, instead="FloorPlan.load(path)")
    pairs = pair(estimate, truth, pairing)
    # another clock [s] between truth and estimate; more means Unix times beside times from the start
    if not len(pairs.time) and abs(truth.time[0] - estimate.time[0]) > 86_400.0:
        found, expected = (f"{t[0]:.3f} to {t[-1]:.3f} s" for t in (truth.time, estimate.time))
        raise ValueError(f"evaluate, truth: found times {found}, expected the same clock as the estimate's, {expected}")
    on_floor = pairs.where(pairs.same_floor)
    scores = {"ce": _statistics(circular_error(on_floor)), "he": _statistics(heading_error(pairs))}
    numbers = {
        "eag": np.median(gradient) if len(gradient := error_accumulation_gradient(on_floor)) else np.nan,
        "ve": np.median(velocity_error(pairs)) if len(pairs.time) else np.nan,
        "ca": circular_accuracy(on_floor),
        "oe": np.nan if floor is None else obstacle_error(estimate, floor),
        "fe": floor_share(pairs),
    }
    known = {name: float(value) if np.isfinite(value) else None for name, value in numbers.items()}
    return scores | known | {"n": len(pairs.time)}


def _statistics(errors: Array) -> dict[str, float] | None:
    """Percentiles, mean and maximum of errors; None without errors."""
    if not len(errors):
        return None
    p50, p75, p95 = np.percentile(errors, [50, 75, 95])
    summary = {"p50": p50, "p75": p75, "p95": p95, "mean": errors.mean(), "max": errors.max()}
    return {name: float(value) for name, value in summary.items()}


def coverage(estimate: Trajectory, truth: Trajectory) -> float | None:
    """Share 0-1 of the truth's samples inside the stated 90 % region; None without samples or covariance.

    The region is widened by the covariance of the truth, if it has one.
    """
    pairs = pair(estimate, truth)
    pairs = pairs.where(pairs.same_floor)
    if estimate.covariance is None or not len(pairs.time):
        return None
    covariance = stated_covariance(estimate, pairs.time)
    if truth.covariance is not None:
        covariance = covariance + np.nan_to_num(stated_covariance(truth, pairs.time))
    return float(np.mean(in_region(pairs, covariance)))


def stated_covariance(estimate: Trajectory, time: Array) -> Array:
    """Covariance ``(n, 2, 2)`` [m²] of the positions of an estimate that has one, at times ``(n,)`` [s]."""
    assert estimate.covariance is not None, "asked for with a covariance"
    return interpolate(time, estimate.time, estimate.covariance[:, :2, :2].reshape(-1, 4)).reshape(-1, 2, 2)


def in_region(pairs: Pairs, covariance: Array) -> Mask:
    """``(n,)`` True where the truth is in the 90 % region of ``covariance (n, 2, 2)`` about the estimate."""
    return squared_distance(pairs.estimate - pairs.truth, covariance) < REGION_90


def log_score(error: Array, covariance: Array) -> Array:
    """Logarithmic score ``(n,)`` [nats], smaller is better: -log of the stated Gaussian density [1/m²] at the truth.

    Gneiting and Raftery 2007, section 4.1, with the sign reversed. error: estimate minus truth ``(n, 2)`` [m];
    covariance: ``(n, 2, 2)`` [m²] of the estimate plus that of the truth, as the truth is measured with noise.
    """
    return 0.5 * (squared_distance(error, covariance) + np.log(np.linalg.det(2 * np.pi * covariance)))


def energy_score(error: Array, covariance: Array) -> Array:
    """Energy score ``(n,)`` [m], smaller is better: E|X - y| - E|X - X'| / 2 of X, X' as stated and the truth y.

    Gneiting and Raftery 2007, section 4.3, with the sign reversed. error, covariance: as for `log_score`. |z| is π/2
    times the mean of |u·z| over all directions u. So the score is π/2 times the mean over u of the CRPS of the normal
    distribution along u (their section 4.2), which has a closed form: no draws are needed.
    """
    from scipy.special import ndtr

    angle = np.arange(SCORED_DIRECTIONS) * np.pi / SCORED_DIRECTIONS
    along = np.column_stack([np.cos(angle), np.sin(angle)])
    sigma = np.sqrt(np.einsum("ki,nij,kj->nk", along, covariance, along))
    z = error @ along.T / sigma
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
    crps = sigma * (z * (2 * ndtr(z) - 1) + 2 * density - 1 / np.sqrt(np.pi))
    return 0.5 * np.pi * crps.mean(axis=1)


def error_text(error: Mapping[str, float | None]) -> str:
    """Percentiles of an error in `live` of ``summary.json``, and how often the truth was in the 90 % region."""
    text = " / ".join(f"{error[name]:.1f}" for name in ("p50", "p75", "p95")) + " m"
    return text if error["in_90"] is None else f"{text}, {100 * error['in_90']:.0f} % in the 90 % region"


def table(scores: dict[str, Any]) -> str:
    """The scores of ``evaluate`` as a text of one line per metric; headings in degrees."""
    lines = []
    for name, unit, score in (("ce", "[m]", scores["ce"]), ("he", "[°]", scores["he"])):
        factor = np.degrees(1.0) if name == "he" else 1.0
        values = "—" if score is None else "  ".join(f"{key} {factor * value:.3f}" for key, value in score.items())
        lines.append(f"{name.upper():4}{unit:6}{values}")
    for name, unit in (("eag", "[m/s]"), ("ve", "[m/s]"), ("ca", "[m]"), ("oe", "[-]"), ("fe", "[-]")):
        value = scores[name]
        lines.append(f"{name.upper():4}{unit:6}{'—' if value is None else f'{value:.4f}'}")
    return "\n".join([*lines, f"of {scores['n']} samples"])


RESULT = ("trajectory.csv", "summary.json")  # of an output folder of smooth and replay


@dataclass(frozen=True)
class Comparison(OneLineRepr):
    """Scores of several trajectories.

    reference: name of the truth, or of the first trajectory; scores: of ``evaluate`` by name, with ``distance`` [m] and
    ``duration`` [s]. They count equal samples only if ``n`` is the same.
    """

    reference: str
    scores: Mapping[str, Mapping[str, Any]]

    def _summary(self) -> list[str]:
        return [f"against {self.reference!r}", count(len(self.scores), "trajectory").replace("ys", "ies")]


def compare(
    tracks: Mapping[str, Trajectory], truth: Trajectory | None, reference: str = "", floor: Building | None = None
) -> Comparison:
    """Score each of several trajectories against the truth; without one, all others against the first.

    reference: name of the truth. Raises InputError if a trajectory has no sample at a time of the reference.
    """
    first = next(iter(tracks))
    against, name = (tracks[first], first) if truth is None else (truth, reference)
    scored = tracks if truth is not None else {other: track for other, track in tracks.items() if other != first}
    for other, track in scored.items():
        if not len(pair(track, against).time):
            span, expected = (f"{t[0]:.3f} to {t[-1]:.3f}" for t in (track.time, against.time))
            hint = clock_hint((track.time[0], track.time[-1]), (against.time[0], against.time[-1]))
            raise InputError(other, "time", f"{span}{hint}", f"times within {TOLERANCE} s of {name}, {expected}")
    scores = {other: scores_of_track(track, against, floor) for other, track in scored.items()}
    return Comparison(name, scores)


def scores_of_track(track: Trajectory, truth: Trajectory, floor: FloorPlan | Building | None) -> dict[str, Any]:
    """The scores of ``evaluate`` with ``distance`` [m] and ``duration`` [s] of a track.

    The floor score is None for a track without floor labels: those of dead reckoning and of TUM files say nothing.
    """
    distance = float(np.hypot(*np.diff(track.position, axis=0).T).sum())
    size = {"distance": round(distance, 3), "duration": round(float(np.ptp(track.time)), 3)}
    return size | evaluate(track, truth, floor) | ({} if any(track.floor) else {"fe": None})


@dataclass(frozen=True)
class Metric:
    """A number of `scores_of_track` in tables. key, statistic: its place in the scores; digits: after the point."""

    name: str
    unit: str
    digits: int
    key: str
    statistic: str = ""
    meaning: str = ""

    def text(self, scores: Mapping[str, Any]) -> str:
        """The number as text, headings in degrees; "" if unknown."""
        value = scores[self.key]
        value = value[self.statistic] if self.statistic and value is not None else value
        return "" if value is None else f"{np.degrees(value) if self.unit == '°' else value:.{self.digits}f}"


METRICS = (
    Metric("distance", "m", 1, "distance"),
    Metric("CE50", "m", 2, "ce", "p50", "median horizontal error"),
    Metric("CE75", "m", 2, "ce", "p75"),
    Metric("CE95", "m", 2, "ce", "p95"),
    Metric("CE max", "m", 2, "ce", "max"),
    Metric("HE50", "°", 1, "he", "p50", "median heading error"),
    Metric("EAG", "m/s", 4, "eag", "", "error accumulation gradient"),
    Metric("VE", "m/s", 3, "ve", "", "speed error"),
    Metric("CA", "m", 2, "ca", "", "distance of the most frequent error from 0"),
    Metric("OE", "", 4, "oe", "", "share of steps leaving the walkable area"),
    Metric("FE", "", 3, "fe", "", "share on the correct floor"),
    Metric("samples", "", 0, "n", "", "with ground truth"),
)


def comparison_table(comparison: Comparison) -> str:
    """The scores as a text: a row per trajectory, a column per metric; those that no row has are left out."""
    columns = [
        [f"{metric.name} [{metric.unit}]" if metric.unit else metric.name, *(text or "—" for text in texts)]
        for metric in METRICS
        if any(texts := [metric.text(scores) for scores in comparison.scores.values()])
    ]
    names = ["", *(one_line(name) for name in comparison.scores)]
    aligned = [[cell.ljust(max(map(len, names))) for cell in names]]
    aligned += [[cell.rjust(max(map(len, column))) for cell in column] for column in columns]
    lines = ["  ".join(cells).rstrip() for cells in zip(*aligned, strict=True)]
    return "\n".join([*lines, f"against {one_line(comparison.reference)}"])


def read_tracks(paths: Sequence[Path], frame: Mapping[str, Any] | None = None) -> dict[str, Trajectory]:
    """The trajectories of files and of output folders of ``smooth`` and ``replay``, by the shortest different names.

    frame: of other tracks beside them, as in ``summary.json``. Raises InputError if a file cannot be read, or if
    folders have different frames.
    """
    frames = {} if frame is None else {Path("the methods"): dict(frame)}
    tracks = {}
    for name, path in zip(_names_of(paths), paths, strict=True):
        file = path / RESULT[0] if path.is_dir() else path
        if path.is_dir() and not file.exists():
            expected = "an output folder of smooth or replay, or a trajectory as CSV or TUM"
            raise InputError(path, "", f"a folder without {RESULT[0]}", expected)
        tracks[name] = read_trajectory(file)
        with suppress(OSError, ValueError, KeyError, TypeError):  # a trajectory without a summary
            frames[path] = dict(json.loads(file.with_name(RESULT[1]).read_text(encoding="utf-8"))["frame"])
    for path, own in frames.items():
        first = next(iter(frames))
        if own != frames[first]:
            found = ", ".join(f"{key} {value}" for key, value in own.items())
            raise InputError(path, "frame", found, f"that of {first}: results with one plan, or with the same fixes")
    return tracks


def _names_of(paths: Sequence[Path]) -> list[str]:
    """A name of each path: its last part, or as many as make them different."""
    for parts in range(1, max((len(path.parts) for path in paths), default=1) + 1):
        names = ["/".join(path.parts[-parts:]) for path in paths]
        if len(set(names)) == len(names):
            return names
    twice = next(path for path in paths if paths.count(path) > 1)
    raise InputError(twice, "", "the same trajectory twice", "different trajectories")
