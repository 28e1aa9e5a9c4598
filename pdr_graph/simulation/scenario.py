"""Scenarios: short TOML files that say who walks where, with what phone (docs/simulation.md).

Those that come with the package are known by name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import shapely

from pdr_graph.errors import InputError, read_toml
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.simulation.carrying import HOLDS
from pdr_graph.simulation.itinerary import Route, known, number, one_of, pair, route_of, typed
from pdr_graph.simulation.recorders import RECORDERS
from pdr_graph.simulation.sensors import Clock, Receiver, Transmitter

PACKAGE = Path(__file__).parents[1]
HOMES = (PACKAGE / "scenarios", PACKAGE.parent / "scenarios")  # of what was installed; of a checkout


def names() -> tuple[str, ...]:
    """Of all of them, in order."""
    return tuple(sorted({file.stem for home in HOMES for file in home.glob("*.toml")}))


def scenario_file(given: str | Path) -> Path:
    """The file of a scenario: a path as it is, or the one that comes along under that name.

    Raises InputError if it is neither.
    """
    path = Path(given)
    if path.is_file():
        return path
    for home in HOMES:
        if (home / f"{given}.toml").is_file():
            return home / f"{given}.toml"
    found = "a folder" if path.is_dir() else "no such file"
    raise InputError(path, "", found, f"a scenario's TOML file, or one of {', '.join(names())}")


RANGES = {
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
    "fixes.wild": (0, 1, "of all fixes"),
}
MOST_SAMPLES = 5e6  # fourteen hours at 100 Hz; more is a slip of the pen, and would fill the memory
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
    """One simulated walk (docs/simulation.md).

    name: of its file; route: where to; walker: who walks; phone: that is carried; seed: of all chance; recorder: of
    RECORDERS; platform: "android" or "ios"; start: Unix time [s]; place: longitude and latitude of (0, 0) [deg];
    plan: its file, None without one; plans: its floors by label; gnss, given: None for none; beacons, access_points:
    who is heard.
    """

    name: str
    route: Route
    seed: int = 0
    start: float = 1_777_629_600.0
    recorder: str = "sensor_logger"
    platform: str = "android"
    place: tuple[float, float] = PLACE
    plan: Path | None = None
    plans: Mapping[str, FloorPlan] = field(default_factory=dict)
    walker: Person = field(default_factory=Person)
    phone: Phone = field(default_factory=Phone)
    gnss: Receiver | None = None
    given: GivenFixes | None = None
    beacons: tuple[Transmitter, ...] = ()
    access_points: tuple[Transmitter, ...] = ()

    @classmethod
    def load(cls, path: str | Path) -> Scenario:
        """Read a scenario; path: of its file, or the name of one that comes with the package, as "arcade".

        Raises InputError naming the place in the file.
        """
        path = scenario_file(path)
        return cls.of(read_toml(path), path)

    @classmethod
    def of(cls, given: dict[str, Any], path: Path = Path("scenario")) -> Scenario:
        """A scenario from what its file would say. path: for messages, and where its plan is looked for."""
        return _scenario(path, given)


def _scenario(path: Path, given: dict[str, Any]) -> Scenario:
    allowed = "seed start recorder platform place plan floor heading route walker phone gnss fixes beacons wifi"
    known(path, "", given, allowed.split())
    seed = typed(path, "seed", given.get("seed", 0), int)
    _within(path, "seed", seed)
    plan = path.parent / typed(path, "plan", given["plan"], str) if "plan" in given else None
    plans = {floor.label: floor for floor in FloorPlan.load_all(plan)} if plan else {}
    phone = _section(path, "phone", given, Phone)
    one_of(path, "phone.hold", phone.hold, tuple(HOLDS))
    for sensor in phone.sensors:
        one_of(path, "phone.sensors", sensor, SENSORS)
    person = _section(path, "walker", given, Person)
    one_of(path, "walker.sex", person.sex, ("", "f", "m"))
    route = route_of(
        path, given.get("route"), plans, str(given.get("floor", next(iter(plans), ""))), given.get("heading")
    )
    samples = route.duration * phone.rate
    if samples > MOST_SAMPLES:
        raise InputError(path, "route", f"about {samples:.0f} samples", f"at most {MOST_SAMPLES:.0f}: a shorter walk")
    return Scenario(
        name=path.stem,
        route=route,
        seed=seed,
        start=_unix(path, given.get("start", Scenario.start)),
        recorder=one_of(path, "recorder", given.get("recorder", Scenario.recorder), tuple(RECORDERS)),
        platform=one_of(path, "platform", given.get("platform", Scenario.platform), ("android", "ios")),
        place=_place(path, given.get("place", PLACE)),
        plan=plan,
        plans=plans,
        walker=person,
        phone=phone,
        gnss=_receiver(path, given),
        given=_section(path, "fixes", given, GivenFixes) if "fixes" in given else None,
        beacons=_beacons(path, given.get("beacons", {}), plans),
        access_points=_access_points(path, given, plans, route),
    )


def _section(path: Path, name: str, given: dict[str, Any], kind: type[Section]) -> Section:
    """A table as a dataclass of numbers, words and tuples of them."""
    table = typed(path, name, given.get(name, {}), dict)
    defaults = {f.name: f.default for f in fields(kind)}  # type: ignore[arg-type]
    known(path, name, table, list(defaults))
    values = {}
    for key, value in table.items():
        default = defaults[key]
        if isinstance(default, tuple):
            values[key] = _tuple(typed(path, f"{name}.{key}", value, list))
        else:
            values[key] = typed(path, f"{name}.{key}", value, type(default))
            _within(path, f"{name}.{key}", values[key])
    return kind(**values)


def _tuple(value: list[Any]) -> tuple[Any, ...]:
    return tuple(tuple(v) if isinstance(v, list) else v for v in value)


def _within(path: Path, place: str, value: Any) -> None:
    if place in RANGES:
        number(path, place, value, *RANGES[place])


def _unix(path: Path, value: Any) -> float:
    if isinstance(value, datetime):
        return (value if value.tzinfo else value.replace(tzinfo=UTC)).timestamp()
    if isinstance(value, date):
        return datetime(value.year, value.month, value.day, tzinfo=UTC).timestamp()
    return float(typed(path, "start", value, float))


def _place(path: Path, value: Any) -> tuple[float, float]:
    lon, lat = pair(path, "place", value, "[longitude, latitude] in degrees", 180).tolist()
    return lon, number(path, "place", lat, -85, 85, "degrees of latitude")


def _receiver(path: Path, given: dict[str, Any]) -> Receiver | None:
    if "gnss" not in given:
        return None
    receiver = _section(path, "gnss", given, Receiver)
    for outage in receiver.outages:
        pair(path, "gnss.outages", outage, "[from, to] in seconds from the start", 1e9)
    return receiver


def _beacons(path: Path, table: Any, plans: Mapping[str, FloorPlan]) -> tuple[Transmitter, ...]:
    """The plan's beacons and the scenario's own; the latter's place wins, as when somebody has moved one."""
    typed(path, "beacons", table, dict)
    found: dict[str, Transmitter] = {}
    for label, plan in plans.items():
        for area in plan.of_kind("beacon"):
            name = str(next((area.properties[k] for k in ("mac", "id", "uuid") if area.properties.get(k)), area.name))
            found[name] = Transmitter(name, shapely.get_coordinates(shapely.centroid(area.shape))[0], label)
    for name, place in table.items():
        floor = found[name].floor if name in found else next(iter(plans), "")
        found[name] = Transmitter(name, pair(path, f"beacons.{name}", place), floor)
    return tuple(found.values())


def _access_points(
    path: Path, given: dict[str, Any], plans: Mapping[str, FloorPlan], route: Route
) -> tuple[Transmitter, ...]:
    """Access points somewhere about the way: ``[wifi] access_points = 12``."""
    table = typed(path, "wifi", given.get("wifi", {}), dict)
    known(path, "wifi", table, ["access_points"])
    count = typed(path, "wifi.access_points", table.get("access_points", 0), int)
    _within(path, "wifi.access_points", count)
    random = np.random.default_rng(given.get("seed", 0))
    low, high = route.corners.min(axis=0) - 10, route.corners.max(axis=0) + 10
    floors = list(plans) or [""]
    places = random.uniform(low, high, (count, 2))
    return tuple(
        Transmitter(f"02:00:00:00:{n // 256:02x}:{n % 256:02x}", place, floors[n % len(floors)], -40.0)
        for n, place in enumerate(places)
    )
