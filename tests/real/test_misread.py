"""Recordings of others whose rows were misread: units, clocks, columns, encodings, rates.

``scripts/fuzz.py walks FOLDER`` does the same thousands of times.
"""

import random
from collections import Counter

import pytest
from misread_walks import WRONG, misread, misread_walk, walks_in


@pytest.mark.thorough
def test_a_misread_walk_is_refused_in_one_line_or_ok_only_near_the_truth(data, tmp_path):
    """Of 300; a gyroscope with exchanged axes whose phone is held steady is not noticed."""
    walks, outcomes, wrong = walks_in(data / "ms_indoor20"), Counter(), []
    for n in range(300):
        chance = random.Random(n)
        path = chance.choice(list(walks))
        what, content = misread(path.read_bytes(), chance)
        outcome, text = misread_walk(tmp_path / path.name, content, walks[path])
        outcomes[outcome] += 1
        wrong += [f"{n} {path.name}, {what}: {text}"] if outcome in WRONG else []
    assert outcomes["refused"] > 20
    assert outcomes["ok, inside"] > 150
    assert len(wrong) <= 3, wrong
    assert not outcomes["error"], wrong
