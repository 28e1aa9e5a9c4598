"""[calibration-walk] Sec. 2: dead reckoning from reference positions, on a simulated crowd.

The paper names a known start, a switch, BLE transmitters and an encounter with another terminal, whose estimated
position becomes the reference. It adds the steps since then. The graph has each of them as a factor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.estimation.factors.base import geman_mcclure_weight
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.multi_walk import smooth_together
from pdr_graph.estimation.smoother import smooth
from pdr_graph.geometry import REGION_90, dead_reckon, distance_walked, interpolate, squared_distance
from pdr_graph.lab.papers.result_table import FIRST_SEED, ResultTable
from pdr_graph.lab.simulation.crowd import DURATION, SURVEYED, TERMINAL, TERMINAL_PLACE, Crowd, CrowdWalk, crowd
from pdr_graph.priors import BEACONS, LOSSES, REPORTS, changed
from pdr_graph.types import Array, Closures, Fixes, Index, Levels, Mask, Trajectory

CROWDS = 4
QUICK_CROWDS, SHORT = 1, 150.0  # crowds of a quick run, and how long they walk [s]
FALSE_SHARE, NEAREST_FALSE, FARTHEST_FALSE = 0.1, 20.0, 40.0  # of false encounters; [m] from where the other is
UNBOUNDED = 1e3  # [σ] within which the loss of closures is Gaussian

KNOWN_START, SWITCH, BY_BLE = "known start", "switch", "BLE beacons"
ENCOUNTER, DESK = "encounters with a walker", "encounters with a fixed terminal"
REFERENCES = (SWITCH, BY_BLE, ENCOUNTER, DESK)

NEAR_BEACON = BEACONS.nearest  # [m] by its level, within which the paper's reference is the beacon's place


def experiment(quick: bool = False) -> tuple[ResultTable, ...]:
    """Errors by each reference position, and with false encounters."""
    number, duration = (QUICK_CROWDS, SHORT) if quick else (CROWDS, DURATION)
    crowds = [crowd(FIRST_SEED + n, duration) for n in range(number)]
    return by_reference(crowds), with_false_encounters(crowds)


COLUMN_NAMES = (
    "reference positions",
    "method",
    "references per walk",
    "median [m]",
    "75 % [m]",
    "95 % [m]",
    "median at the end [m]",
    "in the 90 % region [%]",
    "extent of the walk [%]",
)
OF_PAPER, GRAPH, ONE_IN_TEN, LEFT_OUT = "paper", "graph", "1 in 10 false", "these left out"


def by_reference(crowds: Sequence[Crowd]) -> ResultTable:
    """Errors of dead reckoning by each kind of reference position, and by all."""
    close, strong, whole = ([rule.encounters(walkers) for walkers in crowds] for rule in (NEARBY, DISTANT, RECEIVED))
    rows = list[tuple[str, ...]]()
    alone = [(f"+ {source}", (source,)) for source in REFERENCES]
    for title, sources in ((KNOWN_START, ()), *alone, ("all of these", REFERENCES)):
        rows.append(score(crowds, close, by_paper(sources), (title, OF_PAPER)))
        rows.append(score(crowds, close, by_graph(sources), (title, GRAPH)))
        if sources in ((ENCOUNTER,), (DESK,)):
            rows.append(score(crowds, strong, by_graph(sources), (title, "graph, distant encounters too")))
        if sources == (DESK,):
            rows.append(score(crowds, whole, by_graph(sources, as_beacon=True), (title, "graph, terminal as a beacon")))
    minutes = max(walk.steps.end for walk in crowds[0].walks) / 60
    title = f"Reference positions, [calibration-walk] Sec. 2: {len(crowds)} × 12 walkers, {minutes:.1f} min each"
    return ResultTable("reference-positions", title, COLUMN_NAMES, tuple(rows), NOTE_REFERENCES)


def with_false_encounters(crowds: Sequence[Crowd]) -> ResultTable:
    """What false encounters do: one in ten is with a walker who was elsewhere."""
    rows = list[tuple[str, ...]]()
    for rule, sources, without in (
        (NEARBY, (ENCOUNTER,), True),
        (NEARBY, REFERENCES, True),
        (DISTANT, (ENCOUNTER,), False),  # without false ones: in the other table
    ):
        pairs = [falsified(walkers, rule.encounters(walkers), FIRST_SEED) for walkers in crowds]
        false, wrong = [met for met, _ in pairs], [of_crowd for _, of_crowd in pairs]
        title = f"{rule.name}{' and all others' if sources == REFERENCES else ''}, "
        rows.append((*score(crowds, false, by_paper(sources), (title + ONE_IN_TEN, OF_PAPER)), ""))
        rows.append(score_with_rejected(crowds, false, by_graph(sources), (title + ONE_IN_TEN, GRAPH), wrong))
        if rule is NEARBY and sources == (ENCOUNTER,):
            with changed(LOSSES, closure=UNBOUNDED):
                names = title + ONE_IN_TEN, "graph without robust loss"
                rows.append((*score(crowds, false, by_graph(sources), names), ""))
        if without:
            kept = [met.only(~of_crowd) for met, of_crowd in pairs]
            nothing = [np.zeros(len(met), dtype=bool) for met in kept]
            rows.append((*score(crowds, kept, by_paper(sources), (title + LEFT_OUT, OF_PAPER)), ""))
            rows.append(score_with_rejected(crowds, kept, by_graph(sources), (title + LEFT_OUT, GRAPH), nothing))
    title = f"False encounters, {NEAREST_FALSE:.0f} to {FARTHEST_FALSE:.0f} m from the other walker"
    header = (*COLUMN_NAMES, "rejected: false, right [%]")
    return ResultTable("false-encounter", title, header, tuple(rows), NOTE_FALSE)


NOTE_REFERENCES = """The paper publishes no figure for this. Place and direction of the start are known, with errors of
0.75 m and 0.2 rad. Of two people who meet, the paper's method lets the person who has walked less since a known place
take the other's position. Halls differ from the typical path loss by 8 dB, which only the graph estimates. Extent:
spread of the estimated positions of a walk by that of the true positions.

