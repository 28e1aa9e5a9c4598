"""Scenarios: short TOML files with a walker, a route and a phone (docs/simulation.md).

Scenarios that are part of the package can be loaded by name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import shapely

import pdr_graph
from pdr_graph.errors import InputError, read_toml
from pdr_graph.floor.plan_files import FloorPlan
from pdr_graph.lab.simulation.carrying import HOLDS
from pdr_graph.lab.simulation.itinerary import Route, check_keys, number, one_of, pair, route_of, typed
from pdr_graph.lab.simulation.recorders import RECORDERS
from pdr_graph.lab.simulation.sensors import Receiver, SampleClock, Transmitter
from pdr_graph.types import OneLineRepr

SCENARIOS = Path(__file__).parent / "scenarios"
PACKAGE = Path(pdr_graph.__file__).parent
MAPS = (PACKAGE / "maps", PACKAGE.parent / "maps")  # plans of SCENARIOS: in an installation; in a checkout


def names() -> tuple[str, ...]:
    """The names of all scenarios of the package, sorted."""
    return tuple(sorted(file.stem for file in SCENARIOS.glob("*.toml")))


def scenario_file(name: str | Path) -> Path:
    """The path of a scenario's file. name: a path, or the name of a scenario of the package.

    Raises InputError if it is neither.
    """
    path = Path(name)
    if path.is_file():
        return path
    if (SCENARIOS / f"{name}.toml").is_file():
        return SCENARIOS / f"{name}.toml"
    found = "a folder" if path.is_dir() else "no such file"
    raise InputError(path, "", found, f"a scenario's TOML file, or one of {', '.join(names())}")


SIMULATED = ("accelerometer", "gyroscope", "magnetometer", "barometer")
ORIGIN = (135.0, 35.0)  # [deg] longitude and latitude of (0, 0) without a plan
Section = TypeVar("Section")


@dataclass(frozen=True)
class Person:
    """The walker: height [m], 0 to draw it at random; sex "f" or "m", "" to draw it at random."""

    height: float = 0.0
    sex: str = ""


@dataclass(frozen=True)
class Phone:
    """The phone: how it is carried and how it samples.

    hold: of HOLDS; rate [Hz], jitter [s], lost and repeated shares of samples; sensors: of SIMULATED; disturbance: of
    the magnetic field [µT]; altitude: of the floor where the walk begins [m]; barometer_rate [Hz].
    """

    hold: str = "hand"
    rate: float = 100.0
    jitter: float = 0.0004
    lost: float = 0.0005
    repeated: float = 0.0002
    sensors: tuple[str, ...] = SIMULATED
    disturbance: float = 5.0
    altitude: float = 30.0
    barometer_rate: float = 5.0

    @property
    def clock(self) -> SampleClock:
        """The sample clock of the inertial sensors and the magnetometer."""
        return SampleClock(self.rate, self.jitter, self.lost, self.repeated)


@dataclass(frozen=True)
class UserFixes:
    """Positions that the user knows: one every ``period`` [s], ``sigma`` per axis [m], a share of ``outliers``."""

    period: float = 10.0
    sigma: float = 1.5
    outliers: float = 0.0


@dataclass(frozen=True)
class Scenario(OneLineRepr):
    """The description of one simulated walk (docs/simulation.md).

    name: of its file; route: where the walker goes; walker, phone: who walks, and how the phone is carried and errs;
    seed: of all random numbers; recorder: of RECORDERS; platform: "android" or "ios"; start: Unix
    time [s]; place: longitude and latitude of (0, 0) [deg]; plan: its file, None without one; plans: its floors by
    label; gnss, user_fixes: None for none; beacons, access_points: the transmitters within reach.
    """

    name: str
    route: Route
    seed: int = 0
    start: float = 1_777_629_600.0
    recorder: str = "sensor_logger"
    platform: str = "android"
    place: tuple[float, float] = ORIGIN
    plan: Path | None = None
    plans: Mapping[str, FloorPlan] = field(default_factory=dict)
    walker: Person = field(default_factory=Person)
    phone: Phone = field(default_factory=Phone)
    gnss: Receiver | None = None
    user_fixes: UserFixes | None = None
    beacons: tuple[Transmitter, ...] = ()
    access_points: tuple[Transmitter, ...] = ()

    @classmethod
    def load(cls, path: str | Path) -> Scenario:
        """Read a scenario. path: of its file, or the name of a scenario of the package such as "arcade".

        Raises InputError naming the place in the file.
        """
        path = scenario_file(path)
        return cls.of(read_toml(path), path)

    @classmethod
    def of(cls, content: dict[str, Any], path: Path = Path("scenario")) -> Scenario:
        """A scenario from the content of its file. path: for messages, and relative to which its plan is found."""
        return _scenario(path, content)

    def _summary(self) -> list[str]:
        return [repr(self.name), f"seed {self.seed}", *self.route._summary(), f"hold {self.phone.hold!r}"]


MAXIMUM_SAMPLES = 5e6  # fourteen hours at 100 Hz; more would be a typing error, and fill the memory


def _scenario(path: Path, content: dict[str, Any]) -> Scenario:
    """Check the content of a scenario's file, value by value, and build the scenario."""
    allowed = "seed start recorder platform place plan floor heading route walker phone gnss fixes beacons wifi"
    check_keys(path, "", content, allowed.split())
    seed = typed(path, "seed", content.get("seed", 0), int)
    _check_range(path, "seed", seed)
    plan = _plan_file(path, typed(path, "plan", content["plan"], str)) if "plan" in content else None
    plans = {floor.label: floor for floor in FloorPlan.load_all(plan)} if plan else {}
    phone = _section(path, "phone", content, Phone)
    one_of(path, "phone.hold", phone.hold, tuple(HOLDS))
    for sensor in phone.sensors:
        one_of(path, "phone.sensors", sensor, SIMULATED)
    person = _section(path, "walker", content, Person)
    one_of(path, "walker.sex", person.sex, ("", "f", "m"))
    route = route_of(
        path, content.get("route"), plans, str(content.get("floor", next(iter(plans), ""))), content.get("heading")
    )
    samples = route.duration * phone.rate
    if samples > MAXIMUM_SAMPLES:
        raise InputError(
            path, "route", f"about {samples:.0f} samples", f"at most {MAXIMUM_SAMPLES:.0f}: a shorter walk"
        )
    return Scenario(
        name=path.stem,
        route=route,
        seed=seed,
        start=_unix_time(path, content.get("start", Scenario.start)),
        recorder=one_of(path, "recorder", content.get("recorder", Scenario.recorder), tuple(RECORDERS)),
        platform=one_of(path, "platform", content.get("platform", Scenario.platform), ("android", "ios")),
        place=_place(path, content.get("place", ORIGIN)),
        plan=plan,
        plans=plans,
        walker=person,
        phone=phone,
        gnss=_receiver(path, content),
        user_fixes=_user_fixes(path, content),
        beacons=_beacons(path, content.get("beacons", {}), plans),
        access_points=_access_points(path, content, plans, route),
    )


