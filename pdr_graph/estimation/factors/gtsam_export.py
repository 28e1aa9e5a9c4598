"""Export of a walk's factors to GTSAM, for its own optimisers and to check ours.

Factors that exist in GTSAM are GTSAM's own; the others are ``gtsam.CustomFactor`` behind a guard. A loss which GTSAM
does not have is part of the residual, see `_LossRows.with_loss`. So each factor has the cost, the gradient and
the information matrix that it has in our linear system, and GTSAM's marginals at the optimum are the covariances of
that walk. The covariance of an estimate's trajectory also spans the other walks that explain the measurements.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import chain as concatenated
from typing import NamedTuple

import gtsam
import numpy as np

from pdr_graph.estimation.factors.base import POSE, FactorBlock, Measurement, Searching, State, insert
from pdr_graph.estimation.factors.chain import Chain
from pdr_graph.types import Array

ROUNDING = 1e-9  # of a cost, relative and absolute

unit_noise = cache(gtsam.noiseModel.Unit.Create)  # by number of rows


class FactorError(RuntimeError):
    """A factor's callback failed; without the check GTSAM would crash or continue silently."""


def to_gtsam(chain: Chain, measurements: Sequence[Measurement], start: State) -> gtsam.NonlinearFactorGraph:
    """All factors of a walk; ``start`` has all its variables."""
    whole, evaluated = gtsam.NonlinearFactorGraph(), _Evaluated(chain, measurements, start)
    for position, block in enumerate(evaluated.last.blocks):
        for n in range(len(block)):
            whole.add(block.native(n) if block.native else _custom(evaluated, position, block, n))
    return whole


@dataclass(frozen=True)
class GtsamIncrement:
    """What a keyframe adds to a smoother of GTSAM: for ``update`` of `IncrementalFixedLagSmoother`, or of `ISAM2`.

    time: of the keyframe [s]; factors; values: of variables that are new, at the start of the graph; timestamps: times
    [s] of the variables of these factors, by key.
    """

    time: float
    factors: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    timestamps: dict[int, float]


def increments(chain: Chain, measurements: Sequence[Measurement], start: State) -> Iterator[GtsamIncrement]:
    """The factors of `to_gtsam`, keyframe by keyframe: each comes with the last of its variables.

    The first increment is that of all keyframes until a position is measured, which no smoother could place.
    """
    evaluated, since = _Evaluated(chain, measurements, start), dict[int, int]()
    factors = [list[tuple[int, int]]() for _ in chain.time]  # block and factor, by keyframe
    blocks = evaluated.last.blocks
    bound = [np.stack([start.keys(symbol, rows) for symbol, rows in block.variables], axis=1) for block in blocks]
    keyframe = {int(pose): k for k, pose in enumerate(start.keys(POSE).tolist())}
    for of_factors in bound:  # a variable begins with the first factor that binds it to a keyframe
        for keys in of_factors.tolist():
            at = max((keyframe[each] for each in keys if each in keyframe), default=-1)
            for each in keys if at >= 0 else ():
                since[each] = keyframe.get(each, min(at, since.get(each, at)))
    for position, of_factors in enumerate(bound):
        for n, keys in enumerate(of_factors.tolist()):
            factors[max(since.get(each, 0) for each in keys)].append((position, n))
    new = [list[tuple[str, int, Array]]() for _ in chain.time]
    for symbol, rows in start.arrays.items():
        for variable_key, row in zip(start.keys(symbol).tolist(), rows, strict=True):
            new[since.get(variable_key, 0)].append((symbol, variable_key, row))
    placing = {kind.name for kind in measurements if kind.determines_position}
    placed = [k for k, of in enumerate(factors) if any(blocks[position].name in placing for position, _ in of)]
    begin = placed[0] + 1 if placed else 1
    for first, last in zip([0, *range(begin, len(new))], range(begin, len(new) + 1), strict=True):
        time, graph = float(chain.time[last - 1]), gtsam.NonlinearFactorGraph()
        values, timestamps = gtsam.Values(), dict[int, float]()
        for symbol, variable_key, row in concatenated.from_iterable(new[first:last]):
            insert(values, symbol, variable_key, row)
            timestamps[variable_key] = time
        for position, n in concatenated.from_iterable(factors[first:last]):
            block = blocks[position]
            graph.add(block.native(n) if block.native else _custom(evaluated, position, block, n))
            timestamps |= dict.fromkeys((each for each in bound[position][n].tolist() if each not in keyframe), time)
        yield GtsamIncrement(time, graph, values, timestamps)


class _Evaluated:
    """Evaluates the walk at the values of a callback, once for all factors at the same values."""

    def __init__(self, chain: Chain, measurements: Sequence[Measurement], start: State):
        at = chain.evaluate(start, measurements)
        self._measurements = [kind.bound_at(at) if isinstance(kind, Searching) else kind for kind in measurements]
        self._chain, self.last = chain, chain.evaluate(start, self._measurements)
        self._linearized = dict[int, _LossRows]()

    def block(self, values: gtsam.Values, position: int, variables: Sequence[_Variable]) -> _LossRows:
        """The block at ``position`` in the list of blocks; for a factor of these variables, since no other matters."""
        if any(variable.differs(values, self.last.state) for variable in variables):
            self.last.forget_blocks()
            self.last = self._chain.evaluate(self.last.state.updated(values), self._measurements)
            self._linearized.clear()
        if position not in self._linearized:
            self._linearized[position] = _LossRows(self.last.blocks[position])
        return self._linearized[position]


