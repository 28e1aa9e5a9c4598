"""Beacons as ranges, and relocated beacons."""

from dataclasses import replace

import numpy as np
import pytest
from walks import dead_reckon, fixes_at, pushing, steps_of

from pdr_graph.apps.report.evaluation import coverage
from pdr_graph.errors import InputError
from pdr_graph.estimation.factors.beacon_rssi import BeaconRssiFactor, LevelCollector, levels_along
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.estimation.optimizer import optimize
from pdr_graph.estimation.smoother import smooth
from pdr_graph.geometry import interpolate
from pdr_graph.io.tables import beside, read_beacons
from pdr_graph.priors import BEACONS
from pdr_graph.types import Beacons, Recording, Sightings, take

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
    distance = np.sqrt(np.sum((at - place[which]) ** 2, axis=1) + BEACONS.height**2)
    rssi = POWER - 10 * EXPONENT * np.log10(distance) + random.normal(0, NOISE, len(time))
    loud = rssi > WEAKEST
    return Sightings(time[loud], tuple(NAMES[m] for m in which[loud]), rssi[loud])


def crooked(track, seed=0):
    """Steps with errors, whose truth is another walk: turned wrongly at each corner."""
    steps, random = round_the_block(), np.random.default_rng(seed)
    return replace(steps, turn=steps.turn + random.normal(0, 0.03, len(steps)), length=0.9 * steps.length)


def test_beacons_alone_determine_the_position():
    """Without any fix, six beacons give the position within some metres, with a correct covariance."""
    truth = dead_reckon(round_the_block(), start=fixes_at([0.0], [[40.0, -20.0]]), heading=1.0)
    inside = []
    for seed in range(5):
        beacons, steps = beacons_about(truth, seed), crooked(truth, seed)
        estimate = smooth(WalkGraph(steps, levels=levels_along(heard(truth, beacons.position, seed), beacons, steps)))
        assert np.hypot(*(estimate.trajectory.position - truth.position).T).mean() < 3.5
        inside.append(coverage(estimate.trajectory, truth))
    assert np.mean(inside) > 0.6


def walk_among_beacons(seed=0, worse=0.0, listed=lambda place: place, sigma=3.0):
    """The graph of a walk with fixes, of beacons that it heard and their list, and the beacons themselves.

    worse: standard deviation of further errors of the levels [dB].
    """
    truth = dead_reckon(round_the_block())
    beacons, steps = beacons_about(truth, seed), crooked(truth, seed)
    stated = replace(beacons, position=listed(beacons.position))
    levels = levels_along(heard(truth, beacons.position, seed), stated, steps)
    more = np.random.default_rng(seed).normal(0, worse, len(levels))
    fixes = fixes_at(truth.time[::20], truth.position[::20], sigma)
    return WalkGraph(steps, fixes, levels=replace(levels, rssi=levels.rssi + more)), beacons


def test_two_swapped_list_entries_are_detected():
    """Both beacons are received near the other's place; the others keep their positions."""
    graph, beacons = walk_among_beacons(listed=lambda place: place[[0, 4, 2, 3, 1, 5]])
    estimate = smooth(graph)
    moved = {report.label: report for report in estimate.beacons if report.misplaced}
    assert set(moved) == {"b", "e"}
    assert "place of e" in moved["b"].reason
    assert "place of b" in moved["e"].reason
    for label, other_index in (("b", 1), ("e", 4)):
        assert (moved[label].x, moved[label].y) == pytest.approx(beacons.position[other_index], abs=5.0)
    [contradiction] = estimate.contradictions
    assert contradiction.source == "beacons"
    assert contradiction.amount > 0.9
    assert "b and e are swapped" in contradiction.text or "e and b are swapped" in contradiction.text


