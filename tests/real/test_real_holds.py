"""The methods of [heading] with real phones, whose directions are known."""

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pdr_graph.gait.steps import gait_signals
from pdr_graph.geometry import as_complex
from pdr_graph.lab.papers.heading_experiment import READINGS, SENSOR_RATE, errors, real_trials, rms


def fore_aft_by_lateral(trial):
    """Ratio of the accelerations ahead and aside on straight parts, without what is slower than a stride."""
    gait = gait_signals(trial.recording)[0]
    attitude, heading = gait.attitude, gait.direction.heading
    evaluated = np.interp(attitude.time, trial.time, trial.walking) > 0.5
    first = int(np.argmax(evaluated))
    x, y, _ = attitude.R_world_device[first].apply(trial.ahead)
    turning = np.abs(gaussian_filter1d(np.gradient(heading, attitude.period), 0.5 * SENSOR_RATE))
    level = as_complex(attitude.R_world_device.apply(attitude.acceleration))
    level *= np.exp(-1j * (heading - heading[first] + np.arctan2(y, x)))
    axes = np.column_stack([level.real, level.imag])
    axes = (axes - gaussian_filter1d(axes, 1.3 * SENSOR_RATE, axis=0))[evaluated]
    ahead, aside = axes[turning[evaluated] < np.radians(15)].std(axis=0)
    return ahead / aside


def test_real_hands_show_turns_but_not_always_the_axis(data):
    """By the accumulated rate they are on average as accurate as the paper in the hand; by acceleration few are."""
    hands = [trial for name, trials in real_trials(data).items() if name.endswith("hand") for trial in trials]
    by_rate, by_acceleration = (
        np.array([rms(errors(trial, READINGS[method])) for trial in hands])
        for method in ("angular-rate accumulation", "acceleration PCA")
    )
    assert by_rate.mean() < 11.8
    assert by_acceleration.mean() > 2 * 20.3
    clear = np.array([fore_aft_by_lateral(trial) for trial in hands]) > 1.75
    assert by_acceleration[clear].max() < 40 < by_acceleration[~clear].mean()
