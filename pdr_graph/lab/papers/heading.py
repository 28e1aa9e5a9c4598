"""The experiment of [heading] (Hoshi et al. 2015): walking direction from a phone held in any of five ways.

Simulated walks replace the paper's 62 trials. Real phones, of whose walks the direction is known, show whether the
simulated ones are like them.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from pdr_graph.errors import InputError, install
from pdr_graph.gait.heading import Direction, forward_axis
from pdr_graph.gait.steps import gait_signals, uninterrupted
from pdr_graph.geometry import as_complex, interpolate, wrap_angle
from pdr_graph.inertial.attitude import Attitude, attitude_of
from pdr_graph.io.loading import load
from pdr_graph.lab.papers.attitude_filters import imu_filter
from pdr_graph.lab.papers.gait_methods import (
    PrincipalDirection,
    acceleration_axis,
    accumulate_turn,
    angular_rate_axis,
)
from pdr_graph.lab.papers.result_table import ResultTable
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Array, Mask, Recording, Signal

HOLDS = ("hand", "swinging arm", "trouser pocket", "breast pocket", "bag")
PUBLISHED = {  # Table 1: mean of the trials' root mean square errors [deg], by hold
    "acceleration PCA": (20.3, 21.3, 29.0, 44.6, 26.4),
    "angular-rate PCA": (55.7, 21.7, 27.3, 73.3, 50.0),
    "angular-rate accumulation": (11.8, 18.2, 24.9, 15.0, 15.4),
}
TRIALS, RATE = 62, 25.0  # of the experiment; [Hz] of the sensors
EXPERIMENTS = 10  # repetitions of the 62 trials, with other walkers
SEED = 100_000  # of the first trial
PART = 45.0  # [s] of a real walk that are evaluated: about the duration of a trial


def experiment(quick: bool = False, data: Path | None = None) -> tuple[ResultTable, ...]:
    """The tables of [heading]. quick: one experiment of 62 trials instead of ten.

    data: folder with the real recordings ``ridi``, ``ms_indoor20`` and ``ms_more``; default: $PDR_GRAPH_DATA. Missing
    ones have no rows.
    """
    experiments = 1 if quick else EXPERIMENTS
    trials = [[l_walk(n, of) for n in range(TRIALS)] for of in range(experiments)]
    reheld = [reheld_walk(n) for n in range(8 * experiments)]
    real = real_trials(data or Path(os.environ.get("PDR_GRAPH_DATA", "")))
    by_hold = {hold: [trial for each in trials for trial in each[n :: len(HOLDS)]] for n, hold in enumerate(HOLDS)}
    groups = _groups(by_hold, real)
    return (
        _table_1(trials, reheld),
        _readings(by_hold),
        _real_phones(groups),
        _movements(groups),
        _by_ratio(groups),
    )


# Sec. 5: trials


@dataclass(frozen=True)
class Trial:
    """A walk whose direction is known.

    recording: accelerometer and gyroscope at 25 Hz; time: ``(n,)`` [s]; heading: ``(n,)`` true walking direction, not
    wrapped [rad]; walking: ``(n,)`` True where it is evaluated.
    ahead: ``(3,)`` the true walking direction at the first evaluated sample, in device axes. By it the initial
    direction is given in the world of any attitude; the paper's D = W at the start does the same.
    """

    recording: Recording
    time: Array
    heading: Array
    walking: Mask
    ahead: Array


def l_walk(number: int, experiment: int = 0) -> Trial:
    """Trial ``number`` of 62 in an L-shaped corridor, west and then north; the holds take turns."""
    return walk(HOLDS[number % len(HOLDS)], seed=SEED + 100 * experiment + number // len(HOLDS))


def reheld_walk(number: int) -> Trial:
    """The same walk with the phone taken from the hand to another place half-way along the first leg, or back."""
    others = HOLDS[1:]
    holds = ("hand", others[number % 4])
    return walk(*(holds if number % 8 < 4 else holds[::-1]), seed=SEED + number)


def walk(hold: str, new_hold: str = "", seed: int = 0) -> Trial:
    """A simulated walk along the L of 36 m and 26 m. new_hold: of the phone after 17 m, "" for no change."""
    first = [{"to": [[20.0, 1.2]], "hold": new_hold}] if new_hold else []
    route = [[37.0, 1.2], {"stand": 3}, *first, {"to": [[1.2, 1.2], [1.2, 27.0]]}, {"stand": 3}]
    made = simulate(Scenario.of({"seed": seed, "route": route, "phone": {"hold": hold, "rate": RATE}}))
    body, walking = made.body, made.body.step_length > 0.3
    recording = made.recording("accelerometer", "gyroscope")
    return _with_pose(recording, body.time, body.heading, walking, made.motion.R_world_device)


def _with_pose(recording: Recording, time: Array, heading: Array, walking: Mask, pose: Rotation) -> Trial:
    """A trial of a phone whose attitude ``pose (n,)`` in the true world is known."""
    first = int(np.argmax(walking))
    ahead = pose[first].inv().apply([np.cos(heading[first]), np.sin(heading[first]), 0.0])
    return Trial(recording, time, heading, walking, ahead)


# Sec. 4: directions by each method


def _of_paper(method: Callable[[Attitude, float], Direction], recording: Recording) -> tuple[Attitude, Direction]:
    """Attitude by the paper's choice, the IMU filter, and direction by one of its methods."""
    attitude = imu_filter(recording)
    return attitude, method(attitude, 0.0)


