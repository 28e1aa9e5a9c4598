"""Stays and slow passes of a walk, and the places that they face."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from walks import steps_of

from pdr_graph.apps.lifelog.day import STANDING, WALKING, Segment
from pdr_graph.apps.lifelog.stays import stays_of, stays_of_positions
from pdr_graph.floor.building import Building
from pdr_graph.floor.cells import Area
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.frames import Frame
from pdr_graph.gait.step_chunks import append_steps, gap, shifted
from pdr_graph.geometry import dead_reckon
from pdr_graph.types import Fixes, Trajectory

SIGMA, SIGMA_HEADING = 0.3, 0.1  # [m], [rad]
LEFT, RIGHT = np.pi / 2, -np.pi / 2
START = (1.0, 2.0)  # [m] in the middle of the aisle


def aisle(label="1", prefix=""):
    """An aisle of 4 m along x, shops of 8 m to the north and the south."""
    shops = [(f"{prefix}N{n}", shapely.box(8 * n, 4, 8 * n + 8, 9)) for n in range(6)]
    shops += [(f"{prefix}S{n}", shapely.box(8 * n, -5, 8 * n + 8, 0)) for n in range(6)]
    areas = [Area("shop", name, shape) for name, shape in shops]
    return FloorPlan(label, (Area("floor", "", shapely.box(0, -5, 48, 9)), *areas), Frame())


MALL = Building.of(aisle())


def walk(*parts):
    """Steps eastwards from ``(steps, seconds before them)`` parts, of 0.7 m each, or ``(steps, seconds, length)``."""
    count = [part[0] for part in parts]
    steps = steps_of(np.concatenate([np.full(n, *rest[1:] or (0.7,)) for n, *rest in parts]), np.zeros(sum(count)))
    standing = np.zeros(len(steps))
    standing[np.cumsum([0, *count[:-1]])] = [part[1] for part in parts]
    return replace(steps, time=steps.time + np.cumsum(standing), end=steps.end + standing.sum())


def track_of(steps, floor="1"):
    """The trajectory of steps along the aisle."""
    track = dead_reckon(steps, Fixes(np.zeros(1), np.array([START]), np.ones(1), ("",)))
    covariance = np.tile(np.diag([SIGMA**2, SIGMA**2, SIGMA_HEADING**2]), (len(track), 1, 1))
    return replace(track, floor=(floor,) * len(track), covariance=covariance)


def looking(steps, *turns):
    """Turns while standing: 0 except before some steps, ``(step, turn [rad])``."""
    looks = np.zeros(len(steps) + 1)
    for step, turn in turns:
        looks[step] = turn
    return looks


def likeliest(stay):
    return stay.facing[0][0]


def test_a_pause_between_steps_is_a_stay_at_the_position_of_the_walk():
    steps = walk((15, 0), (15, 20.0))
    (stay,) = stays_of(steps, track_of(steps), MALL, looking(steps, (15, LEFT)))
    assert (stay.start, stay.end) == pytest.approx((steps.time[14], steps.time[15] - steps.duration[15]))
    assert stay.end - stay.start == pytest.approx(20.0)
    np.testing.assert_allclose(stay.position, [START[0] + 15 * 0.7, START[1]])
    np.testing.assert_allclose(stay.covariance, SIGMA**2 * np.eye(2))
    assert not stay.passing
    assert stay.heading == pytest.approx(LEFT)
    assert stay.floor == "1"


@pytest.mark.parametrize(("turn", "shop"), [(LEFT, "N1"), (RIGHT, "S1")])
def test_a_stay_is_at_the_shop_on_the_side_of_the_look(turn, shop):
    steps = walk((15, 0), (15, 20.0))
    (stay,) = stays_of(steps, track_of(steps), MALL, looking(steps, (15, turn)))
    assert likeliest(stay) == shop
    assert stay.facing[0][1] > 0.7


def test_the_side_is_less_certain_without_looks():
    steps = walk((15, 0), (15, 20.0))
    (told,), (untold,) = (stays_of(steps, track_of(steps), MALL, looks) for looks in (looking(steps, (15, LEFT)), None))
    assert dict(untold.facing)["N1"] == pytest.approx(dict(untold.facing)["S1"], rel=0.05)
    assert untold.facing[0][1] < told.facing[0][1]


def test_standing_before_the_first_and_after_the_last_step_is_a_stay():
    steps = walk((20, 8.0))
    steps = replace(steps, end=steps.end + 30.0)
    first, last = stays_of(steps, track_of(steps), MALL, looking(steps))
    assert (first.start, last.end) == (steps.start, steps.end)
    np.testing.assert_allclose([first.position, last.position], [START, (START[0] + 14.0, START[1])])


def test_a_short_pause_is_no_stay():
    steps = walk((15, 0), (15, 4.0))
    assert stays_of(steps, track_of(steps), MALL, looking(steps)) == ()


def test_a_few_shuffled_steps_do_not_end_a_stay():
    """Its position is the mean of both halts by duration, and its covariance spans both."""
    steps = walk((15, 0), (2, 20.0, 0.3), (15, 10.0))
    (stay,) = stays_of(steps, track_of(steps), MALL, looking(steps, (15, LEFT)))
    assert stay.end - stay.start == pytest.approx(30.0 + 2 * 0.55)
    np.testing.assert_allclose(stay.position, [START[0] + 15 * 0.7 + 0.6 / 3, START[1]])
    np.testing.assert_allclose(stay.covariance[0, 0], SIGMA**2 + 0.6**2 * 2 / 9)
    assert stay.heading == pytest.approx(LEFT)  # of the longer halt


def test_halts_at_two_shops_are_two_stays():
    steps = walk((15, 0), (6, 20.0), (15, 20.0))
    stays = stays_of(steps, track_of(steps), MALL, looking(steps, (15, LEFT), (21, RIGHT)))
    assert [likeliest(stay) for stay in stays] == ["N1", "S1"]


def test_a_gap_is_no_stay():
    """Ten minutes without a sensor, in which the walker may have gone anywhere."""
    first = walk((20, 0))
    steps = append_steps(
        append_steps(first, gap(first.end, first.end + 600.0)), shifted(walk((20, 0)), first.end + 600.0)
    )
    assert stays_of(steps, track_of(steps), MALL, looking(steps)) == ()


def test_only_a_long_wait_is_a_stay_without_a_plan():
    steps = walk((15, 0), (15, 20.0), (15, 90.0))
    (stay,) = stays_of(steps, track_of(steps), None, looking(steps))
    assert stay.end - stay.start == pytest.approx(90.0)
    assert stay.facing == ()


def test_a_stay_is_at_the_shops_of_its_floor():
    building = Building.of(aisle("1"), replace(aisle("2", "upper "), height=4.0))
    steps = walk((15, 0), (15, 20.0))
    for floor, shop in (("1", "N1"), ("2", "upper N1")):
        (stay,) = stays_of(steps, track_of(steps, floor), building, looking(steps, (15, LEFT)))
        assert (stay.floor, likeliest(stay)) == (floor, shop)


def test_a_slow_pass_is_split_by_front():
    """0.3 m per step from 22 to 38 m, nearer to the north: 2 m past N2, 8 m past N3 and 6 m past N4."""
    steps = walk((30, 0), (53, 0, 0.3), (15, 0))
    track = track_of(steps)
    track = replace(track, position=track.position + np.array([0.0, 1.0]))
    stays = stays_of(steps, track, MALL, looking(steps))
    assert all(stay.passing for stay in stays)
    assert [name for stay in stays if (name := likeliest(stay)) != "N2"] == ["N3", "N4"]
    assert steps.time[29] - 4.0 < stays[0].start  # speed is taken over 4 s
    assert stays[-1].end < steps.time[82] + 4.0
    assert sum(stay.end - stay.start for stay in stays) > 0.7 * 53 * 0.55  # less than 5 s is left out


def test_a_steady_walk_and_steps_before_a_halt_pass_nothing_slowly():
    steps = walk((20, 0), (3, 0, 0.3), (3, 10.0, 0.3), (20, 0))
    assert not any(stay.passing for stay in stays_of(steps, track_of(steps), MALL, looking(steps)))
    slow = walk((60, 0, 0.3))
    assert stays_of(slow, track_of(slow), MALL, looking(slow)) == ()


def test_slow_walking_past_nothing_is_no_pass():
    hall = Area("floor", "", shapely.box(0, 0, 100, 100)), Area("shop", "far", shapely.box(0, 90, 100, 100))
    steps = walk((40, 0), (30, 0, 0.3))
    assert stays_of(steps, track_of(steps), Building.of(FloorPlan("1", hall, Frame())), looking(steps)) == ()


def test_a_stay_by_positions_alone_is_at_the_nearer_front():
    time = np.arange(0.0, 100.0, 1.0)
    way = np.interp(time, [0.0, 20.0, 80.0, 100.0], [1.0, 12.0, 12.0, 24.0])
    place = np.column_stack([way, np.full(100, 3.3)])
    covariance = np.tile(np.diag([0.25, 0.25, 1.0]), (100, 1, 1))
    track = Trajectory(time, place, np.zeros(100), ("1",) * 100, covariance)
    segments = Segment(WALKING, 0.0, 20.0, 11.0), Segment(STANDING, 20.0, 80.0, 0.0), Segment(WALKING, 80.0, 99.0, 12.0)
    (stay,) = stays_of_positions(track, segments, MALL)
    assert (stay.start, stay.end) == (20.0, 80.0)
    assert np.isnan(stay.heading)
    np.testing.assert_allclose(stay.position, [12.0, 3.3])
    assert likeliest(stay) == "N1"
    assert stays_of_positions(track, segments[:1], MALL) == ()


def test_numbers_of_rows_that_do_not_match_are_refused():
    steps = walk((15, 0), (15, 20.0))
    with pytest.raises(ValueError, match="trajectory: found 29 rows, expected 32"):
        stays_of(steps, track_of(walk((27, 0))), MALL)
    with pytest.raises(ValueError, match="looks: found 1, expected 31"):
        stays_of(steps, track_of(steps), MALL, np.zeros(1))
