"""Fixes: measured positions of one receiver or several, and their longest consistent chain.

A robust loss handles scattered outliers. Consecutive outliers that agree with one another (a receiver locked to a
reflection, a wrongly listed beacon) bend the walk until the good fixes beside them look wrong, and no loss recovers
from there. But a walk through them must jump twice. So the longest chain of fixes is used first in which each is within
reach of the run before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Self, TypeVar

import numpy as np

from pdr_graph.estimation.ambiguity.hypothesis import Hypothesis, Proposal, Wording, wording_of
from pdr_graph.estimation.factors.base import (
    AnyArray,
    Doubted,
    FactorBlock,
    Itemized,
    Refined,
    Remembered,
    RobustLoss,
    WeighsPoses,
)
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.geometry import as_complex, dead_reckon, distance_walked, interpolate, pose_rotation
from pdr_graph.priors import FIXES, PARTICLES, PRICES, RECEIVERS
from pdr_graph.types import (
    DUPLICATE,
    FROZEN,
    KEYFRAME,
    LOUD_BEACON,
    OUTSIDE,
    TABLE,
    Array,
    Fixes,
    FixReport,
    Index,
    Mask,
    Steps,
)

if TYPE_CHECKING:
    import gtsam

    from pdr_graph.estimation.factors.chain import Chain, Evaluation

Drift = TypeVar("Drift", float, Array)
RAYLEIGH_MEDIAN = 1.18  # [σ] per axis, of the distance of honest fixes: √(2 ln 2)
FEWEST_TRIPLES = 10  # of fixes that measure how much of their sigma changes within seconds
MOST_RUNS = 1000  # searched backwards for a predecessor
ENDS = 3  # fixes at the end of a run that may lead to the next: an outlier just within reach must not part two runs


@dataclass(frozen=True, eq=False)
class FixFactor(Itemized, Refined, Remembered, Doubted, WeighsPoses):
    """Positions with independent errors: r = (p − z) / σ. [gps-dr] Sec. 4

    fixes: all of them, ``f``; steps: of their walk; number: ``(f,)`` permanent numbers.
    sigma: ``(f,)`` per axis, wider outside the recording [m]; used: ``(f,)`` not far outside it, new and not frozen;
    duplicate: ``(f,)`` epochs that repeat the epoch before; still: ``(f,)`` of a frozen receiver, see `frozen`.
    run: ``(f,)`` number of the run of fixes within reach of each other, −1 for unused ones; consistent: ``(f,)`` in the
    longest chain that one walk can have made.
    independent_sigma: ``(f,)`` wider, so that correlated fixes of one receiver may be treated as independent [m].
    outlier: ``(f,)`` far from the first optimum; held: ``(f,)`` with a factor, here or in `GnssBias`.
    biased: ``(f,)`` with a factor in `GnssBias`, which models their common error, and none here.
    keyframe: ``(f,)``; approximate: the fixes only initialise the search.
    widened: ``(f,)`` factor by which sigmas are wider than stated; wrong: ``(f,)`` assumed to be.
    """

    fixes: Fixes
    steps: Steps = field(metadata=TABLE)
    number: Index
    sigma: Array
    used: Mask
    duplicate: Mask
    still: Mask
    run: Index
    consistent: Mask
    independent_sigma: Array
    outlier: Mask
    held: Mask
    biased: Mask
    keyframe: Index = field(metadata=KEYFRAME)
    widened: Array
    approximate: bool = False
    wrong: Mask | bool = False

    name: ClassVar[str] = "fixes"
    determines_position: ClassVar[bool] = True
    overhang: ClassVar[float] = FIXES.longest_overhang

    @classmethod
    def of(
        cls, fixes: Fixes, steps: Steps, prior: Prior, number: Index | None = None, *, approximate: bool = False
    ) -> FixFactor:
        """The fixes of one walk. approximate: they only initialise the search; number: 0, 1, … by default."""
        overhang = np.maximum(np.maximum(steps.start - fixes.time, fixes.time - steps.end), 0.0)
        fresh, sigma = overhang <= FIXES.longest_overhang, np.hypot(fixes.sigma, FIXES.walking_speed * overhang)
        duplicate, still = duplicates(fixes), frozen(fixes, steps)
        used = fresh & ~duplicate & ~still
        longest = steps if prior.longest == 1 else replace(steps, length=prior.longest * steps.length)
        run, consistent = consistent_chains(longest, fixes, sigma, used)
        independent = sigma.copy()  # n fixes of the same error have the information of one
        for indices in by_source(fixes, consistent):
            first, after = alike(drift(steps, fixes.time[indices]))
            independent[indices] *= np.sqrt(after - first)
        none = np.zeros(len(fixes), dtype=bool)
        return cls(
            fixes=fixes,
            steps=longest,
            number=np.arange(len(fixes)) if number is None else number,
            sigma=sigma,
            used=used,
            duplicate=duplicate,
            still=still & ~duplicate,
            run=run,
            consistent=consistent,
            independent_sigma=independent,
            outlier=none,
            held=consistent,
            biased=none,
            keyframe=np.full(len(fixes), -1),
            widened=np.ones(len(fixes)),
            approximate=approximate,
        )

    def __len__(self) -> int:
        return len(self.fixes)

    @property
    def determines_drift(self) -> bool:
        """True for four fixes or more: two fit any drift, three another direction or length."""
        return int(self.used.sum()) > 3

    def keyframe_times(self) -> Array:
        """The times of the fixes that are used."""
        return self.fixes.time[self.used]

    def bind(self, chain: Chain) -> Self:
        """Bind every fix to its keyframe."""
        return replace(self, keyframe=chain.keyframe(self.fixes.time))

    @cached_property
    def independent(self) -> Index:
        """The fixes that have a factor here."""
        return np.flatnonzero(self.held & ~self.biased & (self.keyframe >= 0))

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """One factor for each fix that is treated as independent."""
        which = self.independent
        sigma, loss = self.independent_sigma[which], RobustLoss(self.outlier[which])
        pose, position = at.state.poses[self.keyframe[which]], self.fixes.position[which]

        def jacobian() -> list[Array]:
            return [pose_rotation(pose[:, 2])[:, :2] / sigma[:, None, None]]

        def native(n: int) -> gtsam.NonlinearFactor:
            import gtsam

            pose_key = int(at.state.keys("x", self.keyframe[which])[n])
            noise = loss.noise(n, gtsam.noiseModel.Isotropic.Sigma(2, sigma[n]))
            return gtsam.PoseTranslationPrior2D(pose_key, position[n], noise)

        value = (pose[:, :2] - position) / sigma[:, None]
        variables = [("x", self.keyframe[which])]
        more = {"loss": loss, "native": native, "constants": np.column_stack([position, sigma])}
        return [FactorBlock.uniform(self.name, value, variables, jacobian, self.number[which], **more)]

    def pose_costs(self, keyframe: int) -> FixCosts | None:
        """The used fixes at a keyframe, as if independent; not the rough fixes of another kind, which weighs itself."""
        here = self.used & (self.keyframe == keyframe)
        if self.approximate or not here.any():
            return None
        return FixCosts(self.fixes.position[here], self.independent_sigma[here], self.outlier[here])

    def distance(self, at: Evaluation) -> Array:
        """Distance ``(f,)`` [m] of each fix from the walk at its time."""
        return np.hypot(*(at.state.poses[self.keyframe, :2] - self.fixes.position).T)

    def refined(self, at: Evaluation) -> Self:
        """Mark fixes far from a first optimum as outliers; leave those of one receiver to `GnssBias`.

        Approximate fixes, used only for the start, are released. Receivers that state too little get wider sigmas.
        """
        factor = self._by_scatter(at)
        if (factor != 1).any():
            return self._wider(factor).refined(at)
        far = self.used & (self.distance(at) > FIXES.outlier * self.sigma)
        # The rest of a run in a wrong place does not become right where the walk happens to pass it
        share = np.bincount(self.run + 1, far) / np.maximum(np.bincount(self.run + 1), 1)
        held = self.used & (self.consistent | (share[self.run + 1] <= 0.5))
        of_receiver = sourced(self.fixes)
        if not (far.any() or of_receiver.any() or self.approximate) and (held == self.held).all():
            return self
        return self.classified(far, held & (not self.approximate))

    def _wider(self, factor: Array) -> Self:
        """Multiply the sigmas by a factor ``(f,)``."""
        sigma, independent = factor * self.sigma, factor * self.independent_sigma
        return replace(self, sigma=sigma, independent_sigma=independent, widened=factor * self.widened)

    def _by_scatter(self, at: Evaluation) -> Array:
        """The factors ``(f,)`` by which sigmas should change, by the scatter of a receiver's fixes in a second.

        Most of a receiver's error stays the same from one second to the next, so that a larger scatter is a larger
        error. Only fixes of the consistent chain count: scattered outliers are no scatter of the receiver.
        """
        off, stated = at.state.poses[self.keyframe, :2] - self.fixes.position, self.sigma / self.widened
        wider = self.widened.copy()
        for indices in by_source(self.fixes, self.used & (self.keyframe >= 0)):
            chain = indices[self.consistent[indices]]
            time, middle = self.fixes.time[chain], chain[1:-1]
            scatter = np.hypot(*(off[middle] - (off[chain[:-2]] + off[chain[2:]]) / 2).T) / np.sqrt(1.5)
            within = time[2:] - time[:-2] <= FIXES.seconds
            if within.sum() >= FEWEST_TRIPLES:
                share = float(np.median((scatter / stated[middle])[within])) / RAYLEIGH_MEDIAN
                wider[indices] = 1 + max(0.0, share - FIXES.suspicious) / RECEIVERS.white
        factor = wider / self.widened
        return np.where(np.abs(np.log(factor)) > 0.2, factor, 1.0)

    def classified(self, outlier: Mask, held: Mask) -> Self:
        """Set the masks ``outlier (f,)`` and ``held (f,)``; fixes that are not held have no factor."""
        return replace(self, outlier=outlier, held=held, biased=held & sourced(self.fixes))

    def misplaced(self, sigma: float) -> Self:
        """The same fixes with an error of ``sigma`` [m] per axis in addition to theirs."""
        wider = {name: np.hypot(getattr(self, name), sigma) for name in ("sigma", "independent_sigma")}
        return replace(self, **wider)

    def rejected(self, number: Index) -> Self:
        """Mark the fixes with these numbers as outliers."""
        return self.classified(self.outlier | np.isin(self.number, number), self.held)

    def reclassified(self, at: Evaluation) -> Self:
        """Mark fixes far from the walk as outliers, or drop them if inconsistent; restore near ones.

        Receivers that state too little get wider sigmas.
        """
        factor = self._by_scatter(at)
        if (factor != 1).any():
            return self._wider(factor).reclassified(at)
        far = self.distance(at) > FIXES.outlier * self.sigma
        reached = self.used & (self.keyframe >= 0)
        outlier = np.where(reached, far & (self.consistent | self.outlier), self.outlier)
        held = np.where(reached, ~far | self.consistent, self.held)
        return self.classified(outlier, held & np.logical_not(self.wrong))

    def hypotheses(self, at: Evaluation, by_others: Callable[[], Evaluation] | None) -> Sequence[Proposal]:
        """A fix beside the one farthest from the walk, or that one, is wrong: the walk may have followed it."""
        own = self.independent[np.argsort(self.fixes.time[self.independent], kind="stable")]
        if self.approximate or len(own) < 2:
            return ()
        sigmas = (self.distance(at) / self.sigma)[own]
        worst = int(np.argmax(sigmas))
        if len(own) * np.exp(-(sigmas[worst] ** 2) / 2) > FIXES.doubtful:
            return ()
        usual, found = float(np.median(self.sigma[own])), list[Proposal]()
        for place in range(max(worst - 1, 0), min(worst + 2, len(own))):
            n, near = int(own[place]), own[max(place - 1, 0) : place + 2]
            if self.outlier[n]:
                continue
            outlier, held = self.outlier.copy(), self.held.copy()
            outlier[near], held[near] = False, self.used[near]  # those near it in time are no outliers
            held[n] = False
            price = PRICES.wrong_fix + 2 * float(np.log(max(usual / self.sigma[n], 1.0)))  # surer ones are right
            without = replace(self.classified(outlier, held), wrong=self.wrong | (self.number == self.number[n]))
            where = (float(self.fixes.time[n]), *self.fixes.position[n].tolist())
            wrong = Hypothesis((self.name, "wrong"), (int(self.number[n]),), where, price)
            found.append(Proposal(wrong, (without,)))
        return found

    @property
    def instances(self) -> tuple[Index, Array]:
        """Numbers and times of the fixes."""
        return self.number, self.fixes.time

    @property
    def diverged(self) -> bool:
        """True if the last consistent fixes all lie far from the walk."""
        last = np.flatnonzero(self.consistent & (self.keyframe >= 0))[-FIXES.patience :]
        return len(last) == FIXES.patience and bool(self.outlier[last].all())

    def contradicts(self, decisions: Mapping[str, AnyArray]) -> bool:
        """True if fixes before the newest were consistent with the others and no longer are."""
        if not decisions or np.count_nonzero(self.consistent) < 2:
            return False
        was = dict(zip(decisions["number"].tolist(), decisions["consistent"].tolist(), strict=True))
        newest = self.fixes.time[self.consistent].max()
        lost = self.used & ~self.consistent & (self.fixes.time < newest) & ~self._rejected_by(decisions)
        return any(was.get(number, False) for number in self.number[lost].tolist())

    def decisions(self) -> dict[str, AnyArray]:
        """The masks of outliers, of fixes with a factor, and of the consistent chain; factors of sigmas."""
        if not len(self):
            return {}
        masks = {"outlier": self.outlier, "held": self.held, "consistent": self.consistent}
        numbers = {"number": self.number, "widened": self.widened, "wrong": np.ones(len(self), dtype=bool) & self.wrong}
        return numbers | {name: np.asarray(mask) for name, mask in masks.items()}

    def continued(self, decisions: Mapping[str, AnyArray]) -> Self:
        """Keep outliers; release fixes that are no longer consistent with the others."""
        if not decisions:
            return self.classified(self.outlier, self.held)
        if (rejected := self._rejected_by(decisions)).any():
            share = np.where(rejected, FIXES.rejected, 1.0)
            run, consistent = consistent_chains(self.steps, self.fixes, self.sigma, self.used, share)
            return replace(self, run=run, consistent=consistent, held=consistent)._continued(decisions)
        return self._continued(decisions)

    def _rejected_by(self, decisions: Mapping[str, AnyArray]) -> Mask:
        """``(f,)`` True for the fixes that decisions mark as outliers or as wrong."""
        rejected = decisions["outlier"].astype(bool) | decisions["wrong"].astype(bool)
        return np.isin(self.number, decisions["number"][rejected])

    def _continued(self, decisions: Mapping[str, AnyArray]) -> Self:
        order = np.argsort(decisions["number"])
        stored = decisions["number"][order]
        place = np.minimum(np.searchsorted(stored, self.number), len(stored) - 1)
        was = order[place]
        decided = stored[place] == self.number if len(stored) else np.zeros(len(self), dtype=bool)
        outlier = np.where(decided, decisions["outlier"][was], self.outlier)
        still = decisions["held"][was] & (self.consistent | outlier)
        factor = np.where(decided, decisions["widened"][was], 1.0)
        for indices in by_source(self.fixes, np.ones(len(self), dtype=bool)):  # new fixes err as those before
            last = np.maximum.accumulate(np.where(decided[indices], np.arange(len(indices)), -1))
            factor[indices] = np.where(last >= 0, factor[indices[last]], 1.0)
        wrong = decided & decisions["wrong"][was]
        same = replace(self._wider(factor / self.widened), wrong=wrong)
        return same.classified(outlier, np.where(decided, still, self.held) & self.used & ~wrong)

    def weight(self, at: Evaluation) -> Array:
        """The share ``(f,)`` of each fix's information that is used."""
        weight = np.zeros(len(self))
        order = np.argsort(self.number)
        for block in at.blocks_of(self.name):
            weight[order[np.searchsorted(self.number[order], block.number)]] = block.weight
        return weight

    def reports(self, at: Evaluation, which: Index | None = None) -> tuple[FixReport, ...]:
        """Residual, weight and reason of every fix."""
        reached = self.keyframe >= 0
        distance = np.where(reached, self.distance(at), np.nan)
        return self.reported(distance, distance / self.sigma, self.weight(at), "the walk", which)

    def reported(
        self, distance: Array, sigmas: Array, weight: Array, origin: str, which: Index | None = None
    ) -> tuple[FixReport, ...]:
        """Reports of fixes, all or ``which``, at ``distance (f,)`` [m], in ``sigmas (f,)``, from ``origin``."""
        reports = []
        for n in np.arange(len(self)) if which is None else which:
            x, y = self.fixes.position[n].tolist()
            if self.duplicate[n]:
                reason = DUPLICATE
            elif self.still[n]:
                reason = FROZEN
            elif self.approximate:
                reason = LOUD_BEACON
            elif not self.used[n] or self.keyframe[n] < 0:
                reason = OUTSIDE
            else:
                reason = fix_reason(float(sigmas[n]), float(weight[n]), bool(self.outlier[n]), origin)
            time, sigma = float(self.fixes.time[n]), float(self.fixes.sigma[n])
            source = self.fixes.source[n] if self.fixes.source else ""
            reports.append(FixReport(time, x, y, sigma, float(distance[n]), float(weight[n]), reason, source))
        return tuple(reports)


