"""Simulated beside real recordings, for docs/simulation.md: features, spectra, and a classifier between the two."""

from collections import defaultdict

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.ndimage import median_filter
from scipy.signal import welch
from scipy.stats import ks_2samp, kurtosis, skew
from tables import DOCS, publish, table

from pdr_graph import dead_reckon, detect_steps
from pdr_graph.gait.steps import uninterrupted
from pdr_graph.geometry import interpolate, wrap_angle
from pdr_graph.io.loading import load
from pdr_graph.lab.simulation.carrying import HOLDS
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Recording, Signal

BANDS = ((0.3, 1.4), (1.4, 2.4), (2.4, 4.5), (4.5, 8.0), (8.0, 15.0))  # [Hz] stride, step, its harmonics, shocks
WINDOW = 5.0  # [s]
RATE = 50.0  # [Hz] to which all recordings are brought
WAYPOINTS, TAPPED = 4.0, 0.66  # [s] between simulated waypoints, [m] per axis: as the Microsoft surveyors'
CROWD = 40  # simulated walkers in each hold
MS, IPIN = "Microsoft, hand", "IPIN, hand"
NAMES = ("cadence [Hz]", "interval CV", "‖a‖ std [m/s²]", *(f"{lo}–{hi} Hz" for lo, hi in BANDS), "‖ω‖ [rad/s]")


def real(data):
    """Group to (hold, walks): the walking parts of real recordings."""
    oxford = sorted((data / "oxford_steps" / "validation").glob("*.csv"))
    groups = {MS: ("hand", sorted((data / "ms_indoor20").glob("site*/*/*.txt")))}
    groups[IPIN] = ("hand", sorted((data / "ipin2023_track3").glob("*Trial*.txt")))
    groups["NJU, hand"] = ("hand", [data / "nju_phyphox_outdoor"])
    groups["IPIN21, hand"] = ("hand", [data / "ipin21_hcu" / "eight"])
    for hold, name in (("hand", "hand"), ("trouser pocket", "frontpocket"), ("bag", "bag")):
        groups[f"Oxford, {hold}"] = (hold, [p for p in oxford if name in p.name])
    groups["Oxford, swinging arm"] = ("swinging arm", [data / "oxford_steps" / "Pixel_Jamie_Hard_SwingingArm_1"])
    for group, (hold, paths) in groups.items():
        walks = [uninterrupted(load(path))[0] for path in paths]
        if group == IPIN:
            walks = [_after(walk, 65.0) for walk in walks]  # shaken and still before
        yield group, hold, walks


def simulated(hold, seeds, manner=None):
    """Walks of about two minutes with corners and a stop."""
    for seed in seeds:
        route = [[0, 0], {"stand": 3}, {"to": [[45, 0], [45, 25], [10, 25]]}, {"stand": 4}]
        route += [{"to": [[10, 5], [30, 5], [30, 20]], "manner": "slow" if seed % 3 == 0 else "normal"}, {"stand": 3}]
        for leg in route:
            if manner and "to" in leg:
                leg["manner"] = manner
        walk = simulate(Scenario.of({"seed": seed, "route": route, "phone": {"hold": hold, "rate": RATE}}))
        yield walk, walk.recording("accelerometer", "gyroscope")


def _after(walk, start):
    def cut(signal):
        keep = signal.time >= start
        return Signal(signal.time[keep], signal.values[keep])

    return Recording(walk.source, 0.0, None, accelerometer=cut(walk.accelerometer), gyroscope=cut(walk.gyroscope))


def windows(walk):
    """Features ``(w, f)`` of each window in which somebody walks, and the lengths of the acceleration in them."""
    steps = detect_steps(walk)
    start, end = walk.accelerometer.time[[0, -1]]
    rows, pieces = [], []
    for begin in np.arange(start, end - WINDOW, WINDOW):
        landed = steps.time[(steps.time >= begin) & (steps.time < begin + WINDOW)]
        interval = np.diff(landed)
        if len(landed) < 6 or interval.max() > 1.0:
            continue
        grid = begin + np.arange(round(WINDOW * RATE)) / RATE
        size = np.linalg.norm(interpolate(grid, walk.accelerometer.time, walk.accelerometer.values), axis=1)
        frequency, power = welch(size - size.mean(), RATE, nperseg=len(grid))
        shares = [power[(frequency >= lo) & (frequency < hi)].sum() / power.sum() for lo, hi in BANDS]
        turn = np.nan
        if walk.gyroscope is not None:
            rate = interpolate(grid, walk.gyroscope.time, walk.gyroscope.values)
            turn = np.linalg.norm(rate, axis=1).mean()
        rows.append([1 / np.median(interval), interval.std() / interval.mean(), size.std(), *shares, turn])
        pieces.append(size)
    return np.array(rows).reshape(-1, len(NAMES)), pieces


