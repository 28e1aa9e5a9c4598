"""The factor graph of one walk: its keyframes, its measurements as factors, and where the search starts.

x_0 ──steps── x_1 ──steps── x_2 ── … ── x_k     x_i  Pose2 at keyframe i
 │    ╲c_0╱    ╲  c_0 ╱      │                  c_s  (R_s, R_d, b) of segment s, a random walk
fix           walls         fix                 g_m  offset and lag of a receiver, slowly varying
 ╰─── g_0 ────── g_1 ───────╯                   b_m  place and power of a beacon; q  (P, n, k) of their path loss
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any, TypeVar

import gtsam
import numpy as np

from pdr_graph.errors import expect
from pdr_graph.estimation.factors import measurements_of
from pdr_graph.estimation.factors.base import AnyArray, Measurement, Stage, State, initial_state
from pdr_graph.estimation.factors.chain import Chain, Evaluation
from pdr_graph.estimation.factors.corridor import CorridorFactor
from pdr_graph.estimation.factors.fixes import FixFactor
from pdr_graph.estimation.factors.gnss_bias import GnssBias
from pdr_graph.estimation.factors.gtsam_export import to_gtsam
from pdr_graph.estimation.factors.heading_prior import HeadingFactor
from pdr_graph.estimation.factors.preintegration import DECIMALS, Pieces, cut
from pdr_graph.estimation.factors.start import CalibrationFactor, Prior, StartFactor
from pdr_graph.estimation.factors.steps_and_walls import StepFactor, WallFactor
from pdr_graph.estimation.initialization import initial_walk, pivot, reach
from pdr_graph.floor.building import Building, FloorSequence
from pdr_graph.floor.cells import STRAY
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.measurements import Closures, Levels
from pdr_graph.types import Array, Fixes, Headings, Index, Steps

STEPS_PER_SEGMENT = 100
FIX_KINDS = (FixFactor.name, GnssBias.name)
Kind = TypeVar("Kind", bound=Measurement)


class WalkGraph:
    """Every measurement of one walk as a factor.

    steps: the walk as the front end saw it; fixes: in the frame of ``floor`` (or any metric frame without one);
    headings: walking directions in that frame; floor: whose walls are factors, optional, or a building; floors: the
    floor's label for each row of the trajectory ``(n + 2,)``, expected with a building of several; levels: of beacons;
    closures: moments at one place; measurements: of any other kind (`Ranges`);
    prior: see ``Prior``; others: of further walks in the same steps, when they begin, in order [s], and
    the priors of their walkers.

    chain: keyframes and steps; measurements: its factors, kind by kind; start: where the search starts;
    sigma_direction: how well fixes and headings determine the walk's direction [rad]; walled: walls are used.

    Raises TypeError, or ValueError where fixes are not in metres or nothing tells the floors of a building.
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
        prior: Prior | None = None,
        others: Sequence[tuple[float, Prior]] = (),
    ):
        _check(steps, fixes, headings, floor, prior)
        self.steps, self.floor, self.prior = steps, floor, prior or Prior()
        self.given = Fixes.none() if fixes is None else fixes
        others_given = [one for one in (levels, closures, *measurements) if one is not None and len(one)]
        self.data = [self.given, headings or Headings.none(), *others_given]

        # Keyframes where something was measured, and a calibration for each segment between
        kinds = [kind for one in self.data for kind in measurements_of(one, steps, self.prior)]
        kinds = _with_rough_fixes(kinds, steps, self.prior)
        lost = steps.is_gap
        gaps = [steps.time[lost] - steps.duration[lost], steps.time[lost]]
        pieces = cut(steps, np.concatenate([*(one.keyframe_times() for one in kinds), *gaps]))
        segment = segments(pieces, steps)
        begins = {_segment_at(pieces, segment, time): prior for time, prior in others} | {0: self.prior}
        c = _prior_means(begins, int(segment[-1]) + 1)
        self.chain = Chain.of(pieces, segment, c)
        self.floors = _labels(floor, floors, len(steps) + 2)

        # Where to start
        kinds = [one.on(self.chain) for one in kinds]
        self._measurements: tuple[Measurement, ...] = tuple(kinds)
        self._associated = True
        initial = initial_walk(self.chain, self.positions, self.headings, steps, c, self.prior.sigma[0])
        self.sigma_direction = initial.sigma_direction

        # All factors; no walls for a walk without a position, or off the plan
        self.floor_sequence = None if floor is None else FloorSequence.of(floor, self._floor_of_pieces)
        known = {s: (np.array(one.mean), one.covariance) for s, one in begins.items()}
        hold = _hold(self.positions, self.headings, self.floor_sequence, float(initial.poses[0, 2]))
        kinds = [StepFactor(), *(one.initialized(initial.poses) for one in kinds)]
        self._measurements = (*kinds, CalibrationFactor(known, self.prior.change), hold)
        self.start = initial_state(initial.poses, initial.c, self._measurements)
        self.walled = False
        used = self.positions.fixes.position[self.positions.used]
        if self.floor_sequence is not None and self.floor_sequence.near(used).any():
            self._use_plan(self.floor_sequence.within(*reach(self.chain, self.positions, steps)))

    @classmethod
    def of(cls, steps: Steps, data: Sequence[Any], **options: Any) -> WalkGraph:
        """The graph of measurements of any types; options: as of ``WalkGraph``."""
        own = {type(one): one for one in data}
        fixes, headings = own.pop(Fixes, None), own.pop(Headings, None)
        return cls(steps, fixes, headings=headings, measurements=list(own.values()), **options)

    def _use_plan(self, floor_sequence: FloorSequence) -> None:
        self.floor_sequence, self.walled, self._associated = floor_sequence, True, False
        self._measurements += (WallFactor.about(floor_sequence, self.prior.wall_margin, self.prior.wall_sigma),)
        use = self.prior.corridors
        if use.turns or use.directions:
            self._measurements += (CorridorFactor.about(floor_sequence, use),)

    # What it is made of

    @property
    def measurements(self) -> tuple[Measurement, ...]:
        """All kinds of factors; those on the plan associated along the start if not along another walk."""
        if not self._associated:
            at = self.chain.evaluate(self.start)
            self._measurements = tuple(one.associated(at) for one in self._measurements)
            self._associated = True
        return self._measurements

    def find(self, kind: type[Kind]) -> Kind | None:
        """The measurements of one kind, None if there are none."""
        return next((one for one in self._measurements if isinstance(one, kind)), None)

    @property
    def positions(self) -> FixFactor:
        """The fixes, with the classification of each."""
        found = self.find(FixFactor)
        assert found is not None, "every graph has one"
        return found

    @property
    def headings(self) -> HeadingFactor:
        """The headings."""
        found = self.find(HeadingFactor)
        assert found is not None, "every graph has one"
        return found

    @property
    def walls(self) -> WallFactor | None:
        """The walls about the steps; None where none are known or asked for."""
        return next((one for one in self.measurements if isinstance(one, WallFactor)), None)

    @property
    def pieces(self) -> Pieces:
        """The walk, cut."""
        return self.chain.pieces

    @property
    def segment(self) -> Index:
        """The calibration segment of each interval ``(k,)``."""
        return self.chain.segment

    @property
    def keyframe_time(self) -> Array:
        """When the poses x0, x1, … are ``(k + 1,)``. [s]"""
        return self.chain.time

    @property
    def _floor_of_pieces(self) -> list[str]:
        row = np.searchsorted(self.pieces.row_end, np.arange(len(self.pieces.length))) + 1
        return [self.floors[r] for r in row.tolist()]

    # At one state

    def evaluate(self, state: State) -> Evaluation:
        """All factors at one state."""
        return self.chain.evaluate(state, self.measurements)

    def initial_values(self) -> gtsam.Values:
        """Where the search starts, as GTSAM has it: x0… of Pose2, c0… of (R_s, R_d, b), and the rest."""
        return self.start.to_values()

    def to_gtsam(self) -> gtsam.NonlinearFactorGraph:
        """The whole graph for GTSAM's own optimisers, with a guarded ``CustomFactor`` where GTSAM has no factor."""
        return to_gtsam(self.chain, self.measurements, self.start)

    def error(self, values: gtsam.Values) -> float:
        """The cost at ``values``: half the sum of squared, robustly weighted residuals, as GTSAM counts it."""
        return self.evaluate(self.start.updated(values)).cost

    # The same measurements otherwise

    def rotated(self, angle: float) -> WalkGraph:
        """Start the search with the walk rotated by ``angle`` [rad] about its fixes."""
        start = self.start.rotated(angle, pivot(self.start.poses, self.positions))
        return self._replaced(_measurements=self._restarted(start), start=start, _associated=not self.walled)

    def associated_at(self, start: State, stray: Array | float = STRAY, alike: float = 1.0) -> WalkGraph:
        """Start the search at ``start``, whose rooms and corridors are taken for those of the walk.

        stray, alike: by how much it errs, see `Measurement.associated`.
        """
        measurements = self._restarted(start)
        if self.walled:
            at = self.chain.evaluate(start)
            measurements = tuple(one.associated(at, stray, alike) for one in measurements)
        return self._replaced(_measurements=measurements, start=start, _associated=True)

    def without_plan(self) -> WalkGraph:
        """Leave out what is evidence of the floor plan."""
        kept = tuple(one for one in self._measurements if not one.on_plan)
        return self._replaced(_measurements=kept, walled=False, _associated=True)

    def staged(self, stage: Stage) -> WalkGraph:
        """All factors in their version for a stage of the search."""
        return self._replaced(_measurements=tuple(one.staged(stage) for one in self.measurements))

    def alternatives(self) -> list[WalkGraph]:
        """Versions from whose optima the search must start too; empty if one start will do."""
        found = []
        for n, one in enumerate(self.measurements):
            for other in one.alternatives():
                found.append(self._replaced(_measurements=(*self.measurements[:n], other, *self.measurements[n + 1 :])))
        return found

    def refined(self, at: Evaluation) -> WalkGraph:
        """The second pass from an optimum: less weight for outliers, common errors. Itself if nothing changes."""
        refined = tuple(one.refined(at) for one in self.measurements)
        if all(one is other for one, other in zip(refined, self.measurements, strict=True)):
            return self
        return self._with_variables(tuple(one.on(self.chain) for one in refined))

    def corrected(self, at: Evaluation) -> WalkGraph | None:
        """Leave out what an optimum shows to be listed wrongly; None if nothing is."""
        corrected = [one.corrected(at) for one in self.measurements]
        if not any(corrected):
            return None
        merged = tuple(new or old for new, old in zip(corrected, self.measurements, strict=True))
        return self._with_variables(merged)

    def decided(self, decisions: Mapping[str, Mapping[str, AnyArray]]) -> WalkGraph:
        """Take over what was decided about measurements, by kind (beacons that are elsewhere)."""
        kinds = [one.continued(decisions[one.name]) if one.name in decisions else one for one in self._measurements]
        return self._with_variables(tuple(kinds)) if decisions else self

    def classified_as(self, other: WalkGraph) -> WalkGraph:
        """Classify measurements (outliers, consistent chain) as ``other``, the same graph but for the plan."""
        plan = tuple(one for one in self._measurements if one.on_plan)
        return self._with_variables((*(one for one in other.measurements if not one.on_plan), *plan))

    def same_association(self, other: WalkGraph) -> bool:
        """True if both lead through the same rooms and corridors."""
        return all(a.same_association(b) for a, b in zip(self.measurements, other.measurements, strict=True))

    def _restarted(self, start: State) -> tuple[Measurement, ...]:
        return tuple(one.restarted(start.poses) for one in self._measurements)

    def _with_variables(self, measurements: tuple[Measurement, ...]) -> WalkGraph:
        """With the variables that these measurements bring, at their initial values."""
        start = initial_state(self.start.poses, self.start.c, measurements)
        return self._replaced(_measurements=measurements, start=start)

    def _replaced(self, **changes: Any) -> WalkGraph:
        other = copy(self)
        vars(other).update(changes)
        return other


