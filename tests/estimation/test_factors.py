"""The own factors: Jacobians, the guard, and GTSAM's view of the graph."""

import gtsam
import numpy as np
import pytest
import shapely
from gtsam.symbol_shorthand import C, X
from plans import plan
from walks import dead_reckon, fixes_at, fixes_on, square_walk, wandering_walk

from pdr_graph.estimation.corridors import Use
from pdr_graph.estimation.factors import FactorError, guarded
from pdr_graph.estimation.graph import Prior, State, WalkGraph
from pdr_graph.floor.areas import Area
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.frames import Frame


def hall(margin=1.0):
    """A hall round the origin with a pillar, so that walks press against walls."""
    area = shapely.box(-6, -6, 6, 6).difference(shapely.box(-1, -1, 1, 1))
    return FloorPlan("hall", (Area("corridor", "", area),), Frame())


def walled_graph(seed=0, steps=24):
    said = wandering_walk(steps, seed)
    return WalkGraph(said, fixes_on(dead_reckon(said), every=7), floor=hall())


def ring():
    """Corridors of 2.5 m round a block of 14 m, with the intersections at its corners."""
    at, w = (-1.25, 12.75), 2.5
    crossings = [shapely.box(x, y, x + w, y + w) for x in at for y in at]
    ways = [shapely.box(1.25, y, 12.75, y + w) for y in at] + [shapely.box(x, 1.25, x + w, 12.75) for x in at]
    areas = [("intersection", c) for c in crossings] + [("corridor", c) for c in ways]
    return plan(*areas)


def turning_graph():
    """Two laps of the ring, whose turns and straight runs are matched along the walk itself."""
    said = square_walk(20, laps=2)
    track = dead_reckon(said)
    start = fixes_at(track.time[:1], track.position[:1])
    graph = WalkGraph(said, start, floor=ring(), prior=Prior(corridors=Use(turns=True, directions=True)))
    return graph.following(graph.start)


def random_state(graph, random):
    """Any poses and calibrations: a factor's derivative must hold away from the optimum too."""
    k, s = len(graph.segment) + 1, len(graph.start.c)
    poses = random.uniform([-6, -6, -np.pi], [6, 6, np.pi], (k, 3))
    return State(poses, random.normal([1, 1, 0], [0.1, 0.05, 0.01], (s, 3)))


def differences(factor, values):
    """Central differences of a factor's error by each of its keys, in GTSAM's local coordinates."""
    blocks = []
    for key in factor.keys():
        columns = []
        for n in range(3):
            errors = []
            for sign in (1, -1):
                move = gtsam.VectorValues()
                for other in values.keys():
                    move.insert(other, sign * 1e-6 * np.eye(3)[n] if other == key else np.zeros(3))
                errors.append(factor.unwhitenedError(values.retract(move)))
            columns.append((errors[0] - errors[1]) / 2e-6)
        blocks.append(np.stack(columns, axis=1))
    return blocks


def assert_derivatives(factor, values):
    analytic = np.hsplit(factor.linearize(values).jacobian()[0], len(factor.keys()))
    for block, numeric in zip(analytic, differences(factor, values), strict=True):
        assert block == pytest.approx(numeric, abs=2e-5)


@pytest.mark.parametrize("seed", range(5))
def test_jacobians(seed):
    """PDR and wall factors at random states. Walls are bilinear: 1e-6 crosses a cell's border too rarely to matter."""
    random = np.random.default_rng(seed)
    graph = walled_graph(seed)
    values = random_state(graph, random).to_values()
    factors = graph.to_gtsam()
    own = [factors.at(n) for n in range(graph.native.size(), factors.size())]
    assert len(own) == 2 * len(graph.segment)
    for factor in own:
        assert_derivatives(factor, values)


@pytest.mark.parametrize("seed", range(3))
def test_jacobians_of_turns(seed):
    """The heading change between two poses, and the intersection that a step between two others should lie in."""
    graph = turning_graph()
    values = random_state(graph, np.random.default_rng(seed)).to_values()
    factors = graph.to_gtsam()
    own = [factors.at(n) for n in range(graph.native.size(), factors.size())]
    turns = [f for f in own if (f.dim() == 1 and len(f.keys()) == 2) or f.dim() == 4]
    assert len(turns) == 2 * len(graph.turns)
    assert sum(np.any(f.unwhitenedError(values)) for f in turns) > len(turns) / 2
    for factor in turns:
        assert_derivatives(factor, values)


@pytest.mark.parametrize("graph", [walled_graph(seed=3), turning_graph()], ids=["walls", "walls and turns"])
def test_batch_linearisation_is_gtsams_own(graph):
    """What the smoother assembles for the whole walk equals GTSAM linearising factor by factor, to rounding."""
    values = random_state(graph, np.random.default_rng(1)).to_values()
    ordering = gtsam.Ordering.NaturalNonlinearFactorGraph(graph.to_gtsam())
    ours, theirs = (g.hessian(ordering) for g in (graph.linearize(values), graph.to_gtsam().linearize(values)))
    for a, b in zip(ours, theirs, strict=True):
        assert a == pytest.approx(b, rel=1e-9, abs=1e-6)
    assert graph.error(values) == pytest.approx(graph.to_gtsam().error(values))


def test_sub_steps_end_at_the_keyframes():
    """The last piece of every interval ends at its keyframe, wherever that is: no jump in the track."""
    graph = walled_graph()
    state = random_state(graph, np.random.default_rng(2))
    placed = graph.evaluate(state.to_values()).poses.value[graph.pieces.last]
    assert placed[:, :2] == pytest.approx(state.poses[1:, :2])
    assert np.exp(1j * placed[:, 2]) == pytest.approx(np.exp(1j * state.poses[1:, 2]))


def test_ends_are_the_sub_steps_without_their_derivatives():
    """What a move that is only tried is judged by is what its derivatives are of; to rounding."""
    graph = walled_graph()
    own = graph.evaluate(random_state(graph, np.random.default_rng(1)).to_values())
    assert own.ends == pytest.approx(own.poses.value, abs=1e-12)


def test_nothing_presses_in_the_open():
    said = wandering_walk(10)
    graph = WalkGraph(said, fixes_on(dead_reckon(said), every=3), floor=hall())
    middle = State(np.tile([3.5, 3.5, 0.0], (len(graph.segment) + 1, 1)), graph.start.c)
    own = graph.evaluate(middle.to_values())
    distance, _ = hall().distance.at(own.poses.value[:, :2])
    assert np.all((own.wall.value[:, 0] > 0) == ((distance < 0.8) & (graph.pieces.length > 0)))


@pytest.mark.parametrize(
    ("error", "block", "complaint"),
    [
        (np.zeros(2), np.zeros((3, 3)), "shapes"),
        (np.zeros(3), np.zeros((3, 2)), "shapes"),
        (np.array([0.0, np.nan, 0.0]), np.zeros((3, 3)), "not finite at .*x4"),
        (np.zeros(3), np.full((3, 3), np.inf), "not finite"),
    ],
)
def test_the_guard_stops_what_gtsam_would_accept(error, block, complaint):
    """GTSAM crashes on an unset block, takes any shape, returns the start for a NaN: the guard says which factor."""
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