@dataclass(frozen=True)
class FixCosts:
    """Costs of poses by fixes. position: ``(f, 2)`` [m]; sigma: ``(f,)`` per axis [m]; outlier: ``(f,)``."""

    position: Array
    sigma: Array
    outlier: Mask

    def costs(self, state: Array) -> Iterable[Array]:
        """Half the squared distance in sigmas from each fix."""
        for position, sigma in zip(self.position, self.sigma, strict=True):
            yield np.minimum(
                _squares(state, position) / (2 * max(sigma, PARTICLES.least_sigma) ** 2), PARTICLES.outlier_price
            )

    def place_sought(self, state: Array) -> tuple[Array, float] | None:
        """The fix farthest from all states if it costs an outlier: an outlier, or all states are wrong."""
        fixes = np.flatnonzero(~self.outlier)
        distance = [np.sqrt(_squares(state, self.position[f]).min()) for f in fixes]
        apart = np.divide(distance, self.sigma[fixes])
        if np.max(apart, initial=0.0) ** 2 / 2 <= PARTICLES.outlier_price:
            return None
        farthest = int(fixes[np.argmax(apart)])
        return self.position[farthest], max(self.sigma[farthest], PARTICLES.least_sigma)


def _squares(state: Array, place: Array) -> Array:
    """Squared distances ``(n,)`` [m²] from a place."""
    return np.square(state[0] - place[0]) + np.square(state[1] - place[1])


