"""The rooms of phones: for Home Assistant, by MQTT (``serve --home-assistant mqtt://HOST``), and as alerts.

An alert (``serve --alert ROOM=URL``) is a POST when a phone enters a room.

Each phone is announced by one retained message of device discovery (Home Assistant 2024.11 and later), with sensors for
its room, the room's probability, the floor and the accuracy, and on a plan with latitudes a device tracker. Sources:
home-assistant.io, integrations mqtt ("Device discovery payload"), sensor.mqtt and device_tracker.mqtt.

A room is a named area of the plan. Its probability is that of the position's distribution, all routes together, in the
room, as a share of what lies on the plan: walls are no place to be. Motion sensors change the odds of their rooms. The
states are retained, so that a dashboard that starts later has them, and Home Assistant's history has the room and its
probability over time.
"""

from __future__ import annotations

import asyncio
import hashlib
import re
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

import msgspec
import numpy as np

import pdr_graph
from pdr_graph.apps.serve.access import OWNER
from pdr_graph.apps.serve.publishing import PROBABILITY, Hub
from pdr_graph.apps.serve.pulling import Broker, Say, connected
from pdr_graph.errors import InputError, one_line
from pdr_graph.floor.building import Building
from pdr_graph.geometry import squared_radius
from pdr_graph.io.validation import RADIUS_68
from pdr_graph.types import Array
from pdr_graph.web_request import request

PREFIX = "pdr_graph"  # of all topics but those of the discovery
STATUS = f"{PREFIX}/status"  # of the server
ONLINE, ABSENT = "online", "offline"
FINISHED = "finished"  # state of a walk that is over
LEAST_SHOWN = 0.05  # probability from which a room is among the attributes
RETAINED_TIME = 2.0  # [s] for the broker to send what it has retained
MOTION_TOPICS = "+/binary_sensor/+/state"  # of mqtt_statestream, retained
# Odds of a room whose sensor sees no motion, or has seen it begin for RECENT [s]: it sees half of the time somebody who
# is there, a tenth of the time somebody else; chosen by hand
QUIET, MOTION, RECENT = 0.6, 3.0, 10.0
LONGEST_PAUSE = 60.0  # [s] without news after which the connection is still looked at
# An alert: a phone is in a room from this probability on for so long [s], and out of it below the other
ENTERED, LEFT, STAYS = 0.8, 0.2, 2.0
ALERT_TIME, RETRY_PAUSE, MOST_ALERTS = 10.0, 5.0, 100  # [s] of a request; before the only other one; unanswered at once


def _spread() -> Array:
    """Points ``(256, 2)`` of a normal distribution of two standard ones, each as probable as another: a spiral."""
    n = np.arange(256) + 0.5
    radius, angle = np.sqrt(-2 * np.log(1 - n / len(n))), n * np.pi * (3 - np.sqrt(5))
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


DEVIATES = _spread()


def rooms_of(pose: Mapping[str, Any], building: Building | None) -> dict[str, float]:
    """The probability of each named area of the floor, the most probable first; "" for areas without a name.

    pose: an event ``pose``. Empty without a plan, before the first position, and where nothing of it is on the plan.
    """
    if building is None or pose["sigma"] is None:
        return {}
    label = pose["floor"] if pose["floor"] in building.labels else building.labels[0]
    cells, share = building[label].cells, Counter[str]()
    for mode in pose["modes"] or [{"probability": 1.0, **pose}]:
        region = mode["region"]
        axes = np.array([region["semi_major"], region["semi_minor"]]) / np.sqrt(squared_radius(PROBABILITY))
        cosine, sine = np.cos(region["angle"]), np.sin(region["angle"])
        points = (DEVIATES * axes) @ np.array([[cosine, sine], [-sine, cosine]]) + (mode["x"], mode["y"])
        for cell in cells.at(points).tolist():
            if cell >= 0:
                share[cells.cells[cell].name] += mode["probability"] / len(DEVIATES)
    return {name: part / share.total() for name, part in share.most_common()}


def room_names(building: Building | None) -> list[str]:
    """The names of the rooms of a plan, floor by floor, each once; none without a plan."""
    floors = () if building is None else building.floors
    return list(dict.fromkeys(cell.name for floor in floors for cell in floor.cells.cells if cell.name))