def area_under_curve(real_windows, simulated_windows):
    """How well a linear discriminant tells windows apart that it was not fitted to: 0.5 not at all, 1 always.

    Each list has one array per recording; a recording is judged by a discriminant fitted to all others.
    """
    labelled = [(w, 0) for w in real_windows] + [(w, 1) for w in simulated_windows]
    scores = defaultdict(list)
    for held, (mine, label) in enumerate(labelled):
        rest = [(w, kind) for n, (w, kind) in enumerate(labelled) if n != held]
        groups = [np.concatenate([w for w, kind in rest if kind == k]) for k in (0, 1) if any(x == k for _, x in rest)]
        if len(groups) < 2:
            continue
        within = sum(np.cov(g.T) for g in groups) + 1e-6 * np.eye(mine.shape[1])
        direction = np.linalg.solve(within, groups[1].mean(axis=0) - groups[0].mean(axis=0))
        scores[label] += (mine @ direction).tolist()
    if not scores[0] or not scores[1]:
        return np.nan
    a, b = np.array(scores[0]), np.array(scores[1])
    return float(np.mean(b[:, None] > a[None, :]) + 0.5 * np.mean(b[:, None] == a[None, :]))


def apart(some, others):
    """How well the classifier tells two groups of walks apart, by what both have."""
    usable = ~np.isnan(np.concatenate([rows for rows, _ in some + others])).any(axis=0)
    return area_under_curve(*([telling(*walk, usable) for walk in walks] for walks in (some, others)))


def telling(rows, pieces, usable):
    """What the classifier sees of each window: logarithms, and the shape of the acceleration's distribution."""
    shape = np.array([[skew(p), kurtosis(p)] for p in pieces])
    return np.column_stack([np.log(np.maximum(rows[:, usable], 1e-4)), shape])


def compare(data):
    """Features side by side, and whether a classifier tells the two apart."""
    theirs, holds = {}, {}
    for group, holds[group], walks in real(data):
        theirs[group] = _at_least_two([w for w in map(windows, walks) if len(w[0])])
    ours = {}
    for hold in dict.fromkeys(holds.values()):
        ours[hold] = [w for w in (windows(recording) for _, recording in simulated(hold, range(CROWD))) if len(w[0])]

    rows, shown = [], set()
    for group, hold in holds.items():
        rows.append(_described(group, theirs[group]))
        if hold not in shown:
            rows.append(_described(f"**simulated, {hold}**", ours[hold]))
            shown.add(hold)
    publish("simulation.md", "features", table(["", "windows", *NAMES], rows))

    verdicts = []
    for group, hold in holds.items():
        peers = [w for other in theirs if holds[other] == hold and other != group for w in theirs[other]]
        among_real = f"{apart(theirs[group], peers):.2f}" if peers else "—"
        distance = _distances(theirs[group], ours[hold])
        most = ", ".join(f"{name} ({distance[name]:.2f})" for name in sorted(distance, key=distance.get)[:-4:-1])
        verdicts.append([group, f"{apart(theirs[group], ours[hold]):.2f}", among_real, most])
    header = ["group", "from simulated", "from the other real ones", "told from simulated most by (KS distance)"]
    publish("simulation.md", "classifier", table(header, verdicts))
    draw({group: (theirs[group], ours[hold]) for group, hold in holds.items()})


def _at_least_two(walks):
    """Halves of one long recording stand for two."""
    if len(walks) > 1:
        return walks
    (rows, pieces), half = walks[0], len(walks[0][0]) // 2
    return [(rows[part], pieces[part]) for part in (slice(0, half), slice(half, None))]


def _described(name, walks):
    values = np.concatenate([rows for rows, _ in walks])
    low, middle, high = np.percentile(values, [10, 50, 90], axis=0)
    cells = [
        "—" if np.isnan(m) else f"{m:.2f} ({lo:.2f}–{hi:.2f})" for lo, m, hi in zip(low, middle, high, strict=True)
    ]
    return [name, len(values), *cells]


