"""Unit and sign of a sensor by its samples, of a file or as they arrive; gravity that the recorder removed.

A phone that lies face up measures +9.81 m/s² along z on Android, and -1 g by CoreMotion on an iPhone. If the sign is
wrong, up is down, and the walk comes out as its mirror image. No law of motion can tell: accelerations of the opposite
sign are those of the mirrored world, in which the same laws hold. Only what is no motion tells: the unit, how people
hold a phone, the dip of the magnetic field, and fixes. Each is a log-odds in `AccelerationSign`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.inertial.sensor_stream import SENSOR_VALIDATION
from pdr_graph.types import STANDARD_GRAVITY, Array, Contradiction, Mask, Signal

GRAVITY = (8.0, 11.5)  # [m/s²] accepted means over WINDOW; 9.5–10.2 on real walks
GRAVITY_IN_G = (0.85, 1.15)  # [g] the same range for a recorder that writes g
MIS_SCALED = (6.0, 15.0)  # [m/s²] medians of an accelerometer with an axis of another scale: 7.3 upright, 9.81 flat
PULL = 0.05  # weight of a scale of 1, as a share of that of all windows
WINDOW = 2.0  # [s] one or two strides, over which the walker's own acceleration averages out
ACCEPTED_FIELD = (4.0, 5000.0)  # [µT] accepted medians: the earth's field has 22 to 67, a phone's iron up to 2000
FIELD_UNITS = ((1e-3, "T", 1e6), (0.15, "mT", 1e3), (4.0, "gauss", 100.0), (np.inf, "nT", 1e-3))  # below which median
FASTEST_TURN = 10.0  # [rad/s] median angular rate; larger values can only be deg/s
PLATFORMS = "android", "ios"
G, METRIC, WEB = "g", "m/s²", "m/s², turns in °/s"  # units that tell of the sign; the last is of browsers
# Log-odds of the opposite sign: g is CoreMotion's unit, and Expo's on Android too; m/s² are Android's, and Safari's
BY_UNIT = {G: 2.0, METRIC: -2.0, WEB: 0.0}
BY_PLATFORM = 6.0  # of Android for its own sign; of iOS, in g, for the opposite one: plug-ins in m/s² convert it or not
FACE_UP = 4.0  # log-odds that a phone held level and steady while walking faces up: all of 12 persons
BY_DIP = 6.0  # log-odds of a field that points as the earth's: never the wrong way in 700 windows of 10 s of 81 walks
MOST_BY_FIXES = 8.0  # log-odds
HELD = 7.0, 9.0  # [°] largest sway of a phone in the hand, 2 to 6.8, and from which it is in a pocket, 4.4 to 13
LEVEL = 0.2, 0.4  # [g] along x: a screen that is read is level, up to 0.17; in a pocket it may lie askew
WALKED = 0.08  # swing of the magnitude in a window of walking
PARTS = 8  # of a window, whose mean directions are compared
MOST_WINDOWS = 10  # of walking, after which the posture is known
FACING = 0.3, 0.5  # [g] along z from which a phone faces up or down a little, and fully
FEWEST_WINDOWS = 2.0  # facing up or down, for the full log-odds
LEAST_ODDS = 0.25  # log-odds from which another sign is taken
SURE_ODDS = 2.5  # log-odds below which the sign is a guess, as by unit alone
IMPLAUSIBLE = 1e12  # times [s] and values in any unit from here on are damage, as are NaN and infinity


def unit_of(path: str, sensor: str, signal: Signal, notes: list[str]) -> tuple[str, float]:
    """The kind of a sensor by its values, and the factor that converts them to SI units, hPa and µT.

    An accelerometer whose recorder removed gravity is of the kind ``linear_acceleration``: over a stride the walker's
    acceleration averages out, and gravity remains. Raises InputError if an accelerometer's unit is not recognised.
    """
    median = float(np.median(signal.values if sensor == "barometer" else np.linalg.norm(signal.values, axis=1)))
    if sensor == "gyroscope" and median > FASTEST_TURN:
        notes.append(f"gyroscope: a median of {median:.1f} can only be degrees per second; converted to rad/s")
        return sensor, np.pi / 180
    if sensor == "barometer" and not 200 <= median <= 2000:  # people walk at 400–1050 hPa
        unit, factor = ("Pa", 0.01) if median > 2000 else ("kPa", 10.0)
        notes.append(f"barometer: a median of {median:.5g} can only be in {unit}; converted to hPa")
        return sensor, factor
    if sensor == "magnetometer" and median > 0 and not ACCEPTED_FIELD[0] <= median <= ACCEPTED_FIELD[1]:
        unit, factor = next((unit, factor) for most, unit, factor in FIELD_UNITS if median < most)
        notes.append(f"magnetometer: a median of {median:.3g} can only be in {unit}; converted to µT")
        return sensor, factor
    if sensor != "accelerometer":
        return sensor, 1.0
    _, typical, means, swing = _windows(signal)
    gravity, spread = float(np.median(means)), float(np.median(typical * swing))
    if GRAVITY[0] <= gravity <= GRAVITY[1] + 1.5 * spread:  # a runner's arm pulls at the phone as hard as gravity does
        return sensor, 1.0
    if GRAVITY_IN_G[0] <= gravity <= GRAVITY_IN_G[1] + 1.5 * spread and gravity > 0.7 * median:
        notes.append(f"accelerometer: gravity is {gravity:.3f}: the unit is g; converted to m/s²")
        return sensor, STANDARD_GRAVITY
    if gravity < 0.5 * median and median < GRAVITY[0]:
        notes.append(f"accelerometer: gravity is {gravity:.3f} m/s²: the recorder removed it")
        return "linear_acceleration", 1.0
    expected = f"{STANDARD_GRAVITY:.2f} m/s², 1 g, or 0 where the recorder removes it"
    raise InputError(path, sensor, f"gravity of {gravity:.3f} (median of {WINDOW:.0f} s means)", expected)


def in_g(values: Array) -> bool:
    """True if accelerations with gravity ``(n, 3)`` of half a second or more are in g, False in m/s²."""
    # twice as wide as over WINDOW: half a second may hold half a step
    return GRAVITY_IN_G[0] / 2 < float(np.linalg.norm(values.mean(axis=0))) < 2 * GRAVITY_IN_G[1]


def axis_scales(signal: Signal) -> Array | None:
    """Factors ``(3,)`` of the axes of an accelerometer whose gravity is not 9.81 m/s² in each attitude of the phone.

    Σ (s_i g_i)² is that of gravity in each window with the mean g; an axis that no window determines has 1. None if
    gravity is as usual, is not there, or stays wrong: then the unit is another.
    """
    _, typical, gravity, _ = _windows(signal)
    low, high = MIS_SCALED
    usual = GRAVITY[0] <= np.median(gravity) <= GRAVITY[1]
    if usual or not low <= np.median(gravity) <= high or np.median(gravity) < 0.7 * np.median(typical):
        return None
    samples = min(max(1, round(WINDOW * signal.rate)), len(signal))
    windows = signal.values[: len(gravity) * samples].reshape(len(gravity), samples, 3)
    squares = np.vstack([(windows.mean(axis=1) / STANDARD_GRAVITY) ** 2, PULL * np.sqrt(len(gravity)) * np.eye(3)])
    ones = np.append(np.ones(len(gravity)), np.full(3, PULL * np.sqrt(len(gravity))))
    scales = np.sqrt(np.clip(np.linalg.lstsq(squares, ones, rcond=None)[0], low / high, high / low))
    scaled = _windows(Signal(signal.time, signal.values * scales))[2]
    return scales if np.mean((scaled >= GRAVITY[0]) & (scaled <= GRAVITY[1])) > 0.9 else None


@dataclass
class WindowBuffer:
    """Packets of samples until they fill a window of `WINDOW`."""

    time: list[Array] = field(default_factory=list)
    values: list[Array] = field(default_factory=list)

    def filled(self, time: Array, values: Array) -> Signal | None:
        """Add samples ``(n,)`` [s], ``(n, k)``; returns the window that they complete, without damaged samples."""
        self.time.append(time)
        self.values.append(values)
        if not len(time) or abs(self.time[-1][-1] - self.time[0][0]) < WINDOW:
            return None
        time, values = np.concatenate(self.time), np.concatenate(self.values)
        usable = np.isfinite(time) & (np.abs(values) < IMPLAUSIBLE).all(axis=1)
        window = Signal(time[usable], values[usable])
        complete = len(window) > 0 and abs(window.time[-1] - window.time[0]) >= WINDOW
        self.time, self.values = ([], []) if complete or not len(window) else ([window.time], [window.values])
        return window if complete else None


@dataclass
class SensorUnit:
    """The unit of a sensor's samples by their values, as in files; once another than the expected is sure it is kept.

    sensor: its name; factor: to its unit; gravity: restores what the recorder removed, None if it did not; note: what
    differs from the expected, "" without; before: found in the last window; window: samples of the present one.
    """

    sensor: str
    factor: float = 1.0
    gravity: GravityRestorer | None = None
    note: str = ""
    before: tuple[str, float, str] = ("", 1.0, "")
    window: WindowBuffer = field(default_factory=WindowBuffer)

    def watch(self, time: Array, values: Array) -> None:
        """Examine samples ``(n,)`` [s], ``(n, k)``: two windows of `WINDOW` in a row that agree decide."""
        if self.note or not len(time) or (window := self.window.filled(time, values)) is None:
            return
        notes = list[str]()
        try:
            kind, factor = unit_of("", self.sensor, window, notes)
        except InputError as error:
            kind, factor, notes = self.sensor, 1.0, [f"{self.sensor}: {error.wrong}"]
        found = kind, factor, "".join(notes)
        if found[2] and self.before[2] and found[:2] == self.before[:2]:
            self.factor, self.note = factor, found[2]
            self.gravity = GravityRestorer() if kind != self.sensor else None
        self.before = found

    def converted(self, values: Array) -> Array:
        """Samples ``(n, k)`` in the expected unit, with gravity."""
        values = values if self.factor == 1.0 else self.factor * values
        return values if self.gravity is None else self.gravity.restored(values)


@dataclass
class AccelerationSign:
    """Whether accelerations have the sign opposite to Android's, as those of CoreMotion and Safari, by all evidence.

    platform: one of PLATFORMS if it is stated, else ""; unit: of BY_UNIT; known: log-odds of the opposite sign by what
    read the samples, in place of those by unit and posture, None without; sign: by which the accelerations are
    multiplied, 1 or -1; dip, fixes: log-odds of the opposite sign by the magnetic field and by fixes; up, faced: sums
    over the windows of walking so far, of which the posture is the ratio; windows, walked: number of windows so far.
    """

    platform: str = ""
    unit: str = METRIC
    known: float | None = None
    sign: float = 1.0
    dip: float = 0.0
    fixes: float = 0.0
    up: float = 0.0
    faced: float = 0.0
    windows: int = 0
    walked: int = 0
    window: WindowBuffer = field(default_factory=WindowBuffer)

    @classmethod
    def of(cls, signal: Signal, unit: str = METRIC, known: float | None = None) -> AccelerationSign:
        """The sign of a whole signal ``(n, 3)`` by unit and posture, or by what is known."""
        found = cls(unit=unit, known=known)
        samples = max(2, round(WINDOW * signal.rate) + 2)
        for first in range(0, len(signal) - samples + 1, samples):
            found.watch(signal.time[first : first + samples], signal.values[first : first + samples])
        found.windows = 2
        found.decide()
        return found

    def watch(self, time: Array, values: Array) -> None:
        """Examine samples ``(n,)`` [s], ``(n, 3)`` in any unit: which way a phone faces that is held while walking."""
        if self.walked >= MOST_WINDOWS or not len(time) or (window := self.window.filled(time, values)) is None:
            return
        self.windows += 1
        size = np.linalg.norm(window.values, axis=1)
        mean = window.values.mean(axis=0)
        gravity = float(np.linalg.norm(mean))
        if len(window) < 2 * PARTS or size.std() <= WALKED * np.median(size) or gravity < np.median(size) / 2:
            return
        parts = np.array([part.mean(axis=0) for part in np.array_split(window.values, PARTS)])
        along = parts @ mean / gravity
        across = np.sqrt(np.maximum((parts**2).sum(axis=1) - along**2, 0.0))
        sway = np.degrees(np.sqrt(np.mean(np.arctan2(across, along) ** 2)))
        if sway > 2 * HELD[1]:
            return  # it is shaken, or handled
        self.walked += 1
        held = np.prod(
            [
                np.clip((most - value) / (most - least), 0.0, 1.0)
                for value, (least, most) in ((sway, HELD), (abs(mean[0]) / gravity, LEVEL))
            ]
        )
        share = float(np.clip((abs(mean[2]) / gravity - FACING[0]) / (FACING[1] - FACING[0]), 0.0, 1.0)) ** 2
        self.up += float(held) * share * np.sign(mean[2])
        self.faced += share

    @property
    def posture(self) -> float:
        """Log-odds of the opposite sign by the posture so far; a phone that stands upright tells nothing."""
        return -FACE_UP * self.up / max(self.faced, FEWEST_WINDOWS)

    @property
    def by_unit(self) -> float:
        """Log-odds of the opposite sign by unit and platform."""
        if self.platform == "ios":
            return BY_PLATFORM if self.unit == G else BY_UNIT[WEB]
        return -BY_PLATFORM if self.platform else BY_UNIT[self.unit]

    @property
    def log_odds(self) -> float:
        """Log-odds of the opposite sign by all evidence."""
        return (self.by_unit + self.posture if self.known is None else self.known) + self.dip + self.fixes

    @property
    def probability(self) -> float:
        """Probability of the present sign."""
        return float(1 / (1 + np.exp(self.sign * self.log_odds)))

    def decide(self) -> bool:
        """Take the more probable sign, from the second window on; True if it changed."""
        changed = self.windows > 1 and self.sign * self.log_odds > LEAST_ODDS
        self.sign = -self.sign if changed else self.sign
        return changed

    def observe(self, dip: float = 0.0, fixes: float = 0.0) -> None:
        """Add evidence of the walk at the present sign: log-odds that up is down. The strongest of each kind counts."""
        dip, fixes = self.sign * dip, self.sign * float(np.clip(fixes, -MOST_BY_FIXES, MOST_BY_FIXES))
        self.dip = dip if abs(dip) > abs(self.dip) else self.dip
        self.fixes = fixes if abs(fixes) > abs(self.fixes) else self.fixes

    @property
    def note(self) -> str:
        """What was converted, by which evidence; "" for Android's sign."""
        if self.sign > 0:
            return ""
        unit = "platform and unit" if self.platform else f"its unit ({self.unit})"
        evidence = {unit: self.by_unit, "the posture of the phone": self.posture} if self.known is None else {}
        evidence |= {"the dip of the magnetic field": self.dip, "the turns between fixes": self.fixes}
        by = ", ".join(name for name, odds in evidence.items() if odds > LEAST_ODDS)
        return f"accelerometer: the sign is opposite to Android's ({self.probability:.0%} by {by}): converted"

    def contradictions(self) -> tuple[Contradiction, ...]:
        """The doubt about the sign, if it is a guess after some seconds of walking."""
        if self.walked <= FEWEST_WINDOWS or abs(self.log_odds) >= SURE_ODDS:
            return ()
        text = f"the sign of the accelerations is {self.probability:.0%} sure: the walk may be its mirror image"
        check = "platform='android' or 'ios'; a magnetometer, or fixes around a corner, tell too"
        return (Contradiction("accelerometer", "its sign", self.probability, "probability", text, check),)