@wording_of(FixFactor.name)
def _wording(hypothesis: Hypothesis) -> Wording:
    """A fix is wrong."""
    time, x, y = hypothesis.parameter
    text = f"the fix at {time:.0f} s, ({x:.0f}, {y:.0f}) m, is wrong"
    return Wording(FixFactor.name, text, "that position and its sigma")


def fix_reason(sigmas: float, weight: float, outlier: bool, origin: str = "the walk") -> str:
    """The reason, as text, for the weight of a fix that lies so many sigmas from ``origin``."""
    trust = {0.0: "rejected", 1.0: "full weight"}.get(weight, "reduced weight")
    return f"{sigmas:.1f} sigma from {origin}: {'outlier' if outlier else trust}"


def consistent_chains(
    steps: Steps, fixes: Fixes, sigma: Array, used: Mask, share: Array | None = None
) -> tuple[Index, Mask]:
    """The run of every fix ``(f,)``, and a mask ``(f,)`` of the longest chain that one walk can have made.

    A run is a sequence of used fixes within reach of one another, used or dropped together. Others have run −1.
    sigma: ``(f,)`` [m] per axis; share: ``(f,)`` of each fix in the length of a chain, by default 1.
    """
    run, consistent = np.full(len(fixes), -1), np.zeros(len(fixes), dtype=bool)
    order = np.flatnonzero(used)
    order = order[np.argsort(fixes.time[order], kind="stable")]
    if len(order):
        moved = np.where(steps.is_gap, FIXES.driven * steps.duration, steps.length)
        way = FIXES.stretched * distance_walked(steps, fixes.time[order], moved)
        share = np.ones(len(fixes)) if share is None else share
        chains = longest_consistent_chain(
            fixes.position[order], FIXES.outlier * sigma[order], way, np.inf, ENDS, share[order]
        )
        run[order], consistent[order] = chains
    return run, consistent


