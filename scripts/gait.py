"""The front end: step counts and lengths on real recordings, and headings of the compass."""

import re
import sys
from pathlib import Path

import numpy as np
from conditions import percentiles, recordings, with_steps
from recordings import rows_of
from scipy.optimize import least_squares
from tables import publish, table

from pdr_graph import Fixes, Trajectory, WalkGraph, detect_steps, smooth
from pdr_graph.apps.bench.matrix import ERRORS, known, places, stated
from pdr_graph.estimation.results import missing_steps
from pdr_graph.gait import walker
from pdr_graph.gait.heading import walking_direction
from pdr_graph.gait.step_detection import walking_steps
from pdr_graph.gait.steps import gait_signals
from pdr_graph.gait.walker import LARGEST_BEND, StepFeatures, Walker
from pdr_graph.geometry import REGION_90, interpolate, wrap_angle
from pdr_graph.inertial.attitude import attitude_of
from pdr_graph.lab.papers.gait_methods import peak_pairs, trough_to_peak
from pdr_graph.lab.simulation.carrying import with_grip_change
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.priors import STRIDES
from pdr_graph.walk import Evidence

sys.path.append(str(Path(__file__).parents[1] / "tests"))
import gait_data
from gait_data import heading_errors, known_places, live_headings

DETECTORS = {
    "[map-matching] peak pairs": peak_pairs,
    "[calibration-walk] candidates": trough_to_peak,
    "**ours**": lambda attitude: walking_steps(attitude.time, attitude.acceleration),
}
LONG = 35.0  # [m]
CHAINS = {"site1/B1": "5ddb8a0", "site1/F1": "5dd9ef", "site2/F1": "5dd36"}
HOLDS = ("hand", "swinging arm", "trouser pocket", "breast pocket", "bag")
CARRIES = {"leg": "trouser pocket", "bag": "bag", "handheld": "hand", "body": "body"}  # by RIDI's names
WALKERS = {"NA": "sighted", "WC": "long cane", "GD": "guide dog"}
PACES = ("slow", "normal", "fast", "jog", "run", "sprint")
RUNS = {
    "walk": ("normal",) * 5,
    "jog": ("jog",) * 5,
    "run": ("run",) * 5,
    "walk, jog, walk": ("normal", "jog", "jog", "jog", "normal"),
    "walk, run, walk": ("normal", "run", "run", "run", "normal"),
}
LIVE_WALKS = 12  # per hold
SENSORS = ("accelerometer", "gyroscope", "magnetometer")
ASIDE = re.compile("_side|hang_body_test")  # RIDI's walks with steps sideways or backwards


def steps(data):
    """The tables."""
    counts(data)
    parity(data)
    quiet(data)
    paces = list(true_walks(data))
    carry_and_pace(data, paces)
    confidence(data, paces)
    runs()
    carried(data)
    walks = measured(data)
    strides(walks)
    left_out(walks, paces)


def counts(data):
    """Steps of the Oxford recordings, of an accelerometer alone."""
    rows = []
    for name, walk in recordings(data, "oxford").items():
        attitude = attitude_of(walk.evidence.walk)
        found = [len(detect(attitude)) for detect in DETECTORS.values()]
        rows.append([name, walk.steps, *(with_error(n, walk.steps) for n in found)])
    publish("results/steps.md", "counts", table(["recording", "true", *DETECTORS], rows))


def parity(data):
    """Errors of the steps by kind of walker, and of how many walks it is said that steps are missing."""
    found = {}
    for walk in gait_data.weallwalk(data):
        steps = detect_steps(walk.recording)
        error = 100 * abs(len(steps) / walk.steps - 1), len(missing_steps(steps))
        found.setdefault(WALKERS[walk.data_set.split()[1]], []).append(error)
    rows, sighted = [], np.percentile([error for error, _ in found["sighted"]], [50, 90, 100])
    for kind, of in found.items():
        errors = np.percentile([error for error, _ in of], [50, 90, 100])
        cells = [f"{error:.1f} % ({error / usual:.1f})" for error, usual in zip(errors, sighted, strict=True)]
        rows.append([kind, len(of), *cells, sum(said for _, said in of)])
    header = ["walkers", "phones", "error: median (by the sighted)", "90 %", "largest", "said to be missing"]
    publish("results/steps.md", "parity", table(header, rows))