@dataclass(frozen=True)
class MotionSensors:
    """Motion sensors in rooms: ``serve --motion SENSOR=ROOM``.

    rooms: name of the room in which each entity ``binary_sensor.SENSOR`` is; since: when each saw motion begin [s], by
    a monotonic clock, -inf if that is unknown, NaN where it sees none.
    A sensor sees anybody who moves there, goes on for up to a minute after them, and sees nobody who sits still. So it
    counts that motion begins, by MOTION, and that there is none, by QUIET: odds of the room, whatever the position is.
    """

    rooms: Mapping[str, str] = field(default_factory=dict)
    since: dict[str, float] = field(default_factory=dict)

    def weighed(self, rooms: Mapping[str, float], now: float) -> dict[str, float]:
        """The probabilities of rooms with the states of the sensors, the most probable first. now: [s]."""
        odds = dict.fromkeys(rooms, 1.0)
        for sensor, begin in self.since.items():
            if (room := self.rooms[sensor]) in odds:
                odds[room] *= QUIET if np.isnan(begin) else MOTION if now - begin < RECENT else 1.0
        share = {name: part * odds[name] for name, part in rooms.items()}
        total = sum(share.values())
        return dict(sorted(((name, part / total) for name, part in share.items()), key=lambda item: -item[1]))

    def take(self, topic: str, payload: bytes, now: float) -> None:
        """Keep the state of a sensor; one that is unavailable has none. now: [s], -inf for a state of any age."""
        sensor, state = topic.split("/")[-2] if topic.count("/") >= 3 else "", payload.strip().lower()
        if sensor in self.rooms and state == b"on":
            if np.isnan(self.since.get(sensor, np.nan)):
                self.since[sensor] = now
        elif sensor in self.rooms:
            self.since.pop(sensor, None)
            if state == b"off":
                self.since[sensor] = np.nan


NO_SENSORS = MotionSensors()


def state_of(pose: Mapping[str, Any], building: Building | None, motion: MotionSensors = NO_SENSORS) -> dict[str, Any]:
    """The state of a phone: null for what is unknown; `accuracy`: 68 % radius [m]; `confidence` [%] of the room."""
    rooms = motion.weighed(rooms_of(pose, building), time.monotonic())
    named = {name: part for name, part in rooms.items() if name}
    room = next(iter(rooms), "")
    return {
        "room": room or None,
        "confidence": round(100 * rooms[room]) if room else None,
        "floor": pose["floor"] or None,
        "accuracy": None if pose["sigma"] is None else round(RADIUS_68 * pose["sigma"], 1),
        "rooms": {name: round(part, 2) for name, part in named.items() if part >= LEAST_SHOWN},
    }


def discovery_of(phone: str, name: str, tracked: bool) -> dict[str, Any]:
    """The discovery message of a phone. phone: its identifier in topics; tracked: it has a latitude."""
    components: dict[str, dict[str, Any]] = {
        "room": {"icon": "mdi:map-marker", "json_attributes_topic": f"{PREFIX}/{phone}/state"},
        "confidence": {"unit_of_measurement": "%", "state_class": "measurement", "icon": "mdi:percent"},
        "floor": {"icon": "mdi:stairs"},
        "accuracy": {"unit_of_measurement": "m", "device_class": "distance", "state_class": "measurement"},
    }
    for key, component in components.items():
        component |= {"platform": "sensor", "name": key.capitalize(), "unique_id": f"{PREFIX}_{phone}_{key}"}
        component["value_template"] = f"{{{{ value_json.{key} }}}}"
    components["room"]["json_attributes_template"] = "{{ value_json.rooms | tojson }}"
    if tracked:
        components["position"] = {
            "platform": "device_tracker",
            "name": "Position",
            "unique_id": f"{PREFIX}_{phone}_position",
            "json_attributes_topic": f"{PREFIX}/{phone}/position",
            "source_type": "gps",
        }
    return {
        "device": {"identifiers": [f"{PREFIX}_{phone}"], "name": name, "manufacturer": "pdr_graph"},
        "origin": {"name": "pdr_graph", "sw_version": pdr_graph.__version__},
        "components": components,
        "state_topic": f"{PREFIX}/{phone}/state",
        "availability": [{"topic": STATUS}, {"topic": f"{PREFIX}/{phone}/status"}],
        "availability_mode": "all",
    }


def phone_of(user: str, name: str) -> str:
    """The identifier of a phone in topics: letters, digits and underscores of its user's and its own name.

    Names of different users never have the same: those of others than the owner, and those that would be empty, end
    with a checksum.
    """
    own = name if user == OWNER else f"{user} {name}"
    plain = re.sub(r"\W+", "_", own, flags=re.ASCII).strip("_").lower()
    if user == OWNER and plain:
        return plain
    return f"{plain or 'phone'}_{hashlib.sha256(msgspec.json.encode((user, name))).hexdigest()[:8]}"