@dataclass
class GravityRestorer:
    """Restores gravity that the recorder removed, along the axis of the largest motion so far.

    A walker bounces more than they sway. The sign of the axis assumes that the phone faces up or stands upright rather
    than upside down. On real walks with the phone in hand the axis is within 3–9° of the vertical and gives the same
    steps and turns.

    moments: ``(4, 4)`` sums of the products of (1, x, y, z) of the accelerations.
    """

    moments: Array = field(default_factory=lambda: np.zeros((4, 4)))

    @property
    def used(self) -> bool:
        """True once it has restored a sample."""
        return bool(self.moments[0, 0] > 0)

    def restored(self, values: Array) -> Array:
        """Accelerations with gravity ``(n, 3)`` from accelerations without. [m/s²]"""
        valid = (np.abs(values) < SENSOR_VALIDATION.largest).all(axis=1)
        ones = np.concatenate([np.ones((len(values), 1)), values], axis=1)[valid]
        self.moments = self.moments + ones.T @ ones
        count, total = self.moments[0, 0], self.moments[0, 1:]
        covariance = self.moments[1:, 1:] - np.outer(total, total) / max(count, 1.0)
        vertical = np.linalg.eigh(covariance)[1][:, -1]
        up = np.sign(vertical[1:][np.argmax(np.abs(vertical[1:]))] or 1.0)
        return values + STANDARD_GRAVITY * up * vertical


