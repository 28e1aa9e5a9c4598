"""The walks of several days and people in one graph."""

from dataclasses import replace

import numpy as np
import pytest
from observations import NOON, estimated_together, observation, walk

from pdr_graph.apps.lifelog.reconstruct import reconstruct
from pdr_graph.types import Sightings

PHONES = {"ben's": "ben"}


def heard(times, level=-55.0):
    times = np.asarray(times, dtype=float)
    return Sightings(times, ("ben's",) * len(times), np.full(len(times), level))


def side_by_side(seed=3, n=240):
    """Anna, whose phone has fixes, and Ben beside her, whose phone has none; both, and the truth."""
    anna, truth = walk(n, seed)
    anna = replace(anna, bluetooth=heard(np.arange(5.0, anna.duration, 20.0)))
    start = anna.fixes[:1]
    ben = observation(anna.steps, replace(start, time=np.zeros(1), position=truth.position[:1], sigma=np.array([3.0])))
    return anna, ben, truth


def error(day, truth):
    track = day.outings[0].trajectory
    return np.median(np.hypot(*(track.position - truth.position).T))


def test_encounters_locate_a_walk():
    """Ben has a fix at his start and no compass; each encounter is good to a few metres."""
    anna, ben, truth = side_by_side()
    alone = reconstruct("ben", "2023-11-14", {"ben": ben}, None)
    of_anna, of_ben = estimated_together([("anna", anna), ("ben", ben)], PHONES)
    assert error(of_ben, truth) < 0.3 * error(alone, truth)
    assert error(of_ben, truth) < 3.0
    assert error(of_anna, truth) < 2.0


def test_a_day_without_encounters_is_unchanged():
    anna, ben, _ = side_by_side()
    made = estimated_together([("anna", anna), ("ben", ben)], {})
    for day, (name, one) in zip(made, (("anna", anna), ("ben", ben)), strict=True):
        alone = reconstruct(name, "2023-11-14", {name: one}, None)
        assert np.array_equal(day.outings[0].trajectory.position, alone.outings[0].trajectory.position)
        assert (day.profile is None) == (alone.profile is None)


def test_receptions_on_another_day_are_no_encounter():
    anna, ben, _ = side_by_side()
    later = replace(ben, epoch=NOON + 86400)
    made = estimated_together([("anna", anna), ("ben", later)], PHONES)
    alone = reconstruct("ben", "2023-11-14", {"ben": later}, None)
    assert np.array_equal(made[1].outings[0].trajectory.position, alone.outings[0].trajectory.position)


def test_the_order_of_people_does_not_matter():
    """To 30 cm: the segments of calibration begin elsewhere."""
    anna, ben, _ = side_by_side()
    forth = estimated_together([("anna", anna), ("ben", ben)], PHONES)
    back = estimated_together([("ben", ben), ("anna", anna)], PHONES)[::-1]
    for one, other in zip(forth, back, strict=True):
        assert one.outings[0].trajectory.position == pytest.approx(other.outings[0].trajectory.position, abs=0.3)
