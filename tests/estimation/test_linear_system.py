"""The smoother's own sparse algebra on graphs of walks, against GTSAM's dense matrices."""

import gtsam
import numpy as np
import pytest
from derivatives import linear_graph
from threadpoolctl import threadpool_info, threadpool_limits
from walks import drawn_beside_beacons, drawn_from_the_model, drawn_with_a_receiver, straight

from pdr_graph import WalkGraph
from pdr_graph.estimation.linear_system import Factorization, one_thread
from pdr_graph.types import Closures

LONG = 1500  # steps: several rounds, and a root


def several_segments():
    steps, fixes, _ = drawn_from_the_model(LONG, seed=4)
    return WalkGraph(steps, fixes)


def closures():
    steps, fixes, truth = drawn_from_the_model(LONG, seed=4)
    pairs = np.sort(np.random.default_rng(0).integers(1, LONG, (40, 2)), axis=1)
    tied = Closures.of([(*truth.time[pair].tolist(), 2.0) for pair in pairs if pair[0] < pair[1]])
    return WalkGraph(steps, fixes, closures=tied)


def beacons():
    steps, fixes, levels, _ = drawn_beside_beacons(LONG, seed=1)
    return WalkGraph(steps, fixes, levels=levels)


def a_receiver():
    steps, fixes, _ = drawn_with_a_receiver(120, seed=1)
    return WalkGraph(steps, fixes)


def one_step():
    return WalkGraph(straight(1))


@pytest.mark.parametrize("graph_of", [several_segments, closures, beacons, a_receiver, one_step])
def test_solution_determinant_and_inverse_are_those_of_the_dense_matrix(graph_of):
    graph = graph_of()
    graph = graph.refined(graph.evaluate(graph.start))
    at = graph.evaluate(graph.start)
    symbols, ordering = list(at.state.arrays), gtsam.Ordering()
    for key in np.concatenate([at.state.keys(symbol) for symbol in symbols]).tolist():
        ordering.push_back(key)
    dense, right = linear_graph(at).hessian(ordering)
    equations = graph.normal_equations(at)
    solution = equations.assembled(at).solution
    moves = np.concatenate([solution.moves[symbol] for symbol in symbols]).ravel()
    assert moves == pytest.approx(np.linalg.solve(dense, right), rel=1e-7, abs=1e-9)
    assert solution.log_determinant == pytest.approx(np.linalg.slogdet(dense)[1] / 2, rel=1e-9)

    inverse, first = np.linalg.inv(dense), np.cumsum([0, *(len(at.state[symbol]) for symbol in symbols)])
    for block in at.blocks:
        groups = [(symbol, rows[:20]) for symbol, rows in block.variables]
        variables = np.stack([first[symbols.index(symbol)] + rows for symbol, rows in groups], axis=1)
        for joint, bound in zip(solution.joint(*groups), variables, strict=True):
            rows = (3 * bound[:, None] + np.arange(3)).ravel()
            assert joint == pytest.approx(inverse[np.ix_(rows, rows)], rel=1e-6, abs=1e-9), block.name


def test_a_chain_takes_as_many_rounds_as_it_can_be_halved_and_beacons_are_the_border():
    """Variables that most others are bound to are not eliminated with them."""
    for graph_of, border in ((several_segments, 0), (beacons, 4 + 1)):
        graph = graph_of()
        at = graph.evaluate(graph.start)
        elimination = graph.normal_equations(at).elimination
        count = sum(len(rows) for rows in at.state.arrays.values())
        assert 1 < len(elimination.rounds) < np.log2(count)
        assert len(elimination.border) == border


@pytest.mark.parametrize("graph_of", [several_segments, one_step])
def test_an_indeterminate_matrix_is_refused(graph_of):
    """A variable without information, eliminated in the first round or in the root."""
    graph = graph_of()
    at = graph.evaluate(graph.start)
    system = graph.normal_equations(at).assembled(at)
    elimination, blocks = system.equations.elimination, system._blocks.copy()
    blocks[elimination.diagonal[0]] -= np.diag([0.0, 0.0, blocks[elimination.diagonal[0], 2, 2]])
    with pytest.raises(RuntimeError, match="do not determine"):
        Factorization(elimination, blocks, system._right)


def test_graphs_with_the_same_factors_share_the_places_of_their_blocks():
    steps, fixes, _ = drawn_from_the_model(240, seed=4)
    graph = WalkGraph(steps, fixes)
    at = graph.evaluate(graph.start)
    equations = graph.normal_equations(at)
    assert graph.rotated(1.0).normal_equations(at) is equations
    fewer = WalkGraph(steps, fixes[:-3])
    assert not equations.fits(fewer.evaluate(fewer.start))


def test_linear_algebra_uses_one_thread_within_and_as_many_as_before_after():
    def threads():
        return {library["filepath"]: library["num_threads"] for library in threadpool_info()}

    with threadpool_limits(limits=2):
        before = threads()
        with one_thread:
            with one_thread:
                assert set(threads().values()) == {1}
            assert set(threads().values()) == {1}
        assert threads() == before
