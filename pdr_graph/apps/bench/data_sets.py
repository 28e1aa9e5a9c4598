"""The walks of each data set with what is known of them, and what an estimate is given.

A data set is a function of the folder of all data that yields the name of each walk and how to read it: one of
DATA_SETS, or ``module:function``. A path is a data set too: of the recordings in it that have a ``truth.csv``, as
``pdr-graph simulate`` writes them.
"""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pdr_graph.errors import InputError, one_line
from pdr_graph.floor.building import Building
from pdr_graph.frames import Frame, earth_field, enu
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import interpolate, rotation
from pdr_graph.inertial.units import BY_PLATFORM
from pdr_graph.io.indoor_location import WAYPOINT_SIGMA
from pdr_graph.io.tables import workbook_columns
from pdr_graph.options import Options
from pdr_graph.types import Array, Fixes, Index, OneLineRepr, Recording, Signal, Trajectory, UntimedFixes
from pdr_graph.walk import Evidence, read

GIVEN_SIGMA = 0.5  # [m] stated of a place of the truth that is given
DENSE = 2.0  # [s] between the rows of a truth that is a track, of which no second row can be given
SCORED_EVERY = 0.5  # [s] at which a track is scored


def no_truth() -> Trajectory:
    """The truth of a walk whose places are not known."""
    return Trajectory(np.empty(0), np.empty((0, 2)), np.empty(0))


@dataclass(frozen=True)
class BenchWalk(OneLineRepr):
    """A recording, and what is known of it for scores alone.

    evidence: as ``walk.read`` returns it; truth: in its frame, without rows if the places are not known; noise: of the
    truth, per axis [m]; steps, length: true number, and length [m], NaN if not known; plan: whose walls a track should
    not cross, None for that of the evidence.
    """

    evidence: Evidence
    truth: Trajectory = field(default_factory=no_truth)
    noise: float = 0.0
    steps: float = np.nan
    length: float = np.nan
    plan: Building | None = None


Walks = Iterator[tuple[str, Callable[[], BenchWalk]]]


def recorded(path: Path, options: Options, noise: float = 0.0) -> BenchWalk:
    """A recording that has its truth, in itself or in the file of the options."""
    evidence = read(path, options)
    return BenchWalk(evidence, evidence.truth or no_truth(), noise)


def malls(data: Path, folder: str = "ms_*") -> Walks:
    """Walks on 14 floors of two malls: waypoints, plans (Microsoft Indoor Location Competition 2.0)."""
    paths = {path.stem: path for path in sorted(data.glob(f"{folder}/site*/*/*.txt"), reverse=True)}  # one is in two
    for path in sorted(paths.values(), key=lambda path: path.parts[-3:]):
        name = f"{path.parent.parent.name}/{path.parent.name} {path.stem[:12]}"
        yield name, partial(recorded, path, Options(plan=path.parent), WAYPOINT_SIGMA)


def microsoft(data: Path) -> Walks:
    """Those of the malls on which the estimator was developed, five floors."""
    return malls(data, "ms_indoor20")


def museum(data: Path, folder: str = "ipin2023_*") -> Walks:
    """Trials in a museum: landmarks, GNSS, listed beacons (IPIN 2023, track 3)."""
    for path in sorted(data.glob(f"{folder}/*Trial*.txt"), key=lambda path: path.name):
        yield path.stem.removeprefix("IPIN2023_T3_Training"), partial(recorded, path, Options())


def ipin2023(data: Path) -> Walks:
    """Those of the museum on which the estimator was developed."""
    return museum(data, "ipin2023_track3")


def ipin21(data: Path) -> Walks:
    """A figure of eight on a plan: its surveyed places, and with simulated fixes its track (HCU Hamburg, IPIN 2021)."""
    folder = data / "ipin21_hcu"
    plan = folder / "map" / "Plan4OG.geojson"
    for path in sorted(folder.rglob("*_err*.csv"), key=lambda path: path.stem.lower()):
        yield path.stem, partial(recorded, folder / "eight", Options(plan=plan, fixes=path))
    if plan.exists():
        yield "landmarks", partial(_at_landmarks, folder / "eight", Options(plan=plan))


def _at_landmarks(path: Path, options: Options) -> BenchWalk:
    """The figure of eight with the rows of its truth when the walker was at the surveyed places."""
    walk = recorded(path, options)
    at = np.loadtxt(path / "ref.csv")[:, 0] / 1000 - walk.evidence.walk.clock_origin
    return replace(walk, truth=walk.truth[np.unique([np.argmin(np.abs(walk.truth.time - t)) for t in at])])


