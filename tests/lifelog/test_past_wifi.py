"""Wi-Fi scans of days without GPS get positions from the scans of other days, with a sigma that holds."""

import numpy as np
import pytest
from made_past import LAT, LON, NOON, content, imported, position, scan, timeline
from made_wifi import EAST, Town, errors

from pdr_graph.apps.lifelog.past.past_days import access_points, day_sums, known_places, scan_positions, scans_of
from pdr_graph.apps.lifelog.past.past_rows import valid_positions
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.frames import METRES_PER_DEGREE
from pdr_graph.io.past_day import GPS, SIGHTING


def all_rows(store):
    """The rows of positions of all days."""
    texts = content(store)[2].values()
    return [line.split(",") for text in texts for line in text.split("milliseconds,")[1].splitlines()[1:]]


@pytest.mark.parametrize(("number", "moved"), [(3000, 0.02), (3000, 0.2), (800, 0.02)])
def test_the_stated_sigma_covers_the_error_at_home_and_on_the_way(tmp_path, number, moved):
    town = Town(1, number, moved)
    signals, truth = town.signals(range(14), gps=lambda day: day % 2 == 0)
    result = imported(tmp_path / "log", timeline(tmp_path / "t.json", (), signals))
    rows = [row for row in all_rows(tmp_path / "log") if len(row) == 5]
    error, sigma = errors(rows, truth)
    assert result.placed == len(error) > (2500 if number == 3000 else 200)
    second = np.array([int(row[0]) // 1000 % 86_400 for row in rows if row[4] == "wifi"])
    walks = ((second > 28_800) & (second < 30_000)) | ((second > 57_600) & (second < 58_800))
    for chosen in (walks, ~walks):
        assert np.mean(error[chosen] < 2.45 * sigma[chosen]) > 0.9  # 95 % of a circle; few independent places
        assert np.median(error[chosen]) < 20
    assert np.median(sigma) < 25, "not covered by saying nothing"


def test_a_day_is_placed_by_an_export_that_comes_later(tmp_path):
    town = Town(2)
    first, _ = town.signals([1], gps=lambda day: False)
    second, _ = town.signals([2])
    log = tmp_path / "log"
    assert imported(log, timeline(tmp_path / "a.json", (), first)).placed == 0
    assert imported(log, timeline(tmp_path / "b.json", (), second)).placed > 300
    assert imported(log, tmp_path / "a.json").positions.days == 0
    with Store(log) as store:
        assert len(store.entries()) == 2


def places(numbers, spots, levels=(-50, -60, -70, -80)):
    """A map of access points from scans at spots [m east]; numbers: their addresses at each spot."""
    positions, rows = [], []
    for n, (macs, spot) in enumerate(zip(numbers, spots, strict=True)):
        positions.append((NOON + 600 * n, LAT, LON + spot / EAST, 10.0))
        rows += [((NOON + 600 * n) * 1000, mac, level) for mac, level in zip(macs, levels, strict=False)]
    time, lat, lon, accuracy = np.array(positions).T
    scans = scans_of(np.array(rows, SIGHTING))
    known = known_places(scans, valid_positions(time, lat, lon, accuracy, GPS).positions)
    return access_points([day_sums(scans, known, 0)])


def test_an_access_point_seen_at_two_far_places_is_not_used():
    points = places([(1, 2, 3, 9), (4, 5, 6, 9)], [0, 5000])
    assert points["mac"].tolist() == [1, 2, 3, 4, 5, 6]
    assert (points["lon"][:3] - LON) * EAST == pytest.approx(np.zeros(3), abs=0.1)
    assert (points["lon"][3:] - LON) * EAST == pytest.approx(np.full(3, 5000), abs=0.1)


def test_a_scan_needs_three_access_points_that_agree():
    points = places([(1, 2, 3), (4, 5, 6)], [0, 1000])

    def found(*macs):
        return scan_positions(scans_of(np.array([(0, mac, -50 - mac % 10) for mac in macs], SIGHTING)), points)

    assert len(found(1, 2).scan) == 0
    assert len(found(1, 2, 4, 5).scan) == 0
    assert len(found(1, 2, 3, 99).scan) == 1
    assert (found(1, 2, 3, 4).lon - LON) * METRES_PER_DEGREE == pytest.approx([0], abs=0.5), (
        "the one elsewhere has no weight"
    )


def test_a_scan_is_at_a_known_place_only_near_in_time_to_a_good_position():
    def at(*positions, time=NOON):
        when, east, accuracy = np.array(positions, float).T
        rows = valid_positions(when, np.full(len(when), LAT), LON + east / EAST, accuracy, GPS).positions
        return known_places(scans_of(np.array([(time * 1000, 1, -50)], SIGHTING)), rows)

    between = at((NOON - 30, 0, 10), (NOON + 30, 40, 10))
    assert (between.lon - LON) * EAST == pytest.approx([20], abs=0.1)
    assert len(at((NOON - 15, 0, 10)).scan) == 1
    assert len(at((NOON - 25, 0, 10)).scan) == 0
    assert len(at((NOON, 0, 100)).scan) == 0


def test_scans_with_a_position_get_no_second_one(tmp_path):
    signals = [
        signal for n in range(40) for signal in (scan(NOON + 60 * n, {1: -40, 2: -50, 3: -60}), position(NOON + 60 * n))
    ]
    assert imported(tmp_path / "log", timeline(tmp_path / "t.json", (), signals)).placed == 0