def longest_consistent_chain(
    position: Array, error: Array, way: Array, jump: float, ends: int = 1, share: Array | None = None
) -> tuple[Index, Mask]:
    """The run of each fix ``(f,)``, and a mask ``(f,)`` of the longest chain of runs. At least one fix.

    position: ``(f, 2)`` [m] in order of time; error: ``(f,)`` largest error [m]; way: ``(f,)`` longest possible path
    since the start [m]. jump: fixes that an impossible jump costs a chain; ends: number of fixes at the end of a run,
    and at the start of the next, any of which may connect them: those passed over do not count; share: ``(f,)`` of each
    fix in the length of a chain.
    """

    def reaches(earlier: Index, later: Index) -> Mask:
        apart = position[later] - position[earlier]
        return np.hypot(apart[..., 0], apart[..., 1]) <= way[later] - way[earlier] + np.hypot(
            error[earlier], error[later]
        )

    every = np.arange(len(position))
    begins = np.append(True, ~reaches(every[:-1], every[1:]))
    first, run = np.flatnonzero(begins), np.cumsum(begins) - 1
    last = np.append(first[1:], len(position)) - 1
    share = np.ones(len(position)) if share is None else share
    length, total = np.add.reduceat(share, first), np.cumsum(share)
    before = np.full(len(first), -1)
    for n in range(1, len(first)):
        earlier = np.arange(max(0, n - MOST_RUNS), n)
        leaving = np.maximum(last[earlier, None] - np.arange(ends), first[earlier, None])
        entering = np.minimum(first[n] + np.arange(ends), last[n])
        led = np.array([reaches(leaving, np.full_like(leaving, at)) for at in entering])
        passed = total[last[earlier], None] - total[leaving] + (total[entering] - total[first[n]])[:, None, None]
        gain = length[earlier] - np.minimum(np.where(led, passed, jump).min(axis=(0, 2)), jump)
        if gain.max() > 0:
            before[n] = earlier[np.argmax(gain)]
            length[n] += gain.max()
    chain = [int(np.argmax(length))]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    in_chain = np.zeros(len(first), dtype=bool)
    in_chain[chain] = True
    return run, in_chain[run]


