"""Assumptions of the model on real recordings: the gyroscope's drift, outliers, errors in stated sigmas."""

import re
from dataclasses import dataclass, replace

import numpy as np
from conditions import recordings, scattered, walks_given, with_steps
from live import GNSS, HELP, THINNED
from tables import HELD_BACK, publish, table

from pdr_graph import WalkGraph, kalman_smoother, smooth
from pdr_graph.apps.report.evaluation import circular_error, pair, stated_covariance
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.geometry import along_and_across, protection_level, unit
from pdr_graph.types import Fixes

VAGUE = 0.1  # [rad/s] prior sigma of b
SIGMAS = (0.001, 0.002, 0.003, 0.004, 0.006, 0.01)  # [rad/s] of a population
RARE, WIDE = 0.05, 0.03  # share of sessions of another population, and its sigma [rad/s]
APART, PLACE, CLEAR = 5.0, 0.5, 0.006  # [s] between places, [m] their sigma, [rad/s] largest sigma of a listed session
SESSIONS = {  # by data set and phone: which part of a recording's name is the session's
    ("conditions:malls", "OPPO PBCM10, malls"): r"site\d/\w+ .{4}",  # four digits of its number: 18 hours
    ("museum", "SM-A520F, museum"): r"Trial(01|02|22|23|27)",
    ("museum", "SM-G930F, museum"): r"Trial(05|21|24|26|52)",
    ("ipin21", "Samsung S10, IPIN21"): "landmarks",
    ("nju", "unknown, NJU campus"): "",
    ("ridi", "Tango, RIDI"): r"(?=.*_(bag|body|handheld|leg)\d$)",  # without the walks sideways
}


@dataclass(frozen=True)
class Drift:
    """Likelihood of b in some walks, as a Gaussian. [rad/s]"""

    value: float
    sigma: float

    @classmethod
    def of(cls, walk):
        """Posterior of a walk with its known places, without its vague prior."""
        truth = walk.truth if len(walk.truth) else walk.evidence.fixes
        times = np.append(np.arange(truth.time[0], truth.time[-1], APART), truth.time[-1])
        rows = np.unique(np.searchsorted(truth.time, times))
        fixes = Fixes(truth.time[rows], truth.position[rows], np.full(len(rows), PLACE))
        prior = replace(Prior(), sigma=(*Prior().sigma[:2], VAGUE))
        calibration = smooth(WalkGraph(walk.evidence.steps, fixes, prior=prior)).calibration
        best = int(np.argmin(calibration.sigma[:, 2]))
        value, sigma = calibration.value[best, 2], min(calibration.sigma[best, 2], 0.999 * VAGUE)
        information = sigma**-2 - VAGUE**-2
        return cls(value / sigma**2 / information, information**-0.5)

    @classmethod
    def shared(cls, drifts):
        """Likelihood of several walks of one session."""
        weight = np.array([each.sigma**-2 for each in drifts])
        return cls(float(weight @ [each.value for each in drifts] / weight.sum()), float(weight.sum() ** -0.5))

    def density(self, sigma):
        """Likelihood of a population with this standard deviation of b and mean 0."""
        variance = sigma**2 + self.sigma**2
        return np.exp(-0.5 * self.value**2 / variance) / np.sqrt(variance)


def drift(data):
    """Drift of each session, and the population that explains all of them best."""
    rows, every = [], []
    for (of, phone), part in SESSIONS.items():
        walks = {}
        for name, walk in recordings(data, of).items():
            if session := re.match(part, name):
                walks.setdefault(session[0], []).append(Drift.of(with_steps(walk)))
        sessions = [Drift.shared(drifts) for drifts in walks.values()]
        clear = sorted((each for each in sessions if each.sigma <= CLEAR), key=lambda each: each.value)
        listed = ", ".join(f"{1e3 * each.value:+.1f} ± {1e3 * each.sigma:.1f}" for each in clear)
        rows.append([phone, len(sessions), listed])
        every += sessions
    publish("results/drift.md", "drift", table(["phone", "sessions", "b [mrad/s]"], rows))
    usual = np.array([[each.density(sigma) for sigma in SIGMAS] for each in every])
    wide = np.array([[each.density(WIDE)] for each in every])
    near = np.array([abs(each.value) < max(WIDE, 3 * each.sigma) for each in every])
    mixed = (1 - RARE) * usual + RARE * wide
    populations = {
        "one population": (usual, mixed),
        f"{100 * RARE:.0f} % of them from another, of {1e3 * WIDE:.0f} mrad/s": (mixed, mixed),
        f"one, without {np.sum(~near)} that is beyond {1e3 * WIDE:.0f} mrad/s": (usual[near], usual[near]),
    }
    rows = []
    for name, (likelihood, best) in populations.items():
        nats = np.log(best).sum(axis=0).max() - np.log(likelihood).sum(axis=0)
        rows.append([name, *(f"{each:.1f}" for each in nats)])
    header = ["sessions; sigma of b [mrad/s]", *(f"{1e3 * sigma:.0f}" for sigma in SIGMAS)]
    publish("results/drift.md", "drift population", table(header, rows))