def with_error(found, true):
    """A count, and by how much it is off."""
    return f"{found} ({100 * (found / true - 1):+.1f} %)"


def quiet(data):
    """Steps found where nobody walked."""
    rows = []
    for name, walks, until in (
        ("IPIN 2023", recordings(data, "ipin2023").values(), 60.0),
        ("IPIN21", [recordings(data, "ipin21")["landmarks"]], 4.0),
    ):
        attitudes = [attitude_of(walk.evidence.walk) for walk in walks]
        found = [sum(int((detect(a).time < until).sum()) for a in attitudes) for detect in DETECTORS.values()]
        rows.append([f"{name}, first {until:.0f} s of {len(attitudes)}", *found])
    publish("results/steps.md", "quiet", table(["", *DETECTORS], rows))


class Paced:
    """A walk with true steps and length, its walker, and what the model needs of its steps."""

    def __init__(self, name, walk, walker):
        self.name, self.walker, self.steps, self.way = name, walker, walk.steps, walk.length
        self.duration = float(np.ptp(walk.evidence.walk.accelerometer.time))
        self.gait = gait_signals(walk.evidence.walk)[0]
        self.features = StepFeatures(self.gait)
        self.lengths = walker_models()(self.features)[0]

    def ratio(self, lengths):
        """Walked length by a model over the true one."""
        return float(lengths.sum()) / self.way


def walker_models():
    """The default model."""
    return walker.MODELS[walker.DEFAULT_STRIDE]


def true_walks(data):
    """The walks of ``strides`` and ``ridi``."""
    yield from (Paced(name, walk, "strides") for name, walk in recordings(data, "strides").items())
    yield from (Paced(name, walk, f"RIDI, {name.split('_')[0]}") for name, walk in recordings(data, "ridi").items())


def carry_and_pace(data, walks):
    """Errors of steps and lengths by carry and pace, of recordings and of simulated walks."""
    errors = {}
    for walk in walks:
        carry = "hand" if walk.walker == "strides" else CARRIES[walk.name.split("_")[1].rstrip("0123456789")]
        speed = walk.way / walk.duration
        at = "slow" if speed < 0.8 else "normal" if speed < 1.3 else "fast"
        counted = len(walk.gait.landings) / walk.steps - 1, float(walk.lengths.sum()) / walk.way - 1
        errors.setdefault((carry, "recorded", at), []).append(counted)
    for name, walk in recordings(data, "oxford").items():
        if not name.endswith("switch rises"):
            attitude = attitude_of(walk.evidence.walk)
            counted = len(walking_steps(attitude.time, attitude.acceleration)) / walk.steps - 1, np.nan
            errors.setdefault((name.split(",")[0], "recorded", "normal"), []).append(counted)
    for hold in HOLDS:
        for manner in PACES:
            for seed in range(4):
                walk = simulate(Scenario.of(paced(manner, hold, seed)))
                gait = gait_signals(walk.recording(*SENSORS[:2]))[0]
                length = walker_models()(StepFeatures(gait), height=walk.walker.height)[0].sum()
                counted = len(gait.landings) / len(walk.body.landings) - 1, length / walk.body.lengths.sum() - 1
                errors.setdefault((hold, "simulated", manner), []).append(counted)
    rows = []
    for carry in (*HOLDS, "body"):
        for kind in ("recorded", "simulated"):
            cells = [cell(np.array(errors.get((carry, kind, manner), []))) for manner in PACES]
            if any(cells):
                rows.append([carry, kind, *cells])
    publish("results/steps.md", "carry and pace", table(["carried", "", *PACES], rows))


