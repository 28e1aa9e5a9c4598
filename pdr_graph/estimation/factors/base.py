"""Building blocks of factors (variables, states, losses, residuals with derivatives), and what a measurement kind is.

A `Measurement` is all instances of one kind on one walk: the times at which it needs keyframes, the variables it adds,
its residuals with derivatives and weights, and its reports. Batch smoother, live smoother, filter, GTSAM export,
reports and journal loop over a list of them and name none. A kind that does more inherits some of the seven interfaces
at the end of this file, of which a subclass defines only the methods that it needs.

A loss is a function of the deviation s of a factor, in sigmas; its weight w(s) = ρ'(s) / s is the share of the factor's
information that is used. Huber's never reaches 0 and has one minimum. Geman and McClure's tends to 0 far off, and is
used only for outliers from a first optimum.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from pdr_graph.geometry import interpolate, rotation, wrap_angle
from pdr_graph.priors import LOSSES
from pdr_graph.types import KEYFRAME, Array, Fixes, Index, Mask, declared

if TYPE_CHECKING:
    import gtsam

    from pdr_graph.estimation.ambiguity.hypothesis import Proposal
    from pdr_graph.estimation.factors.chain import Chain, Evaluation
    from pdr_graph.estimation.factors.fixes import FixFactor


def huber_weight(deviation: Array, width: float | None = None) -> Array:
    """Huber's weight ``(n,)`` at deviations ``(n,)`` [σ]: full up to ``width``."""
    return np.minimum(1.0, (width or LOSSES.huber) / np.maximum(np.abs(deviation), 1e-9))


def geman_mcclure_weight(deviation: Array, width: float | None = None) -> Array:
    """Geman and McClure's weight ``(n,)`` at deviations ``(n,)`` [σ]: it tends to 0 far off."""
    square = (width or LOSSES.huber) ** 2
    return (square / (square + deviation**2)) ** 2


def huber_cost(deviation: Array) -> Array:
    """Huber's loss ``(n,)`` at deviations ``(n,)`` [σ]."""
    inlier = np.minimum(np.abs(deviation), LOSSES.huber)
    return inlier * (np.abs(deviation) - inlier / 2)


