"""Who walks, and how: stature, stride and cadence with their real correlations, step by step.

Speed is step length times cadence, and the two go together: their ratio is a person's constant over a wide range of
speeds, the walk ratio, about 6.3 mm per step and minute (Sekiya et al. 1996). Both wander over minutes and vary from
step to step; left and right differ a little. Published spreads: step time 2–3 %, step length 3–5 % (Hausdorff 2005).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pdr_graph.simulation.noise import autoregressive
from pdr_graph.simulation.way import Way
from pdr_graph.types import Array

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
