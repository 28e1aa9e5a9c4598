"""The pictures of docs/factors.md, drawn by the factors' own code: ``python scripts/factor_pictures.py [NAME …]``."""

import io
import sys
from dataclasses import replace
from functools import cache
from itertools import pairwise
from types import SimpleNamespace

import gtsam
import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from scipy.ndimage import gaussian_filter
from simulations import simulated
from tables import DOCS

from pdr_graph import FloorPlan, Headings, Prior, WalkGraph, smooth
from pdr_graph.apps.lifelog.multi_day import CarriedPhone, encounters
from pdr_graph.apps.lifelog.sessions import STANDING_SIGMA
from pdr_graph.apps.report.plotting import draw_plan
from pdr_graph.estimation.ambiguity.path_modes import rotated, solutions
from pdr_graph.estimation.factors import chain as chains
from pdr_graph.estimation.factors.base import POSE, State
from pdr_graph.estimation.factors.beacon_rssi import BeaconRssiFactor
from pdr_graph.estimation.factors.chain import Chain
from pdr_graph.estimation.factors.corridors import CorridorFactor, TurnFactor
from pdr_graph.estimation.factors.gnss_bias import GnssBias
from pdr_graph.estimation.factors.heading_prior import HeadingFactor
from pdr_graph.estimation.factors.loop_closure import DOUBTED, FIRM, LoopClosureFactor
from pdr_graph.estimation.factors.start import first_heading_prior
from pdr_graph.estimation.factors.steps_and_walls import WallFactor
from pdr_graph.estimation.live.finalization import MarginalFactor
from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.estimation.multi_walk import smooth_together
from pdr_graph.gait.step_chunks import append_steps, gap, shifted
from pdr_graph.geometry import dead_reckon, interpolate, rotation, unit, wrap_angle
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.priors import BEACONS, COMPASS, LOSSES, MOTION
from pdr_graph.types import Closures, Fixes, Levels, Sightings, Steps, Trajectory, take

