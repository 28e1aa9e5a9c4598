"""Straight runs along corridors, the turns between them, and both as measurements of a walk."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import shapely
from plans import MAPS, plan
from walks import fixes_at, steps_of

from pdr_graph import FloorPlan
from pdr_graph.estimation.factors.corridors import CorridorFactor, TurnFactor, straight_runs, turns_along
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.optimizer import optimize
from pdr_graph.geometry import wrap_angle

LOOP = FloorPlan.load(MAPS / "loop.geojson")  # corridors of 2.5 m, middles 1.25 m inside
LAP = [[14.85, 1.25], [43.75, 1.25], [43.75, 26.75], [1.25, 26.75], [1.25, 1.25], [14.0, 1.25]]
STRIDE = 0.7


def along(*corners, sway=0.0):
    """Places every stride along a line, swaying to either side with a period of 8 m."""
    line = shapely.LineString(corners)
    at = np.arange(0, line.length, STRIDE)
    way = shapely.get_coordinates(shapely.line_interpolate_point(line, at))
    ahead = np.gradient(way, axis=0)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) / np.hypot(*ahead.T)[:, None]
    return way + sway * np.sin(2 * np.pi * at / 8.0)[:, None] * left


@pytest.mark.parametrize("sway", [0.0, 0.6])
def test_a_lap_is_five_straight_runs(sway):
    """Also with a zigzag between the walls: the direction of a run is that of its corridor."""
    runs = straight_runs(along(*LAP, sway=sway), LOOP.network)
    legs = np.diff(LAP, axis=0)
    directions = np.array([run.direction for run in runs])
    assert np.degrees(wrap_angle(directions - np.arctan2(*legs.T[::-1]))) == pytest.approx(np.zeros(5), abs=0.5)
    assert [run.width for run in runs] == pytest.approx([2.5] * 5, abs=0.12)


def test_a_run_has_the_direction_of_the_walk():
    there, back = (straight_runs(track, LOOP.network)[0] for track in (along(*LAP[:2]), along(*LAP[:2])[::-1]))
    assert abs(wrap_angle(there.direction - back.direction)) == pytest.approx(np.pi)


def test_there_is_no_run_along_a_link_as_wide_as_a_hall_or_without_links():
    hall = [("corridor", shapely.box(-20, -5, 20, 5)), ("link", shapely.LineString([(-20, 0), (20, 0)]))]
    track = along([0.5, 0.0], [19.5, 0.0])
    drawn = plan(*hall, ("intersection", shapely.box(-1, -1, 1, 1))).network
    assert drawn.width == pytest.approx([10, 10])
    assert not straight_runs(track, drawn)
    assert not straight_runs(track, plan(*hall).network)


def test_a_run_of_a_bend_has_the_direction_of_its_part():
    """A round corridor, whose link is a polygon of twenty sides: the runs are short and within 5° of the walk."""
    middle, link = (shapely.boundary(shapely.Point(0, 0).buffer(30, quad_segs=sides)) for sides in (16, 5))
    ends = [("intersection", shapely.box(x - 0.5, -0.5, x + 0.5, 0.5)) for x in (-30, 30)]
    round_ = plan(("corridor", shapely.buffer(middle, 1)), ("link", link), *ends).network
    track = along(*shapely.get_coordinates(middle))
    runs = straight_runs(track, round_)
    assert len(runs) > 10
    for run in runs:
        walked = track[run.last - 1] - track[run.first]
        assert np.hypot(*walked) < 12
        assert abs(wrap_angle(run.direction - np.arctan2(walked[1], walked[0]))) < np.radians(5)


def test_a_run_continues_across_an_intersection_and_past_pillars():
    street, across = shapely.box(0, -1.5, 40, 1.5), shapely.box(19, -20, 22, 20)
    areas = [("corridor", street - across), ("corridor", across - street), ("intersection", street & across)]
    areas += [("wall", shapely.box(x, 1.0, x + 0.4, 1.5)) for x in range(2, 40, 5)]
    areas += [("link", shapely.LineString(line)) for line in ([(0, 0), (40, 0)], [(20.5, -20), (20.5, 20)])]
    turned = plan(*((kind, shapely.affinity.rotate(shape, 25, (0, 0))) for kind, shape in areas))
    track = shapely.get_coordinates(shapely.affinity.rotate(shapely.LineString(along([1, 0], [39, 0])), 25, (0, 0)))
    (run,) = straight_runs(track, turned.network)
    assert np.degrees(run.direction) == pytest.approx(25, abs=1)
    assert run.last - run.first > 0.9 * len(track)


@pytest.mark.parametrize("sway", [0.0, 0.6])
def test_a_lap_turns_at_each_intersection(sway):
    track = along(*LAP, sway=sway)
    found = list(turns_along(track, LOOP.network))
    for turn, corner, leg in zip(found, LAP[1:-1], pairwise(np.diff(LAP, axis=0)), strict=True):
        assert np.hypot(*(turn.corners.mean(axis=0) - corner)) < 0.1
        assert np.hypot(*(track[turn.at] - corner)) < STRIDE + sway
        for way, along_leg in zip((turn.into, turn.out_of), leg, strict=True):
            assert way == pytest.approx(along_leg / np.hypot(*along_leg), abs=0.02)
    assert all(before.last > after.at - 6 for before, after in pairwise(found)), "from corner to corner"


def test_there_is_no_turn_away_from_an_intersection():
    """The same lap with the intersections drawn 9 m beside it."""
    beside = plan(*((area.kind, shapely.affinity.translate(area.shape, 9, 9)) for area in LOOP.areas))
    track = along(*LAP)
    assert not list(turns_along(track, beside.network))
    assert not list(turns_along(track[:1], LOOP.network))


def test_an_intersection_without_corners_has_no_turn():
    """A bend of a plaza: links meet at a node that has no corners."""
    bare = replace(LOOP.network, corners=np.full_like(LOOP.network.corners, np.nan))
    assert not list(turns_along(along(*LAP), bare))


# As measurements


WIDTH = 4.0  # [m]: a walker in the middle of 4 m feels no wall, whose margin is 0.8 m
ASKEW = 0.06  # [rad] by which the walk is laid wrongly: 1.2 m at the end of 20 m, still clear of the walls
ELL = plan(
    ("corridor", shapely.box(-2, -WIDTH / 2, 20 - WIDTH / 2, WIDTH / 2)),
    ("intersection", shapely.box(20 - WIDTH / 2, -WIDTH / 2, 20 + WIDTH / 2, WIDTH / 2)),
    ("corridor", shapely.box(20 - WIDTH / 2, WIDTH / 2, 20 + WIDTH / 2, 24)),
)


def ell_walk(*corridors):
    """Twenty metres east and, after a turn on the spot, twenty north; from a known start."""
    turn = np.zeros(60)
    turn[30] = np.pi / 2
    steps = steps_of(np.full(60, 20 / 30), turn)
    steps = replace(steps, duration=steps.duration / 2, pause_turn=turn)
    return WalkGraph(steps, fixes_at([0.0], [[0.0, 0.0]], 0.3), floor=ELL, prior=Prior(corridors=corridors))


def test_corridors_are_matched_only_on_request():
    graph = ell_walk()
    matched = graph.associated_at(graph.start)
    assert matched.find(CorridorFactor) is matched.find(TurnFactor) is None
    with pytest.raises(ValueError, match="expected 'directions', 'turns'"):
        Prior(corridors=("both",))
    hall, walk = plan(("floor", shapely.box(-2, -2, 22, 24))), ell_walk()
    with pytest.raises(ValueError, match="found a plan without links, expected areas of kind intersection"):
        WalkGraph(walk.steps, walk.fixes, floor=hall, prior=Prior(corridors=("turns",)))


def test_a_straight_run_determines_the_direction_where_walls_are_far():
    wrong = []
    for corridors in ((), ("directions",)):
        graph = ell_walk(*corridors)
        askew = graph.start.rotated(ASKEW, np.zeros(2))
        solved = optimize(graph.associated_at(askew), askew)
        wrong.append(abs(wrap_angle(solved.state.poses[1, 2])))
    assert wrong[1] < wrong[0] / 2


@pytest.mark.parametrize(
    ("corridors", "names"), [("directions", {"corridors"}), ("turns", {"turns.angle", "turns.place"})]
)
def test_matches_are_removed_with_the_plan(corridors, names):
    graph = ell_walk(corridors)
    matched = graph.associated_at(graph.start)
    without = matched.without_plan()
    whole, left = ({b.name for b in version.evaluate(version.start).blocks if len(b)} for version in (matched, without))
    assert whole - left == {"walls"} | names
    assert without.find(CorridorFactor) is without.find(TurnFactor) is None
