"""The aisle of a walk, and its probability."""

from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from walks import fixes_at, steps_of

from pdr_graph import Headings, smooth
from pdr_graph.estimation.ambiguity.bank import paths, probabilities
from pdr_graph.estimation.ambiguity.path_modes import solutions
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.floor.cells import Area
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.frames import Frame
from pdr_graph.priors import SEARCH

WIDTH = 3.0  # [m] of every aisle


def aisles(*ends):
    """Aisles from the origin to each of the ends."""
    shapes = [shapely.LineString([(0, 0), end]).buffer(WIDTH / 2, cap_style="square") for end in ends]
    return FloorPlan("", (Area("corridor", "", shapely.union_all(shapes)),), Frame())


def straight(metres, floor, headings=None):
    """A straight walk from the origin, of which the direction is not known without headings."""
    count = round(metres / 0.7)
    steps = steps_of(np.full(count, 0.7), np.zeros(count))
    return WalkGraph(steps, fixes_at([0.0], [[0.0, 0.0]], 0.5), headings=headings, floor=floor)


def test_two_mirror_images_have_half_the_probability_each():
    """Less what is kept for ways that nobody found, 1 %, and what the chance of the particles leaves of symmetry."""
    estimate = smooth(straight(28, aisles((50, 0), (-50, 0))))
    assert estimate.probability == pytest.approx(0.5, abs=0.05)
    assert any("different walks" in w for w in estimate.warnings)


def test_a_compass_distinguishes_mirror_images():
    headings = Headings(np.array([10.0]), np.array([np.pi]), np.array([0.35]))
    estimate = smooth(straight(28, aisles((50, 0), (-50, 0)), headings))
    assert estimate.probability > 0.9
    assert estimate.trajectory.position[-1, 0] == pytest.approx(-28, abs=2.0)


def test_a_walk_longer_than_one_aisle_is_in_the_other():
    estimate = smooth(straight(42, aisles((60, 0), (0, 20))))
    assert estimate.probability > 0.9
    assert estimate.trajectory.position[-1] == pytest.approx([42, 0], abs=3.0)


def test_a_walk_longer_than_any_aisle_has_a_low_probability():
    """Two aisles of 20 m and a walk of 42 m: plan or step count is incomplete."""
    estimate = smooth(straight(42, aisles((20, 0), (0, 20))))
    assert estimate.probability < 0.5
    assert estimate.warnings


def test_a_repeated_solution_adds_no_probability():
    """Both together are as likely as the one, and what is left is that of a way which nobody found."""
    optima = solutions(straight(28, aisles((50, 0))))[:1]
    once, twice = (probabilities(many, paths(many)) for many in (optima, 2 * optima))
    assert once == pytest.approx(1 / (1 + np.exp(optima[0].surprise - optima[0].unseen)))
    assert once > 0.98
    assert twice == pytest.approx(np.full(2, once[0] / 2))


def test_missed_paths_have_a_probability_only_on_a_plan():
    """Without walls the search starts in all directions, so nothing is missed."""
    optima = solutions(straight(28, None))
    assert probabilities(optima, paths(optima)).sum() == pytest.approx(1.0)
    optima = solutions(straight(28, aisles((50, 0))))
    assert 0 < 1 - probabilities(optima, paths(optima)).sum() < 2 * np.exp(-SEARCH.unseen)


def test_a_walk_that_fits_nothing_at_all_has_a_probability():
    """The live search for a place divides by it: `replay` of a real walk on a plan without a position ended there."""
    optima = [SimpleNamespace(surprise=surprise, unseen=SEARCH.unseen) for surprise in (6e8, 7e8)]
    share = probabilities(optima, np.array([0, 1]))
    assert (share > 0).all()
    assert share.sum() < 1e-9
