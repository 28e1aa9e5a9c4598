"""Observation of one recording: steps, headings, fixes, radio scans and other measurements.

This is the expensive part of a lifelog. A worker does it once per recording and writes the result to a file, from which
all later stages start. Times can be left out of an observation so that nothing measured then remains in it: steps
before and after such a time are separated by a gap, whose ends are all that it shows of the time between.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdr_graph.apps.lifelog import cache
from pdr_graph.apps.lifelog.cache import content_hash
from pdr_graph.apps.lifelog.local_time import zone_at
from pdr_graph.apps.lifelog.store import RecordingOptions
from pdr_graph.errors import InputError, one_line
from pdr_graph.frames import Frame, enu
from pdr_graph.gait.step_chunks import gap
from pdr_graph.gait.step_chunks import shifted as shifted_steps
from pdr_graph.gait.walker import Profile
from pdr_graph.storage import compress, decode, decompress, encode
from pdr_graph.types import (
    INSTANT,
    Array,
    Beacons,
    Fixes,
    Headings,
    Mask,
    OneLineRepr,
    Recording,
    Sightings,
    Signal,
    Steps,
    take,
    with_offset,
)

if TYPE_CHECKING:
    from pdr_graph.gait.steps import GaitSignals
    from pdr_graph.walk import Evidence

# Chosen by hand
END_DURATION = 1.5  # [s] at either end of a recording over which the magnetic field is averaged
MIN_POSITIONS = 2  # positions required for an outing without steps
KEPT_BAROMETER_RATE = 5.0  # [Hz] to which a barometer is downsampled: climbs take seconds


StatedActivity = tuple[float, float, str]  # start and end [s], kind


@dataclass(frozen=True)
class Ends(OneLineRepr):
    """The magnetic field in the walker's axes at the start and the end of a recording.

    field: ``(2, 2)`` horizontal, x forward and y left, at start and end [µT]; vertical: ``(2,)`` up [µT].
    """

    field: Array
    vertical: Array

    def _summary(self) -> list[str]:
        return [
            f"{name} {ahead:.0f}, {left:.0f}, {up:.0f} µT"
            for name, (ahead, left), up in zip(
                ("start", "end"), self.field.tolist(), self.vertical.tolist(), strict=True
            )
        ]


@dataclass(frozen=True)
class Observation(OneLineRepr):
    """What was extracted from one recording; times are seconds from its start.

    source: name in messages; epoch: Unix time of its start [s]; duration: [s].
    frame: of fixes, headings and beacons; plan: path of the floor plan, "" without one; floor: label where it began,
    "" if unknown.
    steps: None without an accelerometer; looks: ``(n + 1,)`` median turn of the walker during the pause before each
    step and after the last, relative to the step before [rad].
    headings, fixes, barometer, bluetooth, wifi, beacons, measurements: as in ``Recording``, in the frame; ends: None if
    the field is unknown; profile: from the walker file, the initial profile of a lifelog. notes: data skipped or
    assumptions made. stated: activities that the person states, each with start, end (Unix times [s]) and one of
    `day.ACTIVITIES`; none in a file.
    """

    source: str
    epoch: float
    duration: float
    frame: Frame
    plan: str
    floor: str
    steps: Steps | None
    looks: Array
    headings: Headings
    fixes: Fixes
    barometer: Signal | None = None
    bluetooth: Sightings | None = None
    wifi: Sightings | None = None
    beacons: Beacons | None = None
    ends: Ends | None = None
    profile: Profile | None = None
    notes: tuple[str, ...] = ()
    measurements: tuple[Any, ...] = ()
    stated: tuple[StatedActivity, ...] = ()

    @property
    def walked(self) -> Steps:
        """The steps of a recording that has some."""
        assert self.steps is not None, "a recording with steps"
        return self.steps

    def _summary(self) -> list[str]:
        steps = "no steps" if self.steps is None else repr(self.steps)
        others = [f"{len(table)} {type(table).__name__.lower()}" for table in self.measurements]
        return [repr(self.source), f"{self.duration:.1f} s", steps, repr(self.fixes), *others]


@dataclass(frozen=True)
class ObservationFile:
    """An observation as its file has it. measurements: each table encoded by itself, since any type may occur."""

    observation: Observation
    measurements: tuple[bytes, ...]


def to_bytes(observation: Observation) -> bytes:
    """Encode and compress an observation."""
    tables = tuple(encode(table) for table in observation.measurements)
    return compress(ObservationFile(replace(observation, measurements=()), tables))


def from_bytes(blob: bytes) -> Observation:
    """The observation that `to_bytes` encoded, or one of store format 2. Raises ValueError for other bytes."""
    found = decompress(blob, ObservationFile, Observation)
    observation = found if isinstance(found, Observation) else found.observation
    if isinstance(found, ObservationFile) and found.measurements:
        from pdr_graph.estimation.factors import KINDS  # imports gtsam, which is slow

        observation = replace(observation, measurements=tuple(decode(table, *KINDS) for table in found.measurements))
    return replace(observation, headings=replace(observation.headings))  # sources that earlier versions did not have


def read_inputs(recording: Path, options: RecordingOptions) -> Evidence:
    """Read a recording and the files of its options. Raises InputError if a file cannot be used."""
    from pdr_graph.plausibility import FASTEST_RIDE  # imported here: most commands use what was observed long ago
    from pdr_graph.walk import Options, read

    given = {name: value for name, value in options.given.items() if name != "begins"}
    return read(recording, Options(**given), FASTEST_RIDE)


def observe(recording: Path, options: RecordingOptions | None = None) -> Observation:
    """Read a recording with its options, and detect its steps and headings.

    Steps are not corrected by the profile of the walker file, since a lifelog estimates the profile.

    Raises InputError if the recording cannot be used or has no date.
    """
    from pdr_graph.gait.steps import gait_signals
    from pdr_graph.walk import detected

    options = options or RecordingOptions()
    inputs = read_inputs(recording, options)
    walk = inputs.walk
    epoch = walk.epoch if options.begins is None else options.begins
    if epoch is None:
        raise InputError(recording, "", "no date", "a start time: give --begins")
    check_usable(recording, walk, len(inputs.fixes))
    steps, looks, headings, ends = None, np.empty(0), Headings.none(), None
    last = [s.time[-1] for s in walk.signals.values()] or [inputs.fixes.time[-1]]
    if walk.has_acceleration:
        gaits = gait_signals(walk)
        steps, headings = detected(replace(inputs, walker=replace(inputs.walker, profile=None)), gaits)
        looks, ends = _turns_in_pauses(gaits, steps), _fields_at_ends(gaits)
    return Observation(
        source=walk.source,
        epoch=epoch,
        duration=float(max(last)),
        frame=inputs.frame,
        plan="" if options.plan is None else str(options.plan),
        floor=options.floor or "",
        steps=steps,
        looks=looks,
        headings=headings,
        fixes=inputs.fixes,
        barometer=_downsampled(walk.barometer),
        bluetooth=walk.bluetooth,
        wifi=walk.wifi,
        beacons=inputs.beacons,
        ends=ends,
        profile=inputs.walker.profile,
        notes=inputs.notes,
        measurements=walk.measurements,
    )


def check_usable(recording: Path, walk: Recording, positions: int) -> None:
    """Raise InputError for a recording without acceleration and with fewer than MIN_POSITIONS positions."""
    if not walk.has_acceleration and positions < MIN_POSITIONS:
        raise InputError(
            recording,
            "",
            f"no acceleration and {positions} positions",
            f"an accelerometer, or at least {MIN_POSITIONS} positions",
        )


def is_usable(observation: Observation) -> bool:
    """True if an observation has steps, or enough positions."""
    return observation.steps is not None or len(observation.fixes) >= MIN_POSITIONS


def step_count(observation: Observation) -> int:
    """Number of steps of an observation."""
    return 0 if observation.steps is None else int((~observation.steps.is_gap).sum())


def _turns_in_pauses(gaits: list[GaitSignals], steps: Steps) -> Array:
    """Direction of the walker in each pause ``(n + 1,)``, relative to the step before [rad]; 0 in short pauses."""
    landed = np.concatenate([[steps.start], steps.time])
    set_off = np.append(steps.time - steps.duration, steps.end)
    looks = np.zeros(len(landed))
    for gait in gaits:
        time, heading = gait.attitude.time, gait.direction.heading
        # shortest pause [s] of standing in which the walker may turn; shorter pauses are part of the gait
        here = (set_off - landed > 1.0) & (landed >= time[0] - INSTANT) & (set_off <= time[-1] + INSTANT)
        for n in np.flatnonzero(here).tolist():
            first, after = np.searchsorted(time, [landed[n], set_off[n]])
            looks[n] = np.median(heading[first:after]) - heading[first]
    return looks


def _fields_at_ends(gaits: list[GaitSignals]) -> Ends | None:
    """Magnetic field at both ends of a recording, in the walker's axes; None if it was not measured there."""
    if gaits[0].recording.magnetometer is None:
        return None
    start = _mean_field(gaits[0], gaits[0].attitude.time[0], gaits[0].attitude.time[0] + END_DURATION, 0)
    end = _mean_field(gaits[-1], gaits[-1].attitude.time[-1] - END_DURATION, gaits[-1].attitude.time[-1], -1)
    field = np.array([start, end])
    return Ends(field[:, :2], field[:, 2]) if np.isfinite(field).all() else None


