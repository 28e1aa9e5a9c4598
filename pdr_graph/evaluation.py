"""How good a trajectory is: the metrics of the PDR Benchmark Standardization Committee (draft ISO/IEC 21134).

Each metric is one function of paired samples. CE, HE, EAG and VE equal the committee's evaluation-tools under
``nearest`` pairing; ``docs/accuracy.md`` says where CA and OE follow the definition and the tool does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pdr_graph.errors import expect
from pdr_graph.floor.building import Building
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import interpolate, nearest, rotation, wrap_angle
from pdr_graph.types import Array, Mask, Trajectory

TOLERANCE = 0.5  # [s] between a truth sample and the estimate paired with it
SPEED_WINDOW = 0.5  # [s] to either side
SHORTEST_ELAPSED = 1.0  # [s] from the nearer end, below which EAG divides by too little
MOST_KERNELS = 1000
MOST_SHIFTS, SETTLED = 500, 1e-6  # of the mode; in kernel widths
FLAT = 1e-12  # ratio of variances of errors that are on one line
ANOTHER_CLOCK = 86_400.0  # [s] between a truth and an estimate of one walk: Unix times beside those from its start


@dataclass(frozen=True)
class Pairs:
    """Truth samples and the estimate at the same time: time ``(n,)``, positions ``(n, 2)``, headings ``(n,)``, floors.

    start, end: of the truth, [s].
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
        """The pairs with ``mask (n,)``."""
        columns: dict[str, Any] = {n: value[mask] for n, value in vars(self).items() if isinstance(value, np.ndarray)}
        return replace(self, **columns)

    @property
    def same_floor(self) -> Mask:
        """``(n,)`` False where both floors are known and differ."""
        known = (self.truth_floor != "") & (self.estimate_floor != "")
        return ~known | (self.truth_floor == self.estimate_floor)


