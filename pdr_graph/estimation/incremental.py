"""iSAM2 of a walk under way: GTSAM's fixed-lag smoother with the factors of its window.

`gtsam.IncrementalFixedLagSmoother` is iSAM2 (Kaess, Johannsson, Roberts, Ila, Leonard, Dellaert, "iSAM2: Incremental
smoothing and mapping using the Bayes tree", IJRR 31(2), 2012) with marginalisation of what leaves the window. It
linearises each factor, again where a variable has moved beyond a threshold, and gives poses and covariances. A factor
is a ``gtsam.CustomFactor`` with the residual and the derivatives of its block; all callbacks of an update share one
evaluation of the walk. A factor that has changed (an outlier, other walls, another sigma) is replaced.

What marginalisation leaves is linear about the variables at the edge of the window, which iSAM2 holds at their
linearisation point from then on. Where such a variable moves several thresholds all the same, iSAM2 is rebuilt, with
the marginal as a factor like the others (`MarginalFactor`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any
from weakref import proxy

import gtsam
import numpy as np

from pdr_graph.estimation.factors.base import (
    CALIBRATION,
    KEY_NUMBER,
    POSE,
    FactorBlock,
    RobustLoss,
    State,
    insert,
    key,
)
from pdr_graph.estimation.factors.gtsam_export import BlockRows, unit_noise
from pdr_graph.estimation.factors.marginal import MarginalFactor
from pdr_graph.geometry import wrap_angle
from pdr_graph.types import FARTHEST, Array, Index, Mask

if TYPE_CHECKING:
    from pdr_graph.estimation.graph import WalkGraph

STAYS, LEAVES = 1e9, 0.0  # timestamps of the fixed-lag smoother: the window says who leaves, not a lag of its own
THRESHOLD = {  # of relinearisation: moves below change no pose by some centimetres
    POSE: np.array([0.1, 0.1, 0.005]),  # [m, m, rad]
    CALIBRATION: np.array([0.01, 0.004, 4e-4]),  # R_s, R_d, b [-, -, rad/s]
}
THRESHOLD_OF_OTHERS = np.array([0.2, 0.1, 0.05])  # offsets, places [m, m] and lag [s] or power [dB]; P, n, k of levels
WALLED = 0.08  # times these between walls, which begin and end to hold a step within a few centimetres
AGAIN = 4.0  # thresholds beyond which the update is repeated at once; below, a move changes others by its square
SAME = 0.02  # [σ] by which rows of a factor may differ from those that iSAM2 has, and as a share of the largest, /20
SYMBOLS = "abcdefghijklmnopqrstuvwxyz"

Name = tuple[str, tuple[str, ...]]  # of a block: its kind and the symbols of its variables
Identity = tuple[int, ...]  # of a factor in its block: its number, and the keys of its variables


class IncrementalSmoother:
    """iSAM2 with the factors of a walk; begins with all of them, at its start.

    least: information that each number of a variable has beyond the factors, for those that they do not determine.
    walk: whose factors it has; point: at which they are linearised; cost: of them there; estimate: of the variables of
    this walk that have not left.
    Raises RuntimeError, here and in all methods, if the factors do not determine all variables or are not finite.
    """

    def __init__(self, walk: WalkGraph, least: float = 0.0):
        self._least = least
        self._scale = WALLED if walk.walled else 1.0
        self._smoother = gtsam.IncrementalFixedLagSmoother(1.0, _parameters(self._scale))
        self._slots = dict[tuple[Name, Identity], int]()
        self._rows = dict[Name, FactorRows]()  # at the point of linearisation
        self._fresh: dict[Name, FactorRows] | None = None  # at the point of the update under way
        self._fixed = set[int]()  # keys of the variables that the marginal holds at their point
        self.walk, self.cost = walk, 0.0
        self.point = self.estimate = State({})
        self.update(walk)

    def update(self, walk: WalkGraph) -> None:
        """Take the factors of a walk that goes on, or is decided otherwise, and update once.

        New variables begin at the walk's start.
        """
        known, self.point = _keys(self.point), walk.start.at(self.point)
        now = self._evaluated(walk, self.point)
        graph, removed, added, slots = gtsam.NonlinearFactorGraph(), list[int](), list[tuple[Name, Identity]](), {}
        for name, rows in now.items():
            same = rows.follow(self._rows.get(name))
            for n, identity in enumerate(rows.identity):
                slot = self._slots.get((name, identity))
                if slot is not None and same[n]:
                    slots[name, identity] = slot
                elif rows.most[n]:
                    graph.add(rows.native(n) or self._custom(name, rows, n))
                    added.append((name, identity))
        removed = sorted(slot for each, slot in self._slots.items() if each not in slots)
        values, stamps = gtsam.Values(), dict[int, float]()
        for symbol, variables in self.point.arrays.items():
            for variable_key, variable in zip(self.point.keys(symbol).tolist(), variables, strict=True):
                if variable_key not in known:
                    insert(values, symbol, variable_key, variable)
                    stamps[variable_key] = STAYS
                    if self._least:
                        graph.add(_prior(symbol, variable_key, variable, self._least))
        self.walk, self._slots, self._rows = walk, slots, now
        self._run(graph, values, stamps, removed)
        index = self._smoother.getISAM2Result().getNewFactorsIndices()
        self._slots |= {each: int(index[n]) for n, each in enumerate(added)}
        # iSAM2 has dropped the variables without a factor; those that the marginal still binds are marginalised
        isam, gone = self._smoother.getISAM2(), sorted(known - _keys(self.point))
        if bound := [variable_key for variable_key in gone if isam.valueExists(variable_key)]:
            self._marginalize(bound)
        self._read()

    def again(self) -> None:
        """Update once more without new factors."""
        self._run(gtsam.NonlinearFactorGraph(), gtsam.Values(), {}, [])
        self._read()

    def leave(self, leaving: Iterable[tuple[str, int]]) -> None:
        """Marginalise variables, given by symbol and number; their factors are those of the present walk."""
        keys = {key(*name) for name in leaving}
        self._slots = {each: slot for each, slot in self._slots.items() if keys.isdisjoint(each[1][1:])}
        self._marginalize(keys)
        self._read()

    @property
    def converged(self) -> bool:
        """True if no variable is so far from its point that another update would change the estimate."""
        return self._farthest(held=False) <= AGAIN

    @property
    def stale(self) -> bool:
        """True if a variable that the marginal holds has moved so far: iSAM2 is to be begun anew."""
        return self._farthest(held=True) > AGAIN

    def joint(self, *groups: tuple[str, Index]) -> Array:
        """Joint covariances ``(n, 3 d, 3 d)`` of n groups of d variables, as `Solution.joint`."""
        isam = self._smoother.getISAM2()
        keys = np.stack([self.estimate.keys(symbol, rows) for symbol, rows in groups], axis=1)
        joint = np.empty((len(keys), keys.shape[1], 3, keys.shape[1], 3))
        for n, group in enumerate(keys.tolist()):
            if len(group) == 1:
                joint[n, 0, :, 0] = isam.marginalCovariance(group[0])
                continue
            of_group = isam.jointMarginalCovariance(group)
            for a, first in enumerate(group):
                for b in range(a, len(group)):
                    joint[n, a, :, b] = of_group.at(first, group[b])
                    joint[n, b, :, a] = joint[n, a, :, b].T
        return joint.reshape(len(keys), 3 * keys.shape[1], -1)

    def marginals(self) -> list[MarginalFactor]:
        """The factors that marginalisation has left, about the point at which they hold."""
        factors, found = self._smoother.getFactors(), list[MarginalFactor]()
        for factor in map(factors.at, range(factors.size())):
            if isinstance(factor, gtsam.LinearContainerFactor):
                names = [(chr(each >> 56), each & KEY_NUMBER) for each in factor.keys()]
                point = [self.point[s][int(np.flatnonzero(self.point.number(s) == n)[0])] for s, n in names]
                whole = factor.factor().augmentedInformation()
                found.append(MarginalFactor.of(names, np.array(point), whole[:-1, :-1], -whole[:-1, -1]))
        return found

    # Inside

    def _run(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, stamps: Mapping[Any, float], removed: list[int]
    ) -> None:
        """One update of iSAM2."""
        self._fresh = None
        self._smoother.update(graph, values, stamps, removed)

    def _marginalize(self, keys: Iterable[int]) -> None:
        """Marginalise variables; those at the edge of what is left are held at their point from then on."""
        self._run(gtsam.NonlinearFactorGraph(), gtsam.Values(), dict.fromkeys(keys, LEAVES), [])
        fixed = self._smoother.getISAM2().getFixedVariables()
        self._fixed = {each for each in _keys(self.point) if fixed.count(each)}

    def _read(self) -> None:
        """Read linearisation point and estimate. Raises RuntimeError for an estimate that nothing determines."""
        self.point = self._state(self._smoother.getLinearizationPoint())
        self.estimate = self._state(self._smoother.calculateEstimate())
        for symbol, rows in self.estimate.arrays.items():
            if not (np.abs(rows) < FARTHEST).all():  # QR goes on with pivots that are rounding errors
                raise RuntimeError(f"nothing determines variable {symbol}")

    def _state(self, values: gtsam.Values) -> State:
        """The variables of the walk in ``values``, in its order."""
        return self.walk.start.among(State.of_values(values))

    def _farthest(self, held: bool) -> float:
        """The largest move of a variable from its point, in thresholds; of those that are held, or of the others."""
        longest = 0.0
        for symbol, rows in self.estimate.arrays.items():
            moved = rows - self.point[symbol]
            if symbol == POSE:
                moved[:, 2] = wrap_angle(moved[:, 2])
            shares = (np.abs(moved) / _threshold(symbol)).max(axis=1, initial=0.0)
            fixed = [each in self._fixed for each in self.estimate.keys(symbol).tolist()]
            longest = max(longest, float(shares[np.array(fixed, dtype=bool) == held].max(initial=0.0)))
        return longest / self._scale

    def _evaluated(self, walk: WalkGraph, point: State) -> dict[Name, FactorRows]:
        """The rows of all blocks of a walk at a point; their cost is stored."""
        at, found = walk.evaluate(point), dict[Name, FactorRows]()
        if not np.isfinite(at.cost):
            raise RuntimeError("the cost is not finite")  # GTSAM would go on with it
        self.cost = at.cost
        for block in filter(len, at.blocks):
            name = block.name, tuple(symbol for symbol, _ in block.variables)
            while name in found:  # marginals of the same kinds of variables
                name = name[0] + "'", name[1]
            found[name] = FactorRows(block, point)
        at.forget_blocks()
        return found

    def _custom(self, name: Name, factors: FactorRows, n: int) -> gtsam.CustomFactor:
        """Factor ``n`` of a block for iSAM2, where GTSAM has none; it must not own the smoother, which owns it."""
        identity, rows, smoother = factors.identity[n], factors.most[n], proxy(self)

        def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
            part = smoother._part(values, name, identity, rows)
            if jacobians is not None:
                for v in range(len(identity) - 1):
                    jacobians[v] = part[:, 1 + 3 * v : 4 + 3 * v]
            return part[:, 0]

        return gtsam.CustomFactor(factors.noise(n), list(identity[1:]), error)

    def _part(self, values: gtsam.Values, name: Name, identity: Identity, rows: int) -> Array:
        """Residual and derivatives ``(rows, 1 + 3 v)`` of a factor at the point of the update under way."""
        if self._fresh is None:
            point, self._fresh = self._state(values), self._rows
            if any(not np.array_equal(point[symbol], self.point[symbol]) for symbol in self.walk.start.arrays):
                self._fresh = self._evaluated(self.walk, point)
        here = self._fresh[name]
        n = here.place[identity]
        self._rows[name].linearized(identity, here.of(n))
        return here.filled(n, rows)


class FactorRows(BlockRows):
    """The factors of a block at one state, beside those that iSAM2 has.

    identity: of each of the ``n`` factors; place: of each identity.
    """

    def __init__(self, block: FactorBlock, state: State):
        super().__init__(block)
        keys = [state.keys(symbol, rows).tolist() for symbol, rows in block.variables]
        self.identity: list[Identity] = list(zip(block.number.tolist(), *keys, strict=True))
        self.place = dict(zip(self.identity, range(len(self.identity)), strict=True))
        self._native, self._constants = block.native, block.constants
        self._robust = block.loss if isinstance(block.loss, RobustLoss) else None
        self._outlier = [False] * len(block) if self._robust is None else self._robust.outlier.tolist()
        if self._robust is None and block.loss.noise(0, unit_noise(1)) is None:  # GTSAM does not have the loss
            self.rows *= np.sqrt(block.weight)[block.row_of, None]
        self._each = block.rows_each
        self._last = list[Array | None]([None] * len(block))  # as iSAM2 linearised them

    def native(self, n: int) -> gtsam.NonlinearFactor | None:
        """GTSAM's own version of a factor, which needs no callback; None if it has none."""
        if self._native is None or self._constants is None:
            return None
        self._last[n] = self._constants[n]
        return self._native(n)

    def noise(self, n: int) -> gtsam.noiseModel.Base:
        """GTSAM's noise model of a factor: its rows are whitened."""
        unit = unit_noise(self.most[n])
        return unit if self._robust is None else self._robust.noise(n, unit)

    def linearized(self, identity: Identity, rows: Array) -> None:
        """Store the rows with which iSAM2 has a factor from now on."""
        if (n := self.place.get(identity)) is not None:
            self._last[n] = rows

    def follow(self, before: FactorRows | None) -> list[bool]:
        """Take what iSAM2 has of the factors that were there before; True for those that are still the same."""
        if before is None:
            return [False] * len(self.identity)
        same = [False] * len(self.identity)
        there, now, last = list[int](), list[Array](), list[Array]()
        for n, identity in enumerate(self.identity):
            old = before.place.get(identity, -1)
            rows = self._last[n] = before._last[old] if old >= 0 else None
            if rows is not None and self._outlier[n] == before._outlier[old]:
                if self._native is not None and self._constants is not None:
                    same[n] = bool((self._constants[n] == rows).all())
                    continue
                here = self.of(n)
                if here.shape == rows.shape:
                    there.append(n)
                    now.append(here)
                    last.append(rows)
        if not there:
            return same
        if self._each:
            alike = _alike(np.array(now), np.array(last)).tolist()
        else:
            alike = [not len(a) or bool(_alike(a[None], b[None])[0]) for a, b in zip(now, last, strict=True)]
        for n, is_alike in zip(there, alike, strict=True):
            same[n] = is_alike
        return same


