"""The experiment of [heading] (Hoshi et al. 2015): walking direction from a phone held in any of five ways.

Simulated walks replace the paper's 62 trials. Real phones, of whose walks the direction is known, show whether the
simulated ones are like them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from pdr_graph.gait.heading import Direction, forward_axis
from pdr_graph.gait.steps import gait_signals, uninterrupted
from pdr_graph.geometry import as_complex, interpolate
from pdr_graph.inertial.attitude import Attitude, required, runs
from pdr_graph.io.loading import load
from pdr_graph.io.tables import workbook_columns
from pdr_graph.lab.papers.attitude_filters import imu_filter
from pdr_graph.lab.papers.gait_methods import (
    PRINCIPAL_WINDOW,
    PrincipalDirection,
    acceleration_axis,
    accumulate_turn,
    angular_rate_axis,
)
from pdr_graph.lab.papers.result_table import FIRST_SEED, ResultTable
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Array, Mask, Recording, Signal

CARRIED = ("hand", "swinging arm", "trouser pocket", "breast pocket", "bag")
TABLE_1 = {  # Table 1: mean of the trials' root mean square errors [deg], by hold
    "acceleration PCA": (20.3, 21.3, 29.0, 44.6, 26.4),
    "angular-rate PCA": (55.7, 21.7, 27.3, 73.3, 50.0),
    "angular-rate accumulation": (11.8, 18.2, 24.9, 15.0, 15.4),
}
TRIALS, SENSOR_RATE = 62, 25.0  # of the experiment; [Hz] of the sensors
EXPERIMENTS = 10  # repetitions of the 62 trials, with other walkers
PART_DURATION = 45.0  # [s] of a real walk that are evaluated: about the duration of a trial


def experiment(quick: bool = False, data: Path | None = None) -> tuple[ResultTable, ...]:
    """The tables of [heading]. quick: one experiment of 62 trials instead of ten.

    data: folder with the real recordings ``ridi``, ``ms_indoor20`` and ``ms_more``; those that are not there have no
    rows.
    """
    experiments = [[l_walk(n, repetition) for n in range(TRIALS)] for repetition in range(1 if quick else EXPERIMENTS)]
    reheld = [reheld_walk(n) for n in range(8 * len(experiments))]
    by_hold = {hold: [t for trials in experiments for t in trials[n :: len(CARRIED)]] for n, hold in enumerate(CARRIED)}
    groups = _simulated_and_real(by_hold, real_trials(data) if data else {})
    return _table_1(experiments, reheld), _real_phones(groups)


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
    return walk(CARRIED[number % len(CARRIED)], seed=FIRST_SEED + 100 * experiment + number // len(CARRIED))


def reheld_walk(number: int) -> Trial:
    """The same walk with the phone taken from the hand to another place half-way along the first leg, or back."""
    others = CARRIED[1:]
    holds = ("hand", others[number % 4])
    return walk(*(holds if number % 8 < 4 else holds[::-1]), seed=FIRST_SEED + number)


def walk(hold: str, new_hold: str = "", seed: int = 0) -> Trial:
    """A simulated walk along the L of 36 m and 26 m. new_hold: of the phone after 17 m, "" for no change."""
    first = [{"to": [[20.0, 1.2]], "hold": new_hold}] if new_hold else []
    route = [[37.0, 1.2], {"stand": 3}, *first, {"to": [[1.2, 1.2], [1.2, 27.0]]}, {"stand": 3}]
    made = simulate(Scenario.of({"seed": seed, "route": route, "phone": {"hold": hold, "rate": SENSOR_RATE}}))
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
    """Attitude and direction of this package, with the initial direction by the gait: none is given."""
    gait = gait_signals(recording)[0]
    heading = gait.direction.heading
    ahead = forward_axis(gait.attitude, heading, gait.walking, gait.landings.usual_step)
    return gait.attitude, AbsoluteDirection(heading + ahead.angle, gait.direction.variance)


Method = Callable[[Recording], tuple[Attitude, Direction]]
READINGS: dict[str, Method] = {
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
    """Mean of the trials' root mean square errors by method and hold, and their spread."""
    rows = list[tuple[str, ...]]()
    for name, method in READINGS.items():
        by_trial = [[errors(trial, method) for trial in trials] for trials in experiments]
        by_hold = [[e for trials in by_trial for e in trials[n :: len(CARRIED)]] for n in range(len(CARRIED))]
        published = [f" ({figure})" for figure in TABLE_1.get(name, ())] or [""] * len(CARRIED)
        means = (f"{_mean_rms(hold)}{figure}" for hold, figure in zip(by_hold, published, strict=True))
        rows.append((name, *means, _mean_rms([errors(trial, method) for trial in reheld])))
        if len(experiments) > 1:
            holds = range(len(CARRIED))
            means = np.array([[_mean_rms(trials[n :: len(CARRIED)]) for n in holds] for trials in by_trial])
            ranges = zip(means.astype(float).min(axis=0), means.astype(float).max(axis=0), strict=True)
            rows.append(("– range of the experiments", *(f"{low:.0f} to {high:.0f}" for low, high in ranges), ""))
        rows.append(("– median of the trials", *(f"{np.median([rms(e) for e in hold]):.1f}" for hold in by_hold), ""))
        for label, extreme in (("greatest", np.max), ("least", np.min)):
            cells = (f"{np.mean([extreme(np.abs(e)) for e in hold]):.1f}" for hold in by_hold)
            rows.append((f"– {label} absolute error, mean of the trials", *cells, ""))
    return ResultTable(
        "heading",
        f"Walking direction by hold: mean of the trials' RMS error [deg] ([heading] Table 1, Eq. 2, Figs. 12 and 13); "
        f"{len(experiments)} x {TRIALS} simulated trials",
        ("method (paper's figure)", *CARRIED, "re-held in mid-walk"),
        tuple(rows),
        "As in the paper: IMU filter, 25 Hz, windows of 65 samples, initial direction from the truth (the last "
        "method gets none). Principal components are of the level plane, as in Figs. 6 and 7. A half turn in a few "
        "trials decides a mean: the axis is undetermined where the fore-aft acceleration is less than 1.25 times the "
        "lateral one, as in many simulated hands and breast pockets.",
    )


