"""Tables of a Sensor Logger export that the walk does not use are not read."""

import numpy as np
import pytest
from recorders import in_folder, sample, sensor_logger

from pdr_graph.errors import InputError
from pdr_graph.io.loading import load


def test_damage_in_unused_tables_has_no_effect_if_there_is_the_total_acceleration(tmp_path):
    """Android writes the acceleration three times: with gravity, without, and gravity alone."""
    sampled = sample()
    broken = {name: "time,seconds_elapsed,z,y,x\n1,2,three,4,5\n" for name in ("Accelerometer.csv", "Gravity.csv")}
    walk = load(in_folder(tmp_path / "walk", sensor_logger(sampled) | broken))
    assert walk.accelerometer is not None
    assert np.linalg.norm(walk.accelerometer.values, axis=1).mean() == pytest.approx(
        np.linalg.norm(sampled.acceleration, axis=1).mean(), rel=1e-3
    )


def test_the_same_damage_raises_where_the_tables_are_used(tmp_path):
    files = {name: text for name, text in sensor_logger(sample()).items() if name != "TotalAcceleration.csv"}
    broken = {"Accelerometer.csv": "time,seconds_elapsed,z,y,x\n1,2,three,4,5\n"}
    with pytest.raises(InputError, match="three"):
        load(in_folder(tmp_path / "walk", files | broken))
