"""The navigator of a live walk: takes samples, fixes and scans; returns the current pose and the walk smoothed so far.

    samples ─► StepStream ─► certain steps ─► LiveSmoother ─────────┐ pose of the last keyframe
                   └─────► provisional steps ──► prediction ◄───────┘ ──► current pose

No data can end the walk: unusable data are counted, and the status states the problem.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from functools import cache, partial
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pdr_graph.errors import InputError, count, expect
from pdr_graph.estimation.calibration import prior_of
from pdr_graph.estimation.factors.base import Searching
from pdr_graph.estimation.factors.registry import COLLECTORS, kind_of
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.floors import LiveFloors
from pdr_graph.estimation.initialization import MirrorTest, lay_dead_reckoning
from pdr_graph.estimation.linear_system import one_thread
from pdr_graph.estimation.live.live_output import Away, Belief, FixesAlone, after_fixes
from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.estimation.live.window import Window, rewound
from pdr_graph.estimation.results import MOVED, movement_contradictions, time_on_steps
from pdr_graph.estimation.rides import RideWatch
from pdr_graph.estimation.verdict import verdict
from pdr_graph.floor.building import Building
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.frames import Frame, enu, frame_of
from pdr_graph.gait.compass import LiveCompass
from pdr_graph.gait.step_chunks import concatenate_steps
from pdr_graph.gait.step_stream import StepStream
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import horizontal_sigma, peaks, wrap_angle
from pdr_graph.inertial.barometer import with_goings
from pdr_graph.inertial.units import PLATFORMS, AccelerationSign
from pdr_graph.online.event_checks import AHEAD, MOST_SOURCES, EventChecks
from pdr_graph.online.filter_beside import FilterBeside, belief_of_rows
from pdr_graph.online.interface import Event, Pose, Samples, Scan, event_types, modes_of, trajectory_of_rows
from pdr_graph.online.status import (
    RIDES_NOW,
    SENSORS_SILENT,
    Status,
    contradiction_of_fixes,
    contradictions_of,
    issues_of,
    issues_of_times,
    missing_inputs,
    state_of,
    warnings_of,
)
from pdr_graph.priors import BOUT, CANDIDATE, FIXES, INITIAL, STAND, STEP, TRAVEL
from pdr_graph.types import (
    INERTIAL,
    LONLAT,
    START,
    Array,
    Beacons,
    Contradiction,
    Estimate,
    Fixes,
    FixReport,
    Headings,
    Steps,
    Trajectory,
    interpolated,
    last_time,
    take,
)

if TYPE_CHECKING:
    from pdr_graph.estimation.fingerprinting import RadioMap
    from pdr_graph.floor.paths import PathNetwork

DIRECTED = 0.5  # [rad] sigma of the heading below which it is known
KEPT = 300.0  # [s] of events that are kept, to restart the walk if the unit or sign of a sensor is another
OF_SILENCE = 30.0  # part of a silence of the sensors, by which two fixes that the graph takes are apart at least
CAUGHT_UP = 1.0  # [s] of earlier events that a push takes after a restart, until the walk has caught up
MIRRORED = "the walk before {:.0f} s is its mirror image: only then was the sign of the accelerations recognised"


@cache
def shared_thread() -> Executor | None:
    """A thread for all navigators of this process; None if it has one core."""
    return ThreadPoolExecutor(1, "pdr-graph") if (os.cpu_count() or 1) > 1 else None


@cache
def load_libraries() -> None:
    """Load what the first steps and fixes of a process need, once."""
    try:
        import_module("pdr_graph.estimation.incremental")  # here, since GTSAM is slow to load
    except ModuleNotFoundError as error:
        if error.name != "gtsam":
            raise
        expected = "it: pip install 'gtsam>=4.3', which has no wheel for Windows (docs/limits.md)"
        raise InputError("a live walk", "", "no GTSAM", expected) from None
    peaks(np.ones(1), 1.0, 1.0)
    enu(0.0, 0.0).from_lonlat(np.zeros((1, 2)))
    with one_thread:  # it looks for the libraries of linear algebra, once
        pass


class Navigator:
    """Estimator of a walk under way.

    The first of a process loads SciPy's filters, the map projections and GTSAM: half a second, so that no push does.

    floor: plan or building whose walls are factors; lag: steps older than this are finalized [s], None: never; walker:
    of this walk; frame: of the poses, by default the plan's, else the radio map's, else that of the first fix; prior:
    see ``Prior``, by default from the walker's profile; beacons: with their positions; radio_map: for fixes from scans;
    paths: ways outdoors, in their own frame;
    start_floor: label of the floor where the walk begins, for a building of several floors; start_heading,
    start_heading_sigma: direction of the first step, counter-clockwise from +x of the frame, and its sigma [rad];
    epoch: Unix time [s] of time 0 of the events, for the earth's magnetic field; platform: "android" or "ios" if it is
    known, a hint for the sign of the accelerations, which is recognised without it; executor: computes long answers
    beside the walk, of which each is used at a fixed later time of the walk; by default a thread that all navigators of
    the process share, if it has several cores. With None, `review` or the push that needs an answer computes it, with
    equal results.
    """

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
        paths: PathNetwork | None = None,
        start_floor: str | None = None,
        start_heading: float | None = None,
        start_heading_sigma: float = INITIAL.heading_sigma,
        epoch: float | None = None,
        platform: str = "",
        executor: Executor | Literal["thread"] | None = "thread",
    ):
        expect("Navigator, floor", floor, FloorPlan, Building, None, instead="FloorPlan.load(path)")
        if lag is not None and not lag > 0:
            raise ValueError(f"Navigator, lag: found {lag}, expected seconds above 0, or None to finalize nothing")
        load_libraries()
        if platform not in ("", *PLATFORMS):
            raise ValueError(f"Navigator, platform: found {platform!r}, expected 'android', 'ios', or '' if unknown")
        self._arguments: dict[str, Any] = {
            **{"floor": floor, "lag": lag, "walker": walker, "frame": frame, "prior": prior, "beacons": beacons},
            **{"radio_map": radio_map, "paths": paths, "start_floor": start_floor, "start_heading": start_heading},
            **{"start_heading_sigma": start_heading_sigma, "epoch": epoch, "platform": platform, "executor": executor},
        }
        self.walker = walker or Walker()
        self.building = None if floor is None else Building.around(floor)
        self.frame: Frame | None = None
        self._compass = LiveCompass(self.walker)
        labels = self.building.labels if self.building else ()
        self._floors = LiveFloors(self.building, labels[0] if len(labels) == 1 else start_floor or "")
        self._gait = StepStream(self.walker, self._compass.update, self._compass.preview)
        prior, executor = prior or prior_of(self.walker.profile), shared_thread() if executor == "thread" else executor
        lag = np.inf if lag is None else lag
        self._graph = LiveSmoother(prior, lag, self.building, start_floor or "", executor, paths)
        self._filter = FilterBeside(prior)
        self._alone: FixesAlone | None = None
        self._away, self._rides = Away(), RideWatch()
        self._display, self._stand = Display(), Stand()
        self._place: Array | None = None  # known of the walk ``(2,)`` [m]
        self._epoch = epoch
        self._start_heading = start_heading, start_heading_sigma
        self._chunks = list[Steps]()  # since `finalized` was last called, with the last before
        self._beacons = beacons
        self._provisional: Steps | None = None
        self._tail: Steps | None = None  # the provisional steps, on stairs as long as the treads
        self._pose: Pose | None = None  # the current pose, if it was asked for since it changed last
        self._last_fixes = dict[str, tuple[float, ...]]()  # the last position of each receiver
        self._newest_kept = -np.inf  # time of the newest fix that the graph has [s]
        self._checks = EventChecks(sign=AccelerationSign(platform))
        self._mirror, self._mirrored_until = MirrorTest(), np.nan
        self._kept: list[Event] | None = []  # all events so far; None once rows were finalised, or after KEPT seconds
        self._since = np.nan  # time of the first sample [s]
        self._waiting, self._again = deque[Event](), 0  # events to use, and how many of them are used once more
        self._accepted, self._early, self._certain, self._gaps = 0, 0, 0, 0
        self._on_steps, self._stepless = 0.0, 0.0  # [s] on certain steps, and of movement without one
        self._missing = 0.0  # [s] of that like steps
        self._unknown = dict[str, None]()  # what the sensors do not measure, each line once
        common_frame = frame or (self.building.floors[0].frame if self.building else None)
        if radio_map is not None:
            common_frame = common_frame or Frame.from_description(radio_map.frame)
            if (expected := common_frame.describe()) != radio_map.frame:
                raise ValueError(f"Navigator, radio_map: found the frame {radio_map.frame}, expected {expected}")
            self._graph.graph.collectors.append(radio_map.collector(self._use_radio_fixes))
        if common_frame is not None:
            self._lie_in(common_frame)

    def push(self, event: Event) -> None:
        """Process an event; events must come in the order of arrival. Raises ValueError for an unknown sensor."""
        expect("Navigator.push, event", event, *event_types(), instead="events_of(recording)")
        self._waiting.append(_copied(event) if self._again else event)
        self._catch_up(CAUGHT_UP)

    def _catch_up(self, seconds: float) -> None:
        """Use the events that wait; of those that are used once more, so many seconds."""
        until = np.inf
        while self._waiting:
            event, again = self._waiting.popleft(), self._again > 0
            if again:
                self._again -= 1
            elif self._examine(event):
                continue
            self._use(event)
            if self._kept is not None and not again:
                self._kept.append(_copied(event))
            if again and until == np.inf and self._gait.newest > -np.inf:
                until = self._gait.newest + seconds
            if self._again and self._gait.newest >= until:
                return

    def _examine(self, event: Event) -> bool:
        """Examine a new event; True if it tells another unit or sign, so that all events are to be used once more."""
        if not isinstance(event, Samples):
            return False
        time = np.asarray(event.time, dtype=float).reshape(-1)
        self._since = float(np.fmin(self._since, np.min(time, initial=np.inf)))
        if np.max(time, initial=-np.inf) > self._since + KEPT:
            self._kept = None
        sign = self._checks.sign
        before = sign.sign
        sign.observe(self._compass.mirrored, self._mirror.log_odds)
        if not self._checks.watch(event.sensor, event.time, event.values):
            return False
        if self._kept is None:
            if sign.sign != before:
                self._turn_over()
            return False
        kept, since, units = [*self._kept, _copied(event)], self._since, self._checks.units
        waiting = [*kept, *self._waiting]
        Navigator.__init__(self, **self._arguments)
        self._checks, self._kept, self._since = EventChecks(units, sign), kept, since
        self._waiting, self._again = deque(waiting), len(kept)
        return True

    def _turn_over(self) -> None:
        """Continue with accelerations of the other sign: the direction is not known any more."""
        if (last := self._gait.break_off()) is not None:
            self._extend(last)
        self._mirrored_until = self._now
        self._mirror = MirrorTest()
        self._compass.dips[:] = 0.0
        self._pose = self._tail = self._provisional = None

    def _use(self, event: Event) -> None:
        """Process an event."""
        if isinstance(event, Samples):
            self._sample(replace(event, values=self._checks.in_unit(event.sensor, event.time, event.values)))
            return
        self._pose = None
        if isinstance(event, Steps):
            if (steps := self._checks.in_order(event, self._certain_until)) is not None:
                self._extend(steps)
        elif isinstance(event, Scan):
            self._scan(event)
        elif issubclass(kind_of(event), Searching):
            found = f"{type(event).__name__}, whose times are found from the whole walk"
            raise TypeError(f"Navigator.push: found {found}, expected measurements with a time: smooth(WalkGraph(…))")
        elif (data := self._checks.valid(kind_of(event).name, event)) is not None:
            self._fix(data) if isinstance(data, Fixes) else self._measure(data)

    def __repr__(self) -> str:
        return f"Navigator({self.status.state!r}, {count(self.steps, 'step')}, {count(self._accepted, 'fix')})"

    def review(self) -> None:
        """Answer the open questions in an idle moment between pushes; the results are the same without."""
        self._graph.review()

    @property
    def sign(self) -> float:
        """By which the accelerations are multiplied: 1, or -1 if their sign is opposite to Android's."""
        return self._checks.sign.sign

    @property
    def steps(self) -> int:
        """Number of steps so far, with the provisional ones."""
        return self._certain + (0 if self._tail is None else int((~self._tail.is_gap).sum()))

    @property
    def unknown(self) -> tuple[str, ...]:
        """What the sensors did not measure so far, a line each."""
        gaps = (f"steps in {count(self._gaps, 'gap')} of the recording",) if self._gaps else ()
        return (*self._unknown, *gaps)

    @property
    def pose(self) -> Pose | None:
        """The current pose from all data so far; None before the first position in a frame that is given.

        Without a frame and a position, the start of the walk is the origin, after the first second of samples.
        """
        if self._pose is None:
            self._pose = self._current_pose()
        return self._pose

    @property
    def filtered(self) -> Pose | None:
        """The current pose of the Kalman filter beside the smoother; None before its first fix.

        It takes the same steps, fixes and headings, and uses neither plan nor beacons nor the graph.
        """
        return self._filter.pose(self._tail, self._floors.label)

    def at(self, time: float) -> Pose:
        """The smoothed pose of the walk at a time [s], by all data so far.

        After the last keyframe it is predicted, in the window it is the marginal of the graph, and before the window
        linear between the finalised rows that `finalized` has not returned. Raises ValueError for other times.
        """
        track, window, output, modes = self.trajectory, self._window, self._graph.output, ()
        if not len(track) or not track.time[0] <= time <= track.time[-1]:
            known = f"{track.time[0]:.3f} to {track.time[-1]:.3f} s" if len(track) else "none before the first steps"
            raise ValueError(f"Navigator.at: found {time:.3f} s, poses are known for {known}")
        if time > window.times[-1]:
            ways = output.mixture(self._tail, time)
            belief, modes = output.expected(ways), modes_of(ways)
            pose, covariance = belief.mean[:3], belief.covariance[:3, :3]
        elif time >= window.times[0] and window.intervals:
            (pose,), (covariance,) = output.poses_at(np.array([time]))
        else:
            row = interpolated(track, np.array([time]))
            pose, covariance = np.append(row.position[0], row.heading), np.asarray(row.covariance)[0]
        x, y, heading = pose.tolist()
        label = track.floor[int(np.searchsorted(track.time, time))]
        placed = output.is_placed(time)
        return Pose(time, x, y, float(wrap_angle(heading)), label, covariance, modes, placed=placed)

    def _current_pose(self) -> Pose | None:
        alone = self._alone
        if alone is not None and (self._follows_fixes or not self._window.keyframes or self._silent(alone)):
            return self._pose_by_fixes(alone)
        if not self._window.keyframes or not (self.frame is None or self._graph.output.is_placed(self._now)):
            return None if alone is None else self._pose_by_fixes(alone)
        ways = self._graph.output.mixture(self._tail)
        belief = self._stand.held(self._now, self._graph.output.expected(ways), self._walked, self._gait.quiet)
        x, y, heading = belief.mean[:3].tolist()
        here = self._display.at(self._now, belief.mean[:2], heading, self._walked)
        return Pose(
            self._now,
            x,
            y,
            float(wrap_angle(heading)),
            self._floors.label,
            belief.covariance[:3, :3],
            modes_of(ways),
            here,
            self._graph.output.is_placed(self._now),
        )

    def _pose_by_fixes(self, alone: FixesAlone) -> Pose:
        """The pose where no steps are known: the fixes, smoothed, and any direction."""
        time = max(alone.time, self._now) if self._follows_fixes and not self._silent(alone) else alone.time
        x, y = alone.mean.tolist()
        return Pose(time, x, y, 0.0, self._floors.label, alone.covariance_at(time))

    def _silent(self, alone: FixesAlone) -> bool:
        """True if the sensors are silent while fixes come."""
        return alone.time >= self._now + SENSORS_SILENT

    @property
    def _follows_fixes(self) -> bool:
        """True in a ride, and if the fixes went away from the walk, and the pose with them."""
        alone = self._alone
        return alone is not None and (self._rides.since is not None or self._away.is_followed(alone, self._walked))

    @property
    def _latest_fix(self) -> float:
        """Time of the newest fix [s]; minus infinity before the first."""
        return -np.inf if self._alone is None else self._alone.time

    @property
    def _sensors_silent(self) -> bool:
        """True if there was acceleration, and fixes go on without; a step counter is not silent between its steps."""
        return -np.inf < self._gait.accelerated <= self._latest_fix - SENSORS_SILENT

    @property
    def _away_by(self) -> float:
        """Distance of the fixes from the walk where they are followed [m], else 0."""
        alone = self._alone
        if alone is None or self._rides.since is not None or self._sensors_silent or not self._follows_fixes:
            return 0.0
        return float(np.hypot(*(alone.mean - self._graph.output.belief(self._tail).mean[:2])))

    @property
    def _walked(self) -> float:
        """Distance walked so far, with the provisional steps [m]."""
        tail = 0.0 if self._tail is None else float(self._tail.length.sum())
        return float(self._window.steps.walked_by(self._window.steps.end)) + tail

    @property
    def trajectory(self) -> Trajectory:
        """The walk smoothed so far, with the current pose; without the rows that `finalized` returned."""
        if not self._window.keyframes:
            return trajectory_of_rows([])
        output = self._graph.output
        return trajectory_of_rows([*self._graph.graph.finalized.rows, output.rows(), output.predicted_rows(self._tail)])

    @property
    def status(self) -> Status:
        """The present state."""
        graph, walking, pose = self._graph, bool(self._window.keyframes), self.pose
        directed = pose is not None and pose.covariance[2, 2] < DIRECTED**2
        located = self._accepted > 0 or graph.output.modes.mixture is not None or graph.graph.finalized.anchored
        # Time of movement without a step [s]: lately, or in most of the walk
        moved = self._gait.stepless or (self._stepless if self._stepless > self._on_steps else 0.0)
        silent = self._latest_fix - self._gait.accelerated if self._sensors_silent else 0.0
        return Status(
            state=state_of(walking and not (self._follows_fixes or silent), located, graph.sure or directed),
            sigma=pose.sigma if pose is not None and located else float("nan"),
            missing=tuple(missing_inputs(walking, located or graph.graph.has_position, graph.sure or directed)),
            issues=(
                *issues_of(self._gait.health, located and not walking, self._away_by, silent),
                *self._checks.silences(max(self._gait.newest, self._latest_fix)),
                *((RIDES_NOW.format(since),) if (since := self._rides.since) is not None else ()),
                *((MOVED.format(moved),) if moved else ()),
                *self._checks.issues(),
                *issues_of_times(self._early, graph.graph.too_late),
                *self._filter.issues(),
            ),
            unknown=self.unknown,
            sensors=self._gait.health,
            keyframes=len(self._window.keyframes),
            fixes=self._accepted,
            late=graph.graph.too_late,
            early=self._early,
            restarts=len(graph.ambiguity.restarts),
            updates=graph.graph.updates,
            rebuilds=tuple(graph.graph.failures),
            judge=lambda: verdict(self._estimate()),
        )

    def finalized(self) -> Trajectory:
        """Return the rows outside the lag window, which do not change any more; each row is returned once."""
        self._chunks = self._chunks[-1:]
        rows = trajectory_of_rows(self._graph.graph.finalized.pop_finalized())
        self._kept = None if len(rows) else self._kept  # rows that were returned stay
        return rows

    def finish(self) -> Estimate:
        """End the walk and return its estimate, without the rows that `finalized` returned."""
        self._catch_up(np.inf)
        last = self._gait.finish()
        self._tail = self._provisional = self._pose = None
        if last is not None:
            self._extend(last)
        for part in self._rides.finish():
            self._append_steps(part)
        self._graph.finish()
        if (final := self._graph.final) is not None:
            self._filter.judge(partial(belief_of_rows, final.trajectory))
            warnings = (*final.warnings, *self._rides.notes, *self._filter.warnings())
            doubts = *self._rides.contradictions, *self._filter.contradictions(), *self._mirror_images()
            return replace(final, warnings=warnings, contradictions=(*final.contradictions, *doubts))
        estimate = self._estimate()
        warnings = (*warnings_of(self._graph, self.building, estimate), *self._rides.notes, *self._filter.warnings())
        return replace(estimate, dead_reckoning=dead_reckoning_of(self._chunks, estimate.fixes), warnings=warnings)

    def _estimate(self) -> Estimate:
        """The walk smoothed so far, without dead reckoning and warnings."""
        smoother, rows = self._graph, self.trajectory
        if not self._window.keyframes:
            return Estimate(rows, rows, None, {}, 0, float("nan"), True)
        reports = smoother.output.reports()
        return Estimate(
            trajectory=rows,
            dead_reckoning=rows,
            calibration=smoother.output.calibration(),
            reports=reports,
            iterations=smoother.graph.updates,
            cost=smoother.graph.cost,
            converged=True,
            contradictions=(
                *contradictions_of(smoother, self.building, rows, reports),
                *contradiction_of_fixes(self._away_by),
                *movement_contradictions(self._stepless, self._missing, self._on_steps, self._certain),
                *self._rides.contradictions,
                *self._filter.contradictions(),
                *self._mirror_images(),
            ),
            placed=smoother.graph.finalized.anchored,
            assumed=tuple(claim.label for claim in smoother.ambiguity.findings.adopted),
        )

    def _mirror_images(self) -> tuple[Contradiction, ...]:
        """The doubts about the sign of the accelerations, now and earlier."""
        found = self._checks.sign.contradictions()
        if np.isnan(self._mirrored_until):
            return found
        text, check = MIRRORED.format(self._mirrored_until), "platform='ios', which tells it from the start"
        return (*found, Contradiction("accelerometer", "its sign", self._mirrored_until, "s", text, check))

    @property
    def _window(self) -> Window:
        return self._graph.graph.window

    def _on_clock(self, time: Array) -> Array:
        """Times on the sensors' present clock; after a clock reset, with or without its offset, the nearer to now."""
        later = time + self._gait.offset
        now = self._now if self._window.keyframes else 0.0
        return np.where(np.abs(later - now) < np.abs(time - now), later, time)

    def _lie_in(self, frame: Frame) -> Frame:
        """Set the frame of all results, and place the beacons in it; plan or beacons tell the compass where it is."""
        self.frame = frame
        if self._graph.graph.paths is not None:
            self._graph.graph.paths = self._graph.graph.paths.seen_from(frame, self.building)
        listed = None if self._beacons is None else frame.place(self._beacons)
        if listed is not None:
            self._graph.graph.collectors.append(COLLECTORS[Beacons](listed))
        if self.building is not None:
            self._locate(frame, self.building.floors[0].corners.mean(axis=0))
        elif listed is not None and np.isfinite(listed.position).any():
            self._locate(frame, np.nanmean(listed.position, axis=0))
        return frame

    def _locate(self, frame: Frame, place: Array) -> None:
        """Store a position of the walk, which the compass needs for the earth's magnetic field."""
        self._place = place
        self._compass.locate(frame, place, self._epoch)

    def _sample(self, samples: Samples) -> None:
        if samples.sensor not in INERTIAL:
            self._checks.note(samples.sensor, samples.time + self._gait.offset)
        if samples.sensor == "magnetometer":
            self._compass.push(samples.time + self._gait.offset, samples.values)
        elif samples.sensor == "barometer":
            self._floors.push(samples.time + self._gait.offset, samples.values)
        self._gait.push(samples.sensor, samples.time, samples.values)
        certain, provisional = self._gait.advance()
        headings, drifts = self._compass.advance(), self._compass.advance_drifts()
        if certain is None and not headings and not drifts and provisional is self._provisional:
            return  # samples that wait for more: the pose is as before
        self._pose, self._provisional, self._tail = None, provisional, provisional
        for heading in headings:
            self._graph.set_heading(-1 - heading.stretch, heading.time, heading.value, heading.sigma)
            self._filter.add_heading(heading.time, heading.value, heading.sigma, heading.stretch)
        for drift in drifts:
            self._graph.set_drift(-1 - drift.stretch, drift.time, drift.value, drift.sigma)
        if certain is not None:
            self._extend(certain)
        self._tail = None if provisional is None else with_goings(provisional, self._floors.goings)
        self._graph.preview(self._tail)

    def _extend(self, steps: Steps) -> None:
        """Append the next certain steps; those of a ride wait for the fixes that end it."""
        self._gaps += int(steps.is_gap.sum())
        self._unknown |= dict.fromkeys(steps.unknown)
        for part in self._rides.steps(steps):
            self._append_steps(part)

    def _begin_ride(self, since: float) -> None:
        """Put a gap in place of the steps since the start of a ride, as far as they are in the window."""
        if self._window.keyframes:
            end = self._window.steps.end
            begin = self._graph.rewind(since)
            if begin < end:  # a step counter may have been silent since
                ride = self._rides.gap(begin, end)
                self._chunks = [*rewound(self._chunks, begin), ride]
                self._graph.extend(ride)

    def _append_steps(self, steps: Steps) -> None:
        if self._start_heading[0] is not None and not self._certain and (len(steps) or not self._window.keyframes):
            first = float(steps.time[0]) if len(steps) else steps.start
            start = Headings(*np.array([[first], [self._start_heading[0]], [self._start_heading[1]]]), source=(START,))
            self._graph.graph.append(start, np.array([-(2**31)]))
            self._filter.add(start)
        self._mirror.extend(steps)
        self._certain += int((~steps.is_gap).sum())
        self._on_steps += time_on_steps(steps)
        self._stepless += steps.stepless
        self._missing += steps.missing
        self._floors.add_steps(steps)
        anew, goings = self._floors.advance(self._tail), self._floors.goings
        if anew and len(goings):
            self._graph.set_goings(goings)
            self._chunks = [with_goings(part, goings) if part.end >= goings[0, 0] else part for part in self._chunks]
        steps = with_goings(steps, goings)
        self._chunks.append(steps)
        self._graph.extend(steps, self._floors.labels(np.array([steps.end]))[0], self._tail)
        self._filter.filter.extend(steps)
        self._filter.compare(steps.end, partial(self._graph.output.belief, self._tail))

    @property
    def _now(self) -> float:
        return self._tail.end if self._tail is not None else self._certain_until

    @property
    def _certain_until(self) -> float:
        """End of the certain steps, with those of a ride under way. [s]"""
        return float(np.fmax(self._rides.end, self._window.steps.end))

    def _fix(self, received: Fixes) -> None:
        """Append fixes in the frame of the walk, which the first may define; unusable ones are counted."""
        fixes = self._checks.on_earth(received) if received.epsg == LONLAT else received
        if fixes is None or not len(fixes):
            return
        frame = self.frame or self._lie_in(frame_of(fixes))
        if fixes.epsg is not None and not frame.georeferenced:
            return
        if self._place is None:
            self._locate(frame, frame.place(fixes).position[0])
        fixes = frame.place(fixes)
        for source in set(fixes.source) - {""}:
            self._checks.note(source, fixes.time + self._gait.offset)
        new = np.array([self._is_new(fixes.source[n], tuple(fixes.position[n].tolist())) for n in range(len(fixes))])
        if new.any():
            self._measure(fixes if new.all() else take(fixes, new))

    def _is_new(self, source: str, place: tuple[float, ...]) -> bool:
        """Whether a receiver's fix is at another place than its last one: else it is a duplicate epoch."""
        if source and self._last_fixes.get(source) == place:
            return False
        self._last_fixes[source] = place
        if len(self._last_fixes) > MOST_SOURCES:
            del self._last_fixes[next(iter(self._last_fixes))]
        return True

    def _measure(self, data: Any) -> None:
        """Append valid measurements; those of the future, and those that come too often, are counted."""
        data = replace(data, time=self._on_clock(data.time)) if self._gait.offset else data
        if isinstance(data, Fixes):
            data = self._checks.by_sensor_clock(data, self._gait.newest)
        data = self._checks.thinned(kind_of(data).name, self._until_soon(data), self._graph.graph.log.rows(type(data)))
        if data is None or not len(data):
            return
        if isinstance(data, Fixes):
            self._accepted += len(data)
            self._floors.add_fixes(data)
            self._mirror.add(data)
        if not isinstance(data, Fixes):
            self._graph.append(data)
        elif kept := [n for n, time in enumerate(data.time.tolist()) if self._is_kept(time)]:
            self._graph.append(data if len(kept) == len(data) else take(data, np.array(kept)))
        self._filter.add(data)
        for n in range(len(data) if isinstance(data, Fixes) else 0):
            self._alone, riding = after_fixes(self._alone, data[n]), self._rides.since is not None
            if self._sensors_silent:
                continue  # nobody knows whether this is a walk or a ride
            for part in self._rides.fix(float(data.time[n]), data.position[n], float(data.sigma[n])):
                self._append_steps(part)
            if self._rides.since is not None and not riding:
                self._begin_ride(self._rides.since)
            if self._window.keyframes and self._alone is not None:
                belief = self._graph.output.belief(self._tail, self._alone.time)
                self._away = self._away.after(self._alone, belief, self._walked)

    def _is_kept(self, time: float) -> bool:
        """Whether the graph takes a fix: of a silence of the sensors, the longer it is, the fewer.

        All of them would be keyframes at once when the sensors go on: of an hour at 1 Hz, minutes of computing.
        """
        if self._sensors_silent and 0 <= time - self._newest_kept < (time - self._gait.accelerated) / OF_SILENCE:
            return False
        self._newest_kept = max(self._newest_kept, time)
        return True

    def _scan(self, scan: Scan) -> None:
        """Pass the usable signals of a scan to the collectors."""
        received = self._checks.heard(scan.heard)
        if received is not None:
            self._graph.collect(self._until_soon(replace(received, time=self._on_clock(received.time))), scan.radio)

    def _until_soon(self, data: Any) -> Any:
        """The rows that are not later than AHEAD from the newest sample or step, once there are some.

        Where the sensors are silent, from the newest fix: a receiver that goes on has no wrong clock for it.
        """
        newest = max(self._gait.newest, self._now if self._window.keyframes else -np.inf)
        early = last_time(data) > (max(newest, self._latest_fix) + AHEAD if newest > -np.inf else np.inf)
        self._early += int(early.sum())
        return take(data, ~early) if early.any() else data

    def _use_radio_fixes(self, fixes: Fixes) -> None:
        """Use fixes of the radio map for the floor and the first position too."""
        if self._place is None and self.frame is not None:
            self._locate(self.frame, fixes.position[0])
        self._accepted += len(fixes)
        self._filter.add(fixes)
        for n in range(len(fixes)):
            self._floors.add_fixes(fixes[n])


