"""The receiver: the common error of its fixes, a slow offset and a lag behind the other sensors; and its course.

[gps-dr] leaves the *systematic* error of GPS open. Most of a phone's error stays the same from epoch to epoch (indoors
its correlation is 0.9 after a second, 0.5 after ten), so a minute of epochs has the information of a few fixes, not of
sixty. With g = (g_x, g_y, lag) of the source at its time [m, m, s], a fix of stated sigma σ is modelled as

    z = p − v lag − l behind + g + white noise of variance ω² σ₀² + n (σ² − σ₀²)

with ω = RECEIVERS.white, v the recent walking velocity. g is a Gauss–Markov process of sigma σ₀
about o, lag a slow random walk; both are linear between nodes. Receivers are late: the lag begins at RECEIVERS.lag,
which is its sigma too. o [m] is what stays the same throughout: a reflection
under a roof. Its sigma is RECEIVERS.throughout of the receiver's median σ₀. The process runs in units of `drift`, with
correlation length 1. σ₀ is the least sigma of the n fixes with the same error; the excess of worse fixes among them is
common to them as well.

Indoors receivers smooth their positions over minutes and follow a walk only in part: of three in a museum (IPIN 2023)
0.87, 0.53 and 0.79 of it. l is how far the walk is ahead of its own recent mean (`Chain.lead`), and
behind, a constant of the receiver, the share that it does not follow. Without it strides shrink. v and l are in the
axes of the estimate before: along the heading of the pose, a lag of 20 s would let each heading explain each fix.

Some receivers do not follow their walk at all: one of the ten museum logs states 8 m, is 26 m off throughout, and its
course is not that of the walk. Where there is no other source nothing tells, so that it is a hypothesis, with all that
it implies together: o of RECEIVERS.astray, behind up to 1, and courses that say nothing.

The course of a receiver, which Doppler measures without the error of the position, is where the walk leads:

    r = wrap(θ + arg u(t − lag) − course) / σ

u is the velocity of the steps in the two seconds before t − lag, between means of a second, in the axes of a keyframe
shortly before, whose heading is θ. Each turn shows the lag. "Velocity first, position second" is how challenges of
phones were won (Google Smartphone Decimeter Challenge, 2021 to 2023); here the steps have the shape of the walk, and
the course keeps its direction. Its error is that of the receiver's own filter, which has the positions too: the
velocity's sigma is a share of theirs, whatever is stated, and lasts for some seconds. A rough course is not used:
indoors, where receivers follow a walk in part, it is wrong throughout. The speed is not compared with the strides: 0.94
of theirs on a campus (NJU) and 0.1 to 0.8 in a museum (IPIN 2023), it would shrink them.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from pdr_graph.estimation.ambiguity.hypothesis import Hypothesis, Proposal, Wording, wording_of
from pdr_graph.estimation.factors.base import (
    PLANE,
    AnyArray,
    Doubted,
    FactorBlock,
    Refined,
    Remembered,
    RobustLoss,
    Variables,
)
from pdr_graph.estimation.factors.fixes import FixFactor, alike, by_source, drift
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.geometry import as_points, pose_rotation, rotation, wrap_angle
from pdr_graph.priors import FIXES, MOTION, PRICES, RECEIVERS
from pdr_graph.types import FINEST, INSTANT, Array, Complex, Fixes, Index, Steps

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.chain import Chain, Evaluation

SOURCE_NODES, NODES_PER_SOURCE = 2**20, 2**34  # ranges of node numbers: those of a source do not depend on others
QUARTER = rotation(np.pi / 2)
COURSE = "gnss_course"
SECOND = 1.0  # [s]
NODE_EVERY = 5.0  # [s] between nodes of the offset
LEAST_SPEED = 0.3  # [m/s] of the steps, below which a course says nothing
BEFORE = 2 * SECOND + 2 * RECEIVERS.lag  # [s] from the keyframe to the fix: longer than any lag


@dataclass(frozen=True, eq=False)
class GnssBias(Refined, Remembered, Doubted):
    """Offset and lag of each receiver along the walk; none before the second pass.

    fixes, steps: of the walk; velocity: ``(k + 1, 2)`` of the walk at its keyframes [m/s];
    lead: ``(k + 1, 2)`` l there [m].
    fix: ``(f,)`` indices of the biased fixes; white: ``(f,)`` sigmas of their independent errors [m]; node: ``(f,)``
    row of the node before each; share: ``(f,)`` position between this node and the next, 0 to 1.
    node_number: ``(m,)``; sigma: ``(m,)`` σ₀ there [m]; keep: ``(m,)`` correlation with the node before, 0 for the
    first of a source; elapsed: ``(m,)`` time since the node before [s].
    receiver: ``(m,)`` of each node; receiver_number: ``(r,)``; usual: ``(r,)`` median σ₀ [m].
    larger: factor by which all sigmas are larger than of the fixes; courses: of the receivers, unused if these are
    assumed not to follow the walk.
    """

    fixes: FixFactor
    steps: Steps
    velocity: Array
    lead: Array
    fix: Index
    white: Array
    node: Index
    share: Array
    node_number: Index
    sigma: Array
    keep: Array
    elapsed: Array
    receiver: Index
    receiver_number: Index
    usual: Array
    courses: Courses
    larger: float = 1.0
    not_following: bool = False

    name: ClassVar[str] = "gnss_bias"
    symbol: ClassVar[str] = "g"
    symbol_throughout: ClassVar[str] = "o"

    @classmethod
    def of(cls, fixes: FixFactor, steps: Steps, prior: Prior | None = None, number: Index | None = None) -> GnssBias:
        """The biases of the receivers whose fixes are marked as biased; made from the kind of the fixes."""
        sources = by_source(fixes.fixes, fixes.biased)
        offset, white = fixes.sigma.copy(), fixes.sigma.copy()  # of the common and of the independent errors
        for rows in sources:
            first, after = alike(drift(steps, fixes.fixes.time[rows]))
            offset[rows] = [fixes.sigma[rows[a:b]].min() for a, b in zip(first, after, strict=True)]
            beyond = fixes.sigma[rows] ** 2 - offset[rows] ** 2
            white[rows] = np.sqrt(RECEIVERS.white**2 * offset[rows] ** 2 + (after - first) * beyond)
        parts = [_nodes(fixes.fixes.time[rows], offset[rows], steps, fixes.fixes.source[rows[0]]) for rows in sources]
        indices, none = np.empty(0, np.intp), np.empty(0)
        parts = parts or [(indices, none, indices, none, none, none)]
        node, share, numbers, sigma, keep, elapsed = ([*column] for column in zip(*parts, strict=True))
        first = np.cumsum([0] + [len(n) for n in numbers[:-1]])
        joined = np.concatenate([indices, *sources])
        return cls(
            fixes=fixes,
            steps=steps,
            velocity=np.empty((0, 2)),
            lead=np.empty((0, 2)),
            fix=joined,
            white=white[joined],
            node=np.concatenate([n + f for n, f in zip(node, first, strict=True)]),
            share=np.concatenate(share),
            node_number=np.concatenate(numbers),
            sigma=np.concatenate(sigma),
            keep=np.concatenate(keep),
            elapsed=np.concatenate(elapsed),
            receiver=np.repeat(np.arange(len(numbers)), [len(n) for n in numbers]),
            receiver_number=np.array([_number(fixes.fixes.source[rows[0]]) for rows in sources], dtype=np.intp),
            usual=np.array([np.median(offset[rows]) for rows in sources]),
            courses=Courses.of(fixes.fixes, fixes.sigma, sources),
        )

    def refined(self, at: Evaluation) -> GnssBias:
        """Model the common errors of the fixes that the second pass marks as biased."""
        fixes = self.fixes.refined(at)
        if fixes is self.fixes and len(self.lead):
            return self
        return self.of(fixes, self.steps).continued(self.decisions())

    def hypotheses(self, at: Evaluation, by_others: Callable[[], Evaluation] | None) -> Sequence[Proposal]:
        """No receiver follows the walk, or all their errors are larger than they state.

        The latter only if the fixes lie accordingly about the walk and the offset.
        """
        if not len(self.fix):
            return ()
        names, found = tuple(dict.fromkeys(self.fixes.fixes.source[n] for n in self.fix.tolist())), list[Proposal]()
        if not self.not_following:
            lost = self._without_following()
            wider = np.log(lost._of_throughout / self._of_throughout)  # normaliser of the wider prior
            price = PRICES.astray + float(np.sum(wider)) + self.courses.surprise * bool(at.blocks_of(COURSE))
            hypothesis = Hypothesis((self.name, "not following"), names, (RECEIVERS.astray,), price)
            found.append(Proposal(hypothesis, (lost,), anew=bool(at.blocks_of(COURSE))))
        [block] = [block for block in at.blocks_of(FixFactor.name) if block.variables[-1][0] == self.symbol_throughout]
        if np.sqrt(np.mean(block.residual**2)) < RECEIVERS.scattered:
            return found
        for factor, price in PRICES.larger:
            normalisers = 2 * float(np.log(factor)) * (len(block) + len(self.sigma) + len(self.usual))
            outlier = self.fixes.outlier & (self.fixes.distance(at) > FIXES.outlier * factor * self.fixes.sigma)
            fixes = self.fixes.classified(outlier, self.fixes.held)
            errors = Hypothesis((self.name, "larger"), names, (factor,), price + normalisers)
            found.append(Proposal(errors, (replace(self._times(factor), fixes=fixes), fixes)))
        return found

    def offsets(self, at: Evaluation) -> Sequence[tuple[str, str, int]]:
        """Name of each receiver, and the symbol and the row of what is the same throughout."""
        names = {int(self.receiver[n]): self.fixes.fixes.source[f] for n, f in zip(self.node, self.fix, strict=True)}
        return [(name, self.symbol_throughout, row) for row, name in sorted(names.items())]

    def _without_following(self) -> Self:
        """The receivers do not follow the walk."""
        return replace(self, courses=self.courses.unused(), not_following=True)

    def _times(self, factor: float) -> Self:
        """Multiply the sigmas of all errors."""
        changes = {name: factor * getattr(self, name) for name in ("white", "sigma", "usual", "larger")}
        return replace(self, **changes)

    def decisions(self) -> dict[str, AnyArray]:
        """Whether receivers do not follow the walk, and the factor of their sigmas."""
        if self.larger == 1.0 and not self.not_following:
            return {}
        return {"larger": np.array([self.larger]), "not_following": np.array([self.not_following])}

    def continued(self, decisions: Mapping[str, AnyArray]) -> Self:
        """Apply an earlier decision about the errors of receivers."""
        if not decisions:
            return self
        larger = self._times(float(decisions["larger"][0]))
        return larger._without_following() if decisions["not_following"][0] else larger

    def bind(self, chain: Chain) -> Self:
        """Bind every fix to its keyframe, and compute the velocity there."""
        if not len(self.fix):
            return replace(self, fixes=self.fixes.bind(chain))
        lead = np.zeros(len(chain.time), dtype=complex) if chain.heading is None else chain.lead
        fixes, courses = self.fixes.bind(chain), self.courses.bind(chain)
        return replace(self, fixes=fixes, velocity=as_points(chain.velocity), lead=as_points(lead), courses=courses)

    def variables(self, poses: Array) -> Sequence[Variables]:
        """A node (g_x, g_y [-], lag [s]) every few seconds in which there are fixes; o [-] of each receiver."""
        if not len(self.node_number):
            return ()
        needed = np.full(len(self.node_number), -np.inf)
        for rows in (self.node, self.node + 1):
            np.maximum.at(needed, rows, self.fixes.fixes.time[self.fix])
        last = np.full(len(self.receiver_number), np.inf)
        return (
            Variables(self.symbol, self.node_number, np.tile(expected(), (len(self.node_number), 1)), needed),
            Variables(self.symbol_throughout, self.receiver_number, np.zeros((len(self.receiver_number), 3)), last),
        )

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """Factors of the fixes, the prior of each source's first node, and the process from node to node."""
        return [self._fixes(at), *self._of_courses(at), *self._process(at)] if len(self.fix) else ()

    def _fixes(self, at: Evaluation) -> FactorBlock:
        reached = np.flatnonzero(self.fixes.keyframe[self.fix] >= 0)
        fix, node, share = self.fix[reached], self.node[reached], self.share[reached, None]
        white = self.white[reached]
        g, keyframe = at.state[self.symbol], self.fixes.keyframe[fix]
        receiver = self.receiver[node]
        behind = at.state[self.symbol_throughout][receiver, 2:]
        pose, now = at.state.poses[keyframe], (1 - share) * g[node] + share * g[node + 1]
        R = pose_rotation(pose[:, 2])[:, :2, :2]
        ahead, lead = self.velocity[keyframe], self.lead[keyframe]
        shifted = pose[:, :2] - ahead * now[:, 2:] - lead * behind + now[:, :2]
        value = (shifted - self.fixes.fixes.position[fix]) / white[:, None]

        def jacobian() -> list[Array]:
            by_pose, by_now = np.zeros((len(pose), 2, 3)), np.zeros((len(pose), 2, 3))
            by_pose[:, :, :2] = R / white[:, None, None]
            by_throughout = np.zeros((len(pose), 2, 3))
            by_throughout[:, :, 2] = -lead / white[:, None]
            by_now[:, [0, 1], [0, 1]] = 1 / white[:, None]
            by_now[:, :, 2] = -ahead / white[:, None]
            return [by_pose, (1 - share[:, :, None]) * by_now, share[:, :, None] * by_now, by_throughout]

        nodes = ((self.symbol, node), (self.symbol, node + 1))
        variables = (("x", keyframe), *nodes, (self.symbol_throughout, receiver))
        loss = RobustLoss(self.fixes.outlier[fix])
        return FactorBlock.uniform(FixFactor.name, value, variables, jacobian, self.fixes.number[fix], loss=loss)

    def _of_courses(self, at: Evaluation) -> list[FactorBlock]:
        reached = self.fixes.keyframe[self.fix[self.courses.row]] >= 0
        which = np.flatnonzero(reached & (self.courses.keyframe >= 0))
        if not len(which):
            return []
        rows = self.courses.row[which]
        node, share, lag = self.node[rows], self.share[rows], at.state[self.symbol][:, 2]
        lags = ((self.symbol, node), (self.symbol, node + 1))
        number, late = self.fixes.number[self.fix[rows]], (1 - share) * lag[node] + share * lag[node + 1]
        return [self.courses.block(at, which, number, late, lags, share)]

    def _process(self, at: Evaluation) -> list[FactorBlock]:
        """Factors of g, which varies about o, and of o."""
        g, o = at.state[self.symbol], at.state[self.symbol_throughout]
        first, later, sigma, share, scale = self._nodes_by_order
        about = g - o[self.receiver] * PLANE - expected()
        begin = FactorBlock.uniform(
            f"{self.name}.begin",
            about[first] / sigma[first],
            [(self.symbol, first), (self.symbol_throughout, self.receiver[first])],
            lambda: [np.eye(3) / sigma[first, :, None], -np.diag(PLANE) / sigma[first, :, None]],
            self.node_number[first],
            prior=True,
        )
        follow = FactorBlock.uniform(
            f"{self.name}.change",
            (about[later] - share * about[later - 1]) * scale,
            [(self.symbol, later), (self.symbol, later - 1), (self.symbol_throughout, self.receiver[later])],
            lambda: [np.eye(3) * by[:, :, None] for by in (scale, -share * scale, (share - 1) * PLANE * scale)],
            self.node_number[later],
            prior=True,
        )
        receivers = self.symbol_throughout, np.arange(len(o))
        same = FactorBlock.prior_of(f"{self.name}.throughout", receivers, o, self._of_throughout, self.receiver_number)
        return [begin, follow, same]

    @cached_property
    def _nodes_by_order(self) -> tuple[Index, Index, Array, Array, Array]:
        """Of the process: first and later nodes, sigmas ``(m, 3)``; of the later, share kept and scale ``(n, 3)``."""
        first, later = np.flatnonzero(self.keep == 0), np.flatnonzero(self.keep)
        sigma = np.stack([self.sigma, self.sigma, np.full(len(self.sigma), RECEIVERS.lag)], axis=1)
        share = self.keep[later, None] * self.sigma[later, None] / self.sigma[later - 1, None] * [1, 1, 0] + [0, 0, 1]
        change = self.sigma[later] * np.sqrt(1 - self.keep[later] ** 2)
        scale = 1 / np.stack([change, change, RECEIVERS.lag_change * np.sqrt(self.elapsed[later])], axis=1)
        return first, later, sigma, share, scale

    @cached_property
    def _of_throughout(self) -> Array:
        """Sigmas ``(r, 3)`` of o [m, m] and behind: what is not followed is at most off by what a receiver states."""
        lead = np.sum(self.lead[self.fixes.keyframe[self.fix]] ** 2, axis=1) / 2
        receiver, count = self.receiver[self.node], len(self.usual)
        mean = np.bincount(receiver, lead, count) / np.maximum(np.bincount(receiver, minlength=count), 1)
        factor, most = (RECEIVERS.astray, 1.0) if self.not_following else (RECEIVERS.throughout, RECEIVERS.behind)
        behind = np.minimum(most, self.usual / np.sqrt(np.maximum(mean, INSTANT)))
        return np.stack([factor * self.usual, factor * self.usual, behind], axis=1)


