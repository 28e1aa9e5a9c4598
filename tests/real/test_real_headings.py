"""Compasses of real walks, of the whole recording and live, against the surveyors' ways. Landmarks only score."""

from dataclasses import replace

import numpy as np
import pytest
from gait_data import heading_errors, live_headings
from tiers import thorough

from pdr_graph.apps.bench.data_sets import walks_of
from pdr_graph.walk import observe


def walks(data, of, only=""):
    """The walks of a data set with their steps and the headings of the whole recording."""
    walks = [read() for name, read in walks_of(of, data) if only in name]
    return [replace(walk, evidence=observe(walk.evidence)) for walk in walks]


def live_errors(walk):
    """Errors and sigmas of the live headings of a walk [rad]."""
    _, headings = live_headings(walk.evidence)
    return heading_errors(walk, headings), headings.sigma


@pytest.mark.thorough
def test_headings_of_whole_recordings_are_right_or_missing(data):
    """Hand-held walks with truth or GNSS: the walking direction is within three sigmas, 8° in the median."""
    every = [walk for of in ("ipin2023", "nju", "microsoft") for walk in walks(data, of)]
    error = np.concatenate([heading_errors(walk, walk.evidence.headings) for walk in every])
    sigma = np.concatenate([walk.evidence.headings.sigma for walk in every])
    assert len(error) > 20
    assert np.all(np.abs(error) < 3 * sigma)
    assert np.degrees(np.median(np.abs(error))) < 9


@pytest.mark.thorough
@pytest.mark.parametrize("site", ["site1", "site2"])
def test_live_headings_of_a_phone_in_the_hand_are_right_or_missing(data, site):
    """Compasses of these phones err by 17 to 21° (5–95 %) over many more walks: 30° and three sigmas are none's."""
    with_heading = 0
    for walk in walks(data, "microsoft", site):
        error, sigma = live_errors(walk)
        assert np.all(np.abs(error) < np.minimum(np.radians(30), 3 * sigma))
        with_heading += len(error) > 0
    assert with_heading >= 2


OTHERS = [thorough(trial) for trial in ("Trial24", "Trial52")]


@pytest.mark.parametrize("trial", ["Trial01", *OTHERS])
def test_live_headings_in_a_museum_are_right_or_unsure(data, trial):
    """Trial52's stairs mislead what gait says is ahead; offline too."""
    (walk,) = walks(data, "ipin2023", trial)
    error, sigma = live_errors(walk)
    assert len(error) >= 3
    assert np.all(np.abs(error / sigma) < 3)
    assert abs(error[-1]) < np.radians(20)