def _alike(now: Array, last: Array) -> Mask:
    """True ``(n,)`` for factors whose rows ``(n, r, w)`` are nearly the same."""
    return np.abs(now - last).max(axis=(1, 2)) < SAME * (1 + np.abs(now).max(axis=(1, 2)) / 20)


def _keys(state: State) -> set[int]:
    """The keys of all variables."""
    return {variable_key for symbol in state.arrays for variable_key in state.keys(symbol).tolist()}


def _prior(symbol: str, variable_key: int, value: Array, information: float) -> gtsam.NonlinearFactor:
    """A weak prior of a variable ``(3,)``."""
    noise = gtsam.noiseModel.Isotropic.Precision(3, information)
    if symbol == POSE:
        return gtsam.PriorFactorPose2(variable_key, gtsam.Pose2(*value), noise)
    return gtsam.PriorFactorVector(variable_key, value, noise)


def _threshold(symbol: str) -> Array:
    """By how much a variable ``(3,)`` may move before its factors are linearised again."""
    return THRESHOLD.get(symbol, THRESHOLD_OF_OTHERS)


@cache
def _parameters(scale: float) -> gtsam.ISAM2Params:
    """Of iSAM2: thresholds per symbol, and a variable is examined at each update."""
    parameters, thresholds = gtsam.ISAM2Params(), gtsam.ISAM2ThresholdMap()
    for symbol in SYMBOLS:
        thresholds.insert((symbol, scale * _threshold(symbol)))
    parameters.setRelinearizeThreshold(thresholds)
    parameters.relinearizeSkip = 1
    parameters.findUnusedFactorSlots = True  # or the slots of removed factors are never used again
    parameters.enablePartialRelinearizationCheck = False
    parameters.setFactorization("QR")
    return parameters
