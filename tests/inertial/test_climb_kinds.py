"""The kind of a climb, from its height, duration and steps."""

import numpy as np
import pytest

from pdr_graph.inertial.barometer import Climbs, climb_kinds
from pdr_graph.types import Steps


def walk(*times, start=0.0, end=200.0):
    time = np.array(times, dtype=float)
    count = len(time)
    column = np.full(count, 0.5)
    duration = np.minimum(0.5, np.diff(time, prepend=start))
    return Steps(start, end, time, duration, column, 0 * column, 0 * column, column, column)


def climb(height, seconds, start=50.0):
    return Climbs(*(np.array([v]) for v in (start, start + seconds, height, 0.2)))


WALKING = walk(*np.arange(1, 200, 0.5))
STANDING = walk(*np.arange(1, 49, 0.5), *np.arange(150, 190, 0.5))


@pytest.mark.parametrize(
    ("steps", "height", "seconds", "kind"),
    [
        (WALKING, 3.6, 12.0, "stairs"),  # 0.15 m a step
        (WALKING, -3.6, 16.0, "stairs"),
        (WALKING, 3.6, 6.0, "escalator"),  # walked up: 0.30 m a step
        (STANDING, 3.6, 12.0, "escalator"),
        (STANDING, 3.6, 5.0, "lift"),
        (STANDING, -30.0, 18.0, "lift"),
        (WALKING, 3.0, 40.0, "ramp"),  # 6 % at 1.25 m/s
        (WALKING, 3.0, 1.5, "draught"),  # 1 m a step: a door
    ],
)
def test_the_kind_of_a_climb(steps, height, seconds, kind):
    assert climb_kinds(steps, climb(height, seconds)) == (kind,)


def test_a_few_steps_in_a_lift_are_not_stairs():
    assert climb_kinds(walk(*np.arange(1, 51, 0.5), 55), climb(7.0, 8.0)) == ("lift",)


def test_a_climb_without_steps_is_a_lift():
    assert climb_kinds(walk(), climb(7.0, 8.0)) == ("lift",)


def test_no_climbs_have_no_kinds():
    assert climb_kinds(WALKING, Climbs.none()) == ()
