"""Scenarios: short TOML files that say who walks where, with what phone (docs/simulation.md)."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.simulation.carrying import HOLDS
from pdr_graph.simulation.itinerary import Route, route_of
from pdr_graph.simulation.radio import Receiver, Transmitter
from pdr_graph.simulation.recorders import RECORDERS
from pdr_graph.simulation.sensors import Clock

SENSORS = ("accelerometer", "gyroscope", "magnetometer", "barometer")
PLACE = (135.0, 35.0)  # [deg] longitude and latitude of (0, 0) where no plan says
Section = TypeVar("Section")


@dataclass(frozen=True)
class Person:
    """What is said of the walker: height [m] and sex "f" or "m"; what is not is drawn."""

    height: float = 0.0
    sex: str = ""


@dataclass(frozen=True)
class Phone:
    """hold: of HOLDS; rate [Hz], jitter [s], lost and repeated shares of samples; sensors: of SENSORS; disturbance: of
    the magnetic field [µT]; altitude: of the floor where the walk begins [m]; barometer_rate [Hz].
    """

    hold: str = "hand"
    rate: float = 100.0
    jitter: float = 0.0004
    lost: float = 0.0005
    repeated: float = 0.0002
    sensors: tuple[str, ...] = SENSORS
    disturbance: float = 5.0
    altitude: float = 30.0
    barometer_rate: float = 5.0

    @property
    def clock(self) -> Clock:
        """Of the inertial sensors and the magnetometer."""
        return Clock(self.rate, self.jitter, self.lost, self.repeated)


@dataclass(frozen=True)
class GivenFixes:
    """Positions that somebody knows: one every ``period`` [s], off by ``sigma`` per axis [m], some ``wild``."""

    period: float = 10.0
    sigma: float = 1.5
    wild: float = 0.0


@dataclass(frozen=True)
class Scenario:
    """One simulated walk.

    name: of its file; recorder: of RECORDERS; platform: "android" or "ios"; start: Unix time [s];
    place: longitude and latitude of (0, 0) [deg]; gnss, given: None for none; beacons, access_points: who is heard.
    """

    name: str
    route: Route
    seed: int = 0
    start: float = 1_777_629_600.0
    recorder: str = "sensor_logger"
    platform: str = "android"
    place: tuple[float, float] = PLACE
    plans: Mapping[str, FloorPlan] = field(default_factory=dict)
    walker: Person = field(default_factory=Person)
    phone: Phone = field(default_factory=Phone)
    gnss: Receiver | None = None
    given: GivenFixes | None = None
    beacons: tuple[Transmitter, ...] = ()
    access_points: tuple[Transmitter, ...] = ()

    @classmethod
    def load(cls, path: str | Path) -> Scenario:
        """Read a scenario. Raises InputError naming the place in the file."""
        path = Path(path)
        try:
            given = tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
            raise InputError(path, "", str(error), "a TOML file") from None
        return cls.of(given, path)

    @classmethod
    def of(cls, given: dict[str, Any], path: Path = Path("scenario")) -> Scenario:
        """A scenario from what its file would say. path: for messages, and where its plan is looked for."""
        return _scenario(path, given)


def _scenario(path: Path, given: dict[str, Any]) -> Scenario:
    allowed = "seed start recorder platform place plan floor heading route walker phone gnss fixes beacons wifi"
    _known(path, "", given, allowed.split())
    plans = _plans(path, given)
    phone = _section(path, "phone", given, Phone)
    _one_of(path, "phone.hold", phone.hold, tuple(HOLDS))
    for sensor in phone.sensors:
        _one_of(path, "phone.sensors", sensor, SENSORS)
    if not 20 <= phone.rate <= 1000 or not 0.1 <= phone.barometer_rate <= 100:
        raise InputError(path, "phone.rate", f"{phone.rate}, {phone.barometer_rate}", "20–1000 Hz, barometer 0.1–100")
    person = _section(path, "walker", given, Person)
    _one_of(path, "walker.sex", person.sex, ("", "f", "m"))
    route = route_of(
        path, given.get("route"), plans, str(given.get("floor", next(iter(plans), ""))), given.get("heading")
    )
    return Scenario(
        name=path.stem,
        route=route,
        seed=_typed(path, "seed", given.get("seed", 0), int),
        start=_unix(path, given.get("start", Scenario.start)),
        recorder=_one_of(path, "recorder", given.get("recorder", Scenario.recorder), tuple(RECORDERS)),
        platform=_one_of(path, "platform", given.get("platform", Scenario.platform), ("android", "ios")),
        place=_place(path, given.get("place", PLACE)),
        plans=plans,
        walker=person,
        phone=phone,
        gnss=_section(path, "gnss", given, Receiver) if "gnss" in given else None,
        given=_section(path, "fixes", given, GivenFixes) if "fixes" in given else None,
        beacons=_beacons(path, given.get("beacons", {}), plans),
        access_points=_access_points(path, given, plans, route),
    )


def _plans(path: Path, given: dict[str, Any]) -> dict[str, FloorPlan]:
    if "plan" not in given:
        return {}
    plan = path.parent / _typed(path, "plan", given["plan"], str)
    return {floor.label: floor for floor in FloorPlan.load_all(plan)}


def _section(path: Path, name: str, given: dict[str, Any], kind: type[Section]) -> Section:
    """A table as a dataclass of numbers, words and tuples of them."""
    table = _typed(path, name, given.get(name, {}), dict)
    defaults = {f.name: f.default for f in fields(kind)}  # type: ignore[arg-type]
    _known(path, name, table, list(defaults))
    values = {}
    for key, value in table.items():
        default = defaults[key]
        if isinstance(default, tuple):
            values[key] = _tuple(_typed(path, f"{name}.{key}", value, list))
        else:
            values[key] = _typed(path, f"{name}.{key}", value, type(default))
    return kind(**values)


def _tuple(value: list[Any]) -> tuple[Any, ...]:
    return tuple(tuple(v) if isinstance(v, list) else v for v in value)


def _typed(path: Path, place: str, value: Any, kind: type) -> Any:
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value)
    if kind is float and is_number:
        return float(value)
    if isinstance(value, kind) and not isinstance(value, bool):
        return value
    names = {float: "a number", int: "a whole number", str: "a text", dict: "a table", list: "a list"}
    raise InputError(path, place, repr(value), names[kind])


def _known(path: Path, place: str, table: Mapping[str, Any], names: Sequence[str]) -> None:
    for name in table:
        if name not in names:
            raise InputError(path, f"{place}.{name}".lstrip("."), "an unknown name", "one of " + ", ".join(names))


def _one_of(path: Path, place: str, value: Any, names: tuple[str, ...]) -> str:
    if value not in names:
        raise InputError(path, place, repr(value), "one of " + ", ".join(n for n in names if n))
    return str(value)


def _unix(path: Path, value: Any) -> float:
    if isinstance(value, datetime):
        return (value if value.tzinfo else value.replace(tzinfo=UTC)).timestamp()
    if isinstance(value, date):
        return datetime(value.year, value.month, value.day, tzinfo=UTC).timestamp()
    return float(_typed(path, "start", value, float))


def _place(path: Path, value: Any) -> tuple[float, float]:
    try:
        lon, lat = (float(v) for v in value)
    except (TypeError, ValueError):
        lon, lat = np.nan, np.nan
    if not (abs(lon) <= 180 and abs(lat) <= 85):
        raise InputError(path, "place", repr(value), "[longitude, latitude] in degrees")
    return lon, lat


def _beacons(path: Path, table: Any, plans: Mapping[str, FloorPlan]) -> tuple[Transmitter, ...]:
    """The plan's beacons and the scenario's own; the latter's place wins, as when somebody has moved one."""
    _typed(path, "beacons", table, dict)
    found: dict[str, Transmitter] = {}
    for label, plan in plans.items():
        for area in plan.of_kind("beacon"):
            name = str(next((area.properties[k] for k in ("mac", "id", "uuid") if area.properties.get(k)), area.name))
            found[name] = Transmitter(name, shapely.get_coordinates(shapely.centroid(area.shape))[0], label)
    for name, place in table.items():
        if not (isinstance(place, list) and len(place) == 2 and all(isinstance(v, int | float) for v in place)):
            raise InputError(path, f"beacons.{name}", repr(place), "[x, y] in metres")
        floor = found[name].floor if name in found else next(iter(plans), "")
        found[name] = Transmitter(name, np.array(place, dtype=float), floor)
    return tuple(found.values())


def _access_points(
    path: Path, given: dict[str, Any], plans: Mapping[str, FloorPlan], route: Route
) -> tuple[Transmitter, ...]:
    """Access points somewhere about the way: ``[wifi] access_points = 12``."""
    table = _typed(path, "wifi", given.get("wifi", {}), dict)
    _known(path, "wifi", table, ["access_points"])
    count = _typed(path, "wifi.access_points", table.get("access_points", 0), int)
    random = np.random.default_rng(given.get("seed", 0))
    low, high = route.corners.min(axis=0) - 10, route.corners.max(axis=0) + 10
    floors = list(plans) or [""]
    places = random.uniform(low, high, (max(0, min(count, 1000)), 2))
    return tuple(
        Transmitter(f"02:00:00:00:{n // 256:02x}:{n % 256:02x}", place, floors[n % len(floors)], -40.0)
        for n, place in enumerate(places)
    )
