"""Checks of a scenario's values, and its route as a sequence of activities, checked against the plan.

All functions raise InputError with the place in the file if something is wrong.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor.formats.drawing import STOREY
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import length_along
from pdr_graph.lab.simulation.body import Activity, ChangeHold, Ride, Roll, Shake, Stand, Walk
from pdr_graph.lab.simulation.carrying import HOLDS
from pdr_graph.lab.simulation.pedestrian import MANNERS
from pdr_graph.types import Array, OneLineRepr

# Names of types in messages
TYPE_NAMES = {float: "a number", int: "a whole number", str: "a text", dict: "a table", list: "a list"}
MAXIMUM_COORDINATE = 1e5  # [m] from the origin


def typed(path: Path, place: str, value: Any, kind: type) -> Any:
    """The value, if it is of type `kind`; a whole number is accepted for a float."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        if kind in (float, int) and isinstance(value, (int, kind)) and abs(value) < 1e15:
            return kind(value)
    elif isinstance(value, kind):
        return value
    raise InputError(path, place, repr(value), TYPE_NAMES[kind])


def number(path: Path, place: str, value: Any, low: float = -1e5, high: float = 1e5, unit: str = "") -> float:
    """The value, if it is a number from `low` to `high`; unit: for the message."""
    checked = typed(path, place, value, float)
    if not low <= checked <= high:
        raise InputError(path, place, f"{checked:g}", f"{low:g} to {high:g} {unit}".rstrip())
    return checked


def pair(
    path: Path, place: str, value: Any, expected: str = "[x, y] in metres", most: float = MAXIMUM_COORDINATE
) -> Array:
    """Two numbers ``(2,)``, each at most `most` in size; expected: for the message."""
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise InputError(path, place, repr(value), expected)
    both = np.array([typed(path, place, v, float) for v in value])
    if not np.all(np.abs(both) <= most):
        raise InputError(path, place, repr(value), f"{expected}, at most {most:g}")
    return both


def one_of(path: Path, place: str, value: Any, names: Iterable[str]) -> str:
    """The value, if it is one of `names`."""
    if not isinstance(value, str) or value not in names:
        raise InputError(path, place, repr(value), "one of " + ", ".join(filter(None, names)))
    return value


def check_keys(path: Path, place: str, table: Iterable[str], names: Iterable[str]) -> None:
    """Raise InputError if a table has a key that is not one of `names`."""
    for name in table:
        if name not in names:
            raise InputError(path, f"{place}.{name}".lstrip("."), "an unknown name", "one of " + ", ".join(names))


# The keys of each kind of item of a route
KEYS = {
    "to": {"to", "manner", "zigzag", "hold"},
    "follow": {"follow", "manner", "zigzag", "hold"},
    "stand": {"stand", "turn"},
    "turn": {"turn"},
    "visit": {"visit", "stay", "manner"},
    "stairs": {"stairs", "to", "climb"},
    "lift": {"lift", "climb"},
    "roll": {"roll", "speed"},
    "hold": {"hold"},
    "shake": {"shake"},
}


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


SHORTEST_LEG = 0.2  # [m]


