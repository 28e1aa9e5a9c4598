import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pdr_graph.gait.detection import peak_pairs

RATE = 50.0


def walking(cadence, amplitude, seconds=30.0, rate=RATE, seed=0):
    """Gravity and a bounce of ``amplitude`` [m/s²] per step, with a heel strike that rings, and noise."""
    t = np.arange(0, seconds, 1 / rate)
    phase = 2 * np.pi * cadence * t
    bounce = amplitude * (np.cos(phase) + 0.3 * np.cos(2 * phase + 1)) + 0.8 * np.cos(10 * phase)
    noise = np.random.default_rng(seed).normal(0, 0.3, (len(t), 3))
    return t, np.array([0.0, 0.0, 9.81]) + bounce[:, None] * [0, 0, 1] + noise


@pytest.mark.parametrize("cadence", [1.2, 1.6, 2.0, 2.4])
@pytest.mark.parametrize("amplitude", [2.0, 4.0, 8.0])
@pytest.mark.parametrize("rate", [25.0, 50.0, 200.0])
def test_every_step_counts_once(cadence, amplitude, rate):
    t, a = walking(cadence, amplitude, rate=rate)
    landings = peak_pairs(t, a)
    assert len(landings.time) == pytest.approx(30 * cadence, abs=1)
    assert np.median(landings.period) == pytest.approx(1 / cadence, rel=0.05)


@settings(max_examples=20, deadline=None)
@given(st.tuples(*[st.floats(-np.pi, np.pi)] * 3))
def test_it_does_not_matter_how_the_phone_is_held(angles):
    t, a = walking(1.9, 3.0)
    turned = peak_pairs(t, Rotation.from_euler("xyz", angles).apply(a))
    assert turned.time == pytest.approx(peak_pairs(t, a).time)


def test_nobody_walks_while_standing():
    t = np.arange(0, 60, 1 / RATE)
    a = np.array([0.5, 3.0, 9.3]) + np.random.default_rng(1).normal(0, 0.15, (len(t), 3))
    assert len(peak_pairs(t, a).time) == 0


def test_a_stop_gives_no_steps_and_the_first_step_after_it_a_usual_period():
    t, a = walking(2.0, 3.0, seconds=20)
    still = (t > 8) & (t < 13)
    a[still] = [0, 0, 9.81]
    landings = peak_pairs(t, a)
    assert not np.any((landings.time > 8.5) & (landings.time < 12.5))
    after = np.searchsorted(landings.time, 12.5)
    assert landings.period[after] == pytest.approx(0.5, rel=0.1)
