"""What a floor plan draws."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import shapely

OUTLINE = "floor"
OPEN = ("corridor", "intersection", "stairs")  # one steps from one into the next
CLOSED = ("room", "lift")  # walls all round, but for doors
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
    a line that people walk along. properties: whatever else the file says of it. floors: labels of those that it is
    on, none said: on all.
    """

    kind: str
    name: str
    shape: shapely.Geometry
    properties: dict[str, Any] = field(default_factory=dict)
    floors: tuple[str, ...] = ()

    @property
    def is_polygon(self) -> bool:
        """True if it has an area."""
        return shapely.get_dimensions(self.shape) == 2