def pair(estimate: Trajectory, truth: Trajectory, pairing: str = "linear") -> Pairs:
    """Give each truth sample its estimate; samples with none within 0.5 s are left out.

    pairing: ``linear`` interpolates between the estimate's rows, as our trajectories are meant (at most 0.5 s beyond
        its ends: the end's row); ``nearest`` takes the row nearest in time, the earlier of two, as the tools do.
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
    floors = np.array(estimate.floor, dtype=object)[row]
    everything = Pairs(
        t,
        truth.position,
        position,
        truth.heading,
        heading,
        np.array(truth.floor, dtype=object),
        floors,
        float(t[0]),
        float(t[-1]),
    )
    return everything.where(within)


def circular_error(pairs: Pairs) -> Array:
    """CE ``(n,)`` [m]: horizontal distance."""
    return np.hypot(*(pairs.estimate - pairs.truth).T)


def heading_error(pairs: Pairs) -> Array:
    """HE ``(n,)`` [rad]: absolute heading difference, of samples whose headings are known."""
    error = np.abs(wrap_angle(pairs.estimate_heading - pairs.truth_heading))
    return error[np.isfinite(error)]


def error_accumulation_gradient(pairs: Pairs) -> Array:
    """EAG ``(n,)`` [m/s]: error over the time to the nearer end of the stretch without absolute position.

    The stretch is the whole truth, s to f: EAG = CE / min(t − s, f − t). Samples nearer than 1 s to an end, where it
    divides by too little, are left out. The error at s is not subtracted.
    """
    elapsed = np.minimum(pairs.time - pairs.start, pairs.end - pairs.time)
    used = elapsed >= SHORTEST_ELAPSED
    return circular_error(pairs)[used] / elapsed[used]


def velocity_error(pairs: Pairs) -> Array:
    """VE ``(n,)`` [m/s]: |speed of the truth − speed of the estimate|, each the mean over t ± 0.5 s.

    As in the committee's tool, speeds are between paired samples and the first sample's is 0.
    """
    return np.abs(_speed(pairs.time, pairs.truth) - _speed(pairs.time, pairs.estimate))


def _speed(time: Array, position: Array) -> Array:
    way = np.hypot(*np.diff(position, axis=0, prepend=position[:1]).T)
    speed = way / np.diff(time, prepend=time[0] - 1.0)
    total = np.concatenate([[0.0], np.cumsum(speed)])
    first = np.searchsorted(time, time - SPEED_WINDOW, side="left")
    last = np.searchsorted(time, time + SPEED_WINDOW, side="right")
    return (total[last] - total[first]) / (last - first)


def circular_accuracy(pairs: Pairs) -> float:
    """CA [m]: distance from 0 of the most frequent error, in the walker's own axes (forward, left).

    The mode of a Gaussian kernel density of the errors (of a thousand of them, evenly taken, where there are more).
    NaN with fewer than three samples, or where headings are unknown.
    """
    known = np.isfinite(pairs.estimate_heading)
    turned = rotation(-pairs.estimate_heading[known])
    errors = np.einsum("nij,nj->ni", turned, (pairs.truth - pairs.estimate)[known])
    if len(errors) < 3:
        return float("nan")
    return float(np.hypot(*_mode(errors[:: -(-len(errors) // MOST_KERNELS)])))


def _mode(points: Array) -> Array:
    """The densest place ``(2,)`` of some points ``(n, 2)``: mean shift (Fukunaga and Hostetler 1975) from the densest
    of them, kernels as wide as Scott's rule says. Their mean where all are on one line.
    """
    width = np.cov(points.T) * len(points) ** (-1 / 3)
    variance, axes = np.linalg.eigh(width)
    if variance[0] <= FLAT * variance[1]:
        return points.mean(axis=0)
    white = points @ axes / np.sqrt(variance)
    square = np.sum(white**2, axis=1)
    apart = square[:, None] + square - 2 * white @ white.T
    place = white[np.argmax(np.exp(-0.5 * apart).sum(axis=1))]
    for _ in range(MOST_SHIFTS):
        before, weight = place, np.exp(-0.5 * np.sum((white - place) ** 2, axis=1))
        place = weight @ white / weight.sum()
        if np.hypot(*(place - before)) < SETTLED:
            break
    return axes @ (place * np.sqrt(variance))


def obstacle_error(estimate: Trajectory, floor: FloorPlan | Building) -> float:
    """OE, 0–1: share of rows from which the way to the next leaves the walkable area of its floor."""
    rows = np.append(np.arange(len(estimate)), len(estimate) - 1)
    labels = [estimate.floor[row] for row in rows.tolist()]
    return float(np.mean(Building.around(floor).crosses_wall(estimate.position[rows], labels)))


def floor_share(pairs: Pairs) -> float:
    """FE, 0–1: share of samples on the right floor, of those whose true floor is known; NaN if none is."""
    known = pairs.truth_floor != ""
    return float(np.mean(pairs.truth_floor[known] == pairs.estimate_floor[known])) if known.any() else float("nan")


def evaluate(
    estimate: Trajectory, truth: Trajectory, floor: FloorPlan | Building | None = None, pairing: str = "linear"
) -> dict[str, Any]:
    """All metrics, as ``pdr-graph evaluate --json`` prints them; None where one cannot be computed.

    estimate, truth: in one frame and one clock; floor: the plan, for what needs its walls; pairing: "linear" or
    "nearest", see `pair`. CE, EAG and CA are of samples on the right floor, as far as floors are known; ``n``, how
    many samples of the truth have an estimate, may be 0. Raises ValueError if the clocks differ.
    """
    expect("evaluate, estimate", estimate, Trajectory, instead="smooth(graph).trajectory")
    expect("evaluate, truth", truth, Trajectory, instead="read_trajectory(path, recording)")
    expect("evaluate, floor", floor, FloorPlan, Building, None, instead="FloorPlan.load(path)")
    pairs = pair(estimate, truth, pairing)
    if not len(pairs.time) and abs(truth.time[0] - estimate.time[0]) > ANOTHER_CLOCK:
        found, expected = (f"{t[0]:.3f} to {t[-1]:.3f} s" for t in (truth.time, estimate.time))
        raise ValueError(f"evaluate, truth: found times {found}, expected the same clock as the estimate's, {expected}")
    on_floor = pairs.where(pairs.same_floor)
    return {
        "ce": _statistics(circular_error(on_floor)),
        "he": _statistics(heading_error(pairs)),
        "eag": _median(error_accumulation_gradient(on_floor)),
        "ve": _median(velocity_error(pairs)) if len(pairs.time) else None,
        "ca": _or_none(circular_accuracy(on_floor)),
        "oe": None if floor is None else obstacle_error(estimate, floor),
        "fe": _or_none(floor_share(pairs)),
        "n": len(pairs.time),
    }


def _statistics(errors: Array) -> dict[str, float] | None:
    if not len(errors):
        return None
    p50, p75, p95 = np.percentile(errors, [50, 75, 95])
    summary = {"p50": p50, "p75": p75, "p95": p95, "mean": errors.mean(), "max": errors.max()}
    return {name: float(value) for name, value in summary.items()}


def _median(values: Array) -> float | None:
    return float(np.median(values)) if len(values) else None


def _or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None


def table(scores: dict[str, Any]) -> str:
    """The scores of ``evaluate`` for people to read."""

    def row(name: str, unit: str, statistics: dict[str, float] | None) -> str:
        values = "—" if statistics is None else "  ".join(f"{k} {v:.3f}" for k, v in statistics.items())
        return f"{name:4}{unit:6}{values}"

    lines = [row("CE", "[m]", scores["ce"]), row("HE", "[rad]", scores["he"])]
    for name, unit in (("eag", "[m/s]"), ("ve", "[m/s]"), ("ca", "[m]"), ("oe", "[-]"), ("fe", "[-]")):
        value = scores[name]
        lines.append(f"{name.upper():4}{unit:6}{'—' if value is None else f'{value:.4f}'}")
    return "\n".join([*lines, f"of {scores['n']} samples"])