def _of_package(recording: Recording) -> tuple[Attitude, Direction]:
    """Attitude and direction of this package."""
    gait = gait_signals(recording)[0]
    return gait.attitude, gait.direction


@dataclass(frozen=True)
class AbsoluteDirection(Direction):
    """A direction that needs no initial direction: headings in the world of the attitude."""


def _of_gait(recording: Recording) -> tuple[Attitude, Direction]:
    """The same with the initial direction by the gait: no direction is given."""
    gait = gait_signals(recording)[0]
    heading = gait.direction.heading
    ahead = forward_axis(gait.attitude, heading, gait.walking, gait.landings.usual_step)
    return gait.attitude, AbsoluteDirection(heading + ahead.angle, gait.direction.variance)


def _with_better_attitude(recording: Recording) -> tuple[Attitude, Direction]:
    """Acceleration PCA with the attitude of this package, by VQF forwards and backwards."""
    attitude = attitude_of(recording)
    return attitude, acceleration_axis(attitude, 0.0)


Method = Callable[[Recording], tuple[Attitude, Direction]]
METHODS: dict[str, Method] = {
    "acceleration PCA": partial(_of_paper, acceleration_axis),
    "angular-rate PCA": partial(_of_paper, angular_rate_axis),
    "angular-rate accumulation": partial(_of_paper, accumulate_turn),
    "pdr_graph": _of_package,
    "pdr_graph, no initial direction": _of_gait,
}


def errors(trial: Trial, method: Method) -> Array:
    """Errors ``(m,)`` of the direction at the evaluated samples, not wrapped. [deg]"""
    attitude, direction = method(trial.recording)
    truth = np.interp(attitude.time, trial.time, trial.heading)
    evaluated = np.interp(attitude.time, trial.time, trial.walking) > 0.5
    first = int(np.argmax(evaluated))
    x, y, _ = attitude.R_world_device[first].apply(trial.ahead)
    truth += np.arctan2(y, x) - truth[first]  # in the world of the attitude
    heading = direction.heading
    if isinstance(direction, PrincipalDirection):  # of the two sides of the axis the one nearer to the given direction
        heading = heading + direction.axis
        heading = heading + np.pi * np.round((truth[first] - heading[first]) / np.pi)
    elif isinstance(direction, AbsoluteDirection):
        heading = heading + 2 * np.pi * np.round((truth[first] - heading[first]) / (2 * np.pi))
    else:
        heading = heading + truth[first] - heading[first]
    return np.degrees(heading - truth)[evaluated]


