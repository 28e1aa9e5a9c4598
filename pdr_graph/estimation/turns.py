"""The turn factor: turns of a walk at the intersections of its floor.

Of a turn that was matched to an intersection two things are known: [map-matching] Eq. (6) bounds by how much one can
turn there, from one corridor into the other; and one turns in the intersection, between the walls of both corridors.
Both are free within their bounds and quadratic outside. Which turn is at which intersection is data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from pdr_graph.estimation.linearised import Linearised
from pdr_graph.geometry import wrap_angle
from pdr_graph.types import Array, Index

SIGMA_TURNED = 0.05  # [rad] of a heading change: a walker of whom only a few steps are straight in a corridor
SIGMA_PLACE = 0.5  # [m] outside the intersection: corners are cut, and the step nearest to the turn is half a step off


@dataclass(frozen=True, eq=False)
class Turns:
    """Turns of a walk, ``t`` of them.

    before, after: ``(t,)`` keyframes in the corridors on either side; least, most: ``(t,)`` heading change from the one
    to the other, counter-clockwise [rad]; piece: ``(t,)`` of the walk that ends where it turns; normal: ``(t, 4, 2)``
    outward of the sides of the intersection; edge: ``(t, 4)`` how far along these the sides are [m].
    """

    before: Index
    after: Index
    least: Array
    most: Array
    piece: Index
    normal: Array
    edge: Array

    def __len__(self) -> int:
        return len(self.piece)

    def turned(self, heading: Array) -> tuple[Array, Array]:
        """By how much the keyframes' headings ``(k + 1,)`` turn too much or too little ``(t,)``, and the derivative:

            r = [ max(0, δ − β) − max(0, α − δ) ] / σ,      δ = θ_after − θ_before

        The derivative is by θ_after; by θ_before it is the opposite.
        """
        off = wrap_angle(heading[self.after] - heading[self.before] - (self.least + self.most) / 2)
        beyond = np.maximum(np.abs(off) - (self.most - self.least) / 2, 0.0)
        return np.sign(off) * beyond / SIGMA_TURNED, (beyond > 0) / SIGMA_TURNED

    def place(self, poses: Linearised) -> Linearised:
        """How far beyond each side ``(t, 4)`` of its intersection each turn is: r = max(0, n p − e) / σ.

        Of an intersection with right angles the sum of the squares is that of the distance. poses: of all pieces.
        """
        turning = poses.take(self.piece)
        beyond = np.einsum("tsk,tk->ts", self.normal, turning.value[:, :2]) - self.edge
        slope = np.zeros((*beyond.shape, 3))
        slope[:, :, :2] = self.normal * (beyond > 0)[:, :, None] / SIGMA_PLACE
        value = np.maximum(beyond, 0.0) / SIGMA_PLACE
        return Linearised(value, slope @ turning.by_i, slope @ turning.by_j, slope @ turning.by_c)

    def take(self, which: Index) -> Turns:
        """The turns with these indices."""
        return Turns(*(getattr(self, column.name)[which] for column in fields(self)))

    def only(self, pieces: slice) -> Turns:
        """The turns in some pieces, counted from the first of these. Their keyframes are those of the whole walk."""
        here = np.flatnonzero((self.piece >= pieces.start) & (self.piece < pieces.stop))
        return replace(self.take(here), piece=self.piece[here] - pieces.start)

    @classmethod
    def together(cls, turns: Sequence[Turns]) -> Turns | None:
        """All of them; None of none."""
        columns = [[getattr(turn, column.name) for turn in turns] for column in fields(cls)]
        return cls(*(np.concatenate(column) for column in columns)) if turns else None
