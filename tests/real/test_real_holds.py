"""The methods of [heading] with real phones, whose directions are known."""

import numpy as np

from pdr_graph.lab.papers.heading_experiment import READINGS, errors, movement, real_trials, rms


def test_real_hands_show_turns_but_not_always_the_axis(data):
    """By the accumulated rate they are on average as accurate as the paper in the hand; by acceleration few are."""
    hands = [trial for name, trials in real_trials(data).items() if name.endswith("hand") for trial in trials]
    by_rate, by_acceleration = (
        np.array([rms(errors(trial, READINGS[method])) for trial in hands])
        for method in ("angular-rate accumulation", "acceleration PCA")
    )
    assert by_rate.mean() < 11.8
    assert by_acceleration.mean() > 2 * 20.3
    clear = np.array([movement(trial).fore_aft for trial in hands]) > 1.75
    assert by_acceleration[clear].max() < 40 < by_acceleration[~clear].mean()
