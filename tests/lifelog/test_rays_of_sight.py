"""Places that a person faces: by distance, side, direction and line of sight, with honest probabilities."""

import numpy as np
import pytest
import shapely
from plans import plan

from pdr_graph.apps.lifelog import stays
from pdr_graph.apps.lifelog.stays import VisiblePlaces
from pdr_graph.geometry import rotation, unit

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


def test_a_near_front_in_the_direction_of_the_heading_is_faced():
    probability = facing(AISLE, (12, 3.3), NORTH)
    assert probability["N1"] > 0.8
    assert probability["N1"] > 10 * probability[""]


def test_the_opposite_heading_faces_the_other_side_less_certainly():
    probability = facing(AISLE, (12, 3.3), SOUTH)
    assert max(probability, key=probability.get) == "S1"
    assert probability["S1"] < facing(AISLE, (12, 3.3), NORTH)["N1"]


def test_the_heading_decides_the_side_in_the_middle_of_the_aisle():
    """Without a heading both sides are equally probable."""
    assert facing(AISLE, (12, 2), NORTH)["N1"] > 5 * facing(AISLE, (12, 2), NORTH)["S1"]
    unknown = facing(AISLE, (12, 2), np.nan)
    assert unknown["N1"] == pytest.approx(unknown["S1"], rel=0.05)  # the fixed places are not the same on both sides


def test_two_fronts_share_the_probability_of_a_position_between_them():
    probability = facing(AISLE, (8, 3.3), NORTH)
    assert probability["N0"] == pytest.approx(probability["N1"], rel=0.1)  # as above


def test_nothing_is_faced_far_from_everything():
    hall = ("floor", "", shapely.box(0, 0, 60, 60)), ("shop", "far", shapely.box(0, 40, 60, 60))
    assert facing(hall, (30, 15), NORTH) == {"": 1.0}


def test_places_behind_a_wall_are_not_faced():
    """A line across the aisle hides the places behind it only."""
    wall = ("wall", "", shapely.LineString([(15.5, 0), (15.5, 4)]))
    kiosk = ("shop", "kiosk", shapely.box(16, 1, 17, 3))
    assert facing((*AISLE, kiosk), (15, 2), EAST)["kiosk"] > 0.7
    assert "kiosk" not in facing((*AISLE, kiosk, wall), (15, 2), EAST, sigma=0.1)


def test_positions_behind_shops_do_not_count():
    """With any uncertainty: shops of 1 m separate the next aisle."""
    plan = ("floor", "", shapely.box(0, 0, 40, 9)), ("shop", "between", shapely.box(0, 4, 40, 5))
    probability = facing((*plan, ("shop", "behind", shapely.box(0, 8.5, 40, 9))), (20, 3), NORTH, sigma=2.0)
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


def test_a_shop_with_two_fronts_is_one_place():
    plan = AISLE[0], *(("shop", "N", shape) for _, _, shape in AISLE[1:4]), *AISLE[4:]
    assert facing(plan, (8, 3.3), NORTH)["N"] == pytest.approx(
        facing(AISLE, (8, 3.3), NORTH)["N0"] + facing(AISLE, (8, 3.3), NORTH)["N1"], abs=1e-9
    )


def test_probabilities_do_not_depend_on_the_orientation_of_the_frame():
    """To 0.02, since the directions of the rays are fixed."""
    place, turn = np.array([9.0, 3.0]), 0.4
    turned = [(kind, name, shapely.transform(shape, lambda xy: xy @ rotation(turn).T)) for kind, name, shape in AISLE]
    one, other = facing(AISLE, place, NORTH + 0.3), facing(turned, rotation(turn) @ place, NORTH + 0.3 + turn)
    for name in one | other:
        assert one.get(name, 0.0) == pytest.approx(other.get(name, 0.0), abs=0.02)


def test_the_correlation_of_position_and_heading_is_used():
    """A walk that may be rotated by 20° to the left would also end farther left, before another shop."""
    independent = np.diag([1.0, 1.0, 0.35**2])
    together = independent.copy()
    together[0, 2] = together[2, 0] = -0.9 * 0.35  # the more to the left they faced, the further west they stand
    plan, place = fronts_of(*AISLE), np.array([9.5, 2.5])
    probability = [dict(plan.facing(place, NORTH, covariance))["N0"] for covariance in (independent, together)]
    assert probability[1] > probability[0] + 0.01


def test_an_unknown_position_faces_nothing():
    assert facing(AISLE, (12, 2), NORTH, sigma=50.0) == {"": 1.0}


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


SIGMA = 2.5  # [m] per axis of a poor estimate, with which much can go wrong


def excess(claimed):
    """Difference of the right answers from the stated probabilities in the worst bin [standard deviations]."""
    random = np.random.default_rng(1)
    poses, names = draws(random, 400, SIGMA)
    plan = fronts_of(*AISLE)
    # `VisiblePlaces` adds by itself that people shuffle, which these here do not
    covariance = np.diag([claimed**2 - stays.SHUFFLE_SIGMA**2, claimed**2 - stays.SHUFFLE_SIGMA**2, 0.04])
    stated = [dict(plan.facing(pose[:2], pose[2], covariance)) for pose in poses]
    probability = [one | {"": 1 - sum(one.values())} for one in stated]
    answers = np.array(
        [(p, answer == name) for one, name in zip(probability, names, strict=True) for answer, p in one.items()]
    )
    which = np.digitize(answers[:, 0], [0.1, 0.3, 0.5, 0.7])
    off = []
    for n in range(5):
        p, right = answers[which == n].T
        off.append((right.sum() - p.sum()) / np.sqrt(np.sum(p * (1 - p))))
    return np.abs(off).max()


def test_stated_probabilities_are_relative_frequencies():
    """For people drawn from the model; not so if the position is stated twice as certain (the control)."""
    assert excess(SIGMA) < 3.3  # of five bins at 99.5 %
    assert excess(SIGMA / 2) > 3.3
