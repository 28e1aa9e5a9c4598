"""Steps and strides on real recordings: counts, false steps, lengths by every model, what a profile adds."""

import numpy as np
from scipy.optimize import least_squares
from tables import publish, table

from pdr_graph import Walker, WalkGraph, detect_steps, smooth
from pdr_graph.estimation.calibration import posterior_profile, prior_of
from pdr_graph.frames import enu
from pdr_graph.gait import walker
from pdr_graph.gait.step_detection import walking_steps
from pdr_graph.gait.steps import gait_signals
from pdr_graph.gait.walker import StepFeatures
from pdr_graph.inertial.attitude import attitude_of
from pdr_graph.io.loading import load
from pdr_graph.lab.papers.gait_methods import peak_pairs, trough_to_peak
from pdr_graph.priors import STRIDES
from pdr_graph.types import LONLAT, Fixes

OXFORD = {  # true counts of the data page
    "hand": ("user1_hand", 326),
    "trouser pocket": ("user1_frontpocket", 327),
    "bag": ("user1_bag", 346),
    "swinging arm, switch rises": ("SwingingArm", 284),
    "swinging arm, feet in turn": ("SwingingArm", 264),
}
DETECTORS = {
    "[map-matching] peak pairs": peak_pairs,
    "[calibration-walk] candidates": trough_to_peak,
    "**ours**": lambda attitude: walking_steps(attitude.time, attitude.acceleration),
}
QUIET = {"IPIN 2023": 60.0, "IPIN21": 4.0}  # [s] from the start
LONG = 35.0  # [m]
CHAINS = {"site1/B1": "5ddb8a0", "site1/F1": "5dd9ef", "site2/F1": "5dd36"}


def steps(data):
    """The tables."""
    counts(data)
    quiet(data)
    walks = measured(data)
    strides(walks)
    profiles(walks)


def counts(data):
    """Steps of the Oxford recordings, of an accelerometer alone."""
    rows = []
    for name, true, path in oxford(data):
        attitude = attitude_of(load(path))
        found = [len(detect(attitude)) for detect in DETECTORS.values()]
        rows.append([name, true, *(beside(n, true) for n in found)])
    publish("results/steps.md", "counts", table(["recording", "true", *DETECTORS], rows))


def oxford(data):
    """Each count of the Oxford recordings: what it is of, the true one, and the file."""
    files = sorted((data / "oxford_steps").glob("validation/*.csv")) + sorted((data / "oxford_steps").glob("Pixel*"))
    for name, (part, true) in OXFORD.items():
        yield name, true, next(f for f in files if part in f.name)


def beside(found, true):
    """A count, and by how much it is off."""
    return f"{found} ({100 * (found / true - 1):+.1f} %)"


def quiet(data):
    """Steps found where nobody walked."""
    paths = {
        "IPIN 2023": sorted((data / "ipin2023_track3").glob("*Trial*.txt")),
        "IPIN21": [data / "ipin21_hcu" / "eight"],
    }
    rows = []
    for name, files in paths.items():
        attitudes = [attitude_of(load(path)) for path in files]
        found = [sum(int((detect(a).time < QUIET[name]).sum()) for a in attitudes) for detect in DETECTORS.values()]
        rows.append([f"{name}, first {QUIET[name]:.0f} s of {len(files)}", *found])
    publish("results/steps.md", "quiet", table(["", *DETECTORS], rows))


class Measured:
    """A walk whose way between some moments is known: legs of distance [m], share of each step, which steps."""

    def __init__(self, name, walk, truth, every=1):
        self.name = name
        self.truth = enu(*truth.position[0][::-1]).place(truth) if truth.epsg == LONLAT else truth
        self.gait = gait_signals(walk)[0]
        self.features, landings = StepFeatures(self.gait), self.gait.landings
        begin, time = landings.time - landings.period, self.truth.time[::every]
        self.legs = []
        for a, b, move in zip(time[:-1], time[1:], np.diff(self.truth.position[::every], axis=0), strict=True):
            share = np.clip(np.minimum(landings.time, b) - np.maximum(begin, a), 0, None) / landings.period
            if share.any():
                self.legs.append((float(np.hypot(*move)), share))
        self.way = sum(distance for distance, _ in self.legs)

    def ratio(self, lengths):
        """Walked length by a model over the true one."""
        return sum(share @ lengths for _, share in self.legs) / self.way


