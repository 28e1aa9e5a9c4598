"""Every number that steers the estimate: value, unit, meaning, source, and the range in which the accuracy is the same.

One table for each subject, a class with one instance; code reads ``WALLS.body`` where it uses it, so that
``scripts/reproduce settings`` can halve and double each number. That script measures the ranges; its figures are in
docs/results/settings.md. Sources are a paper with section or equation, a fit with its script, practice, or, if none is
stated, JUDGEMENT. Constants of nature, sizes of caches, numerical tolerances, grids, limits of loops and when a live
estimate does its work stay in their modules, and so do numbers of one formula that change no walk that was measured.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np

JUDGEMENT = "judgement"
SEARCHED = "set on 36 simulated walks in malls and offices; doors of 0.9 m in small plans need the densest"
PROFILES = "set on simulated walks of three to twelve fixes with profiles 20 and 35 % off; a right one costs nothing"
VERDICT_SEEDS = "set on simulated walks with honest and with lying sources (scripts/reproduce integrity)"


class Entry(NamedTuple):
    """One number. table: name of its instance; still: least and largest factor of the value at which the accuracy is
    the same (0.5 and 2 were tried), None if it was not measured.
    """

    table: str
    name: str
    value: Any
    unit: str
    meaning: str
    source: str
    still: tuple[float, float] | None

    def __str__(self) -> str:
        return f"{self.table}.{self.name}"


def number(
    value: Any, unit: str, meaning: str, source: str = JUDGEMENT, *, still: tuple[float, float] | None = None
) -> Any:
    """A field with this default and its description. still: see `Entry`."""
    return field(default=value, metadata={"unit": unit, "meaning": meaning, "source": source, "still": still})


class Table:
    """The numbers of one subject."""


def tables() -> dict[str, Table]:
    """The instances of all tables by name, in the order of this file."""
    return {name: table for name, table in globals().items() if isinstance(table, Table)}


def entries() -> Iterator[Entry]:
    """Yield every number of every table."""
    for name, table in tables().items():
        for of in fields(table):  # type: ignore[arg-type]
            yield Entry(name, of.name, getattr(table, of.name), **of.metadata)


@contextmanager
def changed(table: Table, **values: Any) -> Iterator[None]:
    """Set some numbers of a table within a ``with`` block, for scripts and tests."""
    before = {name: getattr(table, name) for name in values}
    try:
        for name, value in values.items():
            object.__setattr__(table, name, value)
        yield
    finally:
        for name, value in before.items():
            object.__setattr__(table, name, value)


# Steps


BOUNCES = "strides, RIDI, Microsoft: 0.013 to 0.04 m at 0.5 to 1.7 m/s, 0.023 to 0.03 m below"
JARS = "45 recorded walks: from 0.08 m/s², 0.035 of the amplitude; waving 0.03 m/s², or 0.025"
LABELLED = "fit: steps of 80 recordings; pauses of weallwalk, 2 h of waving, lifting and rides, 15 % of the weight"
RUNS = "2.4 to 4.5 m/s at 2.6 to 3.1 steps/s: Cavagna et al. 1988, 2005; no recorded run was at hand"
GAITS = "chosen by hand on the 40 phones of weallwalk, all seven persons, and on an hour of rides and waving"
LOST = "59 recorded walks, whole and with 8 to 15 % of their steps taken away"
LEGS = "fit: 594 straight legs of 91 mall walks, 86 of 6 s of RIDI and IPIN 2021; log score of walks, floors left out"
POWED = "Torres-Sospedra et al. 2015: e, best of their representations; 2 to 4 alike on one mall floor"
SWAYS = "strides: slow walkers sway by 0.5 to 0.9 m/s², others by 0.3"


@dataclass(frozen=True)
class StepPriors(Table):
    """Durations of steps."""

    shortest: float = number(0.25, "s", "shortest duration of a step", still=(0.5, 2))
    longest: float = number(2.2, "s", "longest duration of a step", "strides: 1.0 to 1.6 s at 0.3 to 0.5 m/s")
    pause: float = number(
        2.2, "steps", "interval between landings from which it is a stop: 1.2 s at a usual pace", still=(1, 1)
    )
    usual: float = number(0.54, "s", "typical duration of a step", still=(1, 1))


@dataclass(frozen=True)
class CandidatePriors(Table):
    """Candidate landings in |a|: one set for all phones and grips; ``scripts/reproduce steps`` scores it."""

    sampling: float = number(0.04, "s", "longest interval at which the rhythm is evaluated: 25 Hz", still=(0.5, 1))
    usual_spread: float = number(0.25, "log", "spread of a step's duration over people and paces", still=(1, 1))
    smoothing: float = number(0.05, "s", "narrow Gaussian: |a| above it is a knock; others are multiples", still=(1, 1))
    look_ahead: float = number(2.0, "s", "part of the window after a landing", still=(1, 2))
    kernel: float = number(0.7, "steps", "width of the Gaussian at the frequency of the steps", still=(1, 1))
    weakest: float = number(
        0.35, "m/s²", "least amplitude of a step, peak to peak: a standing person's is less", still=(0.5, 2)
    )
    weakest_share: float = number(0.23, "share", "least amplitude among the steps around: feet shuffle", still=(1, 1))
    highest_bounce: float = number(
        0.14,
        "m",
        "largest vertical motion, peak to peak: walkers bob by 0.02 to 0.10, shaking arms by 0.15",
        still=(1, 2),
    )
    usual_bounce: float = number(0.014, "m", "vertical motion below which a usual step is doubted", BOUNCES)
    run_bounce: float = number(
        0.06, "m", "vertical motion of a run, above which a usual step is too long", "Cavagna 1988", still=(0.5, 2)
    )
    slow_kernel: float = number(0.5, "steps", "width of the Gaussian at the frequency of slow steps: these vary more")
    slow_bounce: float = number(0.025, "m", "vertical motion of slow walkers, peak to peak", BOUNCES)
    bounce_spread: float = number(0.2, "log", "spread of that motion", BOUNCES)
    bounce_weight: float = number(0.4, "correlation", "cost of a vertical motion off by a factor of e")
    rhythm_weight: float = number(0.8, "correlation", "weight of |a| repeating itself, in slow steps", still=(0.5, 1))
    sway_weight: float = number(
        0.8, "correlation", "weight of the sway of a body, and of that of a limb", SWAYS, still=(0.5, 2)
    )
    sway_noise: float = number(0.2, "m/s²", "sway of who stands, types or rides: 0.02 to 0.1", SWAYS, still=(0.5, 2))
    slow_penalty: float = number(0.15, "correlation", "by which slow steps must fit better than usual ones")
    least_jar: float = number(0.045, "m/s²", "by which landings jar, root mean square: less is a smooth motion", JARS)
    jar_share: float = number(0.03, "share", "the same, of the amplitude", JARS, still=(0.5, 1))
    steadiest_tilt: float = number(
        0.96, "share", "least length of that mean; else the phone tilts to and fro", still=(0.5, 1)
    )


@dataclass(frozen=True)
class BoutPriors(Table):
    """When candidate landings become steps."""

    closest_share: float = number(0.55, "steps", "least interval between two landings", still=(0.5, 1))
    start: float = number(
        0.68, "correlation", "least mean regularity of the first steps, to start", GAITS, still=(0.5, 1)
    )
    go_on: float = number(0.1, "correlation", "least regularity to go on")
    memory: int = number(20, "steps", "regular ones from which the walker's rhythm and amplitude are learned", GAITS)
    remembered: float = number(10.0, "s", "after regular steps in which one in their rhythm continues the walk", GAITS)
    weak_share: float = number(0.3, "share", "of the walker's amplitude, below which a step must be regular", GAITS)
    weak_regularity: float = number(0.5, "correlation", "so regular", GAITS, still=(0.5, 2))
    push_off: float = number(
        0.6, "share", "a first landing weaker than this, of the following ones, is none", still=(1, 1)
    )
    fewest: int = number(4, "steps", "least number of steps; fewer are a gesture", still=(1, 1))


@dataclass(frozen=True)
class ConfidencePriors(Table):
    """The probability that what was accepted as a step is one: a logistic regression."""

    usual: float = number(4.1, "log odds", "of a regular step", LABELLED, still=(0.5, 2))
    regular: float = number(1.0, "correlation", "below which steps are irregular", LABELLED, still=(0.5, 2))
    irregular: float = number(12.7, "log odds", "for a regularity of 0 instead of 1", LABELLED, still=(0.5, 2))
    sure: float = number(0.9, "probability", "from which a step is as long as the model says", still=(0.5, 2))


@dataclass(frozen=True)
class StridePriors(Table):
    """Lengths of steps."""

    sigma: float = number(
        0.45, "share", "sigma of a step's length and of its sway to the side, usual gait", LEGS, still=(1, 1)
    )
    turn_shortens: float = number(
        1.124, "%/deg", "shortening of a step in a turn", "[map-matching] Eq. (2)", still=(1, 1)
    )
    k0: float = number(0.49, "m", "constant part of a step", "fit: 38 walks, scripts/reproduce steps", still=(1, 1))
    k1: float = number(0.13, "√(m/s) → m", "part that grows with the bounce", "fit: as ``k0``", still=(1, 1))
    run: float = number(0.97, "m", "step of a run, of 0.4 s", RUNS, still=(1, 1))
    run_cadence: float = number(1.5, "exponent", "with which it grows with the cadence", RUNS, still=(0.5, 2))
    run_period: tuple[float, float] = number(
        (0.39, 0.43), "s", "a step that is surely and hardly of a run", RUNS, still=(1, 1)
    )
    run_amplitude: tuple[float, float] = number(
        (9.0, 12.0),
        "m/s²",
        "hardly and surely of a run",
        "simulated runs; walkers who hurry have up to 10 at such a rhythm",
        still=(1, 1),
    )


@dataclass(frozen=True)
class IrregularityPriors(Table):
    """How irregular a gait is, by the durations of its steps, and how much more irregular steps err."""

    usual: float = number(
        0.03, "log", "mean change of the duration from step to step: strolls in malls", LEGS, still=(0.5, 2)
    )
    steps: float = number(8.0, "steps", "over which that mean is taken, with exponential weights", LEGS, still=(0.5, 2))
    largest: float = number(
        0.1, "log", "largest change that counts: a hesitation is not ten times an irregular step", still=(0.5, 2)
    )
    exponent: float = number(0.8, "exponent", "with which the sigma of a step grows with it", LEGS, still=(0.5, 2))


@dataclass(frozen=True)
class TreadPriors(Table):
    """Lengths of steps on stairs."""

    blondel: float = number(0.63, "m", "two rises and one going", "Blondel's rule")
    shortest_going: float = number(0.22, "m", "least depth of treads", "building practice")
    longest_going: float = number(0.38, "m", "largest depth of treads", "building practice")
    sigma: float = number(0.1, "m", "sigma of a step on stairs: landings are among them")


@dataclass(frozen=True)
class MotionPriors(Table):
    """Errors of dead reckoning."""

    turn: float = number(0.02, "rad", "sigma of the heading error that one step adds: the body sways about the phone")
    unmeasured_turn: float = number(0.3, "rad", "the same without a gyroscope: a corner every thirty steps")
    standing_turn: float = number(0.02, "rad", "change between walking direction and phone in a pause", still=(0.5, 2))
    gap_speed: float = number(1.0, "m/s", "sigma per axis of the displacement in a gap: walker stands or walks")
    gap_turn: float = number(
        1.2, "rad", "sigma of a turn that is unknown, in a gap or while the grip changes in a stand; has a gradient"
    )
    steps_per_keyframe: int = number(
        10, "steps", "most steps between keyframes: the per-step optimum", "design, section 3", still=(0.5, 2)
    )
    steps_per_segment: int = number(
        100, "steps", "for which the calibration is constant", "design, section 3", still=(0.5, 2)
    )
    pace_steps: int = number(
        12, "steps", "before and after a change of pace, whose median durations are compared", still=(0.5, 2)
    )
    pace_change: float = number(0.15, "ratio", "change of these from which it is another pace", still=(0.5, 2))
    run_speed: float = number(2.3, "m/s", "of a run", "people walk up to 2 m/s: a Froude number of 0.5", still=(0.5, 2))
    run_change: float = number(
        3.5, "factor", "of the change of pace between walk and run: strides are off by 0.25", RUNS, still=(0.5, 2)
    )


# Directions


@dataclass(frozen=True)
class ForwardPriors(Table):
    """The forward axis of the phone; docs/results/compass.md and heading.md score it."""

    lead: float = number(
        1.1,
        "rad",
        "phase by which forward leads vertical acceleration: 33–119° in 16 of 18 real walks",
        "fit: docs/results/seeds.md",
        still=(1, 2),
    )
    window_steps: int = number(16, "steps", "length of a window", still=(0.5, 2))
    least_windows: int = number(3, "windows", "least number of windows of walking", still=(0.5, 2))
    least_coherence: float = number(0.3, "share", "of forward and vertical acceleration in a window of gait")
    gait_sigma: float = number(0.3, "rad", "sigma of the gait axis about the walking direction: hands sway")
    reading_sigma: float = number(0.17, "rad", "sigma of the y axis of a phone held for reading", still=(0.5, 2))
    facing_up: float = number(0.4, "share", "least vertical component of the screen's normal in reading")
    steady: float = number(0.95, "share", "least length of the mean direction; a waved phone has less", still=(0.5, 1))
    opposed: float = number(0.6, "rad", "of gait axis and y axis from which the phone is not read", still=(0.5, 2))
    early_coherence: float = number(0.45, "share", "least coherence in such a window", still=(0.5, 2))
    surely_facing_up: float = number(0.55, "share", "``facing_up`` where the gait does not confirm it", still=(0.5, 2))
    early_sigma: float = number(
        0.4,
        "rad",
        "sigma of the gait axis of one early window: errors of 4 to 20° (median)",
        "simulated and real walks",
    )
    confirmed_sigma: float = number(0.25, "rad", "sigma of the y axis if one such window agrees", still=(0.5, 2))
    unconfirmed: float = number(
        0.35, "rad", "sigma of the y axis of a phone that faces up, unconfirmed by gait", still=(0.5, 2)
    )

    @property
    def half_window(self) -> int:
        """Steps of a window live, and beside a turn of the phone: few enough to know the axis soon."""
        return self.window_steps // 2

    @property
    def early_spread(self) -> float:
        """Sigma of the gait axes of early windows about their mean. [rad]"""
        return float(np.sqrt(self.early_sigma**2 - self.gait_sigma**2))


@dataclass(frozen=True)
class GripPriors(Table):
    """Grip changes; ``scripts/reproduce compass`` scores them."""

    tilting: float = number(0.25, "rad/s", "rate of the vertical in the device above that of a carried phone")
    new_tilt: float = number(0.5, "rad", "change of the vertical in the device that makes a grip change")
    fast: float = number(0.8, "rad", "turn of the phone for which a clear axis of the gait is waited for")
    noise: float = number(
        0.5,
        "rad",
        "deviation from the usual axis that is noise",
        "up to 0.6 in 1029 of 1031 windows in two malls",
        still=(0.5, 2),
    )
    clear: float = number(0.7, "rad", "deviation that is clear; less counts in part")
    off_sigma: float = number(0.2, "rad", "sigma of a deviation", "0.14 to 0.26: RIDI")
    coherent: float = number(0.7, "share", "least coherence of a window that shows a deviation", still=(1, 2))
    weak: float = number(0.13, "share", "least level acceleration in it, of the vertical", "RIDI: 0.27 to 0.64")
    sigma: float = number(0.35, "rad", "sigma of the walker's turn during a grip change")


@dataclass(frozen=True)
class CompassPriors(Table):
    """Walking directions by the compass."""

    sigma: float = number(
        0.2,
        "rad",
        "error that a walk shares: the phone's own iron, a building's axis",
        "fit: scripts/reproduce compass",
        still=(0.5, 2),
    )
    longest_stretch: float = number(
        150.0, "s", "walk per heading: a gyroscope with 0.002 rad/s errs by as much in that time", "derived"
    )
    least_certain: float = number(
        0.7, "rad", "sigma of north or forward axis beyond which there is no heading", still=(0.5, 2)
    )
    off: float = number(float(np.pi / 4), "rad", "of a compass that is off throughout")


@dataclass(frozen=True)
class LiveCompassPriors(Table):
    """The live compass."""

    unconfirmed: float = number(0.6, "rad", "sigma of the forward axis until the gait confirms it: bags")
    least_added: float = number(1.0, "rad", "largest sigma of a heading that is reported")


# Sensors


@dataclass(frozen=True)
class RestPriors(Table):
    """Phones at rest, and the gyroscope's bias there."""

    window: float = number(0.5, "s", "over which the spread of the samples is taken")
    rate: float = number(0.012, "rad/s", "largest spread at rest: twice the noise of cheap sensors")
    acceleration: float = number(0.10, "m/s²", "the same of the acceleration")
    shortest: float = number(1.5, "s", "least duration of a rest: any phone is at rest for a moment")
    largest_bias: float = number(0.2, "rad/s", "of a gyroscope, largest mean rate at rest: else a turntable or a car")
    drift_time: float = number(60.0, "s", "over which the bias is averaged: it follows the temperature")
    longest_bridged: float = number(1.0, "s", "missing samples that are interpolated: a step or two")


