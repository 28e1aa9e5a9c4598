"""Floors drawn for a test, and those of maps/."""

import json
from pathlib import Path

import shapely

from pdr_graph.floor.cells import Area
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.frames import Frame

ROOT = Path(__file__).resolve().parents[1]
MAPS = ROOT / "maps"
ARCADE, TWO_FLOORS, EIGHT = (MAPS / f"{name}.geojson" for name in ("arcade", "two_floors", "figure_eight"))


def plan(*areas):
    """A floor of areas, each a kind, a name if it has one, and a shape [m]."""
    return FloorPlan("1", tuple(Area(kind, "".join(name), shape) for kind, *name, shape in areas), Frame())


def corridors(*lines, width):
    """A floor of corridors of one width along lines [m]."""
    shapes = [shapely.LineString(line).buffer(width / 2, cap_style="square") for line in lines]
    return plan(("corridor", shapely.union_all(shapes)))


def ring():
    """Corridors of 2.5 m round a block of 14 m, with the intersections at its corners."""
    at, w = (-1.25, 12.75), 2.5
    crossings = [shapely.box(x, y, x + w, y + w) for x in at for y in at]
    ways = [shapely.box(1.25, y, 12.75, y + w) for y in at] + [shapely.box(x, 1.25, x + w, 12.75) for x in at]
    areas = [("intersection", c) for c in crossings] + [("corridor", c) for c in ways]
    return plan(*areas)


def moved(source, path, lat, lon):
    """Write a drawn plan with its origin elsewhere [deg], to `path`."""
    drawn = json.loads(source.read_text())
    (west, south), drawn["pdr_graph"]["origin"] = drawn["pdr_graph"]["origin"], [lon, lat]
    for feature in drawn["features"]:
        feature["geometry"]["coordinates"] = _shifted(feature["geometry"]["coordinates"], lon - west, lat - south)
    path.write_text(json.dumps(drawn))
    return path


def _shifted(coordinates, east, north):
    if isinstance(coordinates[0], float | int):
        return [round(coordinates[0] + east, 8), round(coordinates[1] + north, 8)]
    return [_shifted(inner, east, north) for inner in coordinates]
