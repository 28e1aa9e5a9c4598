"""Steps on stairs are as long as the treads."""

import numpy as np
import pytest
from walks import PERIOD, steps_of

from pdr_graph.inertial.barometer import Climbs, with_stair_lengths


def climbed(height, kind):
    """Forty steps of 0.6 m, twenty of them during a climb."""
    steps = steps_of(np.full(40, 0.6), np.zeros(40))
    start, end = np.array([10 * PERIOD]), np.array([30 * PERIOD])
    return steps, with_stair_lengths(steps, Climbs(start, end, np.array([height]), np.array([0.3])), (kind,))


def test_stairs_of_17_cm_have_goings_of_29_cm():
    """Blondel's rule, 63 cm = 2 rises + going; the steps before and after do not change."""
    steps, found = climbed(20 * 0.17, "stairs")
    on = found.length != steps.length
    assert found.length[on] == pytest.approx(0.63 - 2 * 0.17, abs=0.02)
    assert np.flatnonzero(on)[[0, -1]] == pytest.approx([10, 30], abs=1)


def test_steps_down_are_as_long_as_steps_up():
    assert climbed(-3.0, "stairs")[1].length == pytest.approx(climbed(3.0, "stairs")[1].length)


@pytest.mark.parametrize("kind", ["lift", "escalator", "ramp", "draught"])
def test_steps_elsewhere_do_not_change(kind):
    steps, found = climbed(3.4, kind)
    assert found.length == pytest.approx(steps.length)
