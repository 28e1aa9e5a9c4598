"""The same walks by what a user would pick instead, in one run: time, and how far each is from the truth.

Every rival has the steps, the fixes and the sigmas that the graph has, and the textbook's model of its kind. What it is
given beyond that is said in its docstring.
"""

import sys
import time
from pathlib import Path

import gtsam
import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from gtsam.symbol_shorthand import C, X
from scipy.linalg import solveh_banded
from scipy.optimize import least_squares
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu
from tables import table

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

from synthetic_walks import PERIOD, walk_and_truth

from pdr_graph import WalkGraph, dead_reckon, smooth
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.kalman import kalman_filter
from pdr_graph.geometry import wrap_angle
from pdr_graph.priors import MOTION

SEEDS = 3  # walks
LENGTHS = (2000, 7000)  # steps
LONGEST_OF_SLOW = 2000  # steps: theirs grows with the square of them
EVERY = 30  # steps between fixes
START_SIGMAS = np.array([3.0, 3.0, 0.3])  # [m, m, rad] of the first pose, for those that need to be told one
PRIOR = Prior()
HUBER = gtsam.noiseModel.mEstimator.Huber.Create(2.45)
SETTLED, MOST_ITERATIONS = 1e-5, 30  # of our own Gauss–Newton on scipy


def rival_rows():
    """Time and error of each on walks of two lengths, and as ratios of ours."""
    rows = []
    for n in LENGTHS:
        walks = [walk_and_truth(n, EVERY, seed) for seed in range(SEEDS)]
        ours = None
        for name, method in METHODS.items():
            if method in SLOW and n > LONGEST_OF_SLOW:
                continue
            took, errors = zip(*(_run(method, *one) for one in walks), strict=True)
            seconds, error = float(np.median(took)), np.concatenate(errors)
            ours = ours or seconds
            middle, most = np.percentile(error, [50, 95])
            rows.append([n, name, f"{seconds:.3f}", f"{seconds / ours:.2g}", f"{middle:.2f}", f"{most:.2f}"])
        limit = min(_seconds(banded_limit, n)[0] for _ in range(5))
        rows.append(
            [n, "LAPACK's banded solve of such a chain, four times", f"{limit:.4f}", f"{limit / ours:.2g}", "", ""]
        )
    header = ["steps", "method", "CPU [s]", "ratio", "median error [m]", "95 % [m]"]
    return table(header, rows)


def _run(method, steps, fixes, truth):
    """CPU time [s] and the errors at the ends of steps ``(n,)`` [m]; the better of two runs."""
    (first, position), *again = [_seconds(method, steps, fixes) for _ in range(1 if method in SLOW else 2)]
    took = min([first, *(seconds for seconds, _ in again)])
    return took, np.hypot(*(position[: len(steps) + 1] - truth.position[: len(steps) + 1]).T)


def _seconds(function, *arguments):
    began = time.process_time()
    result = function(*arguments)
    return time.process_time() - began, result


def ours(steps, fixes):
    """The graph, with the covariance of every step."""
    return smooth(WalkGraph(steps, fixes)).trajectory.position


def our_filter(steps, fixes):
    """The causal filter of `kalman_filter`, which builds the graph to read it."""
    return kalman_filter(WalkGraph(steps, fixes)).trajectory.position


