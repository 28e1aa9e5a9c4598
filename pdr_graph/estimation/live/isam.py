"""iSAM2 that cannot be corrupted: named factors, and a shadow copy of all that it holds.

``ISAM2.update`` is not transactional (gtsam 4.3.0): after an exception the object may crash or go on with stale
estimates, and a NaN passes without a word. So whatever goes in is kept here too, under a name; when an update fails the
object is thrown away and a new one is made of the shadow. What marginalised variables left behind are factors of
GTSAM's own, and are kept with the others.
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

Name = tuple[str, int]  # of the block, and the factor's own number
RELINEARIZE = 0.01  # [m, rad, -] that a variable moves before GTSAM's own factors of it are linearised again
HELD = 1e3  # [m, rad, -] standard deviation of a hold on what nothing determines
HOLD = "hold"
DROPPED = "left out, not finite"
WEIGHT_CHANGE = 0.1  # of a robust weight, until a factor is linearised again
POSE_CHARACTER, SYMBOL_BITS = ord(POSE), 56  # the first byte of a key is its symbol


@dataclass(frozen=True)
class Linear:
    """A factor in the graph. point: its variables where it was linearised; weight, signature: as of `FactorBlock`."""

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
    """The variables of a walk under way, and its factors by name; those older than ``lag`` [s] are marginalised.

    values: the estimate; marginal: what variables that were marginalised have left behind; rebuilds: reasons of each
    rebuild.
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

    def changes(
        self, block: FactorBlock, state: State, tighter: float = 1.0, again: Collection[Name] = ()
    ) -> dict[Name, Linear]:
        """The factors of a block that are new, or must be linearised again, by ``tighter`` times its tolerance.

        Factors of variables that a kind has brought are new only with one of their variables, or if named in ``again``.
        """
        if not len(block):
            return {}
        known = [self.factors.get((block.name, number)) for number in block.number.tolist()]
        point = block.point(state)
        signature = np.zeros(len(block)) if block.signature is None else block.signature
        keys = np.stack([state.keys(symbol, rows) for symbol, rows in block.variables], axis=1)
        due = np.array([one is None for one in known]) & (np.bincount(block.row_of, minlength=len(block)) > 0)
        if block.prior:
            names, rows = [(block.name, number) for number in block.number[due].tolist()], keys[due].tolist()
            alive = [all(self.values.exists(key) for key in row) for row in rows]
            due[due] = [not known or name in again for name, known in zip(names, alive, strict=True)]
        seen = np.array([n for n, one in enumerate(known) if one is not None], dtype=np.intp)
        if len(seen):
            due[seen] = _stale([known[n] for n in seen.tolist()], block, point[seen], seen, signature[seen], tighter)
        if not due.any():
            return {}
        return _linear(block, state, np.flatnonzero(due), keys, point, signature)

    def gone(self, blocks: Sequence[FactorBlock], state: State) -> list[Name]:
        """The factors of the keyframes in ``state`` that no block has any more."""
        present = {name: set[int]() for name in {block.name for block in blocks if not block.prior}}
        for block in blocks:
            if not block.prior:
                present[block.name].update(block.number[np.unique(block.row_of)].tolist())
        alive = set(state.keys("x").tolist())
        found = []
        for name, one in self.factors.items():
            numbers = present.get(name[0])
            if numbers is not None and name[1] not in numbers and one.poses and alive.issuperset(one.poses):
                found.append(name)
        return found

    def update(
        self,
        add: Mapping[Name, Linear],
        remove: Iterable[Name] = (),
        values: gtsam.Values | None = None,
        times: Mapping[int, float] | None = None,
    ) -> None:
        """One incremental update: factors of known names are replaced.

        values: of new variables; times: of these, and of those that must stay alive [s].
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
            self._smoother.update(_graph(one.factor for one in add.values()), values, times, slots)
            self._accept(list(add))
        except (RuntimeError, ValueError, IndexError) as error:
            self._rebuild(values, f"{type(error).__name__}: {str(error).strip().splitlines()[0][:100]}")

    def covariance(self, keys: list[int]) -> Array:
        """Joint covariance of some variables, in GTSAM's local coordinates."""
        return np.asarray(self._smoother.getISAM2().jointMarginalCovariance(keys).fullMatrix())

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """All factors, those of what was marginalised too."""
        return _graph([*(one.factor for one in self.factors.values()), *self.marginal])

    def marginal_cost(self) -> float:
        """Cost of the marginal at the estimate."""
        return float(sum(factor.error(self.values) for factor in self.marginal))

    def moved_to(self, values: gtsam.Values, relinearize: float | None = None) -> TransactionalISAM:
        """The same variables at other values, with the marginalised past but without factors; `start` adds these."""
        again = TransactionalISAM(self.lag, self.relinearize if relinearize is None else relinearize)
        again.marginal, again.rebuilds, again._times = self.marginal, self.rebuilds, dict(self._times)
        again.values = values
        return again

    def start(self, factors: Mapping[Name, Linear]) -> None:
        """Begin with these factors, after `moved_to` or `restored`."""
        self.factors = dict(factors)
        self._start_or_hold(gtsam.Values(self.values))

    def checkpoint(self) -> IsamCheckpoint:
        """The variables and the marginalised past."""
        return IsamCheckpoint(
            lag=self.lag,
            rebuilds=list(self.rebuilds),
            keys=np.array(list(self.values.keys()), dtype=np.int64),
            times=np.array([self._times[key] for key in self.values.keys()]),
            variables=np.array([_numbers(self.values, key) for key in self.values.keys()]).reshape(-1, 3),
            marginal=[_packed(factor, self.values) for factor in self.marginal],
        )

    @classmethod
    def restored(cls, checkpoint: IsamCheckpoint) -> TransactionalISAM:
        """From a checkpoint; `start` adds the factors."""
        own, values = cls(checkpoint.lag), gtsam.Values()
        for key, time, numbers in zip(checkpoint.keys.tolist(), checkpoint.times, checkpoint.variables, strict=True):
            _insert(values, key, numbers)
            own._times[key] = float(time)
        own.marginal = [_unpacked(one, values) for one in checkpoint.marginal]
        own.values, own.rebuilds = values, list(checkpoint.rebuilds)
        return own

    def _accept(self, added: list[Name]) -> None:
        """Take over what an update has found; RuntimeError if it is not finite."""
        found = self._smoother.calculateEstimate()
        if not all(np.isfinite(extract(found, chr(symbol))).all() for symbol in self._symbols):
            raise RuntimeError("the estimate is not finite")
        slots = dict(zip(added, self._smoother.getISAM2Result().getNewFactorsIndices(), strict=False))
        self._slots |= slots
        if found.size() < len(self._times):
            self._forget(found)
        self.values = found
        self.updates += 1

    def _forget(self, found: gtsam.Values) -> None:
        """What was marginalised is no longer known by name."""
        self._times = {key: time for key, time in self._times.items() if found.exists(key)}
        for name in [n for n, one in self.factors.items() if not all(key in self._times for key in one.keys)]:
            del self.factors[name], self._slots[name]
        held, ours = self._smoother.getFactors(), set(self._slots.values())
        left = [held.at(slot) for slot in range(held.size()) if slot not in ours and held.exists(slot)]
        point = self._smoother.getISAM2().getLinearizationPoint()
        self.marginal = [_anchored(factor, point) for factor in left]

    def _rebuild(self, values: gtsam.Values, why: str) -> None:
        """Build a new object from the copy, without factors that are not finite; hold undetermined variables."""
        known = gtsam.Values(self.values)
        known.insert(values)
        bad = [name for name, one in self.factors.items() if not _finite(one.factor, known)]
        for name in bad:
            del self.factors[name]
        self.rebuilds.append(f"{why}; {len(bad)} factors {DROPPED}" if bad else why)
        self._start_or_hold(known)

    def _start_or_hold(self, known: gtsam.Values) -> None:
        """Start from these values; where the factors do not determine them all, hold each loosely where it is."""
        try:
            self._start(known)
        except (RuntimeError, ValueError, IndexError):
            for key in known.keys():
                self.factors[HOLD, key] = Linear(_hold(known, key), (key,), np.empty(0), 1.0, 0.0)
            self._start(known)

    def _start(self, known: gtsam.Values) -> None:
        self._smoother = _smoother(self.lag, self.relinearize)
        self._slots, self._symbols = {}, {key >> SYMBOL_BITS for key in self._times}
        self._smoother.update(self.graph(), known, {key: self._times[key] for key in known.keys()}, [])
        self._accept(list(self.factors))