@dataclass(frozen=True, eq=False)
class Courses:
    """Courses of fixes ``v``.

    row: ``(v,)`` of each among the fixes with a common error; time: ``(v,)`` [s]; course, sigma: ``(v,)`` [rad];
    alike: ``(v,)`` number of courses with the error of each, among which its information is shared.
    keyframe: ``(v,)`` that has θ, −1 before the chain; moment, track: ``(m + 1,)`` of the steps by themselves [s, m];
    turned: ``(k + 1,)`` heading of this track at the keyframes [rad]; wrong: they are assumed to be.
    """

    row: Index
    time: Array
    course: Array
    sigma: Array
    alike: Array
    keyframe: Index
    moment: Array
    track: Complex
    turned: Array
    wrong: bool = False

    @classmethod
    def of(cls, fixes: Fixes, sigma: Array, receivers: Sequence[Index]) -> Self:
        """The courses of each receiver's fixes. sigma: ``(f,)`` of all positions, per axis [m]."""
        rows, half = np.concatenate([np.empty(0, np.intp), *receivers]), RECEIVERS.velocity_time / 2
        used = fixes[rows]
        alone = np.fmax(used.course_sigma, RECEIVERS.velocity * sigma[rows] / np.maximum(used.speed, FINEST))
        times = [fixes.time[group] for group in receivers]
        count = [np.searchsorted(time, time + half) - np.searchsorted(time, time - half) for time in times]
        alike = np.concatenate([np.empty(0), *count])
        known, none = np.flatnonzero((alone < RECEIVERS.roughest) & np.isfinite(used.course)), np.empty(0)
        used, alike = used[known], np.maximum(alike[known], 1)
        unbound = np.full(len(known), -1)
        track = np.empty(0, dtype=np.complex128)
        return cls(known, used.time, used.course, alone[known] * np.sqrt(alike), alike, unbound, none, track, none)

    def unused(self) -> Self:
        """The same, without a factor."""
        return replace(self, keyframe=np.full(len(self.row), -1), wrong=True)

    @property
    def surprise(self) -> float:
        """Negative log likelihood of courses in any direction, beside that of courses of the walk. [nats]"""
        alone = self.sigma / np.sqrt(self.alike)
        return float(np.sum(np.log(np.maximum(np.sqrt(2 * np.pi) / alone, 1.0)) / self.alike))

    def bind(self, chain: Chain) -> Self:
        """Find the keyframe before each, and reckon the steps of the chain."""
        pieces, intervals = chain.pieces, len(chain.segment)
        if not len(self.row) or not intervals or self.wrong:
            return replace(self, keyframe=np.full(len(self.row), -1))
        keyframe = np.searchsorted(chain.time, self.time - BEFORE + INSTANT, side="right") - 1
        heading = np.append(0.0, np.cumsum(pieces.to_end[0, pieces.last]))
        moves = pieces.length * np.exp(1j * (heading[pieces.interval] + pieces.to_middle[0]))
        return replace(
            self,
            keyframe=np.maximum(keyframe, 0) if chain.begins else keyframe,
            moment=np.append(chain.time[0], chain.time[pieces.interval] + pieces.to_end[1]),
            track=np.append(0.0, np.cumsum(moves)),
            turned=heading,
        )

    def block(
        self, at: Evaluation, which: Index, number: Index, lag: Array, lags: Sequence[tuple[str, Index]], share: Array
    ) -> FactorBlock:
        """Factors of the courses ``which (w,)``, of fixes with permanent numbers ``(w,)``.

        lag: of each ``(w,)`` [s]; lags: the two variables between which it lies, share: how far ``(w,)``.
        """
        keyframe, moment = self.keyframe[which], self.time[which] - lag
        way = self._place(moment) - self._place(moment - SECOND)
        moving = np.abs(way) > LEAST_SPEED * SECOND
        root = np.where(moving, 1 / self.sigma[which], 0.0)
        off = np.angle(way) - self.turned[keyframe] + at.state.poses[keyframe, 2] - self.course[which]

        def jacobian() -> list[Array]:
            by_pose, by_lag = np.zeros((2, len(which), 1, 3))
            faster = self._speed(moment) - self._speed(moment - SECOND)
            by_pose[:, 0, 2] = root
            by_lag[:, 0, 2] = -root * (faster / np.where(moving, way, 1.0)).imag
            return [by_pose, (1 - share[:, None, None]) * by_lag, share[:, None, None] * by_lag]

        value, variables = (wrap_angle(off) * root)[:, None], (("x", keyframe), *lags)
        loss = RobustLoss(np.zeros(len(which), dtype=bool))
        return FactorBlock.uniform(COURSE, value, variables, jacobian, number, loss=loss)

    def _place(self, time: Array) -> Complex:
        """Mean place ``(n,)`` of the steps in the second before each time, so that the lag moves it smoothly. [m]"""
        return self._area(time) - self._area(time - SECOND)

    def _speed(self, time: Array) -> Complex:
        """Derivative ``(n,)`` of `_place`. [m/s]"""
        return self._at(time) - self._at(time - SECOND)

    def _at(self, time: Array) -> Complex:
        return np.interp(time, self.moment, self.track)

    def _area(self, time: Array) -> Complex:
        """Integral ``(n,)`` of the track from its start to each time. [m s]"""
        before = np.clip(np.searchsorted(self.moment, time) - 1, 0, len(self.moment) - 1)
        since = (time - self.moment[before]) * (self.track[before] + self._at(time)) / 2
        return self._areas[before] + since

    @cached_property
    def _areas(self) -> Complex:
        """That integral ``(m + 1,)`` at each moment. [m s]"""
        return np.append(0.0, np.cumsum(np.diff(self.moment) * (self.track[1:] + self.track[:-1]) / 2))


