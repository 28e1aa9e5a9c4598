"""What receivers and beacons say of a walk under way: the models of `receivers` and `beacons`, one keyframe at a time.

Each observation is linearised here where the walk is, with its robust weight, and again when that has changed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, TypeVar

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, G, Q, X

from pdr_graph.estimation.beacons import LOSS, LOSS_SIGMA, OWN_SIGMA, STRETCH, Levels, levels
from pdr_graph.estimation.observations import Rows
from pdr_graph.estimation.preintegration import DECIMALS
from pdr_graph.estimation.receivers import ALONG, LAG, LAG_CHANGE, NODE, STANDING, WHITE, Receivers
from pdr_graph.estimation.tree import Name, linear
from pdr_graph.io.beacons import number_of
from pdr_graph.types import Array, Beacons, Sightings, Steps

AMBLE = 1.0  # [m/s] at which a walker is thought to go on until the next node
CHANGED = 0.1  # of a weight, or [m] and 0.1 rad of a pose, until an observation is linearised again
LONGEST = 6.0  # [s] that a stretch may take


One = TypeVar("One", bound="Observation")


@dataclass
class Observation:
    """An observation: the number of its keyframe; keys: its other variables; at: pose and weight when linearised."""

    keyframe: int
    keys: tuple[int, ...] = ()
    at: Array = field(default_factory=lambda: np.full(4, np.nan))


@dataclass
class SeenFix(Observation):
    """A fix of a receiver: position [m], velocity ahead [m/s], sigmas of what it shares and does not.

    keys: of the nodes before and after it; share: how far it is on from the one to the other.
    """

    position: Array = field(default_factory=lambda: np.zeros(2))
    velocity: float = 0.0
    offset: float = 1.0
    white: float = 1.0
    share: float = 0.0
    wild: bool = False


@dataclass
class SeenLevel(Observation):
    """How loud a beacon was: time [s], rssi [dBm]."""

    time: float = 0.0
    beacon: int = 0
    rssi: float = 0.0


@dataclass
class _Source:
    """A receiver: its nodes' numbers, times and drifts; drift and sigma of its last fixes."""

    nodes: list[tuple[int, float, float]] = field(default_factory=list)
    recent: list[tuple[float, float]] = field(default_factory=list)


def linearised(
    kind: str, seen: Mapping[int, Observation], rows: Rows, pose: Array, at: gtsam.Values
) -> dict[Name, gtsam.NonlinearFactor]:
    """The factors of those observations that have changed since. pose: ``(n, 3)`` of their keyframes."""
    factors: dict[Name, gtsam.NonlinearFactor] = {}
    now = np.column_stack([pose, rows.weight])
    root = np.sqrt(rows.weight)
    for n, (number, one) in enumerate(seen.items()):
        if not (np.abs(now[n] - one.at) <= CHANGED).all():
            one.at = now[n]
            blocks = [root[n] * block for block in rows.by[n]]
            factors[kind, number] = linear(
                [X(one.keyframe), *one.keys], blocks[: 1 + len(one.keys)], root[n] * rows.value[n], at
            )
    return factors