def rms(values: Array) -> float:
    """Root mean square, Eq. (2)."""
    return float(np.sqrt(np.mean(values**2)))


def without_half_turns(error: Array) -> Array:
    """The error of an axis whose side is known: within ±90°. [deg]"""
    return (error + 90) % 180 - 90


# Sec. 5.1: Table 1, and the extremes of Figs. 12 and 13


def _table_1(experiments: Sequence[Sequence[Trial]], reheld: Sequence[Trial]) -> ResultTable:
    """Mean of the trials' root mean squares by method and hold, and their extremes."""
    rows = list[tuple[str, ...]]()
    for name, method in METHODS.items():
        found = [[[] for _ in HOLDS] for _ in experiments]  # of each experiment and hold, the errors of its trials
        for of, trials in zip(found, experiments, strict=True):
            for n, trial in enumerate(trials):
                of[n % len(HOLDS)].append(errors(trial, method))
        again = f"{np.mean([rms(errors(trial, method)) for trial in reheld]):.1f}"
        means = np.array([[np.mean([rms(e) for e in of_hold]) for of_hold in of] for of in found])
        pooled = [[e for of in found for e in of[n]] for n in range(len(HOLDS))]
        published = [f" ({p})" for p in PUBLISHED[name]] if name in PUBLISHED else [""] * len(HOLDS)
        mean = [f"{m:.1f}{p}" for m, p in zip(means.mean(axis=0), published, strict=True)]
        rows.append((name, *mean, again))
        if len(experiments) > 1:
            ranges = (f"{a:.0f} to {b:.0f}" for a, b in zip(means.min(axis=0), means.max(axis=0), strict=True))
            rows.append(("– least and greatest of the experiments", *ranges, ""))
        rows.append(("– median of the trials", *(f"{np.median([rms(e) for e in of]):.1f}" for of in pooled), ""))
        for label, extreme in (("greatest", np.max), ("least", np.min)):
            cells = (f"{np.mean([extreme(np.abs(e)) for e in of]):.1f}" for of in pooled)
            rows.append((f"– {label} error of a trial, mean", *cells, ""))
    return ResultTable(
        "heading",
        f"Walking direction by hold, root mean square error ([heading] Table 1, Eq. 2, Figs. 12 and 13); "
        f"{len(experiments)} x {TRIALS} simulated trials",
        ("RMS [deg] (paper)", *HOLDS, "re-held in mid-walk"),
        tuple(rows),
        "As in the paper: IMU filter, 25 Hz, 65 samples, initial direction given, errors not wrapped. Its text takes three "
        "components, its Fig. 6 two; here two, see the next table. Evaluated while walking.",
    )


# Readings of the paper


def _readings(by_hold: dict[str, list[Trial]]) -> ResultTable:
    """Root mean squares by what the paper leaves open."""
    rows = list[tuple[str, ...]]()

    def row(label: str, method: Method, view: Callable[[Array], Array] = lambda error: error) -> None:
        cells = (np.mean([rms(view(errors(trial, method))) for trial in trials]) for trials in by_hold.values())
        rows.append((label, *(f"{cell:.1f}" for cell in cells)))

    for name, axis in (("acceleration PCA", acceleration_axis), ("angular-rate PCA", angular_rate_axis)):
        level = METHODS[name]
        row(f"{name}, level components, not wrapped (first table)", level)
        row("– three components, as the text has it", partial(_of_paper, partial(axis, axes=3)))
        row("– errors wrapped to ±180°", level, lambda error: (error + 180) % 360 - 180)
        row("– half turns removed: the error of the axis alone", level, without_half_turns)
    row("acceleration PCA, attitude of pdr_graph, half turns removed", _with_better_attitude, without_half_turns)
    published = (("paper, " + name, *map(str, PUBLISHED[name])) for name in list(PUBLISHED)[:2])
    return ResultTable(
        "heading-readings",
        "What the paper leaves open: mean RMS [deg] of the same simulated trials ([heading] Secs. 4.1, 4.2, Eq. 2)",
        ("reading", *HOLDS),
        (*rows, *published),
        "No reading comes near the paper in the hand and the breast pocket: the axis itself is wrong there.",
    )