def cell(errors):
    """The mean error of the steps, and the root mean square error of the length, of walks ``(n, 2)``."""
    if not len(errors):
        return ""
    steps, length = errors[:, 0].mean(), errors[np.isfinite(errors[:, 1]), 1]
    return f"{100 * steps:+.1f} %" + (f", {100 * np.sqrt(np.mean(length**2)):.0f} %" if len(length) else "")


def paced(manner, hold, seed):
    """A scenario of one pace."""
    corners = [[90, 0], [90, 60], [0, 60]]
    route = [[0, 0], {"stand": 4}, {"to": corners, "manner": manner}, {"stand": 4}]
    return {"seed": seed, "route": route, "phone": {"hold": hold}}


def runs():
    """Runs, alone and between walks: lengths by the model, and with fixes; and how often the region holds."""
    rows = []
    for name, manners in RUNS.items():
        found = [run(manners, hold, seed) for hold in ("hand", "trouser pocket") for seed in range(4)]
        for given in ("start and a quarter", "every 10 s"):
            ratio, inside = zip(*[each[given] for each in found], strict=True)
            off = 100 * np.abs(np.array(ratio) - 1)
            rows.append(
                [name, given, f"{np.median(off):.0f} %", f"{off.max():.0f} %", f"{100 * np.mean(inside):.0f} %"]
            )
    header = ["", "fixes", "error of the length: median", "largest", "in 90 %"]
    publish("results/steps.md", "runs", table(header, rows))


def run(manners, hold, seed):
    """Estimated by true length and share of moments in the 90 % region, by fixes."""
    corners = [[40, 0], [120, 0], [120, 100], [40, 100], [40, 60]]
    route = [[0, 0], {"stand": 3}, *({"to": [c], "manner": m} for c, m in zip(corners, manners, strict=True))]
    walk = simulate(Scenario.of({"seed": seed, "route": [*route, {"stand": 3}], "phone": {"hold": hold}}))
    body, random, scores = walk.body, np.random.default_rng(seed), {}
    steps = detect_steps(walk.recording(*SENSORS[:2]), Walker(height=walk.walker.height))
    end = float(body.time[-1])
    for given, time, sigma in (
        ("start and a quarter", np.array([0.2, end / 4]), 0.3),
        ("every 10 s", np.arange(0.5, end, 10.0), 1.5),
    ):
        place = interpolate(time, body.time, body.position) + random.normal(0, sigma, (len(time), 2))
        track = smooth(WalkGraph(steps, Fixes(time, place, np.full(len(time), sigma)))).trajectory
        moments = np.arange(0.5, end - 0.5, 0.5)
        true = interpolate(moments, body.time, body.position)
        inside = np.nanmean(places(track, Trajectory(moments, true, np.full(len(moments), np.nan)), 0.0)[1])
        scores[given] = float(np.hypot(*np.diff(track.position, axis=0).T).sum() / body.lengths.sum()), float(inside)
    return scores


def confidence(data, walks):
    """How many of the steps of a stated confidence are steps: of recordings, simulated walks, and where nobody walked.

    The latter have 15 % of the weight; all recordings count the same.
    """
    stated = [(walk.gait.landings.confidence, 1) for walk in walks]
    for walk in recordings(data, "oxford").values():
        attitude = attitude_of(walk.evidence.walk)
        stated.append((walking_steps(attitude.time, attitude.acceleration).confidence, 1))
    for hold in HOLDS:
        for manner in PACES:
            signal = simulate(Scenario.of(paced(manner, hold, seed=0))).signals["accelerometer"]
            stated.append((walking_steps(signal.time, signal.values).confidence, 1))
    for speed in (8.0, 14.0, 30.0):
        for seed in range(4):
            rough = gait_data.quarter_car(speed, 256e-6, seed=seed)
            stated.append((walking_steps(*gait_data.in_hand(rough)).confidence, 0))
    stated = [(steps, true) for steps, true in stated if len(steps)]
    said, true = (np.concatenate(v) for v in zip(*((s, np.full(len(s), t)) for s, t in stated), strict=True))
    weight = np.concatenate([np.full(len(s), 1 / len(s)) for s, _ in stated])
    weight *= np.where(true == 1, 0.85 / weight[true == 1].sum(), 0.15 / weight[true == 0].sum())
    rows = []
    for low, high in ((0, 0.5), (0.5, 0.7), (0.7, 0.85), (0.85, 0.9), (0.9, 1.0)):
        of = (said >= low) & (said < high)
        shares = (np.sum(weight[of]), *(np.average(v[of], weights=weight[of]) for v in (said, true)))
        rows.append([f"{low} to {high}", *(f"{100 * share:.0f} %" for share in shares)])
    publish("results/steps.md", "confidence", table(["confidence", "of all", "stated", "true"], rows))


