"""The equations of docs/factors.md, written a second time from the page, compared with the factors.

Nothing here is taken from the code but its inputs: loops instead of running sums, differences instead of derivatives,
shapely instead of grids, dense matrices instead of elimination. Rounding is 1e-9; what is differenced is good to 1e-6.
"""

from dataclasses import replace
from math import erf

import gtsam
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from plans import plan
from scipy.stats import norm
from walks import dead_reckon, drawn_from_the_model, fixes_at, fixes_on, in_corridors, wandering_walk

from pdr_graph.apps.lifelog import multi_day
from pdr_graph.estimation.factors import base as losses
from pdr_graph.estimation.factors.beacon_rssi import BeaconRssiFactor
from pdr_graph.estimation.factors.chain import (
    increment,
    increment_covariance,
    intervals,
    preintegrate,
    whole_pieces,
)
from pdr_graph.estimation.factors.corridors import CorridorFactor, TurnFactor
from pdr_graph.estimation.factors.gnss_bias import GnssBias
from pdr_graph.estimation.factors.loop_closure import LoopClosureFactor
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.incremental import IncrementalSmoother
from pdr_graph.estimation.optimizer import optimize
from pdr_graph.gait.step_chunks import append_steps, gap, shifted
from pdr_graph.geometry import ANY_HEADING, interpolate, unit
from pdr_graph.priors import LOSSES, MOTION, RECEIVERS
from pdr_graph.types import Closures, Drifts, Headings, Levels, Sightings

MARGIN, LOOSE = 0.8, 1.0  # [m] of walls, as the page has them


def turned_by(angle):
    return unit(np.array([angle, angle + np.pi / 2])).T


def wrapped(angle):
    return np.angle(np.exp(1j * angle))


def walk_with_a_pause(seed=0, n=23):
    """Steps of which one sets off after a stop in which the walker turned."""
    steps = wandering_walk(n, seed)
    wait = np.where(np.arange(n) >= 9, 3.0, 0.0)
    turned = np.where(np.arange(n) == 9, 0.7, 0.0)
    turn = steps.turn + turned
    later_steps = {"time": steps.time + wait, "end": steps.end + 3.0, "turn": turn, "pause_turn": turned}
    return replace(steps, **later_steps, final_turn=0.1)


def graph_of(steps, at=(0.0, 4.0, 6.5, 9.3, 12.2), **more):
    """A walk with fixes at some times [s], within steps and, of `walk_with_a_pause`, within the pause."""
    track, time = dead_reckon(steps), np.array([t for t in at if t < steps.end])
    graph = WalkGraph(steps, fixes_at(time, interpolate(time, track.time, track.position)), **more)
    assert np.isin(time, graph.pieces.keyframe_time).all(), "every fix has a keyframe"
    return graph


def any_state(graph, seed, reach=6.0):
    """Anywhere: an equation holds away from the optimum too."""
    random = np.random.default_rng(seed)
    moved = {symbol: rows + random.normal(0, 0.1, rows.shape) for symbol, rows in graph.start.arrays.items()}
    moved["x"] = random.uniform([-reach, -reach, -np.pi], [reach, reach, np.pi], graph.start.poses.shape)
    return graph.start.replaced(**moved)


class Factor:
    """One factor of a block at a state: its whitened residual, weight and cost.

    variables: symbol and row of each; by: derivatives ``(r, 3)`` by each, with the root of its weight.
    """

    def __init__(self, block, n):
        rows = block.row_of == n
        self.variables = [(symbol, int(which[n])) for symbol, which in block.variables]
        self.residual, self.weight = block.residual[rows], float(block.weight[n])
        self.cost = float(block.loss.cost(block.deviation)[n])
        self.by = [by[rows] for by in block.weighted[1]]


def factors_with(graph, state, name, *variables):
    """The factors of one name between exactly these variables, all if none are asked for."""
    blocks = graph.evaluate(state).blocks_of(name)
    factors = [Factor(block, n) for block in blocks for n in range(len(block))]
    return [factor for factor in factors if not variables or factor.variables == list(variables)]


# Steps


def pieces_between(steps, begin, end):
    """Time, length, turn and the variances of length, sway and turn of what was walked from one moment to another."""
    rows, before = [], steps.start
    for k in range(len(steps)):
        sets_off = steps.time[k] - steps.duration[k]
        rows.append((before, sets_off, 0.0, steps.pause_turn[k], 0.0, 0.0, 0.02**2))
        moving_turn = steps.turn[k] - steps.pause_turn[k]
        squares = steps.sigma_length[k] ** 2, steps.sigma_length[k] ** 2, steps.sigma_turn[k] ** 2
        rows.append((sets_off, steps.time[k], steps.length[k], moving_turn, *squares))
        before = steps.time[k]
    rows.append((before, steps.end, 0.0, steps.final_turn, 0.0, 0.0, 0.02**2))
    found = []
    for a, b, *values in rows:
        share = (min(b, end) - max(a, begin)) / (b - a) if b - a > 1e-5 else 0.0
        if share > 1e-6:
            found.append(((b - a) * share, *(share * v for v in values)))
    return np.array(found)


