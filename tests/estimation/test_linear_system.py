"""The smoother's own sparse algebra against dense matrices and GTSAM: solution, determinant, inverse."""

import numpy as np
import pytest
from walks import drawn_from_the_model

from pdr_graph import WalkGraph
from pdr_graph.estimation.linear_system import Elimination, Factorization

COUNT = 300  # variables: several rounds, and a root


def chain():
    return np.column_stack([np.arange(COUNT - 1), np.arange(1, COUNT)])


def chain_with_segments():
    """Of a walk: keyframes 0 to 249, and a calibration for every 25 of them, which follow one another."""
    keyframe = np.arange(249)
    of_segment = 250 + keyframe // 25
    change = np.column_stack([np.arange(250, 259), np.arange(251, 260)])
    pairs = np.stack([keyframe, keyframe + 1, of_segment], axis=1)
    alone = np.column_stack([np.arange(260, COUNT), np.arange(260, COUNT)])
    return np.concatenate([pairs[:, :2], pairs[:, 1:], pairs[:, ::2], change, alone])


def chain_with_closures():
    return np.concatenate([chain(), np.random.default_rng(0).integers(0, COUNT, (40, 2))])


def chain_with_beacons():
    """The last four variables have a factor in common with most of the others, and one has none with any."""
    most = np.random.default_rng(1).integers(0, COUNT - 4, (900, 1))
    beacon = np.random.default_rng(2).integers(COUNT - 4, COUNT, (900, 1))
    alone = np.array([[COUNT - 5, COUNT - 5]])
    return np.concatenate([chain()[: COUNT - 6], np.column_stack([most, beacon]), alone])


def everything_with_everything():
    return np.column_stack([side.ravel() for side in np.meshgrid(np.arange(60), np.arange(60))])


def nothing_with_anything():
    return np.column_stack([np.arange(COUNT), np.arange(COUNT)])


def one_alone():
    return np.zeros((1, 2), dtype=np.intp)


GRAPHS = (
    chain,
    chain_with_segments,
    chain_with_closures,
    chain_with_beacons,
    everything_with_everything,
    nothing_with_anything,
    one_alone,
)


def system(pairs):
    """A positive definite matrix with blocks for these pairs: dense, and in the slots of its elimination."""
    random, count = np.random.default_rng(3), pairs.max() + 1
    elimination = Elimination(count, *pairs.T)
    dense = np.zeros((count, 3, count, 3))
    for i, j in pairs:
        J = random.normal(size=(3, 6))
        square = J.T @ J
        for a, one in enumerate((i, j)):
            for b, other in enumerate((i, j)):
                dense[one, :, other] += square[3 * a : 3 * a + 3, 3 * b : 3 * b + 3]
    every = np.arange(count)
    dense[every, :, every] += np.eye(3)
    blocks = np.zeros((len(elimination.codes), 3, 3))
    first, second = np.divmod(elimination.codes[:-1], count + 1)
    blocks[:-1] = dense[first, :, second]
    return elimination, dense.reshape(3 * count, 3 * count), blocks, random.normal(size=(count, 3))


@pytest.mark.parametrize("pairs", GRAPHS)
def test_solution_determinant_and_inverse_are_those_of_the_dense_matrix(pairs):
    elimination, dense, blocks, right = system(pairs())
    found = Factorization(elimination, blocks, right)
    assert found.solution.ravel() == pytest.approx(np.linalg.solve(dense, right.ravel()), rel=1e-8, abs=1e-10)
    assert found.log_determinant == pytest.approx(np.linalg.slogdet(dense)[1] / 2, rel=1e-10)
    inverse = np.linalg.inv(dense)
    for i, j in pairs()[:200]:
        joint = inverse[np.ix_(*([3 * i, 3 * i + 1, 3 * i + 2, 3 * j, 3 * j + 1, 3 * j + 2],) * 2)]
        assert found.joint(np.array([[i, j]]))[0] == pytest.approx(joint, abs=1e-9)


def test_a_chain_takes_as_many_rounds_as_it_can_be_halved():
    assert len(Elimination(COUNT, *chain().T).rounds) < np.log2(COUNT)


def test_variables_that_most_others_are_bound_to_are_not_eliminated_with_them():
    assert Elimination(COUNT, *chain_with_beacons().T).border.tolist() == list(range(COUNT - 4, COUNT))


def test_an_indeterminate_matrix_is_refused():
    """A variable without information, at the beginning or in the root; and a negative one."""
    for pairs in (chain(), one_alone()):
        elimination, _, blocks, right = system(pairs)
        blocks[elimination.diagonal[0]] -= np.diag([0.0, 0.0, blocks[elimination.diagonal[0], 2, 2]])
        with pytest.raises(RuntimeError, match="do not determine"):
            Factorization(elimination, blocks, right)


def test_graphs_with_the_same_factors_share_the_places_of_their_blocks():
    steps, fixes, _ = drawn_from_the_model(240, seed=4)
    graph = WalkGraph(steps, fixes)
    at = graph.evaluate(graph.start)
    equations = graph.normal_equations(at)
    assert graph.rotated(1.0).normal_equations(at) is equations
    fewer = WalkGraph(steps, fixes[:-3])
    assert not equations.fits(fewer.evaluate(fewer.start))