Encounters at ten metres (from −85 dBm on) contract the walks, and nothing says so; the lifelog uses close ones. Far
pairs are many, so pairs that met at 5 m by their level were 10 and 14 m apart (medians). Beacons by themselves leave
the region too small, since the search ends in one of several optima."""
NOTE_FALSE = """Of 142 close encounters between walkers (67, 4, 6 and 65 in the four halls) 15 are false, of 2457 at ten
metres 251. The robust loss rejects half of the close ones (weight below a tenth), and all if there are other
references; of those at ten metres 4 %, since 20 to 40 m are 3 to 5 of their largest sigmas."""


# Encounters


@dataclass(frozen=True)
class Encounters:
    """Encounters of pairs of walkers, or of a walker with the terminal.

    time: ``(n,)`` [s]; pair: ``(n, 2)`` numbers of walkers, the second may be TERMINAL; rssi: ``(n,)`` [dBm]; sigma:
    ``(n,)`` per axis of the distance between both [m].
    """

    time: Array
    pair: Index
    rssi: Array
    sigma: Array

    def __len__(self) -> int:
        return len(self.time)

    def only(self, which: Mask) -> Encounters:
        """Some of the encounters."""
        return Encounters(self.time[which], self.pair[which], self.rssi[which], self.sigma[which])

    @property
    def with_terminal(self) -> Mask:
        """True ``(n,)`` for encounters with the fixed terminal."""
        return self.pair[:, 1] == TERMINAL


@dataclass(frozen=True)
class Rule:
    """Which receptions are encounters: of a level of at least ``least`` [dBm]; sigma: least per axis [m]."""

    name: str
    least: float
    sigma: float

    def encounters(self, walkers: Crowd) -> Encounters:
        """The encounters of a crowd; the distance by the level has any direction."""
        met = walkers.receptions
        which = met.rssi >= self.least
        sigma = np.maximum(self.sigma, distance_by(met.rssi[which]) / np.sqrt(2))
        return Encounters(met.time[which], met.pair[which], met.rssi[which], sigma)


def distance_by(rssi: Array) -> Array:
    """Distances ``(n,)`` [m] at levels ``(n,)`` [dBm], by the path loss of a typical phone."""
    power, exponent, _ = BEACONS.path_loss
    return 10 ** ((power - rssi) / (10 * exponent))


DISTANT = Rule("encounters at about ten metres", -85.0, 1.5)  # sigma by the level
# At the level of a metre; their distance was 3.3 m per axis (root mean square) on seeds 0 to 2
NEARBY = Rule("close encounters", BEACONS.path_loss[0], 3.0)
RECEIVED = Rule("all receptions", -np.inf, 3.0)


def falsified(walkers: Crowd, met: Encounters, seed: int) -> tuple[Encounters, Mask]:
    """Encounters, one in ten with a walker NEAREST_FALSE to FARTHEST_FALSE metres away, and which these are."""
    random, pair, false = np.random.default_rng(seed), met.pair.copy(), np.zeros(len(met), dtype=bool)
    for n in np.flatnonzero(random.uniform(size=len(met)) < FALSE_SHARE).tolist():
        places = walkers.places(float(met.time[n]))
        away = np.hypot(*(places - places[pair[n, 0]]).T)[:TERMINAL]
        others = np.flatnonzero((away > NEAREST_FALSE) & (away < FARTHEST_FALSE))
        if pair[n, 1] != TERMINAL and len(others):
            pair[n, 1], false[n] = random.choice(others), True
    return replace(met, pair=pair), false


# By the paper: the position is set to the reference


@dataclass(frozen=True)
class Reference:
    """A reference position of a walker at a time [s]: a known place ``(2,)`` [m], or that of another walker."""

    time: float
    walker: int
    place: Array | None = None
    other: int = -1


def references(walkers: Crowd, sources: Sequence[str], met: Encounters) -> list[Reference]:
    """The references of all walkers by time. Levels of beacons count within NEAR_BEACON, all encounters ``met`` do."""
    all_of = list[Reference]()
    for number, walk in enumerate(walkers.walks):
        known = [walk.presses] if SWITCH in sources else []
        if BY_BLE in sources:
            levels = walk.levels
            near = np.flatnonzero(distance_by(levels.rssi) < NEAR_BEACON)
            known.append(Fixes(levels.time[near], levels.position[levels.beacon[near]], np.ones(len(near))))
        all_of += [
            Reference(time, number, place)
            for fixes in known
            for time, place in zip(fixes.time.tolist(), fixes.position, strict=True)
        ]
    for time, (walker, other) in zip(met.time.tolist(), met.pair.tolist(), strict=True):
        if other == TERMINAL and DESK in sources:
            all_of.append(Reference(time, walker, TERMINAL_PLACE))
        elif other != TERMINAL and ENCOUNTER in sources:
            all_of.append(Reference(time, walker, other=other))
    return sorted(all_of, key=lambda reference: reference.time)


def set_to_references(walks: Sequence[CrowdWalk], known: Iterable[Reference]) -> list[Trajectory]:
    """Dead reckoning of every walker, set to each reference: [calibration-walk] Sec. 2, Eq. (1).

    Of two walkers who meet, the one who has walked farther since the last known place takes the other's position. The
    paper does not say which; by it, the error grows with that distance.
    """
    tracks = [dead_reckon(walk.steps, walk.start, float(walk.heading.heading[0])) for walk in walks]
    offset, since = np.zeros((len(walks), 2)), np.zeros(len(walks))  # [m], and walked at the last known place [m]
    changes: list[list[tuple[float, Array]]] = [[(-np.inf, np.zeros(2))] for _ in walks]

    def reckoned(walker: int, time: float) -> Array:
        return interpolate(np.array([time]), tracks[walker].time, tracks[walker].position)[0]

    def walked(walker: int, time: float) -> float:
        return float(distance_walked(walks[walker].steps, np.array([time]))[0]) - float(since[walker])

    for reference in known:
        walker, place, time, last = reference.walker, reference.place, reference.time, 0.0
        if place is None:
            walker, other = sorted((walker, reference.other), key=lambda n: walked(n, time), reverse=True)
            place, last = reckoned(other, time) + offset[other], walked(other, time)
        offset[walker] = place - reckoned(walker, time)
        since[walker] += walked(walker, time) - last
        changes[walker].append((time, offset[walker].copy()))
    return [
        replace(track, position=track.position + _at(track.time, of_walker))
        for track, of_walker in zip(tracks, changes, strict=True)
    ]


def _at(time: Array, changes: Sequence[tuple[float, Array]]) -> Array:
    """Offsets ``(n, 2)`` [m] at times [s], each of them from its time on."""
    begins, offsets = zip(*changes, strict=True)
    return np.array(offsets)[np.searchsorted(np.array(begins), time, side="right") - 1]


# By the graph


def smoothed(walkers: Crowd, sources: Sequence[str], met: Encounters, as_beacon: bool = False) -> list[Trajectory]:
    """Every walker by the graph, all in one if they met. as_beacon: the terminal is one more beacon, all its levels."""
    graphs = list[WalkGraph]()
    for number, walk in enumerate(walkers.walks):
        fixes, levels = [walk.start], [walk.levels] if BY_BLE in sources else []
        fixes += [walk.presses] if SWITCH in sources else []
        if DESK in sources:
            at_desk = met.only((met.pair == (number, TERMINAL)).all(axis=1))
            n, place = len(at_desk), np.array([TERMINAL_PLACE])
            if as_beacon:
                beacon = np.zeros(n, dtype=np.intp)
                levels.append(Levels(at_desk.time, beacon, at_desk.rssi, ("terminal",), place, np.array([SURVEYED])))
            else:
                fixes.append(Fixes(at_desk.time, place.repeat(n, axis=0), at_desk.sigma))
        graphs.append(WalkGraph(walk.steps, Fixes.concatenate(fixes), headings=walk.heading, measurements=levels))
    estimates = [smooth(graph) for graph in graphs]
    if ENCOUNTER in sources:
        estimates = smooth_together(graphs, estimates, closures_of(met))
    return [estimate.trajectory for estimate in estimates]


def closures_of(met: Encounters) -> Closures:
    """The encounters between walkers as closures."""
    met = met.only(~met.with_terminal)
    return Closures(np.stack([met.time, met.time], axis=1), met.sigma, met.pair)


def closure_weights(tracks: Sequence[Trajectory], met: Encounters) -> Array:
    """Share of the information of each encounter ``(n,)`` that the graph's robust loss leaves it at its estimate."""
    ends = [
        [interpolate(np.array([t]), tracks[n].time, tracks[n].position)[0] for n in pair]
        for t, pair in zip(met.time.tolist(), met.pair.tolist(), strict=True)
    ]
    apart = np.hypot(*np.diff(np.array(ends).reshape(-1, 2, 2), axis=1)[:, 0].T)
    return geman_mcclure_weight(apart / met.sigma, LOSSES.closure)


