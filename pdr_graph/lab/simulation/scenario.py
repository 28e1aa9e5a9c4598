"""Scenarios: short TOML files with a walker, a route and a phone (docs/simulation.md), checked value by value.

Scenarios that are part of the package can be loaded by name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import shapely

import pdr_graph
from pdr_graph.errors import InputError, read_toml
from pdr_graph.floor.formats.drawing import STOREY
from pdr_graph.floor.plan_files import FloorPlan
from pdr_graph.geometry import length_along
from pdr_graph.lab.simulation.body import MANNERS, Activity, ChangeHold, Ride, Roll, Shake, Stand, Walk
from pdr_graph.lab.simulation.carrying import HOLDS
from pdr_graph.lab.simulation.recorders import RECORDERS
from pdr_graph.lab.simulation.sensors import Receiver, SampleClock, Transmitter, setting
from pdr_graph.types import Array, OneLineRepr

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
LARGEST = 1e5  # of any number: metres from the origin, seconds, degrees
Section = TypeVar("Section")
TYPE_NAMES = {float: "a number", int: "a whole number", str: "a text", dict: "a table", list: "a list"}


@dataclass(frozen=True)
class Value:
    """A value in a scenario's file and its place there. Methods return it checked; they raise InputError."""

    path: Path
    place: str
    value: Any

    def error(self, expected: str, found: str = "") -> InputError:
        """The error that names the place and what is there."""
        return InputError(self.path, self.place, found or repr(self.value), expected)

    def typed(self, kind: type) -> Any:
        """The value if it is of type `kind`; a whole number is accepted for a float."""
        value = self.value
        if kind in (int, float):
            largest = 1e15  # whole numbers up to here are exact floats
            if isinstance(value, int | kind) and not isinstance(value, bool) and abs(value) < largest:
                return kind(value)
        elif isinstance(value, kind):
            return value
        raise self.error(TYPE_NAMES[kind])

    def number(self, low: float = -LARGEST, high: float = LARGEST, unit: str = "", kind: type = float) -> Any:
        """The value if it is a number from `low` to `high`; unit: for the message."""
        checked = self.typed(kind)
        if not low <= checked <= high:
            raise self.error(f"{low:g} to {high:g} {unit}".rstrip(), f"{checked:g}")
        return checked

    def pair(self, expected: str = "[x, y] in metres", most: float = LARGEST) -> Array:
        """Two numbers ``(2,)``, each at most `most` in size; expected: for the message."""
        if not isinstance(self.value, list | tuple) or len(self.value) != 2:
            raise self.error(expected)
        both = np.array([replace(self, value=each).typed(float) for each in self.value])
        if not np.all(np.abs(both) <= most):
            raise self.error(f"{expected}, at most {most:g}")
        return both

    def points(self) -> list[Array]:
        """Positions ``(2,)`` [m] from [x, y] or a list of these."""
        several = isinstance(self.value, list) and self.value and isinstance(self.value[0], list)
        return [replace(self, value=each).pair() for each in (self.value if several else [self.value])]

    def one_of(self, names: Iterable[str]) -> str:
        """The value if it is one of `names`."""
        if not isinstance(self.value, str) or self.value not in names:
            raise self.error("one of " + ", ".join(filter(None, names)))
        return self.value

    def table(self, names: Iterable[str] | None = None) -> dict[str, Value]:
        """The values of a table; raises InputError for a key that is not one of `names`."""
        table = {}
        for key, value in self.typed(dict).items():
            table[key] = Value(self.path, f"{self.place}.{key}".lstrip("."), value)
            if names is not None and key not in names:
                raise table[key].error("one of " + ", ".join(names), "an unknown name")
        return table

    def section(self, kind: type[Section]) -> Section:
        """The table as a dataclass, whose fields are the keys and whose `setting`s are the accepted values."""
        settings = {of.name: of for of in fields(kind)}  # type: ignore[arg-type]
        values: dict[str, Any] = {}
        for key, value in self.table(settings).items():
            default, accepted = settings[key].default, settings[key].metadata.get("accepted", ())
            if isinstance(default, tuple):
                several = [replace(value, value=each) for each in value.typed(list)]
                pair = "[from, to] in seconds from the start"
                values[key] = tuple(
                    each.one_of(accepted) if accepted else tuple(each.pair(pair, 1e9).tolist()) for each in several
                )
            else:
                values[key] = value.one_of(accepted) if isinstance(default, str) else value.number(*accepted)
        return kind(**values)

    def unix_time(self) -> float:
        """A TOML date, time or number as Unix time [s]; UTC without a zone."""
        value = self.value
        if isinstance(value, date) and not isinstance(value, datetime):
            value = datetime(value.year, value.month, value.day)
        if isinstance(value, datetime):
            return (value if value.tzinfo else value.replace(tzinfo=UTC)).timestamp()
        return float(self.typed(float))

    def lonlat(self) -> tuple[float, float]:
        """Longitude and latitude [deg]."""
        lon, lat = self.pair("[longitude, latitude] in degrees", 180).tolist()
        return lon, replace(self, value=lat).number(-85, 85, "degrees of latitude")