def sums(pieces, c, errors=None):
    """Δ_k(c) after each piece, one after the other; errors: of each piece's length, sway and turn."""
    errors = np.zeros((len(pieces), 3)) if errors is None else errors
    R_s, R_d, b = c
    place, heading, ends = np.zeros(2), 0.0, []
    for (time, length, turn, *_), (long, aside, off) in zip(pieces, errors, strict=True):
        change = R_d * turn + b * time + off
        course = heading + change / 2
        place = place + turned_by(course) @ [R_s * length + long, aside]
        heading += change
        ends.append([*place, heading])
    return np.array(ends)


def covariances(pieces, c):
    """Cov(Δ_k, Δ_o) of the sums after all pieces k and o ``(m, m, 3, 3)``, by differences in each piece's errors."""
    small, columns = 1e-6, []
    for n in range(3 * len(pieces)):
        push = small * np.eye(3 * len(pieces))[n].reshape(-1, 3)
        columns.append((sums(pieces, c, push) - sums(pieces, c, -push)) / (2 * small))
    by_errors = np.array(columns).transpose(1, 2, 0)
    variance = pieces[:, 3:] + [0.002**2, 0.002**2, 0]
    return np.einsum("kin,n,ojn->koij", by_errors, variance.ravel(), by_errors)


@pytest.mark.parametrize("seed", range(3))
def test_the_step_residual_is_that_of_the_page(seed):
    """r = [R_iᵀ (p_j − p_i) − Δp(c), wrap(θ_j − θ_i − Δθ(c))], in Mahalanobis' norm of Q."""
    steps = walk_with_a_pause(seed)
    graph = graph_of(steps)
    state, usual = any_state(graph, seed), np.array([1.0, 1.0, 0.0])
    times = graph.pieces.keyframe_time
    for i in range(len(times) - 1):
        (factor,) = factors_with(graph, state, "steps", ("x", i), ("x", i + 1), ("c", 0))
        pieces = pieces_between(steps, times[i], times[i + 1])
        delta = sums(pieces, state.c[0])[-1]
        x_i, x_j = state.poses[i], state.poses[i + 1]
        r = np.append(turned_by(x_i[2]).T @ (x_j - x_i)[:2] - delta[:2], wrapped(x_j[2] - x_i[2] - delta[2]))
        Q_of_all = covariances(pieces, usual)[-1, -1]
        whitened = factor.residual
        assert whitened @ whitened == pytest.approx(r @ np.linalg.solve(Q_of_all, r), rel=1e-6)


def test_sub_steps_share_the_residual():
    """s_k = Δ_k(c) + G_k r, G_k = Cov(Δ_k, Δ_K) Q⁻¹; the remaining covariance is Cov(Δ_k) − G_k Cov(Δ_K, Δ_k)."""
    steps = walk_with_a_pause()
    graph = graph_of(steps)
    state, usual = any_state(graph, 4), np.array([1.0, 1.0, 0.0])
    placed = graph.evaluate(state).ends
    times = graph.pieces.keyframe_time
    for i in range(len(times) - 1):
        pieces = pieces_between(steps, times[i], times[i + 1])
        first = graph.pieces.first[i]
        delta, cov = sums(pieces, state.c[0]), covariances(pieces, usual)
        x_i, x_j = state.poses[i], state.poses[i + 1]
        r = np.append(turned_by(x_i[2]).T @ (x_j - x_i)[:2] - delta[-1, :2], wrapped(x_j[2] - x_i[2] - delta[-1, 2]))
        for k in range(len(pieces)):
            gain = cov[k, -1] @ np.linalg.inv(cov[-1, -1])
            s = delta[k] + gain @ r
            expected = np.append(x_i[:2] + turned_by(x_i[2]) @ s[:2], x_i[2] + s[2])
            assert placed[first + k] == pytest.approx(expected, abs=1e-5)
            spread = cov[k, k] - gain @ cov[-1, k]
            assert graph.chain.bridge.spread[first + k] == pytest.approx(spread, abs=1e-6)