def _plan_file(path: Path, name: str) -> Path:
    """The file of a scenario's plan: beside the scenario, else a plan of the package."""
    beside = path.parent / name
    if beside.exists():
        return beside
    return next((folder / name for folder in MAPS if (folder / name).is_file()), beside)


def _section(path: Path, name: str, content: dict[str, Any], kind: type[Section]) -> Section:
    """A table of the file as a dataclass, whose fields are the keys and whose defaults give the types."""
    table = typed(path, name, content.get(name, {}), dict)
    defaults = {f.name: f.default for f in fields(kind)}  # type: ignore[arg-type]
    check_keys(path, name, table, list(defaults))
    values = {}
    for key, value in table.items():
        default = defaults[key]
        if isinstance(default, tuple):
            values[key] = _tuple(typed(path, f"{name}.{key}", value, list))
        else:
            values[key] = typed(path, f"{name}.{key}", value, type(default))
            _check_range(path, f"{name}.{key}", values[key])
    return kind(**values)


def _tuple(value: list[Any]) -> tuple[Any, ...]:
    """A list and the lists in it as tuples."""
    return tuple(tuple(v) if isinstance(v, list) else v for v in value)


# Accepted values: minimum, maximum, unit
ACCEPTED_RANGES = {
    "seed": (0, 1e15, ""),
    "walker.height": (0.5, 2.5, "m"),
    "phone.rate": (20, 1000, "Hz"),
    "phone.barometer_rate": (0.1, 100, "Hz"),
    "phone.jitter": (0, 1, "s"),
    "phone.lost": (0, 0.9, "of all samples"),
    "phone.repeated": (0, 0.9, "of all samples"),
    "phone.disturbance": (0, 1000, "µT"),
    "phone.altitude": (-500, 9000, "m"),
    "gnss.accuracy": (0.01, 10_000, "m"),
    "gnss.period": (0.01, 86_400, "s"),
    "gnss.latency": (0, 3600, "s"),
    "gnss.outliers": (0, 1, "of all fixes"),
    "gnss.hdop": (0.1, 100, ""),
    "wifi.access_points": (0, 1000, ""),
    "fixes.period": (0.01, 86_400, "s"),
    "fixes.sigma": (0.001, 10_000, "m"),
    "fixes.outliers": (0, 1, "of all fixes"),
}