@dataclass(frozen=True)
class PackedFactor:
    """A linear factor. keys: ``(v,)``; information: ``(3 v + 1, 3 v + 1)``, that of the residual in the last row."""

    keys: IntegerArray
    information: Array


@dataclass(frozen=True)
class IsamCheckpoint:
    """Variables ``(n, 3)`` with their keys and times [s], and the marginalised past."""

    lag: float
    rebuilds: list[str]
    keys: IntegerArray
    times: Array
    variables: Array
    marginal: list[PackedFactor]


def _stale(
    known: Sequence[Linear | None], block: FactorBlock, point: Array, rows: Index, signature: Array, tighter: float
) -> Mask:
    """Which factors have moved too far from where they were linearised, or have changed."""
    was = [one for one in known if one is not None]
    stale = np.abs(np.array([one.signature for one in was]) - signature) > tighter
    if block.tolerance is None:
        return stale
    apart = np.abs(point - np.array([one.point for one in was]))
    for n, (symbol, _) in enumerate(block.variables):
        if symbol == "x":
            apart[:, 3 * n + 2] = np.abs(wrap_angle(apart[:, 3 * n + 2]))
    stale |= (apart > block.limits() * tighter).any(axis=1)
    if block.loss is not GAUSSIAN:
        stale |= np.abs(block.weight[rows] - [one.weight for one in was]) > WEIGHT_CHANGE * tighter
    return stale