def _mean_field(gait: GaitSignals, begin: float, end: float, at: int) -> Array:
    """Mean field ``(3,)`` [µT] from ``begin`` to ``end`` [s]: forward, left, up for the walker at sample ``at``."""
    from pdr_graph.inertial.magnetometer import measured_field

    attitude = gait.attitude
    assert gait.recording.magnetometer is not None, "the caller has checked it"
    held = attitude[slice(*np.searchsorted(attitude.time, [begin, end]).tolist())]
    field = measured_field(gait.recording.magnetometer, held.time)
    measured = np.count_nonzero(field.any(axis=1))
    if not measured:
        return np.full(3, np.nan)
    x, y, z = held.R_world_device.apply(field).sum(axis=0) / measured
    cos, sin = np.cos(heading := gait.direction.heading[at]), np.sin(heading)
    return np.array([cos * x + sin * y, cos * y - sin * x, z])


def _downsampled(barometer: Signal | None) -> Signal | None:
    """Downsample a barometer to 5 Hz by averaging."""
    if barometer is None or barometer.rate <= KEPT_BAROMETER_RATE:
        return barometer
    bins = np.floor(barometer.time * KEPT_BAROMETER_RATE).astype(np.int64)
    _, first, count = np.unique(bins, return_index=True, return_counts=True)
    time = np.add.reduceat(barometer.time, first) / count
    return Signal(time, np.add.reduceat(barometer.values, first, axis=0) / count[:, None])