@dataclass(frozen=True)
class Person:
    """The walker: height [m], 0 to draw it at random; sex "f" or "m", "" to draw it at random."""

    height: float = setting(0.0, 0.5, 2.5, "m")
    sex: str = setting("", "", "f", "m")


@dataclass(frozen=True)
class Phone(SampleClock):
    """The phone: how it is carried, and how inertial sensors and magnetometer sample.

    hold: of HOLDS; sensors: of SIMULATED; disturbance: of the magnetic field [µT]; altitude: of the floor where the
    walk begins [m]; barometer_rate [Hz].
    """

    hold: str = setting("hand", *HOLDS)
    sensors: tuple[str, ...] = setting(SIMULATED, *SIMULATED)
    disturbance: float = setting(5.0, 0, 1000, "µT")
    altitude: float = setting(30.0, -500, 9000, "m")
    barometer_rate: float = setting(5.0, 0.1, 100, "Hz")


@dataclass(frozen=True)
class UserFixes:
    """Positions that the user knows: one every ``period`` [s], ``sigma`` per axis [m], a share of ``outliers``."""

    period: float = setting(10.0, 0.01, 86_400, "s")
    sigma: float = setting(1.5, 0.001, 10_000, "m")
    outliers: float = setting(0.0, 0, 1, "of all fixes")


@dataclass(frozen=True)
class Route(OneLineRepr):
    """The activities of the walker, in order.

    start: ``(2,)`` [m]; heading [rad] and floor there; corners: ``(c, 2)`` all positions [m]; duration: about [s].
    """

    start: Array
    heading: float
    floor: str
    activities: tuple[Activity, ...]
    corners: Array
    duration: float

    def _summary(self) -> list[str]:
        return [f"{len(self.activities)} activities", f"about {self.duration:.0f} s"]


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
    place: tuple[float, float] = (135.0, 35.0)
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
        keys = "seed start recorder platform place plan floor heading route walker phone gnss fixes beacons wifi"
        given = Value(path, "", content).table(keys.split())
        readers: dict[str, Callable[[Value], Any]] = {
            "seed": lambda value: value.number(0, 1e15, kind=int),
            "start": Value.unix_time,
            "recorder": lambda value: value.one_of(RECORDERS),
            "platform": lambda value: value.one_of(("android", "ios")),
            "place": Value.lonlat,
            "walker": lambda value: value.section(Person),
            "phone": lambda value: value.section(Phone),
            "gnss": lambda value: value.section(Receiver),
            "fixes": lambda value: value.section(UserFixes),
        }
        values = {name: read(given[name]) for name, read in readers.items() if name in given}
        plan = None
        if "plan" in given:  # beside the scenario, else of the package
            file = given["plan"].typed(str)
            beside = path.parent / file
            packaged = [folder / file for folder in MAPS if (folder / file).is_file()]
            plan = beside if beside.exists() or not packaged else packaged[0]
        plans = {floor.label: floor for floor in FloorPlan.load_all(plan)} if plan else {}
        floor = str(content.get("floor", next(iter(plans), "")))
        route = route_of(given.get("route", Value(path, "route", None)), plans, floor, given.get("heading"))
        samples, most = route.duration * values.get("phone", Phone()).rate, 5e6  # fourteen hours at 100 Hz
        if samples > most:
            raise InputError(path, "route", f"about {samples:.0f} samples", f"at most {most:.0f}: a shorter walk")
        return cls(
            name=path.stem,
            route=route,
            plan=plan,
            plans=plans,
            user_fixes=values.pop("fixes", None),
            beacons=_beacons(given.get("beacons", Value(path, "beacons", {})), plans),
            access_points=_access_points(
                given.get("wifi", Value(path, "wifi", {})), list(plans) or [""], route, values.get("seed", 0)
            ),
            **values,
        )

    def _summary(self) -> list[str]:
        return [repr(self.name), f"seed {self.seed}", *self.route._summary(), f"hold {self.phone.hold!r}"]


