"""A phone that walks and posts what Sensor Logger would."""

import json
import time
import urllib.error
import urllib.request

import numpy as np
import simulated

G = 9.80665
PATIENCE = 20.0  # [s] for an answer
FIX_PERIOD, FIX_SIGMA = 5, 1.5  # [s], [m]


class SimulatedPhone:
    """Messages of one walk along a route [m] in a frame, each of a second.

    silent: a sensor and the second from which it sends nothing.
    """

    def __init__(self, route, frame, seed=0, session="walk-0001", name="Pixel 7", silent=None):
        self.walk = walk = simulated.walk_along(np.array(route), seed=seed)
        self.session, self.name, self.seconds = session, name, int(walk.time[-1])
        self.lonlat = frame.to_lonlat(walk.position) if frame.georeferenced else walk.position
        self._silent, self._random = silent, np.random.default_rng(seed)
        self._frame, self._start = frame, float(round(time.time()) - self.seconds)  # a clock that is right

    def message(self, second):
        """The batch of one second, as JSON."""
        rows = np.flatnonzero(self.walk.time.astype(int) == second)
        gravity = G * self.walk.up[rows]
        sensors = {
            "accelerometer": self.walk.acceleration[rows] - gravity,
            "gravity": gravity,
            "gyroscope": self.walk.angular_rate[rows],
        }
        stamps = [round(1e9 * (self._start + at)) for at in self.walk.time[rows].tolist()]
        payload = [
            {"name": name, "time": at, "values": dict(zip("xyz", xyz, strict=True))}
            for name, values in sensors.items()
            if self._silent is None or name != self._silent[0] or second < self._silent[1]
            for at, xyz in zip(stamps, values.tolist(), strict=True)
        ]
        if second % FIX_PERIOD == 0 and self._frame.georeferenced:
            position = self.walk.position[rows[:1]] + self._random.normal(0, FIX_SIGMA, (1, 2))
            lon, lat = self._frame.to_lonlat(position)[0].tolist()
            values = {"latitude": lat, "longitude": lon, "horizontalAccuracy": 1.51 * FIX_SIGMA}
            payload.append({"name": "location", "time": stamps[0], "values": values})
        return json.dumps(
            {"messageId": second, "sessionId": self.session, "deviceId": self.name, "payload": payload}
        ).encode()

    def position(self, second):
        """The true position ``(2,)`` [m] at the end of a second."""
        return self.walk.position[np.searchsorted(self.walk.time, second + 1) - 1]

    def post(self, server, begin=0, end=None, query=""):
        """Post the messages of some seconds to a server, as quickly as it takes them."""
        for second in range(begin, self.seconds if end is None else end):
            post(f"{server}/sensorlogger{query}", self.message(second))


def post(address, body):
    """Post JSON; returns the text of the answer."""
    request = urllib.request.Request(address, body, {"Content-Type": "application/json"})
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
            return answer.read().decode()
    except urllib.error.HTTPError as error:
        if error.code == 499:  # a text for the user of the phone
            return error.read().decode()
        raise


def fetched(address):
    """The JSON at an address."""
    with urllib.request.urlopen(address, timeout=PATIENCE) as answer:
        return json.load(answer)
