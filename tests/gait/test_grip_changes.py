"""Phones that are taken otherwise in mid-walk, and corners that are none of that."""

import numpy as np
import pytest

from pdr_graph.gait.heading import walking_direction
from pdr_graph.inertial.attitude import attitude_of
from pdr_graph.lab.simulation.carrying import with_grip_change
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.priors import GRIP

ROUND = [[30, 0], [30, 20], [0, 20], [0, 0]]


def walked(hold="hand", seed=0):
    given = {"seed": seed, "route": [[0, 0], {"stand": 2}, {"to": ROUND}], "phone": {"hold": hold, "rate": 50}}
    return simulate(Scenario.of(given))


@pytest.mark.parametrize("angle", [np.pi / 2, -np.pi / 2])
def test_a_phone_turned_in_the_hand_does_not_turn_the_walker(angle):
    """From upright to across on the first leg; the gait shows that the walker went straight on."""
    for seed in range(3):
        walk = walked(seed=seed)
        recording = walk.recording("accelerometer", "gyroscope")
        attitude, step = attitude_of(recording), 1 / walk.walker.cadence
        up = attitude.R_world_device[int(np.searchsorted(attitude.time, 14.0))].inv().apply([0.0, 0.0, 1.0])
        direction = walking_direction(attitude_of(with_grip_change(recording, up, 14.0, angle)), step)
        plain = walking_direction(attitude, step)
        assert plain.variance[-1] == 0
        assert direction.variance[-1] == pytest.approx(GRIP.sigma**2)
        assert direction.heading[-1] == pytest.approx(plain.heading[-1], abs=2 * GRIP.sigma)


@pytest.mark.parametrize("angle", [0, 90, 180])
def test_a_turn_during_a_grip_change_is_found(angle):
    """The walker stands, turns and puts the phone into a pocket; the gait before and after shows the turn."""
    onwards = {0: [50, 0], 90: [25, 25], 180: [0, 0]}[angle]
    turning = {"stand": 1, "turn": angle} if angle else {"stand": 1}
    route = [[0, 0], {"stand": 2}, {"to": [[25, 0]]}, turning, {"hold": "trouser pocket"}, {"to": [onwards]}]
    walk = simulate(Scenario.of({"seed": 1, "route": route, "phone": {"rate": 50}}))
    attitude = attitude_of(walk.recording("accelerometer", "gyroscope"))
    direction = walking_direction(attitude, 1 / walk.walker.cadence)
    truth = np.interp(attitude.time, walk.body.time, walk.body.heading)
    turned = direction.heading[-1] - direction.heading[0] - (truth[-1] - truth[0])
    assert direction.variance[-1] > 0
    assert abs(np.angle(np.exp(1j * turned))) < 2 * GRIP.sigma