def _distances(theirs, ours):
    """Kolmogorov and Smirnov's distance of each feature's distributions: 0 alike, 1 apart."""
    one, other = (np.concatenate([rows for rows, _ in walks]) for walks in (theirs, ours))
    known = [k for k in range(len(NAMES)) if not np.isnan(one[0, k])]
    return {NAMES[k]: ks_2samp(one[:, k], other[:, k]).statistic for k in known}


def draw(groups):
    """Spectra of ‖a‖, real and simulated, group by group."""
    figure = Figure(figsize=(13, 6), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, group in zip(figure.subplots(2, 4, sharex=True).flat, groups, strict=True):
        for name, colour, walks in zip(("real", "simulated"), ("0.35", "tab:blue"), groups[group], strict=True):
            pieces = [piece for _, pieces in walks for piece in pieces]
            power = np.array([welch(p - p.mean(), RATE, nperseg=len(p))[1] for p in pieces])
            frequency = np.fft.rfftfreq(len(pieces[0]), 1 / RATE)
            low, middle, high = np.percentile(power, [25, 50, 75], axis=0)
            axes.semilogy(frequency, middle, color=colour, label=name)
            axes.fill_between(frequency, low, high, color=colour, alpha=0.2, lw=0)
        axes.set(title=group, xlim=(0, 15), ylim=(1e-3, 1e2))
    axes.legend()
    figure.supxlabel("frequency of ‖a‖ [Hz]; bands hold half of the windows")
    figure.supylabel("power density [m²/s⁴/Hz]")
    figure.savefig(DOCS / "simulation.png", dpi=80)


def front_end(data):
    """Errors of the default front end: the real walks with waypoints, and simulated ones."""
    rows = []
    microsoft = [walk for group, _, walks in real(data) if group == MS for walk in walks]
    rows.append(
        ["Microsoft, hand, real", len(microsoft), *_errors((w, w.truth.time, w.truth.position) for w in microsoft)]
    )
    for hold, manner in [(hold, None) for hold in HOLDS if hold != "cart"] + [("hand", "browse")]:
        walks = []
        for walk, recording in simulated(hold, range(CROWD), manner):
            at = np.arange(3.0, walk.body.time[-1] - 3.0, WAYPOINTS)
            place = interpolate(at, walk.body.time, walk.body.position)
            tapped = place + np.random.default_rng(0).normal(0, TAPPED, place.shape)
            walks.append((recording, at, tapped))
        rows.append([", ".join(filter(None, ("simulated", hold, manner))), len(walks), *_errors(walks)])
    header = ["walks", "", "length / way", "course error median [deg]", "95 % [deg]", "turn noise per step [deg]"]
    publish("simulation.md", "front end", table(header, rows))


def _errors(walks):
    """Stride error per walk, course error between waypoints, turn noise."""
    ratios, courses, noise = [], [], []
    for walk, at, place in walks:
        steps = detect_steps(walk)
        track = dead_reckon(steps)
        there = interpolate(at, track.time, track.position)
        leg, ours = np.diff(place, axis=0), np.diff(there, axis=0)
        far = (np.hypot(*leg.T) > 3.0) & (np.hypot(*ours.T) > 1.0)
        between = (steps.time > at[0]) & (steps.time <= at[-1])
        ratios.append(steps.length[between].sum() / np.hypot(*leg.T).sum())
        turned = np.arctan2(*leg[far].T[::-1]) - np.arctan2(*ours[far].T[::-1])
        centre = np.angle(np.exp(1j * turned).mean()) if far.any() else 0.0
        courses += np.abs(wrap_angle(turned - centre)).tolist()
        noise.append(np.std(steps.turn - median_filter(steps.turn, 9)))
    low, high = min(ratios), max(ratios)
    median, worst = np.degrees(np.percentile(courses, [50, 95]))
    return [
        f"{np.mean(ratios):.2f} ({low:.2f}–{high:.2f})",
        f"{median:.1f}",
        f"{worst:.0f}",
        f"{np.degrees(np.median(noise)):.1f}",
    ]


def simulation(data):
    """All of docs/simulation.md."""
    compare(data)
    front_end(data)
