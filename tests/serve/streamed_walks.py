"""Walks as the messages that Sensor Logger pushes, and waiting for what a server makes of them."""

import time
from functools import cache

import numpy as np
import simulated

from pdr_graph.lab.simulation.streaming import batches, message

PATIENCE = 30.0  # [s]


@cache
def outdoors(length=16.0):
    """A straight walk of a length [m], with a fix every four seconds."""
    return simulated.with_receiver(simulated.walk_along(np.array([[0.0, 0.0], [length, 0.0]]), seed=2), every=200)


def bodies(walk, session="walk-one"):
    """The messages of a walk, one a second."""
    return [message(session, n, payload) for n, payload in enumerate(batches(walk))]


def until(condition):
    """Wait for a condition that is not false, and return it."""
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.05)
    return found
