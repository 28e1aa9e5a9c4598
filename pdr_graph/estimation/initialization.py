"""The initial walk: dead reckoning aligned with the fixes, in closed form.

Gauss–Newton needs headings that are roughly right. With the track of each segment (about a hundred steps) as complex
numbers z, rotation and scale are a product with one complex number a, and the condition that the track passes a fix is
*linear* in the unknowns p_s (start of segment s) and a_s:

    fix at z:      p_s + a_s (z − z_s) = f                joint:   p_{s+1} = p_s + a_s (z_{s+1} − z_s)
    slow change:   a_{s+1} = a_s                          weak:    a_s = 0

a banded least-squares problem, re-weighted a few times against outliers. It needs no start and has no local minima.

Without a gyroscope the track has no shape that could be aligned: there the walk follows its fixes, if they are dense.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d

from pdr_graph.estimation.factors.base import huber_weight, rotated
from pdr_graph.estimation.factors.chain import DECIMALS, Chain
from pdr_graph.geometry import as_complex, dead_reckon, interpolate, nearest, rotation, wrap_angle
from pdr_graph.priors import FIXES, INITIAL, MOTION
from pdr_graph.types import Array, Complex, Fixes, Index, Mask, Steps, Trajectory, take

if TYPE_CHECKING:
    from pdr_graph.estimation.factors import Directions, Positions

REWEIGHTINGS = 5
OPEN_DIRECTIONS = 8  # in which a walk may begin that has no direction
WEAK = 3.0  # sigma of scale and rotation about 0, which keeps them finite, and of a change at a turn of over 1 rad
ROBUST = 2.0  # [σ] width of Huber's weight


def align(
    track: Complex,
    segment: Index,
    fix_keyframe: Index,
    fix: Complex,
    sigma: Array,
    gap: Array | None = None,
    lost: Array | None = None,
) -> tuple[Complex, Array, Array]:
    """Align a dead-reckoned track with at least two fixes.

    Returns the position of each keyframe ``(k,)`` [m], the angle to add to its heading ``(k,)`` [rad], and the factor
    of each segment's length ``(s,)``.

    track: ``(k,)`` complex positions of the keyframes [m]; segment: ``(k,)`` the segment of each, 0, 0, …, 1, …;
    fix_keyframe: ``(f,)`` index of the keyframe at each fix; fix: ``(f,)`` complex [m]; sigma: ``(f,)`` [m].
    gap, lost: ``(s - 1,)`` sigmas of the unrecorded displacement [m] and turn [rad] between segments; 0 by default.
    """
    starts = np.flatnonzero(np.diff(segment, prepend=-1))
    offset = track - track[starts[segment]]
    of_fix, z = segment[fix_keyframe], offset[fix_keyframe]
    move = np.diff(track[starts])
    gap = np.zeros(len(move)) if gap is None else gap
    lost = np.zeros(len(move)) if lost is None else lost
    change = np.where(lost < 1.0, np.hypot(INITIAL.change, lost), WEAK)
    joints = np.hypot(INITIAL.joint, gap) ** -2, change**-2
    p, a = _solve(move, joints, of_fix, z, fix, sigma**-2.0)
    for _ in range(REWEIGHTINGS):
        residual = np.abs(p[of_fix] + a[of_fix] * z - fix) / sigma
        if np.all(residual < ROBUST):
            break
        p, a = _solve(move, joints, of_fix, z, fix, sigma**-2.0 * huber_weight(residual, ROBUST))
    return p[segment] + a[segment] * offset, np.angle(a)[segment], np.abs(a)


def _solve(
    move: Complex, joints: tuple[Array, Array], of_fix: Index, z: Complex, fix: Complex, weight: Array
) -> tuple[Complex, Complex]:
    """Solve the four kinds of equation of this module for p, a of each segment.

    move: ``(s - 1,)`` z_{s+1} − z_s; joints: weights ``(s - 1,)`` of the joint and of the slow change.
    """
    segments = len(move) + 1

    def per_segment(values: Array | Complex) -> Complex:
        real, imaginary = (np.bincount(of_fix, part, segments) for part in (values.real, values.imag))
        return real + 1j * imaginary

    joint, change = joints
    band = np.zeros((3, 2 * segments), dtype=complex)  # lower, of p_0, a_0, p_1, a_1, …
    pp, aa, ap = band[0, 0::2], band[0, 1::2], band[1, 0::2]
    pp += per_segment(weight)
    aa += per_segment(weight * np.abs(z) ** 2) + WEAK**-2
    ap += per_segment(weight * z.conj())
    pp[:-1] += joint
    pp[1:] += joint
    aa[:-1] += joint * np.abs(move) ** 2 + change
    aa[1:] += change
    ap[:-1] += joint * move.conj()
    band[1, 1:-1:2] -= joint * move  # next p by this a
    band[2, 0:-2:2] -= joint  # next p by this p
    band[2, 1:-1:2] -= change  # next a by this a
    right = np.stack([per_segment(weight * fix), per_segment(weight * z.conj() * fix)], axis=1).ravel()
    x: Complex = np.asarray(solveh_banded(band, right, lower=True), dtype=complex)
    return x[0::2], x[1::2]


def sigma_direction(chain: Chain, fixes: Positions) -> float:
    """Sigma [rad] of the direction of the whole walk by its consistent fixes; infinite with fewer than two.

    It is the error of fixes and track over their spread: that of the track, or of the fixes if it is smaller. A nearly
    closed walk has no direction by its ends, however far the drift of the gyroscope opened its track.
    """
    used, (track, _) = fixes.consistent, chain.track
    weight = 1.0 / (
        fixes.independent_sigma[used] ** 2 + (INITIAL.rough_track * float(np.sum(chain.pieces.length))) ** 2
    )
    at_fixes = track[fixes.keyframe[used]]
    information = min(_spread(at_fixes, weight), _spread(as_complex(fixes.fixes.position[used]), weight))
    return 1.0 / np.sqrt(information) if information > 0 else np.inf


def _spread(points: Complex, weight: Array) -> float:
    """Weighted sum of the squared distances of points ``(n,)`` from their mean."""
    centre = np.average(points, weights=weight) if len(points) else 0.0
    return float(np.sum(weight * np.abs(points - centre) ** 2))


def lay_dead_reckoning(steps: Steps, fixes: Fixes) -> Trajectory:
    """Dead reckoning, rigidly aligned with the fixes (rotated and moved, not scaled)."""
    track = dead_reckon(steps)
    if not len(fixes):
        return track
    at_fixes = interpolate(fixes.time, track.time, track.position)
    turn = 0.0
    if len(fixes) > 1:
        rows = as_complex(np.concatenate([track.position, at_fixes]))
        at = np.arange(len(track), len(rows), dtype=np.intp)
        turn = align(rows, np.zeros(len(rows), dtype=np.intp), at, as_complex(fixes.position), fixes.sigma)[1][0]
    turned = track.position @ rotation(turn).T
    shift = np.mean(fixes.position - at_fixes @ rotation(turn).T, axis=0)
    return replace(track, position=turned + shift, heading=wrap_angle(track.heading + turn))


class MirrorTest:
    """Compares a walk and its mirror image with its fixes: turns of the wrong sign are those of a phone upside down.

    Both tracks are moved, turned and scaled to the fixes of the last REACH metres, of which those within APART metres
    are one. A straight walk tells nothing.

    log_odds: that the walk is its mirror image, by the last comparison.
    """

    def __init__(self) -> None:
        self.log_odds = 0.0
        self._track = np.empty((0, 4))  # time [s], distance walked [m], x, y [m]
        self._heading, self._compared = 0.0, 0.0  # [rad]; distance at the last comparison [m]
        self._fixes = np.empty((0, 4))  # time [s], x, y, sigma [m]

    def extend(self, steps: Steps) -> None:
        """Append the next steps; after a gap the turns are not known, and the comparison restarts."""
        rows = dead_reckon(steps, heading=self._heading)
        led = np.concatenate([[0.0], np.cumsum(steps.length), [np.sum(steps.length)]])
        first = int(np.flatnonzero(np.append(True, steps.is_gap))[-1])  # row after the last gap
        if first > 0 or not len(self._track):
            self._track, self._fixes = np.empty((0, 4)), self._fixes[self._fixes[:, 0] > rows.time[first]]
            self._compared = float(led[first])
            before = np.zeros(3)
        else:
            before = self._track[-1, 1:]
        new = np.column_stack([rows.time, led, rows.position]) + np.append(0.0, before)
        self._track = np.concatenate([self._track, new[first:]])
        self._track = self._track[self._track[:, 1] >= self._track[-1, 1] - 2 * REACH]
        self._heading = float(rows.heading[-1])
        if self._track[-1, 1] >= self._compared + APART and len(self._fixes):
            self._compared = float(self._track[-1, 1])
            self._compare()

    def add(self, fixes: Fixes) -> None:
        """Add fixes, which are compared when the steps of their time are known."""
        self._fixes = np.concatenate([self._fixes, np.column_stack([fixes.time, fixes.position, fixes.sigma])])

    def _compare(self) -> None:
        time, led, x, y = self._track.T
        self._fixes = self._fixes[self._fixes[:, 0] >= time[0]]
        fixes = self._fixes[self._fixes[:, 0] <= time[-1]]
        walked = np.interp(fixes[:, 0], time, led)
        latest = walked >= np.max(walked, initial=0.0) - REACH
        fixes, walked = fixes[latest], walked[latest]
        if len(fixes) < 3:
            return
        columns = (walked, *(np.interp(fixes[:, 0], time, column) for column in (x, y)), *fixes[:, 1:].T)
        part = np.unique(walked // APART, return_inverse=True)[1]
        number = np.bincount(part)
        walked, x, y, fix_x, fix_y, sigma = (np.bincount(part, column) / number for column in columns)
        sigma = np.hypot(sigma, DRIFT * np.abs(walked - walked.mean()))
        track, fix = x + 1j * y, fix_x + 1j * fix_y
        if len(number) > 2:
            self.log_odds = _cost(track, fix, sigma) - _cost(track.conj(), fix, sigma)


def mirror_log_odds(steps: Steps, fixes: Fixes) -> float:
    """Log-odds that a whole walk is its mirror image: the largest of `MirrorTest` along it, of either sign."""
    test, found, used, begin = MirrorTest(), [0.0], 0, steps.start
    fixes = take(fixes, np.argsort(fixes.time, kind="stable"))
    for first in range(0, len(steps), COMPARED):
        rows = np.arange(first, min(first + COMPARED, len(steps)))
        end = float(steps.time[rows[-1]])
        before, used = used, int(np.searchsorted(fixes.time, end))
        test.add(fixes[before:used])
        test.extend(replace(take(steps, rows), start=begin, end=end, final_turn=0.0))
        found.append(test.log_odds)
        begin = end
    return max(found, key=abs)


COMPARED = 10  # steps of a recording from comparison to comparison
REACH, APART, DRIFT = 150.0, 5.0, 0.05  # [m], [m], and error of the track per metre from its middle


def _cost(track: Complex, fix: Complex, sigma: Array) -> float:
    """Cost of the fixes ``(n,)`` at the places of a track ``(n,)`` that is moved, turned and scaled to them. [nats]"""
    weight = sigma**-2.0
    residual = np.zeros(len(fix))
    for _ in range(2 * REWEIGHTINGS):
        share = weight / weight.sum()
        z, f = track - np.sum(share * track), fix - np.sum(share * fix)
        turn = np.sum(share * f * z.conj()) / max(float(np.sum(share * np.abs(z) ** 2)), 1e-9)
        stride = float(np.clip(np.abs(turn), 1 / FIXES.stretched, FIXES.stretched))
        residual = np.abs(f - stride * np.exp(1j * np.angle(turn)) * z) / sigma
        weight = sigma**-2.0 / (1 + (residual / ROBUST) ** 2)  # Cauchy's
    return float(np.sum(np.log1p((residual / ROBUST) ** 2)))


def positions_of(track: Trajectory) -> Fixes:
    """The positions of a track as fixes of equal sigma, for `lay_dead_reckoning`."""
    return Fixes(track.time, track.position, np.ones(len(track)))


def initial_walk(
    chain: Chain, fixes: Positions, headings: Directions, steps: Steps, c: Array, sigma_stride: float
) -> tuple[Array, Array, float]:
    """Dead reckoning aligned with the fixes, or with the headings if they determine the direction better.

    A start heading may be reversed: it is used only where the fixes leave the direction open.
    c: ``(s, 3)`` prior means of the calibrations; sigma_stride: prior sigma of R_s [-].
    Returns the poses ``(k + 1, 3)`` of the keyframes, the calibrations ``(s, 3)``, and the sigma [rad] of the direction
    of the whole walk by fixes and headings.
    """
    (track, heading), used = chain.track, fixes.consistent
    at, sigma = fixes.keyframe[used], fixes.independent_sigma[used]
    fix, uncertain = as_complex(fixes.fixes.position[used]), sigma_direction(chain, fixes)
    if len(fix) < 2:
        track = track + (fix - track[at] if len(fix) else 0.0)
    else:
        # Sigmas of the distance [m] and of the turn [rad] in gaps from each segment to the next
        lost, begins = np.flatnonzero(steps.is_gap), chain.time[chain.segment_first[1:]]
        after = np.searchsorted(begins, np.round(steps.time[lost], DECIMALS))
        inside = after < len(begins)  # no segment follows a gap at the end of the recording
        variance = np.stack([steps.sigma_length, steps.sigma_turn])[:, lost[inside]] ** 2
        gap, lost_turn = np.sqrt([np.bincount(after[inside], row, len(begins)) for row in variance])
        segment = np.append(chain.segment[:1], chain.segment)
        track, turned, scale = align(track, segment, at, fix, sigma, gap, lost_turn)
        heading = heading + turned
        if uncertain < INITIAL.ambiguous:
            c = c.copy()
            c[:, 0] = np.clip(scale, *(c[:, 0] + np.array([[-2], [2]]) * sigma_stride))
        if (unmeasured := blind(steps, chain.time)).any():
            place, direction = along_fixes(chain.time, fixes.fixes.time[used], fix, sigma**-2.0)
            known = unmeasured & np.isfinite(direction)
            track[known], heading[known] = place[known], direction[known]
    poses = np.stack([track.real, track.imag, heading], axis=1)

    chosen = np.flatnonzero(~headings.headings.stated | (uncertain >= INITIAL.ambiguous))
    measured = take(headings.headings, chosen)
    weight = measured.sigma**-2.0
    if not len(measured) or weight.sum() ** -0.5 > uncertain:
        return poses, c, uncertain
    apart = wrap_angle(measured.heading - poses[headings.keyframe[chosen], 2])
    turn = float(np.angle(np.sum(weight * np.exp(1j * apart))))
    return rotated(poses, turn, pivot(poses, fixes)), c, float(weight.sum() ** -0.5)


def blind(steps: Steps, time: Array) -> Mask:
    """True at times ``(n,)`` [s] about which most turns were not measured: dead reckoning has no shape there."""
    row = np.searchsorted(steps.time, np.stack([time - INITIAL.window, time + INITIAL.window]))
    unmeasured = np.append(0, np.cumsum(steps.sigma_turn >= MOTION.unmeasured_turn))
    return 2 * np.diff(unmeasured[row], axis=0)[0] > np.diff(row, axis=0)[0]


def along_fixes(time: Array, fix_time: Array, fix: Complex, weight: Array) -> tuple[Complex, Array]:
    """Positions [m] and headings [rad] at times ``(n,)`` [s], on the straight line through the fixes about each.

    fix_time, fix, weight: ``(f,)`` of the fixes. NaN where there are fewer than three about a time.
    """
    begin = min(time[0], fix_time[0])
    second = np.rint(fix_time - begin).astype(np.intp)
    moments = np.zeros((6, max(int(second.max()), int(time[-1] - begin) + 1) + 1), dtype=complex)
    since = fix_time - begin
    np.add.at(moments.T, second, (weight * np.array([since**0, since, since**2, fix, since * fix, 1 / weight])).T)
    about = gaussian_filter1d(moments, INITIAL.window, axis=1, mode="constant", truncate=3)
    grid = np.arange(moments.shape[1])
    one, first, square, place, rise, number = (np.interp(time - begin, grid, row) for row in about)
    many = number.real * INITIAL.window * np.sqrt(2 * np.pi) > 3
    determinant = np.where(many, (one * square - first**2).real, 1.0)
    slope = np.where(many, (one * rise - first * place) / determinant, np.nan)
    return (square * place - first * rise) / determinant + slope * (time - begin), np.angle(slope)


def pivot(poses: Array, fixes: Positions) -> Array:
    """The point ``(2,)`` [m] about which a start may be rotated without leaving the fixes."""
    held = fixes.keyframe[fixes.consistent] if fixes.used.any() else [0]
    return poses[held, :2].mean(axis=0)


def reach(chain: Chain, fixes: Positions, steps: Steps) -> tuple[Array, Array]:
    """South-west and north-east corners ``(2,)`` [m] of the area that the walk can have reached."""
    place, at = fixes.fixes.position[fixes.used], np.append(chain.pieces.first, len(chain.pieces.length))
    walked = np.append(0.0, np.cumsum(chain.pieces.length))[at]
    at_fixes = np.sort(walked[fixes.keyframe[fixes.used]])
    to_fix = np.abs(walked - at_fixes[nearest(at_fixes, walked)])
    gaps = float(np.sum(steps.sigma_length[steps.is_gap]))
    far = FIXES.stretched * (to_fix.max() + gaps + fixes.sigma[fixes.used].max()) + 20.0  # [m] a margin
    return place.min(axis=0) - far, place.max(axis=0) + far