def carried(data):
    """Positions of the RIDI walks, which are given where they begin and where they are after a quarter of the time."""
    rows, walks = [], rows_of(data, "ridi", ("first and 25 %, no compass",), ("graph",))
    for carry, name in CARRIES.items():
        group = [row for row in walks if carry in row["walk"]]
        for which, of in (
            (name, [row for row in group if not ASIDE.search(row["walk"])]),
            (f"{name}, sideways or backwards", [row for row in group if ASIDE.search(row["walk"])]),
        ):
            if of:
                errors, regions = np.concatenate([known(row, ERRORS) for row in of]), [stated(row)[:, 0] for row in of]
                inside, least = np.concatenate(regions) < REGION_90, min(np.mean(d < REGION_90) for d in regions)
                cells = [percentiles(errors), f"{np.sqrt(np.mean(errors**2)):.2f}"]
                rows.append([which, len(of), *cells, f"{100 * inside.mean():.0f} %", f"{100 * least:.0f} %"])
    header = ["carried", "walks", "error [m]", "rms [m]", "in 90 %", "of the worst walk"]
    publish("results/steps.md", "carried", table(header, rows))


def left_out(walks, paces):
    """Lengths by the default model, its constants fitted to everybody else: errors by data set."""
    groups = {"strides": [], "RIDI": [], "Microsoft": [], "others": []}
    every = [*walks, *paces]
    for walk in every:
        k0, k1 = fitted([other for other in every if walker_of(other) != walker_of(walk)])
        by = walker_of(walk)
        group = next((g for g in groups if by.startswith(g)), "Microsoft" if walk.name.startswith("site") else "others")
        groups[group].append(walk.ratio(k0 * in_bends(walk) + k1 * bounce(walk)) - 1)
    rows = []
    for name, errors in groups.items():
        size = 100 * np.abs(errors)
        cells = [f"{np.median(size):.1f} %", f"{size.max():.1f} %", f"{100 * np.mean(errors):+.1f} %"]
        rows.append([name, len(errors), *cells])
    k0, k1 = fitted(every)
    print(f"k₀ {k0:.3f} m, k₁ {k1:.3f} √(m/s) → m, fitted to all")
    publish("results/steps.md", "left out", table(["", "walks", "error: median", "largest", "mean"], rows))


def walker_of(walk):
    """The walker of a walk, whose walks a fit leaves out together."""
    return walk.walker if isinstance(walk, Paced) else chain_of(walk)


def fitted(walks):
    """k₀ and k₁ of the default model: each walker counts the same, a walk below 40 m less."""
    names = [walker_of(walk) for walk in walks]
    weight = np.array(
        [np.sqrt(min(1.0, walk.way / 40) / names.count(name)) for walk, name in zip(walks, names, strict=True)]
    )
    once = np.array([[walk.ratio(in_bends(walk)), walk.ratio(bounce(walk))] for walk in walks])
    return least_squares(lambda k: weight * np.log(once @ k), [0.5, 0.1], loss="soft_l1", f_scale=0.05).x


