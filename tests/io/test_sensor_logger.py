"""What of a Sensor Logger export is read: no more than the walk needs."""

import numpy as np
import pytest
from recorders import in_folder, sample, sensor_logger

from pdr_graph import io
from pdr_graph.errors import InputError


def test_damage_in_tables_that_the_total_acceleration_makes_needless_does_no_harm(tmp_path):
    """Android writes the acceleration three times over: with gravity, without, and gravity alone."""
    felt = sample()
    broken = {name: "time,seconds_elapsed,z,y,x\n1,2,three,4,5\n" for name in ("Accelerometer.csv", "Gravity.csv")}
    walk = io.load(in_folder(tmp_path / "walk", sensor_logger(felt) | broken))
    assert walk.accelerometer is not None
    assert np.linalg.norm(walk.accelerometer.values, axis=1).mean() == pytest.approx(
        np.linalg.norm(felt.acceleration, axis=1).mean(), rel=1e-3
    )


def test_the_same_damage_is_refused_where_they_are_needed(tmp_path):
    files = {name: text for name, text in sensor_logger(sample()).items() if name != "TotalAcceleration.csv"}
    broken = {"Accelerometer.csv": "time,seconds_elapsed,z,y,x\n1,2,three,4,5\n"}
    with pytest.raises(InputError, match="three"):
        io.load(in_folder(tmp_path / "walk", files | broken))
