"""iSAM2 that cannot be corrupted: named factors, and a shadow of all that it holds.

``ISAM2.update`` is not transactional (gtsam 4.3.0): after an exception the object may crash or go on with stale
estimates, and a NaN passes without a word. So whatever goes in is kept here too, under a name; when an update fails the
object is thrown away and a new one is made of the shadow. What marginalised variables left behind are factors of
GTSAM's own, and are kept with the others.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from typing import Any

import gtsam
import numpy as np

from pdr_graph.types import Array

Name = Hashable
RELINEARISE = 0.01  # [m, rad, -] that a variable moves before GTSAM's own factors of it are linearised again
HELD = 1e3  # [m, rad, -] standard deviation of a hold on what nothing determines
POSE = ord("x")
DROPPED = "left out, not finite"


class Tree:
    """The variables of a walk under way, and its factors by name; those older than ``lag`` [s] are marginalised.

    values: the estimate; past: what variables that were marginalised have left behind; rebuilds: why it was made anew.
    """

    def __init__(self, lag: float = np.inf, relinearise: float = RELINEARISE):
        self.lag, self.relinearise = lag, relinearise
        self.values = gtsam.Values()
        self.factors: dict[Name, gtsam.NonlinearFactor] = {}
        self.rebuilds: list[str] = []
        self.updates = 0
        self._slots: dict[Name, int] = {}
        self._keys: dict[Name, frozenset[int]] = {}
        self.past: list[gtsam.NonlinearFactor] = []
        self._times: dict[int, float] = {}
        self._smoother = _smoother(lag, relinearise)

    def __contains__(self, key: int) -> bool:
        """True if a variable is alive."""
        return self.values.exists(key)

    def update(
        self,
        add: Mapping[Name, gtsam.NonlinearFactor],
        remove: Iterable[Name] = (),
        values: gtsam.Values | None = None,
        times: Mapping[int, float] | None = None,
    ) -> None:
        """One incremental update: factors of known names are replaced.

        values: of new variables; times: of these, and of those that must stay alive [s].
        """
        values, times = values or gtsam.Values(), dict[Any, Any](times or {})
        gone = [name for name in {*remove, *add} if name in self.factors]
        slots = [self._slots[name] for name in gone]
        for name in gone:
            del self.factors[name], self._slots[name], self._keys[name]
        self.factors.update(add)
        self._keys |= {name: frozenset(factor.keys()) for name, factor in add.items()}
        self._times.update(times)
        try:
            self._smoother.update(_graph(add.values()), values, times, slots)
            self._accept(list(add))
        except (RuntimeError, ValueError, IndexError) as error:
            self._rebuild(values, f"{type(error).__name__}: {str(error).strip().splitlines()[0][:100]}")

    def covariance(self, keys: list[int]) -> Array:
        """Joint covariance of some variables, in GTSAM's local coordinates."""
        return np.asarray(self._smoother.getISAM2().jointMarginalCovariance(keys).fullMatrix())

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """All factors, those of what was marginalised too."""
        return _graph([*self.factors.values(), *self.past])

    def anew(self, relinearise: float) -> Tree:
        """The same in a new object, linearised again whenever a variable has moved so far."""
        again = self.at(gtsam.Values(self.values), leave_out=())
        again.relinearise = relinearise
        again.start({})
        return again

    def at(self, values: gtsam.Values, leave_out: Collection[Name]) -> Tree:
        """The same from other values without some factors, not yet started: `start` with those in their place does."""
        again = Tree(self.lag, self.relinearise)
        again.factors = {name: factor for name, factor in self.factors.items() if name not in leave_out}
        again.past, again.rebuilds, again._times = self.past, self.rebuilds, dict(self._times)
        again.values = values
        return again

    def state(self, leave_out: Collection[Name]) -> dict[str, Any]:
        """The variables, and all factors but those named, as numbers: linear where they are not already."""
        factors = {name: factor for name, factor in self.factors.items() if name not in leave_out}
        named = [(*name, 0)[:2] if isinstance(name, tuple) else (name, -1) for name in factors]
        return {
            "lag": self.lag,
            "rebuilds": list(self.rebuilds),
            "keys": [(key, self._times[key]) for key in self.values.keys()],
            "variables": np.array([_numbers(self.values, key) for key in self.values.keys()]),
            "names": [list(name) for name in named],
            "factors": [_packed(factor, self.values) for factor in (*factors.values(), *self.past)],
        }

    @classmethod
    def restored(cls, state: dict[str, Any]) -> Tree:
        """What `state` told of, not yet started: `start` with the factors that were left out does."""
        tree = cls(float(state["lag"]))
        values = gtsam.Values()
        for (key, time), numbers in zip(state["keys"], state["variables"], strict=True):
            _insert(values, int(key), numbers)
            tree._times[int(key)] = float(time)
        factors = [_unpacked(one, values) for one in state["factors"]]
        names = [(kind, int(number)) if number >= 0 else kind for kind, number in state["names"]]
        tree.past = factors[len(names) :]
        tree.factors = dict(zip(names, factors, strict=False))
        tree.values, tree.rebuilds = values, list(state["rebuilds"])
        return tree

    def start(self, factors: Mapping[Name, gtsam.NonlinearFactor]) -> None:
        """Begin with these factors too, after `restored` or `at`."""
        self.factors.update(factors)
        self._keys = {name: frozenset(factor.keys()) for name, factor in self.factors.items()}
        self._start(gtsam.Values(self.values))

    def _accept(self, added: list[Name]) -> None:
        """Take over what an update has found; RuntimeError if it is not finite."""
        found = self._smoother.calculateEstimate()
        poses = gtsam.utilities.extractPose2(found)
        if not (np.isfinite(poses).all() and all(np.isfinite(v).all() for v in _vectors(found))):
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
        for name in [n for n, keys in self._keys.items() if not self._times.keys() >= keys]:
            del self.factors[name], self._slots[name], self._keys[name]
        held, ours = self._smoother.getFactors(), set(self._slots.values())
        self.past = [held.at(slot) for slot in range(held.size()) if slot not in ours and held.exists(slot)]

    def _rebuild(self, values: gtsam.Values, why: str) -> None:
        """A new object of the shadow; factors that are not finite are left out, and what nothing determines is held."""
        known = gtsam.Values(self.values)
        known.insert(values)
        bad = [name for name, factor in self.factors.items() if not _finite(factor, known)]
        for name in bad:
            del self.factors[name], self._keys[name]
        self.rebuilds.append(f"{why}; {len(bad)} factors {DROPPED}" if bad else why)
        try:
            self._start(known)
        except (RuntimeError, ValueError, IndexError):
            for key in known.keys():
                self.factors[("held", key)], self._keys[("held", key)] = _hold(known, key), frozenset([key])
            self._start(known)

    def _start(self, known: gtsam.Values) -> None:
        self._smoother = _smoother(self.lag, self.relinearise)
        self._slots = {}
        graph = _graph([*self.factors.values(), *self.past])
        self._smoother.update(graph, known, {key: self._times[key] for key in known.keys()}, [])
        self._accept(list(self.factors))


