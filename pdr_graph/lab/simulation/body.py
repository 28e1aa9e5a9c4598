"""The body in motion: a sequence of activities becomes a continuous movement of the walker's centre."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from pdr_graph.geometry import interpolate, wrap_angle
from pdr_graph.lab.simulation.pedestrian import MANNERS, Clearance, Manner, Pedestrian, WalkPath, footfalls, walk_path
from pdr_graph.types import Array, Index, OneLineRepr, time_span

HOLD_CHANGE_TIME = 1.4  # [s] to move the phone from one hold to another; chosen by hand


@dataclass(frozen=True)
class Walk:
    """Walk along corners ``(k, 2)`` [m] from the first, which is the current position.

    heights: ``(k,)`` above the first [m]; manners: of each of the k − 1 legs; zigzag: ``(k - 1,)`` amplitude [m];
    new_hold: of the phone from half-way on, "" for no change; floor: at the end, "" for the same.
    """

    corners: Array
    heights: Array
    manners: tuple[str, ...]
    zigzag: Array
    new_hold: str = ""
    floor: str = ""


@dataclass(frozen=True)
class Stand:
    """Stand for some seconds [s] and turn on the spot to the left [rad]. event: kind and name, for `Body.events`."""

    seconds: float
    turn: float = 0.0
    event: str = ""


@dataclass(frozen=True)
class Ride:
    """Ride a lift up by ``climb`` [m] to another floor."""

    climb: float
    floor: str


@dataclass(frozen=True)
class Roll:
    """Push a cart straight to ``end (2,)`` [m] at a constant speed [m/s]; it does not turn."""

    end: Array
    speed: float


@dataclass(frozen=True)
class ChangeHold:
    """Change the hold of the phone."""

    hold: str


@dataclass(frozen=True)
class Shake:
    """Wave the phone for some seconds [s], as some apps ask for their calibration."""

    seconds: float


Activity = Walk | Stand | Ride | Roll | ChangeHold | Shake


@dataclass(frozen=True)
class Event:
    """An event from ``start`` to ``end`` [s]. kind: visit, stand, shake or hold; what: the shop or the hold."""

    start: float
    end: float
    kind: str
    what: str


@dataclass(frozen=True)
class Body(OneLineRepr):
    """The movement of the walker's centre, sampled uniformly, and the landings of the feet.

    rate [Hz]; time: ``(n,)`` [s]; position: ``(n, 2)`` [m]; height: ``(n,)`` of the floor below [m]; heading: ``(n,)``
    walking direction, unwrapped [rad]; phase: ``(n,)`` strides so far, half a stride per step; step_length: ``(n,)``
    of the current step, 0 at rest [m]; rolling: ``(n,)`` speed of a cart [m/s]; floors: labels in order of visit;
    floor: ``(n,)`` index into them.
    landings: ``(s,)`` times [s]; lengths: ``(s,)`` of the step that ends there [m]; events: sorted by time.
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

    def _summary(self) -> list[str]:
        return [*time_span(self), f"{self.rate:g} Hz", f"{len(self.landings)} steps", f"{self.lengths.sum():.0f} m"]

    def events_of(self, kind: str) -> tuple[Event, ...]:
        """The events of one kind."""
        return tuple(event for event in self.events if event.kind == kind)


def move(
    walker: Pedestrian,
    activities: Sequence[Activity],
    start: Array,
    heading: float,
    floor: str,
    hold: str,
    rate: float,
    random: np.random.Generator,
    clearances: Mapping[str, Clearance] | None = None,
) -> Body:
    """The movement of a walker who does one activity after the other.

    start: ``(2,)`` [m]; heading [rad], floor and hold of the phone there; rate [Hz]; clearances: by floor label.
    """
    events = [Event(0.0, 0.0, "hold", hold)]
    mover = _Mover(walker, np.asarray(start, dtype=float), heading, [floor], events, rate, random, clearances or {})
    for activity in activities:
        match activity:
            case Walk():
                mover.walk(activity)
            case Stand():
                mover.stand(activity)
            case Ride():
                mover.ride(activity)
            case Roll():
                mover.roll(activity)
            case ChangeHold():
                mover.change_hold(activity.hold)
                mover.stand(Stand(HOLD_CHANGE_TIME))
            case Shake():
                mover.stand(Stand(activity.seconds, event="shake"))
    return mover.body()


# Arrays of each piece of the movement
QUANTITIES = ("position", "height", "heading", "phase", "step_length", "rolling", "floor")


@dataclass(frozen=True)
class Dynamics:
    """Speeds and accelerations of bodies, lifts and carts. Chosen by hand.

    turning: rate of turning on the spot [rad/s]; aligned: angle below which nobody turns before walking [rad];
    smoothing: standard deviation of the filter that rounds all movement [s]; lift_speed [m/s]; lift_acceleration,
    cart_acceleration [m/s²].
    """

    turning: float = 1.8
    aligned: float = 0.02
    smoothing: float = 0.10
    lift_speed: float = 1.6
    lift_acceleration: float = 0.9
    cart_acceleration: float = 0.5


DYNAMICS = Dynamics()


