"""Velocities by a network: a second witness of each interval's displacement, and against the direction of the steps.

With p the keyframes' places and d the displacement by the network, in its own level frame, the residual of an interval
from keyframe i to j is

    r = [ g / R_s · R(φ)ᵀ (p_j − p_i) − d ] / σ,      φ = φ_s + Σ (Δθ(c) − turn)

The frame is the gyroscope's, turned by an unknown φ_s at the start of each calibration segment s, and drifting with the
calibration c as the steps' headings do, however the phone is held. g is the gain of the network over uncalibrated
steps along the first optimum, R_s their scale: a turned frame or another scale does no harm. The errors of d last for
seconds, so that its variance is 2 τ σ² Δt, that of a long interval. Huber's loss.

The first optimum is without the network, so that it cannot make fixes outliers; a network that contradicts the steps
most of the time, or by its speed, is not used then either. Where both contradict each other along a stretch, each of
both may be wrong: the network there, or the direction of the steps, which may then turn by any angle at either end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from pdr_graph.estimation.ambiguity.hypothesis import Hypothesis, Proposal, Wording, wording_of
from pdr_graph.estimation.factors.base import Doubted, FactorBlock, Refined, RobustLoss, Variables
from pdr_graph.estimation.factors.gnss_bias import QUARTER
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.factors.steps_and_walls import StepFactor
from pdr_graph.gait.learned import Velocities
from pdr_graph.geometry import ANY_HEADING, as_complex, interpolate, rotation, wrap_angle
from pdr_graph.inertial.attitude import runs
from pdr_graph.priors import FIXES, LEARNED, WALKER
from pdr_graph.types import INSTANT, Array, Complex, Index, Mask, Steps, take

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.chain import Chain, Evaluation

LONGEST_GAP = 1.0  # [s] between two velocities that are interpolated
KEYFRAMES_EVERY = 2.0  # [s] between keyframes: where the direction of the steps may turn
SLOWEST = 0.2  # [m/s] of steps that are compared with the network
MOST_DOUBTED = 3  # in doubt at once, the longest ones: 8 walks are solved
UNUSED = "not used: it contradicts the steps"
STRETCHES, NETWORK, STEP_DIRECTION = "wrong along stretches", "network", "step direction"


@dataclass(frozen=True)
class VelocityReport:
    """How the velocities of an interval were used.

    time: its middle [s]; speed: by the network [m/s]; residual: measured minus estimated velocity [m/s]; weight: share
    of its information that was used, 0-1.
    """

    time: float
    speed: float
    residual: float
    weight: float
    reason: str


@dataclass(frozen=True, eq=False)
class LearnedVelocityFactor(Refined, Doubted):
    """Displacements by a network, see above.

    moved: ``(k, 2)`` of each interval [m], NaN where the network has none; sigma: ``(k, 2)`` [m]; frame: ``(s,)`` of
    each calibration segment; angle: ``(s,)`` φ_s along the optimum without it [rad], None in the first pass; gain: g.
    wrong: ``(k,)`` intervals in which the network is assumed to be wrong.
    """

    velocities: Velocities
    times: Array
    moved: Array
    sigma: Array
    frame: Index
    angle: Array | None = None
    gain: float = 1.0
    wrong: Mask | bool = False

    name: ClassVar[str] = "network"
    symbol: ClassVar[str] = "v"

    @classmethod
    def of(cls, velocities: Velocities, steps: Steps, prior: Prior, number: Index | None = None) -> Self:
        """The velocities of one walk; `number` is not used."""
        times = np.arange(steps.start, steps.end, KEYFRAMES_EVERY)[1:]
        if len(steps) and steps.is_gap.any():  # also rides, which no network of walkers knows
            time, row = velocities.time, np.searchsorted(steps.time, velocities.time)
            row = np.minimum(row, len(steps) - 1)
            within = steps.is_gap[row] & (time > steps.time[row] - steps.duration[row]) & (time < steps.time[row])
            velocities = take(velocities, ~within)
        return cls(velocities, times, np.empty((0, 2)), np.empty((0, 2)), np.empty(0, dtype=np.intp))

    def keyframe_times(self) -> Array:
        """Times at which it needs keyframes, so that a wrong direction has an end."""
        return self.times

    def bind(self, chain: Chain) -> Self:
        """Integrate the velocities over the intervals of a chain."""
        of, time = self.velocities, self.velocities.time
        if not len(of):
            nothing = np.full((len(chain.segment), 2), np.nan)
            return replace(self, moved=nothing, sigma=nothing, frame=np.zeros(len(chain.segment_first), dtype=np.intp))
        gap = (np.diff(time) > LONGEST_GAP) | (np.diff(of.frame) != 0)
        rates = np.hstack([of.velocity, 2 * LEARNED.lasts * (of.sigma**2 + LEARNED.least**2)])
        sums = np.column_stack([np.diff(time)[:, None] * (rates[1:] + rates[:-1]) / 2, gap])
        sums = np.cumsum(np.vstack([np.zeros(5), sums]), axis=0)
        moved = np.diff(interpolate(chain.time, time, sums), axis=0)
        known = (chain.time[:-1] >= time[0] - LONGEST_GAP) & (chain.time[1:] <= time[-1] + LONGEST_GAP)
        known &= moved[:, 4] == 0
        begins = np.searchsorted(time, chain.time[chain.segment_first])
        frame = of.frame[np.minimum(begins, len(time) - 1)]
        place = np.where(known[:, None], moved[:, :2], np.nan)
        return replace(self, moved=place, sigma=np.sqrt(moved[:, 2:4] + INSTANT), frame=frame)

    def variables(self, poses: Array) -> Sequence[Variables]:
        """Angle of the frame [rad] in each calibration segment; the other two numbers are not used."""
        if self.angle is None:
            return ()
        rows = np.column_stack([self.angle, *np.zeros((2, len(self.angle)))])
        return (Variables(self.symbol, np.arange(len(rows)), rows, np.full(len(rows), np.inf)),)

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """Factors of the intervals, and of the frame's angle between segments."""
        if self.angle is None:
            return []
        k, chain, nodes = self._used, at.chain, at.state[self.symbol]
        s = chain.segment[k]
        gain = self.gain / at.state.c[s, :1]
        drift, by_drift = self._drift(at)
        sigma, heading = self.sigma[k], at.state.poses[:, 2]
        back = rotation(-(nodes[s, 0] + drift[k]))
        walked = np.einsum("nij,nj->ni", back, at.state.poses[k + 1, :2] - at.state.poses[k, :2])

        def jacobian() -> list[Array]:
            by_angle = -gain * walked @ QUARTER.T / sigma
            by_i, by_j, by_node, by_c = np.zeros((4, len(k), 2, 3))
            by_i[:, :, :2] = -back @ rotation(heading[k]) * (gain / sigma)[:, :, None]
            by_j[:, :, :2] = back @ rotation(heading[k + 1]) * (gain / sigma)[:, :, None]
            by_node[:, :, 0] = by_angle
            by_c[:] = by_angle[:, :, None] * by_drift[k][:, None]
            by_c[:, :, 0] -= gain / at.state.c[s, :1] * walked / sigma
            return [by_i, by_j, by_node, by_c]

        value = (gain * walked - self.moved[k]) / sigma
        variables = [("x", k), ("x", k + 1), (self.symbol, s), ("c", s)]
        loss, number = RobustLoss(np.zeros(len(k), dtype=bool)), chain.number[1:][k]
        block = FactorBlock.uniform(self.name, value, variables, jacobian, number, loss=loss)
        return [block, *self._of_nodes(at, nodes)]

    def _of_nodes(self, at: Evaluation, nodes: Array) -> Iterator[FactorBlock]:
        """Priors of the first angle in each frame, and factors between consecutive segments in it."""
        begins = np.append(True, self.frame[1:] != self.frame[:-1])
        first, later = np.flatnonzero(begins), np.flatnonzero(~begins)
        off, widths = nodes[first].copy(), np.tile([2 * np.pi, 1.0, 1.0], (len(first), 1))
        off[:, 0] = wrap_angle(off[:, 0] - np.asarray(self.angle)[first])
        yield FactorBlock.prior_of(f"{self.name}.begin", (self.symbol, first), off, widths, first)
        turned, by_c = self._drift(at, whole=True)
        sigma, last = np.array([WALKER.change[0], 1.0, 1.0]), later - 1
        change = nodes[later] - nodes[last]
        change[:, 0] = wrap_angle(change[:, 0] - turned[last])
        ahead = np.tile(np.diag(1 / sigma), (len(later), 1, 1))
        by_calibration = np.zeros_like(ahead)
        by_calibration[:, 0] = -by_c[last] / sigma[0]
        variables = [(self.symbol, last), (self.symbol, later), ("c", last)]
        yield FactorBlock.uniform(
            f"{self.name}.change", change / sigma, variables, lambda: [-ahead, ahead, by_calibration], later
        )

    def _drift(self, at: Evaluation, whole: bool = False) -> tuple[Array, Array]:
        """How far the frame has turned from its segment's start to the middle of each interval ``(k,)``, or over each
        whole segment ``(s,)`` [rad], and the derivative ``(…, 3)`` by c.
        """
        last, first, segment = at.pieces.last, at.chain.segment_first, at.chain.segment
        turn, time = at.pieces.to_end[:, last]
        by_c, increment = np.column_stack([np.zeros(len(turn)), turn, time]), at.increments.delta[last, 2] - turn
        each = np.column_stack([increment, by_c])
        total = np.cumsum(each, axis=0)
        before = total - each
        if whole:
            found = total[np.append(first[1:], len(total)) - 1] - before[first]
        else:
            found = before - before[first][segment] + each / 2
        return found[:, 0], found[:, 1:]

    @cached_property
    def _used(self) -> Index:
        """The intervals that have a factor."""
        return np.flatnonzero(np.isfinite(self.moved[:, 0]) & ~np.asarray(self.wrong))

    def _ratio(self, at: Evaluation) -> Complex:
        """Displacement by the network over that by dead reckoning ``(k,)``; NaN where nobody walks."""
        walked, lasting = np.diff(at.chain.track[0]), np.diff(at.chain.time)
        speed = np.abs(walked) / lasting
        on_foot = speed > np.median(speed[speed > SLOWEST]) / 2 if (speed > SLOWEST).any() else speed > SLOWEST
        return as_complex(np.where(on_foot[:, None], self.moved, np.nan)) / np.where(on_foot, walked, 1.0)

    def _apart(self, at: Evaluation) -> tuple[Array, complex]:
        """How far the ratio of each interval on foot ``(n,)`` is from the usual one, relative to that; and that one."""
        ratio = self._ratio(at)
        usual = _median(ratio) + INSTANT
        return np.abs(ratio[np.isfinite(ratio)] / usual - 1), usual

    def refined(self, at: Evaluation) -> Self:
        """The second pass uses the network, its frame as along the first optimum, unless it contradicts the steps."""
        if self.angle is not None or not len(self._used):
            return self
        k, drift = self._used, self._drift(at)[0]
        walked = as_complex(np.diff(at.state.poses[:, :2], axis=0))
        turned = (walked * as_complex(self.moved).conj() * np.exp(-1j * drift))[k]
        unit = turned / np.maximum(np.abs(turned), INSTANT)
        of_segment = np.zeros(len(self.frame), dtype=np.complex128)
        np.add.at(of_segment, at.chain.segment[k], unit)
        angle = np.angle(np.where(np.abs(of_segment) > 0, of_segment, unit.sum()))
        on_foot = np.isfinite(self._ratio(at)[k])
        straight = walked[k] * np.exp(-1j * (angle[at.chain.segment[k]] + drift[k]))
        scale = as_complex(self.moved)[k] * at.state.c[at.chain.segment[k], 0]
        gain = float(np.abs(_median(scale[on_foot] / straight[on_foot])))
        apart, usual = self._apart(at)
        usable = np.mean(apart < LEARNED.apart) > LEARNED.agree and abs(np.log(abs(usual))) < LEARNED.apart
        return replace(self, angle=angle, gain=gain, wrong=np.full(len(self.moved), not usable))

    def hypotheses(self, at: Evaluation, by_others: Callable[[], Evaluation] | None) -> Sequence[Proposal]:
        """The network, or the direction of the steps, is wrong along each stretch where they contradict each other."""
        if self.angle is None or not len(self._used):
            return ()
        stretches, found = self._stretches(at), list[Proposal]()
        for wrong in product((NETWORK, STEP_DIRECTION), repeat=len(stretches)) if stretches else ():
            which = list(zip(stretches, wrong, strict=True))
            by = ([stretch for stretch, of in which if of == name] for name in (NETWORK, STEP_DIRECTION))
            found.append(self._wrong_along(at, *by))
        return found

    def _stretches(self, at: Evaluation) -> list[tuple[int, int]]:
        """First and last interval of the longest stretches along which network and steps contradict each other."""
        known, (apart, _) = np.flatnonzero(np.isfinite(self._ratio(at))), self._apart(at)
        begins, ends = runs(apart > LEARNED.apart)
        spans = np.column_stack([known[begins], known[ends - 1]])[ends - begins > 1]
        longest = np.argsort(spans[:, 0] - spans[:, 1], kind="stable")[:MOST_DOUBTED]
        return [(a, b) for a, b in spans[np.sort(longest)].tolist()]

    def _turns(self, at: Evaluation, stretches: list[tuple[int, int]]) -> Index:
        """The intervals at the ends of stretches in which the steps' direction turns: about half of each is apart."""
        ratio, last, found = self._ratio(at), int(self._used[-1]), set[int]()
        for a, b in stretches:
            along, usual = _median(ratio[a : b + 1]), _median(ratio)
            share = np.nan_to_num(np.abs((ratio - usual) / (along - usual)))
            for end, beside in ((a, max(a - 1, 0)), (b, min(b + 1, last))):
                found |= {min((end, beside), key=lambda k: abs(share[k] - 0.5))} if end < last else set()
        return np.array(sorted(found), dtype=np.intp)

    def _wrong_along(self, at: Evaluation, network: list[tuple[int, int]], steps: list[tuple[int, int]]) -> Proposal:
        """The hypothesis that the network, and the direction of the steps, are wrong along these stretches.

        A wrong network says any velocity of a walker, or is turned by any angle along the stretch. The direction of the
        steps turns by any angle somewhere in the intervals at the ends of its stretches.
        """
        lasting, root = np.diff(at.chain.time)[:, None], at.chain.bridge.root.copy()
        price, wrong, last = LEARNED.wrong_steps * len(steps), np.zeros(len(root), dtype=bool), int(self._used[-1])
        for a, b in network:
            here = a + np.flatnonzero(np.isfinite(self.moved[a : b + 1, 0]))
            any_move = FIXES.walking_speed / np.sqrt(2) * lasting[here]
            wide = np.log(np.maximum(any_move / self.sigma[here], 1.0)) + (self.moved[here] / any_move) ** 2 / 2
            price += LEARNED.wrong + min(float(wide.sum()), LEARNED.turned * (1 + (b < last)))
            wrong[here] = True
        if len(turns := self._turns(at, steps)):
            move = at.chain.delta[turns, :2]
            swing = ANY_HEADING * np.column_stack([move @ QUARTER.T / 2, np.ones(len(turns))])
            place = np.sum(move**2, axis=1)[:, None, None] / 4 * np.diag([1.0, 1.0, 0.0])
            wide = np.linalg.inv(root[turns].transpose(0, 2, 1) @ root[turns]) + place
            wide = np.linalg.inv(wide + swing[:, :, None] * swing[:, None])
            wider = np.linalg.cholesky(wide).transpose(0, 2, 1)
            price += float(np.sum(np.linalg.slogdet(root[turns])[1] - np.linalg.slogdet(wider)[1]))
            root[turns] = wider
        time = at.chain.time
        names = [f"{NETWORK} {time[a]:.0f} to {time[b + 1]:.0f} s" for a, b in network]
        names += [f"{STEP_DIRECTION} {time[a]:.0f} to {time[b + 1]:.0f} s" for a, b in steps]
        claim = Hypothesis((self.name, STRETCHES), tuple(names), price=price)
        return Proposal(claim, (replace(self, wrong=wrong), *([StepFactor(root)] if steps else [])))

    def reports(self, at: Evaluation, which: Index | None = None) -> tuple[VelocityReport, ...]:
        """Speed, residual and weight of each interval with velocities."""
        if self.angle is None:
            return ()
        k, lasting = np.flatnonzero(np.isfinite(self.moved[:, 0])), np.diff(at.chain.time)
        all_used = replace(self, wrong=False).factors(at)[0]
        off = np.hypot(*(all_used.residual.reshape(-1, 2) * self.sigma[k]).T) / lasting[k]
        weight = np.where(np.isin(k, self._used), all_used.weight, 0.0)
        columns = (at.chain.time[k] + lasting[k] / 2, np.hypot(*self.moved[k].T) / lasting[k], off, weight)
        rows = zip(*(column.tolist() for column in columns), strict=True)
        return tuple(
            VelocityReport(t, v, off, used, f"{off:.2f} m/s from the walk" if used else UNUSED)
            for t, v, off, used in rows
        )


def _median(ratio: Complex) -> complex:
    """The median of complex numbers without NaN, by parts; 0 of none."""
    known = ratio[np.isfinite(ratio)]
    return complex(np.median(known.real), np.median(known.imag)) if len(known) else 0j


@wording_of(LearnedVelocityFactor.name)
def _wording(hypothesis: Hypothesis) -> Wording:
    """The network is wrong, or the direction of the steps."""
    wrong = ", ".join(f"the {instance}" for instance in hypothesis.instances)
    check = "how the phone was held then; the walkers and phones that the network was trained with"
    return Wording("network and steps", f"where both contradict each other, these are wrong: {wrong}", check)