@dataclass(frozen=True)
class MagnetometerPriors(Table):
    """Calibration of the magnetometer, and tests of the field."""

    hard_spread: float = number(300.0, "µT", "sigma of a phone's hard iron before any calibration")
    soft_spread: float = number(0.1, "share", "sigma of its soft iron")
    field_spread: float = number(3.0, "µT", "magnitude about the ellipsoid in a building: width of the loss")
    independent: int = number(100, "samples", "independent ones in a building")
    hard_sigma: float = number(3.0, "µT", "largest sigma of a hard iron that is worth subtracting")
    tilted: float = number(0.8, "share", "length of the mean vertical above which the phone was hardly tilted")


@dataclass(frozen=True)
class NorthPriors(Table):
    """The filter of north."""

    drift: float = number(0.004, "rad/√s", "of the attitude's heading after removal of the bias", still=(0.5, 2))
    undisturbed: float = number(0.12, "rad", "sigma of an observation that passes both tests", still=(0.5, 2))
    alike: float = number(2.5, "s", "for which a walker stays in one disturbance: about three metres", still=(1, 2))
    disturbed: float = number(0.35, "rad", "largest error in either test; others are not used", still=(0.5, 1))
    weakest: float = number(
        0.3, "share", "least level field, of the earth's: a weaker one's direction is noise", still=(0.5, 2)
    )
    disagree: float = number(
        0.5, "rad", "residual (rms) of those that measure no drift", "0.06 to 0.41 in 46 real walks", still=(0.5, 1)
    )
    least_valid: float = number(0.3, "share", "least share of observations that pass, or none is used", still=(0.5, 2))


