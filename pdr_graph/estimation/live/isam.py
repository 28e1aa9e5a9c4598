"""A transactional iSAM2: named factors, and a shadow copy of all factors and values.

``ISAM2.update`` is not transactional (gtsam 4.3.0): after an exception the object may crash or continue with stale
estimates, and a NaN raises nothing. So every factor is stored here too, under a name. When an update fails, a new
object is built from the shadow copy. The marginals of finalised variables are GTSAM's own factors; they are stored too.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from pdr_graph.estimation.factors.base import POSE, UNIT, FactorBlock, State, extract
from pdr_graph.estimation.factors.losses import GAUSSIAN
from pdr_graph.geometry import wrap_angle
from pdr_graph.types import Array, Index, Mask

IntegerArray = NDArray[np.int64]

Name = tuple[str, int]  # of the block, and of the factor within it
RELINEARIZE = 0.01  # [m, rad, -] change of a variable at which GTSAM relinearises its own factors; chosen by hand
LARGEST = 1e9  # [m, rad, -] of any variable: rounding errors of the solver can lead to 1e17, which is finite
HOLD, HOLD_SIGMA = "hold", 1e3  # prior of a variable that no factor determines: name; sigma [m, rad, -]
DROPPED = "left out, not finite"
WEIGHT_CHANGE = 0.1  # change of a robust weight at which a factor is linearised again; chosen by hand
POSE_CHARACTER, SYMBOL_BITS = ord(POSE), 56  # the first byte of a key is its symbol


@dataclass(frozen=True)
class Linear:
    """A linearised factor. point: linearisation point ``(3 v,)``; weight, signature: see `FactorBlock`."""

    factor: gtsam.NonlinearFactor
    keys: tuple[int, ...]
    point: Array
    weight: float
    signature: float

    @cached_property
    def poses(self) -> tuple[int, ...]:
        """The keys of its poses."""
        return tuple(key for key in self.keys if key >> SYMBOL_BITS == POSE_CHARACTER)


class TransactionalISAM:
    """Variables and named factors of a walk under way; variables older than ``lag`` [s] are marginalised.

    relinearize: see RELINEARIZE. values: the estimate; marginal: factors of marginalised variables; rebuilds: the
    reason of each rebuild; updates: number of updates.
    """

    def __init__(self, lag: float = np.inf, relinearize: float = RELINEARIZE):
        self.lag, self.relinearize = lag, relinearize
        self.values = gtsam.Values()
        self.factors: dict[Name, Linear] = {}
        self.rebuilds: list[str] = []
        self.updates = 0
        self._slots: dict[Name, int] = {}
        self.marginal: list[gtsam.NonlinearFactor] = []
        self._times: dict[int, float] = {}
        self._symbols: set[int] = set()
        self._smoother = _smoother(lag, relinearize)

    def __contains__(self, key: int) -> bool:
        """True if a variable is alive."""
        return self.values.exists(key)

    def changes(self, block: FactorBlock, state: State, again: Collection[Name] = ()) -> dict[Name, Linear]:
        """The factors of a block that are new or must be linearised again.

        Priors of variables that a kind adds are new only if one of their variables is, or if ``again`` names them.
        """
        if not len(block):
            return {}
        stored = [self.factors.get((block.name, number)) for number in block.number.tolist()]
        point = block.point(state)
        signature = np.zeros(len(block)) if block.signature is None else block.signature
        keys = np.stack([state.keys(symbol, rows) for symbol, rows in block.variables], axis=1)
        due = np.array([factor is None for factor in stored]) & (np.bincount(block.row_of, minlength=len(block)) > 0)
        if block.prior:
            names, rows = [(block.name, number) for number in block.number[due].tolist()], keys[due].tolist()
            alive = [all(self.values.exists(key) for key in row) for row in rows]
            due[due] = [not complete or name in again for name, complete in zip(names, alive, strict=True)]
        old = np.array([n for n, factor in enumerate(stored) if factor is not None], dtype=np.intp)
        if len(old):
            due[old] = _stale([stored[n] for n in old.tolist()], block, point[old], old, signature[old])
        if not due.any():
            return {}
        return _linear(block, state, np.flatnonzero(due), keys, point, signature)

    def obsolete(self, blocks: Sequence[FactorBlock], state: State) -> list[Name]:
        """Names of the stored factors of the keyframes in ``state`` that no block has any more."""
        present = {name: set[int]() for name in {block.name for block in blocks if not block.prior}}
        for block in blocks:
            if not block.prior:
                present[block.name].update(block.number[np.unique(block.row_of)].tolist())
        alive = set(state.keys("x").tolist())
        names = []
        for name, factor in self.factors.items():
            numbers = present.get(name[0])
            if numbers is not None and name[1] not in numbers and factor.poses and alive.issuperset(factor.poses):
                names.append(name)
        return names

    def update(
        self,
        add: Mapping[Name, Linear],
        remove: Iterable[Name] = (),
        values: gtsam.Values | None = None,
        times: Mapping[int, float] | None = None,
    ) -> None:
        """Update incrementally; a factor with the name of a stored one replaces it.

        values: of new variables; times: [s] of these, and of variables that must stay alive.
        """
        values, times = values or gtsam.Values(), dict[Any, Any](times or {})
        replaced = [name for name in {*remove, *add} if name in self.factors]
        slots = [self._slots[name] for name in replaced]
        for name in replaced:
            del self.factors[name], self._slots[name]
        self.factors.update(add)
        self._times.update(times)
        self._symbols |= {key >> SYMBOL_BITS for key in times}
        try:
            self._smoother.update(_graph(linear.factor for linear in add.values()), values, times, slots)
            self._accept(list(add))
        except (RuntimeError, ValueError, IndexError) as error:
            self._rebuild(values, f"{type(error).__name__}: {str(error).strip().splitlines()[0][:100]}")

    def covariance(self, keys: list[int]) -> Array:
        """Joint covariance of some variables, in GTSAM's local coordinates."""
        return np.asarray(self._smoother.getISAM2().jointMarginalCovariance(keys).fullMatrix())

    def linearized(self) -> gtsam.GaussianFactorGraph:
        """All factors, with the marginals, at the estimate."""
        return self.graph().linearize(self.values)

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """All factors, with the marginals."""
        return _graph([*(linear.factor for linear in self.factors.values()), *self.marginal])

    def marginal_cost(self) -> float:
        """Cost of the marginal at the estimate."""
        return float(sum(factor.error(self.values) for factor in self.marginal))

    def with_values(self, values: gtsam.Values, relinearize: float | None = None) -> TransactionalISAM:
        """The same variables at other values, with the marginals but without other factors; `start` adds these."""
        isam = TransactionalISAM(self.lag, self.relinearize if relinearize is None else relinearize)
        isam.marginal, isam.rebuilds, isam._times = self.marginal, self.rebuilds, dict(self._times)
        isam.values = values
        return isam

    def moved(self, values: gtsam.Values) -> TransactionalISAM:
        """The same variables at other values, with all factors as they are; it has not started."""
        isam = self.with_values(values)
        isam.factors = dict(self.factors)
        return isam

    def absorb(self, factors: Mapping[Name, Linear]) -> None:
        """Count factors as marginals, before `start`: they keep their linearisation, and lose their names."""
        self.marginal = [*self.marginal, *(linear.factor for linear in factors.values())]
        self.factors = {name: factor for name, factor in self.factors.items() if name not in factors}

    def insert(self, values: gtsam.Values, times: Mapping[int, float]) -> None:
        """Add variables before `start`. times: [s] until which these are needed, and variables that must stay alive."""
        if values.size():
            self.values = gtsam.Values(self.values)
            self.values.insert(values)
        self._times |= times

    def start(self, factors: Mapping[Name, Linear]) -> None:
        """Add the first factors, after `with_values` or `restored`."""
        self.factors = dict(factors)
        self._start_or_hold(gtsam.Values(self.values))

    def checkpoint(self, kept: Mapping[Name, Linear]) -> IsamCheckpoint:
        """Variables and marginals; kept: factors that are stored as marginals."""
        return IsamCheckpoint(
            lag=self.lag,
            rebuilds=list(self.rebuilds),
            keys=np.array(list(self.values.keys()), dtype=np.int64),
            times=np.array([self._times[key] for key in self.values.keys()]),
            variables=np.array([_numbers(self.values, key) for key in self.values.keys()]).reshape(-1, 3),
            marginal=[
                _packed(factor, self.values)
                for factor in (*self.marginal, *(linear.factor for linear in kept.values()))
            ],
        )

    @classmethod
    def restored(cls, checkpoint: IsamCheckpoint) -> TransactionalISAM:
        """Create from a checkpoint, without factors; `start` adds them."""
        isam, values = cls(checkpoint.lag), gtsam.Values()
        for key, time, numbers in zip(checkpoint.keys.tolist(), checkpoint.times, checkpoint.variables, strict=True):
            _insert(values, key, numbers)
            isam._times[key] = float(time)
        isam.marginal = [_unpacked(packed, values) for packed in checkpoint.marginal]
        isam.values, isam.rebuilds = values, list(checkpoint.rebuilds)
        return isam

    def _accept(self, added: list[Name]) -> None:
        """Copy the estimate after an update. Raises RuntimeError if it is not that of any walk."""
        estimate = self._smoother.calculateEstimate()
        if not all((np.abs(extract(estimate, chr(symbol))) < LARGEST).all() for symbol in self._symbols):
            raise RuntimeError("the estimate is not finite, or of no walk")
        slots = dict(zip(added, self._smoother.getISAM2Result().getNewFactorsIndices(), strict=False))
        self._slots |= slots
        if estimate.size() < len(self._times):
            self._forget(estimate)
        self.values = estimate
        self.updates += 1

    def _forget(self, estimate: gtsam.Values) -> None:
        """Remove the names of marginalised variables and their factors, and copy the new marginals."""
        self._times = {key: time for key, time in self._times.items() if estimate.exists(key)}
        for name in [n for n, factor in self.factors.items() if not all(key in self._times for key in factor.keys)]:
            del self.factors[name], self._slots[name]
        stored, named = self._smoother.getFactors(), set(self._slots.values())
        marginals = [stored.at(slot) for slot in range(stored.size()) if slot not in named and stored.exists(slot)]
        point = self._smoother.getISAM2().getLinearizationPoint()
        self.marginal = [_anchored(factor, point) for factor in marginals]

    def _rebuild(self, values: gtsam.Values, why: str) -> None:
        """Rebuild iSAM2 from the copy, without factors that are not finite; add priors if it is underdetermined."""
        initial = gtsam.Values(self.values)
        initial.insert(values)
        bad = [name for name, factor in self.factors.items() if not _finite(factor.factor, initial)]
        for name in bad:
            del self.factors[name]
        self.rebuilds.append(f"{why}; {len(bad)} factors {DROPPED}" if bad else why)
        self._start_or_hold(initial)

    def _start_or_hold(self, initial: gtsam.Values) -> None:
        """Start from these values; add a weak prior of each variable if the factors are underdetermined."""
        try:
            self._start(initial)
        except (RuntimeError, ValueError, IndexError):
            for key in initial.keys():
                self.factors[HOLD, key] = Linear(_hold(initial, key), (key,), np.empty(0), 1.0, 0.0)
            self._start(initial)

    def _start(self, initial: gtsam.Values) -> None:
        self._smoother = _smoother(self.lag, self.relinearize)
        self._slots, self._symbols = {}, {key >> SYMBOL_BITS for key in self._times}
        self._smoother.update(self.graph(), initial, {key: self._times[key] for key in initial.keys()}, [])
        self._accept(list(self.factors))