class Loss:
    """Half the squared deviation: errors are Gaussian."""

    def weight(self, deviation: Array) -> Array:
        """Weights ``(n,)`` at deviations ``(n,)`` [σ]."""
        return np.ones(len(deviation))

    def cost(self, deviation: Array) -> Array:
        """Costs ``(n,)`` at deviations ``(n,)`` [σ]."""
        return 0.5 * deviation**2

    def noise(self, n: int, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base | None:
        """GTSAM's noise model of factor ``n`` with this loss, None if GTSAM has none; noise: its Gaussian model.

        The export puts a loss that GTSAM does not have into the residual; its weight must not rise with the deviation.
        """
        return noise if type(self) is Loss else None


GAUSSIAN = Loss()


@dataclass(frozen=True)
class RobustLoss(Loss):
    """Huber's loss, and Geman and McClure's for outliers.

    outlier: ``(n,)``; width: of Geman and McClure's [σ].
    """

    outlier: Mask
    width: float = field(default_factory=lambda: LOSSES.huber)

    def weight(self, deviation: Array) -> Array:
        """Weights ``(n,)`` at deviations ``(n,)`` [σ]."""
        return np.where(self.outlier, geman_mcclure_weight(deviation, self.width), huber_weight(deviation))

    def cost(self, deviation: Array) -> Array:
        """Costs ``(n,)`` at deviations ``(n,)`` [σ]."""
        square = deviation**2
        return np.where(self.outlier, 0.5 * self.width**2 * square / (self.width**2 + square), huber_cost(deviation))

    def noise(self, n: int, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
        """GTSAM's noise model of factor ``n``."""
        import gtsam

        robust, estimator = gtsam.noiseModel.Robust, gtsam.noiseModel.mEstimator
        if self.outlier[n]:
            return robust.Create(estimator.GemanMcClure.Create(self.width), noise)
        return robust.Create(estimator.Huber.Create(LOSSES.huber), noise)


AnyArray = NDArray[Any]
POSE, CALIBRATION = "x", "c"  # the symbols of the variables that every walk has
PLANE = np.array([1.0, 1.0, 0.0])  # components of a variable that are a position, where the third is something else


KEY_NUMBER = (1 << 56) - 1  # the bits of a key that are the number


def key(symbol: str, number: int = 0) -> int:
    """GTSAM's key of a variable, as ``gtsam.symbol`` makes it: the symbol in the highest of eight bytes."""
    return ord(symbol) << 56 | number


@dataclass(frozen=True)
class Variables:
    """Variables of one symbol that a measurement kind adds.

    number: ``(n,)`` in their GTSAM keys; initial: ``(n, 3)``; needed: ``(n,)`` time of their last factor [s].
    """

    symbol: str
    number: Index
    initial: Array
    needed: Array


@dataclass(frozen=True)
class State:
    """Estimates of all variables: an array ``(n, 3)`` per symbol, of poses (x, y, θ) under "x".

    numbers: ``(n,)`` of each variable in its GTSAM key; 0, 1, … by default.
    """

    arrays: Mapping[str, Array]
    numbers: Mapping[str, Index] = field(default_factory=dict)

    @property
    def poses(self) -> Array:
        """Keyframe poses ``(k + 1, 3)``: x, y [m], heading [rad]."""
        return self.arrays[POSE]

    @property
    def c(self) -> Array:
        """Calibrations ``(s, 3)``: R_s [-], R_d [-], b [rad/s]."""
        return self.arrays[CALIBRATION]

    def __getitem__(self, symbol: str) -> Array:
        """The variables ``(n, 3)`` of one symbol."""
        return self.arrays[symbol]

    def number(self, symbol: str) -> Index:
        """The numbers ``(n,)`` of the variables of one symbol."""
        numbers = self.numbers.get(symbol)
        return np.arange(len(self.arrays[symbol])) if numbers is None else numbers

    def keys(self, symbol: str, rows: Index | slice = slice(None)) -> Index:
        """GTSAM keys of the variables in rows ``(m,)``."""
        return key(symbol) + self.number(symbol)[rows]

    def replaced(self, **arrays: Array) -> State:
        """Replace the arrays of some symbols; new symbols are added."""
        return replace(self, arrays={**self.arrays, **arrays})

    def rotated(self, angle: float, pivot: Array) -> State:
        """Rotate all poses by ``angle`` [rad] about ``pivot (2,)`` [m]."""
        return self.replaced(x=rotated(self.poses, angle, pivot))

    def retracted(self, moves: Mapping[str, Array], longest: float = np.inf) -> State:
        """Move every variable by GTSAM's local coordinates; poses by Pose2's exponential map, strides in log scale.

        A stride scale thus stays above 0: R_s ← R_s exp(δ / R_s), to first order R_s + δ; by a factor e at most.

        moves: ``(n, 3)`` of the variables of each symbol; longest: no pose may go further [m]; the whole move is
        shortened instead.
        """
        furthest = float(np.abs(moves[POSE][:, :2]).max())
        scale = min(1.0, longest / max(furthest, 1e-9))
        arrays = {symbol: rows + scale * moves[symbol] for symbol, rows in self.arrays.items()}
        arrays[POSE] = retracted(self.poses, scale * moves[POSE])
        stride = self.c[:, 0]
        arrays[CALIBRATION][:, 0] = stride * np.exp(np.clip(scale * moves[CALIBRATION][:, 0] / stride, -1, 1))
        return replace(self, arrays=arrays)

    def to_values(self) -> gtsam.Values:
        """All variables as ``gtsam.Values``."""
        import gtsam  # here, since it is slow to load and batch smoothing does without

        values = gtsam.Values()
        for symbol, rows in self.arrays.items():
            for variable_key, vector in zip(self.keys(symbol).tolist(), rows, strict=True):
                insert(values, symbol, variable_key, vector)
        return values

    @classmethod
    def of_values(cls, values: gtsam.Values) -> State:
        """All variables in ``gtsam.Values``, in order of their numbers."""
        keys = np.array(sorted(values.keys()), dtype=np.int64)
        symbols, numbers = keys >> 56, keys & KEY_NUMBER
        numbers = {chr(code): numbers[symbols == code] for code in np.unique(symbols).tolist()}
        return cls({symbol: extract(values, symbol) for symbol in numbers}, numbers)

    def updated(self, values: gtsam.Values) -> State:
        """Copy the estimates of all variables that ``values`` has."""
        return self.at(State.of_values(values))

    def at(self, other: State) -> State:
        """These variables, where ``other`` has them with its estimates."""
        arrays = dict[str, Array]()
        for symbol, rows in self.arrays.items():
            there, place = self._places(symbol, other)
            arrays[symbol] = rows.copy()
            arrays[symbol][there] = other.arrays.get(symbol, rows)[place]
        return replace(self, arrays=arrays)

    def among(self, other: State) -> State:
        """Those of these variables that ``other`` has, with its estimates."""
        arrays, numbers = dict[str, Array](), dict[str, Index]()
        for symbol, rows in self.arrays.items():
            there, place = self._places(symbol, other)
            arrays[symbol], numbers[symbol] = other.arrays.get(symbol, rows)[place], self.number(symbol)[there]
        return State(arrays, numbers)

    def _places(self, symbol: str, other: State) -> tuple[Mask, Index]:
        """Which of the variables ``(n,)`` of a symbol another state has, and the rows of these there."""
        number, of = self.number(symbol), other.number(symbol) if symbol in other.arrays else np.empty(0, dtype=np.intp)
        if not len(of):
            return np.zeros(len(number), dtype=bool), np.empty(0, dtype=np.intp)
        order = np.argsort(of)
        place = order[np.minimum(np.searchsorted(of, number, sorter=order), len(of) - 1)]
        there = of[place] == number
        return there, place[there]


def rotated(poses: Array, angle: float, pivot: Array) -> Array:
    """Rotate poses ``(n, 3)`` by ``angle`` [rad] about ``pivot (2,)`` [m]."""
    return np.column_stack([(poses[:, :2] - pivot) @ rotation(angle).T + pivot, poses[:, 2] + angle])


def retracted(poses: Array, move: Array) -> Array:
    """Poses ``(n, 3)`` moved by ``move (n, 3)`` in their own axes: x Exp(ξ), as ``gtsam.Pose2.retract``."""
    angle = move[:, 2]
    small = np.abs(angle) < 1e-10
    divisor = np.where(small, 1.0, angle)
    sine = np.where(small, 1.0, np.sin(angle) / divisor)
    cosine = np.where(small, 0.0, (1 - np.cos(angle)) / divisor)
    ahead, left = sine * move[:, 0] - cosine * move[:, 1], cosine * move[:, 0] + sine * move[:, 1]
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    columns = [poses[:, 0] + cos * ahead - sin * left, poses[:, 1] + sin * ahead + cos * left]
    return np.column_stack([*columns, wrap_angle(poses[:, 2] + angle)])


def insert(values: gtsam.Values, symbol: str, variable_key: int, vector: Array) -> None:
    """Add a variable to ``gtsam.Values``."""
    import gtsam

    values.insert(variable_key, gtsam.Pose2(*vector) if symbol == POSE else np.asarray(vector))


def extract(values: gtsam.Values, symbol: str) -> Array:
    """The variables ``(n, 3)`` of one symbol, in order of their numbers."""
    import gtsam

    if symbol == POSE:
        return np.asarray(gtsam.utilities.extractPose2(values))
    return np.asarray(gtsam.utilities.extractVectors(values, symbol)).reshape(-1, 3)


@dataclass(frozen=True)
class Linearized:
    """Functions ``(k, r)`` of x_i, x_j and c, with their derivatives by each ``(k, r, 3)``."""

    value: Array
    by_i: Array
    by_j: Array
    by_c: Array

    def times(self, matrix: Array) -> Linearized:
        """Multiply values and derivatives by ``matrix (k, q, r)``."""
        value = np.einsum("kqr,kr->kq", matrix, self.value)
        return Linearized(value, matrix @ self.by_i, matrix @ self.by_j, matrix @ self.by_c)

    def take(self, rows: Index) -> Linearized:
        """The rows with these indices."""
        return Linearized(self.value[rows], self.by_i[rows], self.by_j[rows], self.by_c[rows])


@dataclass(frozen=True)
class FactorBlock:
    """Factors of one kind at one state, ``n`` of them with ``m`` rows in all.

    name: of the kind; residual: ``(m,)`` whitened; row_of: ``(m,)`` the factor of each row, ascending.
    variables: of each factor, as symbol and rows ``(n,)`` of the state; jacobian: returns the derivatives ``(m, 3)`` of
    all rows by each of these variables, in GTSAM's local coordinates; number: ``(n,)`` permanent number of each factor.
    rows_each: rows of every factor, 0 if they vary; loss: of the norm of its residual, or of the residual itself where
    every factor has one row; most_rows: ``(n,)`` where another state may give a factor more rows.
    prior: these are priors of variables that the kind adds.
    curvature: returns a root ``(n, k, 3 v)`` of the second derivatives of the residuals times these, unweighted,
    without those that would make the cost concave; the search adds them to JᵀJ, covariances are without them.
    native: returns GTSAM's own version of factor n, where GTSAM has one; constants: ``(n, k)`` all that this has
    beside its variables and its loss.
    """

    name: str
    residual: Array
    row_of: Index
    variables: tuple[tuple[str, Index], ...]
    jacobian: Callable[[], Sequence[Array]]
    number: Index
    rows_each: int = 0
    loss: Loss = GAUSSIAN
    most_rows: Index | None = None
    prior: bool = False
    curvature: Callable[[], Array] | None = None
    native: Callable[[int], gtsam.NonlinearFactor] | None = None
    constants: Array | None = None

    @classmethod
    def uniform(
        cls,
        name: str,
        residual: Array,
        variables: Iterable[tuple[str, Index]],
        jacobian: Callable[[], Sequence[Array]],
        number: Index | None = None,
        **others: Any,
    ) -> FactorBlock:
        """Factors with the same number of rows: residual ``(n, r)``; jacobian returns ``(n, r, 3)`` per variable."""
        n, r = residual.shape

        def rows() -> list[Array]:
            return [by.reshape(-1, 3) for by in jacobian()]

        number = np.arange(n) if number is None else number
        row_of = np.arange(n).repeat(r)
        return cls(name, residual.ravel(), row_of, tuple(variables), rows, number, r, **others)

    @classmethod
    def prior_of(cls, name: str, variables: tuple[str, Index], off: Array, sigma: Array, number: Index) -> FactorBlock:
        """Priors of variables ``(n,)``. off: ``(n, 3)`` from their means; sigma: ``(n, 3)``."""
        root = 1 / sigma
        return cls.uniform(name, off * root, [variables], lambda: [np.eye(3) * root[:, :, None]], number, prior=True)

    def __len__(self) -> int:
        return len(self.number)

    def only(self, which: Index) -> FactorBlock:
        """The factors with these indices, ascending."""
        if len(which) == len(self):
            return self
        rows = np.flatnonzero(np.isin(self.row_of, which))
        native = self.native
        return replace(
            self,
            residual=self.residual[rows],
            row_of=np.searchsorted(which, self.row_of[rows]),
            variables=tuple((symbol, of_factor[which]) for symbol, of_factor in self.variables),
            jacobian=lambda: [by[rows] for by in self.jacobian()],
            number=self.number[which],
            native=None if native is None else lambda n: native(int(which[n])),
            constants=None if self.constants is None else self.constants[which],
        )

    @cached_property
    def deviation(self) -> Array:
        """Deviation ``(n,)`` of each factor [σ]: the norm of its residual, or the signed residual."""
        if self.rows_each == 1:
            return self.residual
        return np.sqrt(np.bincount(self.row_of, self.residual**2, len(self)))

    @cached_property
    def weight(self) -> Array:
        """The share ``(n,)`` of each factor's information that is used, 0 to 1."""
        return self.loss.weight(self.deviation)

    @cached_property
    def cost(self) -> float:
        """The sum of the losses, as GTSAM counts it: half a squared residual where the loss is Gaussian."""
        return float(self.loss.cost(self.deviation).sum())

    @cached_property
    def weighted(self) -> tuple[Array, list[Array]]:
        """Residuals ``(m,)`` and derivatives ``(m, 3)`` by each variable, times the root of the weight."""
        if self.loss is GAUSSIAN:
            return self.residual, list(self.jacobian())
        root = np.sqrt(self.weight)[self.row_of]
        return root * self.residual, [root[:, None] * by for by in self.jacobian()]


class Stage(Enum):
    """Stage of the search for the walk.

    ROUGH: it may be in wrong rooms; FINAL: it is near its optimum.
    """

    ROUGH = "rough"
    FINAL = "final"


@dataclass(frozen=True)
class ResidualReport:
    """A factor of a kind that makes no reports.

    time: of its keyframe [s]; residual: whitened, the norm of several rows [σ]; weight: share of its information that
    is used.
    """

    time: float
    residual: float
    weight: float


class Measurement(ABC):
    """A measurement kind: all its instances on one walk. Subclasses are frozen.

    name: in reports, decisions and blocks; determines_position: True if it measures absolute positions; overhang: time
    [s] by which an instance may lie before or after the steps; price: cost of the association with rooms or paths, in
    addition to the residuals [half a squared sigma].
    A kind that is made from data has ``of(data, steps, prior, number)`` too, see `register`. What else a kind may do is
    an interface below, which it inherits.
    """

    name: ClassVar[str] = ""
    determines_position: ClassVar[bool] = False
    overhang: ClassVar[float] = 0.0
    price: float = 0.0

    @property
    def determines_drift(self) -> bool:
        """True if it determines the gyroscope's drift, so that the search finds any drift."""
        return False

    def keyframe_times(self) -> Array:
        """Times [s] at which keyframes are needed ``(t,)``."""
        return np.empty(0)

    def bind(self, chain: Chain) -> Self:
        """Bind every instance to its keyframe in ``chain``."""
        return self

    def variables(self, poses: Array) -> Sequence[Variables]:
        """The variables it adds, with initial values. poses: ``(k + 1, 3)`` of the initial walk."""
        return ()

    @abstractmethod
    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """All factors at one state; the first block is that of the instances."""
        ...

    def reports(self, at: Evaluation, which: Index | None = None) -> tuple[Any, ...]:
        """Reports, each a dataclass: residual, weight and reason of each instance, or of the instances ``which``.

        By default a `ResidualReport` of each instance, of a kind with a keyframe in each row.
        """
        blocks = at.blocks_of(self.name) if declared(type(self), KEYFRAME) else []
        if not blocks:
            return ()
        keyframe = next(rows for symbol, rows in blocks[0].variables if symbol == POSE)
        columns = np.stack([at.chain.time[keyframe], blocks[0].deviation, blocks[0].weight], axis=1)
        shown = columns if which is None else columns[which]
        return tuple(ResidualReport(*row) for row in shown.tolist())


def initial_state(
    poses: Array, c: Array, measurements: Iterable[Measurement], numbers: Mapping[str, Index] | None = None
) -> State:
    """The initial state of a walk: poses, calibrations, and the variables that measurements add.

    numbers: of poses and calibrations in their GTSAM keys, see `Chain.numbers`; 0, 1, … by default.
    """
    arrays, numbers = {POSE: poses, CALIBRATION: c}, dict(numbers or {})
    for measurement in measurements:
        for new in measurement.variables(poses):
            arrays[new.symbol], numbers[new.symbol] = new.initial, new.number
    return State(arrays, numbers)


def poses_at(time: Array, keyframe_time: Array, poses: Array) -> Array:
    """Poses ``(n, 3)`` at times ``(n,)`` [s], linear between keyframes; headings are unwrapped."""
    return interpolate(time, keyframe_time, np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])]))


