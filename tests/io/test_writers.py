"""The writers' own formatting of many numbers is Python's, to the byte."""

import numpy as np
import pytest

from pdr_graph.io.writers import LARGEST_OUTPUT, decimals, text_rows, write_tum
from pdr_graph.types import Trajectory

PLACES = (1, 2, 3, 4, 5, 6, 8)
SIZES = (1e-9, 1e-3, 1.0, 40.0, 1e4, 1.7e9, 9e11)  # with Unix times [s]


def by_python(values, places):
    return "".join(f"{value:.{places}f}\n" for value in values.tolist()).encode()


@pytest.mark.parametrize("places", PLACES)
@pytest.mark.parametrize("size", SIZES)
def test_decimals_are_those_of_python(places, size):
    values = np.clip(np.random.default_rng(places).normal(0, size, 5000), -0.99 * LARGEST_OUTPUT, 0.99 * LARGEST_OUTPUT)
    assert text_rows([decimals(values, places)]) == by_python(values, places)


@pytest.mark.parametrize("places", PLACES)
def test_numbers_near_a_half_of_the_last_digit_are_rounded_as_by_python(places):
    """Halves that binary numbers have exactly go to the even digit; the neighbours of the others either way."""
    random = np.random.default_rng(places)
    halves = (random.integers(0, 10**9, 2000) + 0.5) / 10**places
    exact = random.integers(0, 10**6, 2000) / 2 ** random.integers(1, 12, 2000)
    near = [np.nextafter(halves, 0), halves, np.nextafter(halves, np.inf), exact, -halves, -exact]
    values = np.concatenate(near)
    assert text_rows([decimals(values, places)]) == by_python(values, places)


def test_carries_signs_and_what_is_no_number_are_those_of_python():
    values = np.array(
        [0.0, -0.0, 9.99996, 9999.99999, 99999999.99999, -0.99999, -1e-9, np.nan, np.inf, -np.inf, 1e-320]
    )
    assert text_rows([decimals(values, 4)]) == by_python(values, 4)
    assert text_rows([decimals(values[:0], 4)]) == b""


def test_columns_are_joined_by_the_texts_before_them():
    rows = text_rows([decimals(np.array([1.5, -2.25]), 2), decimals(np.array([-3.0, 40.0]), 1, b" 0 0 0 ")])
    assert rows == b"1.50 0 0 0 -3.0\n-2.25 0 0 0 40.0\n"


def test_numbers_too_large_for_a_column_are_refused():
    with pytest.raises(ValueError, match="expected less than"):
        decimals(np.array([1.0, 2 * LARGEST_OUTPUT]), 4)


def test_tum_rows_are_those_of_a_format_string(tmp_path):
    """Unix times and positions of both signs; a heading that is not known is 0."""
    random = np.random.default_rng(1)
    n = 3000
    time, position = np.cumsum(random.uniform(0, 0.1, n)), random.normal(0, 300, (n, 2))
    heading = np.where(random.uniform(size=n) < 0.1, np.nan, random.uniform(-np.pi, np.pi, n))
    write_tum(tmp_path / "track.tum", Trajectory(time, position, heading, ("",) * n), 1.7e9)
    half = np.nan_to_num(heading) / 2
    expected = "".join(
        f"{t + 1.7e9:.6f} {x:.4f} {y:.4f} 0 0 0 {s:.8f} {c:.8f}\n"
        for t, (x, y), s, c in zip(time, position, np.sin(half), np.cos(half), strict=True)
    )
    assert (tmp_path / "track.tum").read_bytes() == expected.encode()
