"""The smoothed track of a receiver's positions, with covariance.

A Kalman smoother, solved as one banded system (Barfoot, Tong and Särkkä, "Batch continuous-time trajectory estimation
as exactly sparse Gaussian process regression", 2014). The motion is a continuous-time correlated random walk, as in

    Johnson, London, Lea and Durban, "Continuous-time correlated random walk model for animal telemetry data",
    Ecology 89(5), 2008, Eqs. (1)–(5):      dp = v dt,      dv = −v/τ dt + s √(2/τ) dw

with speed s and time τ of the transport mode. Over long gaps the covariance grows accordingly. The error of a fix is
white noise plus a slowly varying offset, as in `gnss_bias`:

    z = p + σ g + n,        g a Gauss–Markov process of unit variance that is correlated over STANDING
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from pdr_graph.estimation.factors.losses import geman_mcclure_weight
from pdr_graph.priors import RECEIVERS, TRACK
from pdr_graph.types import Array, Index, Mask

SHORTEST = 0.1  # [s] least interval between knots: shorter ones make the information matrix ill-conditioned
NOWHERE = 1e-12  # [1/m²] prior information on the position of the first knot
P, V, G = range(3)  # position, velocity, offset of the receiver: the state of a knot, for each axis alike


@dataclass(frozen=True)
class GpsKnots:
    """The ``n`` knots of a track; most are fixes, and the first is one.

    time: ``(n,)`` [s]; position: ``(n, 2)`` [m], NaN where there is no fix; slow, white: ``(n,)`` standard deviations
    of a fix's error per axis [m].
    """

    time: Array
    position: Array
    slow: Array
    white: Array


@dataclass(frozen=True)
class Motion:
    """Motion model from knot to knot ``(n - 1,)``: speed per axis s [m/s], tau: correlation time τ [s].

    changed: True where the transport mode changes, so that the velocity is independent of the one before.
    """

    speed: Array
    tau: Array
    changed: Mask

    def of(self, which: Index) -> Motion:
        """The motion for subdivided intervals; which: ``(m,)`` original interval of each part, in order."""
        first = np.diff(which, prepend=-1) > 0
        return Motion(self.speed[which], self.tau[which], self.changed[which] & first)


@dataclass(frozen=True)
class SmoothTrack:
    """The track at every knot: position ``(n, 2)`` [m], velocity ``(n, 2)`` [m/s].

    weight: ``(n,)`` of each fix, 0–1; root: banded Cholesky factor of the information.
    """

    position: Array
    velocity: Array
    weight: Array
    root: Array

    def variances(self) -> Array:
        """Variances of position [m²] and velocity [m²/s²] per axis ``(n, 2)``, by Takahashi's sparse inverse."""
        knots = self.root.shape[1] // 3
        diagonal, next_ = np.zeros((knots, 3, 3)), np.zeros((knots - 1, 3, 3))
        for i in range(3):
            for j in range(3):
                if i >= j:
                    diagonal[:, i, j] = self.root[i - j, j::3]
                next_[:, i, j] = self.root[3 + i - j, j : 3 * (knots - 1) : 3]
        inverse = np.linalg.inv(diagonal)
        alone = inverse.transpose(0, 2, 1) @ inverse
        gain = next_ @ inverse[:-1]
        result, block = np.empty((knots, 2)), alone[-1]
        result[-1] = block[P, P], block[V, V]
        for k in range(knots - 2, -1, -1):
            block = alone[k] + gain[k].T @ block @ gain[k]
            result[k] = block[P, P], block[V, V]
        return result


