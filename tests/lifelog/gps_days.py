"""Simulated days of a phone's positions in a town: places, ways between them, and silences, with the truth.

Outdoors a position every few seconds with a slowly varying error; indoors positions wander by tens of metres, or there
are none until some time after the person has left.
"""

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from made_tracks import geolife

HOME = 52.5, 13.4  # latitude and longitude of the middle of the town [deg]
METRES = np.array([111_319.5 * np.cos(np.radians(HOME[0])), 111_319.5])  # east and north per degree
MIDNIGHT = datetime(2024, 5, 13, 22, tzinfo=UTC).timestamp()  # of 2024-05-14 in Berlin [s]
DAY = 86_400.0  # [s]
WALKS, RIDES = 1.3, 8.0  # [m/s]
WALKABLE = 900.0  # [m] farther ways are ridden
FADES = 60.0  # [s] of the slow error
OUTDOORS, INDOORS, WHITE = 4.0, 18.0, 1.5  # [m] standard deviations per axis of the slow errors and of the white one
RADIUS = {"home": 0.0, "office": 5000.0, "lunch": 400.0, "shop": 2500.0, "friend": 4000.0, "bakery": 2600.0}


@dataclass(frozen=True)
class Stop:
    """A true stop. name; start, end: Unix times [s]; position ``(2,)``: east and north of HOME [m]."""

    name: str
    start: float
    end: float
    position: np.ndarray


@dataclass(frozen=True)
class GpsDay:
    """time ``(n,)`` Unix times [s]; lonlat ``(n, 2)`` [deg]; stops: the true ones, in order."""

    time: np.ndarray
    lonlat: np.ndarray
    stops: tuple[Stop, ...]

    def write(self, path):
        """Write as a GeoLife file."""
        return geolife(path, self.time, self.lonlat.round(6))


def gps_day(seed, number=0):
    """The `number`-th day of a person; places and habits depend on the seed."""
    town, random = np.random.default_rng([seed, 7]), np.random.default_rng([seed, number])
    angle = town.uniform(0, 2 * np.pi, len(RADIUS))
    places = {n: r * np.array([np.cos(a), np.sin(a)]) for (n, r), a in zip(RADIUS.items(), angle, strict=True)}
    places["lunch"] = places["office"] + places["lunch"]
    plan = [("home", random.normal(7.8, 0.3)), ("office", random.normal(12.2, 0.2)), ("lunch", 0.7), ("office", 17.5)]
    plan += [("bakery", random.uniform(0.03, 0.07))] * (random.random() < 0.5)
    plan += [("shop", random.uniform(0.12, 0.5))] * (random.random() < 0.7)
    plan += [("friend", random.uniform(0.5, 2.0))] * (random.random() < 0.4)
    begin = MIDNIGHT + number * DAY
    time, way, indoors, stops = _walked(plan, places, begin, random)
    return GpsDay(*_received(time, way, indoors, random), tuple(stops))


def _walked(plan, places, begin, random):
    """True positions each second from midnight to midnight, whether indoors, and the stops."""
    at, now, ways, inside, stops = places["home"], begin, [], [], []
    for n, (name, until) in enumerate([*plan, ("home", 24.0)]):
        for part in _way(at, places[name], random) if n else []:
            ways.append(part)
            inside.append(np.zeros(len(part), bool))
            now += len(part)
        leaves = begin + 3600 * until if until > 3 else now + 3600 * until
        stay = max(int(leaves - now), 60)
        stops.append(Stop(name, now, now + stay, places[name]))
        ways.append(places[name] + _shuffled(stay, random))
        inside.append(np.ones(stay, bool))
        at, now = places[name], now + stay
    way, indoors = np.concatenate(ways), np.concatenate(inside)
    return begin + np.arange(len(way)), way, indoors, stops


def _way(start, end, random):
    """Positions each second of a walk, or of a walk to a stop, a wait, a ride and a walk."""
    off = end - start
    far = np.hypot(*off)
    if far < WALKABLE:
        yield from _line(start, end, WALKS, random)
        return
    board, leave = start + off / far * random.uniform(150, 350), end - off / far * random.uniform(150, 350)
    yield from _line(start, board, WALKS, random)
    yield np.tile(board, (int(random.uniform(20, 240)), 1))  # a wait that nobody would write down
    yield from _line(board, leave, RIDES, random)
    yield from _line(leave, end, WALKS, random)


def _line(start, end, speed, random):
    """A way with one corner, and red lights."""
    corner = np.array([end[0], start[1]])
    for a, b in ((start, corner), (corner, end)):
        steps = max(int(np.hypot(*(b - a)) / speed), 1)
        yield a + np.linspace(0, 1, steps, endpoint=False)[:, None] * (b - a)
        if random.random() < 0.5:
            yield np.tile(b, (int(random.uniform(10, 60)), 1))


def _shuffled(seconds, random):
    """Movement within a building of some metres [m]."""
    return _slow(np.arange(seconds, dtype=float), 4.0, 600.0, random)


def _slow(time, sigma, fades, random):
    """A Gauss–Markov error ``(n, 2)`` at times [s]."""
    keep = np.exp(-np.diff(time, prepend=time[:1]) / fades)
    noise, value, found = random.normal(size=(len(time), 2)), random.normal(size=2), np.empty((len(time), 2))
    for n, (k, own) in enumerate(zip(keep.tolist(), noise, strict=True)):
        value = k * value + np.sqrt(1 - k * k) * own
        found[n] = value
    return sigma * found


def _received(time, way, indoors, random):
    """Times and positions of the fixes."""
    edge = np.flatnonzero(np.diff(indoors.astype(int)))
    heard = np.ones(len(time), bool)
    for begin, end in zip([0, *(edge + 1)], [*(edge + 1), len(time)], strict=True):
        if indoors[begin] and random.random() < 0.6:  # no reception soon after the door until some time after it
            heard[begin + int(random.uniform(10, 90)) : min(end + int(random.uniform(10, 90)), len(time))] = False
    for _ in range(random.poisson(1.5)):  # an app that is stopped
        begin = random.integers(len(time))
        heard[begin : begin + int(random.uniform(300, 2400))] = False
    every = np.where(indoors, 20, 5)
    chosen = np.flatnonzero(heard & (np.arange(len(time)) % every == 0))
    error = _slow(time[chosen], 1.0, FADES, random) * np.where(indoors[chosen], INDOORS, OUTDOORS)[:, None]
    seen = way[chosen] + error + random.normal(0, WHITE, (len(chosen), 2))
    return time[chosen], seen / METRES + np.array(HOME[::-1])


def true_stays(days, least):
    """Stops of `least` [s] or longer as (start, end, name), joined over midnights, within the time recorded."""
    found = []
    for stop in (stop for day in days for stop in day.stops):
        if found and found[-1][2] == stop.name and stop.start - found[-1][1] < 2:
            found[-1] = (found[-1][0], stop.end, stop.name)
        else:
            found.append((stop.start, stop.end, stop.name))
    first, last = days[0].time[0], days[-1].time[-1]
    found = [(max(start, first), min(end, last), name) for start, end, name in found]
    return [stay for stay in found if stay[1] - stay[0] >= least]
