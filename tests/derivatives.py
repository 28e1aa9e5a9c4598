"""Derivatives of all factors of a graph, held against central differences: for tests."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest

STEP = 1e-6


def terms(block, state):
    """Per factor with rows: index, (key, derivatives ``(r, 3)``) of each variable, residuals ``(r,)``."""
    residual, blocks = block.weighted
    keys = [state.keys(symbol, rows).tolist() for symbol, rows in block.variables]
    bounds = np.searchsorted(block.row_of, np.arange(len(block) + 1)).tolist()
    for n, (a, b) in enumerate(pairwise(bounds)):
        if a < b:
            pairs = [(column[n], by[a:b]) for column, by in zip(keys, blocks, strict=True)]
            yield n, pairs, residual[a:b]


def random_state(graph, random, reach=6.0):
    """Any poses and other variables: a factor's derivative must hold away from the optimum too."""
    start = graph.start
    moved = {symbol: rows + random.normal(0, 0.3, rows.shape) for symbol, rows in start.arrays.items()}
    moved["x"] = random.uniform([-reach, -reach, -np.pi], [reach, reach, np.pi], start.poses.shape)
    moved["c"] = start.c + random.normal(0, [0.1, 0.05, 0.01], start.c.shape)
    return start.replaced(**moved)


def perturbed(state, symbol, row, axis, size):
    """One variable moved in GTSAM's local coordinates."""
    rows, move = state[symbol].copy(), size * np.eye(3)[axis]
    if symbol == "x":
        pose = gtsam.Pose2(*rows[row]).retract(move)
        rows[row] = pose.x(), pose.y(), pose.theta()
    else:
        rows[row] += move
    return state.replaced(**{symbol: rows})


def by_variable(block, jacobian, symbol, row):
    """The derivatives ``(m, 3)`` of a block's rows by one variable, whichever of a factor's variables it is."""
    total = np.zeros((len(block.residual), 3))
    for (own, rows), by in zip(block.variables, jacobian, strict=True):
        if own == symbol:
            total += np.where((rows[block.row_of] == row)[:, None], by, 0.0)
    return total


def assert_derivatives(graph, state):
    """Of the residuals of every block by every variable, and of the cost, whose robust weights are those of the loss.

    Walls are bilinear: STEP crosses a cell's border too rarely to matter.

    Returns the names of the blocks that have factors.
    """
    at = graph.evaluate(state)
    jacobians = [block.jacobian() for block in at.blocks]
    weighted = [block.weighted for block in at.blocks]
    for symbol, rows in state.arrays.items():
        for row in range(len(rows)):
            for axis in range(3):
                ahead, back = (graph.evaluate(perturbed(state, symbol, row, axis, s)) for s in (STEP, -STEP))
                slope = 0.0
                for n, block in enumerate(at.blocks):
                    where = f"{block.name} by {symbol}{row}, axis {axis}"
                    one, other = ahead.blocks[n], back.blocks[n]
                    assert one.row_of.tolist() == block.row_of.tolist() == other.row_of.tolist(), where
                    numeric = (one.residual - other.residual) / (2 * STEP)
                    analytic = by_variable(block, jacobians[n], symbol, row)[:, axis]
                    scale = 1 + float(np.abs(analytic).max(initial=0.0))
                    assert analytic / scale == pytest.approx(numeric / scale, abs=2e-5), where
                    residual, by = weighted[n]
                    slope += float(residual @ by_variable(block, by, symbol, row)[:, axis])
                costs = (ahead.cost - back.cost) / (2 * STEP)
                assert slope == pytest.approx(costs, rel=1e-4, abs=1e-3 + 1e-8 * at.cost / STEP * 1e-2), (
                    f"cost by {symbol}{row}"
                )
    return {block.name for block in at.blocks if len(block)}


def linear_graph(at):
    """All factors of an evaluation as GTSAM's linear graph, whitened and weighted: the oracle of our linear algebra."""
    graph, values = gtsam.GaussianFactorGraph(), at.state.to_values()
    for block in at.blocks:
        for _, pairs, residual in terms(block, at.state):
            unit = gtsam.noiseModel.Unit.Create(len(residual))
            if len(pairs) <= 3:  # as many as `add` takes
                graph.add(*(side for pair in pairs for side in pair), -residual, unit)
            else:
                graph.push_back(linear_factor(pairs, residual, unit).linearize(values))
    return graph


def linear_factor(pairs, residual, noise):
    """A factor of any number of variables with these keys and Jacobians."""

    def error(_, __, jacobians):
        if jacobians is not None:
            for n, (_, by) in enumerate(pairs):
                jacobians[n] = np.asfortranarray(by)
        return residual

    return gtsam.CustomFactor(noise, [key for key, _ in pairs], error)


def assert_gtsam_agrees(graph, state):
    """The exported graph has the same cost, and linearised factor by factor the same information, to rounding."""
    values, exported = state.to_values(), graph.to_gtsam()
    ordering = gtsam.Ordering.NaturalNonlinearFactorGraph(exported)
    at = graph.evaluate(state)
    ours, theirs = (g.hessian(ordering) for g in (linear_graph(at), exported.linearize(values)))
    for a, b in zip(ours, theirs, strict=True):
        assert a == pytest.approx(b, rel=1e-8, abs=1e-6)
    assert at.cost == pytest.approx(exported.error(values))
    assert graph.error(values) == pytest.approx(at.cost)
