"""A scenario's values and route, checked one by one and against the plan; the route as what the body does.

What is wrong is refused with its place in the file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor.formats import STOREY
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import length_along
from pdr_graph.simulation.body import Ride, Roll, Shake, Stand, Stretch, Take, Walk
from pdr_graph.simulation.carrying import HOLDS
from pdr_graph.simulation.pedestrian import MANNERS
from pdr_graph.types import Array

FARTHEST = 1e5  # [m] from the origin
NAMES = {float: "a number", int: "a whole number", str: "a text", dict: "a table", list: "a list"}


def typed(path: Path, place: str, value: Any, kind: type) -> Any:
    """A value of a kind; a whole number will do for a float."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        if kind in (float, int) and isinstance(value, (int, kind)) and abs(value) < 1e15:
            return kind(value)
    elif isinstance(value, kind):
        return value
    raise InputError(path, place, repr(value), NAMES[kind])


def number(path: Path, place: str, value: Any, low: float = -1e5, high: float = 1e5, unit: str = "") -> float:
    """A number within bounds."""
    said = typed(path, place, value, float)
    if not low <= said <= high:
        raise InputError(path, place, f"{said:g}", f"{low:g} to {high:g} {unit}".rstrip())
    return said


def pair(path: Path, place: str, value: Any, expected: str = "[x, y] in metres", most: float = FARTHEST) -> Array:
    """Two numbers ``(2,)``, most of either."""
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise InputError(path, place, repr(value), expected)
    both = np.array([typed(path, place, v, float) for v in value])
    if not np.all(np.abs(both) <= most):
        raise InputError(path, place, repr(value), f"{expected}, at most {most:g}")
    return both


def one_of(path: Path, place: str, value: Any, names: Iterable[str]) -> str:
    """One of some words."""
    if not isinstance(value, str) or value not in names:
        raise InputError(path, place, repr(value), "one of " + ", ".join(filter(None, names)))
    return value


def known(path: Path, place: str, table: Iterable[str], names: Iterable[str]) -> None:
    """A table has only keys that mean something."""
    for name in table:
        if name not in names:
            raise InputError(path, f"{place}.{name}".lstrip("."), "an unknown name", "one of " + ", ".join(names))


HIGHEST = (-500.0, 500.0)  # [m] that stairs and lifts go
SLOW = 0.5  # [m/s]
SHORTEST_LEG = 0.2  # [m]
FRONT = 0.7  # [m] before a shop front, where one looks
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
class Route:
    """start: ``(2,)`` [m]; heading [rad] and floor there; stretches in order; corners: ``(c, 2)`` all places [m];
    duration: about [s].
    """

    start: Array
    heading: float
    floor: str
    stretches: tuple[Stretch, ...]
    corners: Array
    duration: float


@dataclass
class _Draft:
    """The route so far. legs: of the walk that is not finished: where to, manner, zigzag."""

    path: Path
    plans: Mapping[str, FloorPlan]
    where: Array
    floor: str
    stretches: list[Stretch] = field(default_factory=list)
    legs: list[tuple[Array, str, float]] = field(default_factory=list)
    begun: Array = field(default_factory=lambda: np.zeros(2))
    rehold: str = ""
    corners: list[Array] = field(default_factory=list)

    def go(self, place: str, to: Array, manner: str, zigzag: float) -> None:
        """One more leg; refused if it leads through a wall."""
        begun = self.where
        self.step(place, to)
        if not self.legs:
            self.begun = begun
        self.legs.append((to, manner, zigzag))

    def step(self, place: str, to: Array, walled: bool = True) -> None:
        """Be somewhere else; refused if a wall is between."""
        plan = self.plans.get(self.floor)
        if np.hypot(*(to - self.where)) < SHORTEST_LEG:
            raise InputError(self.path, place, f"a leg of less than {SHORTEST_LEG} m", "places apart")
        if walled and plan is not None and plan.crosses_wall(self.where[None], to[None])[0]:
            found = f"a way from ({self.where[0]:g}, {self.where[1]:g}) to ({to[0]:g}, {to[1]:g}) through a wall"
            raise InputError(self.path, place, found, "a way that one can walk")
        self.where = to
        self.corners.append(to)

    def finish(self, climb: float = 0.0, floor: str = "") -> None:
        """End the walk: what comes next is done standing."""
        if not self.legs:
            return
        corners = np.array([self.begun, *(to for to, _, _ in self.legs)])
        way = length_along(corners)
        heights = climb * way / way[-1]
        manners, zigzag = tuple(m for _, m, _ in self.legs), np.array([z for _, _, z in self.legs])
        self.stretches.append(Walk(corners, heights, manners, zigzag, self.rehold, floor))
        self.legs, self.rehold, self.floor = [], "", floor or self.floor


