"""IPIN21's Eight with its polygons: the building and the start are all that is known of where it was."""

import numpy as np
import pytest

from pdr_graph import FloorPlan, WalkGraph, detect_steps, smooth
from pdr_graph.apps.report.evaluation import circular_error, pair
from pdr_graph.io.loading import load
from pdr_graph.types import Fixes

START_SIGMA = 0.3  # [m] of who stands on a marked place


@pytest.fixture(scope="module")
def eight(data):
    """The plan, the truth in its frame, and the walk as the graph has it: one fix, no heading."""
    folder = data / "ipin21_hcu"
    plan, walk = FloorPlan.load(folder / "map" / "Plan4OG.geojson"), load(folder / "eight")
    truth, steps = plan.frame.place(walk.truth), detect_steps(walk)
    start = Fixes(np.array([steps.start]), truth.position[:1], np.array([START_SIGMA]), ("",))
    return plan, truth, smooth(WalkGraph(steps, start, floor=plan))


def test_half_of_the_steps_are_within_a_metre_and_none_is_in_a_wrong_corridor(eight):
    """Corridors are 3 m wide: one cell all round the eight, and beside it 205 rooms behind walls of 12 cm."""
    plan, truth, estimate = eight
    error, position = circular_error(pair(estimate.trajectory, truth)), estimate.trajectory.position
    assert np.median(error) <= 1.0
    assert error.max() < 3.0
    assert not plan.crosses_wall(position[:-1], position[1:]).any()
    walked = set(plan.cells.at(truth.position).tolist())
    assert {plan.cells.cells[c].kind for c in walked} == {"corridor"}
    assert set(plan.cells.at(position).tolist()) == walked
    assert len(plan.regions) > 200
