"""The walker: ``walker.toml``, stride models, and the personal calibration of [calibration-walk] Sec. 3.3.

A stride model is one function per published model. It returns length and standard deviation ``(n,)`` [m] of every step.
The standard deviation is that of one step about the model, in addition to the walker's scale R_s; if the source gives
none it is a share of the length.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import cache, cached_property
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdr_graph.errors import InputError, one_line, read_toml
from pdr_graph.priors import MOTION, STRIDES
from pdr_graph.types import Array, OneLineRepr, Steps
from pdr_graph.whole_files import write_file

if TYPE_CHECKING:
    from pdr_graph.gait.steps import GaitSignals

BANDS = np.linspace(0.0, 5.0, 5)  # [Hz] [calibration-walk] uses four bands of 0–5 Hz; their edges are not published


@dataclass(frozen=True)
class StepFeatures:
    """Features of the n steps of an uninterrupted part of a recording, computed on first use."""

    gait: GaitSignals

    @property
    def amplitude(self) -> Array:
        """Amplitude of |a|, peak to peak ``(n,)``. [m/s²]"""
        return self.gait.landings.amplitude

    @property
    def period(self) -> Array:
        """Duration of a step ``(n,)``. [s]"""
        return self.gait.landings.period

    @property
    def rhythm(self) -> Array:
        """Duration of a step around each one ``(n,)``. [s]"""
        return self.gait.landings.rhythm

    @cached_property
    def turn(self) -> Array:
        """Heading change over the step ``(n,)``. [rad]"""
        return self._turned(self.period)

    @cached_property
    def bend(self) -> Array:
        """Half the heading change over the stride, which excludes the sway from step to step ``(n,)``. [rad]"""
        return self._turned(2 * self.period) / 2

    @property
    def vertical(self) -> Array:
        """Vertical acceleration, peak to peak ``(n,)``. [m/s²]"""
        return self._lifts[:, 0]

    @property
    def lift(self) -> Array:
        """Time from lift to landing of the foot: minimum to maximum of the vertical acceleration ``(n,)``. [s]"""
        return self._lifts[:, 1]

    @cached_property
    def power(self) -> Array:
        """Power of |a| around each landing, in four bands of 0–5 Hz ``(n, 4)``; the first has gravity's. [m²/s⁴]"""
        attitude, window = self.gait.attitude, 2.0  # [s] chosen by hand
        magnitude = np.linalg.norm(attitude.acceleration, axis=1)
        count = min(max(4, round(window / attitude.period)), len(magnitude))
        middle = np.searchsorted(attitude.time, self.gait.landings.time)
        first = np.clip(middle - count // 2, 0, len(magnitude) - count)
        windows = magnitude[first[:, None] + np.arange(count)]
        taper = np.hanning(count)
        spectrum = np.abs(np.fft.rfft(windows * taper, axis=1)) ** 2 / (taper**2).sum() / count
        band = np.digitize(np.fft.rfftfreq(count, attitude.period), BANDS) - 1
        return np.stack([spectrum[:, band == b].sum(axis=1) for b in range(len(BANDS) - 1)], axis=1)

    def _turned(self, duration: Array) -> Array:
        landed, time, heading = self.gait.landings.time, self.gait.attitude.time, self.gait.direction.heading
        return np.interp(landed, time, heading) - np.interp(landed - duration, time, heading)

    @cached_property
    def _lifts(self) -> Array:
        """Vertical acceleration, peak to peak [m/s²], and time from minimum to maximum [s] of each step ``(n, 2)``."""
        from scipy.ndimage import gaussian_filter1d  # here, since walkers are read where no steps are detected

        attitude, landings = self.gait.attitude, self.gait.landings
        smoothing = 0.05  # [s] Gaussian; chosen by hand
        up = attitude.R_world_device.apply(attitude.acceleration)[:, 2]
        smooth = gaussian_filter1d(up, smoothing / attitude.period)
        found = np.zeros((len(landings), 2))
        for n, (landed, period) in enumerate(zip(landings.time, landings.period, strict=True)):
            first, middle, last = np.searchsorted(attitude.time, landed + period * np.array([-0.8, -0.3, 0.3]))
            high = middle + int(np.argmax(smooth[middle : last + 1])) if middle < len(smooth) else len(smooth) - 1
            low = first + int(np.argmin(smooth[first : high + 1]))
            found[n] = smooth[high] - smooth[low], max(high - low, 1) * attitude.period
        return found


REFERENCE_HEIGHT = 1.70  # [m] stature for which models without stature were fitted
LARGEST_BEND = 89.0  # [deg] turn of a step from which [map-matching] Eq. (2) leaves it no length
Lengths = tuple[Array, Array]


def inverted_pendulum(steps: StepFeatures, height: float = REFERENCE_HEIGHT) -> Lengths:
    """The default: the bounce of the body (Zijlstra & Hof 2003: a leg is an inverted pendulum), L = k₀ + k₁ √(A T).

    A is the peak-to-peak amplitude of |a| at the frequency of the steps, T the duration of a step. A pendulum's chord
    grows with √A T. But who walks slowly sways and lands softly, so that √A T is the same at 0.4 and at 1.5 m/s; with
    √(A T) lengths hold from 0.3 to 1.5 m/s, whichever walker the fit leaves out (``scripts/reproduce steps``). k₀ is
    most of a step: how hard a foot lands also depends on shoes, floor and pocket. Both scale with stature. In bends
    steps are shorter by [map-matching] Eq. (2), which real walks confirm (1.1 % per degree; ``scripts/reproduce
    steps``).

    Steps that are short and strong are those of a run. Their bounce hardly grows with the speed (Cavagna et al. 1988),
    so that their length is by cadence alone, and off by a fifth: `pace_changes` widens the calibration.
    """
    straight_on = STRIDES.k0 + STRIDES.k1 * np.sqrt(steps.amplitude * steps.period)
    strong = np.clip((steps.amplitude - STRIDES.run_amplitude[0]) / np.ptp(STRIDES.run_amplitude), 0, 1)
    short = np.clip((STRIDES.run_period[1] - steps.rhythm) / np.ptp(STRIDES.run_period), 0, 1)
    run = STRIDES.run * (0.4 / steps.period) ** STRIDES.run_cadence
    length = straight_on + strong * short * (run - straight_on)
    return _plausible(_in_turns(steps.bend) * length * height / REFERENCE_HEIGHT)


def by_height(steps: StepFeatures, height: float = REFERENCE_HEIGHT) -> Lengths:
    """[calibration-walk] Eq. (6): L = 0.26 h + 0.31, the same for every step."""
    return _plausible(np.full(len(steps.period), 0.26 * height + 0.31))


def by_cadence(
    steps: StepFeatures,
    height: float = REFERENCE_HEIGHT,
    normal_step: float = 0.70,
    normal_cadence: float = 111.0,
) -> Lengths:
    """[map-matching] Eqs. (1) to (3): L = R/100 · C r_c, with cadence C, r_c = L₀ / C₀, and R = 100 − a |θ| percent
    in turns, θ the heading change of the step in degrees, here up to 89°.

    normal_step: L₀ [m]; normal_cadence: C₀ [steps/min], by default of an average person; height is not used.
    """
    return _plausible(_in_turns(steps.turn) * 60 / steps.period * normal_step / normal_cadence)


def _in_turns(turn: Array) -> Array:
    """[map-matching] Eq. (2): length of steps that turn by ``turn (n,)`` [rad], as a share of that straight on."""
    return 1 - STRIDES.turn_shortens / 100 * np.minimum(np.degrees(np.abs(turn)), LARGEST_BEND)


def by_amplitude(
    steps: StepFeatures,
    height: float = REFERENCE_HEIGHT,
    intercept: float = 0.445,
    slope: float = 0.0335,
    variance: float = 0.01,
) -> Lengths:
    """[gps-dr] Sec. 2.3: linear in the amplitude of the vertical acceleration, L = intercept + slope A.

    intercept [m], slope [s²] and variance [m²] are one person's, from `regression`; height is not used.
    """
    length, _ = _plausible(intercept + slope * steps.vertical)
    return length, np.full(len(length), np.sqrt(variance))


def regression(amplitude: Array, length: Array) -> dict[str, float]:
    """Fit one person's constants of `by_amplitude` to amplitudes [m/s²] and lengths [m] of steps, both ``(n,)``.

    Raises ValueError for fewer than three steps, or equal amplitudes.
    """
    if len(amplitude) < 3 or np.ptp(amplitude) == 0:
        raise ValueError(f"found {len(amplitude)} steps, expected three or more with different amplitudes")
    slope, intercept = np.polyfit(amplitude, length, 1)
    residual = length - intercept - slope * amplitude
    variance = float(residual @ residual / (len(residual) - 2))
    return {"intercept": float(intercept), "slope": float(slope), "variance": variance}


def weinberg(steps: StepFeatures, height: float = REFERENCE_HEIGHT, k: float = 0.425) -> Lengths:
    """Weinberg 2002 (Analog Devices AN-602): L = k · (a_max − a_min)^¼ of the vertical acceleration.

    k [m^¾ s^½]: by default fitted to Microsoft's walks (``scripts/reproduce steps``); height is not used.
    """
    return _plausible(k * steps.vertical**0.25)


def lasso(steps: StepFeatures, height: float = REFERENCE_HEIGHT) -> Lengths:
    """[calibration-walk] Eq. (7): L = K₀ h/T + K₁ P₀ + K₂ P₁ + K₃ P₂ + K₄ P₃; T from lift to landing, P the power of
    |a| in four bands of 0–5 Hz.

    The weights are not published; ours are of 60 simulated walkers (`lab.papers.calibration_walk.eq7`). The band of P₀
    begins at 0 Hz, so that gravity gives the model its constant.
    """
    return _plausible(lasso_features(steps, height) @ lasso_weights())


def lasso_features(steps: StepFeatures, height: float) -> Array:
    """The five terms of [calibration-walk] Eq. (7), ``(n, 5)``."""
    return np.column_stack([height / steps.lift, steps.power])


@cache
def lasso_weights() -> Array:
    """The weights K₀ … K₄ of `lasso` ``(5,)``."""
    with resources.files("pdr_graph.gait").joinpath("lasso.csv").open() as file:
        return np.loadtxt(file, delimiter=",", skiprows=1, usecols=1)


MODELS: dict[str, Callable[..., Lengths]] = {
    "inverted pendulum": inverted_pendulum,
    "height": by_height,
    "cadence": by_cadence,
    "amplitude": by_amplitude,
    "weinberg": weinberg,
    "lasso": lasso,
}


def _plausible(length: Array) -> Lengths:
    """Lengths clipped to 0.2–1.8 m, and their standard deviation."""
    length = np.clip(length, 0.2, 1.8)
    return length, STRIDES.sigma * length


COEFFICIENTS = ("E_length", "E_straight", "E_corner")


@dataclass(frozen=True)
class Profile(OneLineRepr):
    """A walker's personal calibration: how their steps and turns differ from the models.

    E_length: distance error per metre [-]; E_straight: heading error per metre walked [rad/m]; E_corner: turn error per
    turn [-]. covariance: ``(3, 3)`` of the three in this order; residual: root mean square distance of the calibration
    walk from its known route [m]; speed: of that walk, by the models [m/s].
    """

    E_length: float
    E_straight: float
    E_corner: float
    covariance: Array
    residual: float
    speed: float

    def _summary(self) -> list[str]:
        sigmas = np.sqrt(np.diagonal(self.covariance))
        errors = [f"{n} {getattr(self, n):.3g} ± {s:.2g}" for n, s in zip(COEFFICIENTS, sigmas, strict=True)]
        return [*errors, f"residual {self.residual:.2f} m"]

    def corrected(self, steps: Steps) -> Steps:
        """The steps corrected by [calibration-walk] Eqs. (8), (9), with E_straight on the uncorrected length."""
        drift = self.E_straight * steps.length
        return replace(
            steps,
            length=(1 + self.E_length) * steps.length,
            turn=(1 + self.E_corner) * steps.turn + drift,
            pause_turn=(1 + self.E_corner) * steps.pause_turn,
            sigma_length=np.where(steps.is_gap, 1.0, 1 + self.E_length) * steps.sigma_length,
            final_turn=(1 + self.E_corner) * steps.final_turn,
        )


DEFAULT_STRIDE = "inverted pendulum"
LARGEST_SETTING = 3  # height [m] and heading error per step [rad]; a larger value is in another unit


@dataclass(frozen=True)
class Walker(OneLineRepr):
    """The walker: stature, stride model and personal calibration.

    height: stature [m].
    sigma_turn: standard deviation of the heading error that one step adds [rad]: the body sways about the phone.
    stride: the stride model, a key of `MODELS`; constants: its constants by name.
    profile: personal calibration, None if unknown.
    """

    height: float = REFERENCE_HEIGHT
    sigma_turn: float = field(default_factory=lambda: MOTION.turn)
    stride: str = DEFAULT_STRIDE
    constants: dict[str, float] = field(default_factory=dict)
    profile: Profile | None = None

    def __post_init__(self) -> None:
        """Raise ValueError for impossible values (a height in centimetres) and unknown stride models."""
        for name, unit in (("height", "metres"), ("sigma_turn", "radians")):
            value = getattr(self, name)
            number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
            if not number or not 0 < value < LARGEST_SETTING:
                raise ValueError(f"Walker.{name}: found {value!r}, expected {unit} between 0 and {LARGEST_SETTING}")
        if self.stride not in MODELS:
            raise ValueError(f"Walker.stride: found {self.stride!r}, expected one of {', '.join(MODELS)}")

    def _summary(self) -> list[str]:
        return [f"height {self.height:g} m", f"stride {self.stride!r}", *(["calibrated"] if self.profile else [])]

    @classmethod
    def load(cls, path: str | Path) -> Walker:
        """The walker in a ``walker.toml`` (``docs/formats.md``), in which every name is optional. Raises InputError."""
        table = read_toml(path)
        names = {"height", "sigma_turn", "stride", "calibration"}
        for name in table.keys() - names:
            raise InputError(path, name, "an unknown name", "one of " + ", ".join(sorted(names)))
        settings = table.keys() & {"height", "sigma_turn"}
        numbers = {name: _number(path, name, table[name], 0, LARGEST_SETTING) for name in settings}

        # ``stride = "name"``, or a table with ``model`` and constants
        given = table.get("stride", DEFAULT_STRIDE)
        stride = given if isinstance(given, dict) else {"model": given}
        model = stride.get("model", DEFAULT_STRIDE)
        if model not in MODELS:
            raise InputError(path, "stride", repr(model)[:60], "one of " + ", ".join(MODELS))
        allowed = [p for p in inspect.signature(MODELS[model]).parameters if p not in ("steps", "height")]
        for key in stride.keys() - {"model", *allowed}:
            raise InputError(path, f"stride.{key}", "an unknown constant", ", ".join(allowed) or "no constants")
        constants = {key: _number(path, f"stride.{key}", stride[key], 0, 1000) for key in allowed if key in stride}
        profile = _profile(path, table["calibration"]) if "calibration" in table else None
        return cls(**numbers, stride=model, constants=constants, profile=profile)

    def describe(self) -> dict[str, Any]:
        """The walker as plain numbers and texts, for ``summary.json``."""
        description = asdict(self)
        if self.profile is not None:
            description["profile"]["covariance"] = self.profile.covariance.tolist()
        return description

    def save(self, path: str | Path, comment: str) -> None:
        """Write a ``walker.toml``; `comment` is its first line."""
        lines = [f"# {one_line(comment)}", f"height = {self.height:.3f}  # [m]"]
        lines += [f"sigma_turn = {self.sigma_turn:.4f}  # [rad]", "", "[stride]", f'model = "{self.stride}"']
        lines += [f"{name} = {value:.6g}" for name, value in self.constants.items()]
        if (profile := self.profile) is not None:
            rows = ", ".join("[" + ", ".join(f"{value:.6e}" for value in row) + "]" for row in profile.covariance)
            lines += [
                "",
                "[calibration]",
                f"E_length = {profile.E_length:.5f}  # distance error per metre",
                f"E_straight = {profile.E_straight:.6f}  # heading error per metre [rad/m]",
                f"E_corner = {profile.E_corner:.5f}  # turn error per turn",
                f"covariance = [{rows}]  # of the three, in this order",
                f"residual = {profile.residual:.3f}  # rms distance of the calibration walk from its route [m]",
                f"speed = {profile.speed:.3f}  # of the calibration walk [m/s]",
            ]
        write_file(path, "\n".join(lines) + "\n")


def _profile(path: str | Path, table: Any) -> Profile:
    if not isinstance(table, dict):
        raise InputError(path, "calibration", repr(table)[:60], "a table")
    for name in (*COEFFICIENTS, "covariance", "residual", "speed"):
        if name not in table:
            raise InputError(path, f"calibration.{name}", "nothing", "a number, as pdr-graph calibrate writes it")
    limits = dict(zip(COEFFICIENTS, (0.6, 0.5, 0.5), strict=True))  # larger: degrees, or another walker
    values = {n: _number(path, f"calibration.{n}", table[n], -limit, limit) for n, limit in limits.items()}
    values |= {n: _number(path, f"calibration.{n}", table[n], 0, 1e3) for n in ("residual", "speed")}
    try:
        covariance = np.array(table["covariance"], dtype=float).reshape(3, 3)
    except (TypeError, ValueError):
        covariance = np.full((3, 3), np.nan)
    symmetric = np.allclose(covariance, covariance.T, atol=1e-12) and np.isfinite(covariance).all()
    if not symmetric or np.linalg.eigvalsh(covariance).min() <= 0:
        found = repr(table["covariance"])[:60]
        raise InputError(path, "calibration.covariance", found, "a symmetric, positive definite 3 × 3 matrix")
    return Profile(covariance=covariance, **values)


def _number(path: str | Path, name: str, value: Any, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not low < value < high:
        centimetres = name == "height" and isinstance(value, int | float) and 100 * 0.5 <= value < 100 * high
        found = f"{value!r:.60}{' (centimetres?)' if centimetres else ''}"
        raise InputError(path, name, found, f"a number between {low} and {high} (metres, radians)")
    return float(value)