@dataclass
class _Mover:
    """State of the walker, and the pieces of the movement so far: one array per quantity and piece."""

    walker: Pedestrian
    place: Array
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

    def walk(self, walk: Walk) -> None:
        """Walk along the corners, from standing to standing."""
        clearance = self.clearances.get(self.floors[-1])
        path = walk_path(walk.corners, walk.heights + self.height, walk.zigzag, self.random, clearance)
        self.face(path.heading[0])
        first_floor = len(self.floors) - 1
        if walk.floor and walk.floor != self.floors[-1]:
            self.floors.append(walk.floor)
        falls = footfalls(self.walker, path, _manners(walk, path), self.random)
        begin, t = self.now, self._times(falls.time[-1])
        knots = np.concatenate([[0.0], falls.time])
        padded = np.concatenate([[-1.0], knots, [knots[-1] + 1.0]])  # rest before and after: the speed starts at 0
        along = PchipInterpolator(padded, np.concatenate([[0.0, 0.0], falls.along, falls.along[-1:]]))(t)
        lengths = np.diff(falls.along, prepend=0.0)
        current = np.minimum(np.searchsorted(falls.time, t, side="right"), len(falls.time) - 1)
        self._add(
            len(t),
            position=interpolate(along, path.along, path.position),
            height=np.interp(along, path.along, path.height),
            heading=np.interp(along, path.along, path.heading) + self.heading - path.heading[0],
            phase=self.strides + np.interp(t, knots, np.arange(len(knots)) / 2),
            step_length=lengths[current],
            floor=np.where(along < path.length / 2, first_floor, len(self.floors) - 1),  # half-way, as in a lift
        )
        self.landings.append(begin + falls.time)
        self.lengths.append(lengths)
        self.strides += len(falls.time) / 2
        self.place, self.height = path.position[-1], float(path.height[-1])
        self.heading += float(path.heading[-1] - path.heading[0])
        if walk.new_hold:
            self.change_hold(walk.new_hold, begin + t[-1] / 2)

    def stand(self, stand: Stand) -> None:
        """Stand, and turn on the spot."""
        begin, t = self.now, self._times(max(stand.seconds, abs(stand.turn) / DYNAMICS.turning))
        self._add(len(t), heading=self.heading + stand.turn * _smooth_step(t / max(t[-1], 1e-9)))
        self.heading += stand.turn
        if stand.event:
            kind, _, what = stand.event.partition(" ")
            self.events.append(Event(begin, self.now, kind, what))

    def face(self, heading: float) -> None:
        """Turn on the spot to a heading [rad], in the direction of the smaller angle."""
        turn = float(wrap_angle(heading - self.heading))
        if abs(turn) > DYNAMICS.aligned:
            self.stand(Stand(0.0, turn))

    def change_hold(self, hold: str, time: float | None = None) -> None:
        """Change the hold of the phone, from `time` [s] or from now on."""
        begin = self.now if time is None else time
        self.events.append(Event(begin, begin + HOLD_CHANGE_TIME, "hold", hold))

    def ride(self, ride: Ride) -> None:
        """Ride a lift up or down."""
        speed, acceleration = DYNAMICS.lift_speed, DYNAMICS.lift_acceleration
        climb = _trapezoid(abs(ride.climb), speed, acceleration, self.rate) * np.sign(ride.climb)
        self.floors.append(ride.floor)
        arrived = np.arange(len(climb)) >= len(climb) // 2
        self._add(len(climb), height=self.height + climb, floor=len(self.floors) - 2 + arrived)
        self.height += ride.climb

    def roll(self, roll: Roll) -> None:
        """Push a cart, which keeps its heading whichever way it moves."""
        move = roll.end - self.place
        distance = float(np.hypot(*move))
        along = _trapezoid(distance, abs(roll.speed), DYNAMICS.cart_acceleration, self.rate)
        speed = np.gradient(along) * self.rate
        self._add(len(along), position=self.place + along[:, None] * move / distance, rolling=speed)
        self.place = roll.end

    def body(self) -> Body:
        """Join all pieces to the whole movement, smoothed."""
        whole = {name: np.concatenate([piece[name] for piece in self.pieces]) for name in QUANTITIES}
        smooth = DYNAMICS.smoothing * self.rate
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
        """Add a piece of ``count`` samples; quantities that are not in `values` stay constant."""
        constant: dict[str, Array | Index | float] = {
            "position": self.place,
            "height": self.height,
            "heading": self.heading,
            "phase": self.strides,
            "floor": len(self.floors) - 1,
        }
        shapes = {name: (count, 2) if name == "position" else (count,) for name in QUANTITIES}
        piece = constant | values
        self.pieces.append({name: np.broadcast_to(piece.get(name, 0.0), shape) for name, shape in shapes.items()})
        self.samples += count

    def _times(self, seconds: float) -> Array:
        """Sample times within a piece of this length, from 0 [s]."""
        return np.arange(max(2, round(seconds * self.rate) + 1)) / self.rate

    @property
    def now(self) -> float:
        """The end of the movement so far [s]."""
        return self.samples / self.rate


def _manners(walk: Walk, path: WalkPath) -> Callable[[float], Manner]:
    """The manner of walking at each length along a path [m], whose legs have the proportions of the corners."""
    legs = np.cumsum(np.hypot(*np.diff(walk.corners, axis=0).T))
    ends = legs * path.length / legs[-1]
    manners = [MANNERS[name] for name in walk.manners]
    return lambda s: manners[min(int(np.searchsorted(ends, s, side="right")), len(manners) - 1)]


def _smooth_step(share: Array) -> Array:
    """From 0 to 1 with zero velocity and acceleration at both ends."""
    return share**3 * (10 - 15 * share + 6 * share**2)


def _trapezoid(distance: float, speed: float, acceleration: float, rate: float) -> Array:
    """Distance covered from rest to rest [m], with constant acceleration to `speed` [m/s] and back."""
    if distance == 0:
        return np.zeros(2)
    speed = min(speed, np.sqrt(acceleration * distance))
    ramp, cruise = speed / acceleration, distance / speed - speed / acceleration
    t = np.arange(round((2 * ramp + cruise) * rate) + 1) / rate
    velocity = speed * np.clip(np.minimum(t, 2 * ramp + cruise - t) / ramp, 0, 1)
    along = np.cumsum(velocity) / rate
    return along * distance / along[-1]