class Measured:
    """A walk whose way between some moments is known: legs of distance [m], share of each step, which steps."""

    def __init__(self, name, walk, every=1):
        self.name, self.gait = name, gait_signals(walk.evidence.walk)[0]
        self.features, landings = StepFeatures(self.gait), self.gait.landings
        known = known_places(walk)[::every]
        begin, time, self.legs = landings.time - landings.period, known.time, []
        for a, b, move in zip(time[:-1], time[1:], np.diff(known.position, axis=0), strict=True):
            share = np.clip(np.minimum(landings.time, b) - np.maximum(begin, a), 0, None) / landings.period
            if share.any():
                self.legs.append((float(np.hypot(*move)), share))
        self.way = sum(distance for distance, _ in self.legs)

    def ratio(self, lengths):
        """Walked length by a model over the true one."""
        return sum(share @ lengths for _, share in self.legs) / self.way


def measured(data):
    """Microsoft's walks, and those that no constant was chosen on."""
    walks = [Measured(name, walk) for name, walk in recordings(data, "microsoft").items()]
    for name, walk in recordings(data, "ipin2023").items():
        if not name.startswith("Trial52"):  # it climbs stairs
            walks.append(Measured(name.split("_")[0], walk))
    walks.append(Measured("IPIN21", recordings(data, "ipin21")["Freq5_err3m"], every=8))
    walks.append(Measured("NJU", recordings(data, "nju")["campus"]))
    return walks


def strides(walks):
    """Dead-reckoned length over the true one, by model: Microsoft's fifteen, and the four others."""
    known = [walk for walk in walks if walk.name.startswith("site")]
    others = [walk for walk in walks if walk not in known]
    rows = []
    for name, model in walker.MODELS.items():
        ratios, elsewhere = (np.array([w.ratio(model(w.features)[0]) for w in of]) for of in (known, others))
        shown = f"**{name}**" if name == "inverted pendulum" else name
        rows.append([shown, *spread(known, ratios), *(f"{ratio:.2f}" for ratio in elsewhere)])
    header = ["model / true length", f"{LONG:.0f} m and more: bias", "spread", "all fifteen: bias", "spread"]
    publish("results/steps.md", "stride", table([*header, *(walk.name for walk in others)], rows))


def spread(walks, ratios):
    """Bias and spread of the long walks, and of all. [%]"""
    long = np.array([walk.way >= LONG for walk in walks])
    return [f"{100 * v:.1f} %" for of in (ratios[long], ratios) for v in (of.mean() - 1, of.std())]


def chain_of(walk):
    """The walks of one walker, which a fit must not share out."""
    return next((c for c, start in CHAINS.items() if walk.name.startswith(f"{c} {start}")), walk.name)


def in_bends(walk):
    """Share of its length that each step has in a bend."""
    turned = np.minimum(np.degrees(np.abs(walk.features.bend)), LARGEST_BEND)
    return 1 - STRIDES.turn_shortens / 100 * turned


def bounce(walk):
    """√(A T) of each step, shortened in bends."""
    return np.sqrt(walk.features.amplitude * walk.features.period) * in_bends(walk)


# Compass


WALKS = {"Microsoft": "microsoft", "IPIN 2023": "ipin2023", "NJU campus": "nju"}  # in the hand


def compass(data):
    """The tables."""
    rows = []
    for name, of in WALKS.items():
        walks = [with_steps(walk) for walk in recordings(data, of).values()]
        found = [(heading_errors(walk, walk.evidence.headings), walk.evidence.headings.sigma) for walk in walks]
        errors, sigmas = np.concatenate(found, axis=1)
        size = np.degrees(np.abs(errors))
        stated = f"{np.degrees(sigmas.min()):.0f}–{np.degrees(sigmas.max()):.0f}"
        cells = [f"{np.median(size):.0f}", f"{size.max():.0f}", stated]
        rows.append([name, len(walks), len(size), *cells, f"{np.sqrt(np.mean((errors / sigmas) ** 2)):.2f}"])
    header = ["walks", "", "headings", "error [deg]: median", "largest", "stated sigma [deg]", "rms error / sigma"]
    publish("results/compass.md", "compass", table(header, rows))
    live_compass(data)
    grips(data)


