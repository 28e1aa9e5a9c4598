"""Gyro drift of real and simulated phones, for the prior of b: its likelihood in each session with a wide prior."""

from dataclasses import dataclass, replace

import numpy as np
from integrity_walks import route_outdoors, with_stands
from microsoft import recordings
from recorded import given, ipin21_walks, ipin2023_walks, nju_walk
from tables import publish, table

from pdr_graph import WalkGraph, detect_steps, smooth
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.geometry import dead_reckon
from pdr_graph.io.loading import load
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Fixes

WIDE = 0.03  # [rad/s] prior sigma of b: ten times what is measured
SIGMAS = (0.001, 0.0015, 0.002, 0.0025, 0.003, 0.0035, 0.005)  # [rad/s] of a population
PHONES = {"IPIN 2023, Trial01": "SM-A520F", "IPIN 2023, Trial24": "SM-G930F", "IPIN 2023, Trial52": "SM-G930F"}
HOLDS, CROWD = ("hand", "trouser pocket", "swinging arm", "bag"), 24  # simulated phones of each kind
EVERY = 100  # samples between two rows of the truth: 1 s


@dataclass(frozen=True)
class Drift:
    """The likelihood of b [rad/s] in one walk, as a Gaussian."""

    value: float
    sigma: float

    @classmethod
    def of(cls, steps, fixes):
        """The posterior of a walk without its wide prior."""
        calibration = smooth(WalkGraph(steps, fixes, prior=prior_of_drift(WIDE))).calibration
        best = int(np.argmin(calibration.sigma[:, 2]))
        value, sigma = calibration.value[best, 2], min(calibration.sigma[best, 2], 0.999 * WIDE)
        information = sigma**-2 - WIDE**-2
        return cls(value / sigma**2 / information, information**-0.5)

    @classmethod
    def shared(cls, drifts):
        """That of several walks of one session."""
        weight = np.array([drift.sigma**-2 for drift in drifts])
        return cls(float(weight @ [drift.value for drift in drifts] / weight.sum()), float(weight.sum() ** -0.5))

    def surprise(self, sigma):
        """Negative log likelihood of a population with this standard deviation of b, zero mean."""
        variance = sigma**2 + self.sigma**2
        return 0.5 * (self.value**2 / variance + np.log(variance))


def prior_of_drift(sigma):
    """The usual prior with another sigma of b [rad/s]."""
    usual = Prior()
    return replace(usual, sigma=(*usual.sigma[:2], sigma))


def walks(data):
    """Phone, session, steps and known places of each recording that has some."""
    for _, walk in recordings(data):
        yield "OPPO PBCM10", f"Microsoft {session_of(walk)}", walk.steps, given(walk.truth, slice(None))
    for walk in ipin2023_walks(data):
        name = f"IPIN 2023, {walk.name.split('Training')[1].split('_')[0]}"
        yield PHONES[name], name, walk.steps, given(walk.truth, slice(None))
    eight = next(ipin21_walks(data))
    yield "Samsung S10", "IPIN21's eight", eight.steps, given(eight.truth, slice(None, None, 5))
    campus = nju_walk(data)
    yield "unknown", "NJU campus", campus.steps, campus.fixes[np.arange(0, len(campus.fixes), 10)]
    steps = detect_steps(load(data / "apf_pdr" / "walk"))
    ends = np.array([steps.start, steps.end])
    yield "Samsung A16", "CAD walk, closed", steps, Fixes(ends, np.zeros((2, 2)), np.full(2, 0.5), ("", ""))


def session_of(walk):
    """Site, floor and day of a Microsoft recording, whose number begins with its time: four digits are 18 hours."""
    floor, number = walk.name.split()
    return f"{floor}, {number[:4]}"


def drift(data):
    """The tables: b by session, and which sigma of a population explains all sessions best."""
    sessions = {}
    for phone, name, steps, fixes in walks(data):
        sessions.setdefault((phone, name), []).append(Drift.of(steps, fixes))
    shared = {key: Drift.shared(drifts) for key, drifts in sessions.items()}
    rows = [
        [phone, name, len(sessions[phone, name]), f"{1e3 * b.value:+.1f} ± {1e3 * b.sigma:.1f}"]
        for (phone, name), b in shared.items()
    ]
    publish("results/drift.md", "drift", table(["phone", "session", "recordings", "b [mrad/s]"], rows))
    total = np.array([sum(b.surprise(sigma) for b in shared.values()) for sigma in SIGMAS])
    header = ["sigma of b [mrad/s]", *(f"{1e3 * sigma:.1f}" for sigma in SIGMAS)]
    cells = ["nats above the best", *(f"{excess:.1f}" for excess in total - total.min())]
    publish("results/drift.md", "drift population", table(header, [cells]))
    rows = [[hold, *simulated_drift(hold)] for hold in HOLDS]
    publish("results/drift.md", "drift simulated", table(["simulated phone", "walks", "RMS of b [mrad/s]"], rows))


def simulated_drift(hold):
    """Number of simulated walks, and the root mean square of their drift [mrad/s], by the true headings."""
    drifts = []
    for seed in range(CROWD):
        random = np.random.default_rng((seed, 7))
        route = with_stands(route_outdoors(random), random)
        simulation = simulate(Scenario.of({"seed": seed, "phone": {"rate": 50, "hold": hold}, "route": route}))
        steps, truth = detect_steps(simulation.recording()), simulation.truth[::EVERY]
        track = dead_reckon(steps)
        walked = (truth.time > steps.time[0]) & (truth.time < steps.time[-1])
        time, true = truth.time[walked], np.unwrap(truth.heading)[walked]
        drifts.append(np.polyfit(time, np.interp(time, track.time, np.unwrap(track.heading)) - true, 1)[0])
    return CROWD, f"{1e3 * np.sqrt(np.mean(np.square(drifts))):.1f}"
