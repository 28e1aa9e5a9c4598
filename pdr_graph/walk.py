"""From files to the most probable walk: ``read(files) -> Evidence``, ``observe``, ``estimate -> Result``.

Every use of a walk is a page on top of these three: `apps.report.output_files` (``smooth``), `apps.replay`, a day of
the lifelog, a trial. A recording and the files beside it are checked once, in `read`.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdr_graph.errors import InputError, count
from pdr_graph.estimation.ambiguity.plan_hypotheses import begun_on
from pdr_graph.estimation.calibration import prior_of
from pdr_graph.estimation.factors.beacon_rssi import levels_along
from pdr_graph.estimation.factors.heading_prior import heading_reports
from pdr_graph.estimation.floors import Floors, floors_along
from pdr_graph.estimation.gps_track import Stated, detect_rides, follow, with_stated_rides
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.initialization import mirror_log_odds
from pdr_graph.estimation.kalman import kalman_filter, kalman_smoother
from pdr_graph.estimation.results import POSITIONS_ALONE
from pdr_graph.estimation.rides import ridden, ride_contradictions, ride_notes, stepping, without_rides
from pdr_graph.estimation.smoother import estimated, smooth
from pdr_graph.estimation.verdict import FIRST_ONLY, ROUTE, missing_of, verdict
from pdr_graph.floor.cells import BEACON
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import Frame, frame_of
from pdr_graph.gait.compass import LiveCompass, compass_measurements
from pdr_graph.gait.steps import GaitSignals, detect_steps, gait_signals
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import interpolate, wrap_angle
from pdr_graph.inertial.barometer import with_stair_lengths
from pdr_graph.inertial.units import AccelerationSign
from pdr_graph.io.loading import load
from pdr_graph.io.tables import (
    ANCHOR_SIGMA,
    CLOCK_MARGIN,
    SURVEY_SIGMA,
    beside,
    drawn_beacons,
    read_beacons,
    read_fixes,
    read_ranges,
    read_trajectory,
    read_visited,
)
from pdr_graph.options import Options
from pdr_graph.plausibility import FASTEST_WALK, RADIO_RANGE, Plausibility, check_floors
from pdr_graph.priors import COMPASS, INITIAL, changed, entries, tables
from pdr_graph.types import (
    LONLAT,
    START,
    Array,
    Beacons,
    Contradiction,
    Drifts,
    Estimate,
    Fixes,
    FixReport,
    Headings,
    OneLineRepr,
    Recording,
    Steps,
    Trajectory,
    UntimedFixes,
    Verdict,
    by_type,
    take,
)

if TYPE_CHECKING:
    from pdr_graph.estimation.fingerprinting import RadioMap
    from pdr_graph.floor.paths import PathNetwork


@contextmanager
def settings_changed(given: Iterable[str]) -> Iterator[list[str]]:
    """Set numbers of `pdr_graph.priors` within a ``with`` block; yields them as ``TABLE.name=value``.

    given: such texts, or TOML files of tables. Raises InputError for numbers that there are not.
    """
    known, kept = {str(entry): entry for entry in entries()}, list[str]()
    with ExitStack() as stack:
        for text in given:
            try:
                content = tomllib.loads(text.strip() if "=" in text else Path(text).read_text(encoding="utf-8"))
                rows = [(table, *row) for table, of in content.items() for row in of.items()]
            except (OSError, ValueError, AttributeError) as error:
                raise InputError("--set", "", f"{text!r} ({error})", "TABLE.name=value, or a TOML file") from None
            for table, name, value in rows:
                entry = known.get(full := f"{table.upper()}.{name}")
                if entry is None:
                    alike = ", ".join(get_close_matches(full, known, 3, 0.5))
                    raise InputError("--set", "", repr(full), f"a number of docs/results/settings.md: {alike}")
                try:
                    new = type(entry.value)(value)
                    fits = np.shape(new) == np.shape(entry.value) and np.isfinite(np.asarray(new, dtype=float)).all()
                except (TypeError, ValueError):
                    new, fits = None, False
                if not fits:
                    raise InputError("--set", full, repr(value), f"a value such as {entry.value!r} [{entry.unit}]")
                stack.enter_context(changed(tables()[entry.table], **{name: new}))
                kept.append(f"{full}={value}")
        yield kept


FASTEST_FIXES = 25.0  # [Hz] of the fastest receivers; each fix costs milliseconds, and denser ones repeat each other
UNDECIDED = "the direction of dead reckoning from one fix is open"
SMOOTHED = ("graph", "rts")  # methods whose report also shows the causal filter
NO_ACCELEROMETER = "steps: there is no accelerometer, so that this is the fixes alone, smoothed"
UNDETECTED = "steps: none were found, so that this is the fixes alone, smoothed"


@dataclass(frozen=True)
class Evidence(OneLineRepr):
    """All that is known of one walk, in one frame: the files that `read` has read, then what `observe` makes of them.

    walk: the recording; walker: with the profile by which the steps are corrected; building: None without a plan;
    frame: of the output; fixes: all that are used, in order of time; notes: what was left out or assumed, a line each;
    beacons: None if none was received; radio_map: the fixes include those from it; start_heading: of the first step,
    counter-clockwise from +x [rad].
    steps: None without an accelerometer or a step counter, and before they are detected; headings, measurements: tables
    for the graph;
    floors: of every step, None if unknown; others: the same walk begun on other floors, if nothing says on which.
    modes: of transport, as stated; rides: ``(r, 2)`` start and end of each [s], of which the steps are left out;
    doubts: contradictions that are known before the estimate; paths: ways outdoors around the walk, None without.
    """

    walk: Recording
    walker: Walker
    building: Building | None
    frame: Frame
    fixes: Fixes
    notes: tuple[str, ...] = ()
    beacons: Beacons | None = None
    radio_map: RadioMap | None = None
    start_heading: float | None = None
    options: Options = field(default_factory=Options)
    steps: Steps | None = None
    headings: Headings = field(default_factory=Headings.none)
    measurements: tuple[Any, ...] = ()
    floors: Floors | None = None
    others: tuple[Evidence, ...] = ()
    modes: Stated = ()
    rides: Array = field(default_factory=lambda: np.empty((0, 2)))
    doubts: tuple[Contradiction, ...] = ()
    paths: PathNetwork | None = None

    @property
    def truth(self) -> Trajectory | None:
        """The truth of the recording in the output frame, for scores alone; None if there is none to be placed."""
        truth = self.walk.truth
        if truth is None or (truth.epsg is not None and not self.frame.georeferenced):
            return None
        return self.frame.place(truth)

    @property
    def near(self) -> Array:
        """Approximate position ``(2,)`` [m] of the walk, for the World Magnetic Model."""
        if len(self.fixes):
            return self.fixes.position[0]
        return np.zeros(2) if self.building is None else self.building.floors[0].corners.mean(axis=0)

    @property
    def other_fixes(self) -> Fixes:
        """The fixes without those of the radio map, which a navigator makes from the scans itself."""
        if self.radio_map is None:
            return self.fixes
        return self.fixes[np.array([name != self.radio_map.source for name in self.fixes.source], dtype=bool)]

    def graph(self) -> WalkGraph | None:
        """Build the factor graph of the walk; None without steps."""
        if self.steps is None:
            return None
        return WalkGraph(
            self.steps,
            self.fixes,
            headings=self.headings,
            floor=self.building,
            floors=self.floors.labels if self.floors else None,
            measurements=self.measurements,
            paths=self.paths,
            prior=prior_of(self.walker.profile),
        )

    def _summary(self) -> list[str]:
        return [repr(self.walk), count(len(self.fixes), "fix"), *([] if self.steps is None else [repr(self.steps)])]


@dataclass(frozen=True)
class Result(OneLineRepr):
    """The estimate of a walk with the evidence that it follows from.

    missing: what could not be estimated, a line each; graph: None without steps, and of live walks; step_count: number
    of steps without a graph; issues: warnings in addition to those of the estimate; causal: returns causal tracks by
    name; live: the current poses of a live walk; beside: numbers of poses of the filter beside it, and of those that
    disagree.
    """

    evidence: Evidence
    estimate: Estimate
    missing: tuple[str, ...] = ()
    graph: WalkGraph | None = None
    step_count: int = 0
    issues: tuple[str, ...] = ()
    causal: Callable[[], Mapping[str, Trajectory]] = dict
    live: Trajectory | None = None
    beside: Mapping[str, int] = field(default_factory=dict)

    @property
    def steps(self) -> Steps | None:
        """The steps of the graph."""
        return None if self.graph is None else self.graph.steps

    @property
    def verdict(self) -> Verdict:
        """Whether the estimate can be trusted."""
        return verdict(self.estimate)

    def _summary(self) -> list[str]:
        return [repr(self.estimate), self.verdict.state]


def read(recording: Path, options: Options | None = None, fastest: float = FASTEST_WALK) -> Evidence:
    """Read a recording and all files of its options into one frame; no steps are detected yet.

    fastest: mean speed at which the walker can have gone from one place to another [m/s]. Raises InputError if a file
    cannot be used, or cannot belong to this walk.
    """
    options = options or Options()
    walk = load(recording, options.gnss_latency)
    notes = list(walk.notes)
    walker = options.person()
    listed_fixes = read_fixes(options.fixes, walk, notes=notes) if options.fixes else Fixes.none()
    building = read_plan(options, listed_fixes.floor)
    listed = beside(recording) if options.recorded_fixes else None
    walk = replace(walk, beacons=_beacons(walk, options, listed, building, notes))
    radio_map = read_radio_map(options, building)
    recorded = walk.fixes if options.recorded_fixes else Fixes.none()
    metric = listed_fixes.epsg is None
    frame, listed_fixes, recorded = _in_one_frame(building, radio_map, listed_fixes, recorded, notes, options.fixes)
    fixes = Fixes.concatenate([listed_fixes, recorded])
    if radio_map is not None:
        if radio_map.frame != frame.describe():
            expected = f"that of the walk, {frame.describe()}"
            raise InputError(options.radio_map or "--radio-map", "frame", f"{radio_map.frame}", expected)
        if not len(located := radio_map.fixes(walk)):
            notes.append("radio map: no scan resembles its fingerprints, so it gives no fix")
        fixes = Fixes.concatenate([fixes, located])
    places = Plausibility.of(walk, frame, fixes, building, fastest)
    places.check_fixes(options.plan, options.fixes, listed_fixes, recorded, metric)
    begin, end = places.span
    if (every := int(np.ceil(len(fixes) / (FASTEST_FIXES * (end - begin + 1))))) > 1:
        notes.append(f"{len(fixes)} fixes: more than {FASTEST_FIXES:.0f} per second, so one in {every} is used")
        fixes = fixes[np.arange(0, len(fixes), every)]
    beacons = _placed_beacons(walk, frame, options.beacons, listed, places, notes)
    if options.ranges is not None:
        frame, anchors = _anchors(walk, options.ranges, frame, located=len(fixes) > 0 or building is not None)
        ranges = read_ranges(options.ranges, walk, anchors)
        places.check_list(options.beacons, "anchor", anchors.position[np.unique(ranges.anchor)], RADIO_RANGE)
        walk = replace(walk, measurements=(*walk.measurements, ranges))
    if options.visited is not None:
        frame, visited = _visited(walk, options, frame, building, notes, located=len(fixes) > 0 or building is not None)
        places.check_list(options.visited, "place", visited.position)
        walk = replace(walk, measurements=(*walk.measurements, *([visited] if len(visited) else [])))
    paths = _paths(options, frame, fixes, notes)
    if options.learned is not None and not (options.method == "graph" and walk.has_acceleration):
        notes.append(f"{options.learned.name} was left out: only the graph of steps, by smooth, uses a network")
    if options.truth is not None:
        truth = read_trajectory(options.truth, walk, geodetic=frame.georeferenced)
        places.check_truth(options.truth, truth)
        if frame.kind == "enu" and truth.epsg is None:
            notes.append(f"x, y of {options.truth.name} are taken as metres from {frame}; lat, lon would be exact")
        walk = replace(walk, truth=truth)
    evidence = Evidence(walk, walker, building, frame, fixes, tuple(notes), beacons, radio_map, options=options)
    steps = counted(walk, walker)
    if steps is not None and len(fixes) > 1:  # as of a GPX track without steps, nothing is missing: the fixes turn it
        steps = replace(steps, unknown=())
    evidence = replace(evidence, paths=paths, steps=steps)
    if (bearing := options.start_heading) is None:
        return evidence
    east = frame.bearing_of_east(evidence.near) if frame.georeferenced else 0.0
    return replace(evidence, start_heading=float(wrap_angle(np.pi / 2 - np.radians(bearing) + east)))


def counted(walk: Recording, walker: Walker) -> Steps | None:
    """The steps of the phone's own counter; None where an acceleration shows the steps themselves."""
    if walk.step_counter is None or walk.has_acceleration:
        return None
    from pdr_graph.gait.step_counter import counted_steps  # few recordings have nothing else

    return counted_steps(walk.step_counter, walker)


