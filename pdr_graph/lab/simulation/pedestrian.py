"""The pedestrian: stature, step length and cadence with their real correlations, and the path along a route's corners.

Speed is step length times cadence. Their ratio, the walk ratio, is constant for a person over a wide range of speeds,
about 6.3 mm per step and minute (Sekiya et al. 1996). Both drift over minutes and vary from step to step; left and
right differ a little. Published spreads: step time 2–3 %, step length 3–5 % (Hausdorff 2005). The path has rounded
corners, weaves and zigzags, and may climb stairs. The random processes of all parts of the simulator are here too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from pdr_graph.geometry import interpolate, length_along
from pdr_graph.types import Array, OneLineRepr


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


@dataclass(frozen=True)
class PathShape:
    """How people deviate from the straight lines between corners. Chosen by hand; docs/simulation.md compares walks.

    spacing: between points of the path [m]; rounding: length over which a corner is rounded [m]; weave: standard
    deviation to the side [m], correlated over weave_length [m]; clearance: distance that people keep from walls [m].
    """

    spacing: float = 0.05
    rounding: float = 0.45
    weave: float = 0.12
    weave_length: float = 6.0
    clearance: float = 0.35


SHAPE = PathShape()


def walk_path(
    corners: Array,
    heights: Array,
    zigzag: Array,
    random: np.random.Generator,
    clearance: Clearance | None = None,
) -> WalkPath:
    """The path of a pedestrian along ``corners (k, 2)`` [m] at ``heights (k,)`` [m].

    zigzag: ``(k - 1,)`` amplitude of swinging from side to side on each leg [m], with a period of about 6 m.
    clearance: distance to the nearest wall; offsets to the side are reduced where less than SHAPE.clearance is left.
    """
    length = length_along(corners)
    count = max(3, round(length[-1] / SHAPE.spacing) + 1)
    s = np.linspace(0.0, length[-1], count)
    straight = interpolate(s, length, corners)
    rounded = gaussian_filter1d(straight, min(SHAPE.rounding, length[-1] / 8) / SHAPE.spacing, axis=0, mode="nearest")
    rounded = rounded + _ends(s, straight[0] - rounded[0], straight[-1] - rounded[-1])
    offset = smooth_noise(random, count, SHAPE.weave_length / SHAPE.spacing, SHAPE.weave)[:, 0]
    leg = np.clip(np.searchsorted(length, s, side="right") - 1, 0, len(zigzag) - 1)
    swinging = np.sin(2 * np.pi * s / random.uniform(5, 7) + random.uniform(0, 2 * np.pi))
    offset = offset + gaussian_filter1d(zigzag[leg], 1.0 / SHAPE.spacing, mode="nearest") * swinging
    offset *= np.clip(np.minimum(s, s[-1] - s) / 1.5, 0, 1)  # the path begins and ends at the given corners
    position = _moved_left(rounded, offset, clearance)
    position = gaussian_filter1d(position, 0.3 / SHAPE.spacing, axis=0, mode="nearest")
    position = position + _ends(s, corners[0] - position[0], corners[-1] - position[-1])
    tangent = np.gradient(position, SHAPE.spacing, axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    return WalkPath(length_along(position), position, np.interp(s, length, heights), heading)


def _ends(s: Array, at_start: Array, at_end: Array) -> Array:
    """A correction ``(n, 2)`` [m] at both ends that fades out within half a metre."""
    fade = [np.clip(1 - d / 0.5, 0, 1)[:, None] for d in (s, s[-1] - s)]
    return fade[0] * at_start + fade[1] * at_end


def _moved_left(line: Array, offset: Array, clearance: Clearance | None) -> Array:
    """The line moved to its left by ``offset (n,)`` [m], which is halved where a wall would be too near."""
    tangent = np.gradient(line, axis=0)
    left = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    left /= np.maximum(np.hypot(*left.T), 1e-9)[:, None]
    offset = offset.copy()
    for _ in range(5):
        if clearance is not None:
            offset[clearance(line + offset[:, None] * left) < SHAPE.clearance] /= 2
    return line + offset[:, None] * left


@dataclass(frozen=True)
class Manner:
    """A manner of walking: factors of the walker's own cadence, step length, and spread from step to step."""

    cadence: float = 1.0
    length: float = 1.0
    spread: float = 1.0