LATEST_EPOCH = 7_258_118_400.0  # [s] Unix time of the year 2200; a clock beyond it, or before 1970, was never set
Observe = Callable[[Path, RecordingOptions], Observation]  # as `observe`


@dataclass(frozen=True)
class ObservationTask:
    """A recording to observe. hash: of its content; key, file: of the observation; path, options: as in `Entry`;
    version: `cache.RESULT_VERSION` of the build; forgotten: times that the person has deleted (Unix times [s]).
    """

    hash: str
    key: str
    file: str
    path: str
    options: RecordingOptions
    version: str
    forgotten: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class ObservationResult:
    """Result for a recording. epoch, duration [s], steps, zone: as in `Entry`; refusal: why it failed, else ""."""

    hash: str
    key: str
    epoch: float = 0.0
    duration: float = 0.0
    steps: int = 0
    refusal: str = ""
    zone: str = ""


def plan_hash(plan: Path) -> str:
    """Name and hash of the files of a floor plan."""
    from pdr_graph.floor.plan_files import plan_fingerprint  # here, since few days have a plan and it is slow to load

    return plan_fingerprint(plan)


def observe_all(tasks: Sequence[ObservationTask], observe: Observe | None = None) -> Iterator[ObservationResult]:
    """Observe recordings and write each observation to its file, unless it exists; yields a result per recording.

    observe: a replacement for `observe`, for tests. Raises OSError if a file cannot be written.
    """
    for task in tasks:
        observation = read_observation(Path(task.file))
        if observation is None:
            try:
                observation = _observe_task(task, observe)
            except Exception as error:  # a failure of one recording must not stop the others
                where = "" if isinstance(error, InputError) else f"{task.path}: "
                yield ObservationResult(task.hash, task.key, refusal=f"{where}{error_text(error)}")
                continue
            cache.write(Path(task.file), to_bytes(observation))
        found = {"duration": observation.duration, "steps": step_count(observation), "zone": zone_at_start(observation)}
        yield ObservationResult(task.hash, task.key, observation.epoch, **found)