def _copied(event: Event) -> Event:
    """The event with copies of its samples, whose arrays the caller may use again."""
    return replace(event, time=event.time.copy(), values=event.values.copy()) if isinstance(event, Samples) else event


FOLLOWED = 2.0  # [s] within which a jump of the pose is caught up


class Stand:
    """The pose of a walker who stands stays where it is, until the estimate is some sigmas from it."""

    def __init__(self) -> None:
        self._walked, self._place = np.nan, np.zeros(2)
        self._stepped = self._quiet = -np.inf  # times of the last step, and of the last quiet second [s]

    def held(self, time: float, belief: Belief, walked: float, quiet: bool) -> Belief:
        """The belief that is shown at a time [s] after ``walked`` [m]: its covariance is about the place it stays at.

        quiet: nobody can be walking at that time.
        """
        if not abs(walked - self._walked) < STAND.steps:
            self._stepped, self._walked = time, walked
        self._quiet = time if quiet else self._quiet
        mean, covariance = belief.mean.copy(), belief.covariance.copy()
        recognised = BOUT.fewest * STEP.usual + CANDIDATE.look_ahead  # [s] after the first step
        begun = np.clip(time - max(self._quiet, self._stepped + STEP.longest), 0.0, recognised)
        # A walk may begin before its steps are recognised: sigma 0.4 of its longest way, and not all who move walk
        covariance[:2, :2] += (TRAVEL.walk * begun / 3) ** 2 * np.eye(2)
        apart = mean[:2] - self._place
        stands = time - self._stepped >= STAND.seconds and time - self._quiet < STAND.seconds
        if not stands or np.hypot(*apart) > STAND.held * horizontal_sigma(belief.covariance):
            self._place = belief.mean[:2].copy()
            return Belief(mean, covariance)
        mean[:2] = self._place
        covariance[:2, :2] += np.outer(apart, apart)
        return Belief(mean, covariance)