# Real phones


def real_trials(data: Path) -> dict[str, list[Trial]]:
    """Real walks by data set and carrying."""
    places = {"handheld": "hand", "leg": "trouser pocket", "body": "at the body", "bag": "bag"}
    trials: dict[str, list[Trial]] = {}
    for path in sorted((data / "ridi").glob("*.xlsx")):
        carried = next(place for word, place in places.items() if word in path.stem)
        if path.stem not in SIDEWAYS:
            trials.setdefault(f"RIDI, {carried}", []).append(_ridi(path))
    for folder in ("ms_indoor20", "ms_more"):
        for path in sorted((data / folder).glob("site*/*/*.txt")):
            trials.setdefault("Microsoft, hand", []).extend(_microsoft(path))
    return trials


SIDEWAYS = ("hang_handheld_side_test2", "hang_body_test1")  # whose walkers go sideways, or turn for seconds: data page
SLOWEST = 0.5  # [m/s] at which a real walker walks


def _ridi(path: Path) -> Trial:
    """A walk of RIDI: position and attitude by a visual-inertial device."""
    try:
        from python_calamine import CalamineWorkbook
    except ImportError:
        raise InputError(path, "", "a workbook", install("bench")) from None
    head, *rows = CalamineWorkbook.from_path(path).get_sheet_by_index(0).to_python()
    columns = dict(zip(head, zip(*rows, strict=True), strict=True))

    def columns_of(name: str, axes: str = "xyz") -> Array:
        return np.array([columns[f"{name}_{axis}"] for axis in axes], dtype=float).T

    time = np.array(columns["time"], dtype=float)
    recording = Recording(
        path,
        clock_origin=0.0,
        epoch=None,
        accelerometer=Signal(time, columns_of("acce")),
        gyroscope=Signal(time, columns_of("gyro")),
    )
    grid, recording = _at_25_hz(recording)
    position = gaussian_filter1d(interpolate(grid, time, columns_of("pos", "xy")), 0.5 * RATE, axis=0)
    velocity = as_complex(np.gradient(position, 1 / RATE, axis=0))
    pose = Slerp(time, Rotation.from_quat(columns_of("ori", "xyzw")))(grid)
    walking = _first_part(grid, np.abs(velocity) > SLOWEST)
    return _with_pose(recording, grid, np.unwrap(np.angle(velocity)), walking, pose)


def _microsoft(path: Path) -> Iterator[Trial]:
    """A walk of Microsoft's competition between surveyed waypoints, the phone held flat before the body: y is ahead.

    Its direction is that from one waypoint to the next; full turns by the gyroscope. None if there are 20 s of it.
    """
    walk = uninterrupted(load(path))[0]
    truth, leg = walk.truth, np.diff(as_complex(walk.truth.position))
    if len(leg) < 2:
        return
    grid, recording = _at_25_hz(walk)
    attitude, direction = _of_package(recording)
    middle = np.interp((truth.time[1:] + truth.time[:-1]) / 2, attitude.time, direction.heading)
    turn = wrap_angle(np.diff(np.angle(leg)))
    turn = turn + 2 * np.pi * np.round((np.diff(middle) - turn) / (2 * np.pi))
    heading = np.angle(leg[0]) + np.concatenate([[0.0], np.cumsum(turn)])
    at = np.clip(np.searchsorted(truth.time, grid) - 1, 0, len(leg) - 1)
    walked = (np.abs(leg) > 2.0) & (np.abs(leg) / np.diff(truth.time) > SLOWEST)
    walking = _first_part(grid, walked[at] & (grid >= truth.time[0]) & (grid <= truth.time[-1]))
    if walking.sum() >= 20 * RATE:
        yield Trial(recording, grid, heading[at], walking, np.array([0.0, 1.0, 0.0]))