# Browsing people take steps that are shorter by a factor of 1.2 to 1.4 than their cadence suggests
MANNERS = {
    "normal": Manner(),
    "fast": Manner(1.12, 1.10),
    "slow": Manner(0.88, 0.87),
    "browse": Manner(0.80, 0.58, 2.0),
    "narrow": Manner(0.97, 0.75),  # asked to take short or long steps: [calibration-walk] Sec. 4.1
    "wide": Manner(0.97, 1.25),
    "stairs": Manner(0.90, 0.45, 0.7),
}


HEIGHT = {"f": (1.65, 0.065), "m": (1.78, 0.07)}  # [m] mean and standard deviation
CADENCE = {"f": (1.89, 0.13), "m": (1.80, 0.13)}  # [Hz] mean and standard deviation
WALK_RATIO, WALK_RATIO_SPREAD = 0.38, 0.05  # [m·s] step length over cadence at 1.70 m; relative, between people
ASYMMETRY = 0.012  # standard deviation of the relative difference of left and right


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
        height = float(height or random.normal(*HEIGHT[sex]))
        # geometric similarity: step length grows with the stature, cadence falls with its square root
        cadence = random.normal(*CADENCE[sex]) * np.sqrt(HEIGHT[sex][0] / height)
        ratio = WALK_RATIO * (height / 1.70) ** 1.5 * np.exp(random.normal(0, WALK_RATIO_SPREAD))
        bounce, asymmetry = np.exp(random.normal(0, 0.22)), random.normal(0, ASYMMETRY)
        return cls(height, sex, float(cadence), float(ratio * cadence), float(bounce), float(asymmetry))


@dataclass(frozen=True)
class Footfalls(OneLineRepr, row="step"):
    """The landings of one walk from standing to standing. The last step brings the feet together.

    time: ``(n,)`` of each landing, from the start [s]; along: ``(n,)`` position of the body along the path [m].
    """

    time: Array
    along: Array


STEP_LENGTH_SPREAD, STEP_TIME_SPREAD = 0.040, 0.028  # relative, from one step to the next: Hausdorff 2005
TURN_SHORTENS = 1.124  # [% per degree] of a step's heading change: [map-matching] Eq. (2)
FIRST_STEP, CLOSING_STEP = 0.6, 0.4  # shares of a usual step: the first; the shortest with which the feet close
SHORTEST_STEP = 0.15  # [m]


def footfalls(
    walker: Pedestrian, path: WalkPath, manner_at: Callable[[float], Manner], random: np.random.Generator
) -> Footfalls:
    """The steps of a walker along a path, until the feet are together again.

    manner_at: the manner of walking at a length along the path [m].
    """
    most = int(path.length / (SHORTEST_STEP * 0.5)) + 4
    length, period, length_noise, period_noise = _usual_steps(walker, most, random)
    time, along, t, s = list[float](), list[float](), 0.0, 0.0
    for k in range(most):
        manner = manner_at(s)
        step = length[k] * manner.length * (1 + manner.spread * length_noise[k]) * (FIRST_STEP if k == 0 else 1.0)
        turn = abs(np.degrees(float(path.heading_change(s, s + step))))
        step = max(step * (1 - TURN_SHORTENS / 100 * min(turn, 60.0)), SHORTEST_STEP)
        t += period[k] / manner.cadence * (1 + manner.spread * period_noise[k])
        s += step
        if s > path.length - CLOSING_STEP * step:
            break
        time.append(t)
        along.append(s)
    return Footfalls(np.array([*time, t]), np.array([*along, path.length]))


DRIFT, DRIFT_STEPS = 0.025, 60  # relative standard deviation of length and period; steps over which it changes


def _usual_steps(walker: Pedestrian, count: int, random: np.random.Generator) -> tuple[Array, Array, Array, Array]:
    """Slowly drifting step lengths [m] and periods [s] ``(count,)``, and the noise of each from step to step."""
    drift = autoregressive_noise(random, count, np.exp(-1 / DRIFT_STEPS), DRIFT, 2).T
    left = np.where(np.arange(count) % 2, 0.5, -0.5) * walker.asymmetry
    length = walker.step_length * (1 + left) * np.exp(drift[0])
    period = (1 - left) / walker.cadence * np.exp(-0.5 * drift[0] + drift[1])
    return length, period, random.normal(0, STEP_LENGTH_SPREAD, count), random.normal(0, STEP_TIME_SPREAD, count)
