"""Over seeded walks drawn from the model, the normalised error follows its χ² distribution; a wrong model does not."""

import numpy as np
import pytest
from scipy.stats import chi2
from walks import drawn_from_the_model

from pdr_graph import smooth
from pdr_graph.estimation import graph as walk_graph
from pdr_graph.estimation import robust
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.geometry import wrap_angle

SEEDS = 120


def normalised_errors(wrong: float) -> np.ndarray:
    """NEES of the pose at one random row of each walk: independent draws, three degrees of freedom each."""
    nees = []
    for seed in range(SEEDS):
        steps, fixes, truth = drawn_from_the_model(90, seed, wrong=wrong)
        track = smooth(WalkGraph(steps, fixes)).trajectory
        row = np.random.default_rng(seed).integers(0, len(track))
        gap = np.append(truth.position[row] - track.position[row], wrap_angle(truth.heading[row] - track.heading[row]))
        nees.append(gap @ np.linalg.solve(track.covariance[row], gap))
    return np.array(nees)


@pytest.fixture
def gaussian(monkeypatch):
    """Without robust loss, which is not Gaussian."""
    for module in (walk_graph, robust):
        monkeypatch.setattr(module, "HUBER_WIDTH", 1e6)


def interval():
    low, high = chi2.ppf([0.025, 0.975], 3 * SEEDS) / SEEDS
    return low, high


def test_covariance_is_honest(gaussian):
    low, high = interval()
    assert low < normalised_errors(wrong=1.0).mean() < high


def test_a_wrong_model_is_found_out(gaussian):
    """The control: fixes twice as bad as stated."""
    assert normalised_errors(wrong=2.0).mean() > interval()[1]