def test_a_beacon_near_the_walk_that_is_never_received_is_off_and_pushes_nobody_away():
    truth = dead_reckon(round_the_block())
    beacons, steps = beacons_about(truth), crooked(truth)
    sightings = heard(truth, beacons.position)
    sightings = take(sightings, np.array([name != "d" for name in sightings.transmitter]))
    fixes = fixes_at(truth.time[::20], truth.position[::20], 3.0)
    estimate = smooth(WalkGraph(steps, fixes, levels=levels_along(sightings, beacons, steps)))
    assert not estimate.contradictions
    [silent] = [report for report in estimate.beacons if not report.levels]
    assert silent.label == "d"
    assert "never received" in silent.reason
    assert np.hypot(*(estimate.trajectory.position - truth.position).T).mean() < 2.0


def test_a_beacon_that_is_received_is_no_longer_off():
    kind = walk_among_beacons()[0].find(BeaconRssiFactor)
    kind.prior[3, 2] = -60.0
    assert kind.continued(kind.decisions()).prior[3, 2] == 0.0


def test_a_swap_with_a_beacon_that_is_never_received_is_found():
    """The last beacon is far from the walk; in the list, its place is that of one near the walk."""
    truth = dead_reckon(round_the_block())
    beacons, steps = beacons_about(truth), crooked(truth)
    place = np.vstack([beacons.position[:5], beacons.position.mean(axis=0) + 150])
    sightings = heard(truth, place)
    assert "f" not in sightings.transmitter
    listed = replace(beacons, position=place[[0, 1, 2, 3, 5, 4]])
    fixes = fixes_at(truth.time[::20], truth.position[::20], 3.0)
    estimate = smooth(WalkGraph(steps, fixes, levels=levels_along(sightings, listed, steps)))
    assert any("e and f are swapped" in each.text for each in estimate.contradictions)


@pytest.mark.parametrize("seed", range(3))
def test_correctly_listed_beacons_keep_their_positions(seed):
    estimate = smooth(walk_among_beacons(seed)[0])
    assert {report.reason for report in estimate.beacons} == {"not contradicted"}


def test_an_unsurveyed_beacon_is_located_by_the_walk():
    unlisted = np.where(np.arange(6) == 2, np.nan, 0.0)[:, None]
    graph, beacons = walk_among_beacons(listed=lambda place: place + unlisted, sigma=1.0)
    report = smooth(graph).beacons[2]
    assert report.reason == "not listed: its place is estimated"
    assert (report.x, report.y) == pytest.approx(beacons.position[2], abs=4.0)


def test_live_every_received_level_is_in_the_graph(monkeypatch):
    """Also levels that are due at the keyframe at which the batch restarts the walk."""
    steps, calls, due = round_the_block(120), list[float](), LevelCollector.due

    def noted(*arguments):
        for levels in due(*arguments):
            calls.extend(levels.rssi.tolist())
            yield levels

    monkeypatch.setattr(LevelCollector, "due", noted)
    track = dead_reckon(steps)
    beacons = beacons_about(track)
    sightings, live = heard(track, beacons.position), LiveSmoother()
    live.graph.collectors.append(LevelCollector(beacons))
    for n in pushing(live, steps, fixes_at(steps.time[10::20], track.position[11:-1:20], 1.0)):
        if n < len(steps):  # what is heard until the end of the next step
            rows = (sightings.time > steps.time[n - 1] * (n > 1)) & (sightings.time <= steps.time[n])
            live.collect(take(sightings, rows), "bluetooth")
    live.finish()
    [levels] = [kind for kind in live.graph.at.measurements if isinstance(kind, BeaconRssiFactor)]
    assert len(calls) > 50
    assert sorted(levels.listed.rssi.tolist()) == sorted(calls)


def recorded(minor=()):
    return Recording("", 0.0, None, bluetooth=Sightings(np.zeros(2), ("AA:01", "AA:02"), np.zeros(2), minor))