def apf(data: Path) -> Walks:
    """A walk of 270 m on bare CAD lines that ends where it began, its one known place (APF-PDR, ISPRS 2025)."""
    folder, place = data / "apf_pdr", np.array([8.0, 26.75])
    if folder.exists():
        yield "closed", partial(_closed, folder / "walk", Options(plan=folder / "cad_lines.csv", scale=4.3197), place)


def _closed(path: Path, options: Options, place: Array) -> BenchWalk:
    """A walk from a place ``(2,)`` [m] back to it."""
    evidence = read(path, options)
    (signal, *_) = evidence.walk.signals.values()
    return BenchWalk(evidence, Trajectory(signal.time[[0, -1]], np.stack([place, place]), np.full(2, np.nan)))


def nju(data: Path) -> Walks:
    """A campus by its GPS, which is its truth as well: give one in N s (Nanjing University, phyphox)."""
    if (path := data / "nju_phyphox_outdoor").exists():
        yield "campus", lambda: BenchWalk(read(path, Options()))


def ridi(data: Path) -> Walks:
    """A minute each in pocket, bag, hand and at the body, by a camera; with a magnetometer (RIDI, Yan et al. 2018)."""
    for path in sorted((data / "ridi").glob("*.xlsx")):
        yield path.stem, partial(_of_camera, path)


def strides(data: Path) -> Walks:
    """Walks of 0.3 to 1.5 m/s whose strides a sensor at the foot measured; no places."""
    for path in sorted((data / "strides").glob("*.txt")):
        yield path.stem.removeprefix("PDR_Raw_2018-10-"), partial(_of_foot_sensor, path)


OXFORD = {  # true counts of the data page
    "hand": ("user1_hand", 326),
    "trouser pocket": ("user1_frontpocket", 327),
    "bag": ("user1_bag", 346),
    "swinging arm, switch rises": ("SwingingArm", 284),
    "swinging arm, feet in turn": ("SwingingArm", 264),
}


def oxford(data: Path) -> Walks:
    """Counted steps, of an accelerometer alone (Oxford step counter data); no places."""
    folder = data / "oxford_steps"
    files = [*sorted(folder.glob("validation/*.csv")), *sorted(folder.glob("Pixel*"))]
    for name, (part, count) in OXFORD.items():
        for file in [file for file in files if part in file.name][:1]:
            yield name, partial(_counted, file, count)


DATA_SETS: Mapping[str, Callable[[Path], Walks]] = {
    each.__name__: each for each in (malls, microsoft, museum, ipin2023, ipin21, apf, nju, ridi, strides, oxford)
}


def walks_of(name: str, data: Path, beside: Path = Path()) -> Walks:
    """The walks of a data set in the folder of all data: one of DATA_SETS, ``module:function``, or of one's own folder
    ``beside / name``. Raises InputError if there are none.
    """
    folder = beside / name
    if name in DATA_SETS:
        expected = "its recordings, as python scripts/data.py fetches them, or --data"
        place, walks = data, list(DATA_SETS[name](data))
    elif folder.is_dir():
        place, expected, walks = folder, "recordings, each a folder with its truth.csv", list(_own(folder))
    elif ":" in name:
        place, expected, walks = data, "names and how to read each", list(function_of(name, "data_sets")(data))
    else:
        expected = f"one of {', '.join(DATA_SETS)}, module:function, or a folder of recordings with their truth.csv"
        raise InputError("data_sets", "", repr(name), expected)
    if not walks:
        raise InputError(place, name, "no walk", f"{expected} (docs/bench.md)")
    return iter(walks)


def function_of(name: str, place: str) -> Callable[..., Any]:
    """A function of one's own by its name ``module:function``. place: that has the name, for an error message.

    Raises InputError if it cannot be imported.
    """
    module, _, function = name.partition(":")
    if str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))  # behind the others: a copy.py there is not Python's
    try:
        return getattr(importlib.import_module(module.removesuffix(".py")), function)
    except (ImportError, AttributeError) as error:
        found = f"{name!r} ({one_line(str(error))})"
        raise InputError(place, "", found, "module:function, importable here") from None


def _own(folder: Path) -> Walks:
    """The recordings in a folder, each a folder with ``truth.csv``, and ``plan.geojson`` and ``fixes.csv`` if any."""
    for truth in sorted(folder.glob("*/truth.csv")):
        beside = {name: truth.with_name(name) for name in ("plan.geojson", "fixes.csv")}
        plan, fixes = (path if path.exists() else None for path in beside.values())
        yield truth.parent.name, partial(recorded, truth.parent, Options(plan=plan, fixes=fixes, truth=truth))


def _counted(file: Path, count: int) -> BenchWalk:
    return BenchWalk(read(file, Options()), steps=count)


