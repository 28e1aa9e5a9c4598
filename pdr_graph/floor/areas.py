"""Areas of a floor plan, and their kinds."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import shapely

OUTLINE = "floor"
OPEN = ("corridor", "intersection", "stairs")  # open to each other
CLOSED = ("room", "lift")  # enclosed by walls, except at doors
CONNECTING = ("stairs", "lift")  # from floor to floor
DOOR = "door"
WALKABLE = (*OPEN, *CLOSED, DOOR)
WALL = "wall"
SOLID = (WALL, "shop", "place")
LINK, BEACON = "link", "beacon"
KINDS = (OUTLINE, *WALKABLE, *SOLID, LINK, BEACON)


@dataclass(frozen=True)
class Area:
    """One feature of a plan.

    kind: one of KINDS. shape [m]: a polygon; a wall or door may be a line, a door, place or beacon a point, a link is
    a line that people walk along. properties: all other properties in the file. floors: labels of its floors, empty
    if it is on all.
    """

    kind: str
    name: str
    shape: shapely.Geometry
    properties: dict[str, Any] = field(default_factory=dict)
    floors: tuple[str, ...] = ()

    @property
    def is_polygon(self) -> bool:
        """True if the shape is two-dimensional."""
        return shapely.get_dimensions(self.shape) == 2