def _paths(options: Options, frame: Frame, fixes: Fixes, notes: list[str]) -> PathNetwork | None:
    """The ways around the fixes; None without --paths."""
    if options.paths is None:
        return None
    from pdr_graph.floor.paths import PathNetwork  # with the readers of its formats

    paths = PathNetwork.load(options.paths, frame, fixes)
    notes.extend(f"{options.paths.name}: {note}" for note in paths.notes)
    return paths


def _placed_beacons(
    walk: Recording, frame: Frame, option: Path | None, listed: Path | None, places: Plausibility, notes: list[str]
) -> Beacons | None:
    """The beacons of a walk in the output frame; None if none was received, or if the frame has no latitude.

    Where those received lie out of reach, it raises InputError if ``option`` names their list. A list beside the
    recording is left out with a note; beacons of the plan are where the plan is.
    """
    if walk.beacons is None or walk.bluetooth is None:
        return None
    if walk.beacons.epsg is not None and not frame.georeferenced:
        notes.append(f"{len(walk.beacons)} beacons were left out: no latitude in the plan or in --fixes")
        return None
    beacons, source = frame.place(walk.beacons), option or listed
    if source is None:
        return beacons
    received = np.isin(np.array(beacons.name), walk.bluetooth.transmitter) & np.isfinite(beacons.position).all(axis=1)
    try:
        places.check_list(source, "beacon", beacons.position[received], RADIO_RANGE)
    except InputError as error:
        if option is not None:
            raise
        notes.append(f"beacons were left out: {error}")
        return None
    return beacons