def measured(data):
    """Microsoft's walks, and those that no constant was chosen on."""
    walks = []
    for path in sorted((data / "ms_indoor20").glob("site*/*/*.txt")):
        walk = load(path)
        walks.append(Measured(f"{path.parent.parent.name}/{path.parent.name} {path.stem[:8]}", walk, walk.truth))
    for path in sorted((data / "ipin2023_track3").glob("*Trial[02]*.txt")):  # Trial52 climbs stairs
        walk = load(path)
        walks.append(Measured(path.stem.split("Training")[1].split("_")[0], walk, walk.truth))
    walk = load(data / "ipin21_hcu" / "eight")
    walks.append(Measured("IPIN21", walk, walk.truth, every=8))
    walk = load(data / "nju_phyphox_outdoor")
    walks.append(Measured("NJU", walk, walk.fixes, every=12))
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
    left_out = np.array([walk.ratio(refitted(known, walk)) for walk in known])
    rows.append(["inverted pendulum, k₁ of the other chains", *spread(known, left_out), *[""] * len(others)])
    header = ["model / true length", f"{LONG:.0f} m and more: bias", "spread", "all fifteen: bias", "spread"]
    publish("results/steps.md", "stride", table([*header, *(walk.name for walk in others)], rows))
    cells = [[w.name, f"{w.way:.0f}", len(w.gait.landings), f"{r:.2f}"] for w, r in zip(known, left_out, strict=True)]
    publish(
        "results/steps.md",
        "stride by walk",
        table(["walk", "way [m]", "steps", "model / true, k₁ of the others"], cells),
    )


def spread(walks, ratios):
    """Bias and spread of the long walks, and of all. [%]"""
    long = np.array([walk.way >= LONG for walk in walks])
    return [f"{100 * v:.1f} %" for of in (ratios[long], ratios) for v in (of.mean() - 1, of.std())]


def chain_of(walk):
    """The walks of one walker, which a fit must not share out."""
    return next((c for c, start in CHAINS.items() if walk.name.startswith(f"{c} {start}")), walk.name)


def refitted(walks, walk):
    """Step lengths of a walk by the default model, its k₁ fitted to the legs of everybody else."""
    rest = [other for other in walks if chain_of(other) != chain_of(walk)]
    legs = [(d, share.sum(), share @ bounce(other)) for other in rest for d, share in other.legs]
    distance, count, bounced = np.array(legs).T
    sigma = np.sqrt(2 * 0.47**2 + 0.15**2 * count)
    k = least_squares(lambda k: (STRIDES.k0 * count + k[0] * bounced - distance) / sigma, [0.3], loss="soft_l1").x[0]
    return STRIDES.k0 + k * bounce(walk)


def bounce(walk):
    """√A T of each step."""
    return np.sqrt(walk.features.amplitude) * walk.features.period


def profiles(walks):
    """The length of a chain's walk by the model alone, and with the profile that the rest of the chain taught."""
    rows, plain, taught = [], [], []
    for chain in CHAINS:
        pieces = [walk for walk in walks if chain_of(walk) == chain]
        for piece in pieces:
            profile = None
            for other in pieces:
                profile = profile if other is piece else learnt(other, profile)
            factor = 1 + profile.E_length
            lengths = walker.inverted_pendulum(piece.features)[0]
            plain.append(piece.ratio(lengths))
            taught.append(piece.ratio(factor * lengths))
            rows.append([piece.name, f"{piece.way:.0f}", f"{plain[-1]:.2f}", f"{factor:.2f}", f"{taught[-1]:.2f}"])
    for name, of in (("mean", np.mean), ("spread", np.std)):
        rows.append([f"**{name}**", "", f"{of(plain):.3f}", "", f"{of(taught):.3f}"])
    header = ["walk", "way [m]", "model / true", "profile's 1 + E_length", "with profile / true"]
    publish("results/steps.md", "profiles", table(header, rows))


def learnt(measured_walk, known):
    """The profile after another walk of the same person, with all its waypoints given."""
    truth = measured_walk.truth
    steps = detect_steps([measured_walk.gait], Walker(profile=known))
    fixes = Fixes(truth.time, truth.position, np.full(len(truth), 0.5), ("",) * len(truth))
    return posterior_profile(smooth(WalkGraph(steps, fixes, prior=prior_of(known))), steps, known)
