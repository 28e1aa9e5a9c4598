"""The factor graph of one walk: its keyframes, its measurements as factors, and where the search starts.

x_0 ──steps── x_1 ──steps── x_2 ── … ── x_k     x_i  Pose2 at keyframe i
 │    ╲c_0╱    ╲  c_0 ╱      │                  c_s  (R_s, R_d, b) of segment s, a random walk
fix           walls         fix                 g_m  offset and lag of a receiver, slowly varying
 ╰─── g_0 ────── g_1 ───────╯                   b_m  place and power of a beacon; q  (P, n, k) of their path loss
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from pdr_graph.errors import count, expect
from pdr_graph.estimation.between_steps import between_of
from pdr_graph.estimation.factors.base import (
    AnyArray,
    Locating,
    Measurement,
    OnPlan,
    Refined,
    Remembered,
    Searching,
    Stage,
    State,
    initial_state,
)
from pdr_graph.estimation.factors.chain import (
    DECIMALS,
    Chain,
    Evaluation,
    Path,
    Pieces,
    Priors,
    cut,
    pace_changes,
    whole_pieces,
)
from pdr_graph.estimation.factors.registry import (
    corridors_of,
    kind_of,
    made_from,
    measurements_of_walk,
    ways_among,
    ways_of,
)
from pdr_graph.estimation.factors.start import (
    WALKER_KIND,
    Prior,
    by_another_walker,
    calibration_prior,
    first_heading_prior,
    restarted,
    start_near,
    start_prior,
)
from pdr_graph.estimation.factors.steps_and_walls import steps_between_keyframes, walls_on_plan
from pdr_graph.estimation.initialization import initial_walk, pivot, reach
from pdr_graph.estimation.linear_system import NormalEquations, one_thread
from pdr_graph.floor.building import Building, FloorSequence
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.gait.step_chunks import concatenate_steps, gap_ends
from pdr_graph.priors import INITIAL, MOTION
from pdr_graph.types import (
    INSTANT,
    Array,
    Between,
    Closures,
    Fixes,
    Headings,
    Index,
    Levels,
    Steps,
    concatenate,
    last_time,
    take,
)

if TYPE_CHECKING:
    import gtsam

    from pdr_graph.estimation.factors import Directions, Positions, Ways
    from pdr_graph.estimation.factors.gtsam_export import GtsamIncrement
    from pdr_graph.floor.paths import PathNetwork

MOST_EQUATIONS = 3  # places of blocks that are kept
Kind = TypeVar("Kind", bound=Measurement)


class WalkGraph:
    """The factor graph of one walk.

    steps: of the front end; fixes: in the frame of ``floor`` (or any metric frame without a floor); headings: walking
    directions in that frame; floor: plan or building whose walls are factors, optional; floors: the floor's label for
    each row of the trajectory ``(n + 2,)``, expected for a building of several floors; levels: of beacons; closures:
    moments at one place; measurements: data of any other registered type (`Ranges`); paths: ways outdoors, in that
    frame, which lead to the doors of the floor;
    prior: see ``Prior``; others: start [s] and prior of each further walk in the same steps, in order of time.

    chain: keyframes and steps; measurements: its factors, kind by kind; start: where the search starts;
    sigma_direction: how well fixes and headings determine the walk's direction [rad]; walled: walls are used;
    optimum: of the graph of an estimate, None of others.

    Raises TypeError for other types; ValueError if fixes are not in metres, ``floors`` is missing, or as of `Prior.on`.
    """

    def __init__(
        self,
        steps: Steps,
        fixes: Fixes | None = None,
        *,
        headings: Headings | None = None,
        floor: FloorPlan | Building | None = None,
        floors: Sequence[str] | None = None,
        levels: Levels | None = None,
        closures: Closures | None = None,
        measurements: Sequence[Any] = (),
        paths: PathNetwork | None = None,
        prior: Prior | None = None,
        others: Sequence[tuple[float, Prior]] = (),
    ):
        _check(steps, fixes, headings, floor, prior)
        self.steps, self.floor, self._given, self._others = steps, floor, (prior or Prior()).on(floor), tuple(others)
        self.prior = self._given.after(steps)
        self.paths = paths
        self.fixes = Fixes.none() if fixes is None else fixes
        tables = [table for table in (levels, closures, *measurements) if table is not None]
        tables = [table for table in tables if kind_of(table) and len(table)]  # raises for types without a kind
        self.data = [self.fixes, headings or Headings.none(), *tables]

        # Keyframes at measurements and gaps, and the calibration segments
        kinds = measurements_of_walk(self.data, steps, self.prior)
        lost, whole = steps.is_gap, whole_pieces(steps)
        changed, pace = pace_changes(whole, round(steps.start, DECIMALS))
        bounds = [steps.time[lost] - steps.duration[lost], steps.time[lost], changed]
        pieces = cut(steps, whole, np.concatenate([*(kind.keyframe_times() for kind in kinds), *bounds]))
        segment = segments(pieces, steps, changed)
        starts = np.searchsorted(pieces.keyframe_time[:-1], np.round([time for time, _ in others], DECIMALS))
        begins = dict(zip(segment[starts].tolist(), [prior for _, prior in others], strict=True)) | {0: self.prior}
        first = np.array(sorted(begins))
        means = np.array([begins[s].mean for s in first.tolist()])
        c = means[np.searchsorted(first, np.arange(int(segment[-1]) + 1), side="right") - 1]
        paces = np.zeros(len(c))
        paces[segment[np.searchsorted(pieces.keyframe_time[:-1], np.round(changed, DECIMALS))]] = pace
        self.chain = Chain.of(pieces, segment, c, paces)
        self.floors = _labels(floor, floors, len(steps) + 2)

        # The initial walk
        kinds = [kind.bind(self.chain) for kind in kinds]
        self._measurements: tuple[Measurement, ...] = tuple(kinds)
        self._associated = True
        start = initial_walk(self.chain, self.positions, self.headings, steps, c, self.prior.sigma[0])
        poses, c, self.sigma_direction = start

        # All factors; without walls if the walk has no position, or is off the plan
        row = np.searchsorted(pieces.row_end, np.arange(len(pieces.length))) + 1
        floor_of_pieces = [self.floors[r] for r in row.tolist()]
        self.floor_sequence = None if floor is None else FloorSequence.of(floor, floor_of_pieces)
        prior_of_segment = {s: (np.array(prior.mean), prior.covariance) for s, prior in begins.items()}
        kinds = [kind.initialized(poses) if isinstance(kind, Locating) else kind for kind in kinds]
        calibrations = calibration_prior(prior_of_segment, self.prior.change, self.prior.another)
        priors = calibrations, self._start_prior(float(poses[0, 2]))
        self._measurements = (
            steps_between_keyframes(),
            *kinds,
            *priors,
            *ways_of(paths if paths is None or floor is None else paths.joined(Building.around(floor))),
        )
        self.start = initial_state(poses, c, self._measurements, self.chain.numbers)
        self.walled, self.optimum, self.priors = False, cast("State | None", None), cast("Priors | None", None)
        self._equations = list[NormalEquations]()  # shared by all versions of this graph
        used = self.positions.fixes.position[self.positions.used]
        if self.floor_sequence is not None and self.floor_sequence.building.near(used).any():
            self._use_plan(self.floor_sequence.within(*reach(self.chain, self.positions, steps)))
        elif self.floor_sequence is not None and (self.unplaced or len(self.sought)):
            self._use_plan(self.floor_sequence)

    def __repr__(self) -> str:
        plan = ["walls"] if self.walled else []
        sizes = {"step": len(self.steps), "keyframe": len(self.keyframe_time), "fix": len(self.fixes)}
        parts = [count(size, name) for name, size in sizes.items()]
        return f"WalkGraph({', '.join([*parts, *plan])})"

    @classmethod
    def under_way(
        cls,
        steps: Steps,
        chain: Chain,
        measurements: Sequence[Measurement],
        start: State,
        prior: Prior,
        floor_sequence: FloorSequence | None,
        priors: Priors,
        equations: list[NormalEquations],
    ) -> WalkGraph:
        """The graph of the last part of a walk, whose chain and measurements are there already.

        priors: those of variables that measurements add which hold, see `Evaluation`; equations: of graphs alike.
        """
        graph = object.__new__(cls)
        graph.steps, graph.chain, graph._measurements, graph.start = steps, chain, tuple(measurements), start
        graph.prior, graph.floor_sequence, graph.priors, graph._equations = prior, floor_sequence, priors, equations
        graph.walled, graph._associated, graph.optimum = floor_sequence is not None, True, None
        fixes = made_from(Fixes, measurements)
        graph.fixes = Fixes.none() if fixes is None else fixes.fixes
        return graph

    @classmethod
    def of(cls, steps: Steps, data: Sequence[Any], **options: Any) -> WalkGraph:
        """The graph of measurements of any types; options: as of ``WalkGraph``."""
        by_type = {type(table): table for table in data}
        fixes, headings = by_type.pop(Fixes, None), by_type.pop(Headings, None)
        return cls(steps, fixes, headings=headings, measurements=list(by_type.values()), **options)

    def _use_plan(self, floor_sequence: FloorSequence) -> None:
        self.floor_sequence, self.walled, self._associated = floor_sequence, True, False
        walls = walls_on_plan(floor_sequence, self.prior)
        self._measurements += (walls, *corridors_of(floor_sequence, self.prior))

    def _start_prior(self, heading: float) -> Measurement:
        """Prior of the first pose; heading: of the initial walk [rad]."""
        if len(sought := self.sought) and not self.positions.used.any():  # a straight walk can be anywhere along itself
            reach = float(np.sum(self.chain.pieces.length) + np.hypot(*np.ptp(sought, axis=0)))
            return start_near(sought.mean(axis=0), reach, heading)
        located = [kind for kind in self._measurements if kind.determines_position and not isinstance(kind, Locating)]
        if self.positions.used.any() or any(kind is not self.positions for kind in located):
            return first_heading_prior(heading)
        size = None if self.floor_sequence is None else self.floor_sequence.size
        return start_prior(heading, size, len(self.headings.headings) > 0)

    @property
    def measurements(self) -> tuple[Measurement, ...]:
        """All measurement kinds; those on the plan are associated along the start unless they already are."""
        if not self._associated:
            at = self.chain.evaluate(self.start)
            self._measurements = tuple(_associated(kind, at) for kind in self._measurements)
            self._associated = True
        return self._measurements

    def find(self, kind: type[Kind]) -> Kind | None:
        """The measurements of one kind; None if there are none."""
        return next((measurement for measurement in self._measurements if isinstance(measurement, kind)), None)

    @property
    def positions(self) -> Positions:
        """The fixes, with the classification of each."""
        return made_from(Fixes, self._measurements)

    @property
    def headings(self) -> Directions:
        """The headings."""
        return made_from(Headings, self._measurements)

    @property
    def walls(self) -> Any:
        """The walls along the walk, the first kind on the plan; None if no plan is used."""
        return next((kind for kind in self.measurements if isinstance(kind, OnPlan)), None)

    @property
    def ways(self) -> Ways | None:
        """The outdoor network that the walk may follow; None if there is none."""
        return ways_among(self._measurements)

    @property
    def unplaced(self) -> bool:
        """True if no measurement says where on its plan the walk was."""
        placing = any(kind.determines_position and kind is not self.positions for kind in self._measurements)
        return self.floor_sequence is not None and not self.positions.used.any() and not placing

    @property
    def sought(self) -> Array:
        """Places ``(n, 2)`` that the walk passed at unknown times [m]."""
        found = [kind.places for kind in self._measurements if isinstance(kind, Searching)]
        return np.concatenate([np.empty((0, 2)), *found])

    @property
    def pieces(self) -> Pieces:
        """The pieces of the walk."""
        return self.chain.pieces

    @property
    def segment(self) -> Index:
        """The calibration segment of each interval ``(k,)``."""
        return self.chain.segment

    @property
    def keyframe_time(self) -> Array:
        """Times of the poses x0, x1, … ``(k + 1,)``. [s]"""
        return self.chain.time

    def normal_equations(self, at: Evaluation) -> NormalEquations:
        """The normal equations of the factors at ``at``; those of the last graphs alike are used again."""
        found = next((known for known in self._equations if known.fits(at)), None) or NormalEquations(at)
        self._equations[:] = [found, *(known for known in self._equations if known is not found)][:MOST_EQUATIONS]
        return found

    def evaluate(self, state: State) -> Evaluation:
        """All factors at one state."""
        return self.chain.evaluate(state, self.measurements, self.priors)

    def initial_values(self) -> gtsam.Values:
        """The start of the search as ``gtsam.Values``: x0… of Pose2, c0… of (R_s, R_d, b), and the rest."""
        return self.start.to_values()

    def optimal_values(self) -> gtsam.Values:
        """The optimum as ``gtsam.Values``, with the keys of `to_gtsam`. Raises ValueError unless an estimate has it."""
        if self.optimum is None:
            raise ValueError("WalkGraph.optimal_values: found a graph to be smoothed, expected smooth(graph).graph")
        return self.optimum.to_values()

    def to_gtsam(self) -> gtsam.NonlinearFactorGraph:
        """The whole graph for GTSAM's own optimisers, with a guarded ``CustomFactor`` where GTSAM has no factor."""
        from pdr_graph.estimation.factors.gtsam_export import to_gtsam

        return to_gtsam(self.chain, self.measurements, self.start)

    def increments(self) -> Iterator[GtsamIncrement]:
        """The factors of `to_gtsam` keyframe by keyframe, for ``update`` of another incremental smoother.

        New variables begin at the start of the search: for a graph that was smoothed, at its optimum. A callback
        evaluates the whole walk, 1 ms for 300 keyframes: for longer walks, take graphs of parts.
        """
        from pdr_graph.estimation.factors.gtsam_export import increments

        return increments(self.chain, self.measurements, self.start)

    def error(self, values: gtsam.Values) -> float:
        """The cost at ``values``: half the sum of squared, robustly weighted residuals, as GTSAM counts it."""
        return self.evaluate(self.start.updated(values)).cost

    def smoothed(self, optimum: State) -> WalkGraph:
        """The graph of an estimate: at its optimum, without what only the search needs."""
        return self._replaced(_measurements=self.measurements, start=optimum, optimum=optimum, _equations=[])

    def extended(
        self, steps: Steps | None = None, tables: Sequence[Any] = (), floors: Sequence[str] | None = None
    ) -> WalkGraph:
        """The walk with the steps that follow, and with further measurements of any time.

        Chain and factors are those of the whole walk, however it is split. The search goes on from the present start:
        keyframes between those that were there lie on its path, those after its end are dead-reckoned.

        steps: which begin where those before ended; tables: rows of registered types; floors: labels of all rows of the
        longer walk, as of the constructor. Raises ValueError if the steps do not follow, or of a part of a walk.
        """
        if not hasattr(self, "data"):
            raise ValueError("WalkGraph.extended: found a part of a walk, expected a walk from its start")
        if steps is not None and abs(steps.start - self.steps.end) > INSTANT:
            expected = f"{self.steps.end:.3f} s, where those before end"
            raise ValueError(f"WalkGraph.extended: found steps from {steps.start:.3f} s on, expected {expected}")
        whole = self.steps if steps is None else concatenate_steps([self.steps, steps])
        every = *self.data, *tables
        data = [concatenate([rows for rows in every if type(rows) is kind]) for kind in dict.fromkeys(map(type, every))]
        data = [take(rows, np.argsort(last_time(rows), kind="stable")) for rows in data]
        options = {"floor": self.floor, "paths": self.paths, "prior": self._given, "others": self._others}
        graph = WalkGraph.of(whole, data, floors=floors, **options)
        start = Path.of(self.chain, self.start).placed(graph.chain, graph.start)
        return graph.at(start)

    def at(self, state: State) -> WalkGraph:
        """Start the search at ``state``."""
        return self._replaced(start=state)

    def also(self, measurements: Sequence[Measurement]) -> WalkGraph:
        """Add measurements that add no variables."""
        return self._replaced(_measurements=(*self._measurements, *measurements), _equations=[])

    @one_thread
    def between(self) -> Between:
        """Poses and covariances at any times by the graph of an estimate, see `poses_between`."""
        assert self.optimum is not None, "asked of the graph of an estimate"
        return between_of(self.evaluate(self.optimum), self.prior.mean)

    def starts(self) -> list[State]:
        """Where the search must start, beside ``start``, by the kinds that fit in several places."""
        at = self.chain.evaluate(self.start)
        kinds = [kind for kind in self._measurements if isinstance(kind, Searching)]
        return [state for kind in kinds for state in kind.starts(at, self.positions, self.sigma_direction)]

    def rotated(self, angle: float) -> WalkGraph:
        """Start the search with the walk rotated by ``angle`` [rad] about its fixes."""
        start = self.start.rotated(angle, pivot(self.start.poses, self.positions))
        kinds = restarted(self._measurements, start)
        return self._replaced(_measurements=kinds, start=start, _associated=not self.walled)

    def associated_at(self, start: State, stray: Array | float | None = None, alike: float = 1.0) -> WalkGraph:
        """Start the search at ``start`` and associate rooms and corridors along it.

        stray, alike: error of ``start``, see `OnPlan.associated`.
        """
        measurements = restarted(self._measurements, start)
        if self.walled:
            at = self.chain.evaluate(start)
            measurements = tuple(_associated(kind, at, stray, alike) for kind in measurements)
        return self._replaced(_measurements=measurements, start=start, _associated=True)

    def without_plan(self) -> WalkGraph:
        """Remove all factors of the floor plan."""
        kept = tuple(measurement for measurement in self._measurements if not isinstance(measurement, OnPlan))
        return self._replaced(_measurements=kept, walled=False, _associated=True)

    def staged(self, stage: Stage) -> WalkGraph:
        """All factors in their version for a stage of the search."""
        kinds = (kind.staged(stage) if isinstance(kind, Refined) else kind for kind in self.measurements)
        return self._replaced(_measurements=tuple(kinds))

    def alternatives(self) -> list[WalkGraph]:
        """Versions from whose optima the search must also start; empty if a single start is enough."""
        graphs = []
        for n, measurement in enumerate(self.measurements):
            before, after = self.measurements[:n], self.measurements[n + 1 :]
            for version in measurement.alternatives() if isinstance(measurement, Refined) else ():
                graphs.append(self._replaced(_measurements=(*before, version, *after)))
        return graphs

    def refined(self, at: Evaluation) -> WalkGraph:
        """The second pass from an optimum: less weight for outliers, common errors. ``self`` if nothing changes."""
        refined = tuple(kind.refined(at) if isinstance(kind, Refined) else kind for kind in self.measurements)
        if all(new is old for new, old in zip(refined, self.measurements, strict=True)):
            return self
        chain = replace(self.chain, heading=at.state.poses[:, 2])
        return self._with_variables(tuple(measurement.bind(chain) for measurement in refined))

    def assuming(self, measurements: Sequence[Measurement]) -> WalkGraph:
        """Replace the measurements of some kinds by other versions of them."""
        version = {type(measurement): measurement for measurement in measurements}
        return self._with_variables(tuple(version.get(type(kind), kind) for kind in self._measurements))

    def without(self, kind: Measurement) -> WalkGraph:
        """Remove the measurements of one kind."""
        return self._with_variables(tuple(other for other in self._measurements if type(other) is not type(kind)))

    def decided(self, decisions: Mapping[str, Mapping[str, AnyArray]]) -> WalkGraph:
        """Apply earlier decisions about measurements, by kind (relocated beacons)."""
        another = bool(decisions.get(WALKER_KIND)) and self.prior.another is not None
        graph = self.by_another_walker(self.start) if another else self
        kinds = [
            kind.continued(decisions[kind.name]) if kind.name in decisions and isinstance(kind, Remembered) else kind
            for kind in graph._measurements
        ]
        return graph._with_variables(tuple(kinds)) if decisions else self

    def by_another_walker(self, near: State) -> WalkGraph:
        """The same walk with the prior of another walker; its measurements are not classified yet.

        near: where the search starts unless the measurements determine the direction.
        """
        prior = self.prior.another
        assert prior is not None, "asked for where a profile corrected the steps"
        others = [(time, prior) for time, _ in self._others]
        options = {"floor": self.floor, "floors": self.floors, "paths": self.paths, "prior": prior, "others": others}
        graph = WalkGraph.of(self.steps, self.data, **options)
        graph = graph if self.walled else graph.without_plan()
        graph = graph._replaced(_measurements=by_another_walker(graph._measurements))
        return (
            graph
            if graph.sigma_direction < INITIAL.ambiguous
            else graph.associated_at(graph.start.replaced(x=near.poses))
        )

    def classified_as(self, other: WalkGraph) -> WalkGraph:
        """Classify measurements (outliers, consistent chain) as ``other``, the same graph but for plan and walker."""
        graph = self._replaced(chain=other.chain, prior=other.prior)
        kept = tuple(measurement for measurement in other.measurements if not isinstance(measurement, OnPlan))
        if other.ways is None or self.floor_sequence is None:
            return graph._with_variables((*kept, *(kind for kind in self._measurements if isinstance(kind, OnPlan))))
        beside = replace(self.floor_sequence, outdoors=other.ways.outdoors(other.chain))
        plan = walls_on_plan(beside, self.prior), *corridors_of(beside, self.prior)
        graph = graph._replaced(floor_sequence=beside)._with_variables((*kept, *plan))
        return graph.associated_at(graph.start)

    def same_association(self, other: WalkGraph) -> bool:
        """True if both graphs have the same rooms and corridors."""
        pairs = zip(self.measurements, other.measurements, strict=True)
        return all(a.same_association(b) for a, b in pairs if isinstance(a, OnPlan))

    def _with_variables(self, measurements: tuple[Measurement, ...]) -> WalkGraph:
        """Replace the measurements; variables that they add are at their initial values."""
        start = initial_state(self.start.poses, self.start.c, measurements, self.chain.numbers)
        return self._replaced(_measurements=measurements, start=start)

    def _replaced(self, **changes: Any) -> WalkGraph:
        other = copy(self)
        vars(other).update(changes)
        return other