def test_a_gap_has_a_wide_covariance():
    """1 m/s to either side, 1.2 rad of turn; keyframes at both ends; a new calibration segment after it."""
    before, seconds = wandering_walk(12), 30.0
    after = shifted(wandering_walk(12, 1), before.end + seconds)
    steps = append_steps(append_steps(before, gap(before.end, before.end + seconds)), after)
    graph = graph_of(steps, at=(0.0, 3.7, before.end + seconds + 3.7))
    times = graph.pieces.keyframe_time
    i = int(np.argmin(np.abs(times - before.end)))
    assert times[i : i + 2] == pytest.approx([before.end, before.end + seconds])
    assert graph.segment[i + 1] == graph.segment[i] + 1
    variances = np.array([seconds * 1.0, seconds * 1.0, 1.2]) ** 2 + [0.002**2, 0.002**2, 0]
    state = any_state(graph, 0)
    x_i, x_j = state.poses[i : i + 2]
    away = turned_by(x_i[2] + state.c[graph.segment[i], 2] * seconds / 2).T @ (x_j - x_i)[:2]
    turned = wrapped(x_j[2] - x_i[2] - state.c[graph.segment[i], 2] * seconds)
    (factor,) = factors_with(graph, state, "steps", ("x", i), ("x", i + 1), ("c", int(graph.segment[i])))
    whitened = factor.residual
    assert whitened @ whitened == pytest.approx(np.sum(np.append(away, turned) ** 2 / variances), rel=1e-3)
    assert (MOTION.gap_speed, MOTION.gap_turn) == (1.0, 1.2)


# The plan


def test_a_wall_has_two_hinges():
    """r = max(0, margin − d)/σ + max(0, body − d)/(body_sigma σ) of every piece in which somebody moved, 0 of others.

    Off the corners of a hall the distance is linear, so that the grid of the code is exact.
    """
    steps = walk_with_a_pause(n=10)
    graph = graph_of(steps, floor=plan(("corridor", shapely.box(-40, -40, 40, 40))))
    _, _, heading = graph.start.poses.T
    beside = [np.linspace(-4, 4, len(heading)), np.linspace(39.2, 40.3, len(heading)), heading]
    state = graph.start.replaced(x=np.column_stack(beside))
    between = graph.associated_at(state)
    at = between.evaluate(state)
    residual, _ = between.walls.residual(at)
    boundary = shapely.box(-40, -40, 40, 40).exterior
    pressed = 0
    for k, (x, y, _) in enumerate(at.ends):
        d = shapely.distance(boundary, shapely.Point(x, y)) * (1 if max(abs(x), abs(y)) <= 40 else -1)
        r = max(0, MARGIN - d) / LOOSE + max(0, 0.15 - d) / (0.1 * LOOSE)
        pressed += r > 0
        assert residual[k] == pytest.approx(r if graph.pieces.length[k] > 0 else 0.0, abs=1e-6)
    assert pressed > 5
    whitened = [factor.residual for factor in factors_with(between, state, "walls")]
    assert np.concatenate(whitened) == pytest.approx(residual[residual > 0])


@pytest.mark.parametrize("seed", range(3))
def test_a_turn_is_free_within_its_range(seed):
    """r = [max(0, δ − β) − max(0, α − δ)]/σ; and max(0, n p − e)/σ of the piece that turns, on all four sides."""
    graph = in_corridors("turns")
    state, turns = any_state(graph, seed), graph.find(TurnFactor)
    assert len(turns) == 7
    placed = graph.evaluate(state).ends
    for n in range(len(turns)):
        i, j = int(turns.before[n]), int(turns.after[n])
        alpha, beta = turns.least[n], turns.most[n]
        delta = (alpha + beta) / 2 + wrapped(state.poses[j, 2] - state.poses[i, 2] - (alpha + beta) / 2)
        (factor,) = factors_with(graph, state, "turns.angle", ("x", i), ("x", j))
        r = (max(0, delta - beta) - max(0, alpha - delta)) / 0.05
        assert factor.residual == pytest.approx([r], abs=1e-9)

        interval = int(graph.pieces.interval[turns.piece[n]])
        corner = factors_with(graph, state, "turns.place")[n]
        assert corner.variables == [("x", interval), ("x", interval + 1), ("c", int(graph.segment[interval]))]
        p = placed[turns.piece[n], :2]
        sides = [max(0, normal @ p - edge) / 0.5 for normal, edge in zip(turns.normal[n], turns.edge[n], strict=True)]
        assert corner.residual == pytest.approx(sides, abs=1e-9)