def _anchors(walk: Recording, ranges: Path, frame: Frame, located: bool) -> tuple[Frame, Beacons]:
    """The frame, and the anchors of ranges in it. located: False if the anchors define the frame."""
    anchors = walk.beacons
    if anchors is None:
        raise InputError(ranges, "anchor", "no places of anchors", "--beacons, or a plan on which they are drawn")
    if not located and anchors.epsg is not None:
        frame = frame_of(Fixes(np.zeros(1), anchors.position[:1], np.ones(1), epsg=anchors.epsg))
    if anchors.epsg is not None and not frame.georeferenced:
        raise InputError(ranges, "anchor", "places by latitude in a frame that has none", "anchors as x,y [m]")
    return frame, frame.place(anchors)


def _visited(
    walk: Recording, options: Options, frame: Frame, building: Building | None, notes: list[str], located: bool
) -> tuple[Frame, UntimedFixes]:
    """The frame, and the places of --visited in it. located: False if they define the frame."""
    assert options.visited is not None, "asked for with the option"
    untimed, epsg = read_visited(options.visited, walk, building.floors if building is not None else ())
    placed = Fixes(untimed.time[:, 0], untimed.position, untimed.sigma, epsg=epsg)
    if epsg is not None and not located:
        frame = frame_of(placed)
    if epsg is not None and not frame.georeferenced:
        expected = "x,y in metres of the plan, which has no latitude (map convert --georeference)"
        raise InputError(options.visited, "", "places by latitude and longitude", expected)
    if options.method != "graph":
        notes.append(f"{options.visited.name} was left out: only the graph, by smooth, finds times of places")
        return frame, take(untimed, np.empty(0, dtype=np.intp))
    return frame, replace(untimed, position=frame.place(placed).position)


