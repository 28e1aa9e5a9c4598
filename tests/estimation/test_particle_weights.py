"""Particles are weighed by the residuals of measurements of any kind."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from test_beacons import beacons_about, heard
from test_ranging import ranged
from walks import dead_reckon, drawn_from_the_model, fixes_at, square_walk

import pdr_graph as pdr
from pdr_graph.estimation import particle_filter
from pdr_graph.estimation.factors.base import FactorBlock, Measurement
from pdr_graph.estimation.factors.beacon_rssi import levels_along
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.particle_filter import WeighsPoses, pose_costs
from pdr_graph.geometry import interpolate
from pdr_graph.priors import PARTICLES, RANGES
from pdr_graph.types import Ranges


def states(n, middle=(0.0, 0.0), seed=0):
    """Random states ``(6, n)`` of particles."""
    random = np.random.default_rng(seed)
    pose = np.stack([*(np.array(middle)[:, None] + random.normal(0, 8, (2, n))), random.uniform(-np.pi, np.pi, n)])
    return np.concatenate([pose, np.tile([[1.0], [1.0], [0.0]], n)])


def total(costs, state):
    return np.sum([cost for kind in costs for cost in kind.costs(state)], axis=0)


def test_ranges_weigh_each_pose_by_its_residual():
    """By Huber's loss of the first pass; the survey and the bias widen the sigma, to a metre at least."""
    steps, _, truth = drawn_from_the_model(40, 1)
    ranges = ranged(truth, 1)[0]
    wide = replace(ranges, sigma=np.full(len(ranges), 1.5))
    for table in (ranges, wide):
        graph = WalkGraph(steps, measurements=[table])
        kind = next(kind for kind in graph.measurements if kind.name == "ranges")
        keyframe = int(kind.keyframe[7])
        state = states(50, truth.position[20])
        expected = np.zeros(50)
        for n in np.flatnonzero(kind.keyframe == keyframe):
            anchor = table.position[table.anchor[n]]
            distance = np.sqrt(np.sum((state[:2].T - anchor) ** 2, axis=1) + RANGES.near**2)
            variance = table.sigma[n] ** 2 + 0.1**2 + RANGES.bias**2
            s = (distance - table.range[n]) / np.sqrt(max(variance, PARTICLES.least_sigma**2))
            huber = np.where(np.abs(s) > 2.45, 2.45 * (np.abs(s) - 2.45 / 2), s**2 / 2)
            expected += np.minimum(huber, PARTICLES.outlier_price)
        assert total(pose_costs([kind], keyframe), state) == pytest.approx(expected, rel=0.02, abs=0.02)


def test_levels_of_many_poses_are_those_of_each_alone():
    """As many beacons as levels: the table of beacons is not taken for one of instances."""
    truth = dead_reckon(square_walk())
    beacons = beacons_about(truth)
    graph = WalkGraph(square_walk(), levels=levels_along(heard(truth, beacons.position), beacons, square_walk()))
    kind = next(kind for kind in graph.measurements if kind.name == "beacons")
    keyframe = int(kind.keyframe[0])
    state, costs = states(20), pose_costs([kind], keyframe)
    alone = [total(costs, state[:, n : n + 1])[0] for n in range(20)]
    assert total(costs, state) == pytest.approx(alone)

    # One pose by the factors themselves, of which the same keyframe is evaluated in the walk
    here = graph.start.poses.copy()
    here[keyframe] = state[:3, 4]
    at = graph.evaluate(graph.start.replaced(x=here))
    [block] = at.blocks_of("beacons")
    bound = kind.keyframe[kind.keyframe >= 0] == keyframe
    narrow = block.loss.cost(block.deviation)[: len(bound)][bound].sum()
    assert 0 < alone[4] < narrow, "the path loss and the places are uncertain"


@dataclass(frozen=True)
class Eastings:
    """The coordinate x at some times, measured by something of which the package knows nothing."""

    time: np.ndarray
    x: np.ndarray

    def __len__(self):
        return len(self.time)


