"""The body in motion: an itinerary becomes a continuous movement of the walker's middle."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from pdr_graph.geometry import interpolate, wrap_angle
from pdr_graph.simulation.pedestrian import MANNERS, Clearance, Manner, Walker, Way, footfalls, way_along
from pdr_graph.types import Array, Index

TURNING = 1.8  # [rad/s] on the spot
FACING = 0.02  # [rad] that one need not turn before setting off
REHOLD = 1.4  # [s] to take the phone from one place to another
SMOOTHING = 0.10  # [s] by which no body changes its speed
LIFT_SPEED, LIFT_ACCELERATION = 1.6, 0.9  # [m/s], [m/s²]
CART_ACCELERATION = 0.5  # [m/s²]
QUANTITIES = ("position", "height", "heading", "phase", "step_length", "rolling", "floor")  # of a piece of the movement


@dataclass(frozen=True)
class Walk:
    """Go along corners ``(k, 2)`` [m], the first of which is where one stands.

    heights: ``(k,)`` above there [m]; manners: how, on each of the k − 1 legs; zigzag: ``(k - 1,)`` [m];
    rehold: the phone is taken otherwise half-way; floor: where it ends, "" for where it began.
    """

    corners: Array
    heights: Array
    manners: tuple[str, ...]
    zigzag: Array
    rehold: str = ""
    floor: str = ""


@dataclass(frozen=True)
class Stand:
    """Stay for some seconds, and turn [rad] by so much on the spot, to the left. event: what it is, for the record."""

    seconds: float
    turn: float = 0.0
    event: str = ""


@dataclass(frozen=True)
class Ride:
    """Be carried in a lift by ``climb`` [m] to another floor."""

    climb: float
    floor: str


@dataclass(frozen=True)
class Roll:
    """Push a cart straight to a place ``(2,)`` [m] at a constant speed [m/s]; it does not turn."""

    end: Array
    speed: float


@dataclass(frozen=True)
class Take:
    """Hold the phone otherwise."""

    hold: str


@dataclass(frozen=True)
class Shake:
    """Wave the phone about, as some apps want for their calibration."""

    seconds: float


Stretch = Walk | Stand | Ride | Roll | Take | Shake


@dataclass(frozen=True)
class Event:
    """Something that happened from ``start`` to ``end`` [s]: a visit, a shaking, a hold of the phone."""

    start: float
    end: float
    kind: str
    what: str


@dataclass(frozen=True)
class Body:
    """The walker's middle at a steady rate, and where the feet landed.

    time: ``(n,)`` [s]; position: ``(n, 2)``, height: ``(n,)`` of the floor under it [m]; heading: ``(n,)`` the
    walking direction, unwrapped [rad]; phase: ``(n,)`` strides so far, half a stride per step; step_length: ``(n,)``
    of the step under way, 0 at rest [m]; rolling: ``(n,)`` speed of a cart [m/s]; floors: labels;
    floor: ``(n,)`` which.
    landings: ``(s,)`` [s]; lengths: ``(s,)`` [m], of the step that ends there; events: in order of time.
    """

    rate: float
    time: Array
    position: Array
    height: Array
    heading: Array
    phase: Array
    step_length: Array
    rolling: Array
    floors: tuple[str, ...]
    floor: Index
    landings: Array
    lengths: Array
    events: tuple[Event, ...]

    def during(self, kind: str) -> tuple[Event, ...]:
        """The events of a kind."""
        return tuple(event for event in self.events if event.kind == kind)


def move(
    walker: Walker,
    stretches: Sequence[Stretch],
    start: Array,
    heading: float,
    floor: str,
    hold: str,
    rate: float,
    random: np.random.Generator,
    clearances: Mapping[str, Clearance] | None = None,
) -> Body:
    """The movement of a walker who does one thing after the other.

    start: ``(2,)`` [m]; heading [rad], floor and hold of the phone there; rate [Hz]; clearances: by floor.
    """
    held = [Event(0.0, 0.0, "hold", hold)]
    mover = _Mover(walker, np.asarray(start, dtype=float), heading, [floor], held, rate, random, clearances or {})
    for stretch in stretches:
        match stretch:
            case Walk():
                mover.walk(stretch)
            case Stand():
                mover.stand(stretch)
            case Ride():
                mover.ride(stretch)
            case Roll():
                mover.roll(stretch)
            case Take():
                mover.take(stretch.hold)
                mover.stand(Stand(REHOLD))
            case Shake():
                mover.stand(Stand(stretch.seconds, event="shake"))
    return mover.body()


@dataclass
class _Mover:
    """Where the walker is, and the pieces of the movement so far: one array per quantity and piece."""

    walker: Walker
    where: Array
    heading: float
    floors: list[str]
    events: list[Event]
    rate: float
    random: np.random.Generator
    clearances: Mapping[str, Clearance]
    height: float = 0.0
    strides: float = 0.0
    samples: int = 0
    pieces: list[dict[str, Array]] = field(default_factory=list)
    landings: list[Array] = field(default_factory=list)
    lengths: list[Array] = field(default_factory=list)

    def walk(self, stretch: Walk) -> None:
        """From standing to standing along the corners."""
        clearance = self.clearances.get(self.floors[-1])
        way = way_along(stretch.corners, stretch.heights + self.height, stretch.zigzag, self.random, clearance)
        self.face(way.heading[0])
        begun_on = len(self.floors) - 1
        if stretch.floor and stretch.floor != self.floors[-1]:
            self.floors.append(stretch.floor)
        falls = footfalls(self.walker, way, _manners(stretch, way), self.random)
        begun, t = self.now, self._times(falls.time[-1])
        knots = np.concatenate([[0.0], falls.time])
        still = np.concatenate([[-1.0], knots, [knots[-1] + 1.0]])  # they stand before and after: speed begins at 0
        along = PchipInterpolator(still, np.concatenate([[0.0, 0.0], falls.along, falls.along[-1:]]))(t)
        lengths = np.diff(falls.along, prepend=0.0)
        under_way = np.minimum(np.searchsorted(falls.time, t, side="right"), len(falls.time) - 1)
        self._add(
            len(t),
            position=interpolate(along, way.along, way.position),
            height=np.interp(along, way.along, way.height),
            heading=np.interp(along, way.along, way.heading) + self.heading - way.heading[0],
            phase=self.strides + np.interp(t, knots, np.arange(len(knots)) / 2),
            step_length=lengths[under_way],
            floor=np.where(along < way.length / 2, begun_on, len(self.floors) - 1),  # half-way up, as in a lift
        )
        self.landings.append(begun + falls.time)
        self.lengths.append(lengths)
        self.strides += len(falls.time) / 2
        self.where, self.height = way.position[-1], float(way.height[-1])
        self.heading += float(way.heading[-1] - way.heading[0])
        if stretch.rehold:
            self.take(stretch.rehold, begun + t[-1] / 2)

    def stand(self, stretch: Stand) -> None:
        """Stay, and turn on the spot."""
        begun, t = self.now, self._times(max(stretch.seconds, abs(stretch.turn) / TURNING))
        self._add(len(t), heading=self.heading + stretch.turn * _eased(t / max(t[-1], 1e-9)))
        self.heading += stretch.turn
        if stretch.event:
            kind, _, what = stretch.event.partition(" ")
            self.events.append(Event(begun, self.now, kind, what))

    def face(self, heading: float) -> None:
        """Turn on the spot towards a direction, the shorter way round."""
        turn = float(wrap_angle(heading - self.heading))
        if abs(turn) > FACING:
            self.stand(Stand(0.0, turn))

    def take(self, hold: str, time: float | None = None) -> None:
        """Hold the phone otherwise."""
        begun = self.now if time is None else time
        self.events.append(Event(begun, begun + REHOLD, "hold", hold))

    def ride(self, stretch: Ride) -> None:
        """Up or down in a lift."""
        climb = _trapezoid(abs(stretch.climb), LIFT_SPEED, LIFT_ACCELERATION, self.rate) * np.sign(stretch.climb)
        self.floors.append(stretch.floor)
        arrived = np.arange(len(climb)) >= len(climb) // 2
        self._add(len(climb), height=self.height + climb, floor=len(self.floors) - 2 + arrived)
        self.height += stretch.climb

    def roll(self, stretch: Roll) -> None:
        """Push a cart; its phone looks ahead, whichever way it goes."""
        move = stretch.end - self.where
        distance = float(np.hypot(*move))
        along = _trapezoid(distance, abs(stretch.speed), CART_ACCELERATION, self.rate)
        speed = np.gradient(along) * self.rate
        self._add(len(along), position=self.where + along[:, None] * move / distance, rolling=speed)
        self.where = stretch.end

    def body(self) -> Body:
        """The whole movement."""
        whole = {name: np.concatenate([piece[name] for piece in self.pieces]) for name in QUANTITIES}
        smooth = SMOOTHING * self.rate
        for name in ("position", "height", "heading", "step_length"):
            whole[name] = gaussian_filter1d(whole[name], smooth, axis=0, mode="nearest")
        return Body(
            rate=self.rate,
            time=np.arange(self.samples) / self.rate,
            position=whole["position"],
            height=whole["height"],
            heading=whole["heading"],
            phase=whole["phase"],
            step_length=whole["step_length"],
            rolling=whole["rolling"],
            floors=tuple(self.floors),
            floor=whole["floor"].astype(int),
            landings=np.concatenate([*self.landings, np.empty(0)]),
            lengths=np.concatenate([*self.lengths, np.empty(0)]),
            events=tuple(sorted(self.events, key=lambda event: event.start)),
        )

    def _add(self, count: int, **values: Array | Index | float) -> None:
        """A piece of ``count`` samples; what is not given stays as it is."""
        still: dict[str, Array | Index | float] = {
            "position": self.where,
            "height": self.height,
            "heading": self.heading,
            "phase": self.strides,
            "floor": len(self.floors) - 1,
        }
        shapes = {name: (count, 2) if name == "position" else (count,) for name in QUANTITIES}
        given = still | values
        self.pieces.append({name: np.broadcast_to(given.get(name, 0.0), shape) for name, shape in shapes.items()})
        self.samples += count

    def _times(self, seconds: float) -> Array:
        """Times within a piece that is so long."""
        return np.arange(max(2, round(seconds * self.rate) + 1)) / self.rate

    @property
    def now(self) -> float:
        """[s]"""
        return self.samples / self.rate


def _manners(stretch: Walk, way: Way) -> Callable[[float], Manner]:
    """How one goes at each place of a way: its legs in the proportions of the corners'."""
    legs = np.cumsum(np.hypot(*np.diff(stretch.corners, axis=0).T))
    ends = legs * way.length / legs[-1]
    manners = [MANNERS[name] for name in stretch.manners]
    return lambda s: manners[min(int(np.searchsorted(ends, s, side="right")), len(manners) - 1)]


def _eased(share: Array) -> Array:
    """From 0 to 1 without a jerk."""
    return share**3 * (10 - 15 * share + 6 * share**2)


def _trapezoid(distance: float, speed: float, acceleration: float, rate: float) -> Array:
    """Distance covered from rest to rest at a speed that is reached and left evenly. [m]"""
    if distance == 0:
        return np.zeros(2)
    speed = min(speed, np.sqrt(acceleration * distance))
    ramp, cruise = speed / acceleration, distance / speed - speed / acceleration
    t = np.arange(round((2 * ramp + cruise) * rate) + 1) / rate
    velocity = speed * np.clip(np.minimum(t, 2 * ramp + cruise - t) / ramp, 0, 1)
    along = np.cumsum(velocity) / rate
    return along * distance / along[-1]
