"""Rows of trajectory files."""

import numpy as np

from pdr_graph.io.writers import write_tum
from pdr_graph.types import Trajectory


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
