"""Steps between keyframes, and the walls along them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from pdr_graph.estimation.factors.base import FactorBlock, Measurement, OnPlan, Refined, Stage
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.floor.building import FloorSequence
from pdr_graph.floor.cells import NOWHERE
from pdr_graph.floor.distance_field import DistanceField
from pdr_graph.priors import WALLS
from pdr_graph.types import Array, Index

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.chain import Evaluation

LOOSE = 3.0  # times the sigma of walls in a rough search: tight walls keep a walk in a wrong aisle
STIFF = 0.1  # times that sigma at WALLS.body


@dataclass(frozen=True, eq=False)
class StepFactor(Measurement):
    """The steps, preintegrated between keyframes: x_j = x_i ∘ Δ(c), with c the walker's calibration.

    [heading] Sec. 1, [calibration-walk] Eqs. (8), (9), [map-matching] Eqs. (4), (5); see `step_residuals`.

    doubted: ``(k, 3, 3)`` root of the information of each interval where its direction is assumed to be wrong somewhere
    in it, as `Bridge.root`; None if nowhere.
    """

    doubted: Array | None = None

    name: ClassVar[str] = "steps"

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """One factor for each interval."""
        chain, root = at.chain, at.chain.bridge.root if self.doubted is None else self.doubted
        value = np.einsum("kij,kj->ki", root, at.step_residual.value)
        i = np.arange(len(value))
        variables = (("x", i), ("x", i + 1), ("c", chain.segment))

        def jacobian() -> list[Array]:
            whitened = at.step_residual.times(root)
            return [whitened.by_i, whitened.by_j, whitened.by_c]

        return [FactorBlock.uniform(self.name, value, variables, jacobian, chain.number[1:])]


@dataclass(frozen=True, eq=False)
class WallFactor(OnPlan, Refined):
    """Walls: steps keep clear of them, and bodies stay out of them.

    floor_sequence: the floor of each piece; fields: distances to the walls of a region; field_of: ``(m,)`` index of the
    field of each piece, −1 none; margin: clearance that people keep [m]; sigma: of that clearance [m].
    price: of the regions that the walk leads through.
    """

    floor_sequence: FloorSequence | None
    fields: tuple[DistanceField, ...]
    field_of: Index
    margin: float
    sigma: float
    price: float = 0.0

    name: ClassVar[str] = "walls"

    def associated(self, at: Evaluation, stray: Array | float | None = None, alike: float = 1.0) -> Self:
        """Associate each piece with the walls of its region along the walk ``at``; stray, alike: see `OnPlan`."""
        if self.floor_sequence is None:
            return self
        fields, field_of, price = self.floor_sequence.walls_along(at.ends[:, :2], at.pieces.length > 0, stray, alike)
        return replace(self, fields=fields, field_of=field_of, price=price)

    def staged(self, stage: Stage) -> Self:
        """Wider sigma in a rough search."""
        return replace(self, sigma=LOOSE * self.sigma) if stage is Stage.ROUGH else self

    def same_association(self, other: Measurement) -> bool:
        """True if all pieces are in the same regions."""
        assert isinstance(other, WallFactor)
        return self.fields == other.fields and np.array_equal(self.field_of, other.field_of)

    def distance(self, points: Array) -> tuple[Array, Array]:
        """Signed distance ``(m,)`` [m] of each piece's end to its walls, and its gradient ``(m, 2)``."""
        distance, gradient = np.full(len(points), np.inf), np.zeros((len(points), 2))
        for n, field in enumerate(self.fields):
            here = self.field_of == n
            distance[here], gradient[here] = field.at(points[here])
        return distance, gradient

    def residual(self, at: Evaluation) -> tuple[Array, Array]:
        """A spring that keeps steps clear of walls, and a stiff spring that keeps bodies out of them, whitened:

            r = max(0, margin − d(p)) / σ + max(0, WALLS.body − d(p)) / σ_body

        d is the signed distance to the walls of the piece's own region, negative behind the thinnest wall. A piece in
        which nobody moved adds no evidence. [map-matching] Sec. 3.5 forbids steps through walls; as a hinge on a
        distance field it is GPMP2's (Mukadam et al., IJRR 2018).

        Returns r ``(m,)`` and its gradient ``(m, 2)`` by the position.
        """
        distance, gradient = self.distance(at.ends[:, :2])
        moved = at.pieces.length > 0
        r, steepness = np.zeros(len(distance)), np.zeros(len(distance))
        for keep, sigma in ((self.margin, self.sigma), (WALLS.body, STIFF * self.sigma)):
            near = moved & (distance < keep)
            r += np.where(near, keep - distance, 0.0) / sigma
            steepness += near / sigma
        return r, -gradient * steepness[:, None]

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """One factor for each interval, with a row for each of its steps that is near walls."""
        r, gradient = self.residual(at)
        near = np.flatnonzero(r)
        chain, i = at.chain, np.arange(len(at.pieces.first))
        variables = (("x", i), ("x", i + 1), ("c", chain.segment))

        def jacobian() -> list[Array]:
            poses = at.poses_of(near)
            slope = np.zeros((len(near), 1, 3))
            slope[:, 0, :2] = gradient[near]
            return [(slope @ by)[:, 0] for by in (poses.by_i, poses.by_j, poses.by_c)]

        return [
            FactorBlock(
                self.name,
                r[near],
                at.pieces.interval[near],
                variables,
                jacobian,
                chain.number[1:],
                most_rows=np.bincount(at.pieces.interval),
            )
        ]


def steps_between_keyframes() -> StepFactor:
    """The steps of a walk, one factor for each interval of its chain."""
    return StepFactor()


def walls_on_plan(floor_sequence: FloorSequence, prior: Prior) -> WallFactor:
    """The walls of the floors of a walk, before their association with its pieces."""
    nowhere = np.full(len(floor_sequence.level), NOWHERE)
    return WallFactor(floor_sequence, (), nowhere, prior.wall_margin, prior.wall_sigma)


def walls_of_fields(
    fields: Sequence[DistanceField], field_of: Index, prior: Prior, floor_sequence: FloorSequence | None
) -> WallFactor:
    """The walls with which the pieces of a walk are associated; field_of: ``(m,)`` field of each piece, −1 none."""
    return WallFactor(floor_sequence, tuple(fields), field_of, prior.wall_margin, prior.wall_sigma)
