"""Units and signs of any phone: real walks of Android in the conventions of other systems and plug-ins."""

import time
from dataclasses import replace
from functools import partial

import numpy as np
from conditions import recordings
from tables import publish, table

from pdr_graph.apps.bench.data_sets import given
from pdr_graph.apps.replay import events_within, navigator_of
from pdr_graph.geometry import interpolate
from pdr_graph.inertial.units import AccelerationSign, G
from pdr_graph.online.interface import Samples
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import STANDARD_GRAVITY, Fixes, Signal
from pdr_graph.walk import observe

IN_G, IN_DEGREES = 1 / STANDARD_GRAVITY, 180 / np.pi
CONVENTIONS = {  # name: factors of accelerations and angular rates as Android has them
    "Android, Flutter": (1.0, 1.0),
    "CoreMotion": (-IN_G, 1.0),
    "browser, Chrome": (1.0, IN_DEGREES),
    "browser, Safari": (-1.0, IN_DEGREES),
    "Expo on iOS": (-IN_G, IN_DEGREES),
    "Expo on Android": (IN_G, IN_DEGREES),
    "react-native-sensors on iOS": (-1.0, 1.0),
}
HANDS = ("site1/B1 5ddb8a039191", "site1/F2 5dda4035c5b7", "site2/F6 5dd4b80e4433")
POCKETS = ("dan_bag1", "hang_bag_side1", "hao_leg2", "ma_body1")
SETTINGS = {  # whether there is a magnetometer, and a plan
    "magnetometer, plan": (True, True),
    "plan": (False, True),
    "magnetometer": (True, False),
    "neither": (False, False),
}
GIVEN = "first and 25 %"
TOLD = {"a fix every 30 s": 30.0, "every 10 s": 10.0}  # [s]
SIGMA, MIRRORED = 1.0, 5.0  # [m] of a fix; median error from which a walk is mirrored, where others err by one to three


def followed(walk, factors, compass=True, plan=True):
    """The errors at the places of the truth [m], CPU time, time of the last change of sign [s], and the verdict."""
    evidence = walk.evidence if plan else replace(walk.evidence, building=None)
    evidence = replace(evidence, walk=replace(evidence.walk, sign_odds=None))  # nobody says which phone it is
    kind = partial(Navigator, epoch=evidence.walk.epoch, executor=None)
    nav, spent, decided, sign = navigator_of(evidence.options, evidence, kind)(), 0.0, 0.0, 1.0
    scale = dict(zip(("accelerometer", "gyroscope"), factors, strict=True))
    for event in events_within(evidence)[0]:
        if isinstance(event, Samples):
            if event.sensor == "magnetometer" and not compass:
                continue
            event = replace(event, values=event.values * scale.get(event.sensor, 1.0))
        began = time.thread_time()
        nav.push(event)
        spent += time.thread_time() - began
        if isinstance(event, Samples) and nav.sign != sign:
            sign, decided = nav.sign, float(event.time[-1])
    track, truth = nav.finish().trajectory, walk.truth
    off = interpolate(truth.time, track.time, track.position) - truth.position
    return np.hypot(*off.T), spent, decided, nav.status.verdict.ok


def signs(data):
    """The tables."""
    walks = {name: given(walk, f"{GIVEN}, plan") for name, walk in recordings(data, "microsoft").items()}
    runs = {
        (convention, setting): [followed(walks[name], factors, *SETTINGS[setting]) for name in HANDS]
        for convention, factors in CONVENTIONS.items()
        for setting in SETTINGS
    }
    rows = []
    for convention, (first, second) in CONVENTIONS.items():
        unit = f"{'g' if abs(first) < 1 else 'm/s²'}, {'opposite' if first < 0 else 'as Android'}"
        made = [run for setting in SETTINGS for run in runs[convention, setting]]
        usual = [run for setting in SETTINGS for run in runs[next(iter(CONVENTIONS)), setting]]
        errors = [np.concatenate([errors for errors, *_ in runs[convention, setting]]) for setting in SETTINGS]
        mirrored = sum(np.median(errors) > MIRRORED for errors, *_ in made)
        cpu = sum(run[1] for run in made) / sum(run[1] for run in usual)
        cells = [" / ".join(f"{p:.1f}" for p in np.percentile(each, [50, 95])) for each in errors]
        turns = "°/s" if second > 1 else "rad/s"
        rows.append([convention, unit, turns, *cells, mirrored, f"{max(run[2] for run in made):.0f}", f"{cpu:.2f}"])
    header = ["convention", "unit, sign", "turns", *SETTINGS, "mirrored", "sign after [s]", "CPU / Android's"]
    publish("results/signs.md", "hands", table(header, rows))
    publish("results/signs.md", "pockets", table(["convention", *TOLD], pockets(data)))
    publish(
        "results/signs.md", "recordings", table(["recordings", "walks", "sign changed", "nearest to it"], kept(data))
    )


def pockets(data):
    """Rows of phones in pockets and bags, whose posture tells nothing: mirrored walks, and the "ok" ones of them."""
    rows = []
    for convention, factors in CONVENTIONS.items():
        cells = []
        for every in TOLD.values():
            made = [followed(told(recordings(data, "ridi")[name], every), factors, plan=False) for name in POCKETS]
            wrong = [right for errors, _, _, right in made if np.median(errors) > MIRRORED]
            cells.append(f"{len(wrong)} of {len(made)}, {sum(wrong)} ok")
        rows.append([convention, *cells])
    return rows


def told(walk, every):
    """A walk with a fix every so many seconds."""
    truth = walk.truth
    time = np.arange(truth.time[0], truth.time[-1], every)
    place = interpolate(time, truth.time, truth.position)
    fixes = Fixes(time, place, np.full(len(time), SIGMA), ("",) * len(time))
    return replace(walk, evidence=replace(walk.evidence, fixes=fixes))


def kept(data):
    """Yield rows of recordings as they are read: how many change their sign by all evidence, and how near they come."""
    for of in ("malls", "museum", "nju", "apf", "ipin21", "ridi", "strides"):
        odds, changed = [], 0
        for walk in recordings(data, of).values():
            evidence = observe(replace(walk.evidence, walk=replace(walk.evidence.walk, sign_odds=None)))
            changed += evidence.walk.sign_odds is not None
            odds.append(AccelerationSign.of(evidence.walk.accelerometer).log_odds)
        yield [of, len(odds), changed, f"{max(odds):.1f}"]
    odds = [AccelerationSign.of(Signal(*phone), G).log_odds for phone in iphones(data)]
    yield [
        "weallwalk, as recorded, in g and of the opposite sign",
        len(odds),
        sum(o < 0 for o in odds),
        f"{min(odds):.1f}",
    ]
    odds = [AccelerationSign.of(Signal(t, -STANDARD_GRAVITY * a)).log_odds for t, a in iphones(data)]
    yield ["weallwalk, converted", len(odds), sum(o > 0 for o in odds), f"{max(odds):.1f}"]


def iphones(data):
    """Yield times [s] and raw accelerations [g] of the iPhones in pockets of ``weallwalk``."""
    for path in sorted((data / "weallwalk").glob("iPhone*.csv")):
        rows = np.genfromtxt(path, delimiter=",", usecols=(0, 30, 31, 32), invalid_raise=False)
        rows = rows[np.isfinite(rows).all(axis=1)]
        yield rows[:, 0], rows[:, 1:]
