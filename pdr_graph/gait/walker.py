"""The walker: ``walker.toml``, and the personal calibration of [calibration-walk] Sec. 3.3 with its covariance."""

from __future__ import annotations

import inspect
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph.errors import InputError, one_line, read_toml
from pdr_graph.gait.step_length import MODELS, REFERENCE_HEIGHT
from pdr_graph.priors import MOTION
from pdr_graph.types import Array, OneLineRepr, Steps
from pdr_graph.whole_files import write_file

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
LARGEST_COEFFICIENT = {"E_length": 0.6, "E_straight": 0.5, "E_corner": 0.5}  # larger: degrees, or another walker


@dataclass(frozen=True)
class Walker(OneLineRepr):
    """The walker: stature, stride model and personal calibration.

    height: stature [m].
    sigma_turn: standard deviation of the heading error that one step adds [rad]: the body sways about the phone.
    stride: the stride model, one of `step_length.MODELS`; constants: its constants by name.
    profile: personal calibration, None without one.
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
            if (
                isinstance(value, bool)
                or not isinstance(value, int | float | np.number)
                or not 0 < value < LARGEST_SETTING
            ):
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
        numbers = {
            name: _number(path, name, table[name], 0, LARGEST_SETTING)
            for name in ("height", "sigma_turn")
            if name in table
        }
        stride, constants = _stride(path, table.get("stride", DEFAULT_STRIDE))
        profile = _profile(path, table["calibration"]) if "calibration" in table else None
        return cls(**numbers, stride=stride, constants=constants, profile=profile)

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
        if self.profile is not None:
            lines += ["", *_calibration_table(self.profile)]
        write_file(path, "\n".join(lines) + "\n")


def _calibration_table(profile: Profile) -> list[str]:
    rows = ", ".join("[" + ", ".join(f"{value:.6e}" for value in row) + "]" for row in profile.covariance)
    return [
        "[calibration]",
        f"E_length = {profile.E_length:.5f}  # distance error per metre",
        f"E_straight = {profile.E_straight:.6f}  # heading error per metre [rad/m]",
        f"E_corner = {profile.E_corner:.5f}  # turn error per turn",
        f"covariance = [{rows}]  # of the three, in this order",
        f"residual = {profile.residual:.3f}  # rms distance of the calibration walk from its route [m]",
        f"speed = {profile.speed:.3f}  # of the calibration walk [m/s]",
    ]


def _stride(path: str | Path, entry: Any) -> tuple[str, dict[str, float]]:
    """The model's name and constants from ``stride = "name"`` or a table with ``model`` and constants."""
    table = entry if isinstance(entry, dict) else {"model": entry}
    name = table.get("model", DEFAULT_STRIDE)
    if name not in MODELS:
        raise InputError(path, "stride", repr(name)[:60], "one of " + ", ".join(MODELS))
    allowed = [p for p in inspect.signature(MODELS[name]).parameters if p not in ("steps", "height")]
    for key in table.keys() - {"model", *allowed}:
        raise InputError(path, f"stride.{key}", "an unknown constant", ", ".join(allowed) or "no constants")
    return name, {key: _number(path, f"stride.{key}", table[key], 0, 1000) for key in allowed if key in table}


def _profile(path: str | Path, table: Any) -> Profile:
    if not isinstance(table, dict):
        raise InputError(path, "calibration", repr(table)[:60], "a table")
    for name in (*COEFFICIENTS, "covariance", "residual", "speed"):
        if name not in table:
            raise InputError(path, f"calibration.{name}", "nothing", "a number, as pdr-graph calibrate writes it")
    limits = LARGEST_COEFFICIENT.items()
    values = {n: _number(path, f"calibration.{n}", table[n], -limit, limit) for n, limit in limits}
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