def zone_at_start(observation: Observation) -> str:
    """Name of the time zone where a recording began: at its first position, else at its plan; "" if unknown."""
    frame = observation.frame
    if not frame.georeferenced or not (len(observation.fixes) or observation.plan):
        return ""
    place = observation.fixes.position[:1] if len(observation.fixes) else np.zeros((1, 2))
    longitude, latitude = frame.to_lonlat(place)[0].tolist()
    return zone_at(latitude, longitude)


def read_observation(file: Path) -> Observation | None:
    """Read an observation from its file; None if it is missing or damaged."""
    return cache.read(file, from_bytes)


def read_observations(folder: Path, recordings: Sequence[tuple[str, str]]) -> dict[str, Observation]:
    """Read observations by recording hash; recordings: (hash, key of the observation); folder: ``STORE.d``.

    Raises InputError if one is missing or damaged.
    """
    observations: dict[str, Observation] = {}
    for name, key in recordings:
        file = folder / cache.OBSERVATIONS / key
        observation = read_observation(file)
        if observation is None:
            file.unlink(missing_ok=True)  # so that the next build creates it again
            raise InputError(
                file, "", "no observation, or a damaged one", "an intact file: run pdr-graph lifelog build again"
            )
        observations[name] = observation
    return observations


def error_text(error: Exception) -> str:
    """The text of an error on one line."""
    return str(error) if isinstance(error, InputError) else one_line(f"{type(error).__name__}: {error}")


def _observe_task(task: ObservationTask, observer: Observe | None) -> Observation:
    """Observe the recording of a task. Raises InputError if it is missing or has changed since it was added."""
    cache.check_version(task.version)
    path = Path(task.path)
    if not path.exists():
        raise InputError(path, "", "no such file", "the recording: add it again from its present place")
    if content_hash(path) != task.hash:
        raise InputError(path, "", "changed content", "the content that was added: add it again")
    observation = (observer or observe)(path, task.options)
    if not 0 <= observation.epoch < LATEST_EPOCH:
        raise InputError(path, "time", f"{observation.epoch:g} s since 1970", "a time since 1970: give --begins")
    if task.forgotten:
        observation = without_times(observation, task.forgotten, DELETED)
    if observation is None or not is_usable(observation):
        raise InputError(path, "", "nothing but times that were deleted", "other times: pdr-graph lifelog correct list")
    return observation


DELETED = "part of this recording was deleted"  # note of an observation that was cut
AT_END = 2.0  # [s] from either end of a recording, within which its `Ends` were measured
Span = tuple[float, float]
TIMED_TABLES = ("fixes", "headings", "barometer", "bluetooth", "wifi")  # fields with a row per time


def without_times(observation: Observation, spans: Sequence[Span], note: str) -> Observation | None:
    """The observation without all that was measured in some times; itself if nothing was, None if nothing remains.

    spans: start and end of each, Unix times [s]; note: replaces the notes, which may state what was measured then.
    """
    start, end = observation.epoch, observation.epoch + observation.duration
    inside = [(a - start, b - start) for a, b in _merged(spans) if a < end - INSTANT and b > start + INSTANT]
    if not inside:
        return observation
    begins = next((b for a, b in inside if a <= 0), 0.0)
    ends = next((a for a, b in inside if b >= observation.duration), observation.duration)
    if begins >= ends:
        return None
    cut = _without_rows(observation, inside)
    if cut.steps is None and not len(cut.fixes):
        return None
    return replace(shifted(_reframed(cut, observation), -begins), duration=ends - begins, notes=(note,))


def _merged(spans: Sequence[Span]) -> list[Span]:
    """The spans in order of time, overlapping ones as one."""
    found: list[Span] = []
    for start, end in sorted(spans):
        if found and start <= found[-1][1]:
            found[-1] = found[-1][0], max(end, found[-1][1])
        else:
            found.append((start, end))
    return found


def _outside(time: Array, spans: Sequence[Span]) -> Mask:
    """True ``(n,)`` for the times that lie in none of the spans; of rows with two times, both."""
    inside = np.any([(time >= a) & (time <= b) for a, b in spans], axis=0)
    return ~(inside if inside.ndim == 1 else inside.any(axis=1))


def _without_rows(part: Observation, spans: Sequence[Span]) -> Observation:
    """The observation without the rows whose time lies in a span [s]."""
    rows: dict[str, Any] = {}
    for name in TIMED_TABLES:
        table = getattr(part, name)
        rows[name] = table if table is None else take(table, _outside(table.time, spans))
    steps, looks = part.steps, part.looks
    for a, b in spans:
        if steps is not None:
            steps, looks = steps_without(steps, looks, a, b)
    at_ends = any(a <= AT_END or b >= part.duration - AT_END for a, b in spans)
    return replace(
        part,
        **rows,
        steps=steps,
        looks=looks,
        ends=None if at_ends else part.ends,
        measurements=tuple(_table_without(table, spans) for table in part.measurements),
    )


