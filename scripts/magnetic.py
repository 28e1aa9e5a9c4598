"""What a map of the magnetic field is worth: one real floor, each walk with a map of the others."""

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from conditions import smoothed, with_steps
from scipy.linalg import cholesky, solve_triangular
from scipy.ndimage import uniform_filter1d
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from tables import publish, table

import pdr_graph as pdr
from pdr_graph import smooth
from pdr_graph.apps.bench.data_sets import walks_of
from pdr_graph.apps.report.evaluation import in_region, pair, stated_covariance
from pdr_graph.gait.steps import gait_signals
from pdr_graph.geometry import interpolate, length_along, rotation
from pdr_graph.io.indoor_location import WAYPOINT_SIGMA
from pdr_graph.types import Array, Fixes, Index

FLOOR = "site2/F6"
PAUSE = 120.0  # [s] between recordings of two walks; shorter ones are pieces of one walk
SURVEYED = 0.5  # [m] sigma of the waypoints by which a map is learnt
SPACING = 1.0  # [m] of samples along a walk
TURNING = 12.0  # [s] over which the phone keeps its direction in the hand
NEAR = 1.5  # [m] from another walk within which a place is mapped
COVERED = 0.4  # share of a walk that is mapped, from which it is one of the table
REACH, SIGNAL, OFFSET = 2.0, 0.45, 0.3  # of the Gaussian process: [m]; shares of the variance, a constant's of a piece
CELL, WIDEST = 0.5, 25.0  # [m] of the grid on which a map is evaluated; largest search
TURNS, SCALES = np.radians([-8, -4, 0, 4, 8]), (0.94, 1.0, 1.06)  # of dead reckoning within a sequence
TURN, SCALE = np.radians(5), 0.05  # their sigmas
SEQUENCES = 10, 20, 40  # [m]
TEMPER, WRONG = 0.15, 0.3  # exponent of the likelihood, as neighbouring errors are alike; share of wrong sequences


@dataclass(frozen=True)
class Samples:
    """The field at each SPACING of walks: piece and walk numbers, time [s], position [m], heading [rad], field
    ``(n, 3)`` along the plan's axes [µT], covariance ``(n, 2, 2)`` of the position [m²].
    """

    piece: Index
    walk: Index
    time: Array
    position: Array
    heading: Array
    field: Array
    covariance: Array

    def __getitem__(self, which):
        return Samples(*(values[which] for values in vars(self).values()))


def along(evidence, track, piece=0, walk=0):
    """The samples along a track. The phone is held flat: its heading follows that of the track within TURNING."""
    gaits = gait_signals(evidence.walk)
    time = np.concatenate([gait.attitude.time for gait in gaits])
    at, ahead = np.empty((len(time), 3)), np.empty((len(time), 3))
    for gait in gaits:
        which = np.searchsorted(time, gait.attitude.time)
        magnetic = evidence.walk.magnetometer
        level = gait.attitude.R_world_device
        at[which] = level.apply(interpolate(gait.attitude.time, magnetic.time, magnetic.values))
        ahead[which] = level.apply([0, 1, 0])
    off = np.interp(time, track.time, np.unwrap(track.heading)) - np.arctan2(ahead[:, 1], ahead[:, 0])
    samples, second = (round(s / np.median(np.diff(time))) for s in (TURNING, 0.25))
    turn = np.angle(uniform_filter1d(np.cos(off), samples) + 1j * uniform_filter1d(np.sin(off), samples))
    level = (at[:, 0] + 1j * at[:, 1]) * np.exp(1j * turn)
    at = uniform_filter1d(np.column_stack([level.real, level.imag, at[:, 2]]), second, axis=0)
    way = length_along(track.position)
    when = np.interp(np.arange(0, way[-1], SPACING), way + 1e-9 * np.arange(len(way)), track.time)
    heading = np.interp(when, track.time, np.unwrap(track.heading))
    number = np.full(len(when), piece), np.full(len(when), walk)
    place = interpolate(when, track.time, track.position)
    return Samples(*number, when, place, heading, interpolate(when, time, at), stated_covariance(track, when))


