"""The JSON of a live walk: its pose, its path, GeoJSON and NavSatFix.

Times are Unix seconds by the phone's clock; x, y are metres in the frame of the walk (the plan's, else East-North about
the first fix); lon, lat are degrees, null while the frame is not georeferenced; headings and angles are radians,
counter-clockwise from +x; sigma is per axis [m]. A value that is not known is null.

**Event ``pose``**, at most one per message of the phone, and each element of ``GET /walkers``::

    {"id": "3f2a…",                 # of the walker, as in /walkers/ID.geojson
     "name": "Pixel 7",             # for people
     "state": "running",            # as of `Status`: "waiting", …, "initialising heading", "running"; then "finished"
     "time": 1753234912.08, "message": 3,          # of the last sample; number of messages used so far
     "x": 12.31, "y": 4.02, "lon": 11.5801, "lat": 48.1372,       # the current pose: the mean of all ways
     "sigma": 1.4, "heading": 1.57, "heading_sigma": 0.2, "floor": "1",
     "region": {"probability": 0.9, "semi_major": 3.2, "semi_minor": 2.1, "angle": 0.4},     # [m], [rad], about x, y
     "display": [11.5801, 48.1372], # what a map draws: follows jumps within 2 s. [lon, lat], or [x, y] if lon is null
     "bearing": 0.0,                # of the heading, clockwise from true north (from +y if lon is null) [deg]
     "modes": [{"probability": 0.8, "x": …, "y": …, "lon": …, "lat": …, "heading": …,
                "region": {…}}],    # the ways that remain, the most probable first
     "steps": 214,                                 # so far
     "missing": ["a second fix, …"],               # what would make the pose better, a line each
     "issues": ["gyroscope: silent for 4 s"],      # present problems, a line each
     "notes": ["accelerometer: Android assumed …"],                # assumptions, a line each
     "health": {"accelerometer": "100 Hz", "gyroscope": "silent for 4 s"},
     "ignored": {"pedometer": 12}}  # samples of sensors that are not used

x, y, lon, lat, sigma, heading, heading_sigma, region, display, bearing are null before the first pose.

**Event ``path``**, at most one per PATH_INTERVAL and walker: the smoothed path. Finalised points do not change any
more; ``current`` replaces the former current part::

    {"id": "3f2a…", "from": 120,                   # number of finalised points that were sent in earlier events
     "finalised": {"time": […], "x": […], "y": […], "lon": […] | null, "lat": […] | null, "floor": […]},
     "current": {…the same columns…}}

The first ``path`` of a connection has all finalised points (``from`` is 0); so has one after points were revised.

**Event ``forgotten``**: ``{"id": "3f2a…"}``: the walk was deleted.
"""

from __future__ import annotations

import asyncio
import json
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from sys import intern
from typing import Any

import numpy as np
import shapely

from pdr_graph.apps.report import page
from pdr_graph.apps.serve.access import Access
from pdr_graph.errors import count
from pdr_graph.floor.building import Building
from pdr_graph.floor.cells import BEACON, CLOSED, OPEN, SOLID
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.frames import METRES_PER_DEGREE, Frame
from pdr_graph.geometry import confidence_ellipse
from pdr_graph.inertial.sensor_stream import Health
from pdr_graph.online.interface import NO_DATA, Pose
from pdr_graph.online.status import SENSOR_SILENCE, SENSORS_SILENT, Status
from pdr_graph.types import Array, Trajectory

PATH_INTERVAL = 2.0  # [s] between two events `path` of a walker
PROBABILITY = 0.9  # of the region
METRE_DECIMALS, DEGREE_DECIMALS, RADIAN_DECIMALS, SECOND_DECIMALS = 3, 8, 4, 3  # decimals
PATH_KEYS = ("time", "x", "y", "lon", "lat", "floor")


