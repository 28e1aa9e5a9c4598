"""Bluetooth beacons as ranges: how loud each is tells how far it is, roughly.

Log-distance path loss: a beacon m at height HIGH above the phone and d metres aside is heard with

    rssi = P + a_m − 10 n log₁₀ √(d² + HIGH²) + k cos φ,      φ its bearing from where the walker faces

in the mean over a stretch of the walk, since the walker's body shades what is behind. Variables: q = (P, n, k) of the
phone and the building, b_m = (x, y, a_m) of each beacon: known to a metre, or not at all. What a place adds or takes
stays the same where nobody moves, so that levels are averaged over metres walked, not over seconds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from gtsam.symbol_shorthand import B, Q, X

from pdr_graph.estimation.observations import Rows
from pdr_graph.types import Array, Beacons, Fixes, Index, Sightings, Steps

STRETCH = 2.0  # [m] of the walk over which levels are averaged
LEVEL_SIGMA = 5.0  # [dB] of such a mean: reflections, people, furniture
HIGH = 1.5  # [m]
LOSS, LOSS_SIGMA = np.array([-62.0, 2.2, 3.0]), np.array([8.0, 0.5, 3.0])  # (P [dBm], n, k [dB]) of any phone
BIN, NEAREST = 15.0, 2.0  # [s], [m]
OWN_SIGMA = 4.0  # [dB] of a beacon's power
ANYWHERE = 30.0  # [m] about the walk where it was loudest, of a beacon that nobody surveyed


@dataclass(frozen=True)
class Levels:
    """How loud beacons were on stretches of a walk; ``l`` levels, ``m`` beacons.

    time: ``(l,)`` [s]; beacon: ``(l,)`` which; rssi: ``(l,)`` mean [dBm].
    label: of each beacon; position: ``(m, 2)`` [m], NaN where unknown; sigma: ``(m,)`` [m].
    """

    time: Array
    beacon: Index
    rssi: Array
    label: tuple[str, ...]
    position: Array
    sigma: Array

    def __len__(self) -> int:
        return len(self.time)

    def proximity(self) -> Fixes:
        """Fixes at the surveyed beacons that were loudest, one in BIN seconds: where to start without any other."""
        surveyed = np.flatnonzero(np.isfinite(self.position[self.beacon, 0]))
        order = surveyed[np.argsort(-self.rssi[surveyed], kind="stable")]
        chosen = order[np.unique(self.time[order] // BIN, return_index=True)[1]]
        distance = 10 ** ((LOSS[0] - self.rssi[chosen]) / (10 * LOSS[1]))
        near = np.maximum(NEAREST, distance)
        return Fixes(self.time[chosen], self.position[self.beacon[chosen]], near, ("",) * len(chosen))

    def elsewhere(self, which: list[int]) -> Levels:
        """The same; nobody knows where those beacons are."""
        position = self.position.copy()
        position[which] = np.nan
        return replace(self, position=position)

    def prior(self, place: Array) -> Array:
        """Of each beacon ``(m, 3)``: where it was surveyed, else at the ``place (l, 2)`` of its loudest."""
        b = np.column_stack([self.position, np.zeros(len(self.position))])
        for m in np.flatnonzero(np.isnan(self.position[:, 0])):
            own = np.flatnonzero(self.beacon == m)
            b[m, :2] = place[own[np.argmax(self.rssi[own])]]
        return b

    def heard(self, keyframe: Index, poses: Array, b: Array, q: Array) -> Rows:
        """The levels' factors; keyframe: ``(l,)``; poses ``(k + 1, 3)``; b ``(m, 3)``; q ``(3,)``."""
        pose, beacon = poses[keyframe], b[self.beacon]
        gap = beacon[:, :2] - pose[:, :2]
        square = np.sum(gap**2, axis=1) + HIGH**2
        ahead = np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], axis=1)
        left = ahead[:, ::-1] * [-1, 1]
        along, aside, distance = np.sum(ahead * gap, axis=1), np.sum(left * gap, axis=1), np.sqrt(square)
        expected = q[0] + beacon[:, 2] - 5 * q[1] * np.log10(square) + q[2] * along / distance

        loss = (-10 * q[1] / np.log(10) / square - q[2] * along / distance**3)[:, None]
        by_beacon = np.column_stack([loss * gap + q[2] * ahead / distance[:, None], np.ones(len(pose))])
        by_pose = -np.stack(
            [*(np.sum(v * by_beacon[:, :2], axis=1) for v in (ahead, left)), -q[2] * aside / distance], 1
        )
        by_loss = np.stack([np.ones(len(pose)), -5 * np.log10(square), along / distance], axis=1)
        by = np.stack([by_pose, by_beacon, by_loss], axis=1)[:, :, None] / LEVEL_SIGMA
        keys = np.stack([X(0) + keyframe, B(0) + self.beacon, np.full(len(pose), Q(0))], axis=1)
        return Rows((expected - self.rssi)[:, None] / LEVEL_SIGMA, keys, by, np.zeros(len(pose), dtype=bool))

    def believed(self, prior: Array, b: Array, q: Array) -> tuple[Rows, Rows]:
        """What was believed of beacons (`prior`, ``(m, 3)``) and of the path loss."""
        place = np.where(np.isnan(self.position[:, 0]), ANYWHERE, self.sigma)
        root = 1 / np.stack([place, place, np.full(len(b), OWN_SIGMA)], axis=1)
        of_b = Rows((b - prior) * root, B(0) + np.arange(len(b))[:, None], (np.eye(3) * root[:, :, None])[:, None])
        of_q = Rows(((q - LOSS) / LOSS_SIGMA)[None], np.array([[Q(0)]]), np.diag(1 / LOSS_SIGMA)[None, None])
        return of_b, of_q


def levels(sightings: Sightings, beacons: Beacons, steps: Steps) -> Levels:
    """How loud those beacons were that were heard, by stretches of the walk. beacons: in the frame of the walk."""
    known = {name: m for m, name in enumerate(beacons.name)}
    which = np.array([known.get(name, -1) for name in sightings.transmitter], dtype=np.intp)
    rows = (which >= 0) & (sightings.time >= steps.start) & (sightings.time <= steps.end)
    time, which, rssi = sightings.time[rows], which[rows], sightings.rssi[rows]
    walked = np.append(0.0, np.cumsum(steps.length))[np.searchsorted(steps.time, time)]
    stretch = (walked // STRETCH).astype(np.intp)

    _, group, count = np.unique(stretch * len(known) + which, return_inverse=True, return_counts=True)
    stretches, of_stretch, size = np.unique(stretch, return_inverse=True, return_counts=True)
    middle = np.bincount(of_stretch, time, minlength=len(stretches)) / size
    first = np.unique(group, return_index=True)[1]
    mean = np.bincount(group, rssi, minlength=len(count)) / count
    heard, beacon = np.unique(which[first], return_inverse=True)
    label = tuple(beacons.label[m] for m in heard)
    return Levels(middle[of_stretch[first]], beacon, mean, label, beacons.position[heard], beacons.sigma[heard])
