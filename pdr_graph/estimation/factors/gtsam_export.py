"""Export of a walk's factors to GTSAM, for its own optimisers and to check ours.

Factors that exist in GTSAM are GTSAM's own; the others are ``gtsam.CustomFactor`` behind a guard. A loss which GTSAM
does not have is part of the residual. So cost and gradient are those of the walk's graph.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import gtsam
import numpy as np

from pdr_graph.estimation.factors.base import POSE, FactorBlock, Measurement, State
from pdr_graph.estimation.factors.chain import Chain
from pdr_graph.types import Array

NOWHERE_FAR = 1e-6  # [σ] of a deviation, where a loss is half its weighted square


_unit_noise = cache(gtsam.noiseModel.Unit.Create)  # by number of rows


class FactorError(RuntimeError):
    """A factor's callback failed; without the check GTSAM would crash or continue silently."""


def to_gtsam(chain: Chain, measurements: Sequence[Measurement], start: State) -> gtsam.NonlinearFactorGraph:
    """All factors of a walk; ``start`` has all its variables."""
    whole, evaluated = gtsam.NonlinearFactorGraph(), _Evaluated(chain, measurements, start)
    for position, block in enumerate(evaluated.last.blocks):
        for n in range(len(block)):
            whole.add(block.native(n) if block.native else _custom(evaluated, position, block, n))
    return whole


class _Evaluated:
    """Evaluates the walk at the values of a callback, once for all factors at the same values."""

    def __init__(self, chain: Chain, measurements: Sequence[Measurement], start: State):
        self._chain, self._measurements = chain, measurements
        self.last = chain.evaluate(start, measurements)
        self._linearized = dict[int, _LinearizedBlock]()

    def block(self, values: gtsam.Values, position: int, variables: Sequence[_Variable]) -> _LinearizedBlock:
        """The block at ``position`` in the list of blocks; for a factor of these variables, since no other matters."""
        if any(variable.differs(values, self.last.state) for variable in variables):
            self.last.forget_blocks()
            self.last = self._chain.evaluate(self.last.state.updated(values), self._measurements)
            self._linearized.clear()
        if position not in self._linearized:
            self._linearized[position] = _LinearizedBlock(self.last.blocks[position])
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


class _LinearizedBlock:
    """Residuals and derivatives of the factors of a block, with the loss where GTSAM does not have it."""

    def __init__(self, block: FactorBlock):
        self._residual, self._jacobian = block.residual, list(block.jacobian())
        self._bounds = np.searchsorted(block.row_of, np.arange(len(block) + 1)).tolist()
        self._place = dict(zip(block.number.tolist(), range(len(block)), strict=True))
        self._deviation, self._weight, self._cost = block.deviation, block.weight, block.loss.cost(block.deviation)

    def factor(self, number: int, rows: int) -> tuple[Array, list[Array]]:
        """Residual ``(rows,)`` and derivatives ``(rows, 3)`` of one factor; 0 in rows that it does not have here."""
        n = self._place.get(number)
        here = slice(self._bounds[n], self._bounds[n + 1]) if n is not None else slice(0, 0)
        residual, by = np.zeros(rows), [np.zeros((rows, 3)) for _ in self._jacobian]
        for target, source in zip((residual, *by), (self._residual, *self._jacobian), strict=True):
            target[: here.stop - here.start] = source[here]
        return residual, by

    def with_loss(self, number: int, rows: int) -> tuple[Array, list[Array]]:
        """As `factor`, for r' = r √(2 ρ(s)) / s: half its square is the loss ρ of the deviation s, the norm of r."""
        residual, by = self.factor(number, rows)
        if (n := self._place.get(number)) is None:
            return residual, by
        deviation, weight = abs(float(self._deviation[n])), float(self._weight[n])
        if deviation < NOWHERE_FAR:
            return np.sqrt(weight) * residual, [np.sqrt(weight) * block for block in by]
        scale = np.sqrt(2 * max(float(self._cost[n]), 0.0)) / deviation
        along = residual / deviation  # its slope is ρ' / √(2 ρ), with the weight w = ρ' / s
        more = weight / scale - scale if scale else 0.0
        return scale * residual, [scale * block + more * np.outer(along, along @ block) for block in by]


def _custom(evaluated: _Evaluated, position: int, block: FactorBlock, n: int) -> gtsam.CustomFactor:
    """Factor ``n`` of ``block``, which is at ``position`` in the list of blocks."""
    state, number = evaluated.last.state, int(block.number[n])
    rows = int(np.sum(block.row_of == n) if block.most_rows is None else block.most_rows[n])
    variables = [
        _Variable(int(state.keys(symbol, which)[n]), symbol, int(which[n])) for symbol, which in block.variables
    ]
    unit = _unit_noise(rows)
    robust = block.loss.noise(n, unit)

    def linearized(values: gtsam.Values) -> tuple[Array, list[Array]]:
        now = evaluated.block(values, position, variables)
        return now.factor(number, rows) if robust else now.with_loss(number, rows)

    return guarded(block.name, robust or unit, [variable.key for variable in variables], linearized)


def guarded(
    name: str,
    noise: gtsam.noiseModel.Base,
    keys: Sequence[int],
    linearized: Callable[[gtsam.Values], tuple[Array, list[Array]]],
) -> gtsam.CustomFactor:
    """A ``gtsam.CustomFactor`` whose callback cannot corrupt the solver.

    linearized: values → residual ``(r,)`` and one block ``(r, 3)`` per key. The guard checks shapes and finiteness and
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
