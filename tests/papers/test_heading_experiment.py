"""The experiment of [heading]: errors of its methods on phones whose movement is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pdr_graph.geometry import unit
from pdr_graph.lab.papers import heading_experiment
from pdr_graph.lab.papers.heading_experiment import READINGS, errors, rms, without_half_turns
from pdr_graph.types import STANDARD_GRAVITY, Recording, Signal

TIME = np.arange(0.0, 30.0, 1 / heading_experiment.SENSOR_RATE)
CORNER = 15.0, 16.0  # [s]
WALKING = TIME > 5.0


def walked(fore_aft, lateral, turn=np.pi / 2, device=None):
    """A phone that points ahead, with these amplitudes [m/s²] at the step and the stride; its walker turns once.

    device: rotation of the phone from pointing ahead.
    """
    device = Rotation.identity() if device is None else device
    course = 2.0 + turn * np.clip(TIME - CORNER[0], 0, 1)
    ahead, left = unit(course), unit(course + np.pi / 2)
    level = fore_aft * np.sin(4 * np.pi * TIME)[:, None] * ahead + lateral * np.sin(2 * np.pi * TIME)[:, None] * left
    force = np.column_stack([level, STANDARD_GRAVITY + 2 * np.cos(4 * np.pi * TIME)])
    pose = Rotation.from_euler("Z", course[:, None] - np.pi / 2) * device
    rate = np.random.default_rng(0).normal(0, 0.002, (len(TIME), 3))  # one that repeats itself counts as hung
    rate[:, 2] += np.gradient(course, TIME)
    recording = Recording(
        "made",
        clock_origin=0.0,
        epoch=None,
        accelerometer=Signal(TIME, pose.inv().apply(force)),
        gyroscope=Signal(TIME, device.inv().apply(rate)),
    )
    first = int(np.argmax(WALKING))
    return heading_experiment.Trial(
        recording, TIME, course, WALKING, pose[first].inv().apply([*unit(course[first]), 0.0])
    )


def test_fore_and_aft_acceleration_is_the_direction_except_within_a_window_after_a_corner():
    error, time = errors(walked(fore_aft=1.5, lateral=0.3), READINGS["acceleration PCA"]), TIME[WALKING]
    after = (time > CORNER[0]) & (time < CORNER[1] + heading_experiment.PRINCIPAL_WINDOW)
    assert np.abs(error[~after]).max() < 5
    assert np.abs(error[after]).max() > 60  # at the end of the corner most of the window is of before


def test_the_axis_is_across_if_people_sway_more_than_they_brake():
    axis = without_half_turns(errors(walked(fore_aft=0.5, lateral=1.5), READINGS["acceleration PCA"]))
    assert np.median(np.abs(axis)) > 80


@pytest.mark.parametrize("device", [Rotation.identity(), Rotation.from_rotvec([0.3, -0.5, 2.0])])
def test_the_accumulated_rate_is_right_however_the_phone_is_turned(device):
    """The walker turns by 90° and the phone with them; the initial direction is given in axes of the phone."""
    error = errors(walked(fore_aft=1.0, lateral=0.5, device=device), READINGS["angular-rate accumulation"])
    assert error[0] == 0
    assert rms(error) < 3


def test_a_walker_who_turns_back_is_reversed_until_the_end():
    """[heading] Sec. 5.1: the side nearer to the estimate before persists."""
    error, time = errors(walked(fore_aft=1.5, lateral=0.3, turn=np.pi), READINGS["acceleration PCA"]), TIME[WALKING]
    assert np.abs(error[time < CORNER[0]]).max() < 5
    later = error[time > CORNER[1] + heading_experiment.PRINCIPAL_WINDOW]
    assert np.abs(np.abs(later) - 180).max() < 5


def test_half_turns_are_no_error_of_an_axis():
    error = np.array([-179.0, -90.0, -3.0, 0.0, 4.0, 176.0, 359.0])
    np.testing.assert_allclose(without_half_turns(error), [1, -90, -3, 0, 4, -4, -1])


def test_the_holds_take_turns_and_no_two_trials_are_alike():
    trials = [heading_experiment.l_walk(n) for n in (0, 1, 5)]
    assert np.array_equal(
        trials[0].recording.signals["accelerometer"].values,
        heading_experiment.l_walk(0).recording.signals["accelerometer"].values,
    )
    ends = {float(trial.time[-1]) for trial in trials}
    assert len(ends) == 2  # trials 0 and 1 are one walker's with the same luck, in two holds
    for trial in trials:  # west, then north: the walk of Fig. 8
        assert np.degrees(trial.heading[trial.walking][0]) == pytest.approx(180, abs=20)
        assert np.degrees(trial.heading[trial.walking][-1]) == pytest.approx(90, abs=20)


def test_a_swinging_arm_shows_its_direction_as_in_the_paper():
    """Table 1 has 21.3° and 21.7°: no half turn, only the lag after the corner."""
    for method in ("acceleration PCA", "angular-rate PCA"):
        found = [rms(errors(heading_experiment.walk("swinging arm", seed=seed), READINGS[method])) for seed in range(4)]
        assert np.mean(found) < 25


def test_the_tables_are_rectangular_and_have_the_published_figures(monkeypatch, tmp_path):
    """Without real recordings; a few trials."""
    monkeypatch.setattr(heading_experiment, "TRIALS", 5)
    tables = {table.name: table for table in heading_experiment.experiment(quick=True, data=tmp_path)}
    assert all(len(row) == len(table.header) for table in tables.values() for row in table.rows)
    rows = {row[0]: row for row in tables["heading"].rows}
    assert rows["angular-rate accumulation"][4].endswith("(15.0)")
    assert not any("RIDI" in row[0] for row in tables["heading-real"].rows)
