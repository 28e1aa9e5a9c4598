"""The data types refuse values that would come out as a silent NaN, and print themselves on one line."""

from dataclasses import replace

import numpy as np
import pytest
from walks import fixes_at, wandering_walk

from pdr_graph.gait.step_chunks import gap, join
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import dead_reckon
from pdr_graph.types import (
    Beacons,
    Calibration,
    Closures,
    Contradiction,
    Estimate,
    Fixes,
    Headings,
    Levels,
    OneLineRepr,
    Ranges,
    Recording,
    Rows,
    Sightings,
    Signal,
    Verdict,
)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"length": np.array([0.7, np.nan, 0.7])}, "Steps.length: found row 1: nan"),
        ({"turn": np.zeros(2)}, "Steps.turn: found 2 rows, expected 3"),
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
        ({"floor": ("1", "2")}, "Fixes.floor: found 2 labels, expected 1"),
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


TIME = np.arange(0, 10, 0.01)
SIGNAL = Signal(TIME, np.zeros((1000, 3)))
FIX = fixes_at([0.0], [[1.0, 2.0]])
TRACK = dead_reckon(wandering_walk(3))
CALIBRATION = Calibration(np.zeros(1), np.array([[1.0, 1.0, 0.0]]), 0.01 * np.eye(3)[None], np.ones((1, 3)))
ESTIMATE = Estimate(TRACK, TRACK, CALIBRATION, {"fixes": (1, 2), "beacons": ()}, 3, 1.0, True)
CONTRADICTION = Contradiction("plan", "fixes", 12.0, "m", "the plan lies 12 m from the fixes", "the plan")
REPRS = [
    (SIGNAL, "Signal(1000 samples, 100 Hz, 0.0 to 10.0 s)"),
    (FIX, "Fixes(1 fix, 0.0 to 0.0 s)"),
    (Fixes.none(), "Fixes(0 fixes)"),
    (Headings([1.0, 2.5], [0.0, 0.0], [1.0, 1.0]), "Headings(2 headings, 1.0 to 2.5 s)"),
    (
        Recording("walk", 0.0, None, accelerometer=SIGNAL, gyroscope=SIGNAL, fixes=FIX),
        "Recording(10 s, accelerometer 100 Hz, gyroscope 100 Hz, 1 fix)",
    ),
    (Recording("walk", 0.0, None), "Recording(empty)"),
    (join([wandering_walk(3), replace(gap(5.0, 6.0), start=5.0)]), None),
    (TRACK, None),
    (Sightings(TIME[:2], ("a", "b"), TIME[:2]), "Sightings(2 receptions, 0.0 to 0.0 s)"),
    (Beacons(("a",), np.zeros((1, 2)), np.ones(1), ("",), ("a",)), "Beacons(1 beacon)"),
    (CALIBRATION, "Calibration(1 segment, last: R_s 1 ± 0.1, R_d 1 ± 0.1, b 0 ± 0.1)"),
    (ESTIMATE, None),
    (CONTRADICTION, "Contradiction(plan against fixes, 12 m, doubtful)"),
    (Verdict.of([CONTRADICTION]), "Verdict(doubtful, 1 reason)"),
    (Walker(), "Walker(height 1.7 m, stride 'inverted pendulum')"),
    (
        Levels(TIME[:1], np.zeros(1, int), TIME[:1], ("a",), np.zeros((1, 2)), np.ones(1)),
        "Levels(1 level, 0.0 to 0.0 s)",
    ),
    (
        Ranges(TIME[:2], np.zeros(2, int), np.ones(2), np.ones(2), ("a",), np.zeros((1, 2)), np.ones(1)),
        "Ranges(2 ranges, 0.0 to 0.0 s)",
    ),
    (Closures.of([(1.0, 2.0, 0.5)]), "Closures(1 closure, 1.0 to 2.0 s)"),
]


@pytest.mark.parametrize(("record", "expected"), REPRS)
def test_the_repr_of_a_data_type_is_one_short_line(record, expected):
    text = repr(record)
    assert "\n" not in text
    assert "array" not in text
    assert text.startswith(f"{type(record).__name__}(")
    assert len(text) < 120
    assert expected is None or text == expected


def test_every_data_type_is_among_these():
    kinds = {*OneLineRepr.__subclasses__(), *Rows.__subclasses__()} - {Rows}
    ours = {kind for kind in kinds if kind.__module__ == "pdr_graph.types"}
    assert ours <= {type(record) for record, _ in REPRS}
