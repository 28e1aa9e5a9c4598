"""Delimited text reads back as written, in every dialect."""

import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdr_graph import InputError
from pdr_graph.io.delimited import FOR_ARROW, TextRows, table

NUMBERS = st.one_of(st.just(float("nan")), st.floats(-1e12, 1e12, allow_subnormal=False))


def is_row(numbers):
    """False for a row of empty cells, as spreadsheets leave them: it is skipped."""
    return not all(map(np.isnan, numbers))


TABLES = st.integers(2, 4).flatmap(
    lambda k: st.lists(st.lists(NUMBERS, min_size=k, max_size=k).filter(is_row), min_size=1, max_size=8)
)


@settings(max_examples=300, deadline=None)
@given(
    TABLES,
    st.sampled_from([(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ",")]),
    st.sampled_from(["", '"']),
    st.sampled_from(["", "nan", "NaN"]),
    st.sampled_from(["\n", "\r\n"]),
    st.sampled_from(["{!r}", "{:.17e}"]),
)
def test_any_dialect_reads_back(rows, dialect, quote, empty, end, form):
    """Delimiters, decimal commas, quotes, empty cells, line ends and notations do not change a number."""
    delimiter, decimal = dialect

    def cell(value):
        text = empty if np.isnan(value) else form.format(value).replace(".", decimal)
        return f"{quote}{text}{quote}"

    names = [f"column {k}" for k in range(len(rows[0]))]
    lines = [delimiter.join(f"{quote}{name}{quote}" for name in names)]
    lines += [delimiter.join(map(cell, row)) for row in rows]
    read = table("x.csv", end.join(lines) + end).floats(*names)
    assert read == pytest.approx(np.array(rows), rel=1e-15, nan_ok=True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty file"),
        ("a,b\n1,2\n3,x\n4,5\n", "line 3: found 'x', expected a number"),
        ("a,b\n1,2\n\n3\n4,5\n", "line 4: found 1 fields"),
        ("a,c\n1,2\n", "expected a column b"),
    ],
)
def test_errors_name_the_line(text, message):
    with pytest.raises(InputError, match=message):
        table("x.csv", text).floats("a", "b")


def test_odd_rows_and_columns_lose_no_other_row():
    assert table("x.csv", "a,b\n1,2\n3").floats("a", "b").tolist() == [[1, 2]], "one that was cut off at the end"
    assert np.isnan(table("x.csv", "a,b\n1,2\n").floats("a", optional=("z",))).tolist() == [[False, True]]
    read = table("t.csv", 'time,x,floor\n1,2,"F1\n3,4,F2\n')
    assert read.floats("time", "x").tolist() == [[1, 2], [3, 4]], "an open quote does not swallow the next"
    assert read.rows.words(2) == ["F1", "F2"]


ROW = "1777629600003677440,-0.1,1e-7,4"
ODD = ["nan,1,2,3", "1,,2,3", " 1,2,3,4", "1 ,2,3,4", '"1",2,3,4', "1,2,3", "1,2,3,4,5", "inf,1,2,3", "1e400,1,2,3"]
ODD += ["0x10,1,2,3", "+1,2,3,4", "1_0,2,3,4", "true,1,2,3", "1e5,2,3,4", ".5,1,2,3", "5.,1,2,3", "1,2,3,4\r", ""]


@pytest.mark.parametrize("row", [ROW, *ODD])
def test_pyarrow_reads_what_python_reads_to_the_same_bits_or_nothing(row):
    pytest.importorskip("pyarrow")
    rng = np.random.default_rng(0)
    lines = [",".join(map(repr, rng.normal(0, 1e3, 4).tolist())) for _ in range(50)] + [row, ROW]
    by_arrow = TextRows.of("t.csv", lines, range(1, len(lines) + 1))._floats_by_arrow([0, 2, 3])
    if by_arrow is None:
        assert row in ODD
        return
    by_cell = [[float(line.replace('"', "").split(",")[k]) for k in (0, 2, 3)] for line in lines]
    assert np.array_equal(by_arrow, by_cell, equal_nan=True)


def test_long_tables_are_the_same_with_and_without_pyarrow(monkeypatch):
    text = "time,x\n" + "".join(f"{k / 7!r},{k}\n" for k in range(FOR_ARROW // 10))
    assert len(text) > FOR_ARROW
    with_it = table("t.csv", text).floats("time", "x")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert np.array_equal(with_it, table("t.csv", text).floats("time", "x"))
