"""What the measurements at a keyframe say of many poses there, for the weights of particles.

By default a kind weighs poses by its own residuals: its instances at the keyframe are evaluated once for each pose, as
if the poses were a walk. The priors of other variables (the place of an anchor, the path loss) widen the sigmas. A kind
that knows a shorter way has its own `pose_costs`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol, Self

import numpy as np

from pdr_graph.estimation.factors.base import CALIBRATION, POSE, FactorBlock, Linearized, Measurement, initial_state
from pdr_graph.estimation.factors.chain import Chain, Evaluation
from pdr_graph.estimation.factors.preintegration import Increments
from pdr_graph.estimation.factors.protocols import Structural
from pdr_graph.priors import PARTICLES
from pdr_graph.types import Array, Index, take


class PoseCosts(Protocol):
    """Measurements of one kind at a keyframe."""

    def costs(self, state: Array) -> Iterable[Array]:
        """Negative log-likelihoods ``(n,)`` of states ``(6, n)`` x, y, θ, R_s, R_d, b.

        Each is PARTICLES.outlier_price at most.
        """
        ...

    def place_sought(self, state: Array) -> tuple[Array, float] | None:
        """Position ``(2,)`` and sigma [m] that is far from all states ``(6, n)``, where some of them may belong."""
        ...


class WeighsPoses(Structural):
    """A kind that weighs poses otherwise than by its residuals."""

    @abstractmethod
    def pose_costs(self, keyframe: int) -> PoseCosts | None:
        """The instances at a keyframe; None without any."""
        ...


class LimitsSteps(Structural):
    """A kind that says that the walker stood during an interval, though steps err by more."""

    @abstractmethod
    def standing_variance(self, interval: int) -> float:
        """Largest variance [m²] per axis of the displacement in an interval between keyframes; infinite if unknown."""
        ...


class Repeatable(Structural):
    """A kind whose instances are not rows of its columns alone."""

    @abstractmethod
    def repeated(self, which: Index, keyframe: Index) -> Self:
        """The instances ``which (n,)``, any of them several times, bound to other keyframes ``(n,)``."""
        ...


def _repeated(kind: Any, which: Index, keyframe: Index) -> Any:
    """As `Repeatable.repeated`; of other kinds, all columns and tables with a row for each instance."""
    if isinstance(kind, Repeatable):
        return kind.repeated(which, keyframe)
    changed: dict[str, Any] = {"keyframe": keyframe}
    for name, column in vars(kind).items():
        rows = name in {each.name for each in fields(kind)} and name != "keyframe"
        if rows and isinstance(column, np.ndarray) and len(column) == len(kind.keyframe):
            changed[name] = column[which]
        elif rows and hasattr(column, "time") and len(column) == len(kind.keyframe):
            changed[name] = take(column, which)
    return replace(kind, **changed)


def pose_costs(measurements: Sequence[Measurement], keyframe: int) -> tuple[PoseCosts, ...]:
    """The measurements of all kinds at a keyframe."""
    costs = [
        kind.pose_costs(keyframe) if isinstance(kind, WeighsPoses) else _by_residuals(kind, keyframe)
        for kind in measurements
        if not kind.on_plan
    ]
    return tuple(one for one in costs if one is not None)


def _by_residuals(kind: Measurement, keyframe: int) -> Residuals | None:
    """The instances of a kind at a keyframe; None for kinds whose instances are not bound to one keyframe each."""
    bound = vars(kind).get("keyframe")
    if not isinstance(bound, np.ndarray) or bound.ndim != 1:
        return None
    which = np.flatnonzero(bound == keyframe)
    return Residuals(_repeated(kind, which, np.zeros(len(which), dtype=np.intp))) if len(which) else None


@dataclass(frozen=True)
class Residuals:
    """Costs of poses by the residuals of a kind. kind: its instances at the keyframe, bound to keyframe 0."""

    kind: Measurement

    def costs(self, state: Array) -> Iterable[Array]:
        """The sum of the losses of all factors of each pose."""
        n, f = state.shape[1], len(vars(self.kind)["keyframe"])
        each = _repeated(self.kind, np.tile(np.arange(f), n), np.arange(n).repeat(f))
        walk = initial_state(np.ascontiguousarray(state[:3].T), np.ascontiguousarray(state[3:].T), (each,))
        none = np.empty((0, 3))
        increments, nothing = Increments(none, np.empty((0, 3, 3))), Linearized(none, *(np.empty((0, 3, 3)),) * 3)
        at = Evaluation(Chain.keyframe_alone(0.0, 0, 0), walk, (each,), increments, nothing)
        priors = _prior_variances(at)
        for block in at.blocks:
            poses = [rows for symbol, rows in block.variables if symbol == POSE]
            if len(poses) == 1 and not block.prior:
                deviation = block.deviation / _widening(block, priors)
                cost = np.minimum(block.loss.cost(deviation), PARTICLES.outlier_price)
                yield np.asarray(np.bincount(poses[0], cost, n), dtype=np.float64)

    def place_sought(self, state: Array) -> None:
        """Residuals determine no single place."""


def _prior_variances(at: Evaluation) -> dict[str, Array]:
    """Variances ``(n, 3)`` of the variables of each symbol by their priors alone."""
    variances = dict[str, Array]()
    for block in at.blocks:
        if block.prior and block.rows_each:
            symbol, rows = block.variables[0]
            J = block.jacobian()[0].reshape(len(block), block.rows_each, 3)
            information = np.zeros((len(at.state[symbol]), 3, 3))
            information[rows] = J.transpose(0, 2, 1) @ J
            inverse = np.linalg.inv(information + 1e-9 * np.eye(3))
            variances[symbol] = np.diagonal(inverse, axis1=1, axis2=2).astype(float)
    return variances


def _widening(block: FactorBlock, priors: dict[str, Array]) -> Array:
    """Factors ``(n,)`` by which sigmas are wider, by the errors of other variables and by PARTICLES.least_sigma."""
    variance, slope = np.ones(len(block.residual)), np.zeros(len(block.residual))
    for (symbol, rows), by in zip(block.variables, block.jacobian(), strict=True):
        if symbol == POSE:
            slope = by[:, 0] ** 2 + by[:, 1] ** 2
        elif symbol in priors and symbol != CALIBRATION:
            variance += np.einsum("mi,mi->m", by**2, priors[symbol][rows[block.row_of]])
    widest = np.zeros(len(block))
    np.maximum.at(widest, block.row_of, np.maximum(variance, PARTICLES.least_sigma**2 * slope))
    return np.sqrt(np.maximum(widest, 1.0))
