"""A walk under way without any position is sought on its plan, and goes on as if a fix had told its place."""

from functools import cache
from pathlib import Path

import numpy as np

from pdr_graph import FloorPlan, Recording
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.online.interface import Samples, events_of
from pdr_graph.online.navigator import Navigator

ROOT = Path(__file__).resolve().parents[2]
INERTIAL = ("accelerometer", "gyroscope")


@cache
def followed():
    """The poses of the arcade's walk by plan and inertial sensors alone, its truth, and its estimate."""
    walk = simulate(Scenario.load("arcade"))
    recording = Recording("arcade", 0.0, None, **{name: walk.signals[name] for name in INERTIAL})
    navigator = Navigator(FloorPlan.load(ROOT / "maps" / "arcade.geojson"), lag=60.0)
    poses, states = [], []
    for event in events_of(recording):
        navigator.push(event)
        navigator.review()
        if isinstance(event, Samples) and event.sensor == "accelerometer":
            poses.append(navigator.pose)
            states.append(navigator.status.state)
    return [pose for pose in poses if pose is not None], states, walk.truth, navigator.finish()


def errors(time, position, truth):
    """Distance from the truth [m]."""
    at = np.column_stack([np.interp(time, truth.time, axis) for axis in truth.position.T])
    return np.hypot(*(position - at).T)


def test_the_place_narrows_while_the_walk_goes_on():
    poses, states, truth, _ = followed()
    time = np.array([pose.time for pose in poses])
    off = errors(time, np.array([(pose.x, pose.y) for pose in poses]), truth)
    sigma = np.array([pose.sigma for pose in poses])
    assert time[0] < 45.0, "the first search is answered"
    late = time > time[-1] - 20.0
    assert np.median(off[late]) < 4.0
    assert np.median(sigma[late]) < sigma[0] / 3
    assert np.mean(off < 2.5 * sigma) > 0.85, "the region holds, before and after"
    assert (states[0], states[-1]) == ("waiting", "running")


def test_the_walk_is_smoothed_where_it_was_found():
    _, _, truth, estimate = followed()
    track = estimate.trajectory
    assert np.mean(errors(track.time, track.position, truth)) < 3.0