@dataclass(frozen=True)
class ClimbPriors(Table):
    """Climbs in a barometer's height; docs/results/floors.md scores them."""

    gust: float = number(4.5, "s", "longest spike that is removed: a lift takes four seconds for a storey")
    rate: float = number(2.0, "s", "least width of the Gaussian over which a rate is taken")
    slow: float = number(0.03, "m/s", "low threshold of the rate: weather has 0.002")
    fast: float = number(0.06, "m/s", "high threshold: a ramp of 6 % has 0.08, stairs 0.2 to 0.5, lifts 0.5 to 5")
    quiet: float = number(3.0, "σ", "noise of a rate that does not exceed the high threshold")
    pause: float = number(4.0, "s", "within a climb, to turn on a landing")
    level: float = number(10.0, "s", "before and after a climb over which its ends' heights are taken")
    least: float = number(0.8, "m", "least height of a climb: from pocket to ear a phone rises by 0.6")
    certain: float = number(2.0, "σ", "least height: to miss a climb costs more than to invent one")
    edge: float = number(0.3, "m", "from the levels at which a climb begins and ends; at most an eighth of it")
    correlated: float = number(3.0, "s", "over which errors of a height are alike")
    placement: float = number(0.2, "m", "sigma of the phone's height above the floor, or of a draught")
    weather: float = number(8.5 / 3600, "m/s", "drift of the height with the weather: 1 hPa an hour")


@dataclass(frozen=True)
class KindPriors(Table):
    """Limits between kinds of climbs."""

    walked: float = number(0.5, "share", "least share of a climb's time on steps, to count as on foot")
    steepest_ramp: float = number(0.055, "m/step", "ramps for wheelchairs, 1 in 12", "building practice")
    highest_stairs: float = number(
        0.25, "m/step", "treads are 0.14 to 0.20; two at a time are as walking on an escalator", "building practice"
    )
    highest_step: float = number(0.5, "m/step", "two treads at a time are 0.36", "building practice")
    slowest_lift: float = number(
        0.42, "m/s", "escalators of 0.5 to 0.65 m/s at 30 to 35° rise by 0.25 to 0.37", "building practice"
    )


# The graph


@dataclass(frozen=True)
class LossPriors(Table):
    """Widths of robust losses."""

    huber: float = number(
        2.45,
        "σ",
        "full weight up to here: 95 % of inliers in the plane; beyond it outliers lose most of theirs",
        "χ² of 2 degrees: 5.99",
        still=(1, 1),
    )
    closure: float = number(4.0, "σ", "the same of loop closures: one in ten may be wrong by metres")


