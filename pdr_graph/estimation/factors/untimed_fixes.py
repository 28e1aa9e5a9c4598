"""Places that a walk passed at an unknown time: a receipt, a photo, a card payment, a room of a calendar.

With c(τ) the walk between its keyframes, the residual of a place z is its distance from the walk,

    r = min_τ ‖c(τ) − z‖ / σ,      earliest ≤ τ ≤ latest

so that the time is solved together with the walk (the profile likelihood of τ). Where the nearest point lies within an
interval, r is perpendicular to the walk: the place says nothing about how far along it somebody was. A place that is
not on the walk, as of somebody else's receipt, loses its weight (Geman and McClure's loss).

The nearest point is a local choice. Places whose times are open fit a walk in several places and directions, so that
the search starts from each: with the dead-reckoned track z(τ), turned by φ and scaled by s, each place votes for the
displacements z_place − s exp(iφ) z(τ) of all its times (generalised Hough transform, Ballard 1981, *Generalizing the
Hough transform to detect arbitrary shapes*, Pattern Recognition 13), and fixes with their one time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from scipy.ndimage import gaussian_filter

from pdr_graph.estimation.factors.base import FactorBlock, Itemized, Refined, RobustLoss, Searching, Stage, State
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.geometry import as_complex, as_points, peaks, rotation
from pdr_graph.priors import INITIAL, PRICES, REPORTS
from pdr_graph.types import TABLE, Array, Index, Mask, Steps, UntimedFixes, UntimedFixReport, take

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.chain import Chain, Evaluation
    from pdr_graph.estimation.factors.fixes import FixFactor

KEYFRAMES_EVERY = 2.0  # [s]: a walk is straight in between
ROUGHLY = 3.0  # times the sigma, in the rough stage
TURNS, SCALES = np.radians(np.arange(-180.0, 180.0, 6.0)), (0.88, 1.0, 1.14)  # of the track, that vote
FEWEST = 0.05  # votes of a place that is not on the walk, of 1
EACH, MOST_STARTS = 3, 30  # starts of each turn and scale; of all
MOST_FIXES = 60  # of a receiver, that vote
MOST_CELLS = 300  # of the votes, along an axis
OPEN, OFTEN = 4.0, 3  # [σ²] by which another time is worse at most; intervals between two that are reported
INSIDE = 1e-6  # of an interval, its ends


@dataclass(frozen=True, eq=False)
class UntimedFixFactor(Itemized, Refined, Searching):
    """Places without a time, see above.

    untimed: ``n`` of them; number: ``(n,)`` permanent numbers; moment: ``(t,)`` keyframes that they need [s]; time:
    ``(k + 1,)`` of all keyframes [s]; rough: in the rough stage; interval: ``(n,)`` in which each place was passed, the
    nearest if None.
    """

    untimed: UntimedFixes
    number: Index
    moment: Array = field(metadata=TABLE)
    time: Array = field(metadata=TABLE)
    rough: bool = False
    interval: Index | None = None

    name: ClassVar[str] = "untimed"
    determines_position: ClassVar[bool] = True

    @classmethod
    def of(cls, places: UntimedFixes, steps: Steps, prior: Prior, number: Index | None = None) -> Self:
        """The places whose times may lie in the recording."""
        number = np.arange(len(places)) if number is None else number
        inside = np.flatnonzero((places.time[:, 0] <= steps.end) & (places.time[:, 1] >= steps.start))
        moment = np.arange(steps.start, steps.end, KEYFRAMES_EVERY)
        return cls(take(places, inside), number[inside], moment, np.empty(0))

    @property
    def places(self) -> Array:
        """Positions ``(n, 2)`` of the places [m]."""
        return self.untimed.position

    def keyframe_times(self) -> Array:
        """Times all along the walk."""
        return self.moment if len(self.places) else np.empty(0)

    def bind(self, chain: Chain) -> Self:
        """Keep the times of the keyframes."""
        return replace(self, time=chain.time)

    def staged(self, stage: Stage) -> Self:
        """Wider in the rough stage."""
        return replace(self, rough=stage is Stage.ROUGH)

    def nearest(self, poses: Array) -> tuple[Index, Array]:
        """The interval of the nearest point of the walk ``(n,)`` to each place, and where in it ``(n,)``, 0 to 1."""
        share, distance = self._passed(poses)
        interval = np.argmin(distance, axis=1) if self.interval is None else self.interval
        return interval, share[np.arange(len(share)), interval]

    def _passed(self, poses: Array) -> tuple[Array, Array]:
        """Where in each interval ``(n, k)`` it is nearest to each place, 0 to 1, and how near [m]; else infinite."""
        walk, place = as_complex(poses[:, :2]), as_complex(self.places)
        along, since = np.diff(walk), place[:, None] - walk[:-1]
        length = np.maximum(np.abs(along) ** 2, np.finfo(float).tiny)
        share = np.clip((since * along.conj()).real / length, 0.0, 1.0)
        return share, np.where(self._open(), np.abs(since - share * along), np.inf)

    def bound_at(self, at: Evaluation) -> Self:
        """Keep the intervals in which the walk is nearest."""
        return replace(self, interval=self.nearest(at.state.poses)[0])

    def _open(self) -> Mask:
        """True ``(n, k)`` for the intervals in which each place may have been passed."""
        begin, end = self.untimed.time.T[:, :, None]
        return (self.time[1:] >= begin) & (self.time[:-1] <= end)

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """A factor for each place, of the keyframes about its nearest point: rows along and across the interval."""
        poses, sigma = at.state.poses, self.untimed.sigma * (ROUGHLY if self.rough else 1.0)
        i, share = self.nearest(poses)
        before, after = poses[i], poses[i + 1]
        point = before[:, :2] + share[:, None] * (after - before)[:, :2]
        ends = (share < INSIDE) | (share > 1 - INSIDE)  # in between, the time gives way
        direction = np.where(ends, 0.0, np.arctan2(*(after - before)[:, 1::-1].T))
        turned = np.swapaxes(rotation(direction), 1, 2) / sigma[:, None, None]
        value = np.einsum("nij,nj->ni", turned, point - self.places)

        def jacobian() -> list[Array]:
            rows = turned * np.stack([ends, np.ones(len(i))], axis=1)[:, :, None]
            parts = (1 - share, before), (share, after)
            moved = [part[:, None, None] * rows @ rotation(pose[:, 2]) for part, pose in parts]
            return [np.concatenate([by, np.zeros((len(i), 2, 1))], axis=2) for by in moved]

        loss = RobustLoss(np.ones(len(i), dtype=bool), float(np.sqrt(2 * PRICES.wrong_fix)))
        variables = [("x", i), ("x", i + 1)]
        return [FactorBlock.uniform(self.name, value, variables, jacobian, self.number, loss=loss)]

    def starts(self, at: Evaluation, fixes: FixFactor, sigma_direction: float) -> Sequence[State]:
        """Where the search starts, the best first: the walk ``at``, turned, scaled and moved.

        None where fixes determine the walk to the sigma of the places.
        """
        if not len(self.places) or self._determined(at, fixes):
            return ()
        walk, paths = as_complex(at.state.poses[:, :2]), np.empty((0, len(at.state.poses)), dtype=complex)
        states = list[State]()
        for _, angle, scale, moved, blur in sorted(self._voted(at, fixes, sigma_direction), key=lambda each: -each[0]):
            path = scale * np.exp(1j * angle) * walk + moved
            if len(states) < MOST_STARTS and (np.abs(paths - path).mean(axis=1) > blur).all():
                paths, c = np.vstack([paths, path]), at.state.c.copy()
                c[:, 0] *= scale
                states.append(
                    at.state.replaced(x=np.column_stack([as_points(path), at.state.poses[:, 2] + angle]), c=c)
                )
        return states

    def _determined(self, at: Evaluation, fixes: FixFactor) -> bool:
        """True if all of the walk is so near to fixes that it is known better than the places."""
        known = np.flatnonzero(fixes.consistent)
        if len(known) < 3:  # two may lie together
            return False
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(at.state.poses[:, :2], axis=0).T))])
        measured = np.sort(along[fixes.keyframe[known]])
        ways = np.concatenate([[2 * measured[0]], np.diff(measured), [2 * (along[-1] - measured[-1])]])
        error = np.hypot(np.median(fixes.fixes.sigma[known]), INITIAL.rough_track * ways.max() / 2)
        return bool(error <= 2 * np.median(self.untimed.sigma))

    def _voted(
        self, at: Evaluation, fixes: FixFactor, sigma_direction: float
    ) -> Iterator[tuple[float, float, float, complex, float]]:
        """Log votes, turn [rad], scale and displacement [m] of possible walks, and how exact they are [m]."""
        walk, known = as_complex(at.state.poses[:, :2]), np.flatnonzero(fixes.consistent)
        known = known[:: -(-len(known) // MOST_FIXES) or 1]
        places = as_complex(np.concatenate([self.places, fixes.fixes.position[known]]))
        passed = [*(walk[:-1][open_] for open_ in self._open()), *walk[fixes.keyframe[known], None]]
        length = float(np.sum(at.chain.pieces.length))
        blur = float(np.hypot(np.median(self.untimed.sigma), INITIAL.rough_track * length))

        # Places that no walk of this length can join with the others have no vote
        centre, middle = complex(np.median(places.real), np.median(places.imag)), complex(walk.mean())
        near = np.flatnonzero(np.abs(places - centre) < length + 3 * blur)
        if not len(near):
            return
        places, passed = places[near], [passed[n] for n in near.tolist()]
        reach = float(np.abs(walk - middle).max() * max(SCALES) + np.abs(places - centre).max()) + 3 * blur
        cell = max(blur / 3, 2 * reach / MOST_CELLS)
        cells, around = int(2 * reach / cell) + 1, blur / cell
        prior = 0.5 * (TURNS / sigma_direction) ** 2
        for angle in TURNS[prior < -2 * np.log(FEWEST)].tolist():
            for scale in SCALES:
                votes, similar = np.zeros((cells, cells)), scale * np.exp(1j * angle)
                for place, track in zip(places.tolist(), passed, strict=True):
                    there, moved = np.zeros((cells, cells)), place - centre - similar * (track - middle)
                    np.add.at(there, tuple(np.floor((as_points(moved) + reach) / cell).astype(np.intp).T), 1.0)
                    share = 2 * np.pi * around**2 * gaussian_filter(there, around, mode="constant")
                    votes += np.log(np.clip(share, FEWEST, 1.0))
                votes -= 0.5 * (angle / sigma_direction) ** 2
                for _ in range(EACH):
                    best = np.unravel_index(int(np.argmax(votes)), votes.shape)
                    shift = complex(*((np.array(best) + 0.5) * cell - reach)) + centre
                    yield float(votes[best]), angle, scale, shift - similar * middle, blur
                    votes[tuple(slice(max(0, int(n - 2 * around)), int(n + 2 * around) + 1) for n in best)] = -np.inf

    @property
    def instances(self) -> tuple[Index, Array]:
        """Numbers and latest times of the places."""
        return self.number, self.untimed.time[:, 1]

    def reports(self, at: Evaluation, which: Index | None = None) -> tuple[UntimedFixReport, ...]:
        """Time, distance and weight of each place; other times at which the walk is about as near."""
        [block] = at.blocks_of(self.name)
        interval, share = self.nearest(at.state.poses)
        time = self.time[interval] + share * np.diff(self.time)[interval]
        shares, distance = self._passed(at.state.poses)
        times = self.time[:-1] + shares * np.diff(self.time)
        reports = []
        for n in np.arange(len(self.number)) if which is None else which:
            sigma, weight = float(self.untimed.sigma[n]), float(block.weight[n])
            off = float(block.deviation[n]) * sigma
            reason = f"{off:.1f} m from the walk" + ": not on it" * (weight < REPORTS.rejected)
            x, y = self.places[n].tolist()
            near = (distance[n] ** 2 - np.min(distance[n]) ** 2) / sigma**2
            also = times[n][peaks(np.exp(-near), np.exp(-OPEN), OFTEN)]
            also = also[np.abs(also - time[n]) > OFTEN * KEYFRAMES_EVERY]
            label, others = self.untimed.label[n], tuple(also.tolist())
            reports.append(UntimedFixReport(label, float(time[n]), x, y, sigma, off, weight, reason, others))
        return tuple(reports)