def segments(pieces: Pieces, steps: Steps) -> Index:
    """The calibration segment of each keyframe interval: equal shares of about a hundred steps, cut at gaps."""
    walked = np.searchsorted(steps.time, pieces.keyframe_time[:-1])
    count = max(1, round(len(steps) / STEPS_PER_SEGMENT))
    segment = np.minimum(walked * count // max(len(steps), 1), count - 1)
    gaps = np.searchsorted(np.round(steps.time[steps.is_gap], DECIMALS), pieces.keyframe_time[:-1], side="right")
    return np.unique(segment + gaps, return_inverse=True)[1]


def _with_rough_fixes(kinds: list[Measurement], steps: Steps, prior: Prior) -> list[Measurement]:
    """Add approximate positions from other measurements if no fix can be used."""
    fixed = any(isinstance(one, FixFactor) and one.used.any() for one in kinds)
    rough = next((rough for one in kinds if len(rough := one.rough_fixes())), None)
    if fixed or rough is None:
        return kinds
    return [FixFactor.of(rough, steps, prior, approximate=True), *(one for one in kinds if one.name not in FIX_KINDS)]


def _hold(
    positions: FixFactor, headings: HeadingFactor, floor_sequence: FloorSequence | None, heading: float
) -> StartFactor:
    """Prior of the first pose."""
    if positions.used.any():
        return StartFactor.heading(heading)
    return StartFactor.frame(
        heading, None if floor_sequence is None else floor_sequence.size, len(headings.headings) > 0
    )


def _segment_at(pieces: Pieces, segment: Index, time: float) -> int:
    """The calibration segment that begins at a time [s]."""
    return int(segment[np.searchsorted(pieces.keyframe_time[:-1], np.round(time, DECIMALS))])


def _prior_means(begins: Mapping[int, Prior], count: int) -> Array:
    """Prior mean ``(s, 3)`` of the calibration of each segment."""
    first = np.array(sorted(begins))
    means = np.array([begins[s].mean for s in first.tolist()])
    return means[np.searchsorted(first, np.arange(count), side="right") - 1]


def _check(
    steps: Steps,
    fixes: Fixes | None,
    headings: Headings | None,
    floor: FloorPlan | Building | None,
    prior: Prior | None,
) -> None:
    """Raise on arguments of other types, and on fixes that are not in metres."""
    expect("WalkGraph, steps", steps, Steps, instead="detect_steps(recording)")
    expect("WalkGraph, fixes", fixes, Fixes, None, instead="read_fixes(path, recording, frame)")
    expect("WalkGraph, headings", headings, Headings, None, instead="magnetic_headings(recording, frame, near)")
    expect("WalkGraph, floor", floor, FloorPlan, Building, None, instead="FloorPlan.load(path)")
    expect("WalkGraph, prior", prior, Prior, None)
    if fixes is not None and fixes.epsg is not None and len(fixes):
        expected = "metres: floor.frame.place(fixes), or frame_of(fixes).place(fixes) without a plan"
        raise ValueError(f"WalkGraph, fixes: found those of EPSG:{fixes.epsg}, expected {expected}")


def _labels(floor: FloorPlan | Building | None, floors: Sequence[str] | None, rows: int) -> tuple[str, ...]:
    """The floor's label of each row."""
    if floors is not None:
        return tuple(floors)
    known = () if floor is None else Building.around(floor).labels
    if len(known) > 1:
        found = f"none, with the floors {', '.join(known)[:80]}"
        raise ValueError(f"WalkGraph, floors: found {found}, expected a label for each row, as of floors_of(…)")
    return (known[0] if len(known) == 1 else "",) * rows