def route_of(path: Path, items: Any, plans: Mapping[str, FloorPlan], floor: str, heading: Any) -> Route:
    """The route of a scenario.

    heading: at the start [deg], counter-clockwise from +x; None for that of the first leg.
    """
    if not isinstance(items, list) or len(items) < 2:
        raise InputError(path, "route", repr(items)[:40], "a list: where it starts, and what is done then")
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
        towards = float(np.arctan2(ahead[0, 1], ahead[0, 0])) if len(ahead) else 0.0
    else:
        towards = np.radians(number(path, "heading", heading))
    resting = sum(s.seconds for s in draft.stretches if isinstance(s, Stand | Shake))
    duration = resting + float(np.hypot(*np.diff(corners, axis=0).T).sum()) / SLOW
    return Route(start, towards, floor, tuple(draft.stretches), corners, duration)


def _item(draft: _Draft, place: str, item: Any) -> None:
    """One thing to do. Its first known key says what."""
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
            draft.go(place, corner, manner, number(path, place, item.get("zigzag", 0.0), 0.0, 10.0))
        if "hold" in item:
            draft.rehold = one_of(path, place, item["hold"], HOLDS)
            draft.finish()
        return
    if kind == "visit":
        draft.go(place, _front(draft, place, str(item["visit"])), manner, 0.0)
    draft.finish()
    if kind == "stairs":
        _climb_stairs(draft, place, item)
    else:
        draft.stretches.append(_standing(draft, place, kind, item))


def _standing(draft: _Draft, place: str, kind: str, item: dict[str, Any]) -> Stretch:
    """What is done without walking."""

    def said(name: str, default: float = 0.0, low: float = -1e5, high: float = 1e5) -> float:
        return number(draft.path, place, item.get(name, default), low, high)

    match kind:
        case "stand":
            return Stand(said("stand", low=0.0), np.radians(said("turn")), "stand")
        case "turn":
            return Stand(0.0, np.radians(said("turn")))
        case "visit":
            return Stand(said("stay", 15.0, low=0.0), event=f"visit {item['visit']}")
        case "lift":
            to = _floor(draft, place, item["lift"])
            ride = Ride(said("climb", _rise(draft, to), *HIGHEST), to)
            draft.floor = to
            return ride
        case "roll":
            draft.step(place, pair(draft.path, place, item["roll"]))
            return Roll(draft.where, said("speed", 0.5, 0.05, 10.0))
        case "shake":
            return Shake(said("shake", low=0.0))
        case _:
            return Take(one_of(draft.path, place, item["hold"], HOLDS))


def _climb_stairs(draft: _Draft, place: str, item: dict[str, Any]) -> None:
    draft.begun = draft.where
    for corner in _points(draft.path, place, item.get("to")):
        draft.legs.append((corner, "stairs", 0.0))
        draft.step(place, corner, walled=False)  # through the hole in the floor
    to = _floor(draft, place, item["stairs"])
    draft.finish(number(draft.path, place, item.get("climb", _rise(draft, to)), *HIGHEST), to)


def _rise(draft: _Draft, to: str) -> float:
    """From the floor where one is to another [m], as the plan has it; a storey where there is no plan."""
    return draft.plans[to].height - draft.plans[draft.floor].height if draft.plans else STOREY


def _link(draft: _Draft, place: str, name: str) -> list[Array]:
    """The places of a link that the plan draws, from the one where one stands."""
    plan = draft.plans.get(draft.floor)
    links = [area for area in plan.of_kind("link") if area.name == name] if plan else []
    if not links:
        raise InputError(draft.path, place, f"a link {name!r}", "the name of a link of the plan on this floor")
    corners = shapely.get_coordinates(links[0].shape)
    return [c for n, c in enumerate(corners) if n or np.hypot(*(c - draft.where)) > SHORTEST_LEG]


def _front(draft: _Draft, place: str, name: str) -> Array:
    """Where one stands to look at something: straight ahead of where one is, before its front."""
    plan = draft.plans.get(draft.floor)
    areas = [a for a in plan.areas if a.name == name] if plan else []
    if not areas:
        raise InputError(draft.path, place, f"a visit to {name!r}", "the name of an area of the plan on this floor")
    nearest = np.array(shapely.shortest_line(shapely.Point(draft.where), areas[0].shape).coords)[-1]
    back = draft.where - nearest
    return nearest + back * min(1.0, FRONT / max(float(np.hypot(*back)), 1e-9))


def _floor(draft: _Draft, place: str, label: Any) -> str:
    if draft.plans and str(label) not in draft.plans:
        raise InputError(draft.path, place, f"floor {label!r}", "one of " + ", ".join(draft.plans))
    return str(label)


def _points(path: Path, place: str, value: Any) -> list[Array]:
    """[x, y], or a list of them."""
    several = value if isinstance(value, list) and value and isinstance(value[0], list) else [value]
    return [pair(path, place, v) for v in several]
