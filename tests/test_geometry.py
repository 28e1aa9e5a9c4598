"""Plane geometry of walks, and the frames in which it lies."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS, Geod, Transformer
from walks import fixes_at, square_walk, wandering_walk

from pdr_graph.frames import Frame, enu
from pdr_graph.geometry import dead_reckon, distance_walked, length_along, resample, row_times, wrap_angle
from pdr_graph.types import Trajectory


@given(st.floats(-1e3, 1e3))
def test_wrapped_angles_are_the_same_angles(angle):
    wrapped = wrap_angle(angle)
    assert -np.pi <= wrapped < np.pi
    assert np.exp(1j * wrapped) == pytest.approx(np.exp(1j * angle), abs=1e-9)


def test_a_square_closes_on_itself():
    """Four sides of 14 m with a quarter turn half-way through the first step of each: each corner is cut alike."""
    track = dead_reckon(square_walk(side=20))
    assert track.position[-1] == pytest.approx(track.position[0], abs=0.7)
    lap_length = np.hypot(*np.diff(track.position, axis=0).T).sum()
    assert lap_length == pytest.approx(80 * 0.7)


def test_dead_reckoning_starts_where_and_how_it_is_told():
    track = dead_reckon(wandering_walk(5), fixes_at([0.0], [[3.0, 4.0]]), heading=1.0)
    assert track.position[0] == pytest.approx([3.0, 4.0])
    assert track.heading[0] == pytest.approx(1.0)
    assert len(track) == 5 + 2


def test_steps_lead_as_far_as_the_track_that_they_draw_is_long():
    """By the end of each, nothing before the first, no further after the last; half-way through one, half of it."""
    steps = wandering_walk(40)
    far = distance_walked(steps, row_times(steps))
    assert far == pytest.approx(length_along(dead_reckon(steps).position))
    assert distance_walked(steps, np.array([steps.start - 5, steps.end + 5])) == pytest.approx([0, far[-1]])
    between = (steps.time[1:] + steps.time[:-1]) / 2
    assert distance_walked(steps, between) == pytest.approx((far[2:-1] + far[1:-2]) / 2)
    assert distance_walked(steps, steps.time, np.ones(40)) == pytest.approx(np.arange(40) + 1)


def test_resampled_rows_lie_on_the_track():
    track = dead_reckon(wandering_walk(40))
    fine = resample(track, 10.0)
    assert np.diff(fine.time[:-1]) == pytest.approx(0.1)
    assert fine.time[-1] == track.time[-1]
    for axis in range(2):
        assert fine.position[:, axis] == pytest.approx(np.interp(fine.time, track.time, track.position[:, axis]))


def test_resampling_takes_the_short_way_round_and_mixes_covariances():
    """From 3.0 rad to −3.0 rad it is 0.28 rad over π, not through zero."""
    covariance = np.array([np.eye(3), 3 * np.eye(3)])
    track = Trajectory(np.array([0.0, 1.0]), np.zeros((2, 2)), np.array([3.0, -3.0]), ("", ""), covariance)
    middle = resample(track, 2.0)
    assert abs(middle.heading[1]) == pytest.approx(np.pi)
    assert middle.covariance[1] == pytest.approx(2 * np.eye(3))


# Frames


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
