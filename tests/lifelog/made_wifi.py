"""A town with access points, and a person's scans there: home, work and ways between them."""

import numpy as np
from made_past import LAT, LON, NOON, position, scan

from pdr_graph.frames import METRES_PER_DEGREE

EAST = METRES_PER_DEGREE * np.cos(np.radians(LAT))  # [m] per degree of longitude
DAY = 86_400


class Town:
    """Access points in a square of 2 km; levels by distance, with shadowing and a sensitivity limit."""

    def __init__(self, seed=0, number=3000, moved=0.02, hotspots=0.01):
        self.rng = np.random.default_rng(seed)
        self.place = self.rng.uniform(-1000, 1000, (number, 2))
        self.later = self.place.copy()  # where routers are from day 10 on
        self.moves = self.rng.random(number) < moved
        self.later[self.moves] = self.rng.uniform(-1000, 1000, (int(self.moves.sum()), 2))
        self.follows = self.rng.random(number) < hotspots  # carried by somebody: anywhere at any time
        self.power = self.rng.normal(-38, 4, number)  # [dBm] at 1 m
        self.home, self.work = np.array([-700.0, -400.0]), np.array([600.0, 500.0])

    def levels(self, where, day):
        """What a phone receives at a place: address -> power [dBm], with walls and people in between."""
        place = (self.later if day >= 10 else self.place).copy()
        place[self.follows] = self.rng.uniform(-1000, 1000, (int(self.follows.sum()), 2))
        distance = np.maximum(np.hypot(*(place - where).T), 1.0)
        level = self.power - 10 * 3.2 * np.log10(distance) + self.rng.normal(0, 6, len(place))
        return {int(n) + 1: float(level[n]) for n in np.flatnonzero(level > -92)}

    def where(self, second):
        """Place at a time of the day: home, a way of 20 min, work, the way back by another street."""
        way = np.array([self.home, [-700.0, 500.0], self.work])
        back = np.array([self.work, [600.0, -400.0], self.home])
        times = [0, 28_800, 30_000, 57_600, 58_800, DAY]
        share = np.interp(second, times, [0, 0, 1, 1, 2, 2])
        points = np.concatenate([way, back[1:]])
        return np.array([np.interp(share * 2, range(5), points[:, axis]) for axis in (0, 1)])

    def signals(self, days, every=120.0, gps=lambda day: True, sigma=5.0, bias=12.0):
        """Raw signals of some days, and the true place of each scan by its time.

        A position errs by `sigma` and by a `bias` [m per axis] that changes every hour, as indoors; it states both.
        """
        signals, truth = [], {}
        for day in days:
            offsets = self.rng.normal(0, bias, (25, 2))
            for second in np.arange(21_600, 72_000, every).tolist():
                time, place = NOON - NOON % DAY + day * DAY + second, self.where(second)
                truth[round(time * 1000)] = place
                signals.append(scan(time, self.levels(place, day)))
                if gps(day):
                    x, y = place + self.rng.normal(0, sigma, 2) + offsets[int(second // 3600)]
                    accuracy = 1.51 * float(np.hypot(sigma, bias))
                    signals.append(position(time + 3, LAT + y / METRES_PER_DEGREE, LON + x / EAST, accuracy))
        return signals, truth


def errors(rows, truth):
    """Error [m] and sigma per axis [m] of the rows with the source wifi."""
    found = [row for row in rows if row[4] == "wifi"]
    place = np.array(
        [[(int(lon) / 1e7 - LON) * EAST, (int(lat) / 1e7 - LAT) * METRES_PER_DEGREE] for _, lat, lon, *_ in found]
    )
    true = np.array([truth[int(row[0])] for row in found])
    return np.hypot(*(place - true).T), np.array([int(row[3]) / 151 for row in found])