@dataclass(frozen=True)
class PackedFactor:
    """A linear factor. keys: ``(v,)``; information: augmented, ``(3 v + 1, 3 v + 1)``, residuals in the last row."""

    keys: IntegerArray
    information: Array


@dataclass(frozen=True)
class IsamCheckpoint:
    """Variables ``(n, 3)`` with their keys and times [s], and the marginals."""

    lag: float
    rebuilds: list[str]
    keys: IntegerArray
    times: Array
    variables: Array
    marginal: list[PackedFactor]


def _stale(stored: Sequence[Linear | None], block: FactorBlock, point: Array, rows: Index, signature: Array) -> Mask:
    """True ``(n,)`` for factors that moved too far from their linearisation point, or whose data changed."""
    was = [factor for factor in stored if factor is not None]
    stale = np.abs(np.array([factor.signature for factor in was]) - signature) > 1.0
    if block.tolerance is None:
        return stale
    apart = np.abs(point - np.array([factor.point for factor in was]))
    for n, (symbol, _) in enumerate(block.variables):
        if symbol == "x":
            apart[:, 3 * n + 2] = np.abs(wrap_angle(apart[:, 3 * n + 2]))
    stale |= (apart > block.limits()).any(axis=1)
    if block.loss is not GAUSSIAN:
        stale |= np.abs(block.weight[rows] - [factor.weight for factor in was]) > WEIGHT_CHANGE
    return stale


