import numpy as np
import pytest
from pyproj import CRS, Geod, Transformer
from walks import fixes_at

from pdr_graph.frames import Frame, enu


def test_enu_agrees_with_geodesics():
    """Distance and azimuth from the origin are the geodesic's: what an azimuthal equidistant plane promises."""
    frame = enu(35.0, 135.0)
    xy = np.array([[120.0, -40.0], [-800.0, 650.0]])
    for (x, y), (lon, lat) in zip(xy, frame.to_lonlat(xy), strict=True):
        azimuth, _, distance = Geod(ellps="WGS84").inv(135.0, 35.0, lon, lat)
        assert distance == pytest.approx(np.hypot(x, y), abs=1e-4)
        assert np.radians(azimuth) == pytest.approx(np.arctan2(x, y), abs=1e-7)


@pytest.mark.parametrize("seed", range(5))
def test_enu_is_that_between_reference_systems_to_the_bit(seed):
    random = np.random.default_rng(seed)
    lat, lon = random.uniform([-90, -180], [90, 180])
    system = CRS(f"+proj=aeqd +lat_0={lat} +lon_0={lon} +ellps=WGS84")
    oracle = Transformer.from_crs("EPSG:4326", system, always_xy=True)
    position = random.normal(0, 1e4, (1000, 2))
    lonlat = enu(lat, lon).to_lonlat(position)
    assert (lonlat == np.stack(oracle.transform(*position.T, direction="INVERSE"), axis=1)).all()
    assert (enu(lat, lon).from_lonlat(lonlat) == np.stack(oracle.transform(*lonlat.T), axis=1)).all()


@pytest.mark.parametrize(
    "frame", [enu(60.0, 25.0), Frame("projected", epsg=32632), Frame("plan", (30.0, 120.0), None, (96000.0, 111319.0))]
)
def test_there_and_back(frame):
    xy = np.array([[566_570.0, 5_932_830.0]]) if frame.epsg else np.array([[12.0, 34.0], [-500.0, 3.0]])
    assert frame.from_lonlat(frame.to_lonlat(xy)) == pytest.approx(xy, abs=1e-6)


def test_geodetic_fixes_are_placed_and_metric_ones_left():
    frame = enu(35.0, 135.0)
    metric = fixes_at([0.0], [[5.0, 6.0]])
    assert frame.place(metric) is metric
