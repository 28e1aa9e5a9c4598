"""iSAM2 smooths the live walk: its updates, its guard, its optimum, and the same bits in every process."""

import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from weakref import ref

import numpy as np
import pytest
from synthetic_walks import LOOP, held_by_walls, live_events, walk_and_truth

from pdr_graph import FloorPlan, Navigator
from pdr_graph.estimation import optimizer
from pdr_graph.estimation.factors.base import extract
from pdr_graph.estimation.incremental import IncrementalSmoother
from pdr_graph.estimation.live.finalization import FinalizedTrajectory
from pdr_graph.estimation.live.live_ambiguity import Deferred
from pdr_graph.estimation.optimizer import Descent
from pdr_graph.geometry import interpolate
from pdr_graph.types import Fixes, Steps


def fixes_at_1_hz(n=330):
    """Events of a walk with a fix every second step."""
    return list(live_events(*walk_and_truth(n, 2)[:2]))


def refuse(*_, **__):
    raise AssertionError("the batch's solver is not asked")


def test_final_rows_are_the_estimates_of_isam2_and_of_no_other_solver(monkeypatch):
    """Once the walk is certain and no question is open; at the moment at which they leave, bit for bit."""
    nav, left, take = Navigator(lag=30.0, executor=None), [], FinalizedTrajectory.take

    def taken(self, leaving, at, *more):
        values = nav._graph.graph._isam._smoother.calculateEstimate()
        left.append((at.state.poses, extract(values, "x")))
        return take(self, leaving, at, *more)

    events = fixes_at_1_hz()
    for event in events[: len(events) // 2]:
        nav.push(event)
        nav.review()
    assert nav._graph.sure
    nav.finalized()
    monkeypatch.setattr(FinalizedTrajectory, "take", taken)
    monkeypatch.setattr(Deferred, "ask", lambda *_, **__: None)
    monkeypatch.setattr(Descent, "step", refuse)
    monkeypatch.setattr(optimizer, "optimize", refuse)
    monkeypatch.setattr("pdr_graph.estimation.linear_system.NormalEquations.__init__", refuse)
    for question in nav._graph.ambiguity.questions:
        question.cancel()
    keyframes, updates, rebuilds = nav._window.count, nav.status.updates, nav.status.rebuilds
    for event in events[len(events) // 2 :]:
        nav.push(event)
        assert nav.pose is not None
    assert len(left) > 5
    for own, gtsams in left:
        assert np.array_equal(own, gtsams)
    assert len(nav.finalized()) > 50
    assert nav.status.updates - updates >= nav._window.count - keyframes > 50, "an update for each keyframe that closes"
    assert nav.status.rebuilds == rebuilds


def last_poses(events, nav):
    """The pose after each step."""
    poses = []
    for event in events:
        nav.push(event)
        if isinstance(event, Steps) and nav.pose is not None:
            poses.append((nav.pose.x, nav.pose.y))
    return np.array(poses)


@cache
def without_failure():
    """The poses of a walk of 200 steps."""
    return last_poses(fixes_at_1_hz(200), Navigator(executor=None))


@pytest.mark.parametrize("what", ["throws", "raises the cost"])
def test_an_update_that_fails_begins_isam2_anew_and_is_counted(monkeypatch, what):
    """The walk goes on as without: within a centimetre when the next keyframes have closed."""
    expected, update, count = without_failure(), IncrementalSmoother.update, [0]

    def failing(self, walk):
        update(self, walk)
        count[0] += 1
        if count[0] == 90 and what == "throws":
            raise RuntimeError("Indeterminate linear system")
        if count[0] == 90:
            self.estimate = self.estimate.replaced(x=self.estimate.poses + np.array([30.0, 0.0, 0.0]))

    monkeypatch.setattr(IncrementalSmoother, "update", failing)
    nav = Navigator(executor=None)
    found = last_poses(fixes_at_1_hz(200), nav)
    assert ("Indeterminate" if what == "throws" else "raised the cost") in nav.status.rebuilds[-1]
    assert not nav.status.rebuilds[-1].endswith("at 2 s"), "before the walk is placed another may"
    assert np.hypot(*(found - expected).T).max() < 0.5
    assert np.hypot(*(found - expected)[-30:].T).max() < 0.02


def test_between_walls_pose_and_sigma_are_those_of_the_optimum():
    """Of the window's factors with the marginal, searched to the end by the batch's solver."""
    nav, last, apart, ratio = Navigator(FloorPlan.load(LOOP), lag=60.0, executor=None), None, [], []
    for n, event in enumerate(live_events(*held_by_walls(420, period=0.5))):
        nav.push(event)
        nav.review()
        graph = nav._graph.graph
        if not nav._graph.sure or graph.window.times[-1] == last or n % 4:
            continue
        last, walk = graph.window.times[-1], graph.frozen()
        optimum = optimizer.optimize(walk, walk.start, 1e-8)
        end = ("x", np.array([len(walk.start.poses) - 1]))
        apart.append(np.hypot(*(optimum.state.poses[-1] - graph.at.state.poses[-1])[:2]))
        sigmas = [np.sqrt(np.trace(one.joint(end)[0][:2, :2])) for one in (graph.isam, optimum.solution)]
        ratio.append(sigmas[0] / sigmas[1])
    assert len(ratio) > 10
    assert np.percentile(apart, 95) < 0.02
    assert 0.88 < np.percentile(ratio, 5) <= np.percentile(ratio, 95) < 1.05


HASH = """
import hashlib, sys
sys.path[:0] = [{tests!r}]
from pdr_graph import Navigator
from synthetic_walks import live_events, walk_and_truth
nav, poses = Navigator(lag=30.0, executor=None), []
for event in live_events(*walk_and_truth(130, 2)[:2]):
    nav.push(event)
    nav.review()
    poses.append(repr((nav.pose.x, nav.pose.y, nav.pose.covariance.tolist())) if nav.pose else "")
print(hashlib.sha256("".join(poses).encode()).hexdigest())
"""


def test_a_walk_has_the_same_bits_in_every_process():
    script = HASH.format(tests=str(Path(__file__).resolve().parents[1]))
    found = [
        subprocess.run(
            [sys.executable, "-c", script],
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
            timeout=200,
        ).stdout
        for seed in ("1", "2")
    ]
    assert found[0] == found[1] != ""


def test_a_smoother_that_was_replaced_is_freed():
    """GTSAM's copies of its callbacks would keep it, with all factors, 0.5 MB at each rebuild."""
    nav, smoothers = Navigator(lag=30.0, executor=None), []
    for event in fixes_at_1_hz(100):
        nav.push(event)
        graph = nav._graph.graph
        if nav._window.keyframes:
            smoothers.append(ref(graph.isam))
            graph.moved()
    assert len(smoothers) > 100
    assert sum(each() is not None for each in smoothers) <= 1


def test_a_receiver_whose_fixes_come_back_after_the_lag_has_its_prior_again():
    """Its offset left the window with its last fix; without a prior it was 10^15 m, and the walk went with it."""
    steps, _, truth = walk_and_truth(500, 10)
    time = np.arange(0.4, steps.end, 31.4)  # the last fix leaves when the next one comes
    place = interpolate(time, truth.time, truth.position)
    rare = Fixes(time, place, np.full(len(time), 3.0), source=("GNSS",) * len(time))
    nav = Navigator(lag=28.0, executor=None)
    for event in live_events(steps, rare):
        nav.push(event)
        if nav._window.keyframes:
            estimate = nav._graph.graph.isam.estimate
            assert all(np.abs(rows).max(initial=0.0) < 1e3 for rows in estimate.arrays.values())
    assert nav.status.rebuilds == ()
    assert np.hypot(*(np.array([nav.pose.x, nav.pose.y]) - truth.position[-1])) < 40