def _table_without(table: Any, spans: Sequence[Span]) -> Any:
    """The measurement table without the rows in the spans, and without the anchors that only these refer to."""
    table = take(table, _outside(table.time, spans))
    tables = getattr(type(table), "tables", ())
    if not tables:
        return table
    column = type(table).reference
    used, number = np.unique(getattr(table, column), return_inverse=True)
    named = {name: getattr(table, name) for name in tables}
    kept = {n: c[used] if isinstance(c, np.ndarray) else tuple(c[i] for i in used) for n, c in named.items()}
    return replace(table, **kept, **{column: number.astype(np.intp)})


def steps_without(steps: Steps, looks: Array, a: float, b: float) -> tuple[Steps | None, Array]:
    """The steps with a gap from `a` to `b` [s], and the looks for their rows; None if no step remains."""
    begin = steps.time - steps.duration
    dropped, before = (steps.time > a) & (begin < b), int(np.count_nonzero(steps.time <= a))
    a = max(steps.start, min([a, *begin[dropped]]), *steps.time[max(before - 1, 0) : before])
    b = min(steps.end, max([b, *steps.time[dropped]]))
    if a >= b:
        return steps, looks
    columns = {name: column[~dropped] for name, column in vars(steps).items() if isinstance(column, np.ndarray)}
    seen = looks[:-1][~dropped]
    if before < len(seen):  # the next step turns by what it turned itself; the pause before it is partly left out
        columns["turn"][before] -= columns["pause_turn"][before]
        columns["pause_turn"][before] = seen[before] = 0.0
    last = looks[-1] if before < len(seen) else 0.0
    final = steps.final_turn if before < len(seen) else 0.0
    if steps.start < a and b < steps.end:
        row = gap(a, b)
        columns = {name: np.insert(column, before, getattr(row, name)[0]) for name, column in columns.items()}
        seen = np.insert(seen, before, 0.0)
    if not (columns["length"] > 0).any():
        return None, np.empty(0)
    start, end = b if a <= steps.start else steps.start, a if b >= steps.end else steps.end
    return replace(steps, start=start, end=end, **columns, final_turn=final), np.append(seen, last)


def _reframed(part: Observation, whole: Observation) -> Observation:
    """The observation in a frame about its first position, since the frame is about the first of all."""
    if part.frame.kind != "enu" or len(part.fixes) == len(whole.fixes):
        return part
    tables: tuple[Any, ...] = (part.fixes, part.beacons, *part.measurements)
    placed = [table.position for table in tables if hasattr(table, "position")]
    first = next((p[np.isfinite(p).all(axis=1)][:1] for p in placed if np.isfinite(p).all(axis=1).any()), None)
    if first is None:
        return replace(part, frame=Frame())
    lon, lat = part.frame.to_lonlat(first)[0].tolist()
    return in_frame(part, enu(lat, lon))


def in_frame(part: Observation, frame: Frame) -> Observation:
    """The observation with its positions converted to a frame; without beacons if they cannot be converted.

    Both frames must be georeferenced, unless they are equal or there are no positions.
    """
    if part.frame == frame:
        return part

    def converted(table: Any) -> Any:
        if not hasattr(table, "position") or not len(table.position):
            return table
        return replace(table, position=frame.from_frame(part.frame, table.position))

    return replace(
        part,
        frame=frame,
        fixes=converted(part.fixes),
        beacons=converted(part.beacons) if part.frame.georeferenced else None,
        measurements=tuple(map(converted, part.measurements)),
    )


def shifted(part: Observation, by: float) -> Observation:
    """The observation with `by` seconds added to all times, beginning as much earlier."""
    if not by:
        return part
    tables = {name: getattr(part, name) for name in TIMED_TABLES}
    moved = {name: table if table is None else replace(table, time=table.time + by) for name, table in tables.items()}
    steps = None if part.steps is None else shifted_steps(part.steps, by)
    measured = tuple(with_offset(table, by) for table in part.measurements)
    return replace(part, epoch=part.epoch - by, **moved, steps=steps, measurements=measured)
