"""Export of a walk's factors to GTSAM, for its own optimisers and to check ours.

Factors that exist in GTSAM are GTSAM's own; the others are ``gtsam.CustomFactor`` behind a guard.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import gtsam
import numpy as np

from pdr_graph.estimation.factors.base import UNIT, FactorBlock, Measurement, State
from pdr_graph.estimation.factors.chain import Chain, Evaluation
from pdr_graph.types import Array


class FactorError(RuntimeError):
    """A factor's callback failed; without the check GTSAM would crash or continue silently."""


def to_gtsam(chain: Chain, measurements: Sequence[Measurement], start: State) -> gtsam.NonlinearFactorGraph:
    """All factors of a walk; ``start`` has all its variables."""
    whole, evaluated = gtsam.NonlinearFactorGraph(), _Evaluated(chain, measurements, start)
    for position, block in enumerate(evaluated.at_start.blocks):
        for n in range(len(block)):
            whole.add(block.native(n) if block.native else _custom(evaluated, position, block, n))
    return whole


class _Evaluated:
    """Evaluates the walk at the values of a callback, once for all factors at the same values."""

    def __init__(self, chain: Chain, measurements: Sequence[Measurement], start: State):
        self._chain, self._measurements = chain, measurements
        self.at_start = self._last = chain.evaluate(start, measurements)

    def at(self, values: gtsam.Values) -> Evaluation:
        """All factors at ``values``."""
        state = self.at_start.state.updated(values)
        if any((state[symbol] != self._last.state[symbol]).any() for symbol in state.arrays):
            self._last = self._chain.evaluate(state, self._measurements)
        return self._last


def _custom(evaluated: _Evaluated, position: int, block: FactorBlock, n: int) -> gtsam.CustomFactor:
    """Factor ``n`` of ``block``, which is at ``position`` in the list of blocks."""
    state, number = evaluated.at_start.state, int(block.number[n])
    rows = int(np.sum(block.row_of == n) if block.most_rows is None else block.most_rows[n])
    keys = [int(state.keys(symbol, which)[n]) for symbol, which in block.variables]

    def linearized(values: gtsam.Values) -> tuple[Array, list[Array]]:
        now = evaluated.at(values).blocks[position]
        at = np.flatnonzero(now.number == number)
        rows_of_factor = now.row_of == at[0] if len(at) else np.zeros(len(now.residual), dtype=bool)
        residual, by = np.zeros(rows), [np.zeros((rows, 3)) for _ in keys]
        count = int(rows_of_factor.sum())
        residual[:count] = now.residual[rows_of_factor]
        for target, source in zip(by, now.jacobian(), strict=True):
            target[:count] = source[rows_of_factor]
        return residual, by

    return guarded(block.name, block.loss.noise(n, UNIT[rows]), keys, linearized)


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