def _beacons(
    walk: Recording, options: Options, listed: Path | None, building: Building | None, notes: list[str]
) -> Beacons | None:
    """Beacon positions from ``options.beacons``, else from the list beside the recording, else from the plan."""
    unstated = SURVEY_SIGMA if options.ranges is None else ANCHOR_SIGMA
    if options.beacons is not None:
        return read_beacons(options.beacons, walk, unstated)
    if listed is not None and walk.bluetooth is not None:
        try:
            return read_beacons(listed, walk, unstated)
        except InputError as error:  # no option named this file
            notes.append(f"beacons were left out: {error}")
    return beacons_on_plan(building, walk, unstated)


def beacons_on_plan(
    building: Building | None, walk: Recording | None = None, unstated: float = SURVEY_SIGMA
) -> Beacons | None:
    """The beacons drawn in a plan, None without any. walk: whose transmitters they are; unstated: their sigma [m]."""
    drawn = [(area, floor.label) for floor in building.floors for area in floor.of_kind(BEACON)] if building else []
    return drawn_beacons(drawn, walk, unstated) if drawn else None


def read_plan(options: Options, stated: tuple[str, ...] = ()) -> Building | None:
    """Read the plan, if the options name one. stated: labels of the floors of fixes.

    Raises InputError if it cannot be used, or has no floor of such a label.
    """
    if options.plan is None:
        return None
    building = Building.load(options.plan, options.scale)
    check_floors(options.plan, building, options.floor, options.fixes, stated)
    return building