@dataclass
class _Draft:
    """The route so far.

    position: ``(2,)`` current [m]; legs: end, manner and zigzag of each leg of the unfinished walk; begin: ``(2,)``
    start of that walk [m].
    """

    path: Path
    plans: Mapping[str, FloorPlan]
    position: Array
    floor: str
    activities: list[Activity] = field(default_factory=list)
    legs: list[tuple[Array, str, float]] = field(default_factory=list)
    begin: Array = field(default_factory=lambda: np.zeros(2))
    new_hold: str = ""
    corners: list[Array] = field(default_factory=list)

    def add_leg(self, place: str, to: Array, manner: str, zigzag: float) -> None:
        """Add a leg to the walk; raises InputError if it leads through a wall."""
        begin = self.position
        self.move_to(place, to)
        if not self.legs:
            self.begin = begin
        self.legs.append((to, manner, zigzag))

    def move_to(self, place: str, to: Array, walls: bool = True) -> None:
        """Set the position; raises InputError if it is too near or, with `walls`, behind a wall."""
        plan = self.plans.get(self.floor)
        if np.hypot(*(to - self.position)) < SHORTEST_LEG:
            raise InputError(self.path, place, f"a leg of less than {SHORTEST_LEG} m", "a longer leg")
        if walls and plan is not None and plan.crosses_wall(self.position[None], to[None])[0]:
            found = f"a leg from ({self.position[0]:g}, {self.position[1]:g}) to ({to[0]:g}, {to[1]:g}) through a wall"
            raise InputError(self.path, place, found, "a leg without walls")
        self.position = to
        self.corners.append(to)

    def finish(self, climb: float = 0.0, floor: str = "") -> None:
        """Add the walk over all legs so far to the activities."""
        if not self.legs:
            return
        corners = np.array([self.begin, *(to for to, _, _ in self.legs)])
        along = length_along(corners)
        heights = climb * along / along[-1]
        manners, zigzag = tuple(m for _, m, _ in self.legs), np.array([z for _, _, z in self.legs])
        self.activities.append(Walk(corners, heights, manners, zigzag, self.new_hold, floor))
        self.legs, self.new_hold, self.floor = [], "", floor or self.floor


def route_of(path: Path, items: Any, plans: Mapping[str, FloorPlan], floor: str, heading: Any) -> Route:
    """The route of a scenario from the items of its list.

    floor: at the start; heading: at the start [deg], counter-clockwise from +x; None for that of the first leg.
    """
    if not isinstance(items, list) or len(items) < 2:
        raise InputError(path, "route", repr(items)[:40], "a list: the start, then what the walker does")
    if plans and floor not in plans:
        raise InputError(path, "floor", repr(floor), "one of " + ", ".join(plans))
    start = pair(path, "route, item 1", items[0])
    draft = _Draft(path, plans, start, floor, corners=[start])
    for n, item in enumerate(items[1:], start=2):
        _item(draft, f"route, item {n}", {"to": item} if isinstance(item, list) else item)
    draft.finish()
    corners = np.array(draft.corners)
    if heading is None:
        ahead = (corners - start)[np.hypot(*(corners - start).T) > 0]
        direction = float(np.arctan2(ahead[0, 1], ahead[0, 0])) if len(ahead) else 0.0
    else:
        direction = np.radians(number(path, "heading", heading))
    resting = sum(s.seconds for s in draft.activities if isinstance(s, Stand | Shake))
    slow = 0.5  # [m/s] so that the duration is no underestimate
    duration = resting + float(np.hypot(*np.diff(corners, axis=0).T).sum()) / slow
    return Route(start, direction, floor, tuple(draft.activities), corners, duration)


def _item(draft: _Draft, place: str, item: Any) -> None:
    """Add the activity of one item of the route. The first key of KEYS in it is its kind."""
    path = draft.path
    kind = next((k for k in ("stairs", *KEYS) if isinstance(item, dict) and k in item), None)
    if kind is None:
        raise InputError(path, place, repr(item), "[x, y] or one of " + ", ".join(KEYS))
    if extra := set(item) - KEYS[kind]:
        raise InputError(path, place, f"an unknown name {min(extra)!r}", ", ".join(sorted(KEYS[kind])))
    manner = one_of(path, place, item.get("manner", "normal"), MANNERS)
    if kind in ("to", "follow"):
        corners = _points(path, place, item["to"]) if kind == "to" else _link(draft, place, str(item["follow"]))
        for corner in corners:
            draft.add_leg(place, corner, manner, number(path, place, item.get("zigzag", 0.0), 0.0, 10.0))
        if "hold" in item:
            draft.new_hold = one_of(path, place, item["hold"], HOLDS)
            draft.finish()
        return
    if kind == "visit":
        draft.add_leg(place, _front(draft, place, str(item["visit"])), manner, 0.0)
    draft.finish()
    if kind == "stairs":
        _climb_stairs(draft, place, item)
    else:
        draft.activities.append(_activity(draft, place, kind, item))