def smooth_track(
    knots: GpsKnots, motion: Motion, scales: tuple[float, ...], weight: Array | None = None
) -> SmoothTrack:
    """The most probable track, with small weights for outliers.

    scales: widths of the robust loss in units of the white noise, from wide to narrow, so that the result does not
    depend on the start (graduated non-convexity). weight: initial weights ``(n,)``, 1 by default.
    """
    fixed = np.isfinite(knots.position[:, 0])
    information, offset = _prior(knots, motion)
    way = _solved(knots, information, offset, fixed * (1.0 if weight is None else weight))
    for scale in scales:
        off = np.hypot(*(knots.position - way[0].position - knots.slow[:, None] * way[1]).T)
        weight = np.where(fixed, geman_mcclure_weight(np.nan_to_num(off) / knots.white / scale), 0.0)
        way = _solved(knots, information, offset, weight)
    return way[0]


def _solved(gps: GpsKnots, prior_information: Array, to_next: Array, weight: Array) -> tuple[SmoothTrack, Array]:
    """The track with weights ``(n,)``, and the receiver's offset ``(n, 2)`` in units of ``slow``.

    prior_information, to_next: see `_prior`.
    """
    knots, trust = len(weight), weight / gps.white**2
    design = np.stack([np.ones(knots), np.zeros(knots), gps.slow], axis=1)
    information = prior_information + trust[:, None, None] * design[:, :, None] * design[:, None, :]
    origin = gps.position[0]  # the first knot is a fix; digits are lost far from it
    right = (trust[:, None] * design)[:, :, None] * np.nan_to_num(gps.position - origin)[:, None, :]
    band = np.zeros((6, 3 * knots))
    for i in range(3):
        for j in range(3):
            if i >= j:
                band[i - j, j::3] = information[:, i, j]
            band[3 + i - j, j : 3 * (knots - 1) : 3] = to_next[:, i, j]
    root = cholesky_banded(band, lower=True)
    state = cho_solve_banded((root, True), right.reshape(-1, 2)).reshape(knots, 3, 2)
    return SmoothTrack(origin + state[:, P], state[:, V], weight, root), state[:, G]


def _prior(gps: GpsKnots, motion: Motion) -> tuple[Array, Array]:
    """Information of motion and offset: of each knot ``(n, 3, 3)``, and of each with the one before."""
    span = np.maximum(np.diff(gps.time), SHORTEST)
    leads, kept, noise = _moves(span, motion)
    still = np.exp(-span / RECEIVERS.standing)
    F, inverse = np.zeros((2, len(span), 3, 3))
    F[:, P, P], F[:, P, V], F[:, V, V], F[:, G, G] = 1.0, leads, kept, still
    inverse[:, :2, :2] = np.linalg.inv(noise)
    inverse[:, G, G] = 1 / (1 - still**2)
    back = F.transpose(0, 2, 1) @ inverse
    diagonal = np.zeros((len(gps.time), 3, 3))
    diagonal[1:] += inverse
    diagonal[:-1] += back @ F
    diagonal[0] += np.diag([NOWHERE, np.append(motion.speed, TRACK.at_rest)[0] ** -2, 1.0])
    return diagonal, -back.transpose(0, 2, 1)


def _moves(span: Array, motion: Motion) -> tuple[Array, Array, Array]:
    """Motion over spans ``(m,)`` [s]: displacement per velocity [s], share of velocity kept, noise ``(m, 2, 2)``."""
    tau, variance = motion.tau, motion.speed**2
    kept = np.exp(-span / tau)
    leads = tau * (1 - kept)
    along = span / tau
    far = 2 * along - 3 + 4 * kept - kept**2
    far = np.where(along < 1e-2, 2 / 3 * along**3, far)  # its digits cancel
    pp, pv, vv = variance * tau**2 * far, variance * leads**2 / tau, variance * (1 - kept**2)
    first = np.where(motion.changed, variance, 0.0)  # of a velocity that begins with the interval
    pp, pv, vv = pp + first * leads**2, pv + first * leads * kept, vv + first * kept**2
    noise = np.stack([np.stack([pp, pv], axis=-1), np.stack([pv, vv], axis=-1)], axis=-2)
    return np.where(motion.changed, 0.0, leads), np.where(motion.changed, 0.0, kept), noise
