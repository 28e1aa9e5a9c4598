"""Bluetooth beacons: received levels as coarse ranges, and doubts about the list of their places.

Log-distance path loss (Rappaport, *Wireless Communications*, Sec. 4.9): a beacon m at height HEIGHT above the phone and
d metres aside is received with

    rssi = P + a_m − 10 n log₁₀ √(d² + HEIGHT²) + k cos φ,      φ its bearing relative to the walker's heading

on average over a stretch of the walk; the last term is shadowing by the walker's body. Variables: q = (P, n, k) of
phone and building, b_m = (x, y, a_m) of each beacon, surveyed to a metre or unknown. Fading depends on the place and
stays the same where nobody moves, so levels are averaged over metres walked, not over seconds.

Shadowing is correlated along the walk: level_sigma is that of independent levels with the same information.

A beacon of the list that is *not* received on a stretch on which others are is evidence too: with e the level expected
of it and ε a bound for whatever else made it silent,

    P(silent) = ε + (1 − ε) Φ((weakest − e) / within),      to the power (within / level_sigma)², as it is correlated.

A beacon that is not at its listed position, moved or swapped with another, is detected by comparing its levels and
silences with those expected at every possible place. A beacon that is never received may be off.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from scipy.special import ndtr

from pdr_graph.estimation.ambiguity.hypothesis import Hypothesis, Proposal, Wording, wording_of
from pdr_graph.estimation.factors.base import (
    PLANE,
    AnyArray,
    Doubted,
    FactorBlock,
    Locating,
    Remembered,
    RobustLoss,
    Variables,
)
from pdr_graph.estimation.factors.chain import DECIMALS
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.priors import BEACONS, PRICES
from pdr_graph.types import (
    KEYFRAME,
    TABLE,
    Array,
    BeaconReport,
    Beacons,
    Fixes,
    Index,
    Levels,
    Sightings,
    Steps,
    minor_number,
)

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.chain import Chain, Evaluation

STRONGEST, MOST_BEACONS = 50, 300  # beacons of a stretch, and of a walk or a window, that are used: more only cost time
MOST_SILENT = 8  # beacons about the strongest one of a stretch of which silence counts: each costs as much as a level


@dataclass(frozen=True, eq=False)
class BeaconRssiFactor(Locating, Remembered, Doubted):
    """Mean levels of ``m`` beacons on stretches of the walk, ``l`` of them.

    listed: the levels, with the listed positions; position: ``(m, 2)`` as used, NaN where unknown [m]; prior:
    ``(m, 3)`` mean of each beacon's variable, the place of its strongest level where unknown.
    beacon_number: ``(m,)``, number: ``(l,)``: permanent numbers; keyframe: ``(l,)``.
    origin: ``(2,)`` by which a displaced list was moved [m], None for others.
    """

    listed: Levels
    position: Array = field(metadata=TABLE)
    prior: Array = field(metadata=TABLE)
    beacon_number: Index = field(metadata=TABLE)
    number: Index
    keyframe: Index = field(metadata=KEYFRAME)
    origin: Array | None = field(default=None, metadata=TABLE)

    name: ClassVar[str] = "beacons"
    determines_position: ClassVar[bool] = True

    @classmethod
    def of(cls, levels: Levels, steps: Steps, prior: Prior, number: Index | None = None) -> BeaconRssiFactor:
        """The levels of one walk; of many beacons, those received most often, and the nearest others."""
        received = np.bincount(levels.beacon, minlength=len(levels.position))
        beacons = np.argsort(-received, kind="stable")[: min(MOST_BEACONS, np.count_nonzero(received))]
        silent = np.flatnonzero((received == 0) & np.isfinite(levels.position[:, 0]))
        place = levels.position[beacons]
        middle = place[np.isfinite(place[:, 0])].mean(axis=0) if len(silent) > STRONGEST else 0.0
        nearest = np.argsort(np.hypot(*(levels.position[silent] - middle).T), kind="stable")
        others = silent[nearest[: min(STRONGEST, MOST_BEACONS - len(beacons))]]
        beacons = np.sort(np.append(beacons, others))
        rows = np.flatnonzero(np.isin(levels.beacon, beacons))
        some = Levels(
            time=levels.time[rows],
            beacon=np.searchsorted(beacons, levels.beacon[rows]),
            rssi=levels.rssi[rows],
            label=tuple(levels.label[m] for m in beacons.tolist()),
            position=levels.position[beacons],
            sigma=levels.sigma[beacons],
        )
        mean = np.column_stack([some.position, np.zeros(len(beacons))])
        number = rows if number is None else number[rows]
        return cls(some, some.position, mean, beacons, number, np.full(len(rows), -1))

    def keyframe_times(self) -> Array:
        """The middles of the stretches."""
        return self.listed.time

    def bind(self, chain: Chain) -> Self:
        """Bind every level to its keyframe."""
        return replace(self, keyframe=chain.keyframe(self.listed.time))

    def decisions(self) -> dict[str, AnyArray]:
        """Positions and priors of the beacons."""
        return {"beacon": self._identity, "position": self.position, "prior": self.prior}

    def continued(self, decisions: Mapping[str, AnyArray]) -> Self:
        """Apply earlier decisions: positions and priors of beacons. A received beacon is not off."""
        if not decisions:
            return self
        same, rows = np.nonzero(decisions["beacon"][:, None] == self._identity)
        position, prior = self.position.copy(), self.prior.copy()
        position[rows], prior[rows] = decisions["position"][same], decisions["prior"][same]
        prior[self.listed.beacon, 2] = 0.0
        return replace(self, position=position, prior=prior)

    @property
    def _identity(self) -> Index:
        """A number ``(m,)`` for the label of each beacon, the same in every table."""
        return np.array([zlib.crc32(label.encode()) for label in self.listed.label], dtype=np.intp)

    def initialized(self, poses: Array) -> Self:
        """Initialise beacons of unknown position at the pose where they were strongest."""
        prior = np.column_stack([self.position, self.prior[:, 2]])
        for m in np.flatnonzero(np.isnan(self.position[:, 0])):
            rows = np.flatnonzero(self.listed.beacon == m)
            prior[m, :2] = poses[self.keyframe[rows[np.argmax(self.listed.rssi[rows])]], :2]
        return replace(self, prior=prior)

    def variables(self, poses: Array) -> Sequence[Variables]:
        """Place and power (x, y [m], a [dB]) of each beacon; the path loss (P [dBm], n, k [dB]) of all."""
        needed = np.full(len(self.prior), np.inf)
        beacons, single = Variables("b", self.beacon_number, self.prior, needed), np.zeros(1, dtype=np.intp)
        displacement = () if self.origin is None else (Variables("d", single, np.zeros((1, 3)), needed[:1]),)
        return beacons, Variables("q", single, np.array([BEACONS.path_loss]), np.full(1, np.inf)), *displacement

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """Factors of the levels and of silences, and priors of beacons and path loss."""
        return [self._levels(at), *([self._silences(at)] if len(self._silent[0]) else []), *self._priors(at)]

    def _levels(self, at: Evaluation) -> FactorBlock:
        which = np.flatnonzero(self.keyframe >= 0)
        keyframe, m = self.keyframe[which], self.listed.beacon[which]
        loss = PathLoss(at.state.poses[keyframe], at.state["b"][m], at.state["q"][0])

        def jacobian() -> list[Array]:
            return [by[:, None] / BEACONS.level_sigma for by in loss.derivatives()]

        def curvature() -> Array:
            """Of 10 n log₁₀ d, across and along the direction to the beacon, where it adds to the cost."""
            pull = -10 * loss.q[1] / np.log(10) / BEACONS.level_sigma * value[:, 0]
            bend = pull / loss.square, pull * (2 * BEACONS.height**2 / loss.square - 1) / loss.square
            towards = loss.towards / np.maximum(np.hypot(*loss.towards.T), 1e-9)[:, None]
            across = towards[:, ::-1] * [-1, 1]
            ways = zip(bend, (across, towards), strict=True)
            parts = [np.sqrt(np.maximum(0.0, size))[:, None] * way for size, way in ways]
            by_pose = -np.stack(parts, axis=1)  # (l, 2, 2) in the axes of the pose
            by_beacon = -by_pose @ loss.axes
            nothing = np.zeros((len(which), 2, 1))
            return np.concatenate([by_pose, nothing, by_beacon, nothing, *[nothing] * 3], axis=2)

        value = (loss.level - self.listed.rssi[which])[:, None] / BEACONS.level_sigma
        variables = [("x", keyframe), ("b", m), ("q", np.zeros(len(which), dtype=np.intp))]
        more = {"loss": RobustLoss(np.zeros(len(which), dtype=bool)), "curvature": curvature}
        return FactorBlock.uniform(self.name, value, variables, jacobian, self.number[which], **more)

    @cached_property
    def _silent(self) -> tuple[Index, Index, Index]:
        """Keyframe, beacon and permanent number ``(n,)`` of each silence: at this keyframe, others are received.

        Only the beacons nearest to the strongest beacon are counted.
        """
        levels, place = np.flatnonzero(self.keyframe >= 0), self.prior[:, :2]
        levels = levels[np.lexsort((-self.listed.rssi[levels], self.keyframe[levels]))]
        keyframe, first, of = np.unique(self.keyframe[levels], return_index=True, return_inverse=True)
        strongest, row = np.unique(self.listed.beacon[levels[first]], return_inverse=True)
        gap = place[strongest, None] - place
        nearest = np.argsort(np.hypot(*gap.transpose(2, 0, 1)), axis=1, kind="stable")[:, :MOST_SILENT]
        near = np.zeros(gap.shape[:2], dtype=bool)
        np.put_along_axis(near, nearest, True, axis=1)
        silent = near[row]
        silent[of, self.listed.beacon[levels]] = False
        stretch, beacon = np.nonzero(silent)
        number = np.minimum.reduceat(self.number[levels], first) if len(first) else first
        return keyframe[stretch], beacon, number[stretch] << 32 | self.beacon_number[beacon]

    def _silences(self, at: Evaluation) -> FactorBlock:
        keyframe, m, number = self._silent
        loss = PathLoss(at.state.poses[keyframe], at.state["b"][m], at.state["q"][0] * WITHOUT_BODY)
        cost, slope = silence(loss.level)
        value = np.sqrt(2 * cost + LEAST_SILENCE)

        def jacobian() -> list[Array]:
            by_pose, by_beacon, by_loss = loss.derivatives()
            return [((slope / value)[:, None] * by)[:, None] for by in (by_pose, by_beacon, by_loss * WITHOUT_BODY)]

        variables = [("x", keyframe), ("b", m), ("q", np.zeros(len(m), dtype=np.intp))]
        return FactorBlock.uniform(f"{self.name}.silence", value[:, None], variables, jacobian, number)

    def _priors(self, at: Evaluation) -> list[FactorBlock]:
        b, q = at.state["b"], at.state["q"]
        place = np.where(np.isnan(self.position[:, 0]), BEACONS.anywhere, self.listed.sigma)
        root = 1 / np.stack([place, place, np.full(len(b), BEACONS.power_sigma)], axis=1)
        beacons, single = np.arange(len(b)), np.zeros(1, dtype=np.intp)
        displacement, moved = np.zeros(3), list[FactorBlock]()
        if self.origin is not None:  # the prior of how far the whole list is displaced
            displacement, sigma = at.state["d"][0] * PLANE, np.array([[BEACONS.anywhere, BEACONS.anywhere, 1.0]])
            off = at.state["d"] + np.append(self.origin, 0.0)
            moved = [FactorBlock.prior_of(f"{self.name}.displacement", ("d", single), off, sigma, single)]
        of_loss = f"{self.name}.path_loss", ("q", single), q - BEACONS.path_loss
        return [
            *moved,
            FactorBlock.uniform(
                f"{self.name}.place",
                (b - displacement - self.prior) * root,
                [("b", beacons), *(("d", 0 * beacons) for _ in moved)],
                lambda: [np.eye(3) * root[:, :, None], *(-np.diag(PLANE) * root[:, :, None] for _ in moved)],
                self.beacon_number,
                prior=True,
            ),
            FactorBlock.prior_of(*of_loss, np.array([BEACONS.path_loss_sigma]), single),
        ]

    def rough_fixes(self) -> Fixes:
        """A rough fix at the strongest surveyed beacon in every BIN seconds."""
        levels = self.listed
        surveyed = np.flatnonzero(np.isfinite(levels.position[levels.beacon, 0]))
        order = surveyed[np.argsort(-levels.rssi[surveyed], kind="stable")]
        chosen = order[np.unique(levels.time[order] // 15.0, return_index=True)[1]]
        distance = 10 ** ((BEACONS.path_loss[0] - levels.rssi[chosen]) / (10 * BEACONS.path_loss[1]))
        near = np.maximum(BEACONS.nearest, distance)
        return Fixes(levels.time[chosen], levels.position[levels.beacon[chosen]], near, ("",) * len(chosen))

    def at_places(self, position: Array) -> Self:
        """The same levels with beacons listed at other positions ``(m, 2)`` [m], NaN where unknown."""
        prior = self.prior.copy()
        listed = np.isfinite(position[:, 0])
        prior[listed, :2] = position[listed]
        return replace(self, position=position, prior=prior)

    def hypotheses(self, at: Evaluation, by_others: Callable[[], Evaluation] | None) -> Sequence[Proposal]:
        """Two beacons of the list are swapped, one has moved, the list is of another place or is displaced."""
        along = list_hypotheses(self, at, placed=by_others is not None)
        if by_others is None:
            return along
        others = by_others()
        apart = list_hypotheses(self, others, placed=True) if along else []
        by = np.mean(others.state.poses[:, :2] - at.state.poses[:, :2], axis=0)
        if np.hypot(*by) > BEACONS.displaced:
            apart.append(self._displaced(by))
        return [*along, *(replace(proposal, start=others.state) for proposal in apart)]

    def _displaced(self, by: Array) -> Proposal:
        """The list has the right distances between beacons, but another origin, ``by (2,)`` [m] away."""
        displaced = replace(self.at_places(self.position + by), origin=by)
        price = PRICES.wrong_origin + 2 * float(np.log(BEACONS.anywhere))
        away = Hypothesis((self.name, "displaced"), (), (float(np.round(np.hypot(*by))),), price)
        return Proposal(away, (displaced,), fresh=("b",))

    def reports(self, at: Evaluation, which: Index | None = None) -> tuple[BeaconReport, ...]:
        """Estimated position and mean residual of each beacon that is received, and those that are off."""
        [block] = at.blocks_of(self.name)
        reached = self.keyframe >= 0
        error, of_beacon = np.abs(BEACONS.level_sigma * block.residual), self.listed.beacon[reached]
        place = at.state["b"][:, :2]
        away = np.hypot(*(at.state.poses[self.keyframe[reached], :2] - place[of_beacon]).T)
        received = [(m, of_beacon == m) for m in np.unique(of_beacon).tolist()]
        reports = [self._report(m, place[m], error[rows], float(away[rows].min())) for m, rows in received]
        reason, label = "never received, although the walk passes by: it seems to be off", self.listed.label
        off = [(m, *place[m].tolist()) for m in np.flatnonzero(self.prior[:, 2] < 0).tolist()]
        return *reports, *(BeaconReport(label[m], 0, 0.0, x, y, False, reason) for m, x, y in off)

    def _report(self, m: int, place: Array, off: Array, away: float) -> BeaconReport:
        """The report of one beacon. away: least distance of the walk where it was received [m]."""
        x, y = place.tolist()
        listed, used, label = self.listed.position[m], self.position[m], self.listed.label
        moved = bool(np.isfinite(listed[0]) and (listed != used).any())
        reason = "not contradicted"
        if np.isnan(listed[0]):
            reason = "not listed: its place is estimated"
        elif moved:
            distance = np.hypot(*(self.listed.position - (x, y)).T)
            nearest = label[int(np.nanargmin(distance))]
            reason = f"heard as if it were {distance[m]:.0f} m from where it is listed, "
            if np.isfinite(used[0]):
                reason += f"at the place of {nearest}: swapped, that place was used"
            else:
                reason += f"nearest to the place of {nearest}: moved or swapped, its place was not used"
        elif away > BEACONS.range:
            moved, reason = True, f"received, although the walk is {away:.0f} m or more from where it is listed"
        return BeaconReport(label[m], len(off), float(off.mean()), x, y, moved, reason)


WITHOUT_BODY = np.array([1.0, 1.0, 0.0])  # of (P, n, k): no shadowing by the body


class PathLoss:
    """Levels that are expected of ``n`` beacons at as many poses, see the module.

    axes: unit vectors ``(n, 2, 2)`` ahead and to the left; gap: from each pose to its beacon ``(n, 2)`` [m]; towards:
    the same in these axes; square: of the distance ``(n,)`` [m²]; level: ``(n,)`` [dBm].
    """

    def __init__(self, pose: Array, beacon: Array, q: Array):
        """Of poses ``(n, 3)`` and beacons ``(n, 3)``, x, y, a; q: P, n, k."""
        ahead = np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], axis=1)
        self.q, self.gap = q, beacon[:, :2] - pose[:, :2]
        self.axes = np.stack([ahead, ahead[:, ::-1] * [-1, 1]], axis=1)
        self.towards = np.sum(self.axes * self.gap[:, None], axis=2)
        self.square = np.sum(self.gap**2, axis=1) + BEACONS.height**2
        shadow = q[2] * self.towards[:, 0] / np.sqrt(self.square)
        self.level = q[0] + beacon[:, 2] - 5 * q[1] * np.log10(self.square) + shadow

    def derivatives(self) -> tuple[Array, Array, Array]:
        """Derivatives ``(n, 3)`` of the levels by pose, beacon and q."""
        _, exponent, body = self.q
        (along, aside), distance, one = self.towards.T, np.sqrt(self.square), np.ones(len(self.square))
        slope = (-10 * exponent / np.log(10) / self.square - body * along / distance**3)[:, None]
        by_beacon = np.column_stack([slope * self.gap + body * self.axes[:, 0] / distance[:, None], one])
        by_pose = -np.column_stack([np.sum(self.axes * by_beacon[:, None, :2], axis=2), -body * aside / distance])
        return by_pose, by_beacon, np.stack([one, -5 * np.log10(self.square), along / distance], axis=1)


LEAST_SILENCE = 1e-6  # added to twice the cost of a silence, whose root has no derivative at 0


def silence(expected: Array) -> tuple[Array, Array]:
    """Cost [nats] that a beacon is not received where levels ``expected`` [dBm] are, and its derivative [1/dB]."""
    deviation, bound = (BEACONS.weakest - expected) / BEACONS.within_sigma, np.exp(-BEACONS.most_evidence)
    weight = (BEACONS.within_sigma / BEACONS.level_sigma) ** 2
    probability = bound + (1 - bound) * ndtr(deviation)
    density = (1 - bound) * np.exp(-0.5 * deviation**2) / np.sqrt(2 * np.pi)
    return -weight * np.log(probability), weight * density / probability / BEACONS.within_sigma


def levels_along(sightings: Sightings, beacons: Beacons, steps: Steps) -> Levels:
    """Mean levels of the received beacons, by stretches of the walk. beacons: in the frame of the walk."""
    number = {name: m for m, name in enumerate(beacons.name)}
    which = np.array([number.get(name, -1) for name in sightings.transmitter], dtype=np.intp)
    rows = (which >= 0) & (sightings.time >= steps.start) & (sightings.time <= steps.end)
    time, which, rssi = sightings.time[rows], which[rows], sightings.rssi[rows]
    walked = np.append(0.0, np.cumsum(steps.length))[np.searchsorted(steps.time, time)]
    return mean_levels((walked // BEACONS.stretch).astype(np.intp), time, which, rssi, beacons)


def mean_levels(stretch: Index, time: Array, beacon: Index, rssi: Array, beacons: Beacons) -> Levels:
    """Mean level of every received beacon on every stretch, at the mean time of all advertisements there.

    stretch, time [s], beacon, rssi [dBm]: ``(n,)`` of single advertisements.
    """
    _, group, count = np.unique(stretch * len(beacons) + beacon, return_inverse=True, return_counts=True)
    stretches, of_stretch, size = np.unique(stretch, return_inverse=True, return_counts=True)
    middle = np.bincount(of_stretch, time, minlength=len(stretches)) / size
    first = np.unique(group, return_index=True)[1]
    mean = np.bincount(group, rssi, minlength=len(count)) / count
    if len(mean) > STRONGEST:
        order = np.lexsort((-mean, of_stretch[first]))
        rank = np.arange(len(order)) - np.searchsorted(of_stretch[first][order], of_stretch[first][order])
        kept = np.sort(order[rank < STRONGEST])
        first, mean = first[kept], mean[kept]
    return Levels(middle[of_stretch[first]], beacon[first], mean, beacons.label, beacons.position, beacons.sigma)


def list_hypotheses(beacons: BeaconRssiFactor, at: Evaluation, placed: bool) -> list[Proposal]:
    """What may be wrong with the listed positions, screened along the walk ``at``.

    placed: other sources say where the walk was, so that the whole list may be wrong.
    """
    q = at.state.arrays.get("q", np.array([BEACONS.path_loss]))[0]
    levels = replace(beacons.listed, position=beacons.position)
    surveyed, places, cost = placement_costs(levels, at.chain.time, at.state.poses[:, :2], q)
    count = len(surveyed)
    own = np.diag(cost[:, :count])
    swaps = [(own[i] + own[j] - cost[i, j] - cost[j, i], i, j) for i in range(count) for j in range(i)]
    received = np.isin(surveyed, levels.beacon)
    least = np.where(received, cost[:, count:].min(axis=1, initial=np.inf), 0.0)  # one that is off costs nothing
    gains = own - least
    if max(gains.max(initial=0.0), max(swaps, default=(0.0,))[0]) < BEACONS.suspicious:
        return []
    found = [
        _swapped(beacons, surveyed[i], surveyed[j])
        for gain, i, j in sorted(swaps, reverse=True)[:MOST_OF_A_KIND]
        if gain > -BEACONS.suspicious
    ]
    best = places[count + np.argmin(cost[:, count:], axis=1)]
    for i in np.argsort(-gains)[:MOST_OF_A_KIND].tolist():
        if gains[i] > BEACONS.suspicious:
            labels, which = (beacons.listed.label[surveyed[i]],), surveyed[i : i + 1]
            moved = _unlisted(beacons, which, best[i : i + 1], "moved", labels)
            found.append(moved if received[i] else _off(beacons, which, labels))
    if placed and received.sum() > 1 and np.sum(gains) > received.sum() * BEACONS.suspicious:
        found.append(_unlisted(beacons, surveyed, best, "of another place"))
    return found


def _swapped(beacons: BeaconRssiFactor, a: int, b: int) -> Proposal:
    position = beacons.position.copy()
    position[[a, b]] = position[[b, a]]
    labels = tuple(sorted((beacons.listed.label[a], beacons.listed.label[b])))
    swapped = Hypothesis((beacons.name, "swapped"), labels, price=PRICES.wrong_list)
    return Proposal(swapped, (beacons.at_places(position),), fresh=("b",))


def _unlisted(
    beacons: BeaconRssiFactor, which: Index, place: Array, error: str, labels: tuple[str, ...] = ()
) -> Proposal:
    """Beacons ``which`` are not where they are listed, perhaps at ``place (m, 2)`` [m].

    The price includes the normaliser of the wider prior of their places.
    """
    position = beacons.position.copy()
    position[which] = np.nan
    unlisted = beacons.at_places(position)
    unlisted.prior[which, :2] = place
    price = PRICES.wrong_list + float(2 * np.log(BEACONS.anywhere / beacons.listed.sigma[which]).sum())
    return Proposal(Hypothesis((beacons.name, error), labels, price=price), (unlisted,), fresh=("b",))


def _off(beacons: BeaconRssiFactor, which: Index, labels: tuple[str, ...]) -> Proposal:
    """Beacons ``which`` are never received since they do not send: their power is far below that of others."""
    off = beacons.at_places(beacons.position)
    off.prior[which, 2] = -10 * BEACONS.power_sigma  # it is expected nowhere
    return Proposal(Hypothesis((beacons.name, "off"), labels, price=PRICES.beacon_off), (off,), fresh=("b",))


@wording_of(BeaconRssiFactor.name)
def _wording(hypothesis: Hypothesis) -> Wording:
    """What is wrong with a list of beacons."""
    labels, (_, error) = " and ".join(str(label) for label in hypothesis.instances), hypothesis.kind
    if error == "swapped":
        text = f"the positions of {labels} are swapped in the list"
    elif error == "moved":
        text = f"{labels} is not where the list says"
    elif error == "off":
        return Wording(BeaconRssiFactor.name, f"{labels} sends nothing")  # no reason to doubt the walk
    elif error == "displaced":
        text = f"all positions in the list of beacons are off by about {hypothesis.parameter[0]:.0f} m"
    else:
        text = "the list of beacons is of another place"
    return Wording(BeaconRssiFactor.name, text, "the positions in the list of beacons")


POWERS = np.arange(-12.0, 12.5, 3.0)  # [dB] candidate powers of a beacon
PLACES_EVERY, BESIDE_WALK = 5.0, 20.0  # [m] between candidate places of a beacon, to either side of the walk
MOST_OF_A_KIND = 2  # swaps, and moved beacons, that are proposed
MOST_STRETCHES = 400  # of a walk by which a list is judged, evenly spaced: a kilometre; more repeat the same fading
MOST_COSTS = 1_000_000  # costs of places, powers and stretches in memory


def placement_costs(levels: Levels, keyframe_time: Array, position: Array, q: Array) -> tuple[Index, Array, Array]:
    """How well the levels of each surveyed beacon fit each place.

    Returns the ``m`` surveyed beacons; places ``(p, 2)`` [m], first those listed for them; costs ``(m, p)`` [nats].
    """
    stretch, of = np.unique(levels.time, return_inverse=True)
    track = np.stack([np.interp(stretch, keyframe_time, axis) for axis in position.T], axis=1)
    table = np.full((len(levels.position), len(stretch)), np.nan)  # of beacons and stretches
    table[levels.beacon, of] = levels.rssi
    every = -(-len(track) // MOST_STRETCHES)
    track, table = track[::every], table[:, ::every]
    surveyed = np.flatnonzero(np.isfinite(levels.position[:, 0]))
    low, high = track.min(axis=0) - BESIDE_WALK, track.max(axis=0) + BESIDE_WALK
    axes = (np.arange(a, b, PLACES_EVERY) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    places = np.concatenate([levels.position[surveyed], grid])
    square = np.sum((track - places[:, None]) ** 2, axis=2) + BEACONS.height**2
    expected = q[0] - 5 * q[1] * np.log10(square)
    parts = np.array_split(expected, 1 + expected.size * len(POWERS) // MOST_COSTS)
    return surveyed, places, np.concatenate([_negative_log_likelihood(table[surveyed], part) for part in parts], axis=1)


def _negative_log_likelihood(levels: Array, expected: Array) -> Array:
    """Negative log-likelihood ``(m, p)`` of the levels of each beacon at each place, at its most likely power.

    levels: ``(m, s)`` of each stretch, NaN where not received; expected: ``(p, s)``.
    """
    most = BEACONS.most_evidence  # of one level
    silent = silence(expected[:, None] + POWERS[:, None])[0]
    least = np.empty((len(levels), len(expected)))
    for m, received in enumerate(np.isfinite(levels)):
        expected_here = np.compress(received, expected, axis=1)[:, None]
        off = (levels[m, received] - expected_here - POWERS[:, None]) / BEACONS.level_sigma
        total = np.minimum(0.5 * off**2, most).sum(axis=2) + np.compress(~received, silent, axis=2).sum(axis=2)
        least[m] = np.min(total + 0.5 * (POWERS / BEACONS.power_sigma) ** 2, axis=1)
    return least


LONGEST_STRETCH = 6.0  # [s] of levels that are one mean, live
MOST_RECEPTIONS = 100_000  # that are stored: an hour of a receiver that hears 25 a second


class LevelCollector:
    """Makes mean levels of surveyed beacons on a walk under way; a `Collector`. beacons: in the frame of the walk.

    A stretch ends after BEACONS.stretch metres, or after LONGEST_STRETCH seconds.
    """

    def __init__(self, beacons: Beacons):
        self._beacons = beacons
        surveyed = np.isfinite(beacons.position[:, 0])
        self._by_name = {name.lower(): m for m, name in enumerate(beacons.name) if surveyed[m]}
        self._by_minor = {minor_number(name): m for name, m in self._by_name.items()}
        self._waiting = np.empty((0, 3))  # time [s], beacon, rssi [dBm] of the stretches that are not complete
        self._window = np.empty((0, 3))  # the same of all advertisements in the window

    def collect(self, received: Sightings, radio: str) -> None:
        """Store advertisements of surveyed beacons.

        Those of other radios are left out: an access point may have the address of a beacon.
        """
        if radio != "bluetooth":
            return
        minors = received.minor or ("",) * len(received)
        rows = []
        for time, name, minor, rssi in zip(
            received.time.tolist(), received.transmitter, minors, received.rssi.tolist(), strict=True
        ):
            beacon = self._by_name.get(name.lower(), self._by_minor.get(minor) if minor else None)
            if beacon is not None and np.isfinite([time, rssi]).all():
                rows.append((time, beacon, rssi))
        table = np.array(rows).reshape(-1, 3)
        self._waiting = np.vstack([self._waiting, table])[-MOST_RECEPTIONS:]
        self._window = np.vstack([self._window, table])[-MOST_RECEPTIONS:]

    def due(self, until: float, walked: Callable[[Array], Array]) -> Iterable[Levels]:
        """Yield, once, the levels of the stretches that are complete until ``until`` [s]."""
        time = self._waiting[:, 0]
        if not len(time) or time.min() > until:
            return
        stretch, now = walked(time) // BEACONS.stretch, float(walked(np.array([until]))[0] // BEACONS.stretch)
        complete = (time <= until) & ((stretch < now) | (time < until - LONGEST_STRETCH))
        if complete.any():
            time, beacon, rssi = self._waiting[complete].T
            levels = mean_levels(stretch[complete].astype(np.intp), time, beacon.astype(np.intp), rssi, self._beacons)
            yield replace(levels, time=np.round(levels.time, DECIMALS))
        self._waiting = self._waiting[~complete]

    def complete(self, steps: Steps) -> Iterable[Levels]:
        """The levels of the window, as the batch makes them."""
        time, beacon, rssi = self._window.T
        names = tuple(self._beacons.name[int(m)] for m in beacon)
        levels = levels_along(Sightings(time, names, rssi), self._beacons, steps)
        return [levels] if len(levels) else []

    def forget(self, before: float) -> None:
        """Drop advertisements from before ``before`` [s]."""
        self._window = self._window[self._window[:, 0] >= before]
