"""Jacobians of the factors, the guard of callbacks, and the export to GTSAM."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
import shapely
from derivatives import assert_derivatives, assert_gtsam_agrees, random_state
from gtsam.symbol_shorthand import C, X
from plans import plan
from test_factor_equations import beside_beacons
from walks import dead_reckon, fixes_on, in_corridors, wandering_walk

from pdr_graph.estimation.factors.base import Stage
from pdr_graph.estimation.factors.gnss_bias import GnssBias
from pdr_graph.estimation.factors.gtsam_export import FactorError, guarded
from pdr_graph.estimation.factors.learned_velocity import LearnedVelocityFactor
from pdr_graph.estimation.factors.registry import KINDS
from pdr_graph.estimation.factors.untimed_fixes import UntimedFixFactor
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.gait.learned import Velocities
from pdr_graph.geometry import interpolate
from pdr_graph.priors import MOTION
from pdr_graph.types import Closures, Drifts, Headings, Ranges, UntimedFixes

HALL = plan(("corridor", shapely.box(-6, -6, 6, 6) - shapely.box(-1, -1, 1, 1)))  # with a pillar: walks press on walls


def walled_graph(seed=0, n=24):
    steps = wandering_walk(n, seed)
    return WalkGraph(steps, fixes_on(dead_reckon(steps), every=7), floor=HALL)


def outliers(graph):
    """The second pass from the start: outliers let go, fixes of one receiver share an offset and a lag."""
    return graph.refined(graph.evaluate(graph.start))


def received():
    """Fixes of a receiver, one of them far off."""
    steps = wandering_walk(40, 1)
    fixes = fixes_on(dead_reckon(steps), every=4, seed=1)
    far = replace(fixes, position=fixes.position + np.where(np.arange(len(fixes)) == 4, 8.0, 0.0)[:, None])
    graph = outliers(WalkGraph(steps, replace(far, source=("GNSS",) * len(far))))
    assert graph.positions.outlier.sum() == 1
    assert graph.find(GnssBias).node_number.size > 2
    return graph


def with_a_compass():
    """Several calibration segments, and headings and drifts on either side of Huber's width."""
    steps = wandering_walk(210, 4)
    headings = Headings(np.array([9.0, 30.0, 60.0]), np.array([3.0, 0.0, 1.0]), np.array([0.4, 0.1, 2.0]))
    drifts = Drifts(np.array([9.0, 70.0]), np.array([0.01, -0.02]), np.array([0.002, 0.05]))
    return WalkGraph(steps, fixes_on(dead_reckon(steps), every=60), headings=headings, measurements=[drifts])


def closed(stage):
    """Two closures, held as in a stage of the search."""
    steps = wandering_walk(30, 5)
    tied = Closures.of([(steps.time[3], steps.time[25], 0.5), (steps.time[8], steps.time[18], 2.0)])
    return WalkGraph(steps, fixes_on(dead_reckon(steps), every=8), closures=tied).staged(stage)


def ranged_graph():
    """Ranges to three anchors in the first pass; the loss of the second, which has a sign, GTSAM cannot have."""
    steps = wandering_walk(12)
    time, anchor = steps.time[[2, 4, 6, 8]], np.array([0, 1, 2, 0])
    place = np.array([[0.0, 9.0], [8.0, -5.0], [-6.0, 1.0]])
    distance, sigma, survey = np.array([9.0, 8.0, 16.0, 7.0]), np.full(4, 0.3), np.full(3, 0.1)
    ranges = Ranges(time, anchor, distance, sigma, ("A", "B", "C"), place, survey)
    return WalkGraph(steps, measurements=[ranges])


def beside_a_network():
    """Velocities of a network that turns away for a while, in the second pass: several segments, and two frames."""
    steps = wandering_walk(230, 6)
    track = dead_reckon(steps)
    time = np.arange(steps.start, steps.end, 0.5)
    place = interpolate(time, track.time, track.position)
    velocity = np.gradient(place, time, axis=0) @ np.array([[0.6, 0.8], [-0.8, 0.6]])
    velocity[40:70] *= -1
    table = Velocities(time, velocity, np.full_like(velocity, 0.4), (time > 60).astype(np.intp))
    graph = outliers(WalkGraph(steps, fixes_on(track, every=60), measurements=[table]))
    assert len(graph.find(LearnedVelocityFactor)._used) > 20
    return graph