def _at_25_hz(recording: Recording) -> tuple[Array, Recording]:
    """Times ``(n,)`` [s] of the paper's rate, and accelerometer and gyroscope sampled at them."""
    signals = {name: recording.signals[name] for name in ("accelerometer", "gyroscope")}
    begin, end = max(s.time[0] for s in signals.values()), min(s.time[-1] for s in signals.values())
    grid = np.arange(begin, end, 1 / RATE)
    sampled = {name: Signal(grid, interpolate(grid, s.time, s.values)) for name, s in signals.items()}
    return grid, Recording(recording.source, clock_origin=0.0, epoch=None, **sampled)


def _first_part(time: Array, walking: Mask) -> Mask:
    """``walking (n,)`` in its first 45 s."""
    return walking & (time < time[np.argmax(walking)] + PART)


@dataclass(frozen=True)
class Movement:
    """How a phone moves on straight parts of a walk.

    acceleration: ``(3,)`` fore-aft, lateral and vertical [m/s²]; rate: ``(3,)`` of roll (about the fore-aft axis),
    pitch and yaw [rad/s]; standard deviations without what is slower than a stride.
    """

    acceleration: Array
    rate: Array

    @property
    def fore_aft(self) -> float:
        """Fore-aft by lateral acceleration: acceleration PCA needs more than 1."""
        return float(self.acceleration[0] / self.acceleration[1])

    @property
    def pitch(self) -> float:
        """Rate of pitch by that of roll: angular-rate PCA needs more than 1."""
        return float(self.rate[1] / self.rate[0])


def movement(trial: Trial) -> Movement:
    """The movement of the phone in a trial, in axes of the walker by the direction of this package."""
    attitude, direction = _of_package(trial.recording)
    evaluated = np.interp(attitude.time, trial.time, trial.walking) > 0.5
    first = int(np.argmax(evaluated))
    x, y, _ = attitude.R_world_device[first].apply(trial.ahead)
    heading = direction.heading - direction.heading[first] + np.arctan2(y, x)
    turning = np.abs(gaussian_filter1d(np.gradient(direction.heading, attitude.period), 0.5 * RATE))
    straight = evaluated & (turning < np.radians(15))

    def spread(vectors: Array) -> Array:
        world = attitude.R_world_device.apply(vectors)
        level = as_complex(world) * np.exp(-1j * heading)
        axes = np.stack([level.real, level.imag, world[:, 2]], axis=1)
        return np.std((axes - gaussian_filter1d(axes, 1.3 * RATE, axis=0))[straight], axis=0)

    return Movement(spread(attitude.acceleration), spread(attitude.angular_rate))


BESIDE = {  # a simulated hold and the real phones carried like it
    "hand": ("Microsoft, hand", "RIDI, hand"),
    "trouser pocket": ("RIDI, trouser pocket",),
    "breast pocket": ("RIDI, at the body",),
    "bag": ("RIDI, bag",),
}


def _groups(by_hold: dict[str, list[Trial]], real: dict[str, list[Trial]]) -> dict[str, list[Trial]]:
    """Trials by how the phone is carried, simulated ones before real ones."""
    groups = dict[str, list[Trial]]()
    for hold, others in BESIDE.items():
        groups[f"simulated, {hold}"] = by_hold[hold]
        groups |= {name: real[name] for name in others if name in real}
    return groups