def _mean_rms(trials: Sequence[Array]) -> str:
    """The mean of the trials' root mean square errors [deg] as a cell."""
    return f"{np.mean([rms(error) for error in trials]):.1f}"


# Real phones


def real_trials(data: Path) -> dict[str, list[Trial]]:
    """Real walks by data set and carrying."""
    places = {"handheld": "hand", "leg": "trouser pocket", "body": "at the body", "bag": "bag"}
    trials: dict[str, list[Trial]] = {}
    for path in sorted((data / "ridi").glob("*.xlsx")):
        carried = next(place for word, place in places.items() if word in path.stem)
        if path.stem not in SIDEWAYS:
            trials.setdefault(f"RIDI, {carried}", []).extend(_ridi(path))
    for folder in ("ms_indoor20", "ms_more"):
        for path in sorted((data / folder).glob("site*/*/*.txt")):
            trials.setdefault("Microsoft, hand", []).extend(_microsoft(path))
    return trials


SIDEWAYS = ("hang_handheld_side_test2", "hang_body_test1")  # whose walkers go sideways, or turn for seconds: data page
SLOWEST_WALK = 0.5  # [m/s]
TURNS_BACK = np.radians(135.0)  # [rad] within a window: more than the corner of an L


def _ridi(path: Path) -> Iterator[Trial]:
    """A walk of RIDI: position and attitude by a visual-inertial device."""
    columns = workbook_columns(path)

    def columns_of(name: str, axes: str = "xyz") -> Array:
        return np.stack([columns[f"{name}_{axis}"] for axis in axes], axis=1)

    time = columns["time"]
    grid, recording = _at_25_hz(path, Signal(time, columns_of("acce")), Signal(time, columns_of("gyro")))
    position = gaussian_filter1d(interpolate(grid, time, columns_of("pos", "xy")), 0.5 * SENSOR_RATE, axis=0)
    velocity = as_complex(np.gradient(position, 1 / SENSOR_RATE, axis=0))
    pose = Slerp(time, Rotation.from_quat(columns_of("ori", "xyzw")))(grid)
    yield from _evaluated(recording, grid, np.unwrap(np.angle(velocity)), np.abs(velocity) > SLOWEST_WALK, pose)


def _microsoft(path: Path) -> Iterator[Trial]:
    """A walk of Microsoft's competition, the phone held flat before the body: its y axis points ahead on average.

    The direction is that of this package. Waypoints are too close to each other and too inaccurate for a direction at
    each moment.
    """
    part = uninterrupted(load(path))[0]
    recording = _at_25_hz(path, required(part, "accelerometer"), required(part, "gyroscope"))[1]
    gait = gait_signals(recording)[0]
    attitude, heading = gait.attitude, gait.direction.heading
    y_axis = as_complex(attitude.R_world_device.apply([0.0, 1.0, 0.0]))
    heading = heading + np.angle(np.mean((y_axis * np.exp(-1j * heading))[gait.walking]))
    yield from _evaluated(recording, attitude.time, heading, gait.walking, attitude.R_world_device)