def pose_json(
    identity: Mapping[str, Any], pose: Pose | None, status: Status, frame: Frame | None, epoch: float
) -> dict[str, Any]:
    """The event ``pose``. identity: id, name and further members; epoch: Unix time of time 0 of the pose [s]."""
    event = {**identity, "state": status.state, **nowhere()}
    if pose is not None:
        event |= _place(pose, frame) | {"time": round(epoch + pose.time, SECOND_DECIMALS), "floor": pose.floor}
        event |= {
            "sigma": round(pose.sigma, METRE_DECIMALS) if pose.placed else None,
            "heading_sigma": round(float(pose.covariance[2, 2]) ** 0.5, RADIAN_DECIMALS),
        }
        shown = pose.display or (pose.x, pose.y)
        event["display"] = _lonlat(frame, shown) or [round(shown[0], METRE_DECIMALS), round(shown[1], METRE_DECIMALS)]
        event["bearing"] = _bearing(pose, frame)
        event["modes"] = [{"probability": round(mode.probability, 3)} | _place(mode, frame) for mode in pose.modes]
    health = health_texts(status, -np.inf if pose is None else pose.time)
    return event | {"missing": list(status.missing), "issues": list(status.issues), "health": health}


def nowhere() -> dict[str, Any]:
    """The members of the event ``pose`` that need a pose, before the first one."""
    unknown = ("time", "x", "y", "lon", "lat", "sigma", "heading", "heading_sigma", "region", "display", "bearing")
    return {**dict.fromkeys(unknown), "floor": "", "modes": []}


def _place(pose: Any, frame: Frame | None) -> dict[str, Any]:
    """Position, heading and region of a `Pose` or a `Mode`."""
    lon, lat = _lonlat(frame, (pose.x, pose.y)) or (None, None)
    place = {"x": round(pose.x, METRE_DECIMALS), "y": round(pose.y, METRE_DECIMALS), "lon": lon, "lat": lat}
    return place | {"heading": round(pose.heading, RADIAN_DECIMALS), "region": region(pose.covariance)}


def _lonlat(frame: Frame | None, position: tuple[float, float]) -> list[float] | None:
    if frame is None or not frame.georeferenced:
        return None
    return np.round(frame.to_lonlat(np.array([position]))[0], DEGREE_DECIMALS).tolist()


def _bearing(pose: Pose, frame: Frame | None) -> float:
    """Compass bearing of the heading [deg]; from +y without a frame on earth."""
    east = 0.0
    if frame is not None and frame.georeferenced:
        east = frame.bearing_of_east(np.array([pose.x, pose.y]))
    return round(float(np.degrees(np.pi / 2 - pose.heading + east)) % 360.0, 1)


def region(covariance: Array) -> dict[str, float]:
    """The ellipse that holds the position with PROBABILITY; covariance: ``(2, 2)`` or more, (x, y) first [m²]."""
    major, minor, angle = confidence_ellipse(covariance, PROBABILITY)
    half_axes = {"semi_major": round(major, METRE_DECIMALS), "semi_minor": round(minor, METRE_DECIMALS)}
    return {"probability": PROBABILITY, **half_axes, "angle": round(angle, RADIAN_DECIMALS)}


def health_texts(status: Status, time: float = -np.inf) -> dict[str, str]:
    """The state of each inertial sensor in words; time: of the pose, which goes on by fixes alone [s]."""
    last = [sensor.last for sensor in status.sensors.values() if np.isfinite(sensor.last)]
    return {name: _health(sensor, max(last, default=np.nan), time) for name, sensor in status.sensors.items()}


def _health(sensor: Health, latest: float, time: float) -> str:
    if not sensor.samples:
        return NO_DATA
    if time - sensor.last > SENSORS_SILENT or latest - sensor.last > SENSOR_SILENCE:
        return f"silent for {max(time, latest) - sensor.last:.0f} s"
    gaps = f", {count(sensor.gaps, 'gap')}" if sensor.gaps else ""
    return f"{sensor.rate:.0f} Hz{gaps}"