def recording_of(name: str, time: Array, acceleration: Array, rate: Array) -> Recording:
    """A recording of an accelerometer ``(n, 3)`` [m/s²] with Android's sign and a gyroscope ``(n, 3)`` [rad/s]."""
    signals: dict[str, Any] = {"accelerometer": Signal(time, acceleration), "gyroscope": Signal(time, rate)}
    return Recording(name, 0.0, None, **signals, sign_odds=-BY_PLATFORM)


def _of_foot_sensor(path: Path) -> BenchWalk:
    """A walk of ``strides``; strides that its sensor merged are counted."""
    with path.open(encoding="utf-8") as file:
        rows = np.array([line.split()[1:] for line in file if line.startswith("test")], dtype=float)
    rows = rows[np.append(True, np.diff(rows[:, 9]) > 0)]
    length = rows[np.flatnonzero(np.diff(rows[:, 11]) > 0) + 1, 10]
    usual = np.median(length)
    whole = sum(max(1, round(each / usual)) for each in length[:-1].tolist())
    last = 2 if length[-1] > 0.75 * usual else 1
    recording = recording_of(path.name, (rows[:, 9] - rows[0, 9]) / 1000, rows[:, :3], rows[:, 3:6])
    return BenchWalk(_alone(recording), steps=2 * whole + last, length=float(rows[:, 12].max()))


RIDI_PLACE = 38.65, -90.31  # [deg] St. Louis, of its first author: the data state none; the dip of their field fits


def _of_camera(path: Path) -> BenchWalk:
    """A walk of ``ridi``, East-North.

    The camera's track has no north: it is turned so that the field that the phone measures along it points there on
    average. So an error of the compass that is constant over a walk does not show.
    """
    column = workbook_columns(path)
    time = column["time"] - column["time"][0]
    acceleration, rate, field, position, attitude = (
        np.column_stack([column[f"{name}_{axis}"] for axis in axes])
        for name, axes in (("acce", "xyz"), ("gyro", "xyz"), ("magnet", "xyz"), ("pos", "xyz"), ("ori", "xyzw"))
    )
    recording = replace(recording_of(path.name, time, acceleration, rate), magnetometer=Signal(time, field))
    count, length = visual_inertial(time, position, np.linalg.norm(acceleration, axis=1))
    level = Rotation.from_quat(attitude).apply(field)[:, :2]
    measured = (level / np.linalg.norm(level, axis=1)[:, None]).sum(axis=0)
    turn = np.pi / 2 - earth_field(*RIDI_PLACE).declination - np.arctan2(measured[1], measured[0])
    truth = Trajectory(time, position[:, :2] @ rotation(turn).T, np.full(len(time), np.nan))
    walk = replace(_alone(recording), frame=enu(*RIDI_PLACE))
    return BenchWalk(walk, truth, steps=count, length=length)


def _alone(recording: Recording) -> Evidence:
    return Evidence(recording, Walker(), None, Frame(), Fixes.none())


GRID = 0.02  # [s] of the visual-inertial positions
HEAD_SWAY = 0.25  # [s] Gaussian that smooths these positions: a path is not longer for the sway of the phone


def visual_inertial(time: Array, position: Array, magnitude: Array) -> tuple[int, float]:
    """True number of steps and length [m] of a walk with known positions ``(n, 3)`` [m].

    Steps are the maxima of |a| ``(n,)`` [m/s²] about its strongest frequency while the positions move.
    """
    from scipy.ndimage import gaussian_filter1d
    from scipy.signal import butter, find_peaks, sosfiltfilt

    grid = np.arange(0, time[-1], GRID)
    x, y = (np.interp(grid, time, position[:, axis]) for axis in (0, 1))
    speed = np.hypot(np.gradient(x, GRID), np.gradient(y, GRID))
    moving = gaussian_filter1d(speed, 0.5 / GRID) > 0.25
    level = np.interp(grid, time, magnitude)
    level -= gaussian_filter1d(level, 0.8 / GRID)
    frequency = np.fft.rfftfreq(8 * len(grid), GRID)
    power = np.abs(np.fft.rfft(level * np.hanning(len(grid)), 8 * len(grid)))
    walked = (frequency > 1.2) & (frequency < 2.6)
    strongest = frequency[walked][np.argmax(power[walked])]
    band = butter(2, [0.7 * strongest, 1.35 * strongest], fs=1 / GRID, btype="band", output="sos")
    landed, _ = find_peaks(sosfiltfilt(band, level), height=0.2)
    x, y = (gaussian_filter1d(values, HEAD_SWAY / GRID)[::5] for values in (x, y))
    return int(moving[landed].sum()), float(np.hypot(np.diff(x), np.diff(y)).sum())


# What is given