# What else a kind may do


class Itemized(Measurement):
    """A kind with a report for each instance; other kinds have summaries."""

    @property
    @abstractmethod
    def instances(self) -> tuple[Index, Array]:
        """Numbers and times ``(n,)`` [s] of the instances that have a report, in the order of the reports."""


class OnPlan(Measurement):
    """A kind whose instances belong to rooms or corridors of the floor plan."""

    @abstractmethod
    def associated(self, at: Evaluation, stray: Array | float | None = None, alike: float = 1.0) -> Self:
        """Associate instances with rooms or corridors along the walk ``at``.

        stray: sigma of that walk, everywhere or at the end of each piece ``(m,)`` [m]; alike: number of pieces in a row
        with the same error.
        """

    def same_association(self, other: Measurement) -> bool:
        """True if ``other``, a version of the same kind, is associated alike: the search need not try both."""
        return True


class Locating(Measurement):
    """A kind from which positions can be read before the walk is solved."""

    @abstractmethod
    def rough_fixes(self) -> Fixes:
        """Positions to start from where the walk has no fix."""

    def initialized(self, poses: Array) -> Self:
        """Initialise unknown variables from the initial poses ``(k + 1, 3)`` (positions of unlisted beacons)."""
        return self


class Refined(Measurement):
    """A kind that has other versions for parts of the search, and for a walk under way.

    The search has a rough and a final stage, and a second pass from a first optimum.
    """

    def staged(self, stage: Stage) -> Self:
        """The version for a stage of the search, tighter or looser."""
        return self

    def alternatives(self) -> Sequence[Self]:
        """Versions from whose optima the search must also start, where one optimum hides another."""
        return ()

    def refined(self, at: Evaluation) -> Measurement:
        """The second pass: outliers lose weight, common errors are modelled. ``self`` if nothing changes."""
        return self

    def reclassified(self, at: Evaluation) -> Self:
        """Live: lower the weight of instances far from the walk, and restore it for those that are near again."""
        return self

    @property
    def diverged(self) -> bool:
        """True if its last instances agree with one another and all lie far from the walk: the estimate diverged."""
        return False

    def contradicts(self, decisions: Mapping[str, AnyArray]) -> bool:
        """True if instances that were used before are now inconsistent with the others."""
        return False