def _check_range(path: Path, place: str, value: Any) -> None:
    """Raise InputError if the key `place` has a range and the value is outside."""
    if place in ACCEPTED_RANGES:
        number(path, place, value, *ACCEPTED_RANGES[place])


def _unix_time(path: Path, value: Any) -> float:
    """A TOML date, time or number as Unix time [s]; UTC without a zone."""
    if isinstance(value, datetime):
        return (value if value.tzinfo else value.replace(tzinfo=UTC)).timestamp()
    if isinstance(value, date):
        return datetime(value.year, value.month, value.day, tzinfo=UTC).timestamp()
    return float(typed(path, "start", value, float))


def _place(path: Path, value: Any) -> tuple[float, float]:
    """Longitude and latitude [deg]."""
    lon, lat = pair(path, "place", value, "[longitude, latitude] in degrees", 180).tolist()
    return lon, number(path, "place", lat, -85, 85, "degrees of latitude")


def _user_fixes(path: Path, content: dict[str, Any]) -> UserFixes | None:
    """The ``[fixes]`` of a scenario; None without them. The key ``wild`` is the former name of ``outliers``."""
    if "fixes" not in content:
        return None
    table = typed(path, "fixes", content["fixes"], dict)
    renamed = {"outliers" if key == "wild" else key: value for key, value in table.items()}
    return _section(path, "fixes", {"fixes": renamed}, UserFixes)


def _receiver(path: Path, content: dict[str, Any]) -> Receiver | None:
    """The ``[gnss]`` of a scenario; None without it."""
    if "gnss" not in content:
        return None
    receiver = _section(path, "gnss", content, Receiver)
    for outage in receiver.outages:
        pair(path, "gnss.outages", outage, "[from, to] in seconds from the start", 1e9)
    return receiver


def _beacons(path: Path, table: Any, plans: Mapping[str, FloorPlan]) -> tuple[Transmitter, ...]:
    """The beacons of the plan and of the scenario; a position in the scenario replaces that in the plan."""
    typed(path, "beacons", table, dict)
    beacons: dict[str, Transmitter] = {}
    for label, plan in plans.items():
        for area in plan.of_kind("beacon"):
            name = str(next((area.properties[k] for k in ("mac", "id", "uuid") if area.properties.get(k)), area.name))
            beacons[name] = Transmitter(name, shapely.get_coordinates(shapely.centroid(area.shape))[0], label)
    for name, place in table.items():
        floor = beacons[name].floor if name in beacons else next(iter(plans), "")
        beacons[name] = Transmitter(name, pair(path, f"beacons.{name}", place), floor)
    return tuple(beacons.values())


def _access_points(
    path: Path, content: dict[str, Any], plans: Mapping[str, FloorPlan], route: Route
) -> tuple[Transmitter, ...]:
    """Access points at random positions around the route: ``[wifi] access_points = 12``."""
    table = typed(path, "wifi", content.get("wifi", {}), dict)
    check_keys(path, "wifi", table, ["access_points"])
    count = typed(path, "wifi.access_points", table.get("access_points", 0), int)
    _check_range(path, "wifi.access_points", count)
    random = np.random.default_rng(content.get("seed", 0))
    low, high = route.corners.min(axis=0) - 10, route.corners.max(axis=0) + 10
    floors = list(plans) or [""]
    places = random.uniform(low, high, (count, 2))
    return tuple(
        Transmitter(f"06:00:00:00:{n // 256:02x}:{n % 256:02x}", place, floors[n % len(floors)], -40.0)
        for n, place in enumerate(places)
    )
