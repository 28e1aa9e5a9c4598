"""Input validation: damage that can be repaired with certainty is repaired and noted with numbers; the rest raises."""

import numpy as np
import pytest
from recorders import G, get_sensor_data, in_folder, phyphox, sample, xyz
from refusals import refused

from pdr_graph import InputError
from pdr_graph.io.loading import load
from pdr_graph.io.validation import build_recording


@pytest.fixture(scope="module")
def sampled():
    return sample()


def validated(sampled, acceleration=None, time=None, **more):
    time = sampled.time if time is None else time
    values = sampled.acceleration if acceleration is None else acceleration
    tables = {"accelerometer": np.column_stack([time, values])} | more
    return build_recording("walk.csv", "walk", tables, None)


def assert_noted(walk, words):
    assert sum(words in note for note in walk.notes) == 1, walk.notes


UNITS = {  # sensor, factor, what is noted
    "is g": ("accelerometer", 1 / G),
    "degrees per second": ("gyroscope", 180 / np.pi),
    "Pa": ("barometer", 100.0),
    "kPa": ("barometer", 0.1),
}


@pytest.mark.parametrize("unit", UNITS)
def test_the_unit_follows_from_the_values(sampled, unit):
    sensor, factor = UNITS[unit]
    true = {"accelerometer": sampled.acceleration, "gyroscope": sampled.angular_rate + 0.5}
    values = true.get(sensor, sampled.pressure[:, None])
    walk = validated(sampled, **{sensor: np.column_stack([sampled.time, values * factor])})
    assert walk.signals[sensor].values == pytest.approx(values, rel=1e-6, abs=1e-9)
    assert_noted(walk, unit)
    assert validated(sampled).notes == ()


@pytest.mark.parametrize("factor", [100.0, 1000 / G, 0.3])
def test_an_unknown_unit_raises_with_the_measured_gravity(sampled, factor):
    with pytest.raises(InputError, match=r"gravity of \d+\.\d+ .*9\.81 m/s²"):
        validated(sampled, sampled.acceleration * factor)


def test_an_axis_of_another_scale_is_recognised(sampled):
    """A phone that states 7.3 m/s² where its long axis stands up; held still like that, the scale is right to 3 %."""
    upright = sampled.acceleration @ np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # z becomes -y
    axis = int(np.argmax(np.abs(upright.mean(axis=0))))
    wrong = upright * np.where(np.arange(3) == axis, 7.3 / G, 1.0)
    walk = validated(sampled, wrong)
    assert np.linalg.norm(walk.accelerometer.values.mean(axis=0)) == pytest.approx(G, rel=0.03)
    assert_noted(walk, "its axes are multiplied by")


def test_removed_gravity_is_recognised(sampled):
    walk = validated(sampled, sampled.acceleration - sampled.gravity)
    assert walk.accelerometer is None
    assert len(walk.linear_acceleration) == len(sampled.time)
    assert_noted(walk, "the recorder removed it")


def test_repeated_rows_are_used_once(sampled):
    again = np.sort(np.concatenate([np.arange(len(sampled.time)), [7, 7, 300]]))
    walk = validated(sampled, sampled.acceleration[again], sampled.time[again])
    assert walk.accelerometer.time == pytest.approx(sampled.time)
    assert_noted(walk, "3 repeated rows")


def test_samples_of_a_clock_coarser_than_the_sensor_are_spread_evenly(sampled):
    """50 Hz with times in tenths of a second: five samples share a time, and are then 20 ms apart again."""
    rows = slice(0, 900)
    walk = validated(sampled, sampled.acceleration[rows], np.floor(sampled.time[rows] * 10 + 1e-6) / 10)
    assert walk.accelerometer.time == pytest.approx(sampled.time[rows], abs=1e-6)
    assert_noted(walk, "spread evenly")


