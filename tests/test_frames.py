import numpy as np
import pytest
from pyproj import Geod
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