def _at_25_hz(path: Path, accelerometer: Signal, gyroscope: Signal) -> tuple[Array, Recording]:
    """Times ``(n,)`` [s] of the paper's rate, and a recording of both sensors sampled at them."""
    begin, end = max(accelerometer.time[0], gyroscope.time[0]), min(accelerometer.time[-1], gyroscope.time[-1])
    grid = np.arange(begin, end, 1 / SENSOR_RATE)
    force, rate = (Signal(grid, interpolate(grid, s.time, s.values)) for s in (accelerometer, gyroscope))
    return grid, Recording(str(path), clock_origin=0.0, epoch=None, accelerometer=force, gyroscope=rate)


def _evaluated(recording: Recording, time: Array, heading: Array, walking: Mask, pose: Rotation) -> Iterator[Trial]:
    """The trial of the first 45 s in which a real walker, as on an L, neither stops nor turns back; if there are 20 s.

    pose: attitude ``(n,)`` in the world of ``heading (n,)`` [rad].
    """
    half_window = round(PRINCIPAL_WINDOW / 2 * SENSOR_RATE)
    padded = np.pad(heading, half_window, mode="edge")
    turn = np.abs(padded[2 * half_window :] - padded[: -2 * half_window])  # within a window of the components
    for first, after in zip(*runs(walking & (turn < TURNS_BACK)), strict=True):
        if after - first >= 20 * SENSOR_RATE:
            part = (time >= time[first]) & (time < min(time[first] + PART_DURATION, time[after - 1]))
            yield _with_pose(recording, time, heading, part, pose)
            return


REAL_PHONES = {  # a simulated hold and the real phones carried like it
    "hand": ("Microsoft, hand", "RIDI, hand"),
    "trouser pocket": ("RIDI, trouser pocket",),
    "breast pocket": ("RIDI, at the body",),
    "bag": ("RIDI, bag",),
}


def _simulated_and_real(by_hold: dict[str, list[Trial]], real: dict[str, list[Trial]]) -> dict[str, list[Trial]]:
    """Trials by how the phone is carried, simulated ones before real ones."""
    groups = dict[str, list[Trial]]()
    for hold, others in REAL_PHONES.items():
        groups[f"simulated, {hold}"] = by_hold[hold]
        groups |= {name: real[name] for name in others if name in real}
    return groups


def _real_phones(groups: dict[str, list[Trial]]) -> ResultTable:
    """Errors of all methods by real phones beside simulated ones."""
    rows = list[tuple[str, ...]]()
    for name, trials in groups.items():
        cells = [name, str(len(trials))]
        for method in TABLE_1:
            by_trial = [errors(trial, READINGS[method]) for trial in trials]
            cells.append(_mean_rms(by_trial))
            if "PCA" in method:
                reversed_axis = np.mean([np.abs(error[-1]) > 90 for error in by_trial])
                cells += [_mean_rms([without_half_turns(e) for e in by_trial]), f"{100 * reversed_axis:.0f}"]
        package = "reference" if name.startswith("Microsoft") else _mean_rms([errors(t, _of_package) for t in trials])
        rows.append((*cells, package))
        if (hold := name.removeprefix("simulated, ")) in CARRIED:
            acceleration, rate, accumulation = (str(figures[CARRIED.index(hold)]) for figures in TABLE_1.values())
            rows.append((f"paper, {hold}", "", acceleration, "", "", rate, "", "", accumulation, ""))
    columns = ("– axis", "– reversed at the end [%]")
    return ResultTable(
        "heading-real",
        "The same methods with real phones: mean RMS [deg], not wrapped; axis: half turns removed",
        ("phones", "walks", "acceleration PCA", *columns, "angular-rate PCA", *columns, "accumulation", "pdr_graph"),
        tuple(rows),
        "The first 45 s (at least 20 s) of each real walk without a stop and without turning back, at 25 Hz. Truth "
        "of RIDI: a camera. Microsoft's waypoints give no direction at each moment: their reference is pdr_graph's "
        "direction by the same gyroscope, so it does not judge accumulation.",
    )