def test_a_list_names_beacons_by_address_or_by_number(tmp_path):
    by_address = tmp_path / "beacons.csv"
    by_address.write_text("beacon,x,y,sigma\naa:02,3.0,4.0,0.5\n")
    beacons = read_beacons(by_address, recorded())
    assert beacons.name == ("AA:02",)
    assert beacons.sigma == pytest.approx([0.5])
    assert beacons.epsg is None
    by_number = tmp_path / "BLE_Locations.csv"
    by_number.write_text('bleID,Lat,Lon,floor\n"BLE2",49.0,11.0,-2\n"BLE9",49.0,11.1,00\n')
    beacons = read_beacons(by_number, recorded(minor=("1", "2")))
    assert beacons.name == ("AA:02", "BLE9")
    assert beacons.label == ("BLE2", "BLE9")
    assert beacons.floor == ("-2", "00")
    assert beacons.position[0] == pytest.approx([11.0, 49.0])
    log = tmp_path / "log.txt"
    log.write_text("")
    assert beside(log) == by_number
    assert beside(tmp_path) is None


@pytest.mark.parametrize(
    ("rows", "complaint"),
    [
        ("beacon,x,y\na,3.0,north\n", "line 2, y: found 'north', expected a number"),
        ("beacon,x,y\na,3.0,4.0\na,5.0,6.0\n", "twice"),
        ("beacon,lat,lon\na,93.0,4.0\n", "latitude"),
    ],
)
def test_a_damaged_list_is_one_clear_line(rows, complaint, tmp_path):
    (tmp_path / "beacons.csv").write_text(rows)
    with pytest.raises(InputError, match=complaint):
        read_beacons(tmp_path / "beacons.csv", recorded())


def test_the_curvature_of_a_level_is_the_convex_part_of_its_second_derivative():
    """By the places of pose and beacon, without the shadowing of the body; differences of the residual."""
    (graph, _), far = walk_among_beacons(), 1e-3
    state = graph.start.replaced(q=np.array([[-60.0, 2.0, 0.0]]))

    def levels(moved):
        [block] = graph.evaluate(moved).blocks_of("beacons")
        return block

    block = levels(state)
    which = np.arange(0, len(block), 7)
    curvature = block.curvature()[which]
    hessian = np.empty((len(which), 4, 4))
    moves = [(symbol, axis) for symbol in "xb" for axis in (0, 1)]
    for i, one in enumerate(moves):
        for j, other in enumerate(moves):
            corners = []
            for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                step = {symbol: np.zeros_like(rows) for symbol, rows in state.arrays.items()}
                step[one[0]][:, one[1]] += a * far
                step[other[0]][:, other[1]] += b * far
                corners.append(levels(state.retracted(step)).residual[which])
            hessian[:, i, j] = (corners[0] - corners[1] - corners[2] + corners[3]) / (4 * far**2)
    value, vector = np.linalg.eigh(hessian * block.residual[which, None, None])
    convex = (vector * np.maximum(value, 0.0)[:, None, :]) @ vector.transpose(0, 2, 1)
    of_places = curvature[:, :, [0, 1, 3, 4]]
    ours = of_places.transpose(0, 2, 1) @ of_places
    assert np.abs(convex).max() > 0.05
    assert ours == pytest.approx(convex, abs=1e-4)
    assert not curvature[:, :, [2, 5, 6, 7, 8]].any()


def test_the_curvature_of_the_levels_shortens_the_search(monkeypatch):
    """With large residuals Gauss–Newton alone leaps over the optimum, and takes twice as many iterations and more."""
    graphs = [walk_among_beacons(seed, worse=8.0)[0] for seed in range(4)]
    found = [optimize(graph, graph.start) for graph in graphs]
    every = BeaconRssiFactor.factors

    def straight(self, at):
        return [replace(block, curvature=None) for block in every(self, at)]

    monkeypatch.setattr(BeaconRssiFactor, "factors", straight)
    without = [optimize(graph, graph.start) for graph in graphs]
    assert max(optimum.iterations for optimum in found) <= 12
    assert 2 * sum(optimum.iterations for optimum in found) < sum(optimum.iterations for optimum in without)
    assert all(ours.cost < other.cost + 0.01 for ours, other in zip(found, without, strict=True))