def duplicates(fixes: Fixes) -> Mask:
    """True ``(f,)`` where a receiver repeats its last position, as receivers do while they detect no motion."""
    result = np.zeros(len(fixes), dtype=bool)
    for indices in by_source(fixes, np.ones(len(fixes), dtype=bool)):
        result[indices[1:]] = (np.diff(fixes.position[indices], axis=0) == 0).all(axis=1)
    return result


def frozen(fixes: Fixes, steps: Steps) -> Mask:
    """True ``(f,)`` for the fixes of a receiver that holds its position while the steps lead away, but the first.

    Receivers do so where signals are weak (static navigation): the fixes agree with one another, and are sure.
    """
    result = np.zeros(len(fixes), dtype=bool)
    sources = by_source(fixes, np.ones(len(fixes), dtype=bool))
    if not sources:
        return result
    track = dead_reckon(steps)
    for indices in sources:
        place = as_complex(fixes.position[indices]).tolist()
        walked = as_complex(interpolate(fixes.time[indices], track.time, track.position))
        first = 0
        for n in range(1, len(indices) + 1):
            if n < len(indices) and abs(place[n] - place[first]) < RECEIVERS.still:
                continue
            if np.abs(walked[first:n] - walked[first]).max() > RECEIVERS.away:
                result[indices[first + 1 : n]] = True
            first = n
    return result