def test_a_few_late_rows_are_sorted_and_a_shuffled_file_raises(sampled):
    order = np.arange(len(sampled.time))
    order[[100, 101]] = [101, 100]
    walk = validated(sampled, sampled.acceleration[order], sampled.time[order])
    assert walk.accelerometer.values == pytest.approx(sampled.acceleration)
    assert_noted(walk, "1 rows out of order")
    with pytest.raises(InputError, match="shuffled"):
        validated(sampled, sampled.acceleration[::-1], sampled.time[::-1])


def test_some_missing_values_are_left_out_and_many_raise(sampled):
    values = sampled.acceleration.copy()
    values[::10, 1] = np.nan
    assert len(validated(sampled, values).accelerometer) == len(sampled.time) - len(values[::10])
    values[::3] = np.nan
    with pytest.raises(InputError, match="without a value"):
        validated(sampled, values)


def test_gaps_rates_and_clocks_are_noted(sampled):
    gap = sampled.time + np.where(sampled.time > 10, 4.0, 0.0)
    assert_noted(validated(sampled, time=gap), "1 gap, the longest of 4.02 s after 10.0 s")
    slow = slice(None, None, 5)
    assert_noted(validated(sampled, sampled.acceleration[slow], sampled.time[slow]), "10.0 Hz is too slow")
    late = np.column_stack([sampled.time + 3.0, sampled.angular_rate])
    assert_noted(validated(sampled, gyroscope=late), "begins +3.0 s")
    with pytest.raises(InputError, match=r"start 1000\.0 s after"):
        validated(sampled, gyroscope=np.column_stack([sampled.time + 1000.0, sampled.angular_rate]))


def test_an_empty_table_is_a_sensor_that_was_not_recorded(tmp_path, sampled):
    header = ",".join(xyz("m/s^2", "Acceleration {}")) + "\n"
    for text in ("", header):
        assert load(in_folder(tmp_path, phyphox(sampled) | {"Accelerometer.csv": text})).accelerometer is None


def test_a_line_of_a_megabyte_is_refused_in_a_short_one(tmp_path, sampled):
    files = phyphox(sampled)
    files["Accelerometer.csv"] = files["Accelerometer.csv"].replace("\n", "\n\n", 5) + "x" * 1_000_000 + "\n"
    message = refused(load, in_folder(tmp_path, files), r"Accelerometer\.csv, line \d+")
    assert len(message) < 400


def test_a_log_cut_in_mid_row_loses_that_row_only(tmp_path, sampled):
    text = get_sensor_data(sampled)
    path = tmp_path / "log.txt"
    path.write_text(text[: text.rindex("GYRO") + 25])
    assert len(load(path).gyroscope) == len(sampled.time) - 1


# One unit, a clock that does not leap and a sufficient range throughout; honest recordings pass


MIDDLE, BURST = slice(1000, None), slice(500, 1000)


@pytest.fixture(scope="module")
def walk():
    """A walk of 40 s at 50 Hz or more."""
    return sample(route=((0.0, 0.0), (40.0, 0.0), (40.0, 20.0)))


def built(walk, time=None, acceleration=None, rate=None):
    """The recording of accelerometer and gyroscope, some columns of which are others."""
    at, rate = walk.time if time is None else time, walk.angular_rate if rate is None else rate
    return validated(walk, acceleration, time, gyroscope=np.column_stack([at, rate]))


def changed(values, factor, rows):
    values = values.copy()
    values[rows] *= factor
    return values


@pytest.mark.parametrize("rows", [MIDDLE, BURST])
@pytest.mark.parametrize("whole", [1.0, 1 / G])
def test_an_acceleration_whose_unit_changes_is_refused_with_the_time(walk, rows, whole):
    """From m/s² to g and back, for good or for some seconds: half of the steps would have the wrong length."""
    values = changed(whole * walk.acceleration, 1 / G if whole == 1 else G, rows)
    at = walk.time[rows][0] - walk.time[0]
    with pytest.raises(InputError, match=r"values in .*one unit throughout") as error:
        built(walk, acceleration=values)
    stated = float(str(error.value).split("from ")[1].split(" s on")[0])
    assert stated == pytest.approx(at, abs=2.1)