SHARE, OFF, DRAWS, ASTRAY = 0.3, (50.0, 500.0), 4, 20.0  # of the fixes; [m] each; of each walk; [m] mean error
DISTURBED = {
    "NJU campus, GPS one in 2 s": ("nju", "one in 2 s", ""),
    "IPIN21's eight, every 10 s, 5 m": ("ipin21", "recorded", "freq10_s_err5m"),
    "Microsoft, every second waypoint": ("microsoft", "every second", ""),
}


def in_one_place(fixes, share, random):
    """Fixes of which some in a row are at one other place, within their sigmas, and which these are."""
    count = round(share * len(fixes))
    since = np.arange(len(fixes)) - random.integers(0, len(fixes) - count + 1)
    wild = (since >= 0) & (since < count)
    place = fixes.position[wild].mean(axis=0) + random.uniform(*OFF) * unit(random.uniform(0, 2 * np.pi))
    there = place + random.normal(0, 1, (len(fixes), 2)) * fixes.sigma[:, None]
    return replace(fixes, position=np.where(wild[:, None], there, fixes.position)), wild


def outliers(data):
    """Errors of graph and smoothed filter with outliers, and of the graph without these fixes."""
    rows = []
    for title, (of, what, part) in DISTURBED.items():
        walks = [walk for name, walk in walks_given(data, of, what).items() if re.match(part, name)]
        clean = [(walk, walk.evidence.fixes) for walk in walks]
        rows.append([title, "none", *errors_at(clean, smooth), errors_at(clean, kalman_smoother)[0], "—", "—"])
        for kind, disturb in {"scattered": scattered, "in a row, in one place": in_one_place}.items():
            drawn, kept = [], []
            for n, walk in enumerate(walks):
                for draw in range(DRAWS):
                    fixes, wild = disturb(walk.evidence.fixes, SHARE, np.random.default_rng([HELD_BACK, n, draw]))
                    drawn.append((walk, fixes))
                    kept.append((walk, fixes[~wild]))
            rows.append([title, kind, *errors_at(drawn, smooth), errors_at(drawn, kalman_smoother)[0]])
            rows[-1] += errors_at(kept, smooth)
    astray = f"walks over {ASTRAY:.0f} m off"
    header = ["walk", f"{100 * SHARE:.0f} % outliers", "graph: 50 / 95 % [m]", astray, "RTS: 50 / 95 % [m]"]
    publish("results/outliers.md", "outliers", table([*header, "graph, outliers left out", astray], rows))


def errors_at(walks, method):
    """Median and 95 % of the errors of walks with other fixes [m], and of how many the mean error is over ASTRAY."""
    tracks = [(method(replace(walk.evidence, fixes=fixes).graph()).trajectory, walk.truth) for walk, fixes in walks]
    errors = [circular_error(pair(*both)) for both in tracks]
    text = " / ".join(f"{p:.2f}" for p in np.percentile(np.concatenate(errors), (50, 95)))
    return text, f"{sum(each.mean() > ASTRAY for each in errors)} of {len(errors)}"


LEVELS = (0.95, 0.999)
GROUPS = {  # what is given, by data set and name
    **{
        (f"Microsoft, {name}{plan}", "microsoft"): what + plan for what, name in HELP.items() for plan in ("", ", plan")
    },
    **{(f"IPIN21{plan}", "ipin21"): f"recorded{plan}" for plan in ("", ", plan")},
    **{(f"IPIN 2023, {name}", "ipin2023"): what for what, name in GNSS.items()},
    **{(f"NJU campus, {what}", "nju"): what for what in THINNED},
}


def protection(data):
    """Share of the errors along and across the walking direction within protection levels; each walk counts alike."""
    factors = [protection_level(np.eye(2)[None], np.zeros(1), level)[0, 0] for level in LEVELS]
    groups = {name: list(map(in_sigmas, walks_given(data, of, what).values())) for (name, of), what in GROUPS.items()}
    groups["**all**"] = [walk for walks in groups.values() for walk in walks]
    rows = [[name, len(walks)] for name, walks in groups.items()]
    for row, walks in zip(rows, groups.values(), strict=True):
        row += [f"{100 * np.mean([np.mean(walk <= factor) for walk in walks]):.1f} %" for factor in factors]
        row.append(f"{max(walk.max() for walk in walks):.1f}")
    header = ["walks", "", *(f"within the {100 * level:g} % level" for level in LEVELS), "largest error [σ]"]
    publish("results/protection.md", "protection", table(header, rows))


def in_sigmas(walk):
    """|error| / sigma ``(2 n,)`` along and across the walking direction at the n places of the truth."""
    track = smooth(walk.evidence.graph()).trajectory
    pairs = pair(track, walk.truth)
    heading = np.interp(pairs.time, track.time, np.unwrap(track.heading))
    sigma = along_and_across(stated_covariance(track, pairs.time) + walk.noise**2 * np.eye(2), heading)
    ahead = (pairs.estimate - pairs.truth) @ [1, 1j] * np.exp(-1j * heading)
    return np.abs(np.concatenate([ahead.real / sigma[:, 0], ahead.imag / sigma[:, 1]]))