class LiveReceivers:
    """Offset and lag of each receiver along the walk."""

    def __init__(self) -> None:
        self.fixes: dict[int, SeenFix] = {}  # by the fix's number
        self._sources: dict[str, _Source] = {}
        self._count = 0

    def add(
        self, number: int, source: str, fix: SeenFix, time: float, sigma: float, walked: float, known: gtsam.Values
    ) -> tuple[dict[Name, gtsam.NonlinearFactor], gtsam.Values, dict[int, float]]:
        """A fix that the walk has reached, at ``time`` [s] after ``walked`` [m].

        known: what is alive. Returns factors, values and times of its nodes.
        """
        own = self._sources.setdefault(source, _Source())
        own.nodes = [node for node in own.nodes if known.exists(G(node[0]))]
        drift = time / STANDING + walked / ALONG
        factors, values, times = self._extend(own, time, drift)
        after = next(n for n, node in enumerate(own.nodes) if node[1] > time)
        (a, begin, _), (b, end, _) = own.nodes[max(after, 1) - 1 : max(after, 1) + 1]
        own.nodes = own.nodes[-3:]
        own.recent = [one for one in own.recent if one[0] > drift - 1.0] + [(drift, sigma)]
        least, alike = min(s for _, s in own.recent), 2 * len(own.recent) - 1
        fix.keys, fix.offset = (G(a), G(b)), least
        fix.white = float(np.sqrt(WHITE**2 * least**2 + alike * (sigma**2 - least**2)))
        fix.share = float(np.clip((time - begin) / (end - begin), 0, 1))
        self.fixes[number] = fix
        return factors, values, times | {G(a): time, G(b): time}

    def alike(self, source: str) -> int:
        """How many fixes err like the next one of a source, about; 1 of a source whose errors are independent."""
        known = self._sources.get(source) if source else None
        return 1 if known is None else 2 * len(known.recent) + 1

    def forget(self, alive: set[int]) -> None:
        """Keep the fixes of the keyframes that are alive."""
        self.fixes = {number: fix for number, fix in self.fixes.items() if fix.keyframe in alive}

    def _extend(
        self, own: _Source, time: float, drift: float
    ) -> tuple[dict[Name, gtsam.NonlinearFactor], gtsam.Values, dict[int, float]]:
        factors: dict[Name, gtsam.NonlinearFactor] = {}
        values, times = gtsam.Values(), dict[int, float]()
        noise = gtsam.noiseModel.Diagonal.Sigmas
        while not own.nodes or own.nodes[-1][1] <= time:
            at = time if not own.nodes or own.nodes[-1][1] + NODE <= time else own.nodes[-1][1] + NODE
            by_then = drift + (at - time) * (1 / STANDING + AMBLE / ALONG)
            n, self._count = self._count, self._count + 1
            values.insert(G(n), np.zeros(3))
            times[G(n)] = time
            if own.nodes:
                before, since, drifted = own.nodes[-1]
                keep = np.exp(-max(by_then - drifted, 1e-3))
                change = np.sqrt(1 - keep**2)
                sigma = np.array([change, change, LAG_CHANGE * np.sqrt(at - since)])
                A = np.diag([keep, keep, 1.0]) / sigma[:, None]
                nothing = gtsam.Values()
                nothing.insert(G(before), np.zeros(3))
                nothing.insert(G(n), np.zeros(3))
                factors["kept", n] = linear([G(before), G(n)], [-A, np.diag(1 / sigma)], np.zeros(3), nothing)
            else:
                factors["begun", n] = gtsam.PriorFactorVector(G(n), np.zeros(3), noise(np.array([1.0, 1.0, LAG])))
            own.nodes.append((n, at, by_then))
        return factors, values, times

    def state(self) -> dict[str, Any]:
        """All that it knows, as numbers."""
        fixes = [[number, asdict(fix)] for number, fix in self.fixes.items()]
        return {"fixes": fixes, "sources": [[n, asdict(one)] for n, one in self._sources.items()], "count": self._count}

    @classmethod
    def restored(cls, state: dict[str, Any]) -> LiveReceivers:
        """What `state` told of; every fix is to be linearised."""
        own = cls()
        own.fixes = {int(number): _anew(SeenFix, fix) for number, fix in state["fixes"]}
        for name, one in state["sources"]:
            nodes = [(int(n), t, d) for n, t, d in one["nodes"]]
            own._sources[name] = _Source(nodes, [(d, s) for d, s in one["recent"]])
        own._count = int(state["count"])
        return own

    @property
    def seen(self) -> Mapping[int, Observation]:
        """Its fixes."""
        return self.fixes

    def rows(self, pose: Array, values: gtsam.Values) -> Rows:
        """Their factors at poses ``(f, 3)`` of their keyframes."""
        fixes = list(self.fixes.values())
        g = np.array([values.atVector(key) for fix in fixes for key in fix.keys])
        every = np.arange(len(fixes))
        model = Receivers(
            fix=every,
            keyframe=every,
            position=np.array([fix.position for fix in fixes]),
            offset=np.array([fix.offset for fix in fixes]),
            white=np.array([fix.white for fix in fixes]),
            velocity=np.array([[fix.velocity, 0.0] for fix in fixes]),
            node=2 * every,
            share=np.array([fix.share for fix in fixes]),
            keep=np.empty(0),
            time_before=np.empty(0),
        )
        return model.seen(pose, g, np.array([fix.wild for fix in fixes]))