class Announcer:
    """Publishes the phones of a hub. One that was recorded several times is one device: its newest walk counts.

    known: the phones that have a walk, also those that the hub does not show; motion: sensors of rooms.
    """

    def __init__(
        self, hub: Hub, building: Building | None, known: Callable[[], set[str]], motion: MotionSensors = NO_SENSORS
    ):
        self._hub, self._building, self._known, self._motion = hub, building, known, motion
        self._announced = dict[str, bool]()  # phones: with a position on earth
        self._walks = dict[str, tuple[str, float]]()  # of each phone the walk that is shown, and the time of its pose

    async def run(self, client: Any) -> None:
        """Publish all phones, and each change of them, until the hub ends."""
        self._announced.clear()  # a broker that was lost may have forgotten
        subscriber = self._hub.subscribe(OWNER, connection=False)
        try:
            await client.publish(STATUS, ONLINE, retain=True)
            for phone in await _retained(client) - self._known():  # deleted while there was no connection
                await self._remove(client, phone)
            while not subscriber.ended:
                if await subscriber.wait(LONGEST_PAUSE):
                    for kind, data in subscriber.events():
                        if kind == "pose":
                            await self._pose(client, data)
                        elif kind == "forgotten":
                            await self._forget(client, data["id"])
        finally:
            self._hub.unsubscribe(subscriber)
            with suppress(Exception):  # a connection that was lost: then the broker has the last will
                await client.publish(STATUS, ABSENT, retain=True)

    async def _pose(self, client: Any, pose: Mapping[str, Any]) -> None:
        walker = self._hub.walkers[pose["id"]]
        phone, time = phone_of(walker.user, pose["name"]), pose["time"] or 0.0
        shown, latest = self._walks.get(phone, (pose["id"], -np.inf))
        if shown != pose["id"] and time <= latest:
            return
        self._walks[phone] = pose["id"], time
        tracked, topic = pose["lon"] is not None, f"{PREFIX}/{phone}"
        if self._announced.get(phone, not tracked) != tracked:
            message = msgspec.json.encode(discovery_of(phone, one_line(pose["name"]), tracked))
            await client.publish(f"homeassistant/device/{PREFIX}_{phone}/config", message, retain=True)
            self._announced[phone] = tracked
        await client.publish(
            f"{topic}/state", msgspec.json.encode(state_of(pose, self._building, self._motion)), retain=True
        )
        if tracked and pose["sigma"] is not None:
            accuracy = round(RADIUS_68 * pose["sigma"], 1)
            position = {"latitude": pose["lat"], "longitude": pose["lon"], "gps_accuracy": accuracy}
            await client.publish(f"{topic}/position", msgspec.json.encode(position), retain=True)
        await client.publish(f"{topic}/status", ABSENT if pose["state"] == FINISHED else ONLINE, retain=True)

    async def _forget(self, client: Any, id_: str) -> None:
        """Remove the device of a walk that was deleted, if it is the one that is shown; empty messages do."""
        for phone in [phone for phone, (shown, _) in self._walks.items() if shown == id_]:
            await self._remove(client, phone)

    async def _remove(self, client: Any, phone: str) -> None:
        self._walks.pop(phone, None)
        self._announced.pop(phone, None)
        for topic in (f"homeassistant/device/{PREFIX}_{phone}/config", *_topics(phone)):
            await client.publish(topic, b"", retain=True)


def _topics(phone: str) -> list[str]:
    return [f"{PREFIX}/{phone}/{part}" for part in ("state", "position", "status")]


async def _retained(client: Any) -> set[str]:
    """The phones whose status a broker has retained."""
    phones, topics = set[str](), f"{PREFIX}/+/status"
    await client.subscribe(topics)
    with suppress(TimeoutError):
        async with asyncio.timeout(RETAINED_TIME):
            async for message in client.messages:
                if message.retain:
                    phones.add(str(message.topic).split("/")[1])
    await client.unsubscribe(topics)
    return phones


async def announce(
    broker: Broker,
    hub: Hub,
    building: Building | None,
    known: Callable[[], set[str]],
    say: Say,
    motion: MotionSensors = NO_SENSORS,
) -> None:
    """Publish the phones of a hub to a broker, for ever; a lost connection is made again. As of `Announcer`."""
    await connected(broker, Announcer(hub, building, known, motion).run, say, last_will=(STATUS, ABSENT))


async def watch(broker: Broker, motion: MotionSensors, say: Say) -> None:
    """Keep the states of motion sensors up to date, for ever; without a connection none is known."""

    async def work(client: Any) -> None:
        motion.since.clear()
        await client.subscribe(MOTION_TOPICS)
        try:
            async for message in client.messages:
                now = -np.inf if message.retain else time.monotonic()
                motion.take(str(message.topic), bytes(message.payload), now)
        finally:
            motion.since.clear()

    await connected(broker, work, say)