# Scores


Method = Callable[[Crowd, Encounters], tuple[list[Trajectory], int]]
"""Tracks of a crowd by encounters, and the number of reference positions."""


def by_paper(sources: Sequence[str]) -> Method:
    """The paper's way with these references."""

    def method(walkers: Crowd, met: Encounters) -> tuple[list[Trajectory], int]:
        known = references(walkers, sources, met)
        return set_to_references(walkers.walks, known), len(known)

    return method


def by_graph(sources: Sequence[str], as_beacon: bool = False) -> Method:
    """The graph with these references."""

    def method(walkers: Crowd, met: Encounters) -> tuple[list[Trajectory], int]:
        used = np.where(met.with_terminal, DESK in sources, ENCOUNTER in sources)
        number = int(used.sum()) + sum(
            len(walk.presses) * (SWITCH in sources) + len(walk.levels) * (BY_BLE in sources) for walk in walkers.walks
        )
        return smoothed(walkers, sources, met, as_beacon), number

    return method


def score(
    crowds: Sequence[Crowd], met: Sequence[Encounters], method: Method, names: tuple[str, str]
) -> tuple[str, ...]:
    """A row of a table: errors at all steps of all walks."""
    return _scored(crowds, [method(*both) for both in zip(crowds, met, strict=True)], names)