class LiveBeacons:
    """How loud surveyed beacons were along the walk. beacons: in its frame."""

    def __init__(self, beacons: Beacons):
        known = np.isfinite(beacons.position[:, 0])
        self.beacons = beacons
        called = {name.lower(): m for m, name in enumerate(beacons.name) if known[m]}
        self._by_minor = {number_of(name): m for name, m in called.items()}
        self._by_name = called
        self._heard: list[tuple[float, int, float]] = []
        self._all: list[tuple[float, int, float]] = []  # of the window
        self._met: set[int] = set()
        self.levels: dict[int, SeenLevel] = {}
        self._count = 0

    def hear(self, heard: Sightings) -> None:
        """What the radio heard."""
        minor = heard.minor or ("",) * len(heard)
        rows = zip(heard.time.tolist(), heard.transmitter, minor, heard.rssi.tolist(), strict=True)
        for time, name, number, rssi in rows:
            beacon = self._by_name.get(name.lower(), self._by_minor.get(number) if number else None)
            if beacon is not None and np.isfinite(rssi) and np.isfinite(time):
                self._heard.append((time, beacon, rssi))
                self._all.append(self._heard[-1])

    def so_far(self, steps: Steps) -> Levels:
        """How loud they were along all these steps, as long as nothing was forgotten."""
        time, which, rssi = np.array(self._all).reshape(-1, 3).T
        names = tuple(self.beacons.name[int(m)] for m in which)
        return levels(Sightings(time, names, rssi), self.beacons, steps)

    def due(self, covered: float, walked: Callable[[Array], Array]) -> list[SeenLevel]:
        """Time, beacon and mean level of the stretches that are complete by ``covered`` [s]."""
        if not self._heard or self._heard[0][0] > covered:
            return []
        times = np.array([covered, *(time for time, _, _ in self._heard)])
        now, *stretch_of = (walked(times) // STRETCH).tolist()
        stretches: dict[float, list[tuple[float, int, float]]] = {}
        rest = []
        for one, stretch in zip(self._heard, stretch_of, strict=True):
            complete = one[0] <= covered and (stretch < now or one[0] < covered - LONGEST)
            (stretches.setdefault(stretch, []) if complete else rest).append(one)
        self._heard = rest
        levels = []
        for heard in stretches.values():
            time = round(float(np.mean([t for t, _, _ in heard])), DECIMALS)
            for m in sorted({m for _, m, _ in heard}):
                rssi = float(np.mean([r for _, b, r in heard if b == m]))
                levels.append(SeenLevel(-1, (B(m), Q(0)), time=time, beacon=m, rssi=rssi))
        return levels

    def add(
        self, level: SeenLevel, now: float
    ) -> tuple[dict[Name, gtsam.NonlinearFactor], gtsam.Values, dict[int, float]]:
        """A level that has its keyframe; priors, values and times of what is new ``now`` [s]."""
        factors: dict[Name, gtsam.NonlinearFactor] = {}
        values, noise = gtsam.Values(), gtsam.noiseModel.Diagonal.Sigmas
        if not self._met:
            values.insert(Q(0), LOSS)
            factors["loss"] = gtsam.PriorFactorVector(Q(0), LOSS, noise(LOSS_SIGMA))
        if level.beacon not in self._met:
            self._met.add(level.beacon)
            sigma, place = self.beacons.sigma[level.beacon], np.append(self.beacons.position[level.beacon], 0.0)
            values.insert(B(level.beacon), place)
            own = noise(np.array([sigma, sigma, OWN_SIGMA]))
            factors["beacon", level.beacon] = gtsam.PriorFactorVector(B(level.beacon), place, own)
        self.levels[self._count] = level
        self._count += 1
        return factors, values, {key: now for key in values.keys()}

    def again(self) -> list[SeenLevel]:
        """Begin anew with the levels that are known; these, to be added again."""
        levels, self.levels, self._met = list(self.levels.values()), {}, set()
        for level in levels:
            level.at = np.full(4, np.nan)
        return levels

    def forget(self, alive: set[int], start: float) -> None:
        """Keep the levels of the keyframes that are alive, the first at ``start`` [s]."""
        self._all = [one for one in self._all if one[0] >= start]
        self.levels = {number: level for number, level in self.levels.items() if level.keyframe in alive}

    @property
    def keys(self) -> list[int]:
        """The variables that must stay alive."""
        return [Q(0), *(B(m) for m in self._met)] if self._met else []

    @property
    def seen(self) -> Mapping[int, Observation]:
        """Its levels."""
        return self.levels

    def rows(self, pose: Array, values: gtsam.Values) -> Rows:
        """Their factors at poses ``(l, 3)`` of their keyframes."""
        levels = list(self.levels.values())
        every, nothing = np.arange(len(levels)), np.empty(0)
        b = np.array([values.atVector(level.keys[0]) for level in levels])
        rssi = np.array([level.rssi for level in levels])
        model = Levels(nothing, every, rssi, (), np.empty((0, 2)), nothing)
        return model.heard(every, pose, b, values.atVector(Q(0)))

    def state(self) -> dict[str, Any]:
        """All that it knows but the beacons, as numbers."""
        heard = {"heard": np.array(self._heard).reshape(-1, 3), "all": np.array(self._all).reshape(-1, 3)}
        levels = [[number, asdict(level)] for number, level in self.levels.items()]
        return {**heard, "met": sorted(self._met), "levels": levels, "count": self._count}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `state`, of the same beacons; every level is to be linearised."""
        self._heard, self._all = ([(t, int(m), r) for t, m, r in state[name].tolist()] for name in ("heard", "all"))
        self._met, self._count = set(state["met"]), int(state["count"])
        self.levels = {int(number): _anew(SeenLevel, level) for number, level in state["levels"]}


def _anew(kind: type[One], state: dict[str, Any]) -> One:
    """An observation of which `asdict` told; it is to be linearised."""
    return kind(**(state | {"keys": tuple(state["keys"]), "at": np.full(4, np.nan)}))
