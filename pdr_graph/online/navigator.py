"""The live walk: samples, fixes and scans in, a pose at once, and the walk smoothed as it goes.

    samples ─► StepStream ─► certain steps ─► IncrementalGraph (iSAM2) ─┐ re-anchors
                   └─────► the last, provisional ones ──► the filter's pose

Nothing that is pushed can end the walk: what cannot be used is counted, and the status says what is wrong.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from pdr_graph.errors import expect
from pdr_graph.estimation.calibration import prior_of
from pdr_graph.estimation.factors.beacon_rssi import LevelCollector
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.floors import FloorsCheckpoint, LiveFloors
from pdr_graph.estimation.initialization import lay_dead_reckoning
from pdr_graph.estimation.live.finalization import TrajectoryRows
from pdr_graph.estimation.live.live_smoother import LiveSmoother, SmootherCheckpoint
from pdr_graph.estimation.live.window import Window
from pdr_graph.estimation.results import Placement, calibration_warnings, contradiction_warnings, used_fixes
from pdr_graph.floor.building import Building
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.frames import Frame, frame_of
from pdr_graph.gait.compass import CompassCheckpoint, LiveCompass
from pdr_graph.gait.step_stream import StepStream, StepStreamCheckpoint
from pdr_graph.gait.steps import concatenate_steps
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import wrap_angle
from pdr_graph.inertial.attitude_stream import Health
from pdr_graph.online.interface import EVENTS, NO_DATA, NO_STEPS, Event, Pose, Samples, Scan
from pdr_graph.types import LONLAT, Array, Beacons, Calibration, Estimate, Fixes, FixReport, Steps, Trajectory

if TYPE_CHECKING:
    from pdr_graph.estimation.fingerprinting import RadioMap

FARTHEST, FINEST = 1e8, 1e-4  # [m] from the origin of a frame, of a sigma at most; and at least
AHEAD = 30.0  # [s] by which a fix may lie in the future: other clocks than the sensors' do
UNSURE = "the measurements leave open which way the walk went: the most probable one is given"
SILENT = 2.0  # [s] without a sample of a sensor that the others have meanwhile


@dataclass(frozen=True)
class Status:
    """How well the navigator does.

    state: "waiting" for steps, "no absolute position" until the first fix, "initialising heading" until the direction
    of the walk is known, "running"; issues: what is wrong now, a line each; unknown: what the sensors did not tell of
    the steps, a line each; sensors: how each is; keyframes: in the window; fixes: accepted; late, early: fixes that
    were too old for the window or far in the future; restarts: how often fixes showed that the walk was elsewhere;
    rebuilds: why the graph was built again, a line each.
    """

    state: str
    issues: tuple[str, ...]
    unknown: tuple[str, ...]
    sensors: dict[str, Health]
    keyframes: int
    fixes: int
    late: int
    early: int
    restarts: int
    rebuilds: tuple[str, ...]


@dataclass(frozen=True)
class NavigatorCheckpoint:
    """What a `Navigator` knows; rows that were handed out are not among it.

    taken, early, absurd: numbers of fixes; certain: of steps; gaps: of those; unknown: notes of the steps; place: where
    the walk was first known to be; last_fixes: the last position of each receiver.
    """

    taken: int
    early: int
    absurd: int
    certain: int
    gaps: int
    unknown: tuple[str, ...]
    frame: Frame | None
    place: Array | None
    last_fixes: dict[str, tuple[float, ...]]
    gait: StepStreamCheckpoint
    compass: CompassCheckpoint
    floors: FloorsCheckpoint
    graph: SmootherCheckpoint


class Navigator:
    """A walk under way.

    floor: whose walls are factors; lag: steps older than this are finalized [s], None: never; walker: whose strides
    these are; frame: of the poses, by default the plan's, else the radio map's, else that of the first fix; prior: see
    ``Prior``, by default as of the walker's profile; beacons: places of the beacons that scans hear; radio_map: makes
    fixes of scans; start_floor: label of the floor where the walk begins, of a building with several; epoch: Unix time
    [s] of the events' 0, for the earth's magnetic field.
    """

    Checkpoint: ClassVar = NavigatorCheckpoint

    def __init__(
        self,
        floor: FloorPlan | Building | None = None,
        *,
        lag: float | None = 60.0,
        walker: Walker | None = None,
        frame: Frame | None = None,
        prior: Prior | None = None,
        beacons: Beacons | None = None,
        radio_map: RadioMap | None = None,
        start_floor: str | None = None,
        epoch: float | None = None,
    ):
        expect("Navigator, floor", floor, FloorPlan, Building, None, instead="FloorPlan.load(path)")
        if lag is not None and not lag > 0:
            raise ValueError(f"Navigator, lag: found {lag}, expected seconds above 0, or None to finalize nothing")
        self.walker = walker or Walker()
        self.building = None if floor is None else Building.around(floor)
        self.frame: Frame | None = None
        self._compass = LiveCompass(self.walker)
        labels = self.building.labels if self.building else ()
        self._floors = LiveFloors(self.building, labels[0] if len(labels) == 1 else start_floor or "")
        self._gait = StepStream(self.walker, self._compass.update)
        prior = prior or prior_of(self.walker.profile)
        self._graph = LiveSmoother(prior, np.inf if lag is None else lag, self.building, start_floor or "")
        self._place: Array | None = None  # where the walk was first known to be
        self._epoch = epoch
        self._steps: list[Steps] = []  # since rows were handed out
        self._beacons = beacons
        self._tail: Steps | None = None
        self._last_fixes = dict[str, tuple[float, ...]]()  # the last position of each receiver
        self._accepted, self._early, self._absurd, self._certain = 0, 0, 0, 0
        self._unknown = dict[str, None]()  # what the sensors did not tell of the steps, each line once
        self._gaps = 0
        known = frame or (self.building.floors[0].frame if self.building else None)
        if radio_map is not None:
            known = known or Frame.from_description(radio_map.frame)
            if known.describe() != radio_map.frame:
                raise ValueError(
                    f"Navigator, radio_map: found the frame {radio_map.frame}, expected {known.describe()}"
                )
            from pdr_graph.estimation.live.scan_collector import (
                ScanCollector,
            )  # it takes scipy.optimize, long to import

            self._graph.graph.collectors.append(ScanCollector(radio_map, self._use_radio_fixes))
        if known is not None:
            self._lie_in(known)

    def push(self, event: Event) -> None:
        """Take in an event, in the order in which they arrive."""
        expect("Navigator.push, event", event, *EVENTS, instead="events_of(recording)")
        if isinstance(event, Samples):
            self._sample(event)
        elif isinstance(event, Steps):
            self._extend(event)
        elif isinstance(event, Fixes):
            self._fix(event)
        elif isinstance(event, Scan):
            self._graph.collect(replace(event.heard, time=self._on_clock(event.heard.time)))
        else:
            self._graph.append(replace(event, time=self._on_clock(event.time)))

    @property
    def steps(self) -> int:
        """How many steps there have been, the provisional ones among them."""
        return self._certain + (0 if self._tail is None else int((~self._tail.is_gap).sum()))

    @property
    def unknown(self) -> tuple[str, ...]:
        """What the sensors did not tell of the steps so far, a line each."""
        gaps = (f"{self._gaps} gaps in the recording",) if self._gaps else ()
        return (*self._unknown, *gaps)

    @property
    def pose(self) -> Pose | None:
        """Where the walker is, by all that has come in; None before there are steps, or a second of standing."""
        if not self._window.keyframes:
            return None
        belief = self._graph.belief(self._tail)
        x, y, heading = belief.mean[:3].tolist()
        return Pose(self._now, x, y, float(wrap_angle(heading)), self._floors.label, belief.covariance[:3, :3])

    @property
    def trajectory(self) -> Trajectory:
        """The walk smoothed so far: every step's end, and the present; without the rows that `finalized` returned."""
        if not self._window.keyframes:
            return _trajectory([])
        return _trajectory([*self._graph.rows_past(), self._graph.rows(), self._graph.rows_ahead(self._tail)])

    @property
    def status(self) -> Status:
        """How well it does."""
        graph, state = self._graph, "waiting"
        if self._window.keyframes:
            state = "running" if graph.sure else "initialising heading" if self._accepted else "no absolute position"
        return Status(
            state=state,
            issues=tuple(self._issues()),
            unknown=self.unknown,
            sensors=self._gait.health,
            keyframes=len(self._window.keyframes),
            fixes=self._accepted,
            late=graph.graph.too_late,
            early=self._early,
            restarts=graph.restarts,
            rebuilds=tuple(graph.graph.isam.rebuilds),
        )

    def finalized(self) -> Trajectory:
        """Return the rows outside the lag window, which do not change any more; each row is returned once."""
        self._steps = self._steps[-1:]
        return _trajectory(self._graph.hand_out())

    def finish(self) -> Estimate:
        """The walk, no more events coming: the rows that were not handed out."""
        last = self._gait.finish()
        self._tail = None
        if last is not None:
            self._extend(last)
        self._graph.finish()
        smoother, rows = self._graph, self.trajectory
        if smoother.final is not None:
            return smoother.final
        if not self._window.keyframes:
            return Estimate(rows, self._dead_reckoning(), None, {}, 0, float("nan"), True)
        calibration, reports = smoother.calibration(), smoother.reports()
        return Estimate(
            trajectory=rows,
            dead_reckoning=self._dead_reckoning(),
            calibration=calibration,
            reports=reports,
            iterations=smoother.graph.isam.updates,
            cost=smoother.graph.cost,
            converged=True,
            warnings=self._warnings(reports, calibration),
        )

    def _warnings(self, reports: Mapping[str, Sequence[Any]], calibration: Calibration | None) -> tuple[str, ...]:
        """Warn of what a user must know before trusting the smoothed walk, as `smooth` does."""
        smoother, fixes = self._graph, reports.get("fixes", ())
        used = 2 if smoother.sure else len(used_fixes(fixes))  # a walk that is sure was placed, if long ago
        places = np.array([(fix.x, fix.y) for fix in used_fixes(fixes)]).reshape(-1, 2)
        plan = self.building
        walled = plan is not None and any(bool(floor.near(places).any()) for floor in plan.floors)
        placement = Placement(used, bool(reports.get("headings")), bool(len(places)) and plan is not None, walled)
        return (
            *placement.warnings(),
            *(() if calibration is None else calibration_warnings(calibration)),
            *contradiction_warnings(fixes),
            *(() if smoother.sure or not smoother.graph.placed else (UNSURE,)),
        )

    def _dead_reckoning(self) -> Trajectory:
        """The steps that were not handed out, laid as a rigid shape on their fixes."""
        if not self._steps:
            return _trajectory([])
        steps = concatenate_steps(self._steps)
        reports = [fix for fix in self._fix_reports() if fix.weight > 0 and fix.time >= steps.start]
        place = np.array([(fix.x, fix.y) for fix in reports]).reshape(-1, 2)
        time, sigma = np.array([fix.time for fix in reports]), np.array([fix.sigma for fix in reports])
        return lay_dead_reckoning(steps, Fixes(time, place, sigma, ("",) * len(reports)))

    def _fix_reports(self) -> tuple[FixReport, ...]:
        return self._graph.reports().get("fixes", ()) if self._window.keyframes else ()

    @property
    def _window(self) -> Window:
        return self._graph.graph.window

    def snapshot(self) -> NavigatorCheckpoint:
        """All that the rest of the walk depends on; rows that were handed out are not among it."""
        return NavigatorCheckpoint(
            taken=self._accepted,
            early=self._early,
            absurd=self._absurd,
            certain=self._certain,
            gaps=self._gaps,
            unknown=tuple(self._unknown),
            frame=self.frame,
            place=None if self._place is None else self._place.copy(),
            last_fixes=dict(self._last_fixes),
            gait=self._gait.checkpoint(),
            compass=self._compass.checkpoint(),
            floors=self._floors.checkpoint(),
            graph=self._graph.checkpoint(),
        )

    @classmethod
    def restored(cls, checkpoint: NavigatorCheckpoint, **options: Any) -> Navigator:
        """The navigator of a checkpoint; options: the same as of the one that it was taken of."""
        nav = cls(**options)
        nav._accepted, nav._early, nav._absurd = checkpoint.taken, checkpoint.early, checkpoint.absurd
        nav._gaps, nav._unknown = checkpoint.gaps, dict.fromkeys(checkpoint.unknown)
        nav._certain, nav._last_fixes = checkpoint.certain, dict(checkpoint.last_fixes)
        if nav.frame is None and checkpoint.frame is not None:
            nav._lie_in(checkpoint.frame)
        nav._gait.restore(checkpoint.gait)
        nav._graph.restore(checkpoint.graph)
        nav._compass.restore(checkpoint.compass)
        nav._floors.restore(checkpoint.floors)
        if checkpoint.place is not None and nav.frame is not None:
            nav._locate(nav.frame, checkpoint.place.copy())
        nav._tail = nav._gait.advance()[1]
        return nav

    def _on_clock(self, time: Array) -> Array:
        """Times as the sensors' now run: where that clock was put back, whichever is nearer to the present."""
        later = time + self._gait.offset
        now = self._now if self._window.keyframes else 0.0
        return np.where(np.abs(later - now) < np.abs(time - now), later, time)

    def _lie_in(self, frame: Frame) -> Frame:
        """From now on everything lies in this frame."""
        self.frame = frame
        if self._beacons is not None:
            self._graph.graph.collectors.append(LevelCollector(frame.place(self._beacons)))
        return frame

    def _locate(self, frame: Frame, place: Array) -> None:
        """The first place that is known tells the compass where on earth it is."""
        self._place = place
        self._compass.locate(frame, place, self._epoch)

    def _sample(self, samples: Samples) -> None:
        if samples.sensor == "magnetometer":
            self._compass.push(samples.time + self._gait.offset, samples.values)
        elif samples.sensor == "barometer":
            self._floors.push(samples.time + self._gait.offset, samples.values)
        self._gait.push(samples.sensor, samples.time, samples.values)
        certain, self._tail = self._gait.advance()
        if certain is None:
            return
        for found in self._compass.advance():
            self._graph.point(-1 - found.stretch, found.time, found.heading, found.sigma)
        self._extend(certain)

    def _extend(self, steps: Steps) -> None:
        self._steps.append(steps)
        self._certain += int((~steps.is_gap).sum())
        self._gaps += int(steps.is_gap.sum())
        self._unknown |= dict.fromkeys(steps.unknown)
        self._floors.walked(steps)
        self._floors.advance(self._tail)
        self._graph.extend(steps, self._floors.labels(np.array([steps.end]))[0])

    @property
    def _now(self) -> float:
        return self._tail.end if self._tail is not None else self._window.steps.end

    def _fix(self, fixes: Fixes) -> None:
        """Fixes in the frame of the walk; the first may define it. Those that can be nobody's are counted."""
        on_earth = fixes.epsg != LONLAT or (np.abs(fixes.position) <= [180.0, 90.0]).all(axis=1)
        usable = np.abs(fixes.position).max(axis=1, initial=0.0) < FARTHEST
        usable &= on_earth & (fixes.sigma > FINEST) & (fixes.sigma < FARTHEST)
        self._absurd += int((~usable).sum())
        fixes = fixes[usable]
        if not len(fixes):
            return
        frame = self.frame or self._lie_in(frame_of(fixes))
        if fixes.epsg is not None and not frame.georeferenced:
            return
        if self._place is None:
            self._locate(frame, frame.place(fixes).position[0])
        fixes = frame.place(replace(fixes, time=self._on_clock(fixes.time)))
        for n in range(len(fixes)):
            source, place = fixes.source[n], tuple(fixes.position[n].tolist())
            if source and self._last_fixes.get(source) == place:
                continue  # a receiver says again what it had said: it saw nothing new
            self._last_fixes[source] = place
            if self._window.keyframes and fixes.time[n] > self._now + AHEAD:
                self._early += 1
                continue
            self._accepted += 1
            self._floors.see(fixes[n])
            self._graph.append(fixes[n])

    def _use_radio_fixes(self, fixes: Fixes) -> None:
        """Use the fixes of the radio map for what else fixes tell: floor, and place on earth."""
        if self._place is None and self.frame is not None:
            self._locate(self.frame, fixes.position[0])
        self._accepted += len(fixes)
        for n in range(len(fixes)):
            self._floors.see(fixes[n])

    def _issues(self) -> Iterator[str]:
        """Say what is wrong now, a line each."""
        if self._absurd:
            yield f"fixes: {self._absurd} could not be used"
        if self._accepted and not self._window.keyframes:
            yield f"accelerometer: {NO_STEPS}"
        health = self._gait.health
        latest = max((one.last for one in health.values() if np.isfinite(one.last)), default=np.nan)
        for name, one in health.items():
            if one.samples and latest - one.last > SILENT:
                yield f"{name}: silent for {latest - one.last:.0f} s"
            elif not one.samples and np.isfinite(latest):
                yield f"{name}: {NO_DATA}"
            if one.dropped:
                yield f"{name}: {one.dropped} samples could not be used"
            if one.clock_resets:
                yield f"{name}: clock reset {one.clock_resets} times"


def _trajectory(parts: Sequence[TrajectoryRows]) -> Trajectory:
    """Rows that follow one another."""
    if not parts:
        return Trajectory(np.empty(0), np.empty((0, 2)), np.empty(0), (), np.empty((0, 3, 3)))
    rows = TrajectoryRows.joined(parts)
    heading = wrap_angle(rows.pose[:, 2])
    return Trajectory(rows.time, rows.pose[:, :2], heading, tuple(rows.floor), rows.covariance)
