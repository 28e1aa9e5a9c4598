"""Stays and slow passes of a walk, and the places that they face."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from plans import plan
from walks import steps_of

from pdr_graph.apps.lifelog import stays
from pdr_graph.apps.lifelog.day import STANDING, WALKING, Segment
from pdr_graph.apps.lifelog.stays import VisiblePlaces, stays_of, stays_of_positions
from pdr_graph.floor.building import Building
from pdr_graph.floor.cells import Area
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.frames import Frame
from pdr_graph.gait.step_chunks import append_steps, gap, shifted
from pdr_graph.geometry import dead_reckon, unit
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
def test_a_stay_is_at_the_shop_on_the_side_of_the_look_and_less_certain_without_looks(turn, shop):
    steps = walk((15, 0), (15, 20.0))
    looks = looking(steps, (15, turn))
    (told,), (untold,) = (stays_of(steps, track_of(steps), MALL, each) for each in (looks, None))
    assert told.facing[0] == (shop, pytest.approx(0.85, abs=0.15))
    assert dict(untold.facing)["N1"] == pytest.approx(dict(untold.facing)["S1"], rel=0.05)
    assert untold.facing[0][1] < told.facing[0][1]


def test_standing_before_the_first_and_after_the_last_step_is_a_stay():
    steps = walk((20, 8.0))
    steps = replace(steps, end=steps.end + 30.0)
    first, last = stays_of(steps, track_of(steps), MALL, looking(steps))
    assert (first.start, last.end) == (steps.start, steps.end)
    np.testing.assert_allclose([first.position, last.position], [START, (START[0] + 14.0, START[1])])


def after_a_gap(seconds):
    """A walk, seconds without a sensor, in which the walker may have gone anywhere, and another one."""
    first = walk((20, 0))
    return append_steps(append_steps(first, gap(first.end, first.end + seconds)), shifted(first, first.end + seconds))


HALL = Area("floor", "", shapely.box(0, 0, 100, 100)), Area("shop", "far", shapely.box(0, 90, 100, 100))


@pytest.mark.parametrize(
    ("steps", "building"),
    [
        (walk((15, 0), (15, 4.0)), MALL),
        (after_a_gap(600.0), MALL),
        (walk((60, 0, 0.3)), MALL),
        (walk((40, 0), (30, 0, 0.3)), Building.of(FloorPlan("1", HALL, Frame()))),
    ],
    ids=["a short pause", "a gap", "steady slow walking", "slow walking past nothing"],
)
def test_nothing_is_a_stay_or_a_slow_pass(steps, building):
    assert stays_of(steps, track_of(steps), building, looking(steps)) == ()


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


def test_slow_steps_before_a_halt_pass_nothing_slowly():
    steps = walk((20, 0), (3, 0, 0.3), (3, 10.0, 0.3), (20, 0))
    assert not any(stay.passing for stay in stays_of(steps, track_of(steps), MALL, looking(steps)))


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


# Places that a person faces: by distance, side, direction and line of sight, with honest probabilities

NORTH, EAST, SOUTH = np.pi / 2, 0.0, -np.pi / 2
AISLE = (  # of 4 m along x, shops of 8 m on either side
    ("floor", "", shapely.box(0, -6, 24, 10)),
    *(("shop", f"N{n}", shapely.box(8 * n, 4, 8 * n + 8, 10)) for n in range(3)),
    *(("shop", f"S{n}", shapely.box(8 * n, -6, 8 * n + 8, 0)) for n in range(3)),
)


def fronts_of(*areas):
    return VisiblePlaces.of(plan(*areas))


def facing(plan, place, heading, sigma=0.3, sigma_heading=0.1):
    """Probabilities of the places faced from a position, by name; "" for none."""
    covariance = np.diag([sigma**2, sigma**2, sigma_heading**2])
    probability = dict(fronts_of(*plan).facing(np.array(place, float), heading, covariance))
    assert all(0 < p <= 1 for p in probability.values())
    return {"": 1 - sum(probability.values())} | probability


def test_the_heading_decides_which_front_is_faced():
    near = facing(AISLE, (12, 3.3), NORTH)
    assert near["N1"] > max(0.8, 10 * near[""])
    opposite = facing(AISLE, (12, 3.3), SOUTH)
    assert max(opposite, key=opposite.get) == "S1"
    assert opposite["S1"] < near["N1"], "of the farther side less certainly"
    middle, unknown = facing(AISLE, (12, 2), NORTH), facing(AISLE, (12, 2), np.nan)
    assert middle["N1"] > 5 * middle["S1"]
    assert unknown["N1"] == pytest.approx(unknown["S1"], rel=0.05)  # the fixed places are not the same on both sides


def test_two_fronts_share_the_probability_of_a_position_between_them():
    """Of one shop they are one place."""
    two = facing(AISLE, (8, 3.3), NORTH)
    assert two["N0"] == pytest.approx(two["N1"], rel=0.1)  # as above
    one = AISLE[0], *(("shop", "N", shape) for _, _, shape in AISLE[1:4]), *AISLE[4:]
    assert facing(one, (8, 3.3), NORTH)["N"] == pytest.approx(two["N0"] + two["N1"], abs=1e-9)


def test_nothing_is_faced_far_from_everything_or_from_an_unknown_position():
    hall = ("floor", "", shapely.box(0, 0, 60, 60)), ("shop", "far", shapely.box(0, 40, 60, 60))
    assert facing(hall, (30, 15), NORTH) == {"": 1.0}
    assert facing(AISLE, (12, 2), NORTH, sigma=50.0) == {"": 1.0}


def test_places_behind_a_wall_or_a_shop_are_not_faced():
    """A line across the aisle hides the places behind it only; shops of 1 m separate the next aisle."""
    wall = ("wall", "", shapely.LineString([(15.5, 0), (15.5, 4)]))
    kiosk = ("shop", "kiosk", shapely.box(16, 1, 17, 3))
    assert facing((*AISLE, kiosk), (15, 2), EAST)["kiosk"] > 0.7
    assert "kiosk" not in facing((*AISLE, kiosk, wall), (15, 2), EAST, sigma=0.1)
    aisles = ("floor", "", shapely.box(0, 0, 40, 9)), ("shop", "between", shapely.box(0, 4, 40, 5))
    probability = facing((*aisles, ("shop", "behind", shapely.box(0, 8.5, 40, 9))), (20, 3), NORTH, sigma=2.0)
    assert "between" in probability
    assert "behind" not in probability


def test_a_position_inside_a_shop_is_moved_in_front_of_it():
    assert facing(AISLE, (12, 4.6), NORTH)["N1"] > 0.8


def test_a_stand_drawn_as_a_point_is_faced_from_all_sides():
    plan = ("floor", "", shapely.box(0, 0, 20, 20)), ("place", "stand", shapely.Point(10, 10))
    probability = [facing(plan, 10 + 1.2 * unit(angle), angle + np.pi)["stand"] for angle in np.arange(0, 6, 0.7)]
    assert min(probability) > 0.75
    assert np.ptp(probability) < 0.05  # rays are 15° apart
    away = facing(plan, (11.2, 10), EAST)["stand"]
    assert away / (1 - away) < probability[0] / (1 - probability[0]) / 4


def test_a_person_in_a_room_is_at_the_room_with_any_heading():
    plan = (
        ("corridor", "", shapely.box(0, 0, 20, 2)),
        ("room", "library", shapely.box(0, 2, 10, 8)),
        ("room", "", shapely.box(10, 2, 20, 8)),
        ("door", "", shapely.box(4, 1.9, 5, 2.1)),
        ("door", "", shapely.box(14, 1.9, 15, 2.1)),
    )
    assert facing(plan, (5, 5), SOUTH)["library"] == pytest.approx(1.0)
    assert "library" not in facing(plan, (15, 5), NORTH)
    assert "library" not in facing(plan, (15, 1), NORTH, sigma=0.1)
    at_the_door = facing(plan, (4.5, 2), NORTH, sigma=0.5)["library"]
    assert 0.3 < at_the_door < 0.7  # half of the places lie on either side


def test_the_correlation_of_position_and_heading_is_used():
    """A walk that may be rotated by 20° to the left would also end farther left, before another shop."""
    independent = np.diag([1.0, 1.0, 0.35**2])
    together = independent.copy()
    together[0, 2] = together[2, 0] = -0.9 * 0.35  # the more to the left they faced, the further west they stand
    plan, place = fronts_of(*AISLE), np.array([9.5, 2.5])
    probability = [dict(plan.facing(place, NORTH, covariance))["N0"] for covariance in (independent, together)]
    assert probability[1] > probability[0] + 0.01


def draws(random, count, sigma):
    """People who stopped, drawn as the module describes, with shapely alone.

    They stand anywhere in the aisle with any heading, for nothing or for the first thing that a look meets nearby.
    Returns measured poses ``(n, 3)`` and what they looked at.
    """
    solid = [(name, shape) for kind, name, shape in AISLE if kind == "shop"]
    poses, names = [], []
    while len(poses) < count:
        pose = random.uniform([0, 0, -np.pi], [24, 4, np.pi])
        name = ""
        if random.random() > stays.UNNAMED_RATE / (1 + stays.UNNAMED_RATE):
            askew = random.random() < stays.RANDOM_LOOK_SHARE
            look = random.uniform(-np.pi, np.pi) if askew else pose[2] + random.normal(0, stays.LOOK_SIGMA)
            ray = shapely.LineString([pose[:2], pose[:2] + stays.MAX_DISTANCE * unit(look)])
            met = [(shapely.distance(shapely.Point(pose[:2]), shapely.intersection(ray, s)), n) for n, s in solid]
            distance, name = min((d, n) for d, n in [*met, (np.inf, "")] if not np.isnan(d))
            if random.random() > np.exp(-max(distance - stays.NEAR_DISTANCE, 0.0) / stays.DECAY_DISTANCE):
                continue
        poses.append(pose + random.normal(0, [sigma, sigma, 0.2]))
        names.append(name)
    return np.array(poses), names


POOR_SIGMA = 2.5  # [m] per axis of a poor estimate, with which much can go wrong


def excess(claimed):
    """Difference of the right answers from the stated probabilities in the worst bin [standard deviations]."""
    random = np.random.default_rng(1)
    poses, names = draws(random, 400, POOR_SIGMA)
    plan = fronts_of(*AISLE)
    # `VisiblePlaces` adds by itself that people shuffle, which these here do not
    covariance = np.diag([claimed**2 - stays.SHUFFLE_SIGMA**2, claimed**2 - stays.SHUFFLE_SIGMA**2, 0.04])
    stated = [dict(plan.facing(pose[:2], pose[2], covariance)) for pose in poses]
    answers = np.array(
        [
            (p, answer == name)
            for one, name in zip(stated, names, strict=True)
            for answer, p in (one | {"": 1 - sum(one.values())}).items()
        ]
    )
    which = np.digitize(answers[:, 0], [0.1, 0.3, 0.5, 0.7])
    bins = [answers[which == n].T for n in range(5)]
    return max(abs(right.sum() - p.sum()) / np.sqrt(np.sum(p * (1 - p))) for p, right in bins)


def test_stated_probabilities_are_relative_frequencies():
    """For people drawn from the model; not so if the position is stated twice as certain (the control)."""
    assert excess(POOR_SIGMA) < 3.3  # of five bins at 99.5 %
    assert excess(POOR_SIGMA / 2) > 3.3