def test_a_straight_run_leads_along_its_corridor():
    """wrap(θ − direction), of σ² = 2 (0.3 w/L)² + 0.03² + spread²; the corridors of the ring are level or upright."""
    graph = in_corridors("directions")
    state, corridors = any_state(graph, 2), graph.find(CorridorFactor)
    directions = corridors.direction
    assert len(directions) == 8
    factors = factors_with(graph, state, "corridors")
    for n, (k, direction) in enumerate(zip(corridors.keyframe.tolist(), directions.heading, strict=True)):
        assert factors[n].variables == [("x", k)]
        assert factors[n].residual == pytest.approx([wrapped(state.poses[k, 2] - direction) / directions.sigma[n]])
        assert wrapped(4 * direction) / 4 == pytest.approx(0, abs=0.02)
    side = 19 * 0.7  # [m] from the first step of a side to its last
    assert directions.sigma == pytest.approx(np.hypot(np.sqrt(2) * 0.3 * 2.5 / side, 0.03), rel=0.2)


# Fixes, receivers, beacons, headings


def test_losses_are_those_of_the_page_and_of_gtsam():
    """ρ and w, at residuals on both sides of their widths."""
    s = np.array([0.0, 0.4, 1.0, 2.4, 2.5, 5.0, 40.0])
    laws = {
        "Huber": (lambda k: np.where(s <= k, s**2 / 2, k * (s - k / 2)), lambda k: np.minimum(1, k / np.maximum(s, k))),
        "GemanMcClure": (lambda k: k**2 * s**2 / (k**2 + s**2) / 2, lambda k: (k**2 / (k**2 + s**2)) ** 2),
    }
    none, every = np.zeros(7, dtype=bool), np.ones(7, dtype=bool)
    for loss, name, width in (
        (losses.RobustLoss(none), "Huber", 2.45),
        (losses.RobustLoss(every), "GemanMcClure", 2.45),
        (losses.RobustLoss(every, LOSSES.closure), "GemanMcClure", LOSSES.closure),
    ):
        rho, weight = (law(width) for law in laws[name])
        theirs = getattr(gtsam.noiseModel.mEstimator, name).Create(width)
        assert loss.cost(s) == pytest.approx(rho), name
        assert loss.cost(-s) == pytest.approx(rho), name
        assert loss.weight(s) == pytest.approx(weight, abs=1e-9), name
        assert [theirs.loss(v) for v in s] == pytest.approx(rho), name
        assert [theirs.weight(v) for v in s] == pytest.approx(weight, abs=1e-9), name
    assert losses.huber_weight(s, 2.45) == pytest.approx(laws["Huber"][1](2.45))
    assert losses.geman_mcclure_weight(s) == pytest.approx(laws["GemanMcClure"][1](2.45))


def test_a_fix_is_a_position():
    """p − z for any heading, with the stated sigma and Huber's loss."""
    graph = graph_of(wandering_walk(12))
    state = any_state(graph, 0)
    fixes = graph.positions
    for n, k in enumerate(fixes.keyframe.tolist()):
        (factor,) = factors_with(graph, state, "fixes", ("x", k))
        r = state.poses[k, :2] - fixes.fixes.position[n]
        assert factor.residual == pytest.approx(r / fixes.fixes.sigma[n])
        sigmas = np.hypot(*r) / fixes.fixes.sigma[n]
        huber = 0.5 * sigmas**2 if sigmas <= 2.45 else 2.45 * (sigmas - 2.45 / 2)
        assert factor.cost == pytest.approx(huber)
        assert factor.weight == pytest.approx(min(1.0, 2.45 / sigmas))


def received(seed=0):
    """A walk with fixes of two sources at different times, of different sigmas."""
    steps = wandering_walk(60, seed)
    fixes = fixes_on(dead_reckon(steps), every=6, seed=seed)
    sigma = np.where(np.arange(len(fixes)) % 4 == 0, 2.0, 5.0)
    named = replace(fixes, sigma=sigma, source=tuple("GNSS" if n % 3 else "Wi-Fi" for n in range(len(fixes))))
    graph = WalkGraph(steps, named)
    again = graph.refined(graph.evaluate(graph.start))
    assert again.positions.biased.all()
    assert not again.positions.outlier.any()
    return again


def drifted(graph, time):
    steps = graph.steps
    walked = np.interp(time, np.append(steps.start, steps.time), np.append(0.0, np.cumsum(steps.length)))
    return time / 120.0 + walked / 30.0


