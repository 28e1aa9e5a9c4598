"""What a floor plan draws."""

from __future__ import annotations

from dataclasses import dataclass

import shapely

OUTLINE = "floor"
WALKABLE = ("corridor", "room", "door", "stairs", "lift")
SOLID = ("wall", "shop", "place")


@dataclass(frozen=True)
class Area:
    """One polygon of a plan [m]. kind: OUTLINE, or one of WALKABLE or SOLID."""

    kind: str
    name: str
    polygon: shapely.Geometry