def read_radio_map(options: Options, building: Building | None) -> RadioMap | None:
    """Read the radio map, if the options name one. Raises InputError if its frame is that of a plan that is missing."""
    if options.radio_map is None:
        return None
    from pdr_graph.estimation.fingerprinting import RadioMap  # it takes scipy.optimize, long to import

    radio_map = RadioMap.load(options.radio_map)
    if building is None and radio_map.frame["kind"] == "plan":
        expected = "--map, the plan of the walks that it was learnt from"
        raise InputError(options.radio_map, "frame", "that of a floor plan", expected)
    return radio_map


def _in_one_frame(
    building: Building | None,
    radio_map: RadioMap | None,
    listed: Fixes,
    recorded: Fixes,
    notes: list[str],
    source: Path | None,
) -> tuple[Frame, Fixes, Fixes]:
    """The output frame, and the listed and the recorded fixes in it; adds a note on fixes that cannot be placed in it.

    It is the frame of the plan; else of the radio map; else of metric fixes; else east-north at the first geodetic fix.
    source: file of the listed fixes. Raises InputError for listed fixes by latitude in a plan's frame without any.
    """
    if building is not None:
        frame = building.floors[0].frame
    elif radio_map is not None:
        frame = Frame.from_description(radio_map.frame)
    elif len(listed) and listed.epsg != LONLAT:
        frame = frame_of(listed)
    elif not len(listed) + len(recorded):
        frame = Frame()
    else:
        frame = frame_of(min((f for f in (listed, recorded) if len(f)), key=lambda f: f.time[0]))
    if not frame.georeferenced and listed.epsg is not None and len(listed):
        expected = "time,x,y,sigma in metres of the plan, which has no latitude (map convert --georeference)"
        raise InputError(source or "--fixes", "", "positions by latitude and longitude", expected)
    if not frame.georeferenced and len(recorded):
        noun = f"{len(recorded)} fixes inside the recording"
        notes.append(f"{noun} were left out: no latitude in the plan or in --fixes")
        recorded = Fixes.none()
    return frame, frame.place(listed), frame.place(recorded)