def _beacons(value: Value, plans: Mapping[str, FloorPlan]) -> tuple[Transmitter, ...]:
    """The beacons of the plan and of the scenario; a position in the scenario replaces that in the plan."""
    beacons: dict[str, Transmitter] = {}
    for label, plan in plans.items():
        for area in plan.of_kind("beacon"):
            name = str(next((area.properties[k] for k in ("mac", "id", "uuid") if area.properties.get(k)), area.name))
            beacons[name] = Transmitter(name, shapely.get_coordinates(shapely.centroid(area.shape))[0], label)
    for name, place in value.table().items():
        floor = beacons[name].floor if name in beacons else next(iter(plans), "")
        beacons[name] = Transmitter(name, place.pair(), floor)
    return tuple(beacons.values())


def _access_points(value: Value, floors: list[str], route: Route, seed: int) -> tuple[Transmitter, ...]:
    """Access points at random positions around the route: ``[wifi] access_points = 12``."""
    table = value.table(["access_points"])
    count = table["access_points"].number(0, 1000, kind=int) if table else 0
    random = np.random.default_rng(seed)
    places = random.uniform(route.corners.min(axis=0) - 10, route.corners.max(axis=0) + 10, (count, 2))
    return tuple(
        Transmitter(f"06:00:00:00:{n // 256:02x}:{n % 256:02x}", place, floors[n % len(floors)], -40.0)
        for n, place in enumerate(places)
    )


# The keys of each kind of item of a route; the first key of this table in an item is its kind
KEYS = {
    "stairs": {"stairs", "to", "climb"},
    "to": {"to", "manner", "zigzag", "hold"},
    "follow": {"follow", "manner", "zigzag", "hold"},
    "stand": {"stand", "turn"},
    "turn": {"turn"},
    "visit": {"visit", "stay", "manner"},
    "lift": {"lift", "climb"},
    "roll": {"roll", "speed"},
    "hold": {"hold"},
    "shake": {"shake"},
}
SHORTEST_LEG = 0.2  # [m]
SHOP_FRONT = 0.7  # [m] distance of a visitor from a shop front


def route_of(items: Value, plans: Mapping[str, FloorPlan], floor: str, heading: Value | None) -> Route:
    """The route of a scenario from the items of its list, checked against the plan.

    floor: at the start; heading: at the start [deg], counter-clockwise from +x; None for that of the first leg.
    """
    if not isinstance(items.value, list) or len(items.value) < 2:
        raise items.error("a list: the start, then what the walker does", repr(items.value)[:40])
    if plans and floor not in plans:
        raise Value(items.path, "floor", floor).error("one of " + ", ".join(plans))
    start, *rest = (replace(items, place=f"route, item {n}", value=item) for n, item in enumerate(items.value, 1))
    position = start.pair()
    draft = _Draft(plans, position, floor, corners=[position])
    for item in rest:
        draft.add(item)
    draft.finish()
    corners = np.array(draft.corners)
    if heading is None:
        ahead = (corners - position)[np.hypot(*(corners - position).T) > 0]
        direction = float(np.arctan2(ahead[0, 1], ahead[0, 0])) if len(ahead) else 0.0
    else:
        direction = np.radians(heading.number())
    resting = sum(s.seconds for s in draft.activities if isinstance(s, Stand | Shake))
    walking = float(np.hypot(*np.diff(corners, axis=0).T).sum()) / 0.5  # so slow [m/s] that it is no underestimate
    return Route(position, direction, floor, tuple(draft.activities), corners, resting + walking)


