"""A sensor has one unit, a clock that does not leap and a sufficient range throughout; honest recordings pass."""

import numpy as np
import pytest
from recorders import G, sample

from pdr_graph import InputError
from pdr_graph.io.validation import build_recording

MIDDLE, BURST = slice(1000, None), slice(500, 1000)


@pytest.fixture(scope="module")
def walk():
    """A walk of 40 s at 50 Hz or more."""
    return sample(route=((0.0, 0.0), (40.0, 0.0), (40.0, 20.0)))


def built(walk, time=None, acceleration=None, rate=None):
    time = walk.time if time is None else time
    tables = {
        "accelerometer": np.column_stack([time, walk.acceleration if acceleration is None else acceleration]),
        "gyroscope": np.column_stack([time, walk.angular_rate if rate is None else rate]),
    }
    return build_recording("walk.csv", "walk", tables, None)


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


def test_a_ride_and_a_run_recorded_in_degrees_pass(walk):
    """On a shaking bus a phone turns fifty times slower than in a runner's hand: no change of unit."""
    half, rate = len(walk.time) // 2, np.degrees(walk.angular_rate)
    acceleration = walk.acceleration.copy()
    still = acceleration[:half].mean(axis=0)
    acceleration[:half] = still + 0.5 * (acceleration[:half] - still)
    acceleration[half:] = still + 1.5 * (acceleration[half:] - still)
    typical = np.median(np.linalg.norm(rate, axis=1))
    rate[:half] *= 3 / typical
    rate[half:] *= 170 / typical
    assert built(walk, acceleration=acceleration, rate=rate).gyroscope is not None


def test_a_phone_that_lies_and_is_then_carried_passes(walk):
    acceleration, rate = walk.acceleration.copy(), walk.angular_rate.copy()
    acceleration[BURST], rate[BURST] = [0.0, 0.0, G], 0.001
    assert not built(walk, acceleration=acceleration, rate=rate).notes


def test_a_free_fall_and_a_stop_of_the_sensor_are_no_other_unit(walk):
    acceleration = walk.acceleration.copy()
    acceleration[1000:1030] = 0.01
    assert built(walk, acceleration=acceleration).accelerometer is not None


@pytest.mark.parametrize(("days", "refused"), [(13, False), (15, True), (365 * 300, True)])
def test_a_clock_that_leaps_ahead_by_weeks_is_refused(walk, days, refused):
    time = walk.time.copy()
    time[1000:] += days * 86_400
    if refused:
        with pytest.raises(InputError, match=f"times that leap ahead by {days} days at the sensor's row 1001"):
            built(walk, time=time)
    else:
        assert "1 gaps" in built(walk, time=time).notes[0]


def test_nanoseconds_read_as_a_larger_unit_are_refused(walk):
    with pytest.raises(InputError, match=r"samples per second, expected at most 20000 \(times in another unit"):
        built(walk, time=walk.time / 1000)


def test_milliseconds_read_as_seconds_are_named(walk):
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