CLIMBS = (-500.0, 500.0)  # [m] accepted for stairs and lifts


def _activity(draft: _Draft, place: str, kind: str, item: dict[str, Any]) -> Activity:
    """An activity without walking."""

    def value(name: str, default: float = 0.0, low: float = -1e5, high: float = 1e5) -> float:
        return number(draft.path, place, item.get(name, default), low, high)

    match kind:
        case "stand":
            return Stand(value("stand", low=0.0), np.radians(value("turn")), "stand")
        case "turn":
            return Stand(0.0, np.radians(value("turn")))
        case "visit":
            return Stand(value("stay", 15.0, low=0.0), event=f"visit {item['visit']}")
        case "lift":
            to = _floor(draft, place, item["lift"])
            ride = Ride(value("climb", _climb(draft, to), *CLIMBS), to)
            draft.floor = to
            return ride
        case "roll":
            draft.move_to(place, pair(draft.path, place, item["roll"]))
            return Roll(draft.position, value("speed", 0.5, 0.05, 10.0))
        case "shake":
            return Shake(value("shake", low=0.0))
        case _:
            return ChangeHold(one_of(draft.path, place, item["hold"], HOLDS))


def _climb_stairs(draft: _Draft, place: str, item: dict[str, Any]) -> None:
    """Add a walk on stairs to another floor."""
    draft.begin = draft.position
    for corner in _points(draft.path, place, item.get("to")):
        draft.legs.append((corner, "stairs", 0.0))
        draft.move_to(place, corner, walls=False)  # stairs pass through the floor
    to = _floor(draft, place, item["stairs"])
    draft.finish(number(draft.path, place, item.get("climb", _climb(draft, to)), *CLIMBS), to)


def _climb(draft: _Draft, to: str) -> float:
    """Height from the current floor to another [m], by the plan; one storey without a plan."""
    return draft.plans[to].height - draft.plans[draft.floor].height if draft.plans else STOREY


def _link(draft: _Draft, place: str, name: str) -> list[Array]:
    """The corners of a link of the plan, without the one at the current position."""
    plan = draft.plans.get(draft.floor)
    links = [area for area in plan.of_kind("link") if area.name == name] if plan else []
    if not links:
        raise InputError(draft.path, place, f"a link {name!r}", "the name of a link of the plan on this floor")
    corners = shapely.get_coordinates(links[0].shape)
    return [c for n, c in enumerate(corners) if n or np.hypot(*(c - draft.position)) > SHORTEST_LEG]


SHOP_FRONT = 0.7  # [m] distance of a visitor from a shop front


def _front(draft: _Draft, place: str, name: str) -> Array:
    """The position ``(2,)`` [m] before the front of an area, on the shortest line from the current position."""
    plan = draft.plans.get(draft.floor)
    areas = [a for a in plan.areas if a.name == name] if plan else []
    if not areas:
        raise InputError(draft.path, place, f"a visit to {name!r}", "the name of an area of the plan on this floor")
    nearest = np.array(shapely.shortest_line(shapely.Point(draft.position), areas[0].shape).coords)[-1]
    back = draft.position - nearest
    return nearest + back * min(1.0, SHOP_FRONT / max(float(np.hypot(*back)), 1e-9))


def _floor(draft: _Draft, place: str, label: Any) -> str:
    """The label of a floor as a text; raises InputError if the plan has no such floor."""
    if draft.plans and str(label) not in draft.plans:
        raise InputError(draft.path, place, f"floor {label!r}", "one of " + ", ".join(draft.plans))
    return str(label)


def _points(path: Path, place: str, value: Any) -> list[Array]:
    """Positions ``(2,)`` [m] from [x, y] or a list of these."""
    several = value if isinstance(value, list) and value and isinstance(value[0], list) else [value]
    return [pair(path, place, v) for v in several]
