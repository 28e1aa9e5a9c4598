"""What the phone's radios say of where it is: satellites, beacons, access points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pdr_graph.geometry import interpolate, wrap_angle
from pdr_graph.io.positions import RADIUS_68
from pdr_graph.simulation.body import Body
from pdr_graph.simulation.noise import autoregressive
from pdr_graph.simulation.sensors import Scatter
from pdr_graph.types import Array, Fixes, Index, Sightings

ACCURACY_SPREAD = 0.25  # of a receiver's reported accuracy about the true one (log-normal)
SYSTEMATIC, SYSTEMATIC_TIME = 0.9, 50.0  # share of the error that stays, and for how long [s]: paths, atmosphere
OUTLIER = 5.0  # of the usual accuracy
FLOOR_LOSS = 15.0  # [dB] per ceiling
WALLS = 3.0  # [dB] standard deviation of what walls and furniture add or take, a fixed pattern
WEAKEST = -97.0  # [dBm] that is heard at all


@dataclass(frozen=True)
class Receiver:
    """A satellite receiver.

    accuracy: the radius that holds 68 % of its errors [m]; period between fixes [s]; latency [s]: a fix says where
    one was; outliers: share of wild fixes; outages: from when to when there are none [s]; hdop: usual.
    """

    accuracy: float = 4.5
    period: float = 1.0
    latency: float = 0.0
    outliers: float = 0.005
    outages: tuple[tuple[float, float], ...] = ()
    hdop: float = 0.9


@dataclass(frozen=True)
class SatelliteFixes:
    """fixes: in the metric frame, time when they were logged; accuracy: 68 % radius as reported [m]; hdop."""

    fixes: Fixes
    accuracy: Array
    hdop: Array


def satellites(body: Body, receiver: Receiver, random: np.random.Generator) -> SatelliteFixes:
    """Positions with an accuracy-dependent error, of which most stays the same for a while."""
    measured = np.arange(body.time[0], body.time[-1], receiver.period)
    at = interpolate(measured, body.time, body.position)
    n = len(measured)
    reported = receiver.accuracy * np.exp(autoregressive(random, n, 0.98, ACCURACY_SPREAD)[:, 0])
    keep = np.exp(-receiver.period / SYSTEMATIC_TIME)
    share = autoregressive(random, n, keep, SYSTEMATIC, 2) + random.normal(0, np.sqrt(1 - SYSTEMATIC**2), (n, 2))
    error = reported[:, None] / RADIUS_68 * share
    wild = random.random(n) < receiver.outliers
    error[wild] += OUTLIER * receiver.accuracy * random.normal(0, 1, (int(wild.sum()), 2))
    logged = measured + receiver.latency
    there = logged <= body.time[-1]
    for begin, end in receiver.outages:
        there &= (measured < begin) | (measured >= end)
    hdop = receiver.hdop * np.exp(random.normal(0, 0.1, n)) * reported / receiver.accuracy
    fixes = Fixes(logged, at + error, reported / RADIUS_68, ("",) * n)
    return SatelliteFixes(fixes[there], reported[there], hdop[there])


@dataclass(frozen=True)
class Transmitter:
    """A beacon or an access point. place: ``(2,)`` where it really is [m]; power: received at 1 m [dBm]."""

    name: str
    place: Array
    floor: str = ""
    power: float = -59.0


@dataclass(frozen=True)
class Air:
    """How signals fade. exponent: of distance; shadow: what the body takes away behind it [dB]; fading [dB];
    period: between two sightings of one transmitter [s]; together: True where all are heard in one scan.
    """

    exponent: float
    shadow: float
    fading: float
    period: float
    together: bool


BLUETOOTH = Air(exponent=2.2, shadow=7.0, fading=4.0, period=0.35, together=False)
WIFI = Air(exponent=2.8, shadow=4.0, fading=3.0, period=3.0, together=True)


def heard(
    body: Body,
    transmitters: Sequence[Transmitter],
    air: Air,
    random: np.random.Generator,
    place: np.random.Generator,
) -> Sightings:
    """Who was heard when and how loud: log-distance path loss, the body's shadow, walls as a fixed pattern, fading.

    place: draws what is the same for all walks at a place, the walls' pattern.
    """
    times, names, levels = [np.empty(0)], list[str](), [np.empty(0)]
    scans = np.arange(random.uniform(0, air.period), body.time[-1], air.period)
    for transmitter in transmitters:
        time = scans if air.together else scans + random.uniform(-0.4, 0.4, len(scans)) * air.period
        time = np.clip(time, 0, body.time[-1])
        at = np.clip(np.searchsorted(body.time, time), 0, len(body.time) - 1)
        level = _level(body, at, transmitter, air) + WALLS * Scatter.drawn(place, 4.0, 1).at(body.position[at])[:, 0]
        level += random.normal(0, air.fading, len(at))
        there = level > WEAKEST
        times.append(time[there])
        levels.append(np.round(level[there]))
        names += [transmitter.name] * int(there.sum())
    time, level = np.concatenate(times), np.concatenate(levels)
    order = np.argsort(time, kind="stable")
    return Sightings(time[order], tuple(names[n] for n in order), level[order])


def _level(body: Body, at: Index, transmitter: Transmitter, air: Air) -> Array:
    """Usual received power ``(n,)`` [dBm] at some of the body's samples."""
    way = transmitter.place - body.position[at]
    distance = np.maximum(np.hypot(*way.T), 0.5)
    level = transmitter.power - 10 * air.exponent * np.log10(distance)
    behind = np.abs(wrap_angle(np.arctan2(way[:, 1], way[:, 0]) - body.heading[at])) / np.pi
    level = level - air.shadow * behind**2
    if transmitter.floor:
        ceilings = np.array([label != transmitter.floor for label in body.floors], float)
        level = level - FLOOR_LOSS * ceilings[body.floor[at]]
    return level
