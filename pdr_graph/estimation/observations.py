"""Own factors of keyframes, whatever they observe: whitened errors with robust losses."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gtsam
import numpy as np

from pdr_graph.estimation.native import robustly
from pdr_graph.estimation.robust import HUBER_WIDTH, WILD_WIDTH, gripping, slipping
from pdr_graph.types import Array, Index, Mask


@dataclass(frozen=True)
class Rows:
    """Factors of one kind at one state.

    value: ``(n, r)`` errors, whitened.
    keys: ``(n, v)`` the variables of each; by: ``(n, v, r, 3)`` derivatives by each.
    wild: ``(n,)`` True where the error is so far off that it lets go, from ``slip`` [σ] on; None where the errors are
    Gaussian.
    """

    value: Array
    keys: Index
    by: Array
    wild: Mask | None = None
    slip: float = WILD_WIDTH

    @cached_property
    def weight(self) -> Array:
        """The share ``(n,)`` of each factor's information that is used."""
        if self.wild is None:
            return np.ones(len(self.value))
        sigmas = np.linalg.norm(self.value, axis=1)
        return np.where(self.wild, slipping(sigmas, self.slip), gripping(sigmas, HUBER_WIDTH))

    @cached_property
    def cost(self) -> float:
        """The losses' sum, as GTSAM counts it."""
        square = np.sum(self.value**2, axis=1)
        if self.wild is None:
            return 0.5 * float(square.sum())
        sigmas = np.sqrt(square)
        huber = np.where(sigmas > HUBER_WIDTH, HUBER_WIDTH * (sigmas - HUBER_WIDTH / 2), square / 2)
        geman_mcclure = 0.5 * self.slip**2 * square / (self.slip**2 + square)
        return float(np.where(self.wild, geman_mcclure, huber).sum())

    def add_to(self, graph: gtsam.GaussianFactorGraph) -> None:
        """As linear factors, weighted."""
        root, noise = np.sqrt(self.weight), gtsam.noiseModel.Unit.Create(self.value.shape[1])
        error, by = -root[:, None] * self.value, root[:, None, None, None] * self.by
        terms = [side for v in range(self.keys.shape[1]) for side in (self.keys[:, v].tolist(), by[:, v])]
        add: Any = graph.add  # its overloads are of one, two and three variables
        for factor in zip(*terms, error, strict=True):
            add(*factor, noise)

    def noise(self, n: int) -> gtsam.noiseModel.Base:
        """What GTSAM takes of one of them: whitened errors under its loss."""
        unit = gtsam.noiseModel.Unit.Create(self.value.shape[1])
        return unit if self.wild is None else robustly(unit, bool(self.wild[n]), wild_width=self.slip)