def _windows(signal: Signal) -> tuple[Array, Array, Array, Array]:
    """Begin [s], median magnitude, magnitude of the mean vector, and swing of each window of WINDOW.

    Swing is the standard deviation of the magnitude over its median. The last samples, which fill no window, are left
    out.
    """
    samples = min(max(1, round(WINDOW * signal.rate)), len(signal))
    number = len(signal) // samples
    values = signal.values[: number * samples].reshape(number, samples, -1)
    size = np.linalg.norm(values, axis=2)
    typical = np.median(size, axis=1)
    swing = size.std(axis=1) / np.maximum(typical, np.finfo(float).tiny)
    return signal.time[: number * samples : samples], typical, np.linalg.norm(values.mean(axis=1), axis=1), swing


def check_one_unit(path: str, signals: dict[str, Signal]) -> None:
    """Raise InputError if a sensor's unit changes: acceleration from m/s² to g, angular rate from rad/s to deg/s, or
    back. Windows without gravity or steps fit both units and are not counted.
    """
    if "accelerometer" not in signals:
        return
    time, typical, mean, swing = _windows(signals["accelerometer"])
    # gravity: the mean is within the limits, and the median magnitude of a walk within a factor of 1.4 of them
    metric, in_g = (
        (mean >= low) & (mean <= high) & (typical >= low / 1.4) & (typical <= high * 1.4)
        for low, high in (GRAVITY, GRAVITY_IN_G)
    )
    _refuse_mixture(path, "accelerometer", time, typical, (metric, in_g), ("m/s²", "g"))
    if "gyroscope" in signals:
        moment, rate, _, _ = _windows(signals["gyroscope"])
        effort = np.interp(moment, time, swing)
        walking = effort > 0.1  # a phone that lies or is held still turns slowly
        in_degrees = walking & (rate > FASTEST_TURN)
        in_radians = walking & (rate <= FASTEST_TURN) & (rate > 0)
        if in_degrees.any() and in_radians.any():
            ratio, harder = (np.median(v[in_degrees]) / np.median(v[in_radians]) for v in (rate, effort))
            if 0.5 < np.radians(ratio) < 2 and 2 / 3 < harder < 1.5:  # else a ride and a run in deg/s
                _refuse_mixture(path, "gyroscope", moment, rate, (in_radians, in_degrees), ("rad/s", "deg/s"))


def _refuse_mixture(
    path: str, sensor: str, time: Array, typical: Array, which: tuple[Mask, Mask], units: tuple[str, str]
) -> None:
    """Raise InputError if two windows or more are in each of two units."""
    first, second = which
    if min(first.sum(), second.sum()) < 2:
        return
    counted = np.flatnonzero(first | second)
    change = counted[np.flatnonzero(np.diff(second[counted].astype(int)))[0] + 1]
    before, after = units if second[change] else units[::-1]
    at, value = time[change] - time[0], typical[change]
    found = f"values in {before}, and from {at:.0f} s on in {after}: a median of {value:.3g}"
    raise InputError(path, sensor, found, "one unit throughout (two recordings in one file?)")
