"""Tables of ranges: what is read, and that each error is one line with its place."""

import numpy as np
import pytest

from pdr_graph.errors import InputError
from pdr_graph.io.tables import RANGE_SIGMA, read_ranges
from pdr_graph.types import Beacons, Recording, Signal

TABLE = "time,anchor,range,sigma\n102.5,b,7.5,\n101.0,A,3.25,0.1\n"


@pytest.fixture
def walk():
    """Ten seconds, starting at 100 s on the recorder's clock."""
    return Recording("walk", 100.0, None, accelerometer=Signal(np.arange(10.0), np.zeros((10, 3))))


@pytest.fixture
def anchors():
    """Two anchors."""
    return Beacons(("A", "B"), np.array([[0.0, 0.0], [5.0, 5.0]]), np.array([0.05, 1.0]), ("", ""), ("A", "B"))


def test_rows_are_sorted_and_anchor_names_match_in_any_case(tmp_path, walk, anchors):
    path = tmp_path / "ranges.csv"
    path.write_text(TABLE, encoding="utf-8")
    ranges = read_ranges(path, walk, anchors)
    assert ranges.time.tolist() == [1.0, 2.5]
    assert ranges.anchor.tolist() == [0, 1]
    assert ranges.range.tolist() == [3.25, 7.5]
    assert ranges.sigma.tolist() == [0.1, RANGE_SIGMA]
    assert ranges.position_sigma.tolist() == [0.05, 1.0]


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (TABLE.replace("7.5", "-7.5"), "data row 1, range"),
        (TABLE.replace("7.5", "7500"), "metres"),
        (TABLE.replace("0.1", "0"), "sigma"),
        (TABLE.replace("A,", "C,"), "'C'"),
        (TABLE.replace("7.5", "nan"), "range"),
        (TABLE.replace("102.5", "102500").replace("101.0", "101000"), "milliseconds"),
        ("time,range\n", "line 2"),
    ],
)
def test_errors_are_one_line(tmp_path, walk, anchors, table, message):
    path = tmp_path / "ranges.csv"
    path.write_text(table, encoding="utf-8")
    with pytest.raises(InputError, match=message) as error:
        read_ranges(path, walk, anchors)
    assert "\n" not in str(error.value)