@dataclass(frozen=True)
class WalkerPriors(Table):
    """The walker's calibration (R_s, R_d, b)."""

    sigma: tuple[float, float, float] = number(
        (0.15, 0.03, 0.003),
        "-, -, rad/s",
        "of an unknown walker; b covers all phones but the share ``drifting``",
        "fit of b: docs/results/drift.md; JUDGEMENT",
        still=(1, 1),
    )
    drifting: float = number(
        0.05, "share", "of gyroscopes that drift by ``far``", "fit: docs/results/drift.md", still=(0.5, 2)
    )
    far: float = number(0.03, "rad/s", "sigma of b of such a gyroscope", "fit: docs/results/drift.md", still=(0.5, 2))
    change: tuple[float, float, float] = number(
        (0.03, 0.005, 0.0005), "-, -, rad/s", "sigma of the change from segment to segment", still=(0.5, 2)
    )
    pace: float = number(
        0.2,
        "ratio",
        "sigma of the change of R_s by that of the pace, in logarithms",
        "0.5 with noise at 15 changes in real malls; 1.5 in simulated browsing",
        still=(0.5, 2),
    )
    blind: float = number(
        0.06,
        "-",
        "sigma of R_s where most turns are unmeasured: a longer walk fits the noise of its fixes better",
        "6 % between walks: docs/results/steps.md",
    )
    between_walks: tuple[float, float, float] = number(
        (0.05, 0.01, 0.001), "-, -, rad/s", "sigma between two walks of one person"
    )


@dataclass(frozen=True)
class WallPriors(Table):
    """Walls along a walk: graph and particles."""

    margin: float = number(
        0.8, "m", "that people keep from walls", "real walks in malls: scripts/reproduce settings", still=(1, 1)
    )
    sigma: float = number(1.0, "m", "sigma of that margin", still=(0.5, 2))
    body: float = number(0.15, "m", "least distance of a walker's centre from any wall", still=(0.5, 2))


@dataclass(frozen=True)
class RegionPriors(Table):
    """Which rooms and corridors a walk leads through."""

    stray: float = number(0.5, "m", "sigma of a track")
    outside_cost: float = number(4.0, "nats", "of a point in no region: within 1.4 m it belongs to one")
    outside_price: float = number(
        0.15, "log-odds", "of a point in no region: shops are entered, plans end", still=(0.5, 2)
    )
    at_door: float = number(1.5, "m", "from a door within which it may be used")
    wall_cost: float = number(12.0, "log-odds", "of passing a wall: plans have errors", still=(0.5, 2))
    door_cost: float = number(1.0, "log-odds", "of changing region at a door")
    leave_cost: float = number(6.0, "log-odds", "of entering or leaving all regions")


@dataclass(frozen=True)
class CorridorPriors(Table):
    """Directions of corridors, in runs of steps along their links."""

    side: float = number(
        0.3, "share", "of the width, sigma of the position at either end of a run; 1/√12 if uniformly distributed"
    )
    ahead: float = number(0.03, "rad", "sigma between the line from end to end of a run and the keyframe's heading")
    on_link: float = number(2.0, "cost", "largest of a step on a link: half a corridor off and askew as in a zigzag")
    shortest: float = number(3.0, "m", "of the walk along a link")
    bridged: float = number(
        6.0, "m", "of the walk between two parts of one run: across an intersection, past an open shop"
    )
    straight: float = number(float(np.radians(10)), "rad", "between the links of one run")
    spread: float = number(float(np.radians(4)), "rad", "the same as a standard deviation")


@dataclass(frozen=True)
class TurnPriors(Table):
    """Turns at the intersections of a corridor network."""

    turned: float = number(0.05, "rad", "sigma of a heading change: few steps of a turn are straight in a corridor")
    place: float = number(
        0.5, "m", "sigma outside the intersection: corners are cut, the step nearest to the turn is half a step off"
    )
    overlap: int = number(6, "places", "at the end or the beginning of a stretch that may belong to the turn")
    longest: float = number(8.0, "m", "of the walk around an intersection, from one link to the other")
    least: float = number(float(np.radians(25)), "rad", "turn; less is one corridor")
    most: float = number(float(np.radians(150)), "rad", "turn; more is a reversal")
    at_node: float = number(2.0, "m", "between a turn and its intersection")


@dataclass(frozen=True)
class WayPriors(Table):
    """Ways on foot outdoors, and which of them a walk followed."""

    half_width: tuple[tuple[str, float], ...] = number(
        (
            ("footway", 1.5),
            ("path", 1.5),
            ("steps", 1.5),
            ("cycleway", 1.5),
            ("bridleway", 1.5),
            ("corridor", 1.5),
            ("track", 2.0),
            ("service", 3.0),
            ("living_street", 4.0),
            ("pedestrian", 5.0),
            ("residential", 5.0),
            ("unclassified", 5.0),
            ("road", 5.0),
            ("tertiary", 6.0),
            ("secondary", 7.0),
            ("primary", 9.0),
            ("tertiary_link", 4.0),
            ("secondary_link", 4.0),
            ("primary_link", 4.0),
        ),
        "class, m",
        "half the width of a way with its pavements; others are closed to walkers",
        "RASt 06, Directives for the Design of Urban Roads: lanes of 2.75 to 3.25 m, pavements of 2.5 m",
    )
    side: float = number(0.6, "share", "of half a width, sigma of a walker across it: 0.58 if uniformly distributed")
    drawn: float = number(1.5, "m", "sigma of the line of a way, as it is drawn from pictures")
    station: float = number(12.0, "m", "of the walk between two points at which its way is sought")
    alike: float = number(150.0, "m", "of the walk over which its error, and its place across a way, are the same")
    moved: float = number(2.5, "m", "sigma of the move between two such points: corners are cut, sides changed")
    askew: float = number(0.5, "rad", "sigma of the direction of a walk at most")
    detour: float = number(1.3, "share", "of the walk, longest way between two points beside `slack`")
    slack: float = number(8.0, "m", "the same for every move")
    off: float = number(0.8, "nats", "per station off every way: more than a walk along one costs")
    leave: float = number(3.0, "nats", "of leaving or entering the ways")
    apart: float = number(8.0, "m", "across the walk, between ways that are told apart")
    span: float = number(300.0, "s", "of a walk under way that is matched: some turns, of which 120 s have one or none")
    door: float = number(30.0, "m", "from an outer door of a plan to a way that leads there, at most")


@dataclass(frozen=True)
class PlanPriors(Table):
    """Tolerances of a drawing."""

    crack: float = number(0.1, "m", "widest gap between neighbours that were meant to touch")
    door_reach: float = number(0.15, "m", "by which a door drawn as a line opens the walls on either side")
    door_width: float = number(0.9, "m", "of a door drawn as a point", "building practice")
    narrowest: float = number(0.3, "m", "least width of a passage or gap that is walkable")


@dataclass(frozen=True)
class FixPriors(Table):
    """Fixes that cannot be right, and losses of fixes."""

    longest_overhang: float = number(5.0, "s", "by which a fix may lie outside the recording")
    walking_speed: float = number(1.4, "m/s", "at which the sigma of such a fix grows")
    outlier: float = number(
        5.0,
        "σ",
        "beyond which a fix is an outlier, cannot be reached from another, and is rejected by the filter",
        still=(1, 1),
    )
    stretched: float = number(
        1.5, "ratio", "by which a walk may be longer than its strides say, or shorter", still=(1, 1)
    )
    driven: float = number(30.0, "m/s", "reached during a gap in the recording")
    patience: int = number(
        4, "fixes", "consistent ones in a row, all far from the walk, at which the estimate has diverged"
    )
    rejected: float = number(0.25, "fixes", "value in the longest chain, of one that the walk under way has rejected")
    doubtful: float = number(
        0.3, "probability", "that the farthest of honest fixes is as far off, below which one may be wrong"
    )
    suspicious: float = number(
        0.7,
        "share",
        "of a receiver's sigma that changes in a second, above which its sigmas are too small",
        still=(1, 2),
    )
    seconds: float = number(3.0, "s", "longest time of such a triple")