INK, GREY, PALE = "#2b2f36", "#8a8a8a", "#c9cdd4"
BLUE, ORANGE, GREEN, PURPLE, RED, GOLD = "#1f5fbf", "#d1602b", "#3a8f63", "#7b4fa6", "#b03a5b", "#e0a030"
OUT = DOCS / "factors"
WIDE, HIGH, DPI = 10.0, 4.4, 100  # [inch], [inch], per inch
COLOURS = 128  # of a PNG's palette: a third of the bytes
STYLE = {"font.size": 14, "axes.edgecolor": GREY, "axes.labelcolor": INK, "xtick.color": INK, "ytick.color": INK}
STYLE |= {"axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False, "legend.fontsize": 12.5}
STYLE |= {"axes.titlesize": 14, "axes.titlelocation": "left", "axes.titlecolor": INK, "lines.linewidth": 2.2}
PERIOD, STRIDE, SIGMA_STRIDE, SIGMA_TURN = 0.55, 0.7, 0.2, 0.02  # [s], [m], [m], [rad] of a step
DRAWS = 3000
NOTHING = 100.0  # [m, rad, -] of a hold where nothing else determines a variable
ROUTE = [[0, 0], {"stand": 60}, {"to": [[180, 0], [180, 120], [20, 160]]}, {"stand": 90}, {"to": [[20, 20]]}]
TWO_SIGMA = np.sqrt(5.991)  # half-axes of the 95 % ellipse of two dimensions, in standard deviations


# What is drawn with


def canvas(columns=2, high=HIGH, ratios=None):
    """A figure and its axes."""
    figure = Figure(figsize=(WIDE, high), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, columns, width_ratios=ratios)
    return figure, axes


def save(figure, name):
    """As a PNG with a small palette."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=DPI)
    image = Image.open(buffer).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    OUT.mkdir(exist_ok=True)
    image.save(OUT / f"{name}.png", optimize=True)


def ellipse(axes, middle, covariance, **style):
    """The 95 % ellipse of a position."""
    values, vectors = np.linalg.eigh(covariance)
    round_about = unit(np.linspace(0, 2 * np.pi, 80)) * np.sqrt(np.maximum(values, 0)) * TWO_SIGMA
    axes.plot(*(middle + round_about @ vectors.T).T, **style)


def plane(axes, title=""):
    """Metres, as broad as high."""
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=title)


def band(axes, x, middle, sigma, label, colour=BLUE):
    """A line and its 95 % band."""
    axes.fill_between(x, middle - 1.96 * sigma, middle + 1.96 * sigma, color=colour, alpha=0.18, lw=0)
    axes.plot(x, middle, color=colour, label=label)


# Walks


def steps_of(turn, length=STRIDE):
    """Steps without pauses, of turns ``(n,)``."""
    n = len(turn)
    time = PERIOD * np.arange(1, n + 1)
    sigmas = np.full(n, SIGMA_STRIDE), np.full(n, SIGMA_TURN)
    return Steps(0.0, float(time[-1]), time, np.full(n, PERIOD), np.full(n, length), turn, np.zeros(n), *sigmas)


def fixes_at(track, rows, sigma=1.0, seed=0):
    """Fixes of that sigma at rows of a track."""
    random, rows = np.random.default_rng(seed), np.asarray(rows)
    place = track.position[rows] + random.normal(0, sigma, (len(rows), 2))
    return Fixes(track.time[rows], place, np.full(len(rows), sigma), ("",) * len(rows))


def drawn(steps, R_s=1.0, drift=0.0, seed=0):
    """A walk of which these steps are told: strides scaled by ``R_s (n,)``, all errors as the model has them."""
    random, n = np.random.default_rng(seed), len(steps)
    wander = random.normal(0, steps.sigma_turn) + drift * PERIOD
    heading = np.cumsum(steps.turn + wander)
    course = heading - (steps.turn + wander) / 2
    along = R_s * steps.length + random.normal(0, steps.sigma_length)
    aside = random.normal(0, MOTION.lateral, n)
    place = np.cumsum(along[:, None] * unit(course) + aside[:, None] * unit(course + np.pi / 2), axis=0)
    rows = np.concatenate([np.zeros((1, 3)), np.column_stack([place, heading])])
    return Trajectory(np.append(0.0, steps.time), rows[:, :2], rows[:, 2], ("",) * (n + 1))


def sums_drawn(pieces, seed=0):
    """Partial sums ``(DRAWS, m, 3)`` of the pieces of one interval, each with errors of its own."""
    random = np.random.default_rng(seed)
    errors = random.normal(0, np.sqrt(pieces.variance), (DRAWS, len(pieces.length), 3))
    turn = np.diff(pieces.to_end[0], prepend=0.0) + errors[:, :, 2]
    heading = np.cumsum(turn, axis=1)
    ahead, left = unit(heading - turn / 2), unit(heading - turn / 2 + np.pi / 2)
    moves = (pieces.length + errors[:, :, 0])[..., None] * ahead + errors[:, :, 1, None] * left
    return np.concatenate([np.cumsum(moves, axis=1), heading[..., None]], axis=2)


def rectangle(laps=1, side=(24, 12)):
    """Steps round a rectangle, quarter turns to the left."""
    corners = np.cumsum([side[n % 2] for n in range(4 * laps)])
    turn = np.zeros(corners[-1])
    turn[corners[:-1]] = np.pi / 2
    return steps_of(turn)


# The graph


KINDS = {  # names by the letters of the variables and the rows of the error
    ("x", 2): ("fix", ORANGE),
    ("x", 1): ("heading, first heading", GREEN),
    ("xgg", 2): ("GNSS fix", GOLD),
    ("xbq", 1): ("beacon RSSI", PURPLE),
    ("xx", 2): ("closure", RED),
    ("c", 3): ("calibration", GREY),
    ("cc", 3): ("calibration", GREY),
}
PRIOR = "prior of g, o, b, q", PALE
STEPS, WALL = ("PDR", BLUE), ("wall", INK)
LEVEL = {"c": 2.0, "x": 0.0, "g": -1.7, "o": -2.8, "b": -2.8, "q": -2.8}
PLACED = {"g": (0.5, 1.6, 4.9, 5.9), "b": (2.4, 7.4), "q": (4.7,), "o": (1.05,)}  # by the poses that they go with
BELOW = {"xgg": 0.9, "xbq": 1.35}  # how far below its pose a factor is drawn
ARC = 4.2  # of a closure


def graph():
    """The whole graph of half a minute, as `to_gtsam` has it."""
    whole = a_short_walk()
    place = {key: node_place(whole, key) for key in whole.start.to_values().keys()}
    figure, axes = canvas(1, 5.8)
    factors, named, taken = whole.to_gtsam(), {}, dict.fromkeys(place, 0)
    for n in range(factors.size()):
        draw_factor(axes, factors.at(n), place, taken, named)
    for key, at in place.items():
        letter, row = letter_and_row(whole, key)
        axes.plot(*at, "o", ms=27, mfc="white", mec=INK, mew=1.5, zorder=5)
        axes.text(*at, f"${letter}_{{{row}}}$", ha="center", va="center", zorder=6)
    for name, colour in sorted(named.items()):
        axes.plot([], [], "s", ms=10, color=colour, label=name)
    axes.set(xlim=(-0.6, len(whole.start.poses) - 0.4), ylim=(-ARC - 0.2, 3.2))
    axes.axis("off")
    figure.legend(loc="outside lower center", ncols=5, handletextpad=0.1, columnspacing=1.0)
    save(figure, "graph")


def a_short_walk():
    """Half a minute and a gap, with every kind of measurement, in the hall of the arcade."""
    first, then = steps_of(np.full(14, 0.02)), steps_of(np.full(16, -0.04))
    steps = append_steps(append_steps(first, gap(first.end, first.end + 6)), shifted(then, first.end + 6))
    track = dead_reckon(steps, heading=0.4)
    track = replace(track, position=track.position + np.array([8.0, 12.0]))
    user = fixes_at(track, [0, len(track) - 1])
    phone = replace(fixes_at(track, [4, 21], 4.0), source=("GNSS",) * 2)
    near = track.position[[8, 26]] + 2.0
    heard = Levels(track.time[[8, 26]], np.arange(2), np.full(2, -70.0), ("a", "b"), near, np.full(2, 0.5))
    both = Fixes.concatenate([user, phone])
    headings = Headings(track.time[[11]], track.heading[[11]], np.array([0.3]))
    closures = Closures.of([(steps.start, steps.end, 5.0)])
    arcade = FloorPlan.load(DOCS.parent / "maps" / "arcade.geojson")
    whole = WalkGraph(steps, both, headings=headings, levels=heard, closures=closures, floor=arcade)
    return whole.refined(whole.evaluate(whole.start))


def node_place(whole, key):
    """Where a variable is drawn: poses in a row, a calibration above its own."""
    letter, row = letter_and_row(whole, key)
    if letter == "x":
        return np.array([row, LEVEL["x"]])
    across = np.mean(np.flatnonzero(whole.segment == row)) + 0.5 if letter == "c" else PLACED[letter][row]
    return np.array([across, LEVEL[letter]])


def letter_and_row(whole, key):
    """The symbol of a variable and its row: nodes of receivers are not numbered from 0."""
    letter = chr(gtsam.Symbol(key).chr())
    return letter, whole.start.keys(letter).tolist().index(key)


def draw_factor(axes, factor, place, taken, named):
    """A square between its variables, or beside its only one."""
    keys = list(factor.keys())
    letters, ends = "".join(chr(gtsam.Symbol(key).chr()) for key in keys), np.array([place[key] for key in keys])
    name, colour = KINDS.get((letters, factor.dim()), PRIOR)
    at = ends.mean(axis=0)
    if letters == "xxc":
        walled = taken.setdefault(tuple(keys), 0)
        taken[tuple(keys)] += 1
        name, colour = WALL if walled else STEPS
        at = ends[:2].mean(axis=0) + np.array([0.0, 0.62 * walled])
    elif letters == "xx":
        around = np.linspace(0, np.pi, 60)
        axes.plot(at[0] - np.ptp(ends[:, 0]) / 2 * np.cos(around), -ARC * np.sin(around) ** 0.4, color=colour, lw=1.2)
        at, ends = np.array([at[0], -ARC]), ends[:0]
    elif letters in BELOW:
        at = ends[0] - np.array([0.0, BELOW[letters]])
    elif len(keys) == 1:
        at = ends[0] + np.array([0.3 * taken[keys[0]] - 0.15, 0.85 if letters == "c" else -0.85])
        taken[keys[0]] += 1
    for end in ends:
        axes.plot(*np.array([at, end]).T, color=GREY if colour == PALE else colour, lw=1.1, zorder=1)
    axes.plot(*at, "s", ms=11, color=colour, zorder=4)
    named.setdefault(name, colour)


# Steps


def pdr():
    """Ten steps and their covariance; a hundred of them, whose ends are no ellipse any more."""
    figure, (short, long) = canvas(ratios=[1, 1.15])
    pieces = chains.cut(steps_of(np.full(10, 0.06)), np.empty(0))
    increments = chains.preintegrate(pieces, np.array([[1.0, 1.0, 0.0]]))
    bridge, ends = chains.bridge(pieces, increments), sums_drawn(pieces)
    Q = np.linalg.inv(bridge.root[0].T @ bridge.root[0])
    way = np.concatenate([np.zeros((1, 2)), increments.delta[:, :2]])
    short.plot(*ends[:, -1, :2].T, ".", ms=2, color=PALE, label="random draws")
    short.plot(*way.T, "o-", ms=5, color=INK, lw=1.2, label="ten steps")
    ellipse(short, way[-1], Q[:2, :2], color=BLUE, label="closed form, 95 %")
    plane(short, "one factor")
    short.legend(loc="upper left")

    steps = steps_of(np.zeros(100))
    known = Prior(sigma=(1e-4, 1e-4, 1e-6), change=(1e-4, 1e-4, 1e-6))
    walk = smooth(WalkGraph(steps, prior=known)).trajectory
    ends = np.array([drawn(steps, seed=n).position[-1] for n in range(DRAWS)])
    long.plot(*ends.T, ".", ms=2, color=PALE)
    long.plot(*walk.position.T, color=INK, lw=1.2)
    name = "as an ellipse in (x, y)"
    ellipse(long, walk.position[-1], walk.covariance[-1, :2, :2], color=ORANGE, ls="--", label=name)
    banana(long, walk.position[-1], walk.covariance[-1])
    plane(long, "ten factors, nothing else")
    long.set(xlim=(-2, 82), ylim=(-36, 36))
    long.legend(loc="lower left")
    save(figure, "pdr")


def banana(axes, place, covariance):
    """Where 95 % of x Exp(ξ) lie, x heading along the first axis, ξ of that covariance."""
    random = np.random.default_rng(1)
    local = random.multivariate_normal(np.zeros(3), covariance, 200_000)
    about = gtsam.Pose2(*place, 0.0)
    half = np.where(np.abs(local[:, 2]) < 1e-9, 1e-9, local[:, 2])
    a, b = np.sin(half) / half, (1 - np.cos(half)) / half
    moved = np.stack([a * local[:, 0] - b * local[:, 1], b * local[:, 0] + a * local[:, 1]], axis=1)
    assert np.allclose(about.retract(local[0]).translation() - place, moved[0])
    count, x, y = np.histogram2d(*(place + moved).T, bins=120)
    smoothed = gaussian_filter(count, 2.0)
    level = np.sort(smoothed.ravel())[::-1]
    least = level[np.searchsorted(np.cumsum(level), 0.95 * level.sum())]
    middle = (x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2
    axes.contour(*middle, smoothed.T, levels=[least], colors=BLUE, linewidths=2.2)
    axes.plot([], [], color=BLUE, label=r"as GTSAM has it: $x\,\mathrm{Exp}(\xi)$")


def bridge():
    """Ten steps between two keyframes, given both."""
    figure, axes = canvas(1, 4.6)
    pieces = chains.cut(steps_of(np.linspace(0.1, -0.12, 10)), np.empty(0))
    usual, start = np.array([[1.0, 1.0, 0.0]]), np.zeros((1, 3))
    increments = chains.preintegrate(pieces, usual)
    chain = Chain.of(pieces, np.zeros(1, dtype=np.intp), usual)
    shares, end = chain.bridge, increments.delta[-1:] + np.array([0.5, 1.4, 0.12])
    own = chain.evaluate(State({"x": np.concatenate([start, end]), "c": usual}))
    ends = sums_drawn(pieces)[:60]
    given = ends + np.einsum("kij,dj->dki", shares.gain, end[0] - ends[:, -1])
    for walk in given:
        axes.plot(*np.concatenate([start[:, :2], walk[:, :2]]).T, color=PALE, lw=0.7, zorder=1)
    axes.plot([], [], color=PALE, label="walks drawn between both")
    felt = np.concatenate([start, increments.delta])
    axes.plot(*felt[:, :2].T, "o--", ms=5, color=ORANGE, lw=1.4, label="the steps as they were felt")
    placed = np.concatenate([start, own.ends])
    axes.plot(*placed[:, :2].T, "o-", ms=5, color=BLUE, label="sub-steps, and what stays uncertain (95 %)")
    for pose, spread in zip(own.ends[:-1], shares.spread[:-1], strict=True):
        ellipse(axes, pose[:2], spread[:2, :2], color=BLUE, lw=0.9)
    for pose, name in ((start[0], "$x_i$"), (end[0], "$x_j$")):
        axes.plot(*pose[:2], "o", ms=24, mfc="white", mec=INK, zorder=6)
        axes.text(*pose[:2], name, ha="center", va="center", zorder=7, fontsize=13)
    plane(axes)
    axes.set(ylim=(-1.2, 4.6))
    axes.legend(loc="upper left")
    save(figure, "bridge")


def gap_row():
    """Half a minute that nobody recorded."""
    first, then, seconds = steps_of(np.full(45, 0.01)), steps_of(np.full(45, -0.02)), 30.0
    whole = append_steps(append_steps(first, gap(first.end, first.end + seconds)), shifted(then, first.end + seconds))
    track = dead_reckon(whole, heading=0.2)
    moved = np.where(np.arange(len(track)) > 45, 1.0, 0.0)[:, None] * [14.0, 12.0]
    truth = replace(track, position=track.position + moved)
    rows = [0, 20, 40, 60, 75, len(truth) - 1]
    given = fixes_at(truth, rows, 0.7)
    found = smooth(WalkGraph(whole, given)).trajectory
    figure, axes = canvas(1, 4.6)
    axes.plot(*track.position.T, color=GREY, ls="--", lw=1.4, label="the steps, one after the other")
    axes.plot(*given.position.T, "o", ms=9, color=ORANGE, label="fixes")
    walked = found.position.copy()
    axes.plot(*walked[:46].T, color=BLUE, label="the walk")
    axes.plot(*walked[46:].T, color=BLUE)
    axes.plot(*walked[45:47].T, color=BLUE, ls=":", label="30 s that nobody saw")
    end, R = found.position[45], rotation(found.heading[45])
    ellipse(axes, end, seconds**2 * R @ R.T / TWO_SIGMA**2, color=PALE, lw=1.5)
    axes.plot([], [], color=PALE, label="1 σ of where they lead: 30 m")
    plane(axes)
    axes.set(xlim=(-2, 92), ylim=(-10, 46))
    axes.legend(loc="upper left", ncols=2)
    save(figure, "gap")


# The plan


def walls():
    """The cost of every place beside a doorway, and along a section of a corridor."""
    plan = FloorPlan.load(DOCS.parent / "maps" / "loop.geojson")
    prior, along = Prior(), np.column_stack([np.linspace(5.0, 40.0, 50), np.full(50, 1.25)])
    corridor = plan.regions.walls_along(along)[0][0]
    figure, (above, section) = canvas(ratios=[1.3, 1])
    x, y = np.meshgrid(np.linspace(-0.6, 9.6, 205), np.linspace(-0.6, 7.2, 157))
    r = wall_error(corridor, np.column_stack([x.ravel(), y.ravel()]), prior)
    cost = 0.5 * r.reshape(x.shape) ** 2
    shown = above.contourf(x, y, cost, levels=np.linspace(0, 0.4, 17), cmap="Blues", extend="max")
    figure.colorbar(shown, ax=above, ticks=[0, 0.2, 0.4], label="cost of a step", shrink=0.8)
    plane(above, "from above")

    across = np.column_stack([np.full(300, 20.0), np.linspace(-0.25, 2.75, 300)])
    r = wall_error(corridor, across, prior)
    section.plot(across[:, 1], r, color=BLUE, label="residual [σ]")
    section.plot(across[:, 1], 0.5 * r**2, color=ORANGE, label="cost")
    for at in (0.0, 2.5):
        section.axvline(at, color=INK, lw=5, alpha=0.6)
    section.set(ylim=(0, 4), xlabel="across a corridor of 2.5 m [m]", title="a section")
    section.legend(loc="upper center")
    save(figure, "wall")


def wall_error(field, points, prior):
    """The wall factor of steps that end at some points ``(n, 2)``."""
    n = len(points)
    about = WallFactor(None, (field,), np.zeros(n, dtype=np.intp), prior.wall_margin, prior.wall_sigma)
    return about.residual(SimpleNamespace(ends=points, pieces=SimpleNamespace(length=np.ones(n))))[0]


def a_lap(*corridors):
    """A lap of the loop, and what was matched of it."""
    plan = FloorPlan.load(DOCS.parent / "maps" / "loop.geojson")
    corners = np.array([[1.25, 1.25], [43.75, 1.25], [43.75, 26.75], [1.25, 26.75], [1.25, 3.0]])
    way = np.concatenate([np.linspace(a, b, 60, endpoint=False) for a, b in pairwise(corners)])
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))])
    place = interpolate(np.arange(0.0, along[-1], STRIDE), along, way)
    moves = np.diff(place, axis=0)
    heading = np.unwrap(np.arctan2(*moves.T[::-1]))
    turn = np.diff(heading, prepend=0.0)
    steps = replace(steps_of(turn), length=np.hypot(*moves.T))
    truth = dead_reckon(steps)
    first = Fixes(truth.time[:1], place[:1], np.array([0.5]), ("",))
    whole = WalkGraph(steps, first, floor=plan, prior=Prior(corridors=corridors))
    return plan, whole.associated_at(whole.start), truth.position + place[0]


def direction():
    """The straight runs of a lap and the direction that each tells."""
    plan, whole, track = a_lap("directions")
    figure, axes = canvas(1, 5.2)
    draw_plan(axes, plan)
    axes.plot(*track.T, color=BLUE, label="a walk", zorder=4)
    told = whole.find(CorridorFactor)
    rows = zip(told.keyframe, told.direction.heading, told.direction.sigma, strict=True)
    for n, (k, heading, sigma) in enumerate(rows):
        at = whole.start.poses[k, :2]
        cone = heading + np.linspace(-2, 2, 20) * sigma
        axes.fill(*np.vstack([at, at + 9 * unit(cone)]).T, color=ORANGE, alpha=0.3, lw=0, zorder=5)
        named = "direction of a run, ±2 σ" if n == 0 else None
        axes.annotate("", at + 9 * unit(heading), at, arrowprops={"arrowstyle": "-|>", "color": ORANGE}, zorder=6)
        axes.plot(*at, "o", ms=8, color=ORANGE, zorder=6, label=named)
    plane(axes)
    axes.set(xlim=(-1, 46), ylim=(-1, 29))
    figure.legend(loc="outside lower center", ncols=2)
    save(figure, "direction")


def turn():
    """The least and the greatest turn at an intersection, and what the factor makes of them."""
    plan, whole, _ = a_lap("turns")
    figure, (above, law) = canvas(ratios=[1, 1.1])
    draw_plan(above, plan)
    out, far = np.array([2.5, 0.0]), 12.0
    corner, outer = np.array([42.5, 2.5]), np.array([45.0, 0.0])
    ways = (("least: out-in-out", GREEN, corner, outer), ("greatest: in-out-in", ORANGE, outer, corner))
    for name, colour, by, side in ways:
        line = np.array([[corner[0] - far, side[1]], by, [side[0], corner[1] + far]])
        above.plot(*line.T, color=colour, label=name, zorder=5)
    plane(above)
    above.set(xlim=(29.5, 46), ylim=(-out[0], 15.5))
    above.legend(loc="upper left")

    turns = whole.find(TurnFactor)
    angle = np.radians(np.linspace(20, 160, 400))
    residual = []
    for change in angle:
        heading = np.zeros(turns.after.max() + 1)
        heading[turns.after[0]] = change
        residual.append(turns.heading_change(heading)[0][0])
    law.axvspan(*np.degrees([turns.least[0], turns.most[0]]), color=PALE, alpha=0.6, lw=0, label="free: α to β")
    law.plot(np.degrees(angle), residual, color=BLUE, label="residual [σ]")
    law.set(xlabel="heading change δ [deg]", xticks=[30, 60, 90, 120, 150])
    law.legend(loc="upper left")
    save(figure, "turn")


# Fixes


def losses():
    """What a residual costs, and how much of its weight is left."""
    s, M = np.linspace(0, 10, 400), gtsam.noiseModel.mEstimator
    laws = {
        f"Huber, {LOSSES.huber} σ": (M.Huber.Create(LOSSES.huber), BLUE, "-"),
        f"Geman–McClure, {LOSSES.huber} σ": (M.GemanMcClure.Create(LOSSES.huber), ORANGE, "-"),
        f"Geman–McClure, {LOSSES.closure} σ (closures)": (
            M.GemanMcClure.Create(LOSSES.closure),
            PURPLE,
            "--",
        ),
    }
    figure, (cost, weight) = canvas()
    cost.plot(s, s**2 / 2, color=PALE, label="Gaussian")
    weight.plot(s, np.ones_like(s), color=PALE)
    for name, (law, colour, line) in laws.items():
        cost.plot(s, [law.loss(v) for v in s], color=colour, ls=line, label=name)
        weight.plot(s, [law.weight(v) for v in s], color=colour, ls=line)
    cost.set(ylim=(0, 28), xlabel="residual [σ]", title="cost")
    weight.set(ylim=(0, 1.05), xlabel="residual [σ]", title="weight")
    cost.legend(loc="upper left", fontsize=11)
    save(figure, "losses")


@cache
def gps_walk():
    """Ten minutes by a simulated receiver: most of its error stays the same for a while."""
    given = {"seed": 4, "route": ROUTE, "phone": {"rate": 50}, "gnss": {"accuracy": 6.0}}
    return simulated(Scenario.of(given))


def receiver():
    """A receiver's errors, and the offset that the graph believes in."""
    walk = gps_walk()
    best = solutions(WalkGraph(walk.steps, walk.fixes, headings=walk.headings))[0]
    seen, g, fixes = best.graph.find(GnssBias), best.state["g"], best.graph.positions.fixes
    true = interpolate(fixes.time, walk.truth.time, walk.truth.position)
    marginals = gtsam.Marginals(best.graph.to_gtsam(), best.state.to_values())
    sigma = np.sqrt([marginals.marginalCovariance(key)[0, 0] for key in best.state.keys("g").tolist()])
    offset, spread = ((1 - seen.share) * of[seen.node] + seen.share * of[seen.node + 1] for of in (g[:, 0], sigma))
    figure, axes = canvas(1)
    for n, (begin, end) in enumerate(stops(walk.truth)):
        axes.axvspan(begin, end, color=PALE, alpha=0.45, lw=0, label=None if n else "the walker stands")
    axes.axhline(0, color=GREY, lw=1)
    axes.plot(fixes.time, (fixes.position - true)[:, 0], ".", ms=6, color=ORANGE, label="error of a fix to the east")
    order = np.argsort(fixes.time[seen.fix])
    time, middle, spread = (of[order] for of in (fixes.time[seen.fix], offset, spread))
    band(axes, time, middle, spread, "offset in the graph, 95 %")
    axes.set(xlabel="time [s]", ylabel="[m]", ylim=(-14, 16))
    axes.legend(loc="upper left", ncols=3)
    save(figure, "receiver")


def stops(truth):
    """When nobody moved, from and to [s]."""
    still = np.hypot(*np.gradient(truth.position, axis=0).T) < 0.1 * np.gradient(truth.time)
    change = np.flatnonzero(np.diff(still.astype(int), prepend=0, append=0))
    spans = truth.time[np.minimum(change, len(truth.time) - 1)].reshape(-1, 2)
    return spans[np.diff(spans)[:, 0] > 10]


def beacon():
    """How loud a beacon is at a distance, ahead and behind; and of any phone."""
    metres = np.geomspace(0.5, 40, 200)
    figure, axes = canvas(1)
    draws = np.random.default_rng(0).normal(BEACONS.path_loss, BEACONS.path_loss_sigma, (400, 3))
    low, high = np.percentile([level(metres, 0.0, q) for q in draws], [2.5, 97.5], axis=0)
    axes.fill_between(metres, low, high, color=PALE, alpha=0.5, lw=0, label="a phone of which nothing is known, 95 %")
    for name, facing, colour in (("ahead", 0.0, BLUE), ("behind", np.pi, ORANGE)):
        usual = level(metres, facing, np.array(BEACONS.path_loss))
        axes.fill_between(metres, *(usual + s * BEACONS.level_sigma for s in (-1, 1)), color=colour, alpha=0.15, lw=0)
        axes.plot(metres, usual, color=colour, label=f"the usual one, the beacon {name}, ±1 σ")
    axes.set(xscale="log", xlabel="distance [m]", ylabel="level [dBm]", xticks=[1, 2, 5, 10, 20, 40])
    axes.set_xticklabels(["1", "2", "5", "10", "20", "40"])
    axes.minorticks_off()
    axes.legend(loc="upper right")
    save(figure, "beacon")


def level(metres, facing, q):
    """What the factor expects of a beacon at those distances [dBm]. facing: its bearing from where the walker faces."""
    n = len(metres)
    poses = np.column_stack([-metres, np.zeros(n), np.full(n, -facing)])
    silent = Levels(np.zeros(n), np.zeros(n, dtype=np.intp), np.zeros(n), ("a",), np.zeros((1, 2)), np.ones(1))
    factor = replace(BeaconRssiFactor.of(silent, None, Prior()), keyframe=np.arange(n))
    state = State({"x": poses, "b": np.zeros((1, 3)), "q": q[None]})
    return factor.factors(SimpleNamespace(state=state))[0].residual * BEACONS.level_sigma


def heading():
    """The headings of one walk, and how well all of them together know the direction."""
    walk = gps_walk()
    truth, told = walk.truth, walk.headings
    way = np.diff(truth.position, axis=0)
    course = np.interp(told.time, truth.time[:-1], np.unwrap(np.arctan2(*way.T[::-1])))
    figure, (each, all_of) = canvas(ratios=[1.3, 1])
    off = np.degrees(wrap_angle(told.heading - course))
    each.axhline(0, color=GREY, lw=1)
    style = {"fmt": "o", "ms": 8, "color": BLUE, "capsize": 4}
    each.errorbar(told.time, off, np.degrees(told.sigma), label="error, ±σ stated", **style)
    each.set(xlabel="time [s]", ylabel="[deg]", title=f"the {len(told)} headings of a walk")
    each.legend(loc="upper left")
    n, own, ahead = np.arange(1, 25), 0.1, 0.1
    shared = np.sqrt(own**2 + n * (ahead**2 + COMPASS.sigma**2))
    alone = np.sqrt(own**2 + ahead**2 + COMPASS.sigma**2) / np.sqrt(n)
    all_of.plot(n, np.degrees(alone), color=ORANGE, ls="--", label="taken for independent")
    all_of.plot(n, np.degrees(shared / np.sqrt(n)), color=BLUE, label="the shared part, n times")
    all_of.set(xlabel="headings of one walk", ylim=(0, None), title="σ of all together [deg]")
    all_of.legend(loc="center right")
    save(figure, "heading")


# Beliefs


def calibration():
    """A walker who goes on with shorter strides, known at the ends and not in between."""
    steps = steps_of(np.where(np.arange(900) % 45 == 44, np.pi / 2, 0.0))
    strides = np.where(np.arange(900) < 450, 1.06, 0.94)
    truth = drawn(steps, strides, drift=0.001)
    rows = np.r_[0:300:25, 600:900:25]
    found = smooth(WalkGraph(steps, fixes_at(truth, rows))).calibration
    figure, axes = canvas(1)
    span = np.append(found.start, steps.end)
    time, cell = np.repeat(span, 2)[1:-1], np.repeat(np.arange(len(found.start)), 2)
    prior = found.prior_sigma[cell, 0]
    before = {"color": PALE, "alpha": 0.5, "lw": 0, "label": "believed before, 95 %"}
    axes.fill_between(time, 1 - 1.96 * prior, 1 + 1.96 * prior, **before)
    band(axes, time, found.value[cell, 0], found.sigma[cell, 0], "$R_s$ learnt, 95 %")
    axes.plot(steps.time, strides, color=INK, ls="--", lw=1.6, label="the walker's")
    axes.plot(truth.time[rows], np.full(len(rows), 0.66), "|", ms=14, mew=2, color=ORANGE, label="a fix")
    axes.set(xlabel="time [s]", ylabel="scale of the stride", ylim=(0.6, 1.55))
    axes.legend(loc="upper left", ncols=4)
    save(figure, "calibration")


def first_heading():
    """One fix and nothing else: the walk is started all round."""
    steps = steps_of(np.where(np.arange(60) == 35, 1.2, 0.0))
    one = WalkGraph(steps, fixes_at(dead_reckon(steps), [0], 0.5))
    figure, (around, law) = canvas()
    for n, start in enumerate(rotated(one)):
        named = "where the optimiser starts" if n == 0 else None
        around.plot(*start.start.poses[:, :2].T, color=BLUE, lw=1.6, label=named)
    around.plot(*one.positions.fixes.position[0], "o", ms=11, color=ORANGE, zorder=5, label="the only fix")
    plane(around)
    around.legend(loc="upper left")
    around.set(ylim=(-45, 62))
    angles = np.linspace(-np.pi, np.pi, 200)
    hold = first_heading_prior(0.0)
    law.plot(np.degrees(angles), [cost_at(hold, angle) for angle in angles], color=BLUE, label="the hold, 104°")
    known = Headings(np.zeros(1), np.zeros(1), np.radians([20.0]))
    known = HeadingFactor(known, np.zeros(1, dtype=np.intp), np.zeros(1, dtype=np.intp))
    law.plot(np.degrees(angles), [cost_at(known, angle) for angle in angles], color=ORANGE, label="a heading of 20°")
    law.set(ylim=(0, 8), xlabel="first heading, from the start's [deg]", title="cost", xticks=[-180, -90, 0, 90, 180])
    law.legend(loc="upper center")
    save(figure, "first-heading")


def cost_at(factor, angle):
    """What a factor of the first pose costs at a heading."""
    return cost_of(factor, np.array([[0.0, 0.0, angle]]))


def cost_of(factor, poses):
    """What a factor of poses alone costs."""
    return sum(block.cost for block in factor.factors(SimpleNamespace(state=State({"x": poses}))))


# Moments at one place


def closure():
    """What a closure costs, and a lap that it closes."""
    figure, (law, above) = canvas(ratios=[1, 1.1])
    metres = np.linspace(0, 5, 300)
    for name, firmly, colour in (("Gaussian", True, PALE), ("Geman–McClure", False, BLUE)):
        law.plot(metres, [cost_apart(d, firmly) for d in metres], color=colour, label=name)
    law.axhline(LOSSES.closure**2 / 2, color=GREY, lw=1, ls=":", label="8: its upper limit")
    law.set(ylim=(0, 14), xlabel=f"distance [m], σ = {STANDING_SIGMA} m", title="cost")
    law.legend(loc="lower right", fontsize=11.5)

    steps = rectangle()
    first = fixes_at(dead_reckon(steps), [0], 0.3)
    felt = replace(steps, turn=steps.turn + 0.006)
    tie = Closures.of([(0.0, steps.end, STANDING_SIGMA)])
    ahead = Headings(np.zeros(1), np.zeros(1), np.array([0.05]))
    for name, closures, colour in (("without", None, ORANGE), ("with the closure", tie, BLUE)):
        found = smooth(WalkGraph(felt, first, headings=ahead, closures=closures)).trajectory
        above.plot(*found.position.T, color=colour, label=name)
        ellipse(above, found.position[-1], found.covariance[-1, :2, :2], color=colour, lw=1.2)
    above.plot(*dead_reckon(steps).position.T, color=INK, ls="--", lw=1.4, label="truth")
    plane(above, "a lap and the 95 % region of its end")
    above.legend(loc="upper center", fontsize=11.5)
    above.set(ylim=(-9, 24))
    save(figure, "closure")


def cost_apart(metres, firmly):
    """What a stop costs whose two moments are so far apart."""
    poses = np.array([[0.0, 0.0, 0.0], [metres, 0.0, 0.0]])
    closures, hold = Closures.of([(0.0, 1.0, STANDING_SIGMA)]), FIRM if firmly else DOUBTED
    return cost_of(LoopClosureFactor(closures, np.zeros(1, dtype=np.intp), np.array([[0, 1]]), hold), poses)


def encounter():
    """How near two people were who heard each other; two walks that one encounter binds."""
    figure, (law, above) = canvas(ratios=[1, 1.3])
    levels = np.arange(-85.0, -45.0)
    heard = [Sightings(np.array([1.0]), ("hers",), np.array([level])) for level in levels]
    met = [
        encounters([CarriedPhone("he", 0, 0, 2, one), CarriedPhone("she", 0, 0, 2, None)], {"hers": "she"})
        for one in heard
    ]
    law.plot(levels, [one.sigma[0] for one in met], color=BLUE)
    law.set(xlabel="level at which one heard the other [dBm]", ylabel="σ per axis [m]", ylim=(0, None))

    one, other = steps_of(np.full(60, 0.01)), steps_of(np.full(60, -0.01))
    crossing = dead_reckon(one), dead_reckon(other, heading=np.pi / 2)
    truths = [replace(t, position=t.position - t.position[40]) for t in crossing]
    given = fixes_at(truths[0], [0], 0.5), fixes_at(truths[1], [0, 20, 59], 0.5)
    told = [truth.heading[:1] + off for truth, off in zip(truths, (0.25, 0.0), strict=True)]
    ahead = [Headings(np.zeros(1), heading, np.array([0.25])) for heading in told]
    graphs = [WalkGraph(s, f, headings=h) for s, f, h in zip((one, other), given, ahead, strict=True)]
    alone = [smooth(each) for each in graphs]
    tie = Closures.of([(float(truths[0].time[40]), float(truths[1].time[40]), 1.5)], [(0, 1)])
    bound = smooth_together(graphs, alone, tie)
    for name, found, colour in (("alone", alone, ORANGE), ("bound", bound, BLUE)):
        for n, estimate in enumerate(found):
            track = estimate.trajectory
            above.plot(*track.position.T, color=colour, label=None if n else name, zorder=4 - n)
            ellipse(above, track.position[-1], track.covariance[-1, :2, :2], color=colour, lw=1.2)
    for n, truth in enumerate(truths):
        above.plot(*truth.position.T, color=INK, ls="--", lw=1.3, label=None if n else "truth", zorder=5)
    plane(above, "two who met at (0, 0)")
    above.legend(loc="upper left")
    save(figure, "encounter")


# The window


def marginal():
    """How well a walk under way knows where it is, a minute after its last fix, with and without what has left."""
    steps = steps_of(np.where(np.arange(330) % 60 == 59, np.pi / 2, 0.0))
    truth = drawn(steps, seed=2)
    fixes = fixes_at(truth, [0, 30, 60, 90, 120], 1.0)
    walk = LiveSmoother(lag=30.0)
    time, known, forgotten = [], [], []
    for begin in range(0, len(steps), 5):
        walk.extend(some(steps, begin, begin + 5))
        new = (fixes.time > begin * PERIOD - 1e-6) & (fixes.time <= (begin + 5) * PERIOD)
        if new.any():
            walk.append(take(fixes, np.flatnonzero(new)))
        if begin % 10 == 5 and walk.graph.marginals:
            time.append(walk.graph.window.times[-1])
            known.append(np.sqrt(np.trace(walk.graph.solved_covariance(-1)[:2, :2]) / 2))
            forgotten.append(spread_without_marginal(walk.graph.at))
    figure, axes = canvas(1)
    axes.plot(time, known, color=BLUE, label="with the marginal on what was left of the window")
    axes.plot(time, forgotten, color=ORANGE, ls="--", label="without: what left the window is forgotten")
    axes.plot(fixes.time, np.full(len(fixes), 1.3), "|", ms=14, mew=2, color=INK, label="a fix")
    axes.set(xlabel="time [s]", ylabel="σ of the newest position [m]", yscale="log", ylim=(0.2, 1000))
    axes.legend(loc="upper left")
    save(figure, "marginal")


def some(steps, begin, end):
    """Steps from one number to another, as a front end hands them over."""
    names = ("time", "duration", "length", "turn", "pause_turn", "sigma_length", "sigma_turn")
    start = steps.start if begin == 0 else float(steps.time[begin - 1])
    rows = {name: getattr(steps, name)[begin:end] for name in names}
    return replace(steps, start=start, end=float(rows["time"][-1]), **rows)


def spread_without_marginal(at):
    """Root of the mean variance of the last position, by the window's factors and a hold as loose as nothing. [m]"""
    sizes = [len(at.state[symbol]) for symbol in at.state.arrays]
    first = dict(zip(at.state.arrays, np.cumsum([0, *sizes[:-1]]), strict=True))
    information = np.eye(3 * sum(sizes)) / NOTHING**2
    for block in at.blocks:
        residual, by = block.weighted
        if block.name != MarginalFactor.name:
            J = np.zeros((len(residual), sum(sizes), 3))
            for (symbol, rows), of_variable in zip(block.variables, by, strict=True):
                J[np.arange(len(residual)), first[symbol] + rows[block.row_of]] += of_variable
            J = J.reshape(len(residual), 3 * sum(sizes))
            information += J.T @ J
    last = 3 * (first[POSE] + len(at.state.poses) - 1)
    covariance = np.linalg.inv(information)[last : last + 2, last : last + 2]
    return np.sqrt(np.trace(covariance) / 2)


PICTURES = {
    "graph": graph,
    "pdr": pdr,
    "bridge": bridge,
    "gap": gap_row,
    "wall": walls,
    "direction": direction,
    "turn": turn,
    "losses": losses,
    "receiver": receiver,
    "beacon": beacon,
    "heading": heading,
    "calibration": calibration,
    "first-heading": first_heading,
    "closure": closure,
    "encounter": encounter,
    "marginal": marginal,
}

if __name__ == "__main__":
    with rc_context(STYLE):
        for name in sys.argv[1:] or PICTURES:
            PICTURES[name]()