def motion_of(broker: Broker | None, pairs: Iterable[str], building: Building | None) -> MotionSensors:
    """The motion sensors ``pairs`` SENSOR=ROOM. Raises InputError if something is missing or malformed."""
    option, rooms = "--motion", dict[str, str]()
    names = {name.lower(): name for name in room_names(building)}
    for pair in pairs:
        if broker is None:
            raise InputError(option, "", "no broker", "--home-assistant mqtt://HOST, to which the states are published")
        sensor, _, room = pair.partition("=")
        if not re.fullmatch(r"[a-z0-9_]+", sensor) or room.lower() not in names:
            expected = f"SENSOR=ROOM, binary_sensor.SENSOR in a room of --map ({', '.join(names.values()) or 'none'})"
            raise InputError(option, "", repr(pair), expected)
        rooms[sensor] = names[room.lower()]
    return MotionSensors(rooms)


@dataclass(frozen=True)
class Alert:
    """A request to an address when a phone enters a room: a named area of the plan."""

    room: str
    address: str

    @classmethod
    def of(cls, text: str, building: Building | None) -> Alert:
        """The alert of ``ROOM=URL``. Raises InputError if the plan has no such room, or the address is none."""
        room, _, address = text.partition("=")
        rooms = sorted(room_names(building))
        if room not in rooms:
            expected = f"ROOM=URL, ROOM one of {', '.join(map(one_line, rooms))}" if rooms else "--map with named areas"
            raise InputError("--alert", "", repr(room) if rooms else "no plan with named areas", expected)
        try:
            parts = urlsplit(address)
            host = parts.hostname if parts.scheme in ("http", "https") and parts.port != 0 else None
        except ValueError:
            host = None
        if not host:
            raise InputError("--alert", room, repr(address), "ROOM=URL, as kitchen=https://host/path")
        return cls(room, address)


@dataclass
class _Presence:
    """A phone and a room. inside: None before the first pose; since: time from which the phone may be in it [s]."""

    inside: bool | None = None
    since: float | None = None

    def enters(self, probability: float, time: float) -> bool:
        """True once when the phone is surely in the room, after it was not; where it begins is no entry."""
        if self.inside is None:
            self.inside = probability >= ENTERED
        if probability < ENTERED:
            self.since = None
            self.inside = self.inside and probability >= LEFT
        elif self.since is None:
            self.since = time
        entered = not self.inside and self.since is not None and time - self.since >= STAYS
        self.inside = self.inside or entered
        return entered


async def alert(alerts: Sequence[Alert], hub: Hub, building: Building | None, say: Say) -> None:
    """Ask the address of a room when a phone enters it, until the hub ends; an address that fails is told."""
    subscriber, known = hub.subscribe(OWNER, connection=False), defaultdict[tuple[str, str], _Presence](_Presence)
    asked = set[asyncio.Task[None]]()
    try:
        while not subscriber.ended:
            if not await subscriber.wait(LONGEST_PAUSE):
                continue
            for kind, data in subscriber.events():
                if kind == "forgotten":
                    known = defaultdict(_Presence, {own: each for own, each in known.items() if own[0] != data["id"]})
                if kind != "pose" or data["state"] == FINISHED or data["sigma"] is None:
                    continue
                rooms = rooms_of(data, building)
                for each in alerts:
                    probability = rooms.get(each.room, 0.0)
                    if known[data["id"], each.room].enters(probability, data["time"]) and len(asked) < MOST_ALERTS:
                        about = {"event": "enter", "room": each.room, "phone": data["name"], "time": data["time"]}
                        about |= {"user": hub.walkers[data["id"]].user, "probability": round(probability, 2)}
                        task = asyncio.create_task(_post(each, about | {"floor": data["floor"]}, say))
                        asked.add(task)
                        task.add_done_callback(asked.discard)
    finally:
        hub.unsubscribe(subscriber)
        for task in asked:
            task.cancel()


async def _post(to: Alert, about: Mapping[str, Any], say: Say) -> None:
    """Post to the address of an alert, once more if it fails; redirects are not followed, so no other host is asked."""
    for last in (False, True):
        try:
            headers = {"Content-Type": "application/json"}
            body, most = msgspec.json.encode(about), 1 << 16
            answer = await request(to.address, ALERT_TIME, ALERT_TIME, most, method="POST", body=body, headers=headers)
            if answer.status < 300:
                return
            fault = f"status {answer.status}"
        except OSError as error:
            fault = one_line(str(error))
        if last:
            say(f"--alert {one_line(to.room)}: {urlsplit(to.address).hostname}: {fault}")
        else:
            await asyncio.sleep(RETRY_PAUSE)
