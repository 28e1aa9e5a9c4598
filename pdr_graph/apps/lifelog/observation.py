"""Observation of one recording: steps, headings, fixes, radio scans and other measurements.

This is the expensive part of a lifelog. A worker does it once per recording and writes the result to a file, from which
all later stages start. Times can be left out of an observation so that nothing measured then remains in it: steps
before and after such a time are separated by a gap, whose ends are all that it shows of the time between.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
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
from pdr_graph.io.validation import plausible_times
from pdr_graph.storage import compress, decode, decompress, encode
from pdr_graph.types import (
    INSTANT,
    TABLE,
    Array,
    Beacons,
    Fixes,
    Headings,
    OneLineRepr,
    Recording,
    Sightings,
    Signal,
    Steps,
    declared,
    row_columns,
    rows_of,
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

    @property
    def activities(self) -> tuple[StatedActivity, ...]:
        """The stated activities, with times from the start of the recording [s]."""
        return tuple((start - self.epoch, end - self.epoch, kind) for start, end, kind in self.stated)

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
        from pdr_graph.estimation.factors.registry import KINDS  # imports gtsam, which is slow

        observation = replace(observation, measurements=tuple(decode(table, *KINDS) for table in found.measurements))
    headings, fixes = replace(observation.headings), replace(observation.fixes)  # columns that are new since then
    return replace(observation, headings=headings, fixes=fixes)


def read_inputs(recording: Path, options: RecordingOptions) -> Evidence:
    """Read a recording and the files of its options. Raises InputError if a file cannot be used."""
    from pdr_graph.options import Options
    from pdr_graph.plausibility import FASTEST_RIDE  # imported here: most commands use what was observed long ago
    from pdr_graph.walk import read

    given = {name: value for name, value in options.given.items() if name != "begins"}
    return read(recording, Options(**given), FASTEST_RIDE)


def observe(recording: Path, options: RecordingOptions | None = None) -> Observation:
    """Read a recording with its options, and detect its steps and headings.

    Steps are not corrected by the profile of the walker file, since a lifelog estimates the profile.

    Raises InputError if the recording cannot be used or has no date.
    """
    from pdr_graph.walk import detected

    options = options or RecordingOptions()
    inputs = read_inputs(recording, options)
    walk = inputs.walk
    epoch = walk.epoch if options.begins is None else options.begins
    if epoch is None:
        raise InputError(recording, "", "no date", "a start time: give --begins")
    check_usable(recording, walk, len(inputs.fixes))
    steps, looks, headings, ends = None, np.empty(0), Headings.none(), None
    measurements = walk.measurements
    last = [s.time[-1] for s in walk.signals.values()] or [inputs.fixes.time[-1]]
    if walk.has_acceleration:
        usual = replace(inputs, walker=replace(inputs.walker, profile=None))
        found, gaits, steps, headings, drifts = detected(usual)
        inputs = replace(inputs, notes=found.notes)
        measurements = (*measurements, drifts) if len(drifts) else measurements
        looks, ends = _turns_in_pauses(gaits, steps), _fields_at_ends(gaits)
    barometer = walk.barometer
    if barometer is not None and barometer.rate > KEPT_BAROMETER_RATE:  # averaged
        bins = np.floor(barometer.time * KEPT_BAROMETER_RATE).astype(np.int64)
        _, first, number = np.unique(bins, return_index=True, return_counts=True)
        values = np.add.reduceat(barometer.values, first, axis=0) / number[:, None]
        barometer = Signal(np.add.reduceat(barometer.time, first) / number, values)
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
        barometer=barometer,
        bluetooth=walk.bluetooth,
        wifi=walk.wifi,
        beacons=inputs.beacons,
        ends=ends,
        profile=inputs.walker.profile,
        notes=inputs.notes,
        measurements=measurements,
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
    """Mean magnetic field at both ends of a recording, in the walker's axes; None if it was not measured there."""
    from pdr_graph.gait.compass import measured_field

    fields = []
    for gait, end, span in ((gaits[0], 0, [0.0, END_DURATION]), (gaits[-1], -1, [-END_DURATION, 0.0])):
        attitude, magnetometer = gait.attitude, gait.recording.magnetometer
        if magnetometer is None:
            return None
        held = attitude[slice(*np.searchsorted(attitude.time, attitude.time[end] + np.array(span)).tolist())]
        field = measured_field(magnetometer, held.time)
        if not (measured := np.count_nonzero(field.any(axis=1))):
            return None
        x, y, z = held.R_world_device.apply(field).sum(axis=0) / measured
        cos, sin = np.cos(heading := gait.direction.heading[end]), np.sin(heading)
        fields.append([cos * x + sin * y, cos * y - sin * x, z])
    field = np.array(fields)
    return Ends(field[:, :2], field[:, 2]) if np.isfinite(field).all() else None


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
    """Result for a recording. columns: as of `entry_columns`; refusal: why it failed, else ""."""

    hash: str
    key: str
    columns: Mapping[str, Any]
    refusal: str = ""


def plan_hash(plan: Path) -> str:
    """Name and hash of the files of a floor plan."""
    from pdr_graph.floor.plan_files import plan_fingerprint  # here, since few days have a plan and it is slow to load

    return plan_fingerprint(plan)