class _Variable(NamedTuple):
    """A variable of a factor: its GTSAM key, symbol, and row of the state."""

    key: int
    symbol: str
    row: int

    def differs(self, values: gtsam.Values, state: State) -> bool:
        """True unless the variable is the same in both."""
        if self.symbol == POSE:
            pose = values.atPose2(self.key)
            value = [pose.x(), pose.y(), pose.theta()]
        else:
            value = values.atVector(self.key).tolist()
        return value != state[self.symbol][self.row].tolist()


class BlockRows:
    """The factors of a block at one state, as rows of residual and derivatives ``(…, 1 + 3 v)`` by v variables.

    most: rows of each factor at any state.
    """

    def __init__(self, block: FactorBlock):
        self.rows = np.column_stack([block.residual, *block.jacobian()])
        self._bounds: list[int] = np.searchsorted(block.row_of, np.arange(len(block) + 1)).tolist()
        self.most: list[int] = (np.diff(self._bounds) if block.most_rows is None else block.most_rows).tolist()

    def of(self, n: int) -> Array:
        """The rows ``(r, 1 + 3 v)`` of a factor."""
        return self.rows[self._bounds[n] : self._bounds[n + 1]]

    def filled(self, n: int | None, rows: int) -> Array:
        """The rows of a factor, and zeros for those that it does not have here ``(rows, 1 + 3 v)``; None for none."""
        part = self.rows[:0] if n is None else self.of(n)
        return part if len(part) == rows else np.pad(part, ((0, rows - len(part)), (0, 0)))


class _LossRows(BlockRows):
    """The factors of a block by their numbers, with the loss where GTSAM does not have it."""

    def __init__(self, block: FactorBlock):
        super().__init__(block)
        self.place = dict(zip(block.number.tolist(), range(len(block)), strict=True))
        self._deviation, self._weight, self._cost = block.deviation, block.weight, block.loss.cost(block.deviation)

    def with_loss(self, n: int | None, rows: int) -> Array:
        """As `filled`, under a loss ρ of the deviation s whose weight w never rises with |s|; the last row is added.

        The rows are √w r with derivatives √w J, as in our linear system; the last, √(2 ρ − w s²) with derivative 0,
        completes the cost. So information and gradient are ours, although the derivative of a single row is not its
        own: the same holds for GTSAM's robust noise models.
        """
        if n is None:
            return self.filled(None, rows)
        root, missing = np.sqrt(self._weight[n]), 2 * self._cost[n] - self._weight[n] * self._deviation[n] ** 2
        if missing < -ROUNDING * (1 + self._cost[n]):
            raise FactorError(f"the weight of a loss rises to {self._weight[n]:.3g} at {self._deviation[n]:.3g} sigma")
        whitened = root * self.filled(n, rows)
        whitened[-1, 0] = np.sqrt(max(missing, 0.0))
        return whitened


def _custom(evaluated: _Evaluated, position: int, block: FactorBlock, n: int) -> gtsam.CustomFactor:
    """Factor ``n`` of ``block``, which is at ``position`` in the list of blocks."""
    state, number = evaluated.last.state, int(block.number[n])
    rows = int(np.sum(block.row_of == n) if block.most_rows is None else block.most_rows[n])
    variables = [
        _Variable(int(state.keys(symbol, which)[n]), symbol, int(which[n])) for symbol, which in block.variables
    ]
    noise = block.loss.noise(n, unit_noise(rows))

    def linearized(values: gtsam.Values) -> tuple[Array, list[Array]]:
        now = evaluated.block(values, position, variables)
        part = now.filled(now.place.get(number), rows) if noise else now.with_loss(now.place.get(number), rows + 1)
        return part[:, 0], np.split(part[:, 1:], len(variables), axis=1)

    return guarded(block.name, noise or unit_noise(rows + 1), [variable.key for variable in variables], linearized)


def guarded(
    name: str,
    noise: gtsam.noiseModel.Base,
    keys: Sequence[int],
    linearized: Callable[[gtsam.Values], tuple[Array, list[Array]]],
) -> gtsam.CustomFactor:
    """A ``gtsam.CustomFactor`` whose callback cannot corrupt the solver.

    linearized: values → residual ``(r,)`` and a block ``(r, 3)`` per key. The guard checks shapes and finiteness and
    fills every block: in gtsam 4.3.0 an unset block crashes the process, a wrong shape is accepted silently, and a NaN
    ends the optimiser silently.
    """
    rows = noise.dim()

    def callback(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        residual, blocks = linearized(values)
        shapes = [residual.shape, *(b.shape for b in blocks)]
        if shapes != [(rows,)] + [(rows, 3)] * len(keys):
            raise FactorError(f"{name} factor: shapes {shapes} for {rows} rows and {len(keys)} keys")
        if not all(np.isfinite(a).all() for a in (residual, *blocks)):
            raise FactorError(f"{name} factor: not finite at {[gtsam.DefaultKeyFormatter(k) for k in keys]}")
        if jacobians is not None:
            for n, block in enumerate(blocks):
                jacobians[n] = np.asfortranarray(block)
        return residual

    return gtsam.CustomFactor(noise, list(keys), callback)
