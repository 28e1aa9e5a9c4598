"""The live walk: samples, fixes and scans in, a pose at once, and the walk smoothed as it goes.

    samples ─► LiveGait ─► certain steps ─► IncrementalGraph (iSAM2) ─┐ re-anchors
                   └─────► the last, provisional ones ──► the filter's pose

Nothing that is pushed can end the walk: what cannot be used is counted, and the status says what is amiss.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pdr_graph.estimation.graph import Prior
from pdr_graph.estimation.incremental import IncrementalGraph
from pdr_graph.estimation.prediction import Belief
from pdr_graph.estimation.profiles import prior_of
from pdr_graph.floor.building import Building
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.frames import Frame, enu
from pdr_graph.gait.live import LiveGait
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import wrap_angle
from pdr_graph.inertial.stream import Health
from pdr_graph.online.events import Event, Samples, Scan
from pdr_graph.types import LONLAT, Array, Estimate, Fixes, Steps, Trajectory

AHEAD = 30.0  # [s] by which a fix may lie in the future: other clocks than the sensors' do
SILENT = 2.0  # [s] without a sample of a sensor that the others have meanwhile


@dataclass(frozen=True)
class Pose:
    """Where the walker is now.

    time [s]; x, y [m]; heading [rad]; floor: the plan's label, empty where unknown; covariance: ``(3, 3)`` of
    (x, y, heading) in the output axes [m, m, rad].
    """

    time: float
    x: float
    y: float
    heading: float
    floor: str
    covariance: Array


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
    strides these are; frame: of the poses, by default the plan's, else that of the first fix; prior: see ``Prior``.
    """

    def __init__(
        self,
        floor: FloorPlan | Building | None = None,
        *,
        lag: float | None = 60.0,
        walker: Walker | None = None,
        frame: Frame | None = None,
        prior: Prior | None = None,
    ):
        self.walker = walker or Walker()
        self.building = None if floor is None else Building.around(floor)
        self.frame = frame or (self.building.floors[0].frame if self.building else None)
        self._gait = LiveGait(self.walker)
        prior = prior or prior_of(self.walker.profile)
        self._graph = IncrementalGraph(prior, np.inf if lag is None else lag, self.building)
        self._tail: Steps | None = None
        self._early, self._fixes = list[Fixes](), 0
        self._said = dict[str, tuple[float, float]]()  # the last position of each receiver
        self._refused = 0

    def push(self, event: Event) -> None:
        """Take in an event, in the order in which they arrive."""
        if isinstance(event, Samples):
            self._gait.push(event.sensor, event.time, event.values)
            self._walk()
        elif isinstance(event, Fixes):
            self._fix(event)
        elif isinstance(event, Steps):
            self._extend(event)
        elif isinstance(event, Scan):
            pass

    @property
    def pose(self) -> Pose | None:
        """Where the walker is, by all that has come in; None before the first second of samples."""
        if not self._graph.keyframes:
            return None
        belief = self._graph.belief(self._tail)
        time = self._tail.end if self._tail is not None else self._graph.covered
        return Pose(
            time, *belief.mean[:2].tolist(), float(wrap_angle(belief.mean[2])), self._floor, belief.covariance[:3, :3]
        )

    @property
    def trajectory(self) -> Trajectory:
        """The walk smoothed so far: its start, the end of every step, its end now; without rows that were handed out."""
        raise NotImplementedError

    def _walk(self) -> None:
        certain, self._tail = self._gait.advance()
        if certain is not None:
            self._extend(certain)

    def _extend(self, steps: Steps) -> None:
        self._graph.extend(steps)
        self._take_waiting()