@dataclass(frozen=True, eq=False)
class EastingFactor(Measurement):
    """r = (x − z) / 2 m."""

    eastings: Eastings
    number: np.ndarray
    keyframe: np.ndarray

    name: ClassVar[str] = "eastings"

    def bind(self, chain):
        return replace(self, keyframe=chain.keyframe(self.eastings.time))

    def factors(self, at):
        which = np.flatnonzero(self.keyframe >= 0)
        rows = self.keyframe[which]
        pose = at.state.poses[rows]
        by = np.stack([np.cos(pose[:, 2]), -np.sin(pose[:, 2]), np.zeros(len(pose))], axis=1) / 2.0
        value = (pose[:, 0] - self.eastings.x[which]) / 2.0
        return [
            FactorBlock.uniform(self.name, value[:, None], [("x", rows)], lambda: [by[:, None]], self.number[which])
        ]


def test_a_kind_that_the_package_does_not_know_weighs_particles():
    """It has no method for particles: its residuals are enough."""
    eastings = Eastings(np.array([0.0, 5.0, 5.0]), np.array([3.0, 4.0, -9.0]))
    bound = EastingFactor(eastings, np.arange(3), keyframe=np.array([2, 7, 7]))
    state = states(30)
    expected = sum(np.minimum(0.5 * ((state[0] - z) / 2.0) ** 2, PARTICLES.outlier_price) for z in (4.0, -9.0))
    assert total(pose_costs([bound], 7), state) == pytest.approx(expected)
    assert pose_costs([bound], 3) == ()


def test_a_kind_with_other_poses_has_no_say():
    """Of a loop closure at two keyframes, one pose says nothing."""
    steps, fixes, _ = drawn_from_the_model(30, 0)
    graph = WalkGraph(steps, fixes)
    assert all(len(list(kind.costs(states(3)))) for kind in pose_costs(graph.measurements, 0))
    assert pose_costs([kind for kind in graph.measurements if kind.name in ("steps", "calibration", "start")], 0) == ()


def test_some_particles_move_to_a_fix_far_from_all():
    graph = WalkGraph(square_walk(), fixes_at([0.0], [[500.0, 0.0]], 2.0))
    [costs] = pose_costs([graph.positions], 0)
    position, sigma = costs.place_sought(states(10))
    assert position.tolist() == [500.0, 0.0]
    assert sigma == 2.0
    assert costs.place_sought(states(10, (500.0, 0.0))) is None


ANCHORS = {1: (9.6, 12.7), 2: (12.6, 14.5), 3: (23.9, 7.3)}  # [m] in the office


def walked_by_one_anchor(seed):
    """Mean error [m] of the office's walk by its distance from one anchor every other second, without a fix."""
    made = pdr.simulate(replace(pdr.Scenario.load("office"), seed=seed))
    [plan], truth, random = made.scenario.plans.values(), made.truth, np.random.default_rng(seed)
    time = np.arange(truth.time[0] + 0.5, truth.time[-1] - 0.5, 2.0)
    anchor = np.array([ANCHORS[seed]])
    distance = np.hypot(*(interpolate(time, truth.time, truth.position) - anchor).T)
    detour = np.where(random.random(len(time)) < 0.2, random.exponential(3.0, len(time)), 0.0)
    measured = np.maximum(distance + random.normal(0, 0.5, len(time)) + detour, 0.0)
    rows = np.zeros(len(time), dtype=np.intp)
    ranges = Ranges(time, rows, measured, np.full(len(time), 0.5), ("A",), anchor, np.array([0.1]))
    steps = pdr.detect_steps(made.recording(), pdr.Walker(height=made.walker.height))
    track = pdr.smooth(WalkGraph(steps, floor=plan, measurements=[ranges])).trajectory
    return float(np.hypot(*(track.position - interpolate(track.time, truth.time, truth.position)).T).mean())


@pytest.mark.parametrize("seed", ANCHORS)
def test_ranges_to_one_anchor_find_the_route_on_a_plan(seed):
    """One anchor leaves a circle at each moment, and walls alone the wrong corridor: together they are right."""
    assert walked_by_one_anchor(seed) < 2.0


def test_without_the_ranges_the_particles_take_a_wrong_corridor(monkeypatch):
    """Control: weighed by fixes and headings alone, the same walk is metres off."""

    def some(measurements, keyframe):
        return pose_costs([kind for kind in measurements if isinstance(kind, WeighsPoses)], keyframe)

    monkeypatch.setattr(particle_filter, "pose_costs", some)
    assert max(walked_by_one_anchor(seed) for seed in ANCHORS) > 5.0