def observe(evidence: Evidence) -> Evidence:
    """Detect the steps and headings of a recording, its floors and beacon levels; without an accelerometer its steps
    are those of a step counter, if any.

    Raises InputError if there are neither steps nor fixes, or if the floor of the walk is unknown.
    """
    if evidence.walk.has_acceleration or not (evidence.steps or len(evidence.fixes)):
        evidence, gaits, steps, headings, drifts = detected(evidence)
        evidence = replace(evidence, steps=steps, headings=headings, measurements=(drifts,) if len(drifts) else ())
        evidence = with_network(evidence, gaits)
    return with_tables(evidence)


def acceleration_sign(evidence: Evidence, steps: Steps, dip: float) -> AccelerationSign | None:
    """The sign of the accelerations by all evidence, as live; None without sensors that see turns.

    dip: log-odds of the opposite sign by the magnetic field.
    """
    walk = evidence.walk
    if walk.accelerometer is None or walk.gyroscope is None:
        return None
    sign = AccelerationSign.of(walk.accelerometer, known=walk.sign_odds)
    sign.sign = 1.0  # of the walk as it was evaluated
    sign.observe(dip, mirror_log_odds(steps, evidence.fixes))
    sign.decide()
    return sign


def with_opposite_sign(evidence: Evidence, sign: AccelerationSign) -> Evidence:
    """The walk with its accelerations negated, and a note of it."""
    signal = evidence.walk.accelerometer
    turned = None if signal is None else replace(signal, values=-signal.values)
    walk = replace(evidence.walk, accelerometer=turned, sign_odds=-sign.log_odds)
    return replace(evidence, walk=walk, notes=(*evidence.notes, sign.note))


def with_network(evidence: Evidence, gaits: list[GaitSignals]) -> Evidence:
    """Add the velocities of a walk by the network of --learned to its measurements, if the graph is to be solved.

    Raises InputError if the network cannot be used.
    """
    path = evidence.options.learned
    if path is None or evidence.options.method != "graph":
        return evidence
    from pdr_graph.gait.learned import Network, learned_velocities

    velocities, notes = learned_velocities([gait.attitude for gait in gaits], Network(path))
    walk = replace(evidence.walk, measurements=(*evidence.walk.measurements, velocities))
    return replace(evidence, walk=walk, notes=(*evidence.notes, *notes))


def detected(
    evidence: Evidence, sign: AccelerationSign | None = None
) -> tuple[Evidence, list[GaitSignals], Steps, Headings, Drifts]:
    """The walk in the sign of its accelerations, its gait signals and steps, and headings and drifts by its compass.

    A stated start heading is the first heading. sign: of the accelerations if it was judged.
    """
    gaits, compass = gait_signals(evidence.walk), LiveCompass(reach=2 * COMPASS.longest_stretch)
    steps = detect_steps(gaits, evidence.walker)
    headings, drifts = compass_measurements(gaits, evidence.frame, evidence.near, compass)
    if sign is None and (sign := acceleration_sign(evidence, steps, compass.mirrored)) is not None and sign.sign < 0:
        return detected(with_opposite_sign(evidence, sign), sign)
    evidence = replace(evidence, doubts=() if sign is None else sign.contradictions())
    if evidence.start_heading is not None and len(steps):
        row = (steps.time[:1], np.array([evidence.start_heading]), np.array([INITIAL.heading_sigma]), (START,))
        headings = Headings.concatenate([Headings(*row), headings])
    return evidence, gaits, steps, headings, drifts


