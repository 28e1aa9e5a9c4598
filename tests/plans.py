"""Floors drawn for a test, and those of maps/."""

from pathlib import Path

from pdr_graph.floor.cells import Area
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.frames import Frame

MAPS = Path(__file__).resolve().parents[1] / "maps"


def plan(*areas):
    """A floor of areas, each a kind, a name if it has one, and a shape [m]."""
    return FloorPlan("1", tuple(Area(kind, "".join(name), shape) for kind, *name, shape in areas), Frame())
