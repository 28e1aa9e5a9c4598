"""The walker: stature and gait with their real correlations, the path on the floor, and the continuous movement.

Speed is step length times cadence. Their ratio, the walk ratio, is constant for a person over a wide range of speeds,
about 6.3 mm per step and minute (Sekiya et al. 1996). Both drift over minutes and vary from step to step; left and
right differ a little. Published spreads: step time 2–3 %, step length 3–5 % (Hausdorff 2005). The path has rounded
corners, weaves and zigzags, and may climb stairs. A sequence of activities becomes a continuous movement of the
walker's centre. The random processes of all parts of the simulator are here too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from pdr_graph.geometry import interpolate, length_along, wrap_angle
from pdr_graph.types import Array, Index, OneLineRepr, time_span


def smooth_noise(random: np.random.Generator, count: int, length: float, sigma: float, columns: int = 1) -> Array:
    """Gaussian noise ``(count, columns)`` of standard deviation ``sigma``, correlated over ``length`` samples."""
    width = length / 2
    every = max(1, int(width / 6))  # long waves are interpolated between few points
    points = np.arange(-4, count // every + 6) * every
    white = random.normal(size=(len(points), columns))
    if length < 1:
        return sigma * white[4 : count + 4]
    width = width / every
    # a Gaussian filter of this width leaves white noise with 1/√(2 √π width) of its standard deviation
    waves = gaussian_filter1d(white, width, axis=0, mode="wrap") * np.sqrt(2 * width * np.sqrt(np.pi))
    return sigma * CubicSpline(points, waves)(np.arange(count)) if every > 1 else sigma * waves[4 : count + 4]


def autoregressive_noise(random: np.random.Generator, count: int, keep: float, sigma: float, columns: int = 1) -> Array:
    """First-order autoregressive noise ``(count, columns)`` of standard deviation ``sigma``, stationary from the start.

    keep: correlation of consecutive values, 0–1.
    """
    white = random.normal(0, sigma * np.sqrt(1 - keep**2), (count, columns))
    if count:
        white[0] /= np.sqrt(1 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], white, axis=0))


Clearance = Callable[[Array], Array]  # distance to the nearest wall [m] of positions (n, 2)


@dataclass(frozen=True)
class WalkPath(OneLineRepr):
    """The curve that a pedestrian follows on the floor.

    along: ``(n,)`` length from its start [m]; position: ``(n, 2)`` [m]; height: ``(n,)`` [m];
    heading: ``(n,)`` of the tangent, unwrapped [rad].
    """

    along: Array
    position: Array
    height: Array
    heading: Array

    def _summary(self) -> list[str]:
        return [f"{self.length:.1f} m", f"{len(self.along)} points"]

    @property
    def length(self) -> float:
        """Length of the path [m]."""
        return float(self.along[-1])

    def heading_change(self, begin: float, end: float) -> float:
        """Change of heading between two lengths along the path [m]; unwrapped [rad]."""
        before, after = np.interp([begin, end], self.along, self.heading)
        return float(after - before)


SPACING = 0.05  # [m] between points of a path


def walk_path(
    corners: Array,
    heights: Array,
    zigzag: Array,
    random: np.random.Generator,
    clearance: Clearance | None = None,
    rounding: float = 0.45,
) -> WalkPath:
    """The path of a pedestrian along ``corners (k, 2)`` [m] at ``heights (k,)`` [m]; docs/simulation.md compares walks.

    Corners are rounded over ``rounding`` [m]; people weave by 0.12 m, correlated over 6 m, and keep 0.35 m from walls.

    zigzag: ``(k - 1,)`` amplitude of swinging from side to side on each leg [m], with a period of about 6 m.
    clearance: distance to the nearest wall; offsets to the side are reduced where less than 0.35 m is left.
    """
    length = length_along(corners)
    count = max(3, round(length[-1] / SPACING) + 1)
    s = np.linspace(0.0, length[-1], count)
    straight = interpolate(s, length, corners)
    line = gaussian_filter1d(straight, min(rounding, length[-1] / 8) / SPACING, axis=0, mode="nearest")
    line = line + _ends(s, straight[0] - line[0], straight[-1] - line[-1])
    offset = smooth_noise(random, count, 6.0 / SPACING, 0.12)[:, 0]
    leg = np.clip(np.searchsorted(length, s, side="right") - 1, 0, len(zigzag) - 1)
    swinging = np.sin(2 * np.pi * s / random.uniform(5, 7) + random.uniform(0, 2 * np.pi))
    offset = offset + gaussian_filter1d(zigzag[leg], 1.0 / SPACING, mode="nearest") * swinging
    offset *= np.clip(np.minimum(s, s[-1] - s) / 1.5, 0, 1)  # the path begins and ends at the given corners
    tangent = np.gradient(line, axis=0)
    left = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    left /= np.maximum(np.hypot(*left.T), 1e-9)[:, None]
    if clearance is not None:
        for _ in range(5):
            offset[clearance(line + offset[:, None] * left) < 0.35] /= 2
    position = gaussian_filter1d(line + offset[:, None] * left, 0.3 / SPACING, axis=0, mode="nearest")
    position = position + _ends(s, corners[0] - position[0], corners[-1] - position[-1])
    tangent = np.gradient(position, SPACING, axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    return WalkPath(length_along(position), position, np.interp(s, length, heights), heading)


def _ends(s: Array, at_start: Array, at_end: Array) -> Array:
    """A correction ``(n, 2)`` [m] at both ends that fades out within half a metre."""
    fade = [np.clip(1 - d / 0.5, 0, 1)[:, None] for d in (s, s[-1] - s)]
    return fade[0] * at_start + fade[1] * at_end


@dataclass(frozen=True)
class Manner:
    """A manner of moving: factors of the walker's own cadence, step length, and spread from step to step.

    flight: share of a step in which no foot touches the ground; 0 in walking.
    """

    cadence: float = 1.0
    length: float = 1.0
    spread: float = 1.0
    flight: float = 0.0


# Browsing people take steps that are shorter by a factor of 1.2 to 1.4 than their cadence suggests
MANNERS = {
    "normal": Manner(),
    "fast": Manner(1.12, 1.10),
    "slow": Manner(0.88, 0.87),
    "browse": Manner(0.80, 0.58, 2.0),
    "narrow": Manner(0.97, 0.75),  # asked to take short or long steps: [calibration-walk] Sec. 4.1
    "wide": Manner(0.97, 1.25),
    "stairs": Manner(0.90, 0.45, 0.7),
    # 2.4, 3.2 and 4.4 m/s at 2.6, 2.75 and 3.1 steps/s (Cavagna et al. 1988, 2005: step frequency, flight by speed)
    "jog": Manner(1.41, 1.31, 0.7, 0.25),
    "run": Manner(1.49, 1.65, 0.7, 0.33),
    "sprint": Manner(1.68, 2.02, 0.7, 0.40),
}


@dataclass(frozen=True)
class Pedestrian:
    """A person.

    height [m]; sex: "f" or "m"; cadence: steps per second at ease [Hz]; step_length: at that cadence [m];
    bounce: vertical amplitude relative to most people; asymmetry: left steps are longer by this share.
    """

    height: float
    sex: str
    cadence: float
    step_length: float
    bounce: float = 1.0
    asymmetry: float = 0.0

    @classmethod
    def sample(cls, random: np.random.Generator, height: float | None = None, sex: str | None = None) -> Pedestrian:
        """Draw a person at random; height [m] and sex are drawn too if None."""
        sex = sex or str(random.choice(["f", "m"]))
        usual, spread, usual_cadence = {"f": (1.65, 0.065, 1.89), "m": (1.78, 0.07, 1.80)}[sex]  # [m], [m], [Hz]
        height = float(height or random.normal(usual, spread))
        # geometric similarity: step length grows with the stature, cadence falls with its square root
        cadence = random.normal(usual_cadence, 0.13) * np.sqrt(usual / height)
        ratio = 0.38 * (height / 1.70) ** 1.5 * np.exp(random.normal(0, 0.05))  # [m·s] step length over cadence
        bounce, asymmetry = np.exp(random.normal(0, 0.22)), random.normal(0, 0.012)
        return cls(height, sex, float(cadence), float(ratio * cadence), float(bounce), float(asymmetry))


@dataclass(frozen=True)
class Footfalls(OneLineRepr, row="step"):
    """The landings of one walk from standing to standing. The last step brings the feet together.

    time: ``(n,)`` of each landing, from the start [s]; along: ``(n,)`` position of the body along the path [m];
    flight: ``(n,)`` share of the step before it in which no foot touches the ground.
    """

    time: Array
    along: Array
    flight: Array


SHORTEST_STEP = 0.15  # [m]


def footfalls(
    walker: Pedestrian, path: WalkPath, manner_at: Callable[[float], Manner], random: np.random.Generator
) -> Footfalls:
    """The steps of a walker along a path, until the feet are together again.

    Length and period drift by 2.5 % over 60 steps, and vary by 4 % and 2.8 % from step to step (Hausdorff 2005). In a
    turn a step is shorter: [map-matching] Eq. (2). The first step is shorter too.

    manner_at: the manner of walking at a length along the path [m].
    """
    most = int(path.length / (SHORTEST_STEP / 2)) + 4
    drift = autoregressive_noise(random, most, np.exp(-1 / 60), 0.025, 2).T
    left = np.where(np.arange(most) % 2, 0.5, -0.5) * walker.asymmetry
    length = walker.step_length * (1 + left) * np.exp(drift[0])
    period = (1 - left) / walker.cadence * np.exp(-0.5 * drift[0] + drift[1])
    length_noise, period_noise = random.normal(0, 0.040, most), random.normal(0, 0.028, most)
    time, along, flight, t, s = list[float](), list[float](), list[float](), 0.0, 0.0
    for k in range(most):
        manner = manner_at(s)
        step = length[k] * manner.length * (1 + manner.spread * length_noise[k]) * (0.6 if k == 0 else 1.0)
        turn = abs(np.degrees(float(path.heading_change(s, s + step))))
        step = max(step * (1 - 1.124 / 100 * min(turn, 60.0)), SHORTEST_STEP)
        t += period[k] / manner.cadence * (1 + manner.spread * period_noise[k])
        s += step
        flight.append(manner.flight)
        if s > path.length - 0.4 * step:  # the shortest with which the feet close
            break
        time.append(t)
        along.append(s)
    return Footfalls(np.array([*time, t]), np.array([*along, path.length]), np.array(flight))


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
    of the current step, 0 at rest [m]; flight: ``(n,)`` share of it without a foot on the ground; rolling: ``(n,)``
    speed of a cart [m/s]; floors: labels in order of visit; floor: ``(n,)`` index into them.
    landings: ``(s,)`` times [s]; lengths: ``(s,)`` of the step that ends there [m]; events: sorted by time.
    """

    rate: float
    time: Array
    position: Array
    height: Array
    heading: Array
    phase: Array
    step_length: Array
    flight: Array
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
    mover = _Mover(walker, np.asarray(start, dtype=float), heading, [floor], rate, random, clearances or {})
    mover.events.append(Event(0.0, 0.0, "hold", hold))
    for activity in activities:
        mover.add(activity)
    whole: dict[str, Any] = {name: np.concatenate([piece[name] for piece in mover.pieces]) for name in QUANTITIES}
    for name in ("position", "height", "heading", "step_length", "flight"):
        whole[name] = gaussian_filter1d(whole[name], 0.10 * rate, axis=0, mode="nearest")  # rounds all movement
    return Body(
        rate=rate,
        time=np.arange(mover.samples) / rate,
        **whole | {"floor": whole["floor"].astype(int)},
        floors=tuple(mover.floors),
        landings=np.concatenate([*mover.landings, np.empty(0)]),
        lengths=np.concatenate([*mover.lengths, np.empty(0)]),
        events=tuple(sorted(mover.events, key=lambda event: event.start)),
    )