def linear(keys: Sequence[int], blocks: Sequence[Array], error: Array, at: gtsam.Values) -> gtsam.NonlinearFactor:
    """A factor that was linearised ``at`` some values: whitened errors ``(r,)``, and a block ``(r, 3)`` per key."""
    terms: list[Any] = [side for pair in zip(keys, blocks, strict=True) for side in pair]
    make: Any = gtsam.JacobianFactor  # its overloads are of one, two and three variables
    factor = make(*terms, -error, gtsam.noiseModel.Unit.Create(len(error)))
    return gtsam.LinearContainerFactor(factor, _some(at, keys))


def _packed(factor: gtsam.NonlinearFactor, values: gtsam.Values) -> dict[str, Any]:
    """A factor, linear at these values: its keys and its information, that of the error in the last row."""
    gaussian = factor.linearize(values)
    return {"keys": list(gaussian.keys()), "information": gaussian.augmentedInformation()}


def _unpacked(packed: dict[str, Any], values: gtsam.Values) -> gtsam.NonlinearFactor:
    """The sum of what each pair of keys has; GTSAM's own constructors take no more than three."""
    keys, information = [int(key) for key in packed["keys"]], np.asarray(packed["information"])
    graph, zero, nothing = gtsam.GaussianFactorGraph(), np.zeros((3, 3)), np.zeros(3)
    block = [slice(3 * n, 3 * n + 3) for n in range(len(keys))]
    for n, key in enumerate(keys):
        squared = float(information[-1, -1]) if n == 0 else 0.0
        graph.push_back(gtsam.HessianFactor(key, information[block[n], block[n]], information[block[n], -1], squared))
        for m in range(n + 1, len(keys)):
            across = information[block[n], block[m]]
            graph.push_back(gtsam.HessianFactor(key, keys[m], zero, across, nothing, zero, nothing, 0.0))
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(gtsam.HessianFactor(graph)), _some(values, keys))


def _some(values: gtsam.Values, keys: Iterable[int]) -> gtsam.Values:
    """Some of the variables."""
    some = gtsam.Values()
    for key in keys:
        _insert(some, key, _numbers(values, key))
    return some


def _numbers(values: gtsam.Values, key: int) -> Array:
    """A variable as three numbers."""
    if gtsam.Symbol(key).chr() != POSE:
        return values.atVector(key)
    pose = values.atPose2(key)
    return np.array([pose.x(), pose.y(), pose.theta()])


def _insert(values: gtsam.Values, key: int, numbers: Array) -> None:
    values.insert(key, gtsam.Pose2(*numbers) if gtsam.Symbol(key).chr() == POSE else np.asarray(numbers))


def _smoother(lag: float, relinearise: float) -> gtsam.IncrementalFixedLagSmoother:
    """GTSAM's fixed-lag smoother; the settings that are not its defaults leak or jump otherwise (design section 3)."""
    parameters = gtsam.ISAM2Params()
    parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
    parameters.setRelinearizeThreshold(relinearise)
    parameters.relinearizeSkip = 1
    parameters.enablePartialRelinearizationCheck = relinearise > 0
    parameters.findUnusedFactorSlots = True
    parameters.setFactorization("QR")
    return gtsam.IncrementalFixedLagSmoother(min(lag, 1e12), parameters)


def _graph(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def _vectors(values: gtsam.Values) -> list[Array]:
    return [gtsam.utilities.extractVectors(values, symbol) for symbol in "cgbq"]


def _finite(factor: gtsam.NonlinearFactor, values: gtsam.Values) -> bool:
    """Whether a factor is, linearised."""
    try:
        return bool(np.isfinite(factor.linearize(values).augmentedJacobian()).all())
    except (RuntimeError, ValueError):
        return False


def _hold(values: gtsam.Values, key: int) -> gtsam.NonlinearFactor:
    noise = gtsam.noiseModel.Isotropic.Sigma(3, HELD)
    if gtsam.Symbol(key).chr() == POSE:
        return gtsam.PriorFactorPose2(key, values.atPose2(key), noise)
    return gtsam.PriorFactorVector(key, values.atVector(key), noise)
