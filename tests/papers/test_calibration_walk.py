"""[calibration-walk]: Lasso, the three coefficients, and walks of twenty steps."""

import numpy as np
import pytest

from pdr_graph.gait.walker import lasso_weights
from pdr_graph.geometry import interpolate, length_along
from pdr_graph.lab.papers import calibration_walk as paper


def test_a_lasso_without_penalty_is_least_squares_and_with_a_large_one_nothing():
    random = np.random.default_rng(0)
    terms = random.normal(2.0, 1.0, (200, 4))
    target = terms @ [1.0, -2.0, 0.0, 0.5] + random.normal(0, 0.1, 200)
    assert paper.lasso(terms, target, 0.0) == pytest.approx(np.linalg.lstsq(terms, target, rcond=None)[0], abs=1e-3)
    assert not paper.lasso(terms, target, 100.0).any()


def test_a_lasso_meets_the_optimality_conditions():
    """The gradient of the squares is ±penalty where a weight is not 0, and less elsewhere."""
    random = np.random.default_rng(1)
    terms, penalty = random.normal(size=(300, 6)), 0.2
    target = terms[:, 0] - 0.5 * terms[:, 1] + random.normal(0, 0.3, 300)
    size = np.sqrt(np.mean(terms**2, axis=0))
    weights = paper.lasso(terms, target, penalty)
    gradient = (terms / size).T @ (target - terms @ weights) / len(target)
    kept = weights != 0
    assert 0 < kept.sum() < 6
    assert gradient[kept] == pytest.approx(penalty * np.sign(weights[kept]), abs=1e-4)
    assert np.all(np.abs(gradient[~kept]) <= penalty)


def on_the_eight(coefficients):
    """A course along the eight, 0.5 m a step, with errors (E_length, E_straight, E_corner), and its true places."""
    along = length_along(paper.EIGHT)
    places = interpolate(np.arange(0, along[-1] + 1e-9, 0.5), along, paper.EIGHT)
    steps = np.diff(places, axis=0)
    heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    length, straight, corner = coefficients
    seen = np.hypot(*steps.T) / (1 + length)
    turn = (np.diff(heading, prepend=0.0) - straight * seen) / (1 + corner)
    return paper.Course(seen, turn, np.arange(len(seen)) * 0.5), places


def test_correction_undoes_the_errors_that_the_three_coefficients_describe():
    course, places = on_the_eight((0.1, 0.004, 0.05))
    assert course.corrected(np.array([0.1, 0.004, 0.05])).track(0.0) == pytest.approx(places, abs=1e-9)


@pytest.mark.parametrize("errors", [(0.1, 0.0, 0.0), (-0.08, 0.004, 0.0), (0.05, -0.003, 0.06)])
def test_gradient_descent_on_the_eight_finds_the_three_coefficients(errors):
    """Errors of the shape that the coefficients have are found, since nothing else is wrong."""
    course, _ = on_the_eight(errors)
    assert paper.fit_to_route(course, paper.EIGHT) == pytest.approx(errors, abs=1e-3)


def test_the_eight_turns_to_both_sides_and_closes():
    legs = np.diff(paper.EIGHT[: len(paper.LAP) + 1], axis=0)
    turns = np.sign(legs[:-1, 0] * legs[1:, 1] - legs[:-1, 1] * legs[1:, 0])
    assert (turns == 1).sum() == (turns == -1).sum() == 3
    assert np.all(paper.EIGHT[len(paper.LAP)] == paper.EIGHT[0])


def test_a_walk_of_twenty_steps_closes_the_feet_with_the_next():
    lengths = paper.twenty(paper.FIRST_SEED, "m", "normal").body.lengths
    assert len(lengths) == 21
    assert 0.3 < lengths[-1] / np.median(lengths) < 0.8


@pytest.mark.thorough
def test_the_weights_of_the_product_are_those_of_the_experiment():
    assert paper.eq7(paper.people(60)) == pytest.approx(lasso_weights(), rel=1e-3)


def test_people_alike_scatter_less_than_simulated_people():
    """By the lengths of their steps over Eq. (6)."""
    people = (
        [paper.alike(seed) for seed in range(12)],
        [paper.PaperWalk.simulated(s, paper._route(paper.HUNDRED_METRES), {}) for s in range(12)],
    )
    alike, usual = (np.std(paper.distance_errors(walks, paper.height_length)) for walks in people)
    assert alike < 0.8 * usual