@dataclass(frozen=True)
class ReceiverPriors(Table):
    """Fixes of one receiver."""

    standing: float = number(120.0, "s", "correlation time of a receiver's errors", still=(0.5, 2))
    along: float = number(30.0, "m", "distance walked over which they are correlated", still=(0.5, 2))
    still: float = number(1.0, "m", "within which a frozen receiver stays")
    away: float = number(10.0, "m", "to which the steps must lead meanwhile")
    white: float = number(0.3, "share", "of white noise in the stated sigma", still=(0.5, 2))
    throughout: float = number(
        0.5,
        "share",
        "of the stated sigma in what stays the same",
        "0.55 of ten museum logs, 0.4 to 0.7 without one of them",
        still=(0.5, 2),
    )
    lag: float = number(
        1.5,
        "s",
        "expected lag, and its sigma",
        "0, 0.5, 3 and 1.5 to 5 of the four that follow their walk best (NJU, IPIN 2023)",
        still=(0.5, 2),
    )
    lag_change: float = number(0.02, "s/√s", "random walk of the lag", still=(0.5, 2))
    velocity: float = number(
        0.05,
        "1/s",
        "of the sigma of the position: sigma of the velocity",
        "0.03 on a campus (NJU), 0.04 to 0.06 in a museum (IPIN 2023)",
        still=(1, 2),
    )
    velocity_time: float = number(
        10.0, "s", "over which the velocity's error is the same", "2 on a campus, 10 to 15 in a museum", still=(0.5, 2)
    )
    roughest: float = number(
        0.25,
        "rad",
        "sigma of a course that is used: of slow receivers it is wrong throughout",
        "museum, IPIN 2023",
        still=(1, 2),
    )
    behind: float = number(
        0.3,
        "share",
        "sigma of what a receiver does not follow of a walk's last minutes",
        "0.13, 0.47, 0.21 of three museum walks, IPIN 2023",
    )
    astray: float = number(
        2.4,
        "share",
        "of the stated sigma in what stays the same, of a receiver that does not follow the walk",
        "the most probable of one museum log of ten; 1.3 to 6.1 within a nat",
    )
    scattered: float = number(1.1, "σ", "root mean square residual from which all errors may be larger than stated")


@dataclass(frozen=True)
class BeaconPriors(Table):
    """Levels of beacons, and where beacons are."""

    level_sigma: float = number(
        8.0,
        "dB",
        "of a mean level, as if they were independent: 3 dB that last for 6 m of the walk, and 2 dB",
        "ten museum logs, residuals at surveyed places: 7.7; by set 5.7 and 11",
        still=(1, 1),
    )
    within_sigma: float = number(
        3.5, "dB", "of a mean level about the usual one of its beacon", "ten museum logs: 3.1 to 4.1", still=(0.5, 2)
    )
    height: float = number(1.5, "m", "of a beacon above the phone", still=(1, 1))
    power_sigma: float = number(
        6.0,
        "dB",
        "of a beacon's power; 6 to 10 alike",
        "ten museum logs: residuals at surveyed places, by beacon and log",
        still=(1, 2),
    )
    weakest: float = number(
        -94.0, "dBm", "mean level of which half is received", "ten museum logs: -95 to -93; slope 3 dB", still=(0.5, 2)
    )
    most_evidence: float = number(
        4.5,
        "log-odds",
        "of one level or silence at most",
        "ten museum logs: silences for other reasons 0.5 to 2 %",
        still=(0.5, 2),
    )
    stretch: float = number(2.0, "m", "of the walk over which levels are averaged", still=(1, 1))
    path_loss: tuple[float, float, float] = number(
        (-62.0, 2.2, 3.0), "dBm, -, dB", "(P, n, k) of any phone", still=(1, 1)
    )
    path_loss_sigma: tuple[float, float, float] = number(
        (8.0, 0.5, 3.0), "dBm, -, dB", "sigma of (P, n, k)", still=(1, 2)
    )
    nearest: float = number(2.0, "m", "least sigma of a rough fix")
    range: float = number(
        60.0, "m", "from which no phone receives a beacon; at half of it the usual level is the weakest"
    )
    anywhere: float = number(
        30.0,
        "m",
        "sigma of an unsurveyed beacon about its strongest level, and of the displacement of a whole list",
        still=(0.5, 2),
    )
    suspicious: float = number(
        3.0, "nats", "by which a beacon fits better elsewhere along the walk", "of honest lists up to 4, simulated"
    )
    displaced: float = number(8.0, "m", "between the walks by the list and by all else, from which that is assumed")


@dataclass(frozen=True)
class RangePriors(Table):
    """Ranges to anchors."""

    nlos: float = number(0.2, "share", "of ranges without line of sight", still=(0.5, 2))
    detour: float = number(3.0, "m", "mean length of a detour", still=(0.5, 2))
    bias: float = number(0.15, "m", "sigma of an anchor's bias: antenna delays, calibrated or not", still=(0.5, 2))
    lag: float = number(0.5, "s", "sigma of the lag of their clock, which may be another device's", still=(0.5, 2))


@dataclass(frozen=True)
class LearnedPriors(Table):
    """Velocities by a network of the user's own, and what they and the step direction get wrong."""

    sigma: float = number(0.3, "m/s", "of a velocity of which the network says none, per axis", "RIDI: 0.19 to 0.39")
    least: float = number(0.1, "m/s", "of every velocity, beside what the network says", still=(1, 1))
    lasts: float = number(
        5.0, "s", "for which an error lasts; walks take wiggles from shorter ones", "RIDI: 0.4 to 1.7", still=(1, 1)
    )
    apart: float = number(
        0.6, "ratio", "of velocities and steps, from the usual one, from which one of both is doubted", still=(1, 1)
    )
    agree: float = number(
        0.6, "share", "of the time on foot that is less apart, below which a network is not used", still=(0.5, 1)
    )
    wrong: float = number(4.0, "nats", "the network is wrong along a stretch: 1 in 50", still=(1, 1))
    turned: float = number(
        4.5, "nats", "it is turned by any angle at the end of a stretch: log(2π / 0.07 rad)", still=(1, 1)
    )
    wrong_steps: float = number(
        2.3, "nats", "the direction of the steps is wrong along a stretch: 1 in 10", still=(0.5, 1)
    )


# Initialisation and search


@dataclass(frozen=True)
class InitialPriors(Table):
    """The alignment of dead reckoning with fixes."""

    joint: float = number(3.0, "m", "by which dead reckoning bends within a segment", still=(0.5, 2))
    change: float = number(0.2, "rad, ratio", "by which direction and scale change between segments", still=(0.5, 2))
    ambiguous: float = number(0.35, "rad", "sigma of the direction from which several starts are used")
    rough_track: float = number(0.05, "share", "error of dead reckoning, of the distance walked", still=(0.5, 2))
    heading_sigma: float = number(0.2, "rad", "of the start heading of a user")
    window: float = number(8.0, "s", "sigma of the weights of fixes about a pose without a gyroscope", still=(0.5, 1.5))