class FieldMap:
    """The field of samples in a box, by a Gaussian process per axis, whose kernel is exp(-distance / REACH)."""

    def __init__(self, samples, low, high):
        near = samples[((samples.position > low - 3 * REACH) & (samples.position < high + 3 * REACH)).all(axis=1)]
        self.low, axes = low, [np.arange(a, b, CELL) for a, b in zip(low, high, strict=True)]
        cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        usual, spread = samples.field.mean(axis=0), samples.field.var(axis=0)
        self.constant, spread = OFFSET * spread, (1 - OFFSET) * spread  # [µT²] of a piece, of what remains
        self.mean, self.variance = np.full((*cells.shape[:2], 3), usual), np.full((*cells.shape[:2], 3), spread)
        if not len(near.time):
            return
        mapped = KDTree(near.position).query(cells)[0] < 2 * REACH
        own, to = (SIGNAL * np.exp(-cdist(near.position, p) / REACH) for p in (near.position, cells[mapped]))
        own += OFFSET * (near.piece[:, None] == near.piece) + (1 - SIGNAL - OFFSET) * np.eye(len(own))
        root = cholesky(own, lower=True)
        known, gain = (solve_triangular(root, right, lower=True) for right in (near.field - usual, to))
        self.mean[mapped] += gain.T @ known
        self.variance[mapped] *= 1 - (gain**2).sum(axis=0)[:, None] / (1 - OFFSET)

    def log_likelihood(self, sequence, offsets):
        """Of a sequence of samples at offsets ``(k, 2)`` of its place [m], ``(k,)``; turned and scaled a little."""
        middle, found = sequence.position.mean(axis=0), []
        for turn in TURNS:
            for scale in SCALES:
                place = (sequence.position - middle) @ rotation(turn).T * scale + middle + offsets[:, None]
                cell = np.round((place - self.low) / CELL).astype(int).clip(0, np.array(self.mean.shape[:2]) - 1)
                field = np.column_stack([sequence.field[:, :2] @ rotation(turn).T, sequence.field[:, 2]])
                weight = 1 / self.variance[cell[..., 0], cell[..., 1]]
                off, total = field - self.mean[cell[..., 0], cell[..., 1]], weight.sum(axis=1)
                squares = (weight * off**2).sum(axis=1) - (weight * off).sum(axis=1) ** 2 / (total + 1 / self.constant)
                squares += np.log1p(self.constant * total) - np.log(weight).sum(axis=1)
                prior = (turn / TURN) ** 2 + ((scale - 1) / SCALE) ** 2
                found.append(-0.5 * (TEMPER * squares.sum(axis=1) + prior))
        return np.logaddexp.reduce(found)


def disc(radius, spacing=CELL):
    """Offsets ``(k, 2)`` in a circle."""
    axis = np.arange(-radius, radius + spacing / 2, spacing)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return grid[np.hypot(*grid.T) <= radius]


@dataclass(frozen=True)
class Lines:
    """Distances from lines: n·p = offset [m], normal (n, 2), sigma (n,) [m]."""

    time: Array
    offset: Array
    normal: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class LineFactor(pdr.Measurement):
    """r = (n·p − offset) / σ, as in CONTRIBUTING."""

    lines: Lines
    number: Index
    keyframe: Index = field(metadata=pdr.KEYFRAME)
    name = "magnetic sequences"

    @classmethod
    def of(cls, lines, steps, prior, number):
        return cls(lines, number, np.full(len(number), -1))

    def keyframe_times(self):
        return self.lines.time

    def bind(self, chain):
        return replace(self, keyframe=chain.keyframe(self.lines.time))

    def factors(self, at):
        which = np.flatnonzero(self.keyframe >= 0)
        keyframe, normal, sigma = self.keyframe[which], self.lines.normal[which], self.lines.sigma[which, None]
        pose = at.state.poses[keyframe]
        residual = (np.sum(normal * pose[:, :2], axis=1) - self.lines.offset[which])[:, None] / sigma
        cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])

        def jacobian():
            ahead, left = normal[:, 0] * cos + normal[:, 1] * sin, normal[:, 1] * cos - normal[:, 0] * sin
            return [(np.stack([ahead, left, 0 * ahead], axis=1) / sigma)[:, None]]

        return [pdr.FactorBlock.uniform(self.name, residual, [("x", keyframe)], jacobian, self.number[which])]


pdr.register(Lines, LineFactor)


def sequences(samples, length):
    """Parts of a walk of so many metres, without overlap."""
    return [samples[begin : begin + length] for begin in range(0, len(samples.time) - length + 1, length)]


