"""The pedestrian: stature, stride and cadence with their real correlations, and the path along a route's corners.

Speed is step length times cadence, and the two go together: their ratio is a person's constant over a wide range of
speeds, the walk ratio, about 6.3 mm per step and minute (Sekiya et al. 1996). Both wander over minutes and vary from
step to step; left and right differ a little. Published spreads: step time 2–3 %, step length 3–5 % (Hausdorff 2005).
The path is rounded, weaving, zigzagging, and goes up stairs. Random processes that several parts of the simulator draw
are here too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from pdr_graph.geometry import interpolate, length_along
from pdr_graph.types import Array


def slow(random: np.random.Generator, count: int, length: float, sigma: float, columns: int = 1) -> Array:
    """Smooth noise ``(count, columns)`` of standard deviation ``sigma`` that changes over ``length`` samples."""
    width = length / 2
    every = max(1, int(width / 6))  # a long wave needs few points
    points = np.arange(-4, count // every + 6) * every
    white = random.normal(size=(len(points), columns))
    if length < 1:
        return sigma * white[4 : count + 4]
    width = width / every
    # a Gaussian filter of this width leaves white noise with 1/√(2 √π width) of its standard deviation
    waves = gaussian_filter1d(white, width, axis=0, mode="wrap") * np.sqrt(2 * width * np.sqrt(np.pi))
    return sigma * CubicSpline(points, waves)(np.arange(count)) if every > 1 else sigma * waves[4 : count + 4]


def autoregressive(random: np.random.Generator, count: int, keep: float, sigma: float, columns: int = 1) -> Array:
    """First-order autoregressive noise ``(count, columns)`` of standard deviation ``sigma``, stationary from the start.

    keep: correlation of neighbours, 0–1.
    """
    white = random.normal(0, sigma * np.sqrt(1 - keep**2), (count, columns))
    if count:
        white[0] /= np.sqrt(1 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], white, axis=0))


SPACING = 0.05  # [m] between points of a way
ROUNDING = 0.45  # [m] over which a corner is rounded
WEAVE, WEAVE_LENGTH = 0.12, 6.0  # [m] to the side of the straight line, and over which way it changes
CLEARANCE = 0.35  # [m] that people keep from walls
Clearance = Callable[[Array], Array]  # distance to the nearest wall [m] of positions (n, 2)


@dataclass(frozen=True)
class Way:
    """A curve on the floor.

    along: ``(n,)`` length from its start [m]; position: ``(n, 2)`` [m]; height: ``(n,)`` [m];
    heading: ``(n,)`` of its tangent, unwrapped [rad].
    """

    along: Array
    position: Array
    height: Array
    heading: Array

    @property
    def length(self) -> float:
        """Its length. [m]"""
        return float(self.along[-1])

    def turned(self, begin: float, end: float) -> float:
        """Change of heading between two places on the way. [rad]"""
        before, after = np.interp([begin, end], self.along, self.heading)
        return float(after - before)


def way_along(
    corners: Array,
    heights: Array,
    zigzag: Array,
    random: np.random.Generator,
    clearance: Clearance | None = None,
) -> Way:
    """Somebody's way along ``corners (k, 2)`` [m] at ``heights (k,)`` [m].

    zigzag: ``(k - 1,)`` amplitude of swinging from side to side on each leg [m], about every 6 m.
    clearance: distance to the nearest wall; the way sways less where that leaves less than CLEARANCE.
    """
    length = length_along(corners)
    count = max(3, round(length[-1] / SPACING) + 1)
    s = np.linspace(0.0, length[-1], count)
    straight = interpolate(s, length, corners)
    rounded = gaussian_filter1d(straight, min(ROUNDING, length[-1] / 8) / SPACING, axis=0, mode="nearest")
    rounded = rounded + _ends(s, straight[0] - rounded[0], straight[-1] - rounded[-1])
    offset = slow(random, count, WEAVE_LENGTH / SPACING, WEAVE)[:, 0]
    leg = np.clip(np.searchsorted(length, s, side="right") - 1, 0, len(zigzag) - 1)
    swinging = np.sin(2 * np.pi * s / random.uniform(5, 7) + random.uniform(0, 2 * np.pi))
    offset = offset + gaussian_filter1d(zigzag[leg], 1.0 / SPACING, mode="nearest") * swinging
    offset *= np.clip(np.minimum(s, s[-1] - s) / 1.5, 0, 1)  # it begins and ends where it is told
    position = _swayed(rounded, offset, clearance)
    position = gaussian_filter1d(position, 0.3 / SPACING, axis=0, mode="nearest")
    position = position + _ends(s, corners[0] - position[0], corners[-1] - position[-1])
    tangent = np.gradient(position, SPACING, axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    return Way(length_along(position), position, np.interp(s, length, heights), heading)


def _ends(s: Array, at_start: Array, at_end: Array) -> Array:
    """A correction that fades over half a metre from both ends."""
    fade = [np.clip(1 - d / 0.5, 0, 1)[:, None] for d in (s, s[-1] - s)]
    return fade[0] * at_start + fade[1] * at_end


def _swayed(line: Array, offset: Array, clearance: Clearance | None) -> Array:
    """The line moved to its left by ``offset``, halved where that comes too near to a wall."""
    tangent = np.gradient(line, axis=0)
    left = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    left /= np.maximum(np.hypot(*left.T), 1e-9)[:, None]
    offset = offset.copy()
    for _ in range(5):
        if clearance is not None:
            offset[clearance(line + offset[:, None] * left) < CLEARANCE] /= 2
    return line + offset[:, None] * left


HEIGHT = {"f": (1.65, 0.065), "m": (1.78, 0.07)}  # [m] mean and standard deviation
CADENCE = {"f": (1.89, 0.13), "m": (1.80, 0.13)}  # [Hz]
WALK_RATIO, WALK_RATIO_SPREAD = 0.38, 0.05  # [m·s] step length over cadence at 1.70 m, and between people
REFERENCE = 1.70  # [m]
WANDER, WANDER_STEPS = 0.025, 60  # of length and period, and over how many steps
STEP_LENGTH_SPREAD, STEP_TIME_SPREAD = 0.040, 0.028  # from one step to the next
ASYMMETRY = 0.012  # of left against right
TURN_SHORTENS = 1.124  # [% per degree] of a step's heading change: [map-matching] Eq. (2)
FIRST_STEP, CLOSING_STEP = 0.6, 0.4  # of a usual step: from standing; the least that is left for the feet to close
SHORTEST_STEP = 0.15  # [m]


@dataclass(frozen=True)
class Manner:
    """A way of going. cadence, length: factors of the walker's own; spread: of the variation from step to step."""

    cadence: float = 1.0
    length: float = 1.0
    spread: float = 1.0


