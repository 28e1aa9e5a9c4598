"""Protection levels: distances along and across the walking direction that hold the error with a probability."""

import numpy as np
import pytest
from scipy.stats import t as student
from walks import drawn_from_the_model, fixes_on, square_walk

from pdr_graph import dead_reckon, smooth
from pdr_graph.apps.report.output_files import protection_of
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.geometry import FREEDOM, along_and_across, protection_level, rotation
from pdr_graph.online.interface import Pose


def covariances(heading, along=3.0, across=1.0):
    """Covariances with these sigmas along and across some headings."""
    turned = np.stack([rotation(angle) for angle in heading])
    return turned @ np.diag([along**2, across**2]) @ turned.transpose(0, 2, 1)


def test_sigmas_are_those_along_and_across_the_direction():
    heading = np.linspace(-3.0, 3.0, 13)
    expected = np.tile([3.0, 1.0], (13, 1))
    np.testing.assert_allclose(along_and_across(covariances(heading), heading), expected, atol=1e-9)  # arithmetic
    with_heading = np.tile(np.eye(3), (13, 1, 1))
    with_heading[:, :2, :2] = covariances(heading)
    np.testing.assert_array_equal(
        along_and_across(with_heading, heading), along_and_across(covariances(heading), heading)
    )


@pytest.mark.parametrize("probability", [0.5, 0.95, 0.999])
def test_a_level_holds_errors_of_students_t_as_often_as_it_says(probability):
    heading = np.zeros(1)
    level = protection_level(covariances(heading), heading, probability)[0] / [3.0, 1.0]
    assert level == pytest.approx(student.ppf((1 + probability) / 2, FREEDOM))
    errors = student.rvs(FREEDOM, size=200_000, random_state=0)
    deviation = np.sqrt(probability * (1 - probability) / 200_000)
    assert np.mean(np.abs(errors) <= level[0]) == pytest.approx(probability, abs=4 * deviation)


def test_a_probability_of_one_has_no_level():
    for probability in (0.0, 1.0, 99.9):
        with pytest.raises(ValueError, match="expected a number between 0 and 1"):
            protection_level(np.eye(2)[None], np.zeros(1), probability)


def test_errors_of_walks_drawn_from_the_model_lie_within_the_levels():
    held = []
    for seed in range(20):
        steps, fixes, truth = drawn_from_the_model(60, seed)
        track = smooth(WalkGraph(steps, fixes)).trajectory
        levels = protection_level(track.covariance, track.heading)
        x, y = (track.position - truth.position).T
        cos, sin = np.cos(track.heading), np.sin(track.heading)
        held.append(np.mean(np.abs(np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)) <= levels))
    assert np.mean(held) > 0.95  # the errors are Gaussian, the levels are wider than theirs


def test_a_live_pose_has_its_own_levels():
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = covariances([0.4])[0]
    along, across = Pose(0.0, 0.0, 0.0, 0.4, "", covariance).protection(0.999)
    assert along / across == pytest.approx(3.0)
    assert across == pytest.approx(student.ppf(0.9995, FREEDOM))


def test_a_walk_with_a_position_states_its_median_and_worst_levels():
    steps = square_walk()
    estimate = smooth(WalkGraph(steps, fixes_on(dead_reckon(steps), 10)))
    levels = protection_of(estimate)
    assert list(levels) == ["along_95", "across_95", "along_999", "across_999"]
    assert all(0 < value["median"] <= value["worst"] for value in levels.values())
    ratio = student.ppf(0.9995, FREEDOM) / student.ppf(0.975, FREEDOM)
    assert levels["along_999"]["worst"] / levels["along_95"]["worst"] == pytest.approx(ratio, rel=0.02)  # two decimals
    assert protection_of(smooth(WalkGraph(square_walk()))) is None