def score_with_rejected(
    crowds: Sequence[Crowd],
    met: Sequence[Encounters],
    method: Method,
    names: tuple[str, str],
    false: Sequence[Mask],
) -> tuple[str, ...]:
    """The same row, with the shares of false and of right encounters that keep less than a tenth of their weight."""
    found = [method(*both) for both in zip(crowds, met, strict=True)]
    rejected = dict[bool, list[Mask]]({True: [], False: []})
    for (tracks, _), rows, wrong in zip(found, met, false, strict=True):
        between = ~rows.with_terminal
        weight = closure_weights(tracks, rows.only(between))
        for kind, of_kind in rejected.items():
            of_kind.append(weight[wrong[between] == kind] < REPORTS.rejected)
    shares = [percent(np.concatenate(of_kind)) for of_kind in rejected.values()]
    return (*_scored(crowds, found, names), ", ".join(shares))


def percent(which: Mask) -> str:
    """A share as a cell; "–" of nothing."""
    return f"{100 * which.mean():.0f}" if len(which) else "–"


def _scored(
    crowds: Sequence[Crowd], found: Sequence[tuple[list[Trajectory], int]], names: tuple[str, str]
) -> tuple[str, ...]:
    pairs = [
        (walk.truth, track)
        for walkers, (tracks, _) in zip(crowds, found, strict=True)
        for walk, track in zip(walkers.walks, tracks, strict=True)
    ]
    errors = [np.hypot(*(track.position - truth.position).T) for truth, track in pairs]
    regions = [in_region(truth, track) for truth, track in pairs]
    extent = [np.sqrt(track.position.var(axis=0).sum() / truth.position.var(axis=0).sum()) for truth, track in pairs]
    return (
        *names,
        f"{sum(number for _, number in found) / len(pairs):.1f}",
        *(f"{error:.2f}" for error in np.quantile(np.concatenate(errors), [0.5, 0.75, 0.95]).tolist()),
        f"{np.median([of_walk[-1] for of_walk in errors]):.2f}",
        percent(np.concatenate(regions)),
        f"{100 * np.mean(extent):.0f}",
    )


def in_region(truth: Trajectory, track: Trajectory) -> Mask:
    """Rows ``(n,)`` whose true position is in the 90 % region that the track states; none if it states no region."""
    if track.covariance is None:
        return np.zeros(0, dtype=bool)
    return squared_distance(truth.position - track.position, track.covariance[:, :2, :2]) <= REGION_90