def past_places():
    """Two places beside the walk, one before its start and one at no place of it, bound to the nearest intervals."""
    steps = wandering_walk(24, 5)
    track = dead_reckon(steps)
    place = track.position[[5, 11, 0, 18]] + np.array([[0.6, 0.4], [-0.5, 0.7], [-4.0, -1.0], [5.0, 8.0]])
    span = np.tile([steps.start, steps.end], (4, 1))
    graph = WalkGraph(steps, measurements=[UntimedFixes(span, place, np.full(4, 0.8), tuple("abcd"))])
    return graph.assuming((graph.find(UntimedFixFactor).bound_at(graph.evaluate(graph.start)),))


GRAPHS = {
    "places without a time": past_places,
    "walls": walled_graph,
    "rough walls": lambda: walled_graph(seed=6).staged(Stage.ROUGH),
    "turns": lambda: in_corridors("turns"),
    "directions": lambda: in_corridors("directions"),
    "a receiver": received,
    "beacons": beside_beacons,
    "compass": with_a_compass,
    "closures": lambda: closed(Stage.FINAL),
    "firm closures": lambda: closed(Stage.ROUGH),
    "ranges": ranged_graph,
    "network": beside_a_network,
    "no fix": lambda: WalkGraph(wandering_walk(12)),
    "no fix on a plan": lambda: WalkGraph(wandering_walk(12), floor=HALL),
}
OF_EVERY_WALK = {"steps", "walls", "corridors", "turns", "calibration", "start"}


@pytest.mark.parametrize(
    ("name", "seed"), [(name, seed) for name in GRAPHS for seed in range(2) if seed or name not in ("turns", "compass")]
)
def test_derivatives(name, seed):
    """Every block of every kind, by every variable, at random states; robust weights as slopes of the cost."""
    graph = GRAPHS[name]()
    assert_derivatives(graph, random_state(graph, np.random.default_rng(seed)))


def test_every_measurement_kind_is_tested():
    """Some graph above has factors of each kind with residuals, so the derivatives of all kinds are tested."""
    checked = set()
    for make in GRAPHS.values():
        graph = make()
        at = graph.evaluate(random_state(graph, np.random.default_rng(1)))
        checked |= {kind.name for kind in at.measurements if any(block.deviation.any() for block in kind.factors(at))}
    ours = {kind for kinds in KINDS.values() for kind in kinds if kind.__module__.startswith("pdr_graph.")}
    assert checked >= OF_EVERY_WALK | {kind.name for kind in ours}


@pytest.mark.parametrize("name", GRAPHS)
def test_gtsam_linearises_the_same_graph(name):
    """The assembled linear graph equals GTSAM's linearisation factor by factor, to rounding."""
    graph = GRAPHS[name]()
    assert_gtsam_agrees(graph, random_state(graph, np.random.default_rng(1)))


@pytest.mark.parametrize(
    ("error", "block", "complaint"),
    [
        (np.zeros(2), np.zeros((3, 3)), "shapes"),
        (np.zeros(3), np.zeros((3, 2)), "shapes"),
        (np.array([0.0, np.nan, 0.0]), np.zeros((3, 3)), "not finite at .*x4"),
        (np.zeros(3), np.full((3, 3), np.inf), "not finite"),
    ],
)
def test_the_guard_rejects_what_gtsam_accepts(error, block, complaint):
    """GTSAM crashes on an unset block, accepts any shape, returns the start for a NaN; the guard names the factor."""
    factor = guarded("bad", gtsam.noiseModel.Unit.Create(3), [X(4)], lambda values: (error, [block]))
    values = gtsam.Values()
    values.insert(X(4), gtsam.Pose2())
    with pytest.raises(FactorError, match=complaint):
        factor.linearize(values)


def test_the_guard_fills_every_block():
    blocks = [np.full((3, 3), n + 1.0) for n in range(3)]
    keys = [X(0), X(1), C(0)]
    factor = guarded("good", gtsam.noiseModel.Unit.Create(3), keys, lambda values: (np.ones(3), blocks))
    values = gtsam.Values()
    for key in keys[:2]:
        values.insert(key, gtsam.Pose2())
    values.insert(C(0), np.zeros(3))
    assert np.hsplit(factor.linearize(values).jacobian()[0], 3) == pytest.approx(np.array(blocks))


def test_the_calibrations_of_a_chain_are_numbered_as_the_variables_of_the_graph():
    graph = WalkGraph(wandering_walk(4 * MOTION.steps_per_segment))
    assert len(graph.chain.segment_first) > 2
    assert graph.chain.segment_number.tolist() == graph.start.number("c").tolist()
    assert graph.chain.number.tolist() == graph.start.number("x").tolist()