class Display:
    """A position that moves with the walker and catches up jumps of the pose evenly, within FOLLOWED seconds."""

    def __init__(self) -> None:
        self._time, self._walked, self._position, self._speed = np.nan, 0.0, np.zeros(2), 0.0

    def at(self, time: float, position: Array, heading: float, walked: float) -> tuple[float, float]:
        """The position x, y [m] at a time [s], for a pose at ``position (2,)`` [m] after ``walked`` [m]."""
        if np.isnan(self._time):
            self._position = position.copy()
        else:
            ahead = (walked - self._walked) * np.array([np.cos(heading), np.sin(heading)])
            behind = self._position + ahead - position
            distance, seconds = float(np.hypot(*behind)), max(time - self._time, 0.0)
            self._speed = max(self._speed, distance / FOLLOWED)
            if distance <= self._speed * seconds:
                self._position, self._speed = position.copy(), 0.0
            else:
                self._position = position + (1.0 - self._speed * seconds / distance) * behind
        self._time, self._walked = time, walked
        x, y = self._position.tolist()
        return x, y


def dead_reckoning_of(chunks: Sequence[Steps], reports: Sequence[FixReport]) -> Trajectory:
    """Dead reckoning of consecutive steps, rigidly aligned with those of the fixes that were used."""
    if not chunks:
        return trajectory_of_rows([])
    steps = concatenate_steps(chunks)
    begin = steps.start - FIXES.longest_overhang
    used = [fix for fix in reports if fix.weight > 0 and fix.time >= begin]
    place = np.array([(fix.x, fix.y) for fix in used]).reshape(-1, 2)
    time, sigma = np.array([fix.time for fix in used]), np.array([fix.sigma for fix in used])
    return lay_dead_reckoning(steps, Fixes(time, place, sigma, ("",) * len(used)))