# Arrays of each piece of the movement
QUANTITIES = ("position", "height", "heading", "phase", "step_length", "flight", "rolling", "floor")


@dataclass
class _Mover:
    """State of the walker, and the pieces of the movement so far: one array per quantity and piece."""

    walker: Pedestrian
    place: Array
    heading: float
    floors: list[str]
    rate: float
    random: np.random.Generator
    clearances: Mapping[str, Clearance]
    events: list[Event] = field(default_factory=list)
    height: float = 0.0
    strides: float = 0.0
    samples: int = 0
    pieces: list[dict[str, Array]] = field(default_factory=list)
    landings: list[Array] = field(default_factory=list)
    lengths: list[Array] = field(default_factory=list)

    def add(self, activity: Activity) -> None:
        """Do an activity. Speeds and accelerations of lifts and carts are chosen by hand."""
        match activity:
            case Walk():
                self.walk(activity)
            case Stand():
                self.stand(activity.seconds, activity.turn, activity.event)
            case Ride():
                climb = _trapezoid(abs(activity.climb), 1.6, 0.9, self.rate) * np.sign(activity.climb)
                self.floors.append(activity.floor)
                arrived = np.arange(len(climb)) >= len(climb) // 2
                self._add(len(climb), height=self.height + climb, floor=len(self.floors) - 2 + arrived)
                self.height += activity.climb
            case Roll():  # a cart keeps its heading whichever way it moves
                move = activity.end - self.place
                distance = float(np.hypot(*move))
                along = _trapezoid(distance, abs(activity.speed), 0.5, self.rate)
                speed = np.gradient(along) * self.rate
                self._add(len(along), position=self.place + along[:, None] * move / distance, rolling=speed)
                self.place = activity.end
            case ChangeHold():
                self._change_hold(activity.hold, self.now)
                self.stand(HOLD_CHANGE_TIME)
            case Shake():
                self.stand(activity.seconds, event="shake")

    def walk(self, walk: Walk) -> None:
        """Walk along the corners, from standing to standing."""
        clearance = self.clearances.get(self.floors[-1])
        manners = [MANNERS[name] for name in walk.manners]
        wide = 0.45 + 5 * max(manner.flight for manner in manners)  # [m]: runners take corners at 1 g at most
        path = walk_path(walk.corners, walk.heights + self.height, walk.zigzag, self.random, clearance, wide)
        turn = float(wrap_angle(path.heading[0] - self.heading))
        if abs(turn) > 0.02:
            self.stand(0.0, turn)
        first_floor = len(self.floors) - 1
        if walk.floor and walk.floor != self.floors[-1]:
            self.floors.append(walk.floor)
        legs = length_along(walk.corners)[1:]
        ends = legs * path.length / legs[-1]  # the legs of the path have the proportions of the corners
        falls = footfalls(
            self.walker,
            path,
            lambda s: manners[min(int(np.searchsorted(ends, s, side="right")), len(manners) - 1)],
            self.random,
        )
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
            flight=falls.flight[current],
            floor=np.where(along < path.length / 2, first_floor, len(self.floors) - 1),  # half-way, as in a lift
        )
        self.landings.append(begin + falls.time)
        self.lengths.append(lengths)
        self.strides += len(falls.time) / 2
        self.place, self.height = path.position[-1], float(path.height[-1])
        self.heading += float(path.heading[-1] - path.heading[0])
        if walk.new_hold:
            self._change_hold(walk.new_hold, begin + t[-1] / 2)

    def stand(self, seconds: float, turn: float = 0.0, event: str = "") -> None:
        """Stand for some seconds, and turn on the spot by ``turn`` [rad] at up to 1.8 rad/s; event: as of `Stand`."""
        begin, t = self.now, self._times(max(seconds, abs(turn) / 1.8))
        share = t / max(t[-1], 1e-9)
        smooth = share**3 * (10 - 15 * share + 6 * share**2)  # velocity and acceleration are 0 at both ends
        self._add(len(t), heading=self.heading + turn * smooth)
        self.heading += turn
        if event:
            kind, _, what = event.partition(" ")
            self.events.append(Event(begin, self.now, kind, what))

    def _change_hold(self, hold: str, begin: float) -> None:
        self.events.append(Event(begin, begin + HOLD_CHANGE_TIME, "hold", hold))

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