def with_tables(evidence: Evidence) -> Evidence:
    """Add what steps and recording say together: rides, its tables of measurements, the floors, levels of beacons.

    Headings among the tables join those of the compass. Raises InputError as `observe`.
    """
    tables = evidence.walk.measurements
    headings = [table for table in tables if isinstance(table, Headings)]
    evidence = replace(
        evidence,
        headings=Headings.concatenate([evidence.headings, *headings]) if headings else evidence.headings,
        measurements=by_type([*evidence.measurements, *(each for each in tables if not isinstance(each, Headings))]),
    )
    evidence, heard = _with_floors(_on_foot(evidence)), evidence.walk.bluetooth
    if evidence.steps is None or heard is None or evidence.beacons is None:
        return evidence
    levels = levels_along(heard, evidence.beacons, evidence.steps)
    return replace(evidence, measurements=(levels, *evidence.measurements))


def _on_foot(evidence: Evidence) -> Evidence:
    """Find the rides within a walk, and leave out their steps and headings."""
    steps, headings = evidence.steps, evidence.headings
    if steps is None:
        return evidence
    rides = detect_rides(steps, evidence.fixes) if len(evidence.fixes) > 1 else np.empty((0, 2))
    rides = with_stated_rides(rides, steps, evidence.modes) if evidence.modes else rides
    return replace(
        evidence,
        steps=without_rides(steps, rides, evidence.fixes),
        headings=take(headings, ~ridden(headings.time, headings.time, rides)),
        notes=(*evidence.notes, *ride_notes(rides)),
        rides=rides,
        doubts=(*evidence.doubts, *ride_contradictions(rides, stepping(steps, rides))),
    )


def _with_floors(evidence: Evidence) -> Evidence:
    """Estimate the floor of every step by barometer and fixes, and shorten the steps on stairs to the treads.

    Raises InputError if the building has several floors and that of the walk is unknown.
    """
    building, steps, fixes = evidence.building, evidence.steps, evidence.fixes
    if steps is None:
        return evidence
    only = building.labels[0] if building is not None and len(building.labels) == 1 else ""
    start = only or evidence.options.floor or next((label for label in fixes.floor if label), "")
    begun = [_begun_on(evidence, steps, start)]
    if building is not None and not start and not len(fixes) and {Drifts}.issuperset(map(type, evidence.measurements)):
        every = {label: _begun_on(evidence, steps, label) for label in building.labels}
        begun = [one for label, one in every.items() if one.floors and one.floors.labels[0] == label] or begun
    floors = begun[0].floors
    if building is not None and len(building.labels) > 1 and (floors is None or not all(floors.labels)):
        several = f"{len(building.labels)} floors, {', '.join(building.labels)[:80]}"
        expected = "--floor, the label of the one on which the walk begins"
        raise InputError(evidence.options.plan or "--map", "", several, expected)
    return replace(begun[0], others=tuple(begun[1:]))


def _begun_on(evidence: Evidence, steps: Steps, start: str) -> Evidence:
    """The walk with the floor of every step, if it began on the one with the label ``start``."""
    floors = floors_along(steps, evidence.walk.barometer, start, evidence.fixes, evidence.building)
    return replace(evidence, steps=with_stair_lengths(steps, floors.climbs, floors.kinds), floors=floors)


def estimate(evidence: Evidence) -> Result:
    """Estimate the walk by ``graph``, ``filter``, ``rts`` or ``pdr``; without steps, smooth the fixes alone."""
    graph, found, method = evidence.graph(), None, evidence.options.method
    if graph is None:
        return fixes_alone(evidence)
    if evidence.others:
        possible = {graph: evidence, **{other.graph(): other for other in evidence.others}}
        graph, found = begun_on([graph for graph in possible if graph is not None])
        evidence = possible[graph]
    failed, walk = (), None
    if method == "graph":
        try:
            walk = smooth(graph) if found is None else estimated(graph, found)
        except RuntimeError as error:  # by GTSAM, for a system that it cannot solve
            failed = (f"the graph ({str(error).splitlines()[0]}): this is the filter's walk",)
    elif method == "pdr":
        walk = _dead_reckoned(graph)
    elif method == "rts":
        walk = kalman_smoother(graph)
    walk = walk or kalman_filter(graph)
    if "headings" not in walk.reports:  # their residuals along an estimate that does not report them itself
        headings, track = graph.headings.headings, walk.trajectory
        heading = np.interp(headings.time, track.time, np.unwrap(track.heading))
        reports = heading_reports(headings, heading, np.ones(len(headings)))
        walk = replace(walk, reports={**walk.reports, "headings": reports})
    walk = replace(walk, contradictions=(*walk.contradictions, *evidence.doubts))
    missing = failed or (() if method == "pdr" else missing_of(walk, len(evidence.fixes)))
    causal = partial(_filter_track, graph) if method in SMOOTHED else dict
    missing = (*graph.steps.unknown, *without_acceleration(evidence.walk), *missing)
    return Result(evidence, walk, missing, graph, issues=without_ways(evidence), causal=causal)