def segments(pieces: Pieces, steps: Steps, changed: Array) -> Index:
    """The calibration segment of each keyframe interval: equal shares of about a hundred steps, cut at gaps and paces.

    changed: times at which the pace changes [s].
    """
    walked = np.searchsorted(steps.time, pieces.keyframe_time[:-1])
    count = max(1, round(len(steps) / MOTION.steps_per_segment))
    segment = np.minimum(walked * count // max(len(steps), 1), count - 1)
    bounds = np.round(np.sort(np.append(gap_ends(steps), changed)), DECIMALS)
    return np.unique(segment + np.searchsorted(bounds, pieces.keyframe_time[:-1], side="right"), return_inverse=True)[1]


def _associated(
    kind: Measurement, at: Evaluation, stray: Array | float | None = None, alike: float = 1.0
) -> Measurement:
    """The kind with its instances associated along the walk ``at``; stray, alike: see `OnPlan.associated`."""
    return kind.associated(at, stray, alike) if isinstance(kind, OnPlan) else kind


def _check(
    steps: Steps,
    fixes: Fixes | None,
    headings: Headings | None,
    floor: FloorPlan | Building | None,
    prior: Prior | None,
) -> None:
    """Raise TypeError for arguments of other types, ValueError for fixes that are not in metres."""
    expect("WalkGraph, steps", steps, Steps, instead="detect_steps(recording)")
    expect("WalkGraph, fixes", fixes, Fixes, None, instead="read_fixes(path, recording, frame)")
    expect("WalkGraph, headings", headings, Headings, None, instead="magnetic_headings(recording, frame, near)")
    expect("WalkGraph, floor", floor, FloorPlan, Building, None, instead="FloorPlan.load(path)")
    expect("WalkGraph, prior", prior, Prior, None)
    if fixes is not None and fixes.epsg is not None and len(fixes):
        expected = "metres: floor.frame.place(fixes), or frame_of(fixes).place(fixes) without a plan"
        raise ValueError(f"WalkGraph, fixes: found those of EPSG:{fixes.epsg}, expected {expected}")


def _labels(floor: FloorPlan | Building | None, floors: Sequence[str] | None, rows: int) -> tuple[str, ...]:
    """The floor's label of each row. Raises ValueError if a building of several floors comes without ``floors``."""
    if floors is not None:
        return tuple(floors)
    labels = () if floor is None else Building.around(floor).labels
    if len(labels) > 1:
        missing = f"none, with the floors {', '.join(labels)[:80]}"
        raise ValueError(f"WalkGraph, floors: found {missing}, expected a label for each row, as of floors_of(…)")
    return (labels[0] if len(labels) == 1 else "",) * rows
