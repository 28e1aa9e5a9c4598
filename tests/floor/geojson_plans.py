"""Plans of a test as GeoJSON: shapes in metres are written in degrees."""

import json

import numpy as np
import shapely

from pdr_graph.frames import enu

HERE = enu(48.0, 11.0)


def feature(kind, shape, frame=HERE, **properties):
    """A feature of one kind with its shape [m], or the corners of its box."""
    shape = shapely.box(*shape) if isinstance(shape, tuple) else shape
    geometry = json.loads(shapely.to_geojson(shapely.transform(shape, frame.to_lonlat)))
    return {"type": "Feature", "properties": {"kind": kind, **properties}, "geometry": geometry}


def written(path, *features, **about):
    """Write a plan; about: what the file says of itself."""
    path.parent.mkdir(parents=True, exist_ok=True)
    about = {"origin": [11.0, 48.0]} | about
    path.write_text(json.dumps({"type": "FeatureCollection", "pdr_graph": about, "features": features}))
    return path


def crosses(floor, a, b):
    """True if there is a wall between two positions [m]."""
    return bool(floor.crosses_wall(np.array([a], float), np.array([b], float))[0])
