"""Somebody who goes along streets, a position per second, and what receivers make of it."""

import numpy as np
from scipy.signal import lfilter

from pdr_graph.types import Fixes

SIGMA = 5.0  # [m] stated, per axis: a phone's
PACE = 1.3  # [m/s]
DAY = (("stand", 1800), ("walk", 900), ("stand", 120), ("bus", 1200), ("walk", 400), ("stand", 3600), ("walk", 600))


def streets(legs, seed=0):
    """Positions ``(n + 1, 2)`` and what was done ``(n,)`` of someone who goes along streets, and of their bus."""
    random = np.random.default_rng(seed)
    place, done, heading = [np.zeros(2)], [], 0.0
    for what, seconds in legs:
        top, block = {"stand": (0.0, (1, 1)), "walk": (PACE, (40, 120)), "bus": (9.0, (150, 500))}[what]
        speed, left, wait = 0.0, random.uniform(*block), 0
        for _ in range(seconds):
            speed, wait = (0.0, wait - 1) if wait else (min(top, speed + 1.2), 0)
            place.append(place[-1] + speed * np.array([np.cos(heading), np.sin(heading)]))
            left -= speed
            if left <= 0 and top:
                heading, left = heading + random.choice([-1, 0, 1]) * np.pi / 2, random.uniform(*block)
                wait = int(random.uniform(10, 60)) if what == "bus" and random.random() < 0.5 else 0
        done += [what] * seconds
    return np.array(place), np.array(done)


def gauss_markov(n, sigma, lasts, random):
    """Errors ``(n, 2)`` a second apart that are alike for some time [s]."""
    keep = np.exp(-1 / lasts)
    noise = random.normal(0, sigma * np.sqrt(1 - keep**2), (n, 2))
    noise[0] = random.normal(0, sigma, 2)
    return lfilter([1], [1, -keep], noise, axis=0)


NOISE = {
    "alike for two minutes": lambda n, random: gauss_markov(n, 4.8, 120, random) + random.normal(0, 1.5, (n, 2)),
    "alike for 20 s": lambda n, random: gauss_markov(n, SIGMA, 20, random),
    "white": lambda n, random: random.normal(0, SIGMA, (n, 2)),
}
USUAL = NOISE["alike for two minutes"]


def seen(place, noise=USUAL, every=1, seed=0):
    """Fixes of one receiver every so many seconds."""
    position = place + noise(len(place), np.random.default_rng(seed))
    return logged(np.arange(0, len(place), every), position)


def logged(time, position):
    """Fixes at some of the seconds."""
    n = len(time)
    return Fixes(time.astype(float), position[time], np.full(n, SIGMA), ("",) * n, source=("GPS",) * n)