class Remembered(Measurement):
    """A kind that decides about its instances, in a way that a walk under way must remember."""

    def decisions(self) -> dict[str, AnyArray]:
        """Decisions about its instances, for `continued`; empty if there are none."""
        return {}

    def continued(self, decisions: Mapping[str, AnyArray]) -> Self:
        """Apply earlier decisions to the instances that are still there."""
        return self


class Doubted(Measurement):
    """A kind that may err beyond what it states."""

    @abstractmethod
    def hypotheses(self, at: Evaluation, by_others: Callable[[], Evaluation] | None) -> Sequence[Proposal]:
        """What may be wrong with the instances, so that they fit better than at ``at``; the most promising first.

        by_others: returns the walk by the other sources alone; None if these do not determine its place.
        """


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


class WeighsPoses(Measurement):
    """A kind that weighs particles otherwise than by its residuals."""

    @abstractmethod
    def pose_costs(self, keyframe: int) -> PoseCosts | None:
        """The instances at a keyframe; None without any."""

    def standing_variance(self, interval: int) -> float:
        """Largest variance [m²] per axis of the displacement in an interval between keyframes; infinite if unknown.

        Finite where the walker stood, though steps err by more.
        """
        return np.inf


class Searching(Measurement):
    """A kind that fits a walk in several places or directions."""

    @property
    @abstractmethod
    def places(self) -> Array:
        """Places ``(n, 2)`` that the walk passed [m]."""

    @abstractmethod
    def starts(self, at: Evaluation, fixes: FixFactor, sigma_direction: float) -> Sequence[State]:
        """Where the search must start, the most promising first.

        at: the initial walk; fixes: of the walk; sigma_direction: how well these and headings determine its direction
        [rad].
        """

    @abstractmethod
    def bound_at(self, at: Evaluation) -> Self:
        """The version whose factors keep the variables that they have at ``at``, as GTSAM's do."""


INTERFACES = (Itemized, OnPlan, Locating, Refined, Remembered, Doubted, WeighsPoses, Searching)


def decisions_of(kind: Measurement) -> dict[str, AnyArray]:
    """The decisions of a kind about its instances; empty for kinds that decide nothing."""
    return kind.decisions() if isinstance(kind, Remembered) else {}
