"""[calibration-walk] on recordings: step lengths that its tables quote, and templates after the product's detector."""

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from pdr_graph.apps.bench.data_sets import recording_of, walks_of
from pdr_graph.lab.papers import calibration_walk as paper
from pdr_graph.types import STANDARD_GRAVITY


def test_step_lengths_of_ridi_are_those_that_the_table_compares_with(data):
    by_person = {}
    for name, read in walks_of("ridi", data):
        walk = read()
        by_person.setdefault(name.split("_")[0], []).append(walk.length / walk.steps)
    assert [np.mean(lengths) for lengths in by_person.values()] == pytest.approx(paper.RIDI, abs=6e-4)


def weallwalk(data, pattern):
    """Walks of WeAllWalk with the heel strikes until their last sample."""
    for path in sorted(data.glob(f"weallwalk/iPhoneSensors_{pattern}.csv")):
        route, person, _, tool = re.fullmatch(r"iPhoneSensors_(T\d+)_(ID\d+)_(\w\w)_(\w\w)", path.stem).groups()
        rows = np.loadtxt(path, delimiter=",", usecols=(0, 17, 18, 19, 30, 31, 32))
        rows = rows[np.append(True, np.diff(rows[:, 0]) > 0)]
        tree = ElementTree.parse(path.with_name(f"{route}_{person}_{tool}.xml"))
        steps = sum(float(strike.text) <= rows[-1, 0] for strike in tree.iter("Time"))
        recording = recording_of(path.stem, rows[:, 0], -STANDARD_GRAVITY * rows[:, 4:], rows[:, 1:4])
        yield paper.CountedWalk("weallwalk", person, recording, steps)


def test_on_recordings_the_templates_reject_true_steps(data):
    """The product errs less without them; so they are no part of its detector."""
    (row,) = paper.feet_closing(weallwalk(data, "T1_ID1[15]_*_NA")).rows
    product, last, every = (int(re.search(r"\((\d+)\)", cell)[1]) for cell in row[3:])
    assert product <= last < every