def _real_phones(groups: dict[str, list[Trial]]) -> ResultTable:
    """Errors of every method by real phones beside simulated ones."""
    rows = list[tuple[str, ...]]()
    for name, trials in groups.items():
        cells = [name, str(len(trials))]
        for method in list(METHODS.values())[:4]:
            found = [errors(trial, method) for trial in trials]
            cells.append(f"{np.mean([rms(e) for e in found]):.1f}")
            if method in (METHODS["acceleration PCA"], METHODS["angular-rate PCA"]):
                cells.append(f"{np.mean([rms(without_half_turns(e)) for e in found]):.1f}")
        rows.append(tuple(cells))
        if (hold := name.removeprefix("simulated, ")) in HOLDS:
            acceleration, rate, accumulation = (p[HOLDS.index(hold)] for p in PUBLISHED.values())
            rows.append((f"paper, {hold}", "", f"{acceleration}", "", f"{rate}", "", f"{accumulation}", ""))
    header = ("phones", "walks", "acceleration PCA", "– its axis", "angular-rate PCA", "– its axis")
    return ResultTable(
        "heading-real",
        "Real phones beside simulated ones: mean RMS [deg], not wrapped; axis: half turns removed",
        (*header, "accumulation", "pdr_graph"),
        tuple(rows),
        "The same methods at 25 Hz on the first 45 s of each real walk, initial direction given. Truth of RIDI: camera, "
        "loops of four to eight corners. Truth of Microsoft: course between waypoints, constant on each leg, initial "
        "direction the phone's y axis; so the row of accumulation says how good this truth is.",
    )


def _movements(groups: dict[str, list[Trial]]) -> ResultTable:
    """How phones move, simulated and real."""
    rows = list[tuple[str, ...]]()
    for name, trials in groups.items():
        of = [movement(trial) for trial in trials]
        acceleration, rate = (np.mean([getattr(m, what) for m in of], axis=0) for what in ("acceleration", "rate"))
        cells = [f"{v:.2f}" for v in (*acceleration, *rate)]
        for ratio in ([m.fore_aft for m in of], [m.pitch for m in of]):
            low, middle, high = np.percentile(ratio, [5, 50, 95])
            cells.append(f"{middle:.2f} ({low:.2f} to {high:.2f})")
        rows.append((name, *cells))
    header = ("fore-aft [m/s²]", "lateral [m/s²]", "vertical [m/s²]", "roll [rad/s]", "pitch [rad/s]", "yaw [rad/s]")
    return ResultTable(
        "heading-movement",
        "How the phones move on straight parts: mean standard deviations; ratios: median (5 to 95 % of the walks)",
        ("phones", *header, "fore-aft / lateral", "pitch / roll"),
        tuple(rows),
    )


RATIOS = (0.0, 1.0, 1.25, 1.5, 1.75, 2.0, np.inf)


def _by_ratio(groups: dict[str, list[Trial]]) -> ResultTable:
    """Errors of the principal components by the ratio of the movements that they compare."""
    rows = list[tuple[str, ...]]()
    for kind in ("simulated", "real"):
        pooled = [
            t
            for name, trials in groups.items()
            if name.startswith("simulated") == (kind == "simulated")
            for t in trials
        ]
        columns = list[list[str]]()
        for method, ratio in (("acceleration PCA", "fore_aft"), ("angular-rate PCA", "pitch")):
            found = np.array([rms(errors(trial, METHODS[method])) for trial in pooled])
            at = np.digitize([getattr(movement(trial), ratio) for trial in pooled], RATIOS) - 1
            within = (found[at == n] for n in range(len(RATIOS) - 1))
            columns.append([f"{e.mean():.1f} ({len(e)})" if len(e) else "" for e in within])
        for low, high, *cells in zip(RATIOS, RATIOS[1:], *columns, strict=False):
            rows.append((kind, f"{low:g} to {high:g}" if np.isfinite(high) else f"over {low:g}", *cells))
    return ResultTable(
        "heading-by-ratio",
        "Mean RMS [deg] (walks) of the principal components by the ratio of the movements that they compare",
        ("phones", "ratio", "acceleration PCA, by fore-aft / lateral", "angular-rate PCA, by pitch / roll"),
        tuple(rows),
    )