def path_columns(path: Trajectory, frame: Frame | None, epoch: float) -> dict[str, Any]:
    """A part of the path as columns of equal length."""
    lon = lat = None
    if frame is not None and frame.georeferenced:
        lon, lat = np.round(frame.to_lonlat(path.position), DEGREE_DECIMALS).T.tolist() if len(path) else ([], [])
    x, y = np.round(path.position, METRE_DECIMALS).T.tolist()
    time = np.round(path.time + epoch, SECOND_DECIMALS).tolist()
    return dict(zip(PATH_KEYS, (time, x, y, lon, lat, list(path.floor)), strict=True))


def walk_geojson(pose: Mapping[str, Any], finalised: Mapping[str, Any], current: Mapping[str, Any]) -> dict[str, Any]:
    """The finalised and the current part of a path (`path_columns`) and the pose as a FeatureCollection.

    Coordinates are lon, lat (RFC 7946), or local metres, which the member ``coordinates`` says.
    """
    georeferenced = pose["lon"] is not None
    features = [_line("finalised", finalised, georeferenced), _line("current", current, georeferenced)]
    if pose["x"] is not None:
        keys = ("lon", "lat") if georeferenced else ("x", "y")
        geometry = {"type": "Point", "coordinates": [pose[key] for key in keys]}
        features.append({"type": "Feature", "geometry": geometry, "properties": {"part": "pose", **pose}})
    unit = "longitude, latitude" if georeferenced else "local metres"
    return {"type": "FeatureCollection", "coordinates": unit, "features": features}


def _line(part: str, path: Mapping[str, Any], georeferenced: bool) -> dict[str, Any]:
    """A LineString, a Point if there is one position, null without any: RFC 7946 has no line of one position."""
    x, y = (path["lon"], path["lat"]) if georeferenced and path["lon"] is not None else (path["x"], path["y"])
    coordinates = [list(place) for place in zip(x, y, strict=True)]
    geometry: dict[str, Any] | None = {"type": "LineString", "coordinates": coordinates}
    if len(coordinates) < 2:
        geometry = {"type": "Point", "coordinates": coordinates[0]} if coordinates else None
    properties = {"part": part, "times": path["time"], "floors": path["floor"]}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


FIX_STATUS, NO_FIX_STATUS = 0, -1  # sensor_msgs/NavSatStatus: STATUS_FIX, STATUS_NO_FIX


def nav_sat_fix(pose: Mapping[str, Any]) -> dict[str, Any]:
    """The pose in the shape of ROS's sensor_msgs/NavSatFix: degrees, covariance in east, north, up [m²].

    Without a position on earth, the status is NO_FIX_STATUS and latitude and longitude are null.
    """
    time, fixed = pose["time"] or 0.0, pose["lon"] is not None
    seconds = int(time)
    variance = pose["sigma"] ** 2 if fixed else 0.0
    return {
        "header": {
            "stamp": {"sec": seconds, "nanosec": round((time - seconds) * 1e9)},
            "frame_id": pose["id"],
        },
        "status": {"status": FIX_STATUS if fixed else NO_FIX_STATUS, "service": 0},
        "latitude": pose["lat"],
        "longitude": pose["lon"],
        "altitude": None,
        "position_covariance": [variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, 1e4],  # the altitude is not estimated
        "position_covariance_type": 2 if fixed else 0,  # COVARIANCE_TYPE_DIAGONAL_KNOWN or _UNKNOWN
    }


def plan_layers(building: Building | None) -> dict[str, Any]:
    """The plan as a GeoJSON FeatureCollection; without a plan, an empty one.

    Each feature has ``layer`` (``ground``, ``border``, ``walkable``, ``room``, ``door``, ``stairs``, ``wall``,
    ``link``, ``beacon`` or ``name``) and ``floor``. The member ``pdr_graph`` has ``georeferenced``, ``floors`` (labels,
    lowest first) and ``bounds`` (west, south, east, north; None without a plan).
    """
    if building is None:
        about = {"georeferenced": None, "floors": [], "bounds": None}
        return {"type": "FeatureCollection", "pdr_graph": about, "features": []}
    frame = building.floors[0].frame
    features = [
        {"type": "Feature", "properties": properties | {"floor": floor.label}, "geometry": _geometry(shape, frame)}
        for floor in building.floors
        for properties, shape in _drawn(floor)
        if not shapely.is_empty(shape)
    ]
    (west, south), (east, north) = lonlat(building.corners, frame).tolist()
    about = {
        "georeferenced": frame.georeferenced,
        "floors": list(building.labels),
        "bounds": [west, south, east, north],
    }
    return {"type": "FeatureCollection", "pdr_graph": about, "features": features}