@pytest.mark.parametrize("seed", range(2))
def test_fixes_of_a_receiver_share_an_offset_and_a_lag(seed):
    """p − v lag − l behind + (g_x, g_y) − z, g linear between nodes, white noise of 0.09 σ₀² + n (σ² − σ₀²)."""
    graph = received(seed)
    state, fixes, bias = any_state(graph, seed), graph.positions.fixes, graph.find(GnssBias)
    drift = drifted(graph, fixes.time)
    assert sorted(bias.fix) == list(range(len(fixes)))
    track, factors = dead_reckon(graph.steps), factors_with(graph, state, "fixes")
    for row, f in enumerate(bias.fix.tolist()):
        alike = [o for o in range(len(fixes)) if fixes.source[o] == fixes.source[f] and abs(drift[o] - drift[f]) <= 1]
        least = min(fixes.sigma[alike])
        white = np.sqrt(0.3**2 * least**2 + len(alike) * (fixes.sigma[f] ** 2 - least**2))
        k, node, share = int(graph.positions.keyframe[f]), int(bias.node[row]), float(bias.share[row])
        x, y, _ = state.poses[k]
        assert share == pytest.approx(fixes.time[f] / 5 % 1)
        assert node_times(bias)[node] == 5 * (fixes.time[f] // 5)
        g = (1 - share) * state["g"][node] + share * state["g"][node + 1]
        late = bias.velocity[k] * g[2] + bias.lead[k] * state["o"][bias.receiver[node], 2]
        r = np.array([x, y]) - late + g[:2] - fixes.position[f]
        assert factors[row].variables == [("x", k), ("g", node), ("g", node + 1), ("o", bias.receiver[node])]
        assert factors[row].residual == pytest.approx(r / white)

        began = max(fixes.time[f] - 2.0, 0.0)
        ends = [np.array([np.interp(t, track.time, axis) for axis in track.position.T]) for t in (fixes.time[f], began)]
        way = turned_by(graph.chain.direction[k] - graph.chain.track[1][k]) @ (ends[0] - ends[1]) / 2.0
        assert bias.velocity[k] == pytest.approx(way, abs=0.3)  # [m/s]: keyframes lie further apart


def test_a_walk_leads_its_mean_over_the_last_minutes():
    """l(t) = p(t) − ∫ p(t − s) exp(−s / T) ds / T; a walk under way has the same as the whole walk."""
    steps = wandering_walk(300, 4)
    chain = graph_of(steps).chain
    track = dead_reckon(steps)
    fine = np.arange(track.time[0], track.time[-1], 0.01)
    place = np.stack([np.interp(fine, track.time, axis) for axis in track.position.T], axis=1)
    for k in range(0, len(chain.time), 11):
        weight = np.exp(-(chain.time[k] - fine) / 120.0) * (fine <= chain.time[k])
        before = np.exp(-(chain.time[k] - fine[0]) / 120.0)
        mean = (weight @ place) * 0.01 / 120.0 + before * place[0]
        here = [np.interp(chain.time[k], track.time, axis) for axis in track.position.T]
        assert chain.lead[k] == pytest.approx(complex(*(here - mean)), abs=0.05)
    turned = replace(chain, heading=chain.track[1] + 0.7)
    assert turned.lead == pytest.approx(chain.lead * np.exp(0.7j))
    assert turned.after(20).lead == pytest.approx(turned.lead[20:])


def node_times(bias):
    """Times of the nodes of receivers, multiples of 5 s. [s]"""
    return 5.0 * (bias.node_number % 2**34 - 2**33)


@pytest.mark.parametrize("seed", range(2))
def test_an_offset_is_a_gauss_markov_process(seed):
    """About o [m]: keep = exp(−drift), σ = σ₀ √(1 − keep²) of the offset.

    The lag begins at 1.5 ± 1.5 s, and changes by 0.02 s/√s.
    """
    graph = received(seed)
    state, bias, fixes = any_state(graph, seed), graph.find(GnssBias), graph.positions.fixes
    g, receiver, drift = state["g"], -1, drifted(graph, fixes.time)
    common = np.array([fixes.sigma[(np.array(fixes.source) == fixes.source[f]) & (np.abs(drift - drift[f]) <= 1)].min()
                       for f in range(len(fixes))])  # fmt: skip
    for m in range(len(bias.keep)):
        if bias.keep[m] == 0:
            receiver += 1
            middle = state["o"][receiver] * [1, 1, 0]
            own = [f for f, node in zip(bias.fix.tolist(), bias.node.tolist(), strict=True)
                   if bias.receiver[node] == receiver]  # fmt: skip
            scale = np.interp(node_times(bias), fixes.time[own], common[own])
            (factor,) = factors_with(graph, state, "gnss_bias.begin", ("g", m), ("o", receiver))
            assert factor.residual == pytest.approx((g[m] - middle - [0.0, 0.0, 1.5]) / [scale[m], scale[m], 1.5])
            (factor,) = factors_with(graph, state, "gnss_bias.throughout", ("o", receiver))
            usual = np.median(common[own])
            ahead = np.sqrt(np.mean(bias.lead[graph.positions.keyframe[own]] ** 2))
            sigma = [usual / 2, usual / 2, min(0.3, usual / ahead)]
            assert factor.residual == pytest.approx(state["o"][receiver] / sigma)
            continue
        then, at = node_times(bias)[m - 1 : m + 1]
        beyond = (max(at - graph.steps.end, 0.0) - max(then - graph.steps.end, 0.0)) * 1.0 / 30.0
        keep = np.exp(-(drifted(graph, at) - drifted(graph, then) + beyond))
        sigma = [scale[m] * np.sqrt(1 - keep**2)] * 2 + [0.02 * np.sqrt(at - then)]
        keep *= scale[m] / scale[m - 1]
        r = (g[m] - middle - [keep, keep, 1] * (g[m - 1] - middle)) / sigma
        (factor,) = factors_with(graph, state, "gnss_bias.change", ("g", m), ("g", m - 1), ("o", receiver))
        assert factor.residual == pytest.approx(r, rel=1e-6)
    assert receiver == 1
    assert (RECEIVERS.standing, RECEIVERS.along) == (120.0, 30.0)


def beside_beacons(seed=0):
    steps = wandering_walk(40, seed)
    random = np.random.default_rng(seed)
    place = np.array([[3.0, 4.0], [12.0, -2.0], [np.nan, np.nan]])
    time = dead_reckon(steps).time[np.arange(3, 39, 3)]
    which = np.arange(len(time)) % 3
    heard = Levels(time, which, random.uniform(-90, -60, len(time)), tuple("abc"), place, np.full(3, 0.5))
    return graph_of(steps, levels=heard)


@pytest.mark.parametrize("seed", range(3))
def test_the_level_of_a_beacon_follows_the_path_loss(seed):
    """rssi = P + a − 10 n log₁₀ √(d² + height²) + k cos φ, with level_sigma; and the priors of b and q."""
    graph = beside_beacons(seed)
    state, kind = any_state(graph, seed), graph.find(BeaconRssiFactor)
    heard, b = kind.listed, state["b"]
    factors, (P, n, k) = factors_with(graph, state, "beacons"), state["q"][0]
    for row, keyframe in enumerate(kind.keyframe.tolist()):
        m = int(heard.beacon[row])
        x, y, heading = state.poses[keyframe]
        gap = b[m, :2] - [x, y]
        distance = np.sqrt(gap @ gap + 1.5**2)
        level = P + b[m, 2] - 10 * n * np.log10(distance) + k * (turned_by(heading)[:, 0] @ gap) / distance
        assert factors[row].variables == [("x", keyframe), ("b", m), ("q", 0)]
        assert factors[row].residual == pytest.approx([(level - heard.rssi[row]) / 8.0])
    for m, place in enumerate((0.5, 0.5, 30.0)):
        (factor,) = factors_with(graph, state, "beacons.place", ("b", m))
        assert factor.residual == pytest.approx((b[m] - kind.prior[m]) / [place, place, 6.0])
    (factor,) = factors_with(graph, state, "beacons.path_loss", ("q", 0))
    assert factor.residual == pytest.approx((state["q"][0] - [-62, 2.2, 3]) / [8, 0.5, 3])


@pytest.mark.parametrize("seed", range(3))
def test_a_silence_costs_what_its_probability_says(seed):
    """−w log(ε + (1 − ε) Φ((weakest − level) / within)), for each beacon at each time at which another is received."""
    graph = beside_beacons(seed)
    state, kind = any_state(graph, seed), graph.find(BeaconRssiFactor)
    (P, n, _), b, seen = state["q"][0], state["b"], 0
    for row, keyframe in enumerate(kind.keyframe.tolist()):
        for m in {0, 1, 2} - {int(kind.listed.beacon[row])}:
            (factor,) = factors_with(graph, state, "beacons.silence", ("x", keyframe), ("b", m), ("q", 0))
            gap = b[m, :2] - state.poses[keyframe, :2]
            level = P + b[m, 2] - 10 * n * np.log10(np.sqrt(gap @ gap + 1.5**2))
            below = 0.5 * (1 + erf((-94.0 - level) / 3.5 / np.sqrt(2)))
            probability = np.exp(-4.5) + (1 - np.exp(-4.5)) * below
            assert factor.cost == pytest.approx(-((3.5 / 8.0) ** 2) * np.log(probability), abs=1e-6)
            seen += 1
    assert seen == 2 * len(kind.keyframe) == len(graph.evaluate(state).blocks_of("beacons.silence")[0])


def test_a_heading_is_an_angle_to_the_walking_direction():
    """Each residual is wrap(θ − z)."""
    graph = graph_of(wandering_walk(80), headings=Headings(np.array([9.0]), np.array([3.0]), np.array([0.4])))
    state, k = any_state(graph, 1), int(graph.headings.keyframe[0])
    (factor,) = factors_with(graph, state, "headings", ("x", k))
    assert factor.residual == pytest.approx([wrapped(state.poses[k, 2] - 3.0) / 0.4])


def test_a_drift_is_a_difference_of_the_calibration():
    """Each residual is b − z, of the calibration of the steps before its time."""
    graph = WalkGraph(wandering_walk(210), measurements=[Drifts(np.array([9.0, 90.0]), [0.01, -0.02], [0.002, 0.004])])
    state = any_state(graph, 1)
    for row, (z, sigma) in enumerate([(0.01, 0.002), (-0.02, 0.004)]):
        keyframe = int(np.argmin(np.abs(graph.pieces.keyframe_time - [9.0, 90.0][row])))
        segment = int(graph.chain.segment[keyframe - 1])
        (factor,) = factors_with(graph, state, "drifts", ("x", keyframe), ("c", segment))
        assert factor.residual == pytest.approx([(state.c[segment, 2] - z) / sigma])
        assert segment == row


# Beliefs


def test_calibration_is_a_prior_and_a_random_walk():
    """c₀ about its mean with the prior's covariance, then c_s+1 − c_s of its change; short strides in log scale.

    The drift is distributed as a mixture of two Gaussians, and the other two given the drift as by the usual one.
    """

    def scaled(stride):
        return np.log(stride) if stride < 1 else stride - 1

    correlated = Prior(mean=(1.25, 1.0, 0.0), sigma=(1.25 * 0.15, 0.03, 0.003), correlation=(0.3, -0.2, 0.1))
    graph = WalkGraph(wandering_walk(210), prior=correlated)
    state = any_state(graph, 0)
    (factor,) = factors_with(graph, state, "calibration.begin", ("c", 0))
    (drift,) = factors_with(graph, state, "calibration.drift", ("c", 0))
    off = np.append(scaled(state.c[0, 0] / 1.25), state.c[0, 1:] - [1, 0])
    correlation = np.array([[1, 0.3, -0.2], [0.3, 1, 0.1], [-0.2, 0.1, 1]])
    S = np.diag([0.15, 0.03, 0.003]) @ correlation @ np.diag([0.15, 0.03, 0.003])
    of_drift = off[2] / 0.003
    assert drift.residual == pytest.approx([of_drift])
    assert factor.residual @ factor.residual + of_drift**2 == pytest.approx(off @ np.linalg.solve(S, off))
    assert factor.cost == pytest.approx((off @ np.linalg.solve(S, off) - of_drift**2) / 2)

    def density(b):
        return 0.95 * norm.pdf(b, 0, 0.003) + 0.05 * norm.pdf(b, 0, 0.03)

    assert drift.cost == pytest.approx(np.log(density(0) / density(off[2])))
    b = np.array([-0.1, -0.02, 0.004, 0.01, 0.5])
    (block,) = graph.evaluate(state).blocks_of("calibration.drift")
    slope = (np.log(density(b - 1e-7)) - np.log(density(b + 1e-7))) / 2e-7
    assert block.loss.weight(b / 0.003) * b / 0.003**2 == pytest.approx(slope, rel=1e-4)
    (factor,) = factors_with(graph, state, "calibration.change", ("c", 0), ("c", 1))
    change = np.append(scaled(state.c[1, 0]) - scaled(state.c[0, 0]), (state.c[1] - state.c[0])[1:])
    assert factor.residual == pytest.approx(change / [0.03, 0.005, 0.0005])


def test_the_first_heading_is_uniform():
    """wrap(θ_0 − start)/(π/√3), the standard deviation of a uniform angle."""
    graph = graph_of(wandering_walk(12))
    state = any_state(graph, 3)
    (factor,) = factors_with(graph, state, "start", ("x", 0))
    off = wrapped(state.poses[0, 2] - graph.start.poses[0, 2])
    assert factor.cost == pytest.approx(0.5 * (off / (np.pi / np.sqrt(3))) ** 2)
    assert pytest.approx(np.pi / np.sqrt(3)) == ANY_HEADING


# Moments at one place


def closed(sigma=0.5):
    steps = wandering_walk(40)
    tied = Closures.of([(steps.time[5], steps.time[35], sigma)])
    graph = graph_of(steps, closures=tied)
    return graph, *graph.find(LoopClosureFactor).keyframe[0].tolist()


@pytest.mark.parametrize("seed", range(3))
def test_a_closure_is_the_distance_at_any_headings(seed):
    """r = (p_j − p_i)/σ with Geman and McClure's loss; and its derivatives, forward and to the left."""
    graph, i, j = closed()
    state = any_state(graph, seed)
    (factor,) = factors_with(graph, state, "closures", ("x", i), ("x", j))
    x_i, x_j = state.poses[i], state.poses[j]
    r = (x_j - x_i)[:2] / 0.5
    assert factor.residual == pytest.approx(r)
    assert factor.cost == pytest.approx(4.0**2 * (r @ r) / (4.0**2 + r @ r) / 2)
    loose = 4.0**2 / (4.0**2 + r @ r)  # root of the weight
    by_i, by_j = factor.by
    assert by_i == pytest.approx(-loose / 0.5 * np.column_stack([turned_by(x_i[2]), np.zeros(2)]))
    assert by_j == pytest.approx(loose / 0.5 * np.column_stack([turned_by(x_j[2]), np.zeros(2)]))
    firm, unbound = graph.alternatives()
    (factor,) = factors_with(firm, state, "closures")
    assert factor.cost == pytest.approx(r @ r / 2)
    assert not factors_with(unbound, state, "closures")


def test_an_encounter_has_a_sigma_of_3_m():
    """Per axis; levels below −62 dBm, that of any phone at a metre, are not used."""
    heard = Sightings(np.array([10.0, 40.0, 70.0]), ("her phone",) * 3, np.array([-60.0, -62.0, -63.0]))
    walks = [
        multi_day.CarriedPhone("his", 1000.0, 0.0, 100.0, heard),
        multi_day.CarriedPhone("hers", 990.0, 0.0, 100.0, None),
    ]
    met = multi_day.encounters(walks, {"her phone": "hers"})
    assert met.sigma.tolist() == [3.0, 3.0]
    assert met.time == pytest.approx(np.array([[10, 20], [40, 50]]))


# The window


def test_the_marginal_of_isam2_is_the_schur_complement():
    """Λ_bb − Λ_ba Λ_aa⁻¹ Λ_ab, and what is optimal with it is what was optimal with all."""
    steps, fixes, _ = drawn_from_the_model(120, 0)
    graph = WalkGraph(steps, fixes)
    at, gone = optimize(graph, graph.start).at, 7  # the first keyframes; the rest follows in order
    poses = len(at.state.poses)
    count = poses + len(at.state.c)
    isam = IncrementalSmoother(graph.at(at.state))
    isam.leave([("x", n) for n in range(gone)])
    (marginal,) = isam.marginals()
    assert set(zip(marginal.symbol, marginal.number.tolist(), strict=True)) == {("x", gone), ("c", 0)}
    assert marginal.root.shape[1] == 6

    def information(blocks, without=0):
        """Λ of all variables, less the factors of the first few."""
        total, first = np.zeros((count, 3, count, 3)), {"x": 0, "c": poses}
        for block in blocks:
            J = np.zeros((len(block.residual), count, 3))
            for (symbol, of_factor), derivative in zip(block.variables, block.weighted[1], strict=True):
                J[np.arange(len(J)), first[symbol] + of_factor[block.row_of]] += derivative
            J[np.abs(J[:, :without]).sum(axis=(1, 2)) > 0] = 0.0
            total += np.einsum("mia,mjb->iajb", J, J)
        return total.reshape(3 * count, -1)[3 * without :, 3 * without :]

    joint = np.linalg.inv(information(at.blocks))[3 * gone :, 3 * gone :]
    left = np.linalg.inv(information([*at.blocks, *marginal.factors(at)], without=gone))
    assert left == pytest.approx(joint, rel=1e-6, abs=1e-9)


def test_a_piece_that_ends_with_the_one_before_adds_nothing():
    """Provisional steps may end with the last certain step."""
    steps = walk_with_a_pause(3, 12)
    whole, c = whole_pieces(steps), np.array([1.0, 1.0, 0.0])
    twice = np.insert(whole, 5, whole[4], axis=0)
    for one, other in zip(
        increment(whole, steps.start, 0.3, 5.0, c), increment(twice, steps.start, 0.3, 5.0, c), strict=True
    ):
        assert np.array_equal(one, other)


@settings(max_examples=60)
@given(seed=st.integers(0, 10**6), share=st.tuples(st.floats(0, 1), st.floats(0, 1)))
def test_the_increment_of_a_few_pieces_is_the_preintegrated_one(seed, share):
    """Δ, its derivative by the calibration, and its covariance; the times lie within pieces."""
    random, steps = np.random.default_rng(seed), walk_with_a_pause(seed, 12)
    whole, c = whole_pieces(steps), random.normal((1.0, 1.0, 0.0), (0.2, 0.1, 0.02))
    begin, end = (steps.start + of * (steps.end - steps.start) for of in sorted(share))
    if end - begin < 1e-3:
        return
    pieces = intervals(whole, steps.start, begin, np.array([end]))
    expected = preintegrate(pieces, c[None])
    delta, by_c, covariance = increment(whole, steps.start, begin, end, c)
    assert delta == pytest.approx(expected.delta[-1], abs=1e-12)
    assert by_c == pytest.approx(expected.by_c[-1], abs=1e-11)
    assert covariance == pytest.approx(increment_covariance(pieces, expected)[0], abs=1e-11)
