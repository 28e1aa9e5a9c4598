"""What the nouns refuse: a NaN that got in would come out as a silent NaN."""

from dataclasses import replace

import numpy as np
import pytest
from walks import fixes_at, wandering_walk


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"length": np.array([0.7, np.nan, 0.7])}, "Steps.length: found row 1: nan"),
        ({"turn": np.zeros(2)}, "Steps.turn: found 2 rows, needed 3"),
        ({"time": np.array([1.0, 0.5, 2.0])}, "time, row 1: found 0.5"),
        ({"time": np.array([0.55, 0.55, 1.1])}, "time, row 1"),
        ({"end": 0.1}, "time, row 0"),
        ({"end": -1.0}, "start < end"),
        ({"duration": np.array([0.5, 3.0, 0.5])}, "duration, row 1: found 3.0"),
        ({"sigma_turn": np.zeros(3)}, "sigma_turn, row 0: found 0.0"),
    ],
)
def test_steps_that_cannot_be_are_refused(change, complaint):
    with pytest.raises(ValueError, match=complaint):
        replace(wandering_walk(3), **change)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"position": np.array([[np.inf, 0.0]])}, "Fixes.position: found row 0"),
        ({"sigma": np.array([-1.0])}, "sigma, row 0: found -1.0"),
        ({"floor": ("1", "2")}, "Fixes.floor: found 2 labels, needed 1"),
    ],
)
def test_fixes_that_cannot_be_are_refused(change, complaint):
    with pytest.raises(ValueError, match=complaint):
        replace(fixes_at([0.0], [[1.0, 2.0]]), **change)


def test_fixes_are_selected_like_arrays():
    fixes = fixes_at([0.0, 1.0, 2.0], np.arange(6.0).reshape(3, 2))
    assert fixes[1].position.tolist() == [[2.0, 3.0]]
    assert len(fixes[-1]) == 1
    assert fixes[fixes.time > 0.5].time.tolist() == [1.0, 2.0]
    assert len(fixes[:0]) == 0