def custom_factors(steps, fixes):
    """Our model as GTSAM's tutorials write it: a Python CustomFactor per step, LevenbergMarquardtOptimizer."""
    graph, start = gtsam.NonlinearFactorGraph(), _dead_reckoned(steps)
    noise = _step_noise(steps)
    for k, (length, turn) in enumerate(zip(steps.length, steps.turn, strict=True)):
        graph.add(gtsam.CustomFactor(noise, [X(k), X(k + 1), C(k // 100)], _step_error(k, length, turn)))
    for factor in _fix_factors(steps, fixes):
        graph.add(factor)
    segments = (len(steps) - 1) // 100 + 1
    believed = gtsam.noiseModel.Diagonal.Sigmas(np.array(PRIOR.sigma))
    graph.add(gtsam.PriorFactorVector(C(0), np.array(PRIOR.mean), believed))
    change = gtsam.noiseModel.Diagonal.Sigmas(np.array(PRIOR.change))
    for s in range(segments - 1):
        graph.add(gtsam.BetweenFactorVector(C(s), C(s + 1), np.zeros(3), change))
    for s in range(segments):
        start.insert(C(s), np.array(PRIOR.mean))
    return _positions(gtsam.LevenbergMarquardtOptimizer(graph, start).optimize())


def between_factors(steps, fixes):
    """The kinder tutorial: BetweenFactorPose2 per step, no Python in the loop, and no calibration to learn."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in (*_between(steps), *_fix_factors(steps, fixes)):
        graph.add(factor)
    return _positions(gtsam.LevenbergMarquardtOptimizer(graph, _dead_reckoned(steps)).optimize())


def incremental(steps, fixes):
    """The same by iSAM2, an update and the newest pose per step, as its tutorials do. It is told a first pose, since
    it cannot begin without.
    """
    isam, graph, start = gtsam.ISAM2(), gtsam.NonlinearFactorGraph(), gtsam.Values()
    first, sigmas = gtsam.Pose2(), gtsam.noiseModel.Diagonal.Sigmas(START_SIGMAS)
    graph.add(gtsam.PriorFactorPose2(X(0), first, sigmas))
    start.insert(X(0), first)
    at = {int(k): factor for k, factor in zip(_rows(steps, fixes), _fix_factors(steps, fixes), strict=True)}
    pose = first
    for k, factor in enumerate(_between(steps)):
        graph.add(factor)
        if k + 1 in at:
            graph.add(at[k + 1])
        start.insert(X(k + 1), pose.compose(factor.measured()))
        isam.update(graph, start)
        pose = isam.calculateEstimatePose2(X(k + 1))
        graph.resize(0)
        start.clear()
    return _positions(isam.calculateEstimate())


class Walker(ExtendedKalmanFilter):
    """State x, y, θ, stride scale; a step at a time."""

    def predict_x(self, u=0):
        """A step ``u`` of length and turn."""
        length, turn = u
        x, y, theta, scale = self.x
        course = theta + turn / 2
        self.x = np.array(
            [x + scale * length * np.cos(course), y + scale * length * np.sin(course), theta + turn, scale]
        )


def extended_filter(steps, fixes):
    """filterpy's extended Kalman filter over x, y, θ and a stride scale, then Rauch, Tung and Striebel by hand, since
    filterpy's own takes linear motion for granted. It is told a first pose.
    """
    ekf = Walker(4, 2)
    ekf.x, ekf.P = np.array([0.0, 0.0, 0.0, 1.0]), np.diag(np.append(START_SIGMAS, PRIOR.sigma[0]) ** 2)
    at = dict(zip(_rows(steps, fixes).tolist(), range(len(fixes)), strict=True))
    H, change = np.eye(2, 4), PRIOR.change[0] / 10  # a hundredth of a segment's variance each step
    known, expected, motions = [(ekf.x, ekf.P)], [], []
    for k, (length, turn) in enumerate(zip(steps.length, steps.turn, strict=True)):
        _, _, theta, scale = ekf.x
        ahead = np.array([np.cos(theta + turn / 2), np.sin(theta + turn / 2)])
        aside = np.array([-ahead[1], ahead[0]])
        F, G = np.eye(4), np.zeros((4, 4))
        F[:2, 2], F[:2, 3] = scale * length * aside, length * ahead
        G[:2, 0], G[:2, 1], G[:2, 2], G[2, 2], G[3, 3] = ahead, aside, scale * length * aside / 2, 1.0, 1.0
        sigmas = np.array([steps.sigma_length[k], MOTION.lateral, steps.sigma_turn[k], change])
        ekf.F, ekf.Q = F, G * sigmas**2 @ G.T
        ekf.predict(u=(length, turn))
        expected.append((ekf.x.copy(), ekf.P.copy()))
        motions.append(F)
        if (fix := at.get(k + 1)) is not None:
            R = fixes.sigma[fix] ** 2 * np.eye(2)
            ekf.update(fixes.position[fix], lambda x: H, lambda x: x[:2], R=R)
        known.append((ekf.x.copy(), ekf.P.copy()))
    smoothed, spread = known[-1]
    states = [smoothed]
    for (x, P), (ahead, before), F in zip(known[-2::-1], expected[::-1], motions[::-1], strict=True):
        gain = P @ F.T @ np.linalg.inv(before)
        smoothed, spread = x + gain @ (smoothed - ahead), P + gain @ (spread - before) @ gain.T
        states.append(smoothed)
    return np.array(states[::-1])[:, :2]


def trust_region(steps, fixes):
    """scipy's `least_squares` with the sparse Jacobian given: `trf` by LSMR, Huber's loss for the fixes left out."""
    problem = Problem(steps, fixes)
    found = least_squares(
        problem.error, problem.start, jac=problem.jacobian, method="trf", tr_solver="lsmr", x_scale="jac"
    )
    return problem.positions(found.x)


def gauss_newton(steps, fixes):
    """The same problem with five lines of Gauss–Newton and SuperLU, by someone who has done it before."""
    problem = Problem(steps, fixes)
    x = problem.start
    for _ in range(MOST_ITERATIONS):
        J = problem.jacobian(x)
        move = splu((J.T @ J).tocsc()).solve(-(J.T @ problem.error(x)))
        x = x + move
        if np.abs(move).max() < SETTLED:
            break
    return problem.positions(x)


class Problem:
    """Poses ``(n + 1, 3)`` and (R_s, R_d, b) of every hundred steps as one vector; errors and their derivatives."""

    def __init__(self, steps, fixes):
        self.n, self.segment = len(steps), np.arange(len(steps)) // 100
        self.length, self.turn, self.place = steps.length, steps.turn, fixes.position
        self.at, self.weight = _rows(steps, fixes), 1 / fixes.sigma
        self.scale = 1 / np.stack([steps.sigma_length, np.full(self.n, MOTION.lateral), steps.sigma_turn], axis=1)
        self.first, self.segments = 3 * (self.n + 1), int(self.segment[-1]) + 1
        track = dead_reckon(steps)
        poses = np.column_stack([track.position, track.heading])[: self.n + 1]
        self.start = np.append(poses, np.tile(PRIOR.mean, self.segments))

    def positions(self, x):
        return x[: self.first].reshape(-1, 3)[:, :2]

    def _parts(self, x):
        poses, c = x[: self.first].reshape(-1, 3), x[self.first :].reshape(-1, 3)
        R_s, R_d, b = c[self.segment].T
        angle = R_d * self.turn + b * PERIOD
        course = poses[:-1, 2] + angle / 2
        gap = np.diff(poses[:, :2], axis=0)
        cos, sin = np.cos(course), np.sin(course)
        along, aside = cos * gap[:, 0] + sin * gap[:, 1], cos * gap[:, 1] - sin * gap[:, 0]
        return poses, c, R_s, angle, cos, sin, along, aside

    def error(self, x):
        poses, c, R_s, angle, _, _, along, aside = self._parts(x)
        steps = np.stack([along - R_s * self.length, aside, wrap_angle(np.diff(poses[:, 2]) - angle)], axis=1)
        fixes = self.weight[:, None] * (poses[self.at, :2] - self.place)
        believed, change = (c[0] - PRIOR.mean) / PRIOR.sigma, np.diff(c, axis=0) / PRIOR.change
        return np.concatenate([(self.scale * steps).ravel(), fixes.ravel(), believed, change.ravel()])

    def jacobian(self, x):
        _, _, _, _, cos, sin, along, aside = self._parts(x)
        k, zero, one = np.arange(self.n), np.zeros(self.n), np.ones(self.n)
        by_angle = np.stack([aside, -along, zero], axis=1)  # of the course
        by = {
            0: [-cos, sin, zero],
            1: [-sin, -cos, zero],
            2: [aside, -along, -one],
            3: [cos, -sin, zero],
            4: [sin, cos, zero],
            5: [zero, zero, one],
        }
        rows, columns, values = [], [], []

        def put(row, column, value):
            rows.append(row)
            columns.append(column)
            values.append(value)

        def put_steps(column, value):
            for axis in range(3):
                put(3 * k + axis, column, self.scale[:, axis] * value[axis])

        for offset, value in by.items():
            put_steps(3 * k + offset, value)
        c = self.first + 3 * self.segment
        put_steps(c, [-self.length, zero, zero])
        for axis, share in ((1, self.turn), (2, PERIOD * one)):
            half = by_angle * share[:, None] / 2
            put_steps(c + axis, [half[:, 0], half[:, 1], -share])
        row, f = 3 * self.n, np.arange(len(self.at))
        for axis in range(2):
            put(row + 2 * f + axis, 3 * self.at + axis, self.weight)
        row, s = row + 2 * len(f), np.arange(self.segments - 1)
        for axis in range(3):
            put(np.array([row + axis]), np.array([self.first + axis]), np.array([1 / PRIOR.sigma[axis]]))
            change = np.full(len(s), 1 / PRIOR.change[axis])
            put(row + 3 + 3 * s + axis, self.first + 3 * s + axis, -change)
            put(row + 3 + 3 * s + axis, self.first + 3 * (s + 1) + axis, change)
        rows, columns, values = (np.concatenate(part) for part in (rows, columns, values))
        return coo_array((values, (rows, columns)), shape=(row + 3 * self.segments, len(x))).tocsr()


def banded_limit(n):
    """LAPACK's banded Cholesky of a chain of n poses and four iterations: what no general solver can beat."""
    band = np.zeros((6, 3 * n))
    band[0], band[1:, :] = 4.0, -0.1
    for _ in range(4):
        solveh_banded(band, np.ones(3 * n), lower=True, overwrite_ab=False, check_finite=False)


def _step_error(k, length, turn):
    """The callback of step ``k``."""

    def error(this, values, jacobians):
        d = values.atPose2(X(k)).between(values.atPose2(X(k + 1)))
        R_s, R_d, b = values.atVector(C(k // 100))
        angle = R_d * turn + b * PERIOD
        forward = length * np.array([np.cos(angle / 2), np.sin(angle / 2), 0.0])
        left = length * np.array([-np.sin(angle / 2), np.cos(angle / 2), 0.0])
        if jacobians is not None:
            jacobians[1] = np.eye(3, order="F")
            jacobians[1][:2, :2] = d.rotation().matrix()
            jacobians[0] = np.asfortranarray(-jacobians[1] @ d.inverse().AdjointMap())
            by_turn = R_s * left / 2 + np.array([0, 0, 1.0])
            jacobians[2] = np.asfortranarray(-np.column_stack([forward, by_turn * turn, by_turn * PERIOD]))
        return np.array([d.x(), d.y(), wrap_angle(d.theta() - angle)]) - R_s * forward

    return error


def _between(steps):
    """A BetweenFactorPose2 for each step."""
    noise = _step_noise(steps)
    for k, (length, turn) in enumerate(zip(steps.length.tolist(), steps.turn.tolist(), strict=True)):
        move = gtsam.Pose2(length * np.cos(turn / 2), length * np.sin(turn / 2), turn)
        yield gtsam.BetweenFactorPose2(X(k), X(k + 1), move, noise)


def _fix_factors(steps, fixes):
    for k, place, sigma in zip(_rows(steps, fixes).tolist(), fixes.position, fixes.sigma, strict=True):
        noise = gtsam.noiseModel.Robust.Create(HUBER, gtsam.noiseModel.Isotropic.Sigma(2, sigma))
        yield gtsam.PoseTranslationPrior2D(X(k), place, noise)


def _step_noise(steps):
    sigmas = np.array([steps.sigma_length[0], MOTION.lateral, steps.sigma_turn[0]])
    return gtsam.noiseModel.Diagonal.Sigmas(sigmas)


def _rows(steps, fixes):
    """The pose that each fix is of: at the end of the step in which it was taken."""
    return np.searchsorted(steps.time, fixes.time) + 1


def _dead_reckoned(steps):
    start, track = gtsam.Values(), dead_reckon(steps)
    for k in range(len(steps) + 1):
        start.insert(X(k), gtsam.Pose2(*track.position[k], track.heading[k]))
    return start


def _positions(values):
    return gtsam.utilities.extractPose2(values)[:, :2]


METHODS = {
    "**pdr_graph, with covariance**": ours,
    "pdr_graph, causal filter": our_filter,
    "GTSAM: a CustomFactor per step, LevenbergMarquardtOptimizer": custom_factors,
    "GTSAM: a BetweenFactorPose2 per step, LevenbergMarquardtOptimizer": between_factors,
    "GTSAM: iSAM2, an update per step": incremental,
    "filterpy: extended Kalman filter and RTS": extended_filter,
    "scipy: least_squares, sparse Jacobian, trf with LSMR": trust_region,
    "scipy: Gauss–Newton by hand, SuperLU": gauss_newton,
}
SLOW = (custom_factors, incremental, trust_region)

if __name__ == "__main__":
    print(rival_rows())
