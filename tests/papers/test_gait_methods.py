"""Published step detectors on signals with known steps."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pdr_graph.gait.steps import gait_signals
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.lab.papers import gait_methods
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate

PERIOD, STEP = 0.02, 0.5
TIME = np.arange(0.0, 20.0, PERIOD)


def level(vertical, forward=None):
    """The attitude of a level phone with these accelerations [m/s²] beside gravity."""
    ahead = np.zeros(len(TIME)) if forward is None else forward
    world = np.column_stack([ahead, np.zeros(len(TIME)), 9.81 + vertical])
    return Attitude(TIME, PERIOD, Rotation.identity(len(TIME)), world, np.zeros_like(world))


def bouncing(amplitude=3.0):
    return amplitude * np.cos(2 * np.pi * TIME / STEP)


@pytest.mark.parametrize("method", [gait_methods.peak_pairs, gait_methods.trough_to_peak])
def test_strong_bounces_are_steps_and_weak_ones_are_not(method):
    assert len(method(level(bouncing()))) == pytest.approx(40, abs=1)
    assert len(method(level(bouncing(0.2)))) == 0


def test_a_step_has_a_forward_push_after_the_vertical_peak():
    """[gps-dr] Sec. 2.2: vertical + then −, forward − then +, and the slope between these."""
    pushed = 1.5 * np.sin(2 * np.pi * TIME / STEP - np.pi)
    assert len(gait_methods.vertical_forward(level(bouncing()), pushed)) == pytest.approx(40, abs=2)
    assert len(gait_methods.vertical_forward(level(bouncing()), 0.1 * pushed)) == 0
    assert len(gait_methods.vertical_forward(level(0 * TIME), pushed)) == 0


def test_the_templates_are_those_of_the_paper():
    """[calibration-walk] Fig. 3: in walking the acceleration rises and falls strongly, since the other foot moves on;
    with closing feet it only rises, while the body comes to rest.
    """
    walking, together = gait_methods.templates().T
    low = int(np.argmin(together))
    assert np.all(np.diff(together[low:]) > 0)
    top = int(np.argmax(walking))
    assert walking[top] - walking[top:].min() > 1.5


def test_the_closing_step_is_not_counted():
    """All landings except the last are counted: exactly in 70 % of the walks, and in total within 2."""
    wrong = []
    for seed in range(20):
        walk = simulate(Scenario.of({"seed": seed, "route": [[0, 0], {"stand": 2}, {"to": [[14.5, 0]]}, {"stand": 2}]}))
        gait = gait_signals(walk.recording("accelerometer", "gyroscope"))[0]
        wrong.append(len(gait_methods.without_closing(gait.attitude, gait.forward)) - (len(walk.body.landings) - 1))
    assert np.mean(np.equal(wrong, 0)) >= 0.7
    assert abs(np.sum(wrong)) <= 2
