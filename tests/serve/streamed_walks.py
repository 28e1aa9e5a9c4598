"""Walks as the messages that Sensor Logger pushes, and waiting for what a server makes of them."""

import asyncio
import time
from functools import cache

import numpy as np
import simulated
from starlette.testclient import TestClient

from pdr_graph.apps.serve.serving import Settings, build
from pdr_graph.lab.simulation.streaming import batches, message

PATIENCE = 60.0  # [s] as of a browser: a process may begin on a machine that others compute on


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


async def soon(condition):
    """Wait for a condition within a coroutine."""
    async with asyncio.timeout(PATIENCE):
        while not condition():
            await asyncio.sleep(0.01)


def local_server(folder, **settings):
    """The client of a server without tokens, on this machine; estimates in a thread."""
    return TestClient(build(Settings(folder, workers=0, **settings)), base_url="http://127.0.0.1")


def used(client, count, id_=None):
    """The pose of a walker, by default the first, when so many of its messages were used; None before."""
    poses = (pose for pose in client.get("/walkers").json() if id_ in (None, pose["id"]))
    return next((pose for pose in poses if pose["message"] >= count), None)


def finished_recording(client, id_):
    """End a walk; its recording, as soon as it is there."""
    client.post(f"/walkers/{id_}/finish").raise_for_status()
    answer = until(lambda: (found := client.get(f"/walkers/{id_}/recording")).status_code == 200 and found)
    return answer.content