def _linear(
    block: FactorBlock, state: State, which: Index, keys: Index, point: Array, signature: Array
) -> dict[Name, Linear]:
    """Some factors of a block, linearised at ``state``."""
    residual, jacobian = block.weighted
    first, weight, found = np.searchsorted(block.row_of, np.arange(len(block) + 1)), block.weight, dict[Name, Linear]()
    variables, where = np.unique(keys[which], return_index=True)
    values = gtsam.Values()
    for key, numbers in zip(variables.tolist(), point[which].reshape(-1, 3)[where], strict=True):
        _insert(values, key, numbers)
    for n in which.tolist():
        rows, own = slice(first[n], first[n + 1]), tuple(keys[n].tolist())
        factor = linear_factor(own, [by[rows] for by in jacobian], residual[rows], values)
        found[block.name, int(block.number[n])] = Linear(factor, own, point[n], float(weight[n]), float(signature[n]))
    return found


def linear_factor(
    keys: Sequence[int], blocks: Sequence[Array], residual: Array, values: gtsam.Values
) -> gtsam.NonlinearFactor:
    """A factor linearised at ``values``: whitened residuals ``(r,)``, and derivatives ``(r, 3)`` by each variable."""
    terms: list[Any] = [side for pair in zip(keys, blocks, strict=True) for side in pair]
    make: Any = gtsam.JacobianFactor  # its overloads are of one, two and three variables
    return gtsam.LinearContainerFactor(make(*terms, -residual, UNIT[len(residual)]), values)


def _packed(factor: gtsam.NonlinearFactor, values: gtsam.Values) -> PackedFactor:
    """A factor, linear at these values."""
    gaussian = factor.linearize(values)
    return PackedFactor(np.array(list(gaussian.keys()), dtype=np.int64), np.asarray(gaussian.augmentedInformation()))


def _unpacked(packed: PackedFactor, values: gtsam.Values) -> gtsam.NonlinearFactor:
    """The sum of what each pair of keys has; GTSAM's own constructors take no more than three."""
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
    """A marginal with the values at which it is linear, which GTSAM's own does not have (4.3.0).

    Without them it holds at zero, wherever the variables are. iSAM2 does not linearise its variables again.
    """
    if not isinstance(factor, gtsam.LinearContainerFactor):
        return factor
    linear = factor.toJacobian() if factor.isJacobian() else factor.toHessian()
    return gtsam.LinearContainerFactor(linear, point)


def _numbers(values: gtsam.Values, key: int) -> Array:
    """A variable as three numbers."""
    if key >> SYMBOL_BITS != POSE_CHARACTER:
        return values.atVector(key)
    pose = values.atPose2(key)
    return np.array([pose.x(), pose.y(), pose.theta()])


def _insert(values: gtsam.Values, key: int, numbers: Array) -> None:
    values.insert(key, gtsam.Pose2(*numbers) if key >> SYMBOL_BITS == POSE_CHARACTER else np.asarray(numbers))


def _smoother(lag: float, relinearize: float) -> gtsam.IncrementalFixedLagSmoother:
    """GTSAM's fixed-lag smoother; the settings that are not its defaults leak or jump otherwise (design section 3)."""
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
    noise = gtsam.noiseModel.Isotropic.Sigma(3, HELD)
    if key >> SYMBOL_BITS == POSE_CHARACTER:
        return gtsam.PriorFactorPose2(key, values.atPose2(key), noise)
    return gtsam.PriorFactorVector(key, values.atVector(key), noise)
