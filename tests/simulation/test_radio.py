"""GNSS, beacons and access points."""

import numpy as np
import pytest
from plans import MAPS

from pdr_graph.geometry import interpolate
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate

MALL = MAPS / "mall.geojson"
ROUTE = [[0, 0], {"to": [[150, 0], [150, 100], [0, 100]]}]


def walked(seed=0, route=ROUTE, **more):
    return simulate(Scenario.of({"seed": seed, "route": route, "phone": {"rate": 25}} | more))


def error(walk, late=0.0):
    fixes = walk.gnss.fixes
    return fixes.position - interpolate(fixes.time - late, walk.body.time, walk.body.position)


@pytest.fixture(scope="module")
def without_outliers():
    return [walked(seed, gnss={"outliers": 0}) for seed in range(25)]


@pytest.mark.thorough
def test_68_percent_of_gnss_fixes_are_within_their_accuracy(without_outliers):
    inside = np.concatenate([np.hypot(*error(w).T) < w.gnss.accuracy for w in without_outliers])
    assert inside.mean() == pytest.approx(0.68, abs=0.06)


@pytest.mark.thorough
def test_gnss_errors_are_correlated_for_tens_of_seconds(without_outliers):
    errors = [error(walk) for walk in without_outliers]
    kept = [np.corrcoef(e[:-10].ravel(), e[10:].ravel())[0, 1] for e in errors]
    gone = [np.corrcoef(e[:-200].ravel(), e[200:].ravel())[0, 1] for e in errors]
    assert np.mean(kept) > 0.5 > 0.3 > np.mean(gone)


def test_latency_delays_the_fixes():
    walk = walked(gnss={"latency": 3.0, "accuracy": 0.2, "outliers": 0})
    spread = [error(walk, late).std() for late in (0.0, 3.0)]
    assert spread[1] < 0.2 < 1.0 < spread[0]


def test_outages_and_outliers_occur_as_requested():
    walk = walked(gnss={"outages": [[50, 90]], "outliers": 0.1})
    time = walk.gnss.fixes.time
    assert not np.any((time >= 50) & (time < 90))
    assert np.any(time < 50)
    assert np.any(time > 90)
    outlier = np.hypot(*error(walk).T) > 4 * walk.gnss.accuracy
    assert 0.02 < outlier.mean() < 0.12


def test_hdop_is_proportional_to_the_accuracy():
    walk = walked(gnss={})
    assert np.corrcoef(walk.gnss.hdop, walk.gnss.accuracy)[0, 1] > 0.8
    assert np.median(walk.gnss.hdop) == pytest.approx(0.9, rel=0.4)


def levels_of(walk, name):
    received = walk.bluetooth
    rows = np.array(received.transmitter) == name
    return interpolate(received.time[rows], walk.body.time, walk.body.position), received.rssi[rows]


def test_the_level_of_a_beacon_falls_with_distance_and_behind_the_body():
    """Towards and away from it at many places: 22 dB per decade, 7 dB behind the body."""
    distance, level, facing = [], [], []
    for n in range(60):
        x = 1000.0 * n  # with a different pattern of walls at each
        walk = walked(n, [[x - 15, 1], [x + 15, 1]], beacons={"a": [x, 0.0]})
        place, rssi = levels_of(walk, "a")
        distance.append(np.log10(np.maximum(np.hypot(*(place - [x, 0]).T), 0.5)))
        facing.append((place[:, 0] < x).astype(float))
        level.append(rssi)
    d, f, y = (np.concatenate(v) for v in (distance, facing, level))
    far = d > 0.6
    columns = np.column_stack([d[far], f[far], np.ones(far.sum())])
    slope, gain, _ = np.linalg.lstsq(columns, y[far], rcond=None)[0]
    assert slope == pytest.approx(-22, abs=2.5)
    assert gain == pytest.approx(7, abs=1.5)


def test_a_relocated_beacon_is_strongest_at_its_true_position():
    """At (42, 12.5) on the plan, and ten metres away in the scenario."""
    name, route = "02:00:00:00:00:02", [[20, 11.5], [65, 11.5]]
    for beacons, where in (({}, 42.0), ({name: [52.0, 12.5]}, 52.0)):
        place, level = levels_of(walked(1, route, plan=str(MALL), beacons=beacons), name)
        strongest = np.average(place[:, 0], weights=10 ** (level / 10))
        assert strongest == pytest.approx(where, abs=2.5)


def test_access_points_are_received_in_scans():
    walk = walked(wifi={"access_points": 8})
    scans, counts = np.unique(walk.wifi.time, return_counts=True)
    assert np.median(np.diff(scans)) == pytest.approx(3.0)
    assert counts.max() > 2
    assert np.all(walk.wifi.rssi >= -97)