@pytest.mark.parametrize("rows", [MIDDLE, BURST])
def test_an_angular_rate_whose_unit_changes_is_refused(walk, rows):
    with pytest.raises(InputError, match=r"gyroscope: found values in rad/s, and from \d+ s on in deg/s"):
        built(walk, rate=changed(walk.angular_rate, 180 / np.pi, rows))


def ride_and_run(acceleration, rate):
    """In deg/s: on a shaking bus a phone turns fifty times slower than in a runner's hand."""
    half, still, typical = len(rate) // 2, acceleration.mean(axis=0), np.median(np.linalg.norm(rate, axis=1))
    for part, shaken, turned in ((slice(half), 0.5, 3), (slice(half, None), 1.5, 170)):
        acceleration[part] = still + shaken * (acceleration[part] - still)
        rate[part] *= turned / typical


def lying(acceleration, rate):
    acceleration[BURST], rate[BURST] = [0.0, 0.0, G], 0.001


def falling(acceleration, rate):
    acceleration[1000:1030] = 0.01


@pytest.mark.parametrize("change", [ride_and_run, lying, falling])
def test_honest_recordings_are_no_change_of_unit(walk, change):
    acceleration, rate = walk.acceleration.copy(), walk.angular_rate.copy()
    change(acceleration, rate)
    recording = built(walk, acceleration=acceleration, rate=rate)
    assert change is not lying or recording.notes == ()
    assert len(recording.gyroscope) == len(recording.accelerometer) == len(rate)


@pytest.mark.parametrize(("days", "refused"), [(13, False), (15, True), (365 * 300, True)])
def test_a_clock_that_leaps_ahead_by_weeks_is_refused(walk, days, refused):
    time = walk.time.copy()
    time[1000:] += days * 86_400
    if refused:
        with pytest.raises(InputError, match=f"times that leap ahead by {days} days at the sensor's row 1001"):
            built(walk, time=time)
    else:
        assert "1 gap," in built(walk, time=time).notes[0]


def test_times_in_another_unit_are_refused_or_named(walk):
    with pytest.raises(InputError, match=r"samples per second, expected at most 20000 \(times in another unit"):
        built(walk, time=walk.time / 1000)
    notes = built(walk, time=1000 * walk.time).notes
    assert sum("milliseconds in a column of seconds?" in note for note in notes) == 2


@pytest.mark.parametrize(("limit", "factor", "sensor"), [(2 * G, 3, "accelerometer"), (4.36, 12, "gyroscope")])
def test_a_saturated_sensor_is_noted_with_its_range(walk, limit, factor, sensor):
    values = walk.acceleration if sensor == "accelerometer" else walk.angular_rate
    middle = values.mean(axis=0)
    livelier = middle + factor * (values - middle)
    which = {"acceleration" if sensor == "accelerometer" else "rate": np.clip(livelier, -limit, limit)}
    noted = [note for note in built(walk, **which).notes if "saturated" in note]
    assert len(noted) == 1
    assert noted[0].startswith(f"{sensor}: ")
    assert f"{limit:.1f}" in noted[0]
    unlimited = {key: livelier for key in which}
    assert not [note for note in built(walk, **unlimited).notes if "saturated" in note]


def test_a_gyroscope_of_noise_is_not_used(sampled):
    noise = np.random.default_rng(0).normal(0, 1.0, sampled.angular_rate.shape)
    walk = validated(sampled, gyroscope=np.column_stack([sampled.time, sampled.angular_rate + noise]))
    assert walk.gyroscope is None
    assert_noted(walk, "% of it is noise")


@pytest.mark.parametrize("pace", [0.5, 0.9, 1.1])
def test_sensors_sampled_together_whose_clocks_run_apart_are_refused(sampled, pace):
    time = sampled.time[0] + pace * (sampled.time - sampled.time[0])
    with pytest.raises(InputError, match="expected sensors on one clock"):
        validated(sampled, gyroscope=np.column_stack([time, sampled.angular_rate]))