@wording_of(GnssBias.name)
def _wording(hypothesis: Hypothesis) -> Wording:
    """Receivers do not follow the walk, or all their errors are larger than they state."""
    names, (factor,) = " and ".join(str(name) for name in hypothesis.instances), hypothesis.parameter
    check = "its sigmas, as stated; leave it out, or give a position that is known"
    if hypothesis.kind[1] == "larger":
        return Wording(names, f"the errors of {names} are about {factor:.0f} times what it states", check)
    text = f"the positions of {names} do not follow the walk, and are off by about {factor:.1f} times their sigma"
    return Wording(names, text, check)


def expected() -> Array:
    """Prior mean ``(3,)`` of g [m, m, s]: receivers are late."""
    return np.array([0.0, 0.0, RECEIVERS.lag])


def _number(source: str) -> int:
    """The number of a receiver, so that it does not depend on the others."""
    return zlib.crc32(source.encode()) % SOURCE_NODES


def _nodes(time: Array, sigma: Array, steps: Steps, source: str) -> tuple[Index, Array, Index, Array, Array, Array]:
    """Nodes around a source's fixes at ``time (f,)``, at multiples of their interval, whatever the window.

    sigma: ``(f,)`` of their common error. Returns per fix the row of the node before and the share to the next; per
    node its number, sigma, correlation with the node before, and the time since.
    """
    before = np.floor(time / NODE_EVERY).astype(np.intp)
    grid = np.unique([before, before + 1]).astype(np.intp)
    at = (NODE_EVERY * grid).astype(np.float64)
    node = np.searchsorted(grid, before)
    beyond = np.maximum(at - steps.end, 0.0) * MOTION.gap_speed / RECEIVERS.along
    kept = np.exp(-np.diff(drift(steps, at) + beyond, prepend=0.0))
    keep = np.where(np.arange(len(at)) > 0, kept, 0.0)
    elapsed = np.diff(at, prepend=at[0]).astype(np.float64)
    number = _number(source) * NODES_PER_SOURCE + NODES_PER_SOURCE // 2 + grid
    return node, (time - at[node]) / NODE_EVERY, number, np.interp(at, time, sigma), keep, elapsed