@dataclass(frozen=True)
class SearchPriors(Table):
    """The search for other walks that explain the measurements."""

    alike: float = number(30.0, "steps", "with the same position error, between fixes")
    dropped: float = number(12.0, "nats", "above the best at which a solution is dropped")
    usual: float = number(1.5, "ratio", "usual cost with walls to that without")
    strained: float = number(3.0, "nats", "above the usual at which further paths are searched")
    unseen: float = number(4.5, "nats", "above the usual of a path that the particles may have missed")
    same_path: float = number(
        4.0,
        "m",
        "mean distance of solutions on one path, largest of particles in one mode: half an aisle's spacing",
        still=(0.5, 2),
    )


@dataclass(frozen=True)
class PricePriors(Table):
    """Prices of hypotheses about sources: negative log odds of the error, before a measurement is seen."""

    astray: float = number(
        -float(np.log(1.5 / 11)),
        "nats",
        "a receiver does not follow the walk: 1 in 7",
        "one of ten museum logs, mean of Beta(1/2, 1/2) after them; without that log 3.0",
    )
    larger: tuple[tuple[float, float], ...] = number(
        ((2.0, 1.5), (4.0, 3.0)),
        "factor, nats",
        "all errors of a receiver so many times what it states: 1 in 5, 1 in 20",
    )
    wrong_list: float = number(
        5.5, "nats", "two entries of a list of beacons are swapped, one is elsewhere, or all: 1 in 250"
    )
    beacon_off: float = number(4.0, "nats", "a beacon of a list is off: 1 in 50")
    wrong_origin: float = number(
        3.0, "nats", "a list is displaced as a whole: as a receiver that is several times worse throughout"
    )
    wrong_fix: float = number(6.0, "nats", "a fix is wrong: 1 in 100, anywhere within about 5 sigma", still=(1, 2))
    another_walker: float = number(
        0.4, "nats", "a profile is of another walker, or was learnt from wrong positions: 2 in 5", PROFILES
    )
    wrong_start: float = number(-float(np.log(0.1)), "nats", "the start heading of a user is wrong: 1 in 10")
    compass_off: float = number(
        -float(np.log(0.0115)),
        "nats",
        "a compass is off to one side throughout: 1 in 87, 1 in 43 to either",
        "none of 21 real headings: mean of Beta(1/2, 1/2) after them",
    )
    wrong_plan: float = number(
        6.0,
        "nats",
        "a plan does not fit, at least",
        "right walls add 0 to 4.5 nats on 60 simulated and 45 real walks",
        still=(0.5, 1),
    )
    added_by_walls: float = number(
        0.25,
        "nats",
        "the same per measurement: those that the walls amount to, and the cost without walls",
        "right walls add 0.12 to 0.19 in laps of 12 min, and with fixes at 1 Hz; wrong ones, 3 m off, 0.3 to 2.3",
    )
    displaced_plan: float = number(
        3.0, "nats", "a plan, or the only position on it, is some metres off", "then simulated walks cost 0 to 5 nats"
    )


@dataclass(frozen=True)
class DoubtPriors(Table):
    """Which hypotheses about sources are solved, carried on, adopted and reported."""

    unlikely: float = number(5.0, "nats", "above the best from which a hypothesis is not carried on: 0.7 %")
    older: float = number(
        8.0,
        "nats",
        "per adopted hypothesis, live: its price, 5.5, and 2.5 of evidence from before the reviewed minutes",
    )
    lead: float = number(1.0, "nats", "by which other hypotheses must be better than the adopted ones")
    misplaced: float = number(6.0, "m", "sigma of the displacement of a plan or of the only position on it, per axis")
    span: float = number(120.0, "s", "of the walk in which sources are compared: twice the usual lag")
    least_sigma: float = number(1.0, "m", "of a place that is certain: the walls that tell it count again")
    least_sigma_heading: float = number(0.2, "rad", "of the heading there")


@dataclass(frozen=True)
class PathPriors(Table):
    """Distinct paths of a walk on a plan."""

    largest_sigma: float = number(
        2.7, "m", "in the worst direction, of a path that fixes determine: aisles lie three times as far apart"
    )
    fewest_fixes: int = number(3, "fixes", "that determine a path: two do not check one another")
    most_open: float = number(0.25, "share", "of the walk, at its end, that may be undetermined")


@dataclass(frozen=True)
class AnywherePriors(Table):
    """Particles all over a plan, for a walk without a position."""

    density: float = number(8.0, "1/m²", "of particles at first, in large plans", SEARCHED)
    most_density: float = number(50.0, "1/m²", "the same in small plans", SEARCHED)
    fewest: int = number(2000, "particles", "least number", SEARCHED)
    fewest_at_first: int = number(50_000, "particles", "least number at first", SEARCHED)
    per_bin: float = number(
        0.1, "m²", "particles per occupied bin of place and direction, times their density at first", SEARCHED
    )


@dataclass(frozen=True)
class ParticlePriors(Table):
    """The particle filter on a plan."""

    fewest: int = number(1000, "particles", "least number")
    most: int = number(8000, "particles", "largest number, of the batch", still=(0.5, 2))
    per_bin: int = number(
        20, "particles", "per occupied bin of position and direction; scales with the most", still=(0.5, 2)
    )
    wide: tuple[float, ...] = number(
        (1.5, 1.5, 2.0), "factor", "of the prior's sigmas: rare calibrations", still=(0.5, 2)
    )
    calm: tuple[float, ...] = number(
        (0.7, 0.7, 1.0), "factor", "of length, sway, turn: parts are common errors", still=(0.5, 2)
    )
    least_sigma: float = number(1.0, "m", "of a fix: particles are no denser", still=(0.5, 2))
    outlier_price: float = number(8.0, "log-odds", "largest of an outlier", still=(0.5, 2))
    doubted: float = number(0.2, "rad", "sigma of a turn that may be the phone's")
    clear_price: float = number(0.1, "log-odds", "of a step along a wall", still=(0.5, 2))
    stairs_sigma: float = number(1.0, "m", "from stairs or a lift at a floor change, whose time is rough")


@dataclass(frozen=True)
class KalmanPriors(Table):
    """The causal Kalman filter."""

    same: float = number(1.0, "σ", "from the best within which hypotheses are merged")
    patience: int = number(5, "fixes", "rejected in a row after which the filter is re-initialised")
    left_out: float = number(0.01, "probability", "of a wrong fix, above which a hypothesis goes on without it too")


@dataclass(frozen=True)
class LinePriors(Table):
    """A calibration walk along a known line."""

    farthest: float = number(0.8, "m", "rms distance from the line; simulated walkers stay within 0.4")
    strays: float = number(2.0, "m", "along the line by which a step may move from round to round")
    sway: float = number(0.3, "m", "lateral sigma of people who follow a line")
    usual: tuple[float, float, float] = number(
        (0.4, 0.05, 0.01), "-, -, rad/m", "sigmas of E_length, E_corner, E_straight"
    )


# Other estimates


