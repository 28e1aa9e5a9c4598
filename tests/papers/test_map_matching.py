"""[map-matching]: links, turns, ranges, feasible regions, and the correction that keeps the shape of the track."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import shapely
from plans import MAPS
from walks import fixes_at, steps_of

from pdr_graph import FloorPlan, dead_reckon
from pdr_graph.floor.cells import Area
from pdr_graph.frames import Frame
from pdr_graph.geometry import wrap_angle
from pdr_graph.lab.papers.map_matching import (
    CalibratedTrack,
    Turn,
    calibrated_tracks,
    centroid,
    correct,
    feasible_pairs,
    feasible_region,
    lattice,
    match,
    method_2,
    range_of_R_d,
    range_of_R_s,
    straightened,
    turning_periods,
)

LOOP = FloorPlan.load(MAPS / "loop.geojson")  # corridors of 2.5 m, middles 1.25 m inside
START = np.array([14.85, 1.25])
EAST, NORTH = np.array([1.0, 0.0]), np.array([0.0, 1.0])
CORNER = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])  # of two corridors of 2 m
LEFT_TURN, RIGHT_TURN = Turn(0, 1, 0, 0, 1, EAST, NORTH), Turn(0, 1, 0, 0, 1, EAST, -NORTH)
LAP = ((43.75, 1.25), (43.75, 26.75), (1.25, 26.75), (1.25, 1.25), (14.0, 1.25))
NO_STEPS = steps_of(np.empty(0), np.empty(0))


@cache
def along(*corners, sway=0.0, stride=0.7):
    """Steps of a walk from corner to corner, swaying by ``sway`` [m], and the position at the end of each."""
    line = shapely.LineString([START, *corners])
    at = np.arange(0, line.length, stride / 20)
    points = shapely.get_coordinates(shapely.line_interpolate_point(line, at))
    ahead = np.gradient(points, axis=0)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) / np.hypot(*ahead.T)[:, None]
    places = (points + sway * np.sin(2 * np.pi * at / 6.3)[:, None] * left)[::20]
    moves = np.diff(places, axis=0)
    turn = np.diff(np.unwrap(np.arctan2(*moves.T[::-1])), prepend=0.0)
    return replace(steps_of(np.hypot(*moves.T), turn), pause_turn=turn), places  # each step turns before it moves


def mismeasured(steps, R_d, R_s):
    """The steps with errors that the calibration (R_d, R_s) corrects."""
    return replace(steps, length=steps.length / R_s, turn=steps.turn / R_d, pause_turn=steps.pause_turn / R_d)


def region_of(steps, R_d, R_s):
    """The feasible region of ranges of R_d and R_s in the loop."""
    d = lattice(*R_d)
    return feasible_region(steps, START, 0.0, d, np.tile(R_s, (len(d), 1)), LOOP.network.walls())


def errors(corrected, places):
    return np.hypot(*(corrected.trajectory.position[:-1] - places).T)


# Links and turns


def test_a_turning_period_is_a_run_of_turns_to_one_side():
    degrees = np.array([0, 5, -6, 20, 30, 5, 25, -4, -3, -15, 15, 0])
    assert turning_periods(steps_of(np.full(12, 0.7), np.radians(degrees))).tolist() == [[3, 7], [9, 10], [10, 11]]
    assert turning_periods(NO_STEPS).tolist() == []


def test_headings_between_turns_are_straightened():
    degrees = np.array([1, 2, 1, 2, 1, 5, 30, 40, 20, -5, 2, 1, 2, 1, 2])
    straight = straightened(steps_of(np.full(15, 0.7), np.radians(degrees)))
    assert np.degrees(straight.turn) == pytest.approx([0, 0, 0, 2, 1, 5, 30, 40, 20, -5, 2, 1, 0, 0, 0])
    assert len(straightened(NO_STEPS)) == 0


def test_each_corner_is_a_turn_and_a_zigzag_is_not():
    steps, places = along(*LAP, sway=0.6)
    matched = match(steps, LOOP.network, START, 0.0)
    assert len(matched.turns) == 4
    for turn, corner in zip(matched.turns, LAP, strict=False):
        assert LOOP.network.nodes[turn.node] == pytest.approx(corner, abs=0.01)
        assert np.hypot(*(places[(turn.first + turn.last) // 2] - corner)) < 2.1, "within three steps"


def test_turning_round_in_a_corridor_is_not_a_turn():
    steps, _ = along((30.0, 1.25), (18.0, 1.25))
    assert match(steps, LOOP.network, START, 0.0).turns == ()


def test_the_projection_lies_on_its_link():
    matched = match(along(*LAP, sway=0.6)[0], LOOP.network, START, 0.0)
    for link, point in zip(matched.link, matched.trajectory.position[1:], strict=False):
        assert shapely.distance(shapely.LineString(LOOP.network.lines[link]), shapely.Point(point)) < 1e-6


# Ranges, Eqs. (6) and (7)


@pytest.mark.parametrize(("turn", "side"), [(LEFT_TURN, 1.0), (RIGHT_TURN, -1.0)], ids=["left", "right"])
def test_the_range_of_R_d_is_that_of_straight_lines_through_the_corner(turn, side):
    """Ten thousand walks of two straight lines inside the walls: none turns less than α or more than β."""
    random = np.random.default_rng(0)
    before, after, angle = 9.0, 14.0, side * np.pi / 2
    low, high = range_of_R_d(turn, CORNER, angle, before, after)
    a = np.stack([np.full(10_000, -1 - before), random.uniform(-1, 1, 10_000)], axis=1)
    b = random.uniform(-1, 1, (10_000, 2)) * (1, side)
    c = np.stack([random.uniform(-1, 1, 10_000), np.full(10_000, side * (1 + after))], axis=1)
    turned = wrap_angle(np.arctan2(*(c - b).T[::-1]) - np.arctan2(*(b - a).T[::-1])) / angle
    assert low == pytest.approx(turned.min(), abs=0.03)
    assert high == pytest.approx(turned.max(), abs=0.03)
    assert low <= turned.min()
    assert turned.max() <= high


def test_the_range_of_R_s_reaches_from_the_nearest_to_the_farthest_corner():
    start, walked = np.array([-21.0, 0.5]), np.array([25.0, -0.2])
    forward, backward = range_of_R_s(LEFT_TURN, CORNER, start, np.stack([walked, -walked]))
    assert forward == pytest.approx((20 / 25, 22 / 25))
    assert np.isnan(backward).all()


# Regions


def test_a_region_has_every_pair_that_stays_within_the_walls():
    """Compared with shapely for each pair; the true pair is in the region."""
    measured = mismeasured(along((43.75, 1.25), (43.75, 12.0))[0], 1.04, 1.1)
    found = region_of(measured, (0.9, 1.2), (1.0, 1.2))
    tracks = calibrated_tracks(measured, START, 0.0, found.R_d, found.R_s)
    for (d, s), feasible in np.ndenumerate(found.feasible):
        assert feasible == shapely.covers(LOOP.network.area, shapely.LineString(tracks[d, s]))
    assert (round(1.04 / 0.005), round(1.1 / 0.005)) in found.pairs


@pytest.mark.parametrize("R_d", [(-1.1, -0.9), (15.0, 20.0), (np.nan, np.nan), (np.inf, np.inf)])
def test_impossible_ranges_have_no_pair(R_d):
    """For a turn estimated to the wrong side or near 0, Eq. (6) gives an impossible R_d."""
    assert not region_of(along((43.0, 1.25))[0], R_d, (0.9, 1.1)).pairs


def test_the_centroid_of_a_bent_region_is_one_of_its_pairs():
    bent = {(200, n) for n in range(200, 221)} | {(n, 200) for n in range(200, 221)}
    R_d, R_s = centroid(bent)
    assert (round(R_d / 0.005), round(R_s / 0.005)) in bent
    assert centroid(set()) is None


def test_method_2_uses_the_intersection_of_regions_and_restarts_if_it_is_empty():
    newest = region_of(along((43.75, 1.25), (43.75, 12.0))[0], (0.9, 1.1), (0.9, 1.1))
    some = set(sorted(newest.pairs)[:5])
    assert method_2(newest, some)[1] == some
    assert method_2(newest, {(1, 1)}) == (centroid(newest.pairs), newest.pairs)
    assert method_2(newest, set())[1] == newest.pairs


# The corrected track


@pytest.mark.parametrize("method", [1, 2])
@pytest.mark.parametrize(("R_d", "R_s"), [(1.0, 1.0), (0.94, 1.12), (1.07, 0.88), (1.05, 1.1)])
def test_a_mismeasured_walk_is_corrected(R_d, R_s, method):
    """A lap with zigzags: the mean error is less than a third of the width of the corridor."""
    steps, places = along(*LAP, sway=0.5)
    corrected = correct(mismeasured(steps, R_d, R_s), LOOP, START, 0.0, method)
    assert len(corrected.stretches) == 4
    assert errors(corrected, places).mean() < 0.8
    inside = corrected.trajectory.position[: corrected.stretches[-1].last]
    assert corrected.notes or not LOOP.crosses_wall(inside[:-1], inside[1:]).any()


def test_the_corrected_track_keeps_its_zigzag_and_the_projection_does_not():
    """Both have the rows of dead reckoning."""
    steps, places = along(*LAP, sway=0.6)
    measured = mismeasured(steps, 1.05, 1.1)
    top = np.flatnonzero((places[:, 1] > 25) & (np.abs(places[:, 0] - 22) < 15))
    side = places[top, 1] - 26.75
    corrected = correct(measured, LOOP, START, 0.0).trajectory
    projected = match(measured, LOOP.network, START, 0.0).trajectory
    assert np.corrcoef(side, corrected.position[top, 1])[0, 1] > 0.8
    assert projected.position[top, 1].std() < 0.01
    reckoned = dead_reckon(steps, fixes_at([0.0], START))
    for track in (corrected, match(steps, LOOP.network, START, 0.0).trajectory):
        assert track.time == pytest.approx(reckoned.time)
        assert wrap_angle(track.heading - reckoned.heading) == pytest.approx(np.zeros(len(track)), abs=0.3)


def test_the_calibration_of_a_turn_holds_until_the_next():
    """A walk that ends before its second turn: the rest is dead reckoning with the calibration of the first."""
    steps, _ = along((43.75, 1.25), (43.75, 20.0))
    corrected = correct(mismeasured(steps, 1.03, 1.15), LOOP, START, 0.0)
    (stretch,) = corrected.stretches
    R_d, R_s = stretch.pair
    expected = dead_reckon(mismeasured(steps, 1.03 / R_d, 1.15 / R_s), fixes_at([0.0], START))
    assert corrected.trajectory.position == pytest.approx(expected.position)


@pytest.mark.parametrize("steps", [along((40.0, 1.25))[0], NO_STEPS], ids=["straight", "no steps"])
def test_without_a_turn_the_track_is_dead_reckoning(steps):
    corrected = correct(steps, LOOP, START, 0.0)
    assert corrected.stretches == match(steps, LOOP.network, START, 0.0).turns == ()
    assert corrected.trajectory.position == pytest.approx(dead_reckon(steps, fixes_at([0.0], START)).position)


def test_walls_are_moved_outwards_where_no_pair_is_feasible_and_that_is_noted():
    """The start heading is 4° off, which no pair corrects; the track still stays within a metre of the corridor."""
    steps, places = along(*LAP)
    corrected = correct(steps, LOOP, START, np.radians(4))
    assert corrected.stretches[0].slack > 0
    assert "moved outwards" in corrected.notes[0]
    assert errors(corrected, places).mean() < 1.2


def test_the_calibration_before_is_kept_where_no_pair_is_feasible():
    """The start is 6 m beside the corridor, in a room: no pair is feasible, and that is noted."""
    corrected = correct(along((43.75, 1.25), (43.75, 20.0))[0], LOOP, START + 6.0 * NORTH, 0.0)
    assert not corrected.stretches[0].region.feasible.any()
    assert corrected.stretches[0].pair == (1.0, 1.0)
    assert ["nearest link" in corrected.notes[0], "was kept" in corrected.notes[1]] == [True, True]


def test_a_corner_without_a_turn_in_the_steps_determines_nothing():
    """The links turn by 90°; steps that turn by 8° do not determine R_d, and the pair before is kept."""
    steps, _ = along((43.75, 1.25), (43.75, 12.0))
    track = CalibratedTrack(START[None], np.zeros(1)).recalibrated(steps, 0, (1.0, 1.0))
    (turn,) = match(steps, LOOP.network, START, 0.0).turns
    straight = replace(steps, turn=0.09 * steps.turn, pause_turn=0.09 * steps.pause_turn)
    found, _ = feasible_pairs(straight, track, None, turn, LOOP.network)
    assert not found.pairs


def test_a_plan_without_a_corridor_raises():
    cupboard = FloorPlan("1", (Area("floor", "", shapely.box(0, 0, 0.5, 0.5)),), Frame())
    with pytest.raises(ValueError, match="found no link"):
        correct(along((30.0, 1.25))[0], cupboard, START, 0.0)