CHOICES: Mapping[str, Callable[[Trajectory], list[int]]] = {  # rows of the truth
    "first": lambda truth: [0],
    "first and last": lambda truth: [0, len(truth) - 1],
    "every second": lambda truth: sorted({*range(0, len(truth), 2), len(truth) - 1}),
    "first and 25 %": lambda truth: [0, int(np.searchsorted(truth.time, 0.75 * truth.time[0] + 0.25 * truth.time[-1]))],
}
COUNTED = re.compile(r"(one in|first) (\d+) s|(\d+) places")
GIVEN = ("recorded", "one in N s", "first N s", *CHOICES, "N places", "nothing")
ALSO = ("plan", "no beacons", "no compass", "no times")


def given(walk: BenchWalk, text: str) -> BenchWalk | None:
    """A walk that is given what a text says, and is scored at the rest; None if it has no such thing.

    text: one of GIVEN, then any of ALSO, with commas between. What is withheld of a receiver's positions is the truth
    of a walk that has no other. Raises InputError for another text.
    """
    which, counted, also = selection(text)
    evidence, truth, plan = walk.evidence, walk.truth, "plan" in also
    building = evidence.building if plan else None
    if plan and building is None:
        return None
    fixes, alone = evidence.fixes, not len(truth)
    surveyed = (which in CHOICES or which.endswith("places")) and not alone
    known = truth if surveyed else Trajectory(fixes.time, fixes.position, np.full(len(fixes), np.nan))
    rows = _rows(which, counted, known)
    fixes = Fixes(truth.time[rows], truth.position[rows], np.full(len(rows), GIVEN_SIGMA)) if surveyed else fixes[rows]
    truth = known[np.setdiff1d(np.arange(len(known)), rows)] if surveyed or alone else truth
    if which == "nothing":  # there are no places, then, to compare
        fixes, truth = Fixes.none(), no_truth()
    elif not (len(fixes) and len(truth)):
        return None
    without = "no beacons" in also or (surveyed and not plan)
    recording = replace(evidence.walk, magnetometer=None) if "no compass" in also else evidence.walk
    beacons = None if without else evidence.beacons
    if "no times" in also:
        recording, fixes = _without_times(recording, fixes), Fixes.none()
    evidence = replace(evidence, walk=recording, fixes=fixes, building=building, beacons=beacons)
    return replace(walk, evidence=evidence, truth=_sampled(truth), plan=walk.plan or walk.evidence.building)


def selection(text: str) -> tuple[str, re.Match[str] | None, tuple[str, ...]]:
    """Which positions are given, its number if there is one in the text, and which of ALSO. Raises InputError."""
    which, *also = (part.strip() for part in text.split(","))
    counted = COUNTED.fullmatch(which)
    if not (counted or which in GIVEN) or not set(also) <= set(ALSO):
        raise InputError("given", "", repr(text), f"one of {'; '.join(GIVEN)}, each also with ', {', or '.join(ALSO)}'")
    return which, counted, tuple(also)


def _without_times(recording: Recording, fixes: Fixes) -> Recording:
    """A recording with the positions of fixes, in another order, as places at unknown times."""
    order, (signal, *_) = np.random.default_rng(0).permutation(len(fixes)), recording.signals.values()
    span = np.tile(signal.time[[0, -1]], (len(order), 1))
    label = tuple(f"place {n + 1}" for n in range(len(order)))
    places = UntimedFixes(span, fixes.position[order], fixes.sigma[order], label)
    return replace(recording, measurements=(*recording.measurements, places))


def _rows(which: str, counted: re.Match[str] | None, known: Trajectory) -> Index:
    """The rows of known places that are given: all, unless a text says less; none where it cannot be."""
    time = known.time
    if which in CHOICES:
        dense = which == "every second" and len(time) > 1 and np.median(np.diff(time)) < DENSE
        return np.unique(np.array([] if dense or not len(time) else CHOICES[which](known), dtype=np.intp))
    if counted is None or not len(time):
        return np.arange(len(time))
    if counted[3]:
        return np.sort(np.random.default_rng(0).permutation(len(time))[: int(counted[3])])
    every = float(counted[2])
    return np.flatnonzero(time < time[0] + every) if counted[1] == "first" else _thinned(time, every)


def _thinned(time: Array, every: float) -> Index:
    """The rows of sorted times ``(n,)`` of which one is taken in ``every`` [s], by the median interval."""
    times = np.unique(time)
    rows = every / np.median(np.diff(times)) if len(times) > 1 else 1.0
    return np.arange(0, len(time), max(1, round(rows)))


def _sampled(truth: Trajectory) -> Trajectory:
    """A truth of at most a row every SCORED_EVERY; the places of one with fewer stay."""
    if len(truth) < 2 or np.median(np.diff(truth.time)) > SCORED_EVERY:
        return truth
    time = np.arange(truth.time[0], truth.time[-1], SCORED_EVERY)
    return Trajectory(time, interpolate(time, truth.time, truth.position), np.full(len(time), np.nan))