def lines_of(samples, field_map, length):
    """What the field says beyond an estimate, at most two lines for each sequence of its walk; None without any.

    Each sequence is moved over the region of the estimate. Their product with the estimate's normal distribution has
    the moments of the posterior (expectation propagation, Minka 2001).
    """
    rows = []
    for part in sequences(samples, length):
        middle = length // 2
        prior = part.covariance[middle] + 0.05 * np.eye(2)  # no narrower than the grid
        largest = float(np.clip(2.5 * np.sqrt(np.linalg.eigvalsh(prior)[-1]), 3.0, WIDEST))
        offsets = disc(largest, max(CELL, largest / 24))
        log_prior = -0.5 * np.einsum("ki,ij,kj->k", offsets, np.linalg.inv(prior), offsets)
        before, likelihood = np.exp(log_prior), field_map.log_likelihood(part, offsets)
        before, likelihood = before / before.sum(), np.exp(likelihood - likelihood.max())
        after = (1 - WRONG) * before * likelihood / (before @ likelihood) + WRONG * before
        (mean_0, inverse_0), (mean, inverse) = (moments(offsets, weight) for weight in (before, after))
        added, across = np.linalg.eigh(inverse - inverse_0)
        pull = inverse @ mean - inverse_0 @ mean_0
        for information, normal in zip(added, across.T, strict=True):
            if information > 0.02 * np.trace(inverse_0):  # else it says nothing
                offset = normal @ part.position[middle] + normal @ pull / information
                rows.append((part.time[middle], offset, normal, information**-0.5))
    return Lines(*map(np.array, zip(*rows, strict=True))) if rows else None


def moments(offsets, weight):
    """Mean ``(2,)`` and inverse covariance of weighted offsets."""
    mean = weight @ offsets
    off = offsets - mean
    return mean, np.linalg.inv(np.einsum("k,ki,kj->ij", weight, off, off))


class Floor:
    """The walks of FLOOR: evidence, truth and number of the walk of each piece; its samples by all its waypoints."""

    def __init__(self, data):
        found = [with_steps(read()) for name, read in walks_of("malls", data) if name.startswith(f"{FLOOR} ")]
        found.sort(key=lambda walk: walk.evidence.walk.epoch)
        start, end = (np.array([w.evidence.walk.epoch + w.truth.time[at] for w in found]) for at in (0, -1))
        self.walks, self.number = found, np.cumsum(np.append(False, start[1:] - end[:-1] > PAUSE))
        self.tracks = [smoothed(replace(w, evidence=known(w))).trajectory for w in found]
        parts = [
            along(w.evidence, t, n, self.number[n]) for n, (w, t) in enumerate(zip(found, self.tracks, strict=True))
        ]
        self.samples = Samples(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))
        nearest = np.full(len(self.samples.time), np.inf)
        for walk in np.unique(self.number):
            inside = self.samples.walk == walk
            nearest[inside] = KDTree(self.samples.position[~inside]).query(self.samples.position[inside])[0]
        self.mapped = nearest < NEAR

    def map_for(self, piece, samples, around):
        """The map of the other walks within a distance [m] of an estimate."""
        others = self.samples[self.samples.walk != self.number[piece]]
        low, high = samples.position.min(axis=0), samples.position.max(axis=0)
        return FieldMap(others, low - around, high + around)


def known(walk):
    """The evidence of a walk with its truth as fixes."""
    truth = walk.truth
    return replace(walk.evidence, fixes=Fixes(truth.time, truth.position, np.full(len(truth), SURVEYED)))


def invariants(samples):
    """Norm, vertical and horizontal part ``(3, n)`` of the field [µT], whatever the heading of the phone."""
    return np.stack([np.linalg.norm(samples.field, axis=1), samples.field[:, 2], np.hypot(*samples.field[:, :2].T)])


BINS = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0)  # [m]


def repeatable(floor):
    """Correlation of the field at two walks by their distance, and what remains of its spread."""
    samples, rows = floor.samples, []
    pairs = KDTree(samples.position).query_pairs(BINS[-1], output_type="ndarray")
    pairs = pairs[samples.walk[pairs[:, 0]] != samples.walk[pairs[:, 1]]]
    first, second = samples[pairs[:, 0]], samples[pairs[:, 1]]
    apart, along_way = np.hypot(*(first.position - second.position).T), np.cos(first.heading - second.heading)
    parts = invariants(first), invariants(second)
    for name, which in {"same": along_way > 0.7, "opposite": along_way < -0.7}.items():
        for low, high in pairwise(BINS):
            one, other = (part[:, which & (apart >= low) & (apart < high)] for part in parts)
            both = [np.corrcoef(np.append(a, b), np.append(b, a))[0, 1] for a, b in zip(one, other, strict=True)]
            left = [f"{value:.1f}" for value in (one - other).std(axis=1) / np.sqrt(2)]
            cells = [f"{a:.2f}; {b}" for a, b in zip(both, left, strict=True)]
            rows.append([name, f"{low}–{high}", one.shape[1], *cells])
    spread = invariants(samples).std(axis=1).tolist()
    rows.append(["whole floor", "—", len(samples.time), *(f"0; {value:.1f}" for value in spread)])
    header = ["direction", "apart [m]", "pairs", "norm: correlation; rest [µT]", "vertical", "horizontal"]
    publish("results/magnetic.md", "magnetic field", table(header, rows))


