"""Each position source of a walk has a track of its own, and the table says which were overruled."""

from dataclasses import replace

import numpy as np
import pytest
from walks import fixes_at, fixes_on, square_walk

from pdr_graph import dead_reckon, smooth
from pdr_graph.apps.report.content import position_sources
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.types import Contradiction, Fixes, Levels

STEPS = square_walk()
TRUTH = dead_reckon(STEPS)
CORNERS = np.array([[0.0, 0.0], [14.0, 0.0], [14.0, 14.0], [0.0, 14.0]])


def shifted(metres, source):
    """Fixes of a receiver that is off by the same distance to the east throughout."""
    fixes = fixes_on(TRUTH, 4, sigma=1.0)
    return Fixes(
        fixes.time + 0.01, fixes.position + np.array([metres, 0.0]), fixes.sigma, source=(source,) * len(fixes)
    )


def levels():
    """Exact levels of a beacon in each corner of the square."""
    rows, beacons = np.arange(2, len(TRUTH), 3), np.arange(4)
    time, beacon = np.repeat(TRUTH.time[rows], 4), np.tile(beacons, len(rows))
    distance = np.hypot(*(TRUTH.position[rows][:, None] - CORNERS).reshape(-1, 2).T)
    rssi = -59.0 - 20.0 * np.log10(np.maximum(distance, 0.5))
    return Levels(time, beacon, rssi, ("A", "B", "C", "D"), CORNERS, np.full(4, 0.5))


def sources_of(fixes, **more):
    graph = WalkGraph(STEPS, fixes, **more)
    estimate = smooth(graph)
    return {one.name: one for one in position_sources(graph, estimate)}, estimate


def test_a_walk_by_a_single_source_has_no_table():
    assert sources_of(fixes_on(TRUTH, 10))[0] == {}


def test_a_source_that_lies_has_its_own_track_where_it_says():
    good = fixes_on(TRUTH, 1, sigma=0.5)
    found, estimate = sources_of(Fixes.concatenate([good, shifted(12.0, "GNSS")]))
    assert list(found) == ["fixes", "GNSS"]
    assert max(found["fixes"].distances(estimate.trajectory)) < 1.0
    median, largest = found["GNSS"].distances(estimate.trajectory)
    assert median == pytest.approx(12.0, abs=1.0)
    assert largest < 14.0


def test_an_overruled_source_is_named_with_its_reason():
    good = fixes_on(TRUTH, 1, sigma=0.5)
    wrong = fixes_at(TRUTH.time[[30, 60]] + 0.01, np.array([[90.0, 90.0], [70.0, 80.0]]))
    assert sources_of(Fixes.concatenate([good, wrong]))[0] == {}, "without a receiver all are one source"
    wrong = replace(wrong, source=("Wi-Fi",) * 2)
    found, _ = sources_of(Fixes.concatenate([good, wrong]))
    assert found["Wi-Fi"].remark.startswith("overruled: 2 of 2 rejected, the worst ")
    assert found["Wi-Fi"].weight < 0.1
    assert (found["fixes"].remark, round(found["fixes"].weight, 1)) == ("used", 1.0)


def test_a_source_that_leaves_the_direction_open_is_searched_from_the_result():
    start = fixes_at(TRUTH.time[:1], TRUTH.position[:1])
    found, estimate = sources_of(Fixes.concatenate([start, shifted(0.0, "GNSS")]))
    assert max(found["fixes"].distances(estimate.trajectory)) < 3.0


def test_beacons_alone_lead_along_the_walk():
    found, estimate = sources_of(fixes_on(TRUTH, 10), levels=levels())
    assert list(found) == ["fixes", "beacons"]
    assert found["beacons"].measurements == len(levels())
    assert np.median(np.hypot(*(found["beacons"].track.position - TRUTH.position).T)) < 3.0
    assert found["beacons"].distances(estimate.trajectory)[0] < 3.0


def test_no_track_is_estimated_once_the_time_is_used_up():
    graph = WalkGraph(STEPS, Fixes.concatenate([fixes_on(TRUTH, 10), shifted(1.0, "GNSS")]))
    estimate = smooth(graph)
    found = position_sources(graph, estimate, seconds=0.0)
    assert [one.track for one in found] == [None, None]
    assert np.isnan(found[0].distances(estimate.trajectory)).all()


def test_a_contradiction_stands_beside_its_source():
    graph = WalkGraph(STEPS, Fixes.concatenate([fixes_on(TRUTH, 10), shifted(1.0, "GNSS")]))
    reason = Contradiction("GNSS", "fixes", 5.0, "sigma", "GNSS lies 5 sigma east of the fixes", "the receiver")
    estimate = replace(smooth(graph), contradictions=(reason,))
    found = {one.name: one.remark for one in position_sources(graph, estimate, seconds=0.0)}
    assert "GNSS lies 5 sigma east of the fixes" in found["GNSS"]
    assert "GNSS lies" not in found["fixes"]
    assert repr(position_sources(graph, estimate, seconds=0.0)[0]) == "PositionSource(fixes, 9 measurements, used)"