def _linear(
    block: FactorBlock, state: State, which: Index, keys: Index, point: Array, signature: Array
) -> dict[Name, Linear]:
    """The factors ``which`` of a block, linearised at ``state``."""
    residual, jacobian = block.weighted
    first, weight, linear = np.searchsorted(block.row_of, np.arange(len(block) + 1)), block.weight, dict[Name, Linear]()
    variables, where = np.unique(keys[which], return_index=True)
    values = gtsam.Values()
    for key, numbers in zip(variables.tolist(), point[which].reshape(-1, 3)[where], strict=True):
        _insert(values, key, numbers)
    for n in which.tolist():
        rows, factor_keys = slice(first[n], first[n + 1]), tuple(keys[n].tolist())
        factor = linear_factor(factor_keys, [by[rows] for by in jacobian], residual[rows], values)
        linear[block.name, int(block.number[n])] = Linear(
            factor, factor_keys, point[n], float(weight[n]), float(signature[n])
        )
    return linear


def linear_factor(
    keys: Sequence[int], blocks: Sequence[Array], residual: Array, values: gtsam.Values
) -> gtsam.NonlinearFactor:
    """The linear factor at ``values`` with whitened ``residual (r,)`` and derivatives ``(r, 3)`` by each variable."""
    terms: list[Any] = [side for pair in zip(keys, blocks, strict=True) for side in pair]
    make: Any = gtsam.JacobianFactor  # its overloads are of one, two and three variables
    return gtsam.LinearContainerFactor(make(*terms, -residual, UNIT[len(residual)]), values)