@dataclass(frozen=True)
class StoreyPriors(Table):
    """Floors by barometer and fixes."""

    height: float = number(3.5, "m", "of a storey: flats 2.7, offices 3.3–4.2, shops 5", "building practice")
    spread: float = number(0.2, "log", "sigma of that height")
    scale_spread: float = number(0.08, "share", "sigma of a plan's heights: nominal ones, warm air")
    off: float = number(0.4, "m", "sigma of a storey's height, constant part")
    off_share: float = number(0.06, "share", "sigma of a storey's height, of the height")
    change: float = number(0.5, "nats", "cost of a change of floor")
    further: float = number(0.3, "nats", "cost of each storey of it: short climbs are more frequent")
    landing: float = number(1.0, "nats", "cost of a stop between floors")
    landing_time: float = number(60.0, "s", "in which that cost grows by 1")
    most_landing: float = number(2.0, "nats", "its maximum")
    other_floor: float = number(1.4, "nats", "cost of a fix on another floor: one in five")
    alike: int = number(5, "fixes", "on one floor that count at most: at one place they err alike")
    start: float = number(5.0, "nats", "cost of another floor than the stated start")
    unseen: float = number(10.0, "m", "sigma of the height of a climb without barometer")


@dataclass(frozen=True)
class ScanPriors(Table):
    """Radio maps, and places recognised by them."""

    window: int = number(4, "s", "of one scan: a phone needs 2 to 4 s for all channels")
    faintest: float = number(-100.0, "dBm", "level that counts as not received")
    exponent: float = number(2.7, "power", "of the dB above that: a scan is its strongest transmitters", POWED)
    fewest: int = number(3, "transmitters", "in a scan: one or two are received at too many places")
    neighbours: int = number(8, "fingerprints", "averaged for a position")
    agreed: float = number(0.8, "share", "of the neighbours' weight on one floor, else it is unknown")
    least_sure: float = number(3.0, "m", "largest sigma of a walk at its fingerprints")
    near: float = number(
        5.0, "m", "from a fingerprint within which a place is mapped; σ of a closure where there are few pairs"
    )
    accepted: tuple[float, float] = number(
        (0.05, 0.95), "quantile", "of the distance at mapped places: limits of σ and fix"
    )
    finest: float = number(0.5, "m", "least σ, since walkers pass a place within seconds")
    apart: float = number(10.0, "s", "beside a scan within which scans of the same walk are left out")
    shared: float = number(2.0, "factor", "of σ: a map's error at a place does not average out; 1.5 was too sure")
    scan_spacing: float = number(3.0, "m", "between scans that are used: levels repeat for seconds")
    along: float = number(30.0, "m", "in which closures to the same other walk have the same error")
    later: float = number(60.0, "s", "after which a return to a place is a revisit")
    accepted_pairs: float = number(0.8, "quantile", "of the distance of near pairs, beyond which they are dropped")
    usually_alike: float = number(0.3, "distance", "that quantile where there are few pairs", "fit: two malls")


@dataclass(frozen=True)
class TravelPriors(Table):
    """Walking, standing or riding by positions alone: straightness of the path, and net speed."""

    path: float = number(100.0, "m", "of path for walks")
    ride_path: float = number(600.0, "m", "of path for rides: about a street block")
    errors: float = number(2.0, "errors", "of a receiver, least path: shorter ones are straight by chance")
    crooked: float = number(0.6, "share", "below which a path leads nowhere: half a circle is 0.64", "geometry")
    context: float = number(600.0, "s", "window of the percentile")
    percentile: float = number(65.0, "%", "of displacements over ``lag``: a third may be turns or errands")
    lag: float = number(60.0, "s", "over which the wander is measured")
    scatter: float = number(3600.0, "s", "of positions whose scatter may be less than stated")
    window: float = number(40.0, "s", "over which net speeds are computed for the modes")
    lasts: float = number(300.0, "s", "usual duration of a mode")
    shuffling: float = number(0.05, "m/s", "speed while standing")
    walk: float = number(1.2, "m/s", "net speed of walkers, with turns and stops")
    walk_spread: float = number(0.4, "m/s", "its sigma")
    ride: float = number(7.0, "m/s", "net speed from bicycles to cars")
    ride_spread: float = number(0.9, "log", "its sigma")
    exceptions: float = number(
        0.1, "share", "of larger errors of a receiver, of a walk with turns and stops, of paths of any straightness"
    )
    waiting: float = number(0.15, "share", "of a ride in which it hardly moves")
    creeping: float = number(0.5, "m/s", "speed then")
    outlier_scale: float = number(3.0, "factor", "of these larger errors")
    shortest_ride: int = number(3, "epochs", "shorter ones are jumps of the receiver")


@dataclass(frozen=True)
class RidingPriors(Table):
    """Rides within a walk, by its steps and positions together."""

    speed: float = number(10.0, "m/s", "sigma per axis of the velocity: traffic in a town")
    slowest: float = number(1.0, "m/s", "faster than the steps, and than a receiver's error moves")
    shortest: float = number(150.0, "m", "beyond the steps: farther than a receiver jumps in a street")
    gradual: float = number(40.0, "m", "beyond them, without the longest jump; real walks on foot have up to 5 m")
    boarding: float = number(30.0, "s", "without steps at either end, while it is slow")
    beside: float = number(0.5, "share", "of the way between the fixes before and after, by which one lies beside it")
    alighted: float = number(15.0, "m", "walked since a ride under way, that end it")
    stepping: float = number(0.5, "share", "of its time on steps, above which it may be none")
    watched: float = number(60.0, "s", "of fixes in which a ride under way is sought")
    longest_stop: float = number(600.0, "s", "between two parts of one ride: a jam, a bus stop")
    at_stop: float = number(30.0, "m", "walked during such a stop, at most")
    pause: float = number(5.0, "s", "longest within a bout of walking: it ends with a rest of 3 s", "Kluge et al. 2021")
    fewest_steps: int = number(30, "steps", "of a bout between two parts of a ride")


@dataclass(frozen=True)
class TrackPriors(Table):
    """The smoothed track of positions alone; tuples are of standing, walking, riding and gaps."""

    fastest: float = number(40.0, "m/s", "on the ground")
    rails: float = number(100.0, "m/s", "of a train: 350 km/h", "timetables")
    jump: float = number(20.0, "fixes", "on either side to accept a faster jump, such as a flight")
    usual_intervals: float = number(
        5.0, "intervals", "a gap is longer than this many usual ones: the median of as many on either side"
    )
    longest: float = number(60.0, "s", "and than this: in a minute nobody walks round the block")
    silence: float = number(64_800.0, "s", "18 h: longer is always a gap; a visit bridges a night and a long morning")
    speed: tuple[float, ...] = number((0.05, 0.9, 7.0, 1.0), "m/s", "sigma of the speed per axis")
    keeps: tuple[float, ...] = number((1.0, 40.0, 100.0, 600.0), "s", "correlation time of the velocity")


# Live


