"""Beacons as ranges, and those that are not where their list says."""

from dataclasses import replace

import numpy as np
import pytest
from test_incremental import some
from test_receivers import assert_derivatives, meander, random_state
from walks import dead_reckon, fixes_at, steps_of

from pdr_graph.errors import InputError
from pdr_graph.estimation.beacons import HIGH, levels
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.incremental import IncrementalGraph
from pdr_graph.estimation.live_observations import LiveBeacons, SeenLevel
from pdr_graph.estimation.smoothers import smooth
from pdr_graph.geometry import interpolate
from pdr_graph.io.beacons import beside, read_beacons
from pdr_graph.types import Beacons, Recording, Sightings

POWER, EXPONENT, NOISE, WEAKEST = -60.0, 2.0, 4.0, -95.0
NAMES = tuple("abcdef")


def round_the_block(n=320):
    """Steps round a block of 35 m, and again."""
    turn = np.where(np.arange(n) % 50 == 49, np.pi / 2, 0.0)
    return steps_of(np.full(n, 0.7), turn)


def beacons_about(track, seed=0):
    """Six beacons about a walk."""
    random = np.random.default_rng(seed)
    low, high = track.position.min(axis=0) - 3, track.position.max(axis=0) + 3
    place = low + np.array([[0.1, 0.1], [0.9, 0.1], [0.5, 0.4], [0.1, 0.9], [0.9, 0.9], [0.3, 0.6]]) * (high - low)
    return Beacons(NAMES, place + random.normal(0, 1, (6, 2)), np.ones(6), ("",) * 6, NAMES)


