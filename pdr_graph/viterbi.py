"""The most probable sequence of hidden states (Viterbi 1967)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pdr_graph.types import Array, Index


def viterbi(costs: Sequence[Array] | Array, moves: Sequence[Array] | Array) -> tuple[Index, Array]:
    """The cheapest states ``(…, n)``, and what they cost together ``(…,)``.

    costs: ``(…, s)`` of each state, n times; moves: ``(…, s, s)`` from one state to another, n − 1 times. Costs are
    minus log-probabilities. Of sequences that cost the same, the one of lower states.
    """
    total, came = costs[0], list[Index]()
    for cost, move in zip(costs[1:], moves, strict=True):
        through = total[..., :, None] + move
        came.append(through.argmin(axis=-2))
        total = through.min(axis=-2)
        total += cost
    best = total.argmin(axis=-1)
    shape, rows = best.shape, np.arange(best.size)
    states = [best.ravel()]
    for before in reversed(came):
        states.append(before.reshape(len(rows), -1)[rows, states[-1]])
    return np.stack(states[::-1], axis=-1).reshape(*shape, -1), total.min(axis=-1)