def _packed(factor: gtsam.NonlinearFactor, values: gtsam.Values) -> PackedFactor:
    """A linear factor, packed; ``values`` must contain its variables."""
    gaussian = factor.linearize(values)
    return PackedFactor(np.array(list(gaussian.keys()), dtype=np.int64), np.asarray(gaussian.augmentedInformation()))


def _unpacked(packed: PackedFactor, values: gtsam.Values) -> gtsam.NonlinearFactor:
    """The factor as a sum of one term per pair of keys: GTSAM's own constructors take no more than three keys."""
    keys, information = packed.keys.tolist(), packed.information
    graph, zero, nothing = gtsam.GaussianFactorGraph(), np.zeros((3, 3)), np.zeros(3)
    block = [slice(3 * n, 3 * n + 3) for n in range(len(keys))]
    for n, key in enumerate(keys):
        squared = float(information[-1, -1]) if n == 0 else 0.0
        graph.push_back(gtsam.HessianFactor(key, information[block[n], block[n]], information[block[n], -1], squared))
        for m in range(n + 1, len(keys)):
            across = information[block[n], block[m]]
            graph.push_back(gtsam.HessianFactor(key, keys[m], zero, across, nothing, zero, nothing, 0.0))
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(gtsam.HessianFactor(graph)), values)


def _anchored(factor: gtsam.NonlinearFactor, point: gtsam.Values) -> gtsam.NonlinearFactor:
    """A marginal with its linearisation point, which GTSAM's marginals do not store (gtsam 4.3.0).

    Without it the marginal would be evaluated at zero. iSAM2 never relinearises the variables of a marginal.
    """
    if not isinstance(factor, gtsam.LinearContainerFactor):
        return factor
    linear = factor.toJacobian() if factor.isJacobian() else factor.toHessian()
    return gtsam.LinearContainerFactor(linear, point)


def _numbers(values: gtsam.Values, key: int) -> Array:
    """The value ``(3,)`` of a variable."""
    if key >> SYMBOL_BITS != POSE_CHARACTER:
        return values.atVector(key)
    pose = values.atPose2(key)
    return np.array([pose.x(), pose.y(), pose.theta()])


def _insert(values: gtsam.Values, key: int, numbers: Array) -> None:
    values.insert(key, gtsam.Pose2(*numbers) if key >> SYMBOL_BITS == POSE_CHARACTER else np.asarray(numbers))


def _smoother(lag: float, relinearize: float) -> gtsam.IncrementalFixedLagSmoother:
    """GTSAM's fixed-lag smoother; with default settings it leaks memory or estimates jump (design section 3)."""
    parameters = gtsam.ISAM2Params()
    parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
    parameters.setRelinearizeThreshold(relinearize)
    parameters.relinearizeSkip = 1
    parameters.enablePartialRelinearizationCheck = relinearize > 0
    parameters.findUnusedFactorSlots = True
    parameters.setFactorization("QR")
    return gtsam.IncrementalFixedLagSmoother(min(lag, 1e12), parameters)


def _graph(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def _finite(factor: gtsam.NonlinearFactor, values: gtsam.Values) -> bool:
    """True if the factor's Jacobian is finite."""
    try:
        return bool(np.isfinite(factor.linearize(values).augmentedJacobian()).all())
    except (RuntimeError, ValueError):
        return False


def _hold(values: gtsam.Values, key: int) -> gtsam.NonlinearFactor:
    """A weak prior of a variable at its present value."""
    noise = gtsam.noiseModel.Isotropic.Sigma(3, HOLD_SIGMA)
    if key >> SYMBOL_BITS == POSE_CHARACTER:
        return gtsam.PriorFactorPose2(key, values.atPose2(key), noise)
    return gtsam.PriorFactorVector(key, values.atVector(key), noise)