@dataclass
class _Draft:
    """The route so far.

    position: ``(2,)`` current [m]; legs: end, manner and zigzag of each leg of the unfinished walk; begin: ``(2,)``
    start of that walk [m].
    """

    plans: Mapping[str, FloorPlan]
    position: Array
    floor: str
    activities: list[Activity] = field(default_factory=list)
    legs: list[tuple[Array, str, float]] = field(default_factory=list)
    begin: Array = field(default_factory=lambda: np.zeros(2))
    corners: list[Array] = field(default_factory=list)

    def add(self, item: Value) -> None:
        """Add an item of the route."""
        table = {"to": item.value} if isinstance(item.value, list) else item.value
        kind = next((k for k in KEYS if isinstance(table, dict) and k in table), None)
        if kind is None:
            raise item.error("[x, y] or one of " + ", ".join(KEYS))
        if extra := set(table) - KEYS[kind]:
            raise item.error(", ".join(sorted(KEYS[kind])), f"an unknown name {min(extra)!r}")

        def value(name: str, default: Any = 0.0) -> Value:
            return replace(item, value=table.get(name, default))

        manner = value("manner", "normal").one_of(MANNERS)
        if kind in ("to", "follow"):
            for corner in value("to").points() if kind == "to" else self.link(item, str(table["follow"])):
                self.move_to(item, corner, manner, value("zigzag").number(0.0, 10.0))
            if "hold" in table:
                self.finish(new_hold=value("hold").one_of(HOLDS))
            return
        if kind == "visit":
            self.move_to(item, self.front(item, str(table["visit"])), manner)
        self.finish()
        if kind in ("stairs", "lift"):
            floor = str(table[kind])
            if self.plans and floor not in self.plans:
                raise item.error("one of " + ", ".join(self.plans), f"floor {table[kind]!r}")
            rise = self.plans[floor].height - self.plans[self.floor].height if self.plans else STOREY
            climb = value("climb", rise).number(-500.0, 500.0)
            if kind == "stairs":
                for corner in value("to", None).points():
                    self.move_to(item, corner, "stairs", walls=False)  # stairs pass through the floor
                self.finish(climb, floor)
            else:
                self.activities.append(Ride(climb, floor))
                self.floor = floor
            return
        match kind:
            case "stand":
                activity: Activity = Stand(value(kind).number(0.0), np.radians(value("turn").number()), "stand")
            case "turn":
                activity = Stand(0.0, np.radians(value(kind).number()))
            case "visit":
                activity = Stand(value("stay", 15.0).number(0.0), event=f"visit {table['visit']}")
            case "roll":
                self.move_to(item, value(kind).pair())
                activity = Roll(self.position, value("speed", 0.5).number(0.05, 10.0))
            case "shake":
                activity = Shake(value(kind).number(0.0))
            case _:
                activity = ChangeHold(value(kind).one_of(HOLDS))
        self.activities.append(activity)

    def move_to(self, item: Value, to: Array, manner: str = "", zigzag: float = 0.0, walls: bool = True) -> None:
        """Set the position, and add a leg to the walk if there is a manner of walking.

        Raises InputError if the position is too near or, with `walls`, behind a wall.
        """
        plan, begin = self.plans.get(self.floor), self.position
        if np.hypot(*(to - begin)) < SHORTEST_LEG:
            raise item.error("a longer leg", f"a leg of less than {SHORTEST_LEG} m")
        if walls and plan is not None and plan.crosses_wall(begin[None], to[None])[0]:
            found = f"a leg from ({begin[0]:g}, {begin[1]:g}) to ({to[0]:g}, {to[1]:g}) through a wall"
            raise item.error("a leg without walls", found)
        if manner:
            self.begin = self.begin if self.legs else begin
            self.legs.append((to, manner, zigzag))
        self.position = to
        self.corners.append(to)

    def finish(self, climb: float = 0.0, floor: str = "", new_hold: str = "") -> None:
        """Add the walk over all legs so far to the activities."""
        if not self.legs:
            return
        ends, manners, zigzag = zip(*self.legs, strict=True)
        corners = np.array([self.begin, *ends])
        along = length_along(corners)
        heights = climb * along / along[-1]
        self.activities.append(Walk(corners, heights, manners, np.array(zigzag), new_hold, floor))
        self.legs, self.floor = [], floor or self.floor

    def link(self, item: Value, name: str) -> list[Array]:
        """The corners of a link of the plan, without the one at the current position."""
        plan = self.plans.get(self.floor)
        links = [area for area in plan.of_kind("link") if area.name == name] if plan else []
        if not links:
            raise item.error("the name of a link of the plan on this floor", f"a link {name!r}")
        corners = shapely.get_coordinates(links[0].shape)
        return [c for n, c in enumerate(corners) if n or np.hypot(*(c - self.position)) > SHORTEST_LEG]

    def front(self, item: Value, name: str) -> Array:
        """The position ``(2,)`` [m] before the front of an area, on the shortest line from the current position."""
        plan = self.plans.get(self.floor)
        areas = [a for a in plan.areas if a.name == name] if plan else []
        if not areas:
            raise item.error("the name of an area of the plan on this floor", f"a visit to {name!r}")
        nearest = np.array(shapely.shortest_line(shapely.Point(self.position), areas[0].shape).coords)[-1]
        back = self.position - nearest
        return nearest + back * min(1.0, SHOP_FRONT / max(float(np.hypot(*back)), 1e-9))
