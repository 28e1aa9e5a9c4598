"""The live walk: samples, fixes and scans in, a pose at once, and the walk smoothed as it goes.

    samples ─► LiveGait ─► certain steps ─► IncrementalGraph (iSAM2) ─┐ re-anchors
                   └─────► the last, provisional ones ──► the filter's pose

Nothing that is pushed can end the walk: what cannot be used is counted, and the status says what is amiss.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pdr_graph.errors import expect
from pdr_graph.estimation.graph import Prior
from pdr_graph.estimation.incremental import IncrementalGraph
from pdr_graph.estimation.initial import lay_dead_reckoning
from pdr_graph.estimation.live_floors import LiveFloors
from pdr_graph.estimation.live_past import Rows
from pdr_graph.estimation.profiles import prior_of
from pdr_graph.floor.building import Building
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.frames import Frame, frame_of
from pdr_graph.gait.gaps import joined_chunks
from pdr_graph.gait.live import LiveGait
from pdr_graph.gait.live_heading import LiveCompass
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import wrap_angle
from pdr_graph.inertial.stream import Health
from pdr_graph.online.contract import Pose
from pdr_graph.online.events import Event, Samples, Scan
from pdr_graph.state import restore, state_of
from pdr_graph.types import LONLAT, Array, Beacons, Estimate, Fixes, Steps, Trajectory

FARTHEST, FINEST = 1e8, 1e-4  # [m] from the origin of a frame, of a sigma at most; and at least
AHEAD = 30.0  # [s] by which a fix may lie in the future: other clocks than the sensors' do
UNSURE = "the measurements leave open which way the walk went: the most probable one is given"
SILENT = 2.0  # [s] without a sample of a sensor that the others have meanwhile


@dataclass(frozen=True)
class Status:
    """How well the navigator does.

    state: "waiting" for steps, "adrift" while no fix has told where the walk is, "turning" while none has told its
    direction, "running"; ailments: what is amiss now, a line each; sensors: how each is; keyframes: in the window;
    fixes: taken in; late, early: fixes that were too old for the window or far in the future; restarts: how often fixes
    said that the walk was elsewhere; rebuilds: why the graph was made anew, a line each.
    """

    state: str
    ailments: tuple[str, ...]
    sensors: dict[str, Health]
    keyframes: int
    fixes: int
    late: int
    early: int
    restarts: int
    rebuilds: tuple[str, ...]


class Navigator:
    """A walk under way.

    floor: whose walls are factors; lag: steps older than this are settled [s], None keeps all open; walker: whose
    strides these are; frame: of the poses, by default the plan's, else that of the first fix; prior: see ``Prior``, by
    default as of the walker's profile; beacons: where those are that scans hear; begins: label of the floor where the
    walk begins, of a building with several; epoch: Unix time [s] of the events' 0, for the earth's magnetic field.
    """

    kept = ("_taken", "_early", "_absurd", "_certain")

    def __init__(
        self,
        floor: FloorPlan | Building | None = None,
        *,
        lag: float | None = 60.0,
        walker: Walker | None = None,
        frame: Frame | None = None,
        prior: Prior | None = None,
        beacons: Beacons | None = None,
        begins: str | None = None,
        epoch: float | None = None,
    ):
        expect("Navigator, floor", floor, FloorPlan, Building, None, instead="FloorPlan.load(path)")
        if lag is not None and not lag > 0:
            raise ValueError(f"Navigator, lag: found {lag}, needed seconds above 0, or None to settle nothing")
        self.walker = walker or Walker()
        self.building = None if floor is None else Building.around(floor)
        self.frame: Frame | None = None
        self._compass = LiveCompass(self.walker)
        labels = self.building.labels if self.building else ()
        self._floors = LiveFloors(self.building, labels[0] if len(labels) == 1 else begins or "")
        self._gait = LiveGait(self.walker, self._compass.take)
        prior = prior or prior_of(self.walker.profile)
        self._graph = IncrementalGraph(prior, np.inf if lag is None else lag, self.building, begins or "")
        self._place: Array | None = None  # where the walk was first known to be
        self._epoch = epoch
        self._steps: list[Steps] = []  # since rows were handed out
        self._beacons = beacons
        self._tail: Steps | None = None
        self._said = dict[str, tuple[float, ...]]()  # the last position of each receiver
        self._taken, self._early, self._absurd, self._certain = 0, 0, 0, 0
        known = frame or (self.building.floors[0].frame if self.building else None)
        if known is not None:
            self._lie_in(known)

    def push(self, event: Event) -> None:
        """Take in an event, in the order in which they arrive."""
        expect("Navigator.push, event", event, Samples, Fixes, Scan, Steps, instead="events_of(recording)")
        if isinstance(event, Samples):
            self._sample(event)
        elif isinstance(event, Steps):
            self._extend(event)
        elif isinstance(event, Fixes):
            self._fix(event)
        elif event.radio == "bluetooth":
            self._graph.hear(replace(event.heard, time=self._on_clock(event.heard.time)))

    @property
    def steps(self) -> int:
        """How many steps there have been, the provisional ones among them."""
        return self._certain + (0 if self._tail is None else int((self._tail.length > 0).sum()))

    @property
    def pose(self) -> Pose | None:
        """Where the walker is, by all that has come in; None before there are steps, or a second of standing."""
        if not self._graph.window.keyframes:
            return None
        belief = self._graph.belief(self._tail)
        x, y, heading = belief.mean[:3].tolist()
        return Pose(self._now, x, y, float(wrap_angle(heading)), self._floors.label, belief.covariance[:3, :3])

    @property
    def trajectory(self) -> Trajectory:
        """The walk smoothed so far: every step's end, and the present; without rows that `settled` handed out."""
        if not self._graph.window.keyframes:
            return _trajectory([])
        return _trajectory([*self._graph.rows_past(), self._graph.rows(), self._graph.rows_ahead(self._tail)])

    @property
    def status(self) -> Status:
        """How well it does."""
        graph, state = self._graph, "waiting"
        if graph.window.keyframes:
            state = "running" if graph.sure else "turning" if self._taken else "adrift"
        return Status(
            state=state,
            ailments=tuple(self._ailments()),
            sensors=self._gait.health,
            keyframes=len(graph.window.keyframes),
            fixes=self._taken,
            late=graph.too_late,
            early=self._early,
            restarts=graph.restarts,
            rebuilds=tuple(graph.tree.rebuilds),
        )

    def settled(self) -> Trajectory:
        """The rows that will not change any more, each handed out once and then forgotten."""
        self._steps = self._steps[-1:]
        return _trajectory(self._graph.hand_out())

    def finish(self) -> Estimate:
        """The walk, no more events coming: the rows that were not handed out."""
        last = self._gait.finish()
        self._tail = None
        if last is not None:
            self._extend(last)
        self._graph.finish()
        graph, rows = self._graph, self.trajectory
        return Estimate(
            trajectory=rows,
            dead_reckoning=self._dead_reckoning(),
            calibration=graph.calibration(),
            fixes=tuple(graph.reports()),
            iterations=graph.tree.updates,
            cost=graph.cost,
            converged=True,
            warnings=() if graph.sure or not graph.placed else (UNSURE,),
        )

    def _dead_reckoning(self) -> Trajectory:
        """The steps that were not handed out, laid as a rigid shape on their fixes."""
        if not self._steps:
            return _trajectory([])
        steps = joined_chunks(self._steps)
        reports = [fix for fix in self._graph.reports() if fix.weight > 0 and fix.time >= steps.start]
        place = np.array([(fix.x, fix.y) for fix in reports]).reshape(-1, 2)
        time, sigma = np.array([fix.time for fix in reports]), np.array([fix.sigma for fix in reports])
        return lay_dead_reckoning(steps, Fixes(time, place, sigma, ("",) * len(reports)))

    def snapshot(self) -> dict[str, Any]:
        """All that the rest of the walk depends on, as numbers and text; rows that were handed out are not among it."""
        return {
            **state_of(self),
            "frame": None if self.frame is None else self.frame.describe(),
            "place": self._place,
            "said": [[name, list(place)] for name, place in self._said.items()],
            "gait": self._gait.state(),
            "compass": self._compass.state(),
            "floors": self._floors.state(),
            "graph": self._graph.state(),
        }

    @classmethod
    def restored(cls, snapshot: dict[str, Any], **options: Any) -> Navigator:
        """The navigator of a snapshot; options: the same as of the one that it was taken of."""
        nav = cls(**options)
        restore(nav, snapshot)
        if nav.frame is None and snapshot["frame"] is not None:
            nav._lie_in(Frame.described(snapshot["frame"]))
        nav._gait.restore(snapshot["gait"])
        nav._graph.restore(snapshot["graph"])
        nav._compass.restore(snapshot["compass"])
        nav._floors.restore(snapshot["floors"])
        if snapshot["place"] is not None and nav.frame is not None:
            nav._locate(nav.frame, np.array(snapshot["place"]))
        nav._tail = nav._gait.advance()[1]
        nav._said = {name: tuple(place) for name, place in snapshot["said"]}
        return nav

    def _on_clock(self, time: Array) -> Array:
        """Times as the sensors' now run: where that clock was put back, whichever is nearer to the present."""
        later = time + self._gait.offset
        now = self._now if self._graph.window.keyframes else 0.0
        return np.where(np.abs(later - now) < np.abs(time - now), later, time)

    def _lie_in(self, frame: Frame) -> Frame:
        """From now on everything lies in this frame."""
        self.frame = frame
        if self._beacons is not None:
            self._graph.survey(frame.place(self._beacons))
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
            self._graph.point(found.stretch, found.time, found.heading, found.sigma)
        self._extend(certain)

    def _extend(self, steps: Steps) -> None:
        self._steps.append(steps)
        self._certain += int((steps.length > 0).sum())
        self._floors.walked(steps)
        self._floors.advance(self._tail)
        self._graph.extend(steps, self._floors.labels(np.array([steps.end]))[0])

    @property
    def _now(self) -> float:
        return self._tail.end if self._tail is not None else self._graph.window.way.end

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
            source, place = fixes.sources[n], tuple(fixes.position[n].tolist())
            if source and self._said.get(source) == place:
                continue  # a receiver says again what it had said: it saw nothing new
            self._said[source] = place
            if self._graph.window.keyframes and fixes.time[n] > self._now + AHEAD:
                self._early += 1
                continue
            self._taken += 1
            self._floors.see(fixes[n])
            self._graph.add_fix(float(fixes.time[n]), fixes.position[n], float(fixes.sigma[n]), fixes.floor[n], source)

    def _ailments(self) -> Iterator[str]:
        """What is amiss now."""
        if self._absurd:
            yield f"fixes: {self._absurd} could not be used"
        if self._taken and not self._graph.window.keyframes:
            yield "accelerometer: no steps can be told, so that there are the fixes alone"
        health = self._gait.health
        latest = max((one.last for one in health.values() if np.isfinite(one.last)), default=np.nan)
        for name, one in health.items():
            if one.samples and latest - one.last > SILENT:
                yield f"{name}: silent for {latest - one.last:.0f} s"
            elif not one.samples and np.isfinite(latest):
                yield f"{name}: never heard of"
            if one.dropped:
                yield f"{name}: {one.dropped} samples could not be used"
            if one.put_back:
                yield f"{name}: its clock was put back {one.put_back} times"


def _trajectory(parts: Sequence[Rows]) -> Trajectory:
    """Rows that follow one another."""
    if not parts:
        return Trajectory(np.empty(0), np.empty((0, 2)), np.empty(0), (), np.empty((0, 3, 3)))
    rows = Rows.joined(parts)
    heading = wrap_angle(rows.pose[:, 2])
    return Trajectory(rows.time, rows.pose[:, :2], heading, tuple(rows.floor), rows.covariance)