def sourced(fixes: Fixes) -> Mask:
    """True ``(f,)`` for fixes of a receiver."""
    return np.array([bool(source) for source in fixes.source], dtype=bool)


def by_source(fixes: Fixes, used: Mask) -> list[Index]:
    """The used fixes of each source that has a name, in order of time."""
    if not any(fixes.source):
        return []
    names = np.where(used, np.array(fixes.source, dtype=str), "")
    order = np.argsort(fixes.time, kind="stable")
    return [order[names[order] == name] for name in np.unique(names[names != ""])]


def drift(steps: Steps, time: Array) -> Array:
    """Drift ``(n,)`` of a receiver's errors by times ``(n,)`` [s]: at a difference of 1 their correlation is 1/e.

    Signal paths change with the place, and little where nobody moves.
    """
    return drift_of(time, distance_walked(steps, time))


def drift_of(time: Drift, walked: Drift) -> Drift:
    """Drift of a receiver's errors by a time [s] after ``walked`` [m], see `drift`."""
    return time / RECEIVERS.standing + walked / RECEIVERS.along


def alike(drifted: Array) -> tuple[Index, Index]:
    """Begin and end ``(f,)`` of the range of fixes with about the same error as each, from their drift ``(f,)``."""
    return np.searchsorted(drifted, drifted - 1.0, side="right"), np.searchsorted(drifted, drifted + 1.0)
