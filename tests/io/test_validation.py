"""Checks at the door: what can be mended for certain is mended and noted with numbers, the rest is refused."""

import numpy as np
import pytest
from recorders import G, get_sensor_data, in_folder, phyphox, sample, table, xyz

from pdr_graph import InputError, io
from pdr_graph.io.validation import build_recording


@pytest.fixture(scope="module")
def felt():
    return sample()


def admitted(felt, acceleration=None, time=None, **more):
    time = felt.time if time is None else time
    values = felt.acceleration if acceleration is None else acceleration
    tables = {"accelerometer": np.column_stack([time, values])} | more
    return build_recording("walk.csv", "walk", tables, None)


def said(walk, words):
    assert sum(words in note for note in walk.notes) == 1, walk.notes


@pytest.mark.parametrize(("factor", "words"), [(1 / G, "is g"), (1.0, None)])
def test_units_of_acceleration_are_told_by_gravity(felt, factor, words):
    walk = admitted(felt, felt.acceleration * factor)
    assert walk.accelerometer.values == pytest.approx(felt.acceleration, rel=1e-6, abs=1e-9)
    assert bool(walk.notes) == bool(words)
    if words:
        said(walk, words)


@pytest.mark.parametrize("factor", [100.0, 1000 / G, 0.3])
def test_other_units_are_refused_with_the_number(felt, factor):
    with pytest.raises(InputError, match=r"gravity of \d+\.\d+ .*9\.81 m/s²"):
        admitted(felt, felt.acceleration * factor)


def test_removed_gravity_is_noticed(felt):
    walk = admitted(felt, felt.acceleration - felt.gravity)
    assert walk.accelerometer is None
    assert len(walk.linear_acceleration) == len(felt.time)
    said(walk, "the recorder removed it")


def test_degrees_per_second_are_noticed(felt):
    rates = np.column_stack([felt.time, np.degrees(felt.angular_rate) + 30.0])
    walk = admitted(felt, gyroscope=rates)
    assert walk.gyroscope.values == pytest.approx(felt.angular_rate + np.radians(30.0))
    said(walk, "degrees per second")


@pytest.mark.parametrize(("factor", "unit"), [(100.0, "Pa"), (0.1, "kPa")])
def test_units_of_pressure(felt, factor, unit):
    walk = admitted(felt, barometer=np.column_stack([felt.time, felt.pressure * factor]))
    assert walk.barometer.values[0] == pytest.approx(1013.25)
    said(walk, unit)


def test_repeated_rows_count_once(felt):
    again = np.sort(np.concatenate([np.arange(len(felt.time)), [7, 7, 300]]))
    walk = admitted(felt, felt.acceleration[again], felt.time[again])
    assert walk.accelerometer.time == pytest.approx(felt.time)
    said(walk, "3 repeated rows")


def test_a_clock_coarser_than_the_sensor_is_spread(felt):
    """50 Hz stamped in tenths of a second: five samples share each, and are 20 ms apart again."""
    whole = slice(0, 900)
    walk = admitted(felt, felt.acceleration[whole], np.floor(felt.time[whole] * 10 + 1e-6) / 10)
    assert walk.accelerometer.time == pytest.approx(felt.time[whole], abs=1e-6)
    said(walk, "spread evenly")


def test_a_few_late_rows_are_sorted_and_a_shuffled_file_is_refused(felt):
    order = np.arange(len(felt.time))
    order[[100, 101]] = [101, 100]
    walk = admitted(felt, felt.acceleration[order], felt.time[order])
    assert walk.accelerometer.values == pytest.approx(felt.acceleration)
    said(walk, "1 rows out of order")
    with pytest.raises(InputError, match="shuffled"):
        admitted(felt, felt.acceleration[::-1], felt.time[::-1])


def test_some_missing_values_are_left_out_and_many_refused(felt):
    holes = felt.acceleration.copy()
    holes[::10, 1] = np.nan
    assert len(admitted(felt, holes).accelerometer) == len(felt.time) - len(holes[::10])
    holes[::3] = np.nan
    with pytest.raises(InputError, match="without a value"):
        admitted(felt, holes)


def test_gaps_rates_and_clocks_are_noted(felt):
    gap = felt.time + np.where(felt.time > 10, 4.0, 0.0)
    said(admitted(felt, time=gap), "1 gaps, the longest of 4.02 s after 10.0 s")
    slow = slice(None, None, 5)
    said(admitted(felt, felt.acceleration[slow], felt.time[slow]), "10.0 Hz is too slow")
    late = np.column_stack([felt.time + 3.0, felt.angular_rate])
    said(admitted(felt, gyroscope=late), "begins +3.0 s")
    with pytest.raises(InputError, match=r"begin 1000\.0 s after"):
        admitted(felt, gyroscope=np.column_stack([felt.time + 1000.0, felt.angular_rate]))


FAULTS = {
    "empty": (lambda text: "", None),
    "header only": (lambda text: text.split("\n")[0] + "\n", None),
    "a word": (lambda text: text.replace("9.", "nine.", 1) if "9." in text else text + "x,y,z,w\n", "line"),
    "cut in mid-row": (lambda text: text[: len(text) // 2], ""),
    "CRLF": (lambda text: text.replace("\n", "\r\n"), ""),
    "byte-order mark": (lambda text: "\ufeff" + text, ""),
    "blank lines": (lambda text: text.replace("\n", "\n\n", 5), ""),
    "a line of a megabyte": (lambda text: text + "x" * 1_000_000 + "\n", "line"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_a_table_are_mended_or_refused_in_one_line(tmp_path, felt, fault):
    damage, complaint = FAULTS[fault]
    text = damage(table(xyz("m/s^2", "Acceleration {}"), felt.time, felt.acceleration, form="{:.6f}"))
    folder = in_folder(tmp_path / "walk", phyphox(felt) | {"Accelerometer.csv": text})
    if complaint == "":
        walk = io.load(folder)
        assert len(walk.accelerometer) > 400
        return
    if complaint is None:
        assert io.load(folder).accelerometer is None, "an empty table is a sensor that was not recorded"
        return
    with pytest.raises(InputError, match=complaint) as refusal:
        io.load(folder)
    assert "Accelerometer.csv" in str(refusal.value)
    assert len(str(refusal.value)) < 400


def test_a_log_cut_in_mid_row_loses_that_row_only(tmp_path, felt):
    text = get_sensor_data(felt)
    path = tmp_path / "log.txt"
    path.write_text(text[: text.rindex("GYRO") + 25])
    assert len(io.load(path).gyroscope) == len(felt.time) - 1
