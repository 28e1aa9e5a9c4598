"""Priors of a walk: its first pose, and the calibration of its walker."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from pdr_graph.estimation.ambiguity.hypothesis import Hypothesis, Proposal, Wording, wording_of
from pdr_graph.estimation.factors.base import (
    GAUSSIAN,
    AnyArray,
    Doubted,
    FactorBlock,
    Loss,
    Measurement,
    Remembered,
    State,
)
from pdr_graph.estimation.factors.chain import dead_reckoned, preintegrate
from pdr_graph.floor.building import Building
from pdr_graph.geometry import ANY_HEADING, as_complex, pose_rotation, rotation, wrap_angle
from pdr_graph.priors import MOTION, PRICES, WALKER, WALLS
from pdr_graph.types import Array, Steps

if TYPE_CHECKING:
    import gtsam

    from pdr_graph.estimation.factors.chain import Evaluation
    from pdr_graph.floor.plan import FloorPlan

FRAME_SIGMA = 1e-3  # [m, rad] of a start that defines the frame
WALKER_KIND = "calibration"  # the kind of the prior of the walker, and of the hypothesis about it
ANOTHER_WALKER, DRIFTS = "another walker", "gyroscope drifts"


@dataclass(frozen=True)
class Prior:
    """Prior of walker, gyro and walls.

    mean, sigma: of R_s [-], R_d [-], b [rad/s]. A tighter R_s bends walks instead of scaling them (design section 3);
        the sigma of b covers all sessions of docs/results/drift.md but one.
    correlation: of (R_s, R_d), (R_s, b), (R_d, b).
    change: standard deviation of their change from one segment to the next.
    wall_margin: clearance that people keep from walls, wall_sigma: its sigma [m].
    corridors: factors of the links that a plan draws, beside the walls, which contain the same information:
        "directions" of straight runs, "turns" at intersections.
    another: prior of another walker, if the steps were corrected by a profile, which may be of somebody else.
    usual: R_s of a usual walker; not 1 for steps that a profile has corrected.
    """

    mean: tuple[float, float, float] = (1.0, 1.0, 0.0)
    sigma: tuple[float, float, float] = field(default_factory=lambda: WALKER.sigma)
    change: tuple[float, float, float] = field(default_factory=lambda: WALKER.change)
    correlation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wall_margin: float = field(default_factory=lambda: WALLS.margin)
    wall_sigma: float = field(default_factory=lambda: WALLS.sigma)
    corridors: tuple[Literal["directions", "turns"], ...] = ()
    another: Prior | None = None
    usual: float = 1.0

    def __post_init__(self) -> None:
        """Raise ValueError for a sigma that is not positive and finite, or an unknown factor of corridors."""
        for name in ("sigma", "change"):
            if not all(np.isfinite(s) and s > 0 for s in getattr(self, name)):
                raise ValueError(f"Prior.{name}: found {getattr(self, name)}, expected standard deviations above 0")
        if not set(self.corridors) <= {"directions", "turns"}:
            raise ValueError(f"Prior.corridors: found {self.corridors!r}, expected 'directions', 'turns' or neither")

    @property
    def covariance(self) -> Array:
        """Covariance ``(3, 3)`` of (R_s, R_d, b)."""
        correlation = np.eye(3)
        correlation[np.triu_indices(3, 1)] = correlation.T[np.triu_indices(3, 1)] = self.correlation
        return correlation * np.outer(self.sigma, self.sigma)

    def on(self, floor: FloorPlan | Building | None) -> Prior:
        """Return the prior for a walk on `floor`. Raises ValueError for `corridors` of a plan that draws no links."""
        if self.corridors and floor and not any(len(plan.network) for plan in Building.around(floor).floors):
            expected = "areas of kind intersection, and corridors or lines of kind link between them, clear of walls"
            raise ValueError(f"Prior.corridors: found a plan without links, expected {expected}")
        return self

    def after(self, steps: Steps) -> Prior:
        """The prior for these steps: if most of their turns are unmeasured, positions say little of the stride."""
        if 2 * np.count_nonzero(steps.sigma_turn >= MOTION.unmeasured_turn) <= len(steps):
            return self
        return replace(self, sigma=(min(self.sigma[0], WALKER.blind), *self.sigma[1:]))

    @property
    def longest(self) -> float:
        """Largest mean of R_s, of this walker or of another; at least 1."""
        return max(1.0, *(prior.mean[0] for prior in (self, self.another) if prior is not None))


@dataclass(frozen=True)
class HeavyTail(Loss):
    """Negative logarithm of a mixture of two Gaussians: few gyroscopes drift much further than the others.

    −log[(1 − ν) N(s; 0, 1) + ν N(s; 0, far)] + constant, ν = WALKER.drifting. Its weight is the mean information of
    the two, each with its probability at s; it has one minimum.

    far: ``(n,)`` sigma of the rare density, in sigmas of the usual density.
    """

    far: Array

    def _logarithms(self, deviation: Array) -> tuple[Array, Array]:
        """Logarithms ``(n,)`` of both densities at deviations ``(n,)``, less that of the usual density at 0."""
        odds = WALKER.drifting / (1 - WALKER.drifting)
        return -0.5 * deviation**2, np.log(odds / self._far) - 0.5 * (deviation / self._far) ** 2

    @property
    def _far(self) -> Array:
        return np.maximum(self.far, 1.0)

    def weight(self, deviation: Array) -> Array:
        """Weights ``(n,)`` at deviations ``(n,)`` [σ]."""
        usual, rare = self._logarithms(deviation)
        with np.errstate(over="ignore"):
            return self._far**-2.0 + (1 - self._far**-2.0) / (1 + np.exp(rare - usual))

    def cost(self, deviation: Array) -> Array:
        """Costs ``(n,)`` at deviations ``(n,)`` [σ], 0 at 0."""
        (usual, rare), (_, at_0) = self._logarithms(deviation), self._logarithms(np.zeros(len(deviation)))
        larger = np.maximum(usual, rare)
        return np.log1p(np.exp(at_0)) - larger - np.log1p(np.exp(usual + rare - 2 * larger))


@dataclass(frozen=True, eq=False)
class CalibrationFactor(Remembered, Doubted):
    """Prior and slow change of stride, turn and gyro coefficients.

    r_0 = Σ₀^(−1/2) (c_0 − μ),  r_s = (c_s − c_{s−1}) / σ_change,  with λ(R_s) for R_s (`scaled`), of relative sigma

    [map-matching] Eqs. (4), (5), [calibration-walk] Sec. 3.3. The last row of the root of Σ₀⁻¹ is upper triangular: it
    is the prior of b alone, and has the loss of `HeavyTail`.

    begins: by row, mean ``(3,)`` and covariance ``(3, 3)`` of the segments that start a walk; change: standard
    deviations of the change from one segment to the next.
    another: prior of another walker, if the steps were corrected by a profile; assumed: True if this is that prior.
    drifting: the gyroscope is assumed to be one of those that drift far.
    """

    begins: Mapping[int, tuple[Array, Array]]
    change: tuple[float, float, float]
    another: Prior | None = None
    assumed: bool = False
    drifting: bool = False

    name: ClassVar[str] = WALKER_KIND

    def hypotheses(self, at: Evaluation, by_others: Callable[[], Evaluation] | None) -> Sequence[Proposal]:
        """The profile that corrected the steps is of another walker, who has the usual prior before that correction.

        Or the gyroscope drifts far, to either side, if no measurement says how far: the search may have missed that.
        """
        known = self.drifting or not self.begins or any(kind.determines_drift for kind in at.measurements)
        drifts = () if known else (self._drifting(at, drift) for drift in (-WALKER.far, WALKER.far))
        return (*self._of_another(), *drifts)

    def _drifting(self, at: Evaluation, drift: float) -> Proposal:
        """The gyroscope drifts far; the search starts at a drift [rad/s], with dead reckoning placed on the walk."""
        c = at.state.c.copy()
        c[:, 2] = drift
        track, heading = dead_reckoned(preintegrate(at.pieces, c[at.chain.segment]).delta[at.pieces.last])
        walk = as_complex(at.state.poses[:, :2])
        turn = np.angle(np.vdot(track - track.mean(), walk - walk.mean()))
        placed = walk.mean() + (track - track.mean()) * np.exp(1j * turn)
        poses = np.column_stack([placed.real, placed.imag, wrap_angle(heading + turn)])
        far = WALKER.far * self._priors[2][:, 2, 2]
        price = float(np.sum(np.log(far * (1 - WALKER.drifting) / WALKER.drifting)))
        start = at.state.replaced(x=poses, c=c)
        return Proposal(Hypothesis((self.name, DRIFTS), price=price), (replace(self, drifting=True),), start=start)

    def _of_another(self) -> Sequence[Proposal]:
        if self.another is None:
            return ()
        _, [profile, *_], _ = self._priors
        normaliser = float(np.linalg.slogdet(self.another.covariance)[1] - np.linalg.slogdet(profile)[1]) / 2
        claim = Hypothesis((self.name, ANOTHER_WALKER), price=PRICES.another_walker + normaliser * len(self.begins))
        return (Proposal(claim, (self,), another_walker=True),)

    def decisions(self) -> dict[str, AnyArray]:
        """Whether the walker is another, of whom `WalkGraph.decided` makes the graph; empty if not."""
        return {ANOTHER_WALKER: np.array([True])} if self.assumed else {}

    @cached_property
    def _priors(self) -> tuple[Array, Array, Array]:
        """Means ``(n, 3)``, covariances ``(n, 3, 3)`` and roots of the information of `scaled`, in order of rows."""
        distributions = [self.begins[s] for s in sorted(self.begins)]
        mean = np.array([mean for mean, _ in distributions]).reshape(-1, 3)
        covariance = np.array([covariance for _, covariance in distributions]).reshape(-1, 3, 3)
        root = np.linalg.cholesky(np.linalg.inv(covariance)).transpose(0, 2, 1).astype(float)
        root[:, :, 0] *= mean[:, :1]  # the sigma of λ is that of R_s by its mean
        return mean, covariance, root

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """A prior for each segment that starts a walk, a change factor for each other segment."""
        c, first = at.state.c, np.array(sorted(self.begins), dtype=np.intp)
        follows = np.arange(len(c)) > 0
        follows[first] = False
        later = np.flatnonzero(follows)
        number, sigma = at.state.number("c"), change_sigma(self.change, at.chain.pace[later])
        mean, _, root = self._priors
        begun, by_begun = scaled(c[first], mean)
        moved, by_moved = scaled(c, np.array([[1.0, 0.0, 0.0]]))

        def jacobian() -> list[Array]:
            diagonal = np.eye(3) / sigma[:, None]
            return [-diagonal * by_moved[later - 1], diagonal * by_moved[later]]

        prior = np.einsum("nij,nj->ni", root, begun)
        far = WALKER.far * root[:, 2, 2]
        of_drift = prior[:, 2:] / far[:, None] if self.drifting else prior[:, 2:]
        by_drift = root[:, 2:] / far[:, None, None] if self.drifting else root[:, 2:]
        return [
            FactorBlock.uniform(
                f"{self.name}.begin", prior[:, :2], [("c", first)], lambda: [(root * by_begun)[:, :2]], number[first]
            ),
            FactorBlock.uniform(
                f"{self.name}.drift",
                of_drift,
                [("c", first)],
                lambda: [by_drift],
                number[first],
                loss=GAUSSIAN if self.drifting else HeavyTail(far),
            ),
            FactorBlock.uniform(
                f"{self.name}.change",
                (moved[later] - moved[later - 1]) / sigma,
                [("c", later - 1), ("c", later)],
                jacobian,
                number[later],
            ),
        ]


def change_sigma(change: tuple[float, float, float], pace: Array) -> Array:
    """Standard deviations ``(s, 3)`` of the change to each segment; pace: ``(s,)``, see `Chain`.

    The model of strides is calibrated at one pace of a walker, and errs otherwise at another.
    """
    sigma = np.full((len(pace), 3), change)
    sigma[:, 0] = np.hypot(sigma[:, 0], WALKER.pace * pace)
    return sigma


def scaled(c: Array, mean: Array) -> tuple[Array, Array]:
    """Departures ``(n, 3)`` of calibrations from ``mean``, and their diagonal derivatives ``(n, 1, 3)``.

    Those of strides are shares, in log scale where shorter: λ(r) = log min(r, 1) + max(r, 1) − 1. No walk shrinks to
    nothing or turns back, nor does a long stride cost so little that an outlier is reached by it.
    """
    share, departure, slope = c[:, 0] / mean[:, 0], c - mean, np.ones((len(c), 1, 3))
    shorter = np.minimum(share, 1)
    with np.errstate(invalid="ignore"):  # a step of iSAM2 may turn a stride round: its cost is NaN, and it is not taken
        departure[:, 0] = np.log(shorter) + np.maximum(share, 1) - 1
    slope[:, 0, 0] = 1 / (mean[:, 0] * shorter)
    return departure, slope


@dataclass(frozen=True, eq=False)
class StartFactor(Measurement):
    """Prior of the first pose, where nothing else determines it.

    pose: ``(3,)``; sigmas: ``(3,)`` of x, y [m] and heading [rad], infinite where other measurements determine it.
    """

    pose: Array
    sigmas: Array

    name: ClassVar[str] = "start"

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """One factor, of x_0: r = (R₀ᵀ (p − p₀), wrap(θ − θ₀)) / σ."""
        first, pose = np.zeros(1, dtype=np.intp), at.state.poses[0]
        held = np.isfinite(self.sigmas)
        root = np.diag(1 / self.sigmas)[held]
        turned_back = np.eye(3)
        turned_back[:2, :2] = rotation(-self.pose[2])
        off = turned_back @ (pose - self.pose)
        off[2] = wrap_angle(off[2])

        def jacobian() -> list[Array]:
            return [(root @ turned_back @ pose_rotation(pose[2:])[0])[None]]

        def native(_: int) -> gtsam.NonlinearFactor:
            import gtsam

            pose_key, prior = int(at.state.keys("x", first)[0]), gtsam.Pose2(*self.pose)
            noise = gtsam.noiseModel.Isotropic.Sigma(1, float(self.sigmas[2]))
            return gtsam.PoseRotationPrior2D(pose_key, prior, noise)

        # GTSAM's prior of a whole pose uses the logarithm, in which the cost of a position depends on the heading error
        number, exported = at.state.number("x")[first], None if held.all() else native
        more = {"native": exported, "constants": np.append(self.pose, self.sigmas)[None]}
        return [FactorBlock.uniform(self.name, (root @ off)[None], [("x", first)], jacobian, number, **more)]


@wording_of(CalibrationFactor.name)
def _wording(hypothesis: Hypothesis) -> Wording:
    """The profile is of another walker, or the gyroscope drifts."""
    if hypothesis.kind[1] == DRIFTS:
        return Wording("gyroscope", "the gyroscope drifts far")  # nothing to check: the walk is corrected by it
    text = "the walker's profile does not fit"
    if hypothesis.estimate:
        stride, turn = hypothesis.estimate
        text += f": strides are {stride:.2f} and turns {turn:.2f} times those by the profile"
    return Wording("profile", text, "--walker: is the profile of this person, and learnt from good positions?")


def calibration_prior(
    begins: Mapping[int, tuple[Array, Array]], change: tuple[float, float, float], another: Prior | None = None
) -> CalibrationFactor:
    """Prior and slow change of the calibration; arguments as of `CalibrationFactor`."""
    return CalibrationFactor(begins, change, another)


def by_another_walker(kinds: Iterable[Measurement]) -> tuple[Measurement, ...]:
    """The kinds, that of the calibration marked as having the prior of another walker."""
    return tuple(replace(kind, assumed=True) if isinstance(kind, CalibrationFactor) else kind for kind in kinds)


def restarted(kinds: Iterable[Measurement], start: State) -> tuple[Measurement, ...]:
    """The kinds, the prior of the first heading centred on that of another start of the search."""
    heading = start.poses[0, 2]
    return tuple(
        replace(kind, pose=np.append(kind.pose[:2], heading)) if isinstance(kind, StartFactor) else kind
        for kind in kinds
    )


def first_heading_prior(heading: float) -> StartFactor:
    """A loose prior of the first heading [rad]: fixes determine the position."""
    return StartFactor(np.array([0.0, 0.0, heading]), np.array([np.inf, np.inf, ANY_HEADING]))


def first_pose_prior(pose: Array) -> StartFactor:
    """A prior of the first pose ``(3,)``, which defines the frame."""
    return StartFactor(pose, np.full(3, FRAME_SIGMA))


def start_prior(heading: float, plan_size: float | None, known_heading: bool) -> StartFactor:
    """The start at (0, 0) of a walk without fixes: it defines the frame, or is anywhere on a plan of this size [m].

    known_heading: a compass measures the direction.
    """
    place = FRAME_SIGMA if plan_size is None else plan_size
    turn = FRAME_SIGMA if plan_size is None and not known_heading else ANY_HEADING
    return StartFactor(np.array([0.0, 0.0, heading]), np.array([place, place, turn]))


def start_near(place: Array, reach: float, heading: float) -> StartFactor:
    """The start of a walk within reach [m] of a place ``(2,)``, in any direction; heading: where it is sought [rad]."""
    return StartFactor(np.append(place, heading), np.array([reach, reach, ANY_HEADING]))