def without_acceleration(recording: Recording) -> tuple[str, ...]:
    """Where the gyroscope ran at an end of the recording and the accelerometer did not, for over 5 s, a line each."""
    acceleration, gyroscope = recording.accelerometer, recording.gyroscope
    acceleration = recording.linear_acceleration if acceleration is None else acceleration
    if acceleration is None or gyroscope is None:
        return ()
    late, early = acceleration.time[0] - gyroscope.time[0], gyroscope.time[-1] - acceleration.time[-1]
    ends = (late, "begins {:.0f} s after"), (early, "ends {:.0f} s before")
    return tuple(f"steps: the accelerometer {text.format(by)} the gyroscope" for by, text in ends if by > CLOCK_MARGIN)


def fixes_alone(evidence: Evidence, issues: tuple[str, ...] = ()) -> Result:
    """Smooth the fixes of a walk without steps. Of a recording without any sensor, as a GPX track, nothing is missing.

    issues: further ones.
    """
    issues = (*issues, *without_ways(evidence))
    if not evidence.walk.signals:
        return Result(evidence, follow(evidence.fixes), issues=(*issues, POSITIONS_ALONE))
    missing = UNDETECTED if evidence.walk.has_acceleration else NO_ACCELEROMETER
    return Result(evidence, follow(evidence.fixes), (missing,), issues=issues)


def without_ways(evidence: Evidence) -> tuple[str, ...]:
    """A line if the ways outdoors of a walk are not used."""
    if evidence.paths is None or (evidence.steps is not None and evidence.options.method == "graph"):
        return ()
    return ("ways were not used: only the graph of steps follows them, not smoothed fixes, filters or dead reckoning",)


def _filter_track(graph: WalkGraph) -> Mapping[str, Trajectory]:
    """The causal filter's track from its first fix on, which the report shows beside a smoothed estimate."""
    used = graph.positions.fixes.time[graph.positions.used]
    if graph.unplaced or not len(used):
        return {}
    track = kalman_filter(graph).trajectory
    return {"filter": track[track.time >= used.min()]} if track.time[-1] >= used.min() else {}


def _dead_reckoned(graph: WalkGraph) -> Estimate:
    """Dead reckoning through the first fix, neither rotated nor scaled: the graph with that fix alone."""
    used, fixes = graph.positions.used, graph.positions.fixes
    first = int(np.argmax(used)) if used.any() else 0
    alone = smooth(WalkGraph(graph.steps, fixes[first : first + 1], prior=graph.prior))
    track = alone.trajectory
    at = interpolate(fixes.time, track.time, track.position)
    distance = np.hypot(*(fixes.position - at).T)
    columns = (fixes.time, *fixes.position.T, fixes.sigma, distance, np.zeros(len(fixes)))
    reports = list(map(FixReport, *(column.tolist() for column in columns), [FIRST_ONLY] * len(fixes)))
    reports[first : first + 1] = alone.fixes
    track = replace(track, floor=graph.floors)
    direction = Contradiction(ROUTE, "other directions", 2 * np.pi, "rad", UNDECIDED, "--method graph uses all fixes")
    found = (*alone.contradictions, direction)
    of_kinds = {"fixes": tuple(reports)}
    return replace(alone, trajectory=track, reports=of_kinds, probability=float("nan"), contradictions=found)