@dataclass(frozen=True)
class Schedule(Table):
    """When the live smoother refines, reviews, searches and restarts its estimate."""

    late: float = number(3.0, "s", "by which fixes may come late while the direction is open")
    longest_ambiguous: float = number(180.0, "s", "after which the best path is accepted, with three fixes")
    longest_open: float = number(
        900.0, "s", "of a walk without position or direction, after which keyframes leave and the search is given up"
    )
    review_after: float = number(50.0, "s", "after which the batch solves a walk on a plan once more")
    search_after: float = number(20.0, "s", "from which a walk without position is sought on the plan")
    least_duration: float = number(
        25.0,
        "s",
        "of a first linearisation on a plan, unless fixes determine the direction: shorter walks fit several aisles",
    )
    most_sigma: float = number(0.5, "rad", "of the last heading, for a first linearisation")
    most_sigma_on_plan: float = number(0.35, "rad", "the same on a plan")
    doubted: float = number(3.0, "σ", "of a fix from the walk, beyond which the batch is asked")
    doubted_behind_wall: float = number(1.0, "σ", "the same of a fix in an area beyond a wall")


@dataclass(frozen=True)
class LivePathPriors(Table):
    """Other paths of a walk under way, by particles beside the graph."""

    fewest: int = number(500, "particles", "least number")
    most: int = number(1000, "particles", "largest; more are in the right aisle no more often")
    dominant: float = number(0.5, "share", "of the particles in one mode, whose path is tried")
    mostly: float = number(0.7, "share", "of the particles elsewhere, from which the heaviest mode is tried")
    spread: float = number(1.5, "factor", "of the graph's sigmas: it may be in the wrong aisle")
    least_share: float = number(0.02, "share", "of the particles, in a mode that counts")
    wall_price: float = number(4.0, "log-odds", "largest of a mode whose present position is inside walls")
    least_probability: float = number(0.1, "probability", "of the graph's way, however few particles are there")


@dataclass(frozen=True)
class FixesAlonePriors(Table):
    """The current position by fixes alone."""

    given_up: int = number(3, "fixes", "beyond the gate in a row, after which the position restarts")
    away: int = number(10, "fixes", "that agree, outside the region of the walk, after which the position is theirs")
    moved: float = number(10.0, "m", "least distance that they go meanwhile, and the walker's steps not half of it")


@dataclass(frozen=True)
class StandPriors(Table):
    """The current position of a walker who stands."""

    quiet: float = number(
        0.3, "m/s²", "largest spread of the acceleration's size over a second", "who stands has 0.2, 0.3 m/s 0.4 to 0.7"
    )
    seconds: float = number(3.0, "s", "without a step, and the same without a quiet second that ends it")
    steps: float = number(0.3, "m", "of steps below which there is none: provisional ones change by a little")
    held: float = number(2.0, "σ", "from the estimate, beyond which the position moves there")


@dataclass(frozen=True)
class MovementPriors(Table):
    """Movement in which no step is recognised."""

    longest: float = number(20.0, "s", "longest one without a doubt: the phone is lifted, tapped, put away")
    like_steps: float = number(0.5, "share", "of the spread of |a| in steps, from which a second is like them", LOST)
    missing: float = number(0.05, "share", "of the time on steps, from which the missing ones are said", LOST)


@dataclass(frozen=True)
class LiveFloorPriors(Table):
    """The floors of a walk under way."""

    silent: float = number(20.0, "s", "without barometer samples after which fixes are used alone")
    apart: float = number(120.0, "s", "between a sample and the steps at which its time stamp is wrong")


# Reports and verdicts of an estimate


@dataclass(frozen=True)
class ReportPriors(Table):
    """When a user is warned."""

    sure: float = number(0.9, "probability", "below which a user is warned")
    least_reported: float = number(0.01, "probability", "below which another walk is not reported")
    rejected: float = number(0.1, "weight", "below which a fix counts as rejected")
    many: float = number(0.1, "share", "of rejected fixes at which a user is warned")
    accepted: float = number(0.5, "weight", "below which a range has no line of sight, above which a fix is accepted")
    stride: tuple[float, float] = number((0.8, 1.2), "ratio", "stride scale R_s of usual walkers")
    crossed_anyway: float = number(
        0.01, "share", "of rows, beside one, through walls on right routes", "at most 1 of 15 to 222 rows of real walks"
    )


@dataclass(frozen=True)
class VerdictPriors(Table):
    """When a walk is doubtful or failed."""

    most: float = number(0.5, "share", "of a source that fails, with which it, or the walk, fails", VERDICT_SEEDS)
    doubtful: float = number(
        0.3, "share", "of rejected fixes of a doubtful walk; 0.3 still determine it", VERDICT_SEEDS
    )
    distant: float = number(3.0, "σ", "of the median above the expected one", VERDICT_SEEDS)
    alike: float = number(30.0, "s", "in which the errors of fixes are alike", VERDICT_SEEDS)
    jump: float = number(
        3.0, "σ", "of a receiver from the way of the steps; sound ones to 2.1", "36 walks, 3 of them real"
    )
    widest: float = number(
        12.0,
        "m",
        "median radius of the 90 % region beyond which the place counts as unknown",
        "50 runs of ten museum logs",
    )
    crossed: float = number(0.05, "share", "of rows through walls of a doubtful walk", VERDICT_SEEDS)
    strides: tuple[float, float] = number(
        (0.72, 1.6), "ratio", "of strides to those by height and pace, beyond which no position confirms them"
    )
    near_beacon: float = number(5.0, "m", "sigma of a position by a beacon, which may teach a stride")
    displaced: float = number(2.5, "σ", "of the offset of a receiver from which the ways show it", VERDICT_SEEDS)
    fewest_crossings: int = number(3, "rows", "a corner that is cut is no contradiction", VERDICT_SEEDS)


STEP, CANDIDATE, BOUT, CONFIDENCE = StepPriors(), CandidatePriors(), BoutPriors(), ConfidencePriors()
STRIDES, TREADS, MOTION = StridePriors(), TreadPriors(), MotionPriors()
IRREGULARITY = IrregularityPriors()
FORWARD, GRIP, COMPASS, LIVE_COMPASS = ForwardPriors(), GripPriors(), CompassPriors(), LiveCompassPriors()
REST, MAGNETOMETER, NORTH = RestPriors(), MagnetometerPriors(), NorthPriors()
CLIMB, KIND = ClimbPriors(), KindPriors()
LOSSES, WALKER, WALLS, REGIONS = LossPriors(), WalkerPriors(), WallPriors(), RegionPriors()
CORRIDOR, TURNS, WAYS, PLANS = CorridorPriors(), TurnPriors(), WayPriors(), PlanPriors()
FIXES, RECEIVERS, BEACONS, RANGES = FixPriors(), ReceiverPriors(), BeaconPriors(), RangePriors()
LEARNED = LearnedPriors()
INITIAL, SEARCH = InitialPriors(), SearchPriors()
PRICES, DOUBTS, PATHS, ANYWHERE = PricePriors(), DoubtPriors(), PathPriors(), AnywherePriors()
PARTICLES, KALMAN = ParticlePriors(), KalmanPriors()
LINE, STOREYS, SCANS = LinePriors(), StoreyPriors(), ScanPriors()
TRAVEL, TRACK, RIDING = TravelPriors(), TrackPriors(), RidingPriors()
SCHEDULE, LIVE_PATHS = Schedule(), LivePathPriors()
FIXES_ALONE, STAND, MOVEMENT, LIVE_FLOORS = FixesAlonePriors(), StandPriors(), MovementPriors(), LiveFloorPriors()
REPORTS, VERDICTS = ReportPriors(), VerdictPriors()