def observe_all(tasks: Sequence[ObservationTask], observe: Observe = observe) -> Iterator[ObservationResult]:
    """Observe recordings and write each observation to its file, unless it exists; yields a result per recording.

    observe: a replacement for `observe`, for tests. Raises OSError if a file cannot be written.
    """
    for task in tasks:
        file, path = Path(task.file), Path(task.path)
        found = read_observation(file)
        if found is None:
            try:
                cache.check_version(task.version)
                if not path.exists():
                    raise InputError(path, "", "no such file", "the recording: add it again from its present place")
                if content_hash(path) != task.hash:
                    raise InputError(path, "", "changed content", "the content that was added: add it again")
                found = observe(path, task.options)
                if not plausible_times(np.array(found.epoch)):
                    epoch = f"{found.epoch:g} s since 1970"
                    raise InputError(path, "time", epoch, "a time from 1970 to tomorrow: give --begins")
                found = without_times(found, task.forgotten, DELETED)
                if found is None or not is_usable(found):
                    expected = "other times: pdr-graph lifelog correct list"
                    raise InputError(path, "", "nothing but times that were deleted", expected)
            except Exception as error:  # a failure of one recording must not stop the others
                where = "" if isinstance(error, InputError) else f"{task.path}: "
                yield ObservationResult(task.hash, task.key, {}, f"{where}{error_text(error)}")
                continue
            cache.write(file, to_bytes(found))
        yield ObservationResult(task.hash, task.key, entry_columns(found))


def entry_columns(observation: Observation) -> dict[str, Any]:
    """What an `Entry` has of an observation.

    zone: time zone where the recording began: at its first position, else at its plan; "" if unknown.
    """
    frame, zone = observation.frame, ""
    if frame.georeferenced and (len(observation.fixes) or observation.plan):
        place = observation.fixes.position[:1] if len(observation.fixes) else np.zeros((1, 2))
        longitude, latitude = frame.to_lonlat(place)[0].tolist()
        zone = zone_at(latitude, longitude)
    steps = 0 if observation.steps is None else int((~observation.steps.is_gap).sum())
    return {"epoch": observation.epoch, "duration": observation.duration, "steps": steps, "zone": zone}


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


DELETED = "part of this recording was deleted"  # note of an observation that was cut
AT_END = 2.0  # [s] from either end of a recording, within which its `Ends` were measured
Span = tuple[float, float]
TIMED_TABLES = ("fixes", "headings", "barometer", "bluetooth", "wifi")  # fields with a row per time


def without_times(observation: Observation, spans: Sequence[Span], note: str) -> Observation | None:
    """The observation without all that was measured in some times; itself if nothing was, None if nothing remains.

    spans: start and end of each, Unix times [s]; note: replaces the notes, which may state what was measured then.
    """
    start, long = observation.epoch, observation.duration
    inside = list[Span]()  # from its start [s], without overlap
    for a, b in sorted((a - start, b - start) for a, b in spans):
        if inside and a <= inside[-1][1]:
            inside[-1] = inside[-1][0], max(b, inside[-1][1])
        elif a < long - INSTANT and b > INSTANT:
            inside.append((a, b))
    if not inside:
        return observation
    begins = inside[0][1] if inside[0][0] <= 0 else 0.0
    ends = inside[-1][0] if inside[-1][1] >= long else long
    if begins >= ends:
        return None

    def outside(table: Any) -> Any:
        """The rows of a table with no time inside, and the anchors that these refer to."""
        if table is None:
            return None
        within = np.any([(table.time >= a) & (table.time <= b) for a, b in inside], axis=0)
        table = take(table, ~(within if within.ndim == 1 else within.any(axis=1)))
        reference = getattr(type(table), "reference", None)
        if reference is None:
            return table
        used, number = np.unique(getattr(table, reference), return_inverse=True)
        kept = {name: rows_of(getattr(table, name), used) for name in declared(type(table), TABLE)}
        return replace(table, **kept, **{reference: number.astype(np.intp)})

    steps, looks = observation.steps, observation.looks
    for a, b in inside:
        if steps is not None:
            steps, looks = steps_without(steps, looks, a, b)
    at_ends = any(a <= AT_END or b >= long - AT_END for a, b in inside)
    cut = replace(
        observation,
        **{name: outside(getattr(observation, name)) for name in TIMED_TABLES},
        steps=steps,
        looks=looks,
        ends=None if at_ends else observation.ends,
        measurements=tuple(map(outside, observation.measurements)),
    )
    if steps is None and not len(cut.fixes):
        return None
    if cut.frame.kind == "enu" and len(cut.fixes) < len(observation.fixes):
        # A frame about the first position that is left, since the old one is about the first of all
        tables: tuple[Any, ...] = (cut.fixes, cut.beacons, *cut.measurements)
        placed = [table.position for table in tables if hasattr(table, "position")]
        first = next((p[finite][:1] for p in placed if (finite := np.isfinite(p).all(axis=1)).any()), None)
        if first is None:
            cut = replace(cut, frame=Frame())
        else:
            lon, lat = cut.frame.to_lonlat(first)[0].tolist()
            cut = in_frame(cut, enu(lat, lon))
    return replace(shifted(cut, -begins), duration=ends - begins, notes=(note,))


def steps_without(steps: Steps, looks: Array, a: float, b: float) -> tuple[Steps | None, Array]:
    """The steps with a gap from `a` to `b` [s], and the looks for their rows; None if no step remains."""
    begin = steps.time - steps.duration
    dropped, before = (steps.time > a) & (begin < b), int(np.count_nonzero(steps.time <= a))
    a = max(steps.start, min([a, *begin[dropped]]), *steps.time[max(before - 1, 0) : before])
    b = min(steps.end, max([b, *steps.time[dropped]]))
    if a >= b:
        return steps, looks
    columns = row_columns(take(steps, ~dropped))
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