RADII = 5.0, 10.0  # [m] of the search


def matching(floor):
    """How far from the truth a sequence fits best, where four fifths of it are mapped."""
    rows, offsets = [], disc(RADII[-1])
    distance = np.hypot(*offsets.T)
    found = {length: [] for length in SEQUENCES}
    for piece in range(len(floor.walks)):
        inside = floor.samples.piece == piece
        samples, mapped = floor.samples[inside], floor.mapped[inside]
        parts = [(n, slice(begin, begin + n)) for n in SEQUENCES for begin in range(0, len(mapped) - n + 1, 5)]
        parts = [(length, part) for length, part in parts if mapped[part].mean() >= 0.8]
        field_map = floor.map_for(piece, samples, RADII[-1]) if parts else None
        for length, part in parts:
            fit = field_map.log_likelihood(samples[part], offsets)
            found[length].append([distance[np.argmax(np.where(distance <= r, fit, -np.inf))] for r in RADII])
    for length, best in found.items():
        for radius, off in zip(RADII, np.transpose(best), strict=True):
            cells = [f"{100 * np.mean(off < near):.0f} % ({100 * (near / radius) ** 2:.0f})" for near in (1, 2)]
            rows.append([length, f"{radius:.0f}", len(off), *cells, f"{np.median(off):.1f} ({radius / 2**0.5:.1f})"])
    header = [
        "sequence [m]",
        "search radius [m]",
        "sequences",
        "best within 1 m (by chance)",
        "within 2 m",
        "median [m]",
    ]
    publish("results/magnetic.md", "magnetic matching", table(header, rows))


COARSE, INTERVAL = 8.0, 10.0  # [m] sigma per axis of simulated fixes; [s] between them


def coarse(floor, piece):
    """The evidence of a piece with independent fixes of its waypoints' track, as of coarse Wi-Fi."""
    track, random = floor.tracks[piece], np.random.default_rng(piece)
    time = np.arange(track.time[0] + 1, track.time[-1], INTERVAL)
    place = interpolate(time, track.time, track.position) + random.normal(0, COARSE, (len(time), 2))
    return replace(floor.walks[piece].evidence, fixes=Fixes(time, place, np.full(len(time), COARSE)))


def worth(floor):
    """The error of smoothed walks with the plan, without and with the lines of their sequences."""
    rows, scores = [], {"without": [], "with": []}
    shares = np.array([floor.mapped[floor.samples.piece == piece].mean() for piece in range(len(floor.walks))])
    for piece in np.flatnonzero(shares >= COVERED).tolist():
        evidence, truth = coarse(floor, piece), floor.walks[piece].truth
        track = smooth(evidence.graph()).trajectory
        scores["without"].append(score(track, truth))
        samples = along(evidence, track)
        if lines := lines_of(samples, floor.map_for(piece, samples, WIDEST), SEQUENCES[0]):
            track = smooth(replace(evidence, measurements=(*evidence.measurements, lines)).graph()).trajectory
        scores["with"].append(score(track, truth))
    for which, found in scores.items():
        off, inside = np.concatenate(found).T
        middle = " / ".join(f"{value:.2f}" for value in np.percentile(off, [50, 75, 95]))
        rows.append([which, len(found), middle, f"{off.mean():.2f}", f"{100 * inside.mean():.0f} %"])
    header = ["magnetic map", "pieces", "CE50 / 75 / 95 [m]", "mean [m]", "in 90 % region"]
    publish("results/magnetic.md", "magnetic walks", table(header, rows))


def score(track, truth):
    """Error at each waypoint [m], and 1.0 where it is in the stated 90 % region."""
    pairs = pair(track, truth)
    covariance = stated_covariance(track, pairs.time) + WAYPOINT_SIGMA**2 * np.eye(2)
    off = pairs.estimate - pairs.truth
    return np.column_stack([np.hypot(*off.T), in_region(pairs, covariance)])


def magnetic(data):
    """The tables."""
    floor = Floor(data)
    repeatable(floor)
    matching(floor)
    worth(floor)