def lonlat(position: Array, frame: Frame) -> Array:
    """Longitudes and latitudes ``(n, 2)`` [deg] of positions ``(n, 2)`` [m]; about (0, 0) without a georeference."""
    return frame.to_lonlat(position) if frame.georeferenced else position / METRES_PER_DEGREE


def _drawn(floor: FloorPlan) -> Iterator[tuple[dict[str, str], shapely.Geometry]]:
    """The shapes of a floor [m] with their properties."""
    for layer in page.plan_layers(floor):
        parts = shapely.get_parts(layer.shape)
        yield {"layer": layer.name}, shapely.union_all(shapely.boundary(parts) if layer.name == "border" else parts)
    for area in floor.of_kind(BEACON):
        yield {"layer": "beacon", "text": area.name}, shapely.point_on_surface(area.shape)
    for area in floor.of_kind(*SOLID, *CLOSED, *OPEN):
        if area.name and area.is_polygon:
            yield {"layer": "name", "text": area.name}, shapely.point_on_surface(area.shape)


def _geometry(shape: shapely.Geometry, frame: Frame) -> dict[str, Any]:
    """A shape [m] as a GeoJSON geometry in longitude and latitude."""
    placed = shapely.transform(shape, lambda points: np.round(lonlat(points, frame), 9))  # decimals of a degree: 0.1 mm
    geometry: dict[str, Any] = json.loads(shapely.to_geojson(placed))
    return geometry


Event = tuple[str, dict[str, Any]]  # name and data
MOST_SUBSCRIBERS = 100


def _column(name: str, values: Sequence[Any]) -> Any:
    """A column of a path, of 8 bytes a value. Raises TypeError for values of another type."""
    return list(map(intern, values)) if name == "floor" else array("d", values)


@dataclass
class Published:
    """The last pose of a walker and its path, in columns; user: to whom it belongs; revision: of the finalised part."""

    user: str
    pose: dict[str, Any]
    finalised: dict[str, Any] = field(default_factory=lambda: {name: _column(name, []) for name in PATH_KEYS})
    current: dict[str, Any] = field(default_factory=lambda: {name: [] for name in PATH_KEYS})
    revision: int = 0

    def extend(self, path: dict[str, Any]) -> None:
        """Take over an event ``path``, whose ``from`` is the number of points that stay."""
        count, columns = path["from"], path["finalised"]
        new = {name: None if columns[name] is None else _column(name, columns[name]) for name in PATH_KEYS}
        if count < len(self.finalised["time"]) or (new["lon"] is None) != (self.finalised["lon"] is None):
            self.revision += 1
        for name, added in new.items():
            column = self.finalised[name]
            if column is None or added is None:
                self.finalised[name] = added
            else:
                del column[count:]
                column += added
        self.current = path["current"]

    def path(self, count: int = 0) -> dict[str, Any]:
        """The event ``path`` for a subscriber who has ``count`` finalised points."""
        finalised = {name: None if column is None else list(column[count:]) for name, column in self.finalised.items()}
        return {"id": self.pose["id"], "from": count, "finalised": finalised, "current": self.current}


