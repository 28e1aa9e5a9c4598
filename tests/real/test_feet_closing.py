"""[calibration-walk] on recordings: step lengths that its tables quote, and templates after the product's detector."""

import re

import numpy as np
import pytest
from gait_data import weallwalk

from pdr_graph.apps.bench.data_sets import walks_of
from pdr_graph.lab.papers import calibration_walk as paper


def test_step_lengths_of_ridi_are_those_that_the_table_compares_with(data):
    by_person = {}
    for name, read in walks_of("ridi", data):
        walk = read()
        by_person.setdefault(name.split("_")[0], []).append(walk.length / walk.steps)
    assert [np.mean(lengths) for lengths in by_person.values()] == pytest.approx(paper.RIDI, abs=6e-4)


def test_on_recordings_the_templates_reject_true_steps(data):
    """The product errs less without them; so they are no part of its detector."""
    (row,) = paper.feet_closing(weallwalk(data, "T1_ID1[15]_*_NA")).rows
    product, last, every = (int(re.search(r"\((\d+)\)", cell)[1]) for cell in row[3:])
    assert product <= last < every
