"""Movement without steps: for how long a device moves as a carried one does while no step is recognised."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pdr_graph.priors import MOVEMENT, STAND
from pdr_graph.types import Array, Mask

PARTS = 10  # of a second, whose means are compared: vehicles and taps shake a device faster


@dataclass
class UnrecognisedMovement:
    """Adds up the time of long movements without a step. A step ends a movement, and so do `STAND.seconds` of rest.

    period: between samples [s]; lasting: time for which the present movement without a step has lasted [s]; rest: time
    since it was last seen [s]; magnitude, walking: ``(m,)`` the samples that do not fill a second yet.
    """

    period: float
    lasting: float = 0.0
    rest: float = 0.0
    magnitude: Array = field(default_factory=lambda: np.empty(0))
    walking: Mask = field(default_factory=lambda: np.empty(0, dtype=bool))

    def update(self, acceleration: Array, walking: Mask) -> float:
        """Add samples ``(n, 3)`` [m/s²]; returns the time that long movements without a step gained [s].

        walking: ``(n,)`` True during a step.
        """
        magnitude = np.append(self.magnitude, np.linalg.norm(acceleration, axis=1))
        walking = np.append(self.walking, walking)
        size = PARTS * max(1, round(1.0 / PARTS / self.period))
        whole, second = len(magnitude) // size * size, size * self.period
        spread = magnitude[:whole].reshape(-1, PARTS, size // PARTS).mean(axis=2).std(axis=1)
        stepped = walking[:whole].reshape(-1, size).any(axis=1)
        self.magnitude, self.walking = magnitude[whole:], walking[whole:]
        gained = 0.0
        for moves, steps in np.column_stack([spread > STAND.quiet, stepped]).tolist():
            before, self.rest = self.lasting, 0.0 if moves else self.rest + second
            goes_on = not steps and self.rest < STAND.seconds and (moves or before > 0)
            self.lasting = before + second if goes_on else 0.0
            if self.lasting >= MOVEMENT.longest:
                gained += self.lasting - (before if before >= MOVEMENT.longest else 0.0)
        return gained
