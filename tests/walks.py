"""Synthetic walks for tests: valid, seeded, with their truth."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from pdr_graph.geometry import dead_reckon, interpolate
from pdr_graph.priors import BEACONS, RECEIVERS
from pdr_graph.types import STEP_COLUMNS, Array, Fixes, Steps, Trajectory, last_time, take

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pdr_graph.estimation.graph import WalkGraph
    from pdr_graph.estimation.live.live_smoother import LiveSmoother
    from pdr_graph.types import Levels

PERIOD = 0.55  # [s] per step


def steps_of(length: Array, turn: Array, sigma_length: float = 0.07, sigma_turn: float = 0.02) -> Steps:
    """Steps without pauses, one every PERIOD."""
    n = len(length)
    time = PERIOD * np.arange(1, n + 1)
    return Steps(
        start=0.0,
        end=float(time[-1] + 0.4) if n else 1.0,
        time=time,
        duration=np.full(n, PERIOD),
        length=np.asarray(length, dtype=float),
        turn=np.asarray(turn, dtype=float),
        pause_turn=np.zeros(n),
        sigma_length=np.full(n, sigma_length),
        sigma_turn=np.full(n, sigma_turn),
    )


def straight(n: int, **sigma: float) -> Steps:
    """So many steps of 0.7 m straight on."""
    return steps_of(np.full(n, 0.7), np.zeros(n), **sigma)


def part(steps: Steps, begin: int, end: int) -> Steps:
    """The steps from row ``begin`` to before row ``end``, as a front end hands them over."""
    last = end >= len(steps)
    return replace(
        steps,
        start=float(steps.time[begin - 1]) if begin else steps.start,
        end=steps.end if last else float(steps.time[end - 1]),
        final_turn=steps.final_turn if last else 0.0,
        **{name: getattr(steps, name)[begin:end] for name in STEP_COLUMNS},
    )


def pushing(live: LiveSmoother, steps: Steps, *tables, size: int = 1, late=0.0) -> Iterator[int]:
    """Push a walk by chunks of ``size`` steps, and each measurement so ``late`` [s] or as soon as its time has come.

    Yields the number of steps after every chunk; what comes later than the walk ends is pushed at last.
    """
    waiting = [(table, last_time(table) + late, np.ones(len(table), dtype=bool)) for table in tables]
    for begin in range(0, max(len(steps), 1), size):
        chunk = part(steps, begin, begin + size)
        live.extend(chunk)
        _append_due(live, waiting, chunk.end)
        yield min(begin + size, len(steps))
    _append_due(live, waiting, np.inf)


def _append_due(live, waiting, now):
    for table, arrival, left in waiting:
        due = np.flatnonzero(left & (arrival <= now))
        left[due] = False
        if len(due):
            live.append(take(table, due))


def pushed(live: LiveSmoother, steps: Steps, *tables, **how) -> LiveSmoother:
    """The smoother after a whole walk."""
    for _ in pushing(live, steps, *tables, **how):
        pass
    return live


def live_track(steps: Steps, fixes: Fixes | None = None, prior=None, lag: float = np.inf, **how) -> Trajectory:
    """All rows of a walk that was pushed and finished; of an endless window, solved by its own factors until it rests.

    The batch would solve it at its end, and take its place.
    """
    from pdr_graph.estimation.live.live_smoother import LiveSmoother

    live = pushed(LiveSmoother(prior, lag), steps, *([] if fixes is None else [fixes]), **how)
    if lag < np.inf:
        live.finish()
        assert live.final is None, "these are the batch's rows"
    else:
        live.graph.solve(40)
    return live_rows(live)


def live_rows(live: LiveSmoother) -> Trajectory:
    """The rows that left the window, those in it, and those predicted since the last keyframe."""
    from pdr_graph.estimation.live.finalization import TrajectoryRows

    past = live.graph.finalized
    rows = TrajectoryRows.joined([*past.rows, live.output.rows(), live.output.predicted_rows()])
    return Trajectory(rows.time, rows.pose[:, :2], rows.pose[:, 2], covariance=rows.covariance)


def distances(track: Trajectory, other: Trajectory) -> Array:
    """Distance of each row of a trajectory from where the other is at its time [m]."""
    return np.hypot(*(track.position - interpolate(track.time, other.time, other.position)).T)


def square_walk(side: int = 20, laps: int = 1) -> Steps:
    """Steps of 0.7 m along a square, quarter turns to the left."""
    turn = np.zeros(4 * side * laps)
    turn[side::side] = np.pi / 2
    return steps_of(np.full(len(turn), 0.7), turn)


def wandering_walk(n: int, seed: int = 0) -> Steps:
    """Steps with varied lengths and turns."""
    random = np.random.default_rng(seed)
    return steps_of(random.uniform(0.5, 0.9, n), random.normal(0, 0.15, n))


def fixes_on(track: Trajectory, every: int, sigma: float = 1.0, seed: int | None = None) -> Fixes:
    """Fixes at every ``every``-th row and at the last step; with noise only if ``seed`` is set."""
    rows = np.unique(np.append(np.arange(0, len(track), every), len(track) - 2))
    noise = 0.0 if seed is None else np.random.default_rng(seed).normal(0, sigma, (len(rows), 2))
    return fixes_at(track.time[rows], track.position[rows] + noise, sigma)


def fixes_at(time, position, sigma: float = 1.0) -> Fixes:
    """Fixes with one sigma."""
    time = np.asarray(time, dtype=float)
    return Fixes(time, np.reshape(position, (-1, 2)).astype(float), np.full(len(time), sigma), ("",) * len(time))


def in_corridors(*corridors: Literal["turns", "directions"]) -> WalkGraph:
    """Two laps of the ring, whose turns or straight runs are matched along the walk itself."""
    from plans import ring

    from pdr_graph.estimation.factors.start import Prior
    from pdr_graph.estimation.graph import WalkGraph

    steps = square_walk(20, laps=2)
    track = dead_reckon(steps)
    start = fixes_at(track.time[:1], track.position[:1])
    graph = WalkGraph(steps, start, floor=ring(), prior=Prior(corridors=corridors))
    return graph.associated_at(graph.start)


def drawn_from_the_model(
    n: int, seed: int, every: int = 15, wrong: float = 1.0, sigma_length: float = 0.07
) -> tuple[Steps, Fixes, Trajectory]:
    """A walk whose errors have the distributions of the graph's priors; ``wrong`` scales the errors of the fixes.

    Returns the measured steps, the fixes and the true trajectory.
    """
    from pdr_graph.estimation.factors.start import Prior
    from pdr_graph.geometry import rotation, row_times, unit

    random, prior = np.random.default_rng(seed), Prior()
    steps = steps_of(random.uniform(0.6, 0.8, n), random.normal(0, 0.1, n), sigma_length)
    R_s, R_d, b = random.normal(prior.mean, prior.sigma)
    theta, position, rows = random.uniform(-np.pi, np.pi), random.uniform(-20, 20, 2), []
    rows.append([*position, theta])
    for length, turn in zip(steps.length, steps.turn, strict=True):
        expected = R_d * turn + b * PERIOD
        wander = random.normal(0, steps.sigma_turn[0])
        course = theta + expected / 2 + wander / 2
        move = R_s * length * unit(np.array(course))
        sway = random.normal(0, steps.sigma_length[0], 2)
        position = position + move + rotation(course) @ sway
        theta += expected + wander
        rows.append([*position, theta])
    rows.append([*position, theta + b * (steps.end - steps.time[-1]) + random.normal(0, 0.02)])
    rows = np.array(rows)
    truth = Trajectory(row_times(steps), rows[:, :2], rows[:, 2], ("",) * len(rows))
    sigma = 1.5
    at = np.arange(every, n, every)
    fixes = fixes_at(truth.time[at], truth.position[at] + random.normal(0, wrong * sigma, (len(at), 2)), sigma)
    return steps, fixes, truth


def drawn_with_a_receiver(n: int, seed: int, period: float = 5.0) -> tuple[Steps, Fixes, Trajectory]:
    """As `drawn_from_the_model`, with fixes of one receiver: offset, lag and white noise by the model of `GnssBias`.

    period: between fixes [s], at least that of the nodes, between which the offset is no Gauss–Markov process.
    """
    from pdr_graph.estimation.factors.fixes import drift
    from pdr_graph.estimation.graph import WalkGraph
    from pdr_graph.geometry import as_points, interpolate, rotation

    steps, _, truth = drawn_from_the_model(n, seed)
    random, sigma = np.random.default_rng([seed, 1]), 3.0
    rows = np.unique(np.searchsorted(truth.time, np.arange(period, steps.end - period, period)))
    time = truth.time[rows]
    keep = np.exp(-np.diff(drift(steps, time)))[:, None]
    offset = random.normal(0, 1, (len(time), 2))
    for i in range(1, len(time)):
        offset[i] = keep[i - 1] * offset[i - 1] + np.sqrt(1 - keep[i - 1] ** 2) * offset[i]
    offset += np.random.default_rng([seed, 3]).normal(0, RECEIVERS.throughout, 2)
    change = np.append(
        random.normal(RECEIVERS.lag, RECEIVERS.lag), random.normal(0, RECEIVERS.lag_change * np.sqrt(np.diff(time)))
    )
    lag, where = np.cumsum(change)[:, None], interpolate(time, truth.time, truth.position)

    graph = WalkGraph(steps, fixes_at(time, where, sigma))
    k = graph.positions.keyframe
    velocity = as_points((graph.chain.velocity * np.exp(-1j * graph.chain.direction))[k])
    ahead = np.array([rotation(h) @ v for h, v in zip(truth.heading[rows], velocity, strict=True)])
    white = RECEIVERS.white * random.normal(0, 1, where.shape)
    fixes = fixes_at(time, where - ahead * lag + sigma * (offset + white), sigma)
    return steps, replace(fixes, source=("GNSS",) * len(fixes)), truth


def drawn_beside_beacons(n: int, seed: int, wrong: float = 1.0) -> tuple[Steps, Fixes, Levels, Trajectory]:
    """As `drawn_from_the_model`, with levels of four beacons: positions, powers and path loss from their priors.

    ``wrong`` scales the errors of the levels.
    """

    from pdr_graph.geometry import unit
    from pdr_graph.types import Levels

    steps, fixes, truth = drawn_from_the_model(n, seed, every=30)
    random, count, surveyed = np.random.default_rng([seed, 2]), 4, 0.5
    low, high = truth.position.min(axis=0) - 8, truth.position.max(axis=0) + 8
    listed = random.uniform(low, high, (count, 2))
    b = np.column_stack([listed + random.normal(0, surveyed, (count, 2)), random.normal(0, BEACONS.power_sigma, count)])
    row = np.repeat(np.arange(8, n, 8), count)
    beacon = np.tile(np.arange(count), len(row) // count)
    gap = b[beacon, :2] - truth.position[row]
    distance = np.sqrt(np.sum(gap**2, axis=1) + BEACONS.height**2)
    facing = np.sum(unit(truth.heading[row]) * gap, axis=1) / distance
    power, exponent, shade = random.normal(BEACONS.path_loss, BEACONS.path_loss_sigma)
    expected = power + b[beacon, 2] - 10 * exponent * np.log10(distance) + shade * facing
    rssi = expected + random.normal(0, wrong * BEACONS.level_sigma, len(row))
    levels = Levels(truth.time[row], beacon, rssi, tuple("abcd"), listed, np.full(count, surveyed))
    return steps, fixes, levels, truth


__all__ = [
    "dead_reckon",
    "drawn_beside_beacons",
    "drawn_from_the_model",
    "drawn_with_a_receiver",
    "fixes_at",
    "fixes_on",
    "live_rows",
    "live_track",
    "part",
    "pushed",
    "pushing",
    "square_walk",
    "steps_of",
    "straight",
    "wandering_walk",
]