# Somebody who browses takes steps shorter than their cadence lets one expect: by 1.2 to 1.4
MANNERS = {
    "normal": Manner(),
    "fast": Manner(1.12, 1.10),
    "slow": Manner(0.88, 0.87),
    "browse": Manner(0.80, 0.58, 2.0),
    "narrow": Manner(0.97, 0.75),  # told to take short steps, or long ones: [calibration-walk] Sec. 4.1
    "wide": Manner(0.97, 1.25),
    "stairs": Manner(0.90, 0.45, 0.7),
}


@dataclass(frozen=True)
class Walker:
    """A person.

    height [m]; sex: "f" or "m"; cadence: steps per second at ease [Hz]; step_length: then [m];
    bounce: how much they bob, 1 for most; asymmetry: left steps are longer by this share.
    """

    height: float
    sex: str
    cadence: float
    step_length: float
    bounce: float = 1.0
    asymmetry: float = 0.0

    @classmethod
    def drawn(cls, random: np.random.Generator, height: float | None = None, sex: str | None = None) -> Walker:
        """Somebody, of whom a few things may be known."""
        sex = sex or str(random.choice(["f", "m"]))
        height = float(height or random.normal(*HEIGHT[sex]))
        # taller people take longer and fewer steps, as bodies of one shape do: length by stature, cadence by its root
        cadence = random.normal(*CADENCE[sex]) * np.sqrt(HEIGHT[sex][0] / height)
        ratio = WALK_RATIO * (height / REFERENCE) ** 1.5 * np.exp(random.normal(0, WALK_RATIO_SPREAD))
        bounce, asymmetry = np.exp(random.normal(0, 0.22)), random.normal(0, ASYMMETRY)
        return cls(height, sex, float(cadence), float(ratio * cadence), float(bounce), float(asymmetry))


@dataclass(frozen=True)
class Footfalls:
    """One walk from standing to standing.

    time: ``(n,)`` when each foot landed, from the start [s]; along: ``(n,)`` how far the body had come [m]. The last
    landing only brings the feet together.
    """

    time: Array
    along: Array


def footfalls(walker: Walker, way: Way, manner_at: Callable[[float], Manner], random: np.random.Generator) -> Footfalls:
    """The steps that bring a walker along a way, until the feet are together again. manner_at: of a place on it [m]."""
    most = int(way.length / (SHORTEST_STEP * 0.5)) + 4
    length, period, length_noise, period_noise = _varied(walker, most, random)
    time, along, t, s = list[float](), list[float](), 0.0, 0.0
    for k in range(most):
        manner = manner_at(s)
        step = length[k] * manner.length * (1 + manner.spread * length_noise[k]) * (FIRST_STEP if k == 0 else 1.0)
        turned = abs(np.degrees(float(way.turned(s, s + step))))
        step = max(step * (1 - TURN_SHORTENS / 100 * min(turned, 60.0)), SHORTEST_STEP)
        t += period[k] / manner.cadence * (1 + manner.spread * period_noise[k])
        s += step
        if s > way.length - CLOSING_STEP * step:
            break
        time.append(t)
        along.append(s)
    return Footfalls(np.array([*time, t]), np.array([*along, way.length]))


def _varied(walker: Walker, count: int, random: np.random.Generator) -> tuple[Array, Array, Array, Array]:
    """Usual step lengths [m] and periods [s] as they wander, and the variation of each from step to step."""
    wander = autoregressive(random, count, np.exp(-1 / WANDER_STEPS), WANDER, 2).T
    left = np.where(np.arange(count) % 2, 0.5, -0.5) * walker.asymmetry
    length = walker.step_length * (1 + left) * np.exp(wander[0])
    period = (1 - left) / walker.cadence * np.exp(-0.5 * wander[0] + wander[1])
    return length, period, random.normal(0, STEP_LENGTH_SPREAD, count), random.normal(0, STEP_TIME_SPREAD, count)
