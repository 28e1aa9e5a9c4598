"""What is known of the walker, and its file ``walker.toml``."""

from __future__ import annotations

import inspect
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.gait.length import MODELS, REFERENCE_HEIGHT
from pdr_graph.gait.profile import COEFFICIENTS, Profile
from pdr_graph.settings import read_toml

DEFAULT_STRIDE = "inverted pendulum"
MOST = 3  # of a height [m] and of a step's heading error [rad]
LARGEST = {"E_length": 0.6, "E_straight": 0.5, "E_corner": 0.5}  # beyond that it is another walker's, or degrees


@dataclass(frozen=True)
class Walker:
    """What is known of the walker.

    height: stature [m].
    sigma_turn: heading error that one step adds [rad]; the walking direction wanders about the phone's.
    stride: the stride model, one of `length.MODELS`; constants: of that model, by name.
    profile: the walker's own calibration, None if there is none.
    """

    height: float = REFERENCE_HEIGHT
    sigma_turn: float = 0.02
    stride: str = DEFAULT_STRIDE
    constants: dict[str, float] = field(default_factory=dict)
    profile: Profile | None = None

    def __post_init__(self) -> None:
        """Raise ValueError on what is nobody's: a height in centimetres, an unknown stride model."""
        for name, unit in (("height", "metres"), ("sigma_turn", "radians")):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not 0 < value < MOST:
                raise ValueError(f"Walker.{name}: found {value!r}, needed {unit} between 0 and {MOST}")
        if self.stride not in MODELS:
            raise ValueError(f"Walker.stride: found {self.stride!r}, needed one of {', '.join(MODELS)}")

    @classmethod
    def load(cls, path: str | Path) -> Walker:
        """Read ``walker.toml`` (``docs/formats.md``), everything in it optional. Raises InputError."""
        given = read_toml(path)
        known = {"height", "sigma_turn", "stride", "calibration"}
        for name in given.keys() - known:
            raise InputError(path, name, "an unknown name", "one of " + ", ".join(sorted(known)))
        numbers = {
            name: _number(path, name, given[name], 0, MOST) for name in ("height", "sigma_turn") if name in given
        }
        stride, constants = _stride(path, given.get("stride", DEFAULT_STRIDE))
        profile = _profile(path, given["calibration"]) if "calibration" in given else None
        return cls(**numbers, stride=stride, constants=constants, profile=profile)

    def describe(self) -> dict[str, Any]:
        """As plain numbers and text, for a summary."""
        said = asdict(self)
        if self.profile is not None:
            said["profile"]["covariance"] = self.profile.covariance.tolist()
        return said

    def save(self, path: str | Path, comment: str) -> None:
        """Write ``walker.toml``. comment: its first line."""
        lines = [f"# {comment}", f"height = {self.height:.3f}  # [m]", f"sigma_turn = {self.sigma_turn:.4f}  # [rad]"]
        lines += ["", "[stride]", f'model = "{self.stride}"']
        lines += [f"{name} = {value:.6g}" for name, value in self.constants.items()]
        if self.profile is not None:
            lines += ["", *_calibration_table(self.profile)]
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _calibration_table(profile: Profile) -> list[str]:
    rows = ", ".join("[" + ", ".join(f"{value:.6e}" for value in row) + "]" for row in profile.covariance)
    return [
        "[calibration]",
        f"E_length = {profile.E_length:.5f}  # distance error per metre",
        f"E_straight = {profile.E_straight:.6f}  # heading error per metre [rad/m]",
        f"E_corner = {profile.E_corner:.5f}  # turn error per turn",
        f"covariance = [{rows}]  # of the three, in this order",
        f"residual = {profile.residual:.3f}  # rms distance from where the walk is known to have been [m]",
        f"speed = {profile.speed:.3f}  # at which it was walked [m/s]",
    ]


def _stride(path: str | Path, given: Any) -> tuple[str, dict[str, float]]:
    """The model's name and constants: ``stride = "name"`` or a table with ``model`` and constants."""
    table = given if isinstance(given, dict) else {"model": given}
    name = table.get("model", DEFAULT_STRIDE)
    if name not in MODELS:
        raise InputError(path, "stride", repr(name)[:60], "one of " + ", ".join(MODELS))
    allowed = [p for p in inspect.signature(MODELS[name]).parameters if p not in ("steps", "height")]
    for key in table.keys() - {"model", *allowed}:
        raise InputError(path, f"stride.{key}", "an unknown constant", ", ".join(allowed) or "no constants")
    return name, {key: _number(path, f"stride.{key}", table[key], 0, 1000) for key in allowed if key in table}


def _profile(path: str | Path, given: Any) -> Profile:
    if not isinstance(given, dict):
        raise InputError(path, "calibration", repr(given)[:60], "a table")
    for name in (*COEFFICIENTS, "covariance", "residual", "speed"):
        if name not in given:
            raise InputError(path, f"calibration.{name}", "nothing", "what pdr-graph calibrate writes")
    values = {n: _number(path, f"calibration.{n}", given[n], -LARGEST[n], LARGEST[n]) for n in COEFFICIENTS}
    values |= {n: _number(path, f"calibration.{n}", given[n], 0, 1e3) for n in ("residual", "speed")}
    try:
        covariance = np.array(given["covariance"], dtype=float).reshape(3, 3)
    except (TypeError, ValueError):
        covariance = np.full((3, 3), np.nan)
    symmetric = np.allclose(covariance, covariance.T, atol=1e-12) and np.isfinite(covariance).all()
    if not symmetric or np.linalg.eigvalsh(covariance).min() <= 0:
        found = repr(given["covariance"])[:60]
        raise InputError(path, "calibration.covariance", found, "a symmetric, positive definite 3 × 3 matrix")
    return Profile(covariance=covariance, **values)


def _number(path: str | Path, name: str, value: Any, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not low < value < high:
        raise InputError(path, name, repr(value)[:60], f"a number between {low} and {high} (metres, radians)")
    return float(value)