class Subscriber:
    """Receives events that a viewer may see. connection: of a client, which may have to go for another; ended: it has
    to.
    """

    def __init__(self, hub: Hub, viewer: str, connection: bool, ended: bool):
        self._hub, self.viewer, self.connection, self.ended = hub, viewer, connection, ended
        # ids of walkers with news of each kind, in the order in which these are sent, the oldest first
        self._pending = {kind: dict[str, None]() for kind in ("forgotten", "pose", "path")}
        self._sent = dict[str, tuple[int, int]]()  # revision and number of finalised points
        self._changed = asyncio.Event()
        for id_, walker in hub.walkers.items():
            self.note(id_, walker.user, "pose")
            self.note(id_, walker.user, "path")

    def note(self, id_: str, user: str, kind: str) -> None:
        """Note that there is news of a walker."""
        if Access.sees(self.viewer, user):
            self._pending[kind][id_] = None
            self._changed.set()

    def wake(self) -> None:
        """End a `wait`."""
        self._changed.set()

    def end(self) -> None:
        """Have the connection end."""
        self.ended = True
        self.wake()

    async def wait(self, timeout: float) -> bool:
        """Wait for news; False after ``timeout`` [s] without any."""
        try:
            async with asyncio.timeout(timeout):  # wait_for of Python 3.11 may swallow that the task is cancelled
                await self._changed.wait()
        except TimeoutError:
            return False
        return True

    def events(self) -> Iterator[Event]:
        """Yield the pending events; each is made when it is asked for."""
        self._changed.clear()
        for kind, pending in self._pending.items():
            while pending:
                id_ = next(iter(pending))
                del pending[id_]
                walker = self._hub.walkers.get(id_)
                if kind == "forgotten":
                    self._sent.pop(id_, None)
                    yield kind, {"id": id_}
                elif walker is not None and kind == "pose":
                    yield kind, walker.pose
                elif walker is not None:
                    revision, count = self._sent.get(id_, (-1, 0))
                    path = walker.path(count if revision == walker.revision else 0)
                    self._sent[id_] = walker.revision, len(walker.finalised["time"])
                    yield kind, path


class Hub:
    """All walkers and subscribers."""

    def __init__(self) -> None:
        self.walkers = dict[str, Published]()
        self._closed = False
        self._subscribers = dict[Subscriber, None]()  # the oldest first

    def close(self) -> None:
        """End all connections, since the server ends."""
        self._closed = True
        for subscriber in self._subscribers:
            subscriber.end()

    def pose(self, user: str, pose: dict[str, Any]) -> None:
        """Publish a pose; the first creates the walker."""
        walker = self.walkers.get(pose["id"])
        if walker is None:
            self.walkers[pose["id"]] = Published(user, pose)
        else:
            walker.pose = pose
        self._note(pose["id"], user, "pose")

    def path(self, path: dict[str, Any]) -> None:
        """Publish an event ``path`` of a walker that has a pose."""
        walker = self.walkers.get(path["id"])
        if walker is not None:
            walker.extend(path)
            self._note(path["id"], walker.user, "path")

    def retire(self, id_: str) -> None:
        """Remove a walker without a word: those who see it keep it."""
        self.walkers.pop(id_, None)

    def forget(self, id_: str) -> None:
        """Remove a walker that was deleted."""
        walker = self.walkers.pop(id_, None)
        if walker is not None:
            self._note(id_, walker.user, "forgotten")

    def subscribe(self, viewer: str, connection: bool = True) -> Subscriber:
        """A new subscriber, for whom all walkers are news.

        Beyond MOST_SUBSCRIBERS connections the oldest of the viewer who has the most of them ends. connection: False
        for the server's own, which never ends before the hub does.
        """
        clients = [each for each in self._subscribers if each.connection]
        if connection and len(clients) >= MOST_SUBSCRIBERS:
            [(most, _)] = Counter(each.viewer for each in clients).most_common(1)
            oldest = next(each for each in clients if each.viewer == most)
            self.unsubscribe(oldest)
            oldest.end()
        subscriber = Subscriber(self, viewer, connection, ended=self._closed)
        self._subscribers[subscriber] = None
        return subscriber

    def unsubscribe(self, subscriber: Subscriber) -> None:
        """Remove a subscriber."""
        self._subscribers.pop(subscriber, None)

    def _note(self, id_: str, user: str, kind: str) -> None:
        for subscriber in self._subscribers:
            subscriber.note(id_, user, kind)