def heard(track, place, seed=0):
    """What a phone hears once a second of beacons at ``place (6, 2)``, by the log-distance law and noise."""
    random = np.random.default_rng(seed)
    time = np.repeat(np.arange(0.5, track.time[-1], 1.0), 6)
    at = interpolate(time, track.time, track.position)
    which = np.tile(np.arange(6), len(time) // 6)
    distance = np.sqrt(np.sum((at - place[which]) ** 2, axis=1) + HIGH**2)
    rssi = POWER - 10 * EXPONENT * np.log10(distance) + random.normal(0, NOISE, len(time))
    loud = rssi > WEAKEST
    return Sightings(time[loud], tuple(NAMES[m] for m in which[loud]), rssi[loud])


def crooked(track, seed=0):
    """Steps with errors, whose truth is another walk: turned wrongly at each corner."""
    said, random = round_the_block(), np.random.default_rng(seed)
    return replace(said, turn=said.turn + random.normal(0, 0.03, len(said)), length=0.9 * said.length)


def test_jacobians():
    """Of levels, of beacons' places and powers, and of the path loss."""
    said = meander(60)
    track = dead_reckon(said)
    beacons = beacons_about(track)
    graph = WalkGraph(said, levels=levels(heard(track, beacons.position), beacons, said))
    assert_derivatives(graph, random_state(graph, np.random.default_rng(0)))


def test_gtsam_sees_the_same_graph():
    said = meander(30)
    track = dead_reckon(said)
    beacons = beacons_about(track)
    graph = WalkGraph(said, levels=levels(heard(track, beacons.position), beacons, said))
    values = random_state(graph, np.random.default_rng(1)).to_values()
    assert graph.to_gtsam().error(values) == pytest.approx(graph.error(values))


def test_beacons_alone_place_a_walk():
    """No fix at all: six beacons tell where it was, within some metres, and the covariance says how well."""
    truth = dead_reckon(round_the_block(), start=fixes_at([0.0], [[40.0, -20.0]]), heading=1.0)
    inside = []
    for seed in range(5):
        beacons, said = beacons_about(truth, seed), crooked(truth, seed)
        estimate = smooth(WalkGraph(said, levels=levels(heard(truth, beacons.position, seed), beacons, said)))
        gap = estimate.trajectory.position - truth.position
        assert np.hypot(*gap.T).mean() < 3.5
        square = np.einsum("ni,nij,nj->n", gap, np.linalg.inv(estimate.trajectory.covariance[:, :2, :2]), gap)
        inside.append((square < 4.605).mean())
    assert np.mean(inside) > 0.6


def test_two_entries_of_a_list_that_are_swapped_are_found():
    """Both are heard near the other's place; the others stay where they are."""
    truth = dead_reckon(round_the_block())
    beacons = beacons_about(truth)
    order = np.array([0, 4, 2, 3, 1, 5])
    wrong = replace(beacons, position=beacons.position[order])
    fixes = fixes_at(truth.time[::20], truth.position[::20], 3.0)
    said = crooked(truth)
    estimate = smooth(WalkGraph(said, fixes, levels=levels(heard(truth, beacons.position), wrong, said)))
    moved = {report.label: report for report in estimate.beacons if "moved or swapped" in report.reason}
    assert set(moved) == {"b", "e"}
    assert "place of e" in moved["b"].reason
    assert "place of b" in moved["e"].reason
    for label, own in (("b", 1), ("e", 4)):
        assert (moved[label].x, moved[label].y) == pytest.approx(beacons.position[own], abs=5.0)


@pytest.mark.parametrize("seed", range(5))
def test_beacons_in_their_place_are_left_there(seed):
    truth = dead_reckon(round_the_block())
    beacons, said = beacons_about(truth, seed), crooked(truth, seed)
    fixes = fixes_at(truth.time[::20], truth.position[::20], 3.0)
    estimate = smooth(WalkGraph(said, fixes, levels=levels(heard(truth, beacons.position, seed), beacons, said)))
    assert {report.reason for report in estimate.beacons} == {"heard where it is listed"}


def test_a_beacon_that_nobody_surveyed_is_placed_by_the_walk():
    truth = dead_reckon(round_the_block())
    beacons = beacons_about(truth)
    unknown = replace(beacons, position=np.where(np.arange(6)[:, None] == 2, np.nan, beacons.position))
    fixes = fixes_at(truth.time[::20], truth.position[::20], 1.0)
    said = crooked(truth)
    estimate = smooth(WalkGraph(said, fixes, levels=levels(heard(truth, beacons.position), unknown, said)))
    report = estimate.beacons[2]
    assert report.reason == "its place is learnt"
    assert (report.x, report.y) == pytest.approx(beacons.position[2], abs=4.0)


def test_live_every_level_that_was_heard_is_in_the_graph(monkeypatch):
    """Also those that are due at the very keyframe at which the walk is laid out anew."""
    said, taken, due = round_the_block(120), list[SeenLevel](), LiveBeacons.due
    monkeypatch.setattr(LiveBeacons, "due", lambda *given: (taken.extend(new := due(*given)), new)[1])
    track = dead_reckon(said)
    beacons = beacons_about(track)
    sightings, graph = heard(track, beacons.position), IncrementalGraph()
    graph.survey(beacons)
    for n in range(len(said)):
        own = (sightings.time > (said.time[n - 1] if n else 0.0)) & (sightings.time <= said.time[n])
        names = tuple(sightings.transmitter[m] for m in np.flatnonzero(own))
        graph.hear(Sightings(sightings.time[own], names, sightings.rssi[own]))
        graph.extend(some(said, n, n + 1))
        if n % 20 == 10:
            graph.add_fix(said.time[n], track.position[n + 1], 1.0)
    graph.finish()
    assert graph.beacons is not None
    assert len(taken) > 50
    assert {id(level) for level in graph.beacons.levels.values()} == {id(level) for level in taken}


def test_standing_still_hears_a_beacon_once():
    """A place's reflections stay the same: minutes of levels there are one level."""
    said = round_the_block(8)
    still = replace(said, end=300.0)
    sightings = Sightings(np.linspace(10.0, 290.0, 400), ("a",) * 400, np.full(400, -70.0))
    beacons = beacons_about(dead_reckon(said))
    assert len(levels(sightings, beacons, still)) == 1


def recorded(minor=()):
    return Recording("", 0.0, None, bluetooth=Sightings(np.zeros(2), ("AA:01", "AA:02"), np.zeros(2), minor))


def test_a_list_names_beacons_by_address_or_by_number(tmp_path):
    by_address = tmp_path / "beacons.csv"
    by_address.write_text("beacon,x,y,sigma\naa:02,3.0,4.0,0.5\n")
    found = read_beacons(by_address, recorded())
    assert found.name == ("AA:02",)
    assert found.sigma == pytest.approx([0.5])
    assert found.epsg is None
    by_number = tmp_path / "BLE_Locations.csv"
    by_number.write_text('bleID,Lat,Lon,floor\n"BLE2",49.0,11.0,-2\n"BLE9",49.0,11.1,00\n')
    found = read_beacons(by_number, recorded(minor=("1", "2")))
    assert found.name == ("AA:02", "BLE9")
    assert found.label == ("BLE2", "BLE9")
    assert found.floor == ("-2", "00")
    assert found.position[0] == pytest.approx([11.0, 49.0])
    log = tmp_path / "log.txt"
    log.write_text("")
    assert beside(log) == by_number
    assert beside(tmp_path) is None


def test_a_damaged_list_is_one_clear_line(tmp_path):
    path = tmp_path / "beacons.csv"
    path.write_text("beacon,x,y\na,3.0,north\n")
    with pytest.raises(InputError, match="line 2: found 'north', needed a number"):
        read_beacons(path, recorded())
    path.write_text("beacon,x,y\na,3.0,4.0\na,5.0,6.0\n")
    with pytest.raises(InputError, match="twice"):
        read_beacons(path, recorded())
    path.write_text("beacon,lat,lon\na,93.0,4.0\n")
    with pytest.raises(InputError, match="latitude"):
        read_beacons(path, recorded())