def grips(data):
    """Directions after the grip has changed: a quarter turn of the hand put into real walks, and simulated pockets."""
    rows, quarter = [], []
    for walk in recordings(data, "microsoft").values():
        recording = walk.evidence.walk
        attitude = attitude_of(recording)
        landed = walking_steps(attitude.time, attitude.acceleration)
        if len(landed) < 60:
            continue
        at, plain = float(landed.time[len(landed) // 2]), walking_direction(attitude, landed.usual_step)
        up = attitude.R_world_device[int(np.searchsorted(attitude.time, at))].inv().apply([0.0, 0.0, 1.0])
        for angle in (np.pi / 2, -np.pi / 2):
            turned = attitude_of(with_grip_change(recording, up, at, angle))
            quarter.append(walking_direction(turned, landed.usual_step).heading[-1] - plain.heading[-1])
    rows.append(["a quarter turn of a real hand", *direction_cells(quarter)])
    for name, angle in {"straight on": 0, "aside": 90, "back": 180}.items():
        errors = [gait_data.put_away(angle, seed)[1] for seed in range(40)]
        rows.append([f"stands, into a pocket, then {name}", *direction_cells(errors)])
    header = ["the grip changes", "walks", "error [deg]: median", "90 %", "within 40°"]
    publish("results/compass.md", "grips", table(header, rows))


def direction_cells(errors):
    """Number, median, 90 % and share within 40° of errors [rad]."""
    size = np.degrees(np.abs(wrap_angle(np.array(errors))))
    return [len(size), f"{np.median(size):.0f}", f"{np.percentile(size, 90):.0f}", f"{100 * np.mean(size < 40):.0f} %"]


def live_compass(data):
    """The first headings of the live compass: when, and how honest, on real walks and simulated ones in five holds."""
    rows = [
        live_row(name, [live_recorded(walk) for walk in recordings(data, of).values()]) for name, of in WALKS.items()
    ]
    for hold in HOLDS:
        rows.append(live_row(f"simulated, {hold}", [live_simulated(hold, seed) for seed in range(LIVE_WALKS)]))
    header = ["walks", "", "with a heading", "first heading after [s]: median", "90 %", "error [deg]: median"]
    publish("results/compass.md", "live compass", table([*header, "largest", "sigma: median"], rows))


def live_row(name, walks):
    """A row of the table from the headings of each walk: seconds since the first step, error and sigma [rad]."""
    first = np.array([walk[0] for walk in walks if len(walk)])
    error, sigma = np.degrees(np.abs(first[:, 1])), np.degrees(np.median(first[:, 2]))
    when = [f"{np.percentile(first[:, 0], share):.0f}" for share in (50, 90)]
    return [name, len(walks), len(first), *when, f"{np.median(error):.0f}", f"{error.max():.0f}", f"{sigma:.0f}"]


def live_recorded(walk):
    """Of a real walk: seconds since the first step, error and sigma of each heading."""
    walk = with_steps(walk)
    steps, (moment, headings) = walk.evidence.steps, live_headings(walk.evidence)
    start = steps.time[0] - steps.duration[0]
    return np.column_stack([moment - start, heading_errors(walk, headings), headings.sigma])


def live_simulated(hold, seed):
    """The same of a simulated walk: 110 m with two corners, after three seconds of standing."""
    route = [[0, 0], {"stand": 3}, {"to": [[40, 0], [40, 30], [0, 30]]}]
    walk = simulate(Scenario.of({"seed": seed, "route": route, "phone": {"hold": hold, "rate": 50}}))
    evidence = Evidence(walk.recording(*SENSORS), Walker(), None, walk.frame, Fixes.none())
    moment, headings = live_headings(evidence)
    error = wrap_angle(headings.heading - np.interp(headings.time, walk.body.time, walk.body.heading))
    return np.column_stack([moment - 3, error, headings.sigma])
