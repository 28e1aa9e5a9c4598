"""Fixed receivers that hear the phones: ``serve --home-assistant URL --heard-as PHONE=DEVICE``.

A receiver that hears a phone is a beacon that the phone hears, with sender and receiver exchanged. Its level becomes a
sample of the phone's walk, as Sensor Logger sends those of Bluetooth, whose transmitter is the receiver's name.

Sources: ESPresense, src/main.cpp (``reportDevice``) and src/BleFingerprint.cpp (``fill``), versions 2 to 4:
``espresense/devices/DEVICE/ROOM``, not retained, with ``rssi`` [dBm], the middle of the last advertisements; its
``raw`` and ``distance`` are metres, by the node's own settings. Bermuda publishes nothing by MQTT. Home Assistant's
mqtt_statestream publishes the states of its sensors: ``BASE/sensor/DEVICE_unfiltered_distance_to_RECEIVER/state``,
retained, metres by `BERMUDA`. The messages have no time: they are as old as the way through the broker.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np

from pdr_graph.apps.serve.access import OWNER
from pdr_graph.apps.serve.home_assistant import phone_of
from pdr_graph.apps.serve.pulling import Broker, Say, connected
from pdr_graph.apps.serve.reception import Reception
from pdr_graph.errors import InputError, one_line
from pdr_graph.io.validation import float_of

ESPRESENSE, STATE_TOPICS = "espresense/devices/{}/+", "+/sensor/+/state"
BERMUDA_ENTITY = re.compile(r"(.+)_unfiltered_distance_to_(.+)")
BERMUDA = -55.0, 3.0  # [dBm] at 1 m, and path loss exponent: defaults of its const.py
WEAKEST, LOUDEST = -127.0, -1.0  # [dBm] levels of Bluetooth; 0 is what programs have before the first
MOST_SAID = 20  # receivers without a place that are named


@dataclass(frozen=True)
class Receivers:
    """Who hears whom. phones: by the name of their device, as in topics `pdr_graph/PHONE/…`; places: names of the
    receivers with a place, in lower case.
    """

    broker: Broker
    phones: Mapping[str, str]
    places: frozenset[str]
    unplaced: set[str] = field(default_factory=set)


def receivers_of(broker: Broker | None, pairs: Iterable[str], places: Iterable[str]) -> Receivers:
    """The receivers that hear ``pairs`` PHONE=DEVICE. Raises InputError if something is missing or malformed."""
    option, phones = "--heard-as", dict[str, str]()
    if broker is None:
        raise InputError(option, "", "no broker", "--home-assistant mqtt://HOST, to which the receivers publish")
    for pair in pairs:
        phone, _, device = pair.partition("=")
        if not phone or not device or re.search(r"[+#/]", device) or phone_of(OWNER, phone) != phone:
            expected = "PHONE=DEVICE: PHONE as in pdr_graph/PHONE/state, DEVICE as in espresense/devices/DEVICE"
            raise InputError(option, "", repr(pair), expected)
        if device in phones:
            raise InputError(option, device, f"{phones[device]} and {phone}", "a device of one phone")
        phones[device] = phone
    named = frozenset(name.lower() for name in places)
    if not named:
        raise InputError(option, "", "no places of receivers", "beacons of --map, or --beacons, with the rooms' names")
    return Receivers(broker, phones, named)


def heard(topic: str, payload: bytes) -> tuple[str, str, float] | None:
    """Device, receiver and level [dBm] of a message; None if it has no level that Bluetooth can have."""
    parts = topic.split("/")
    try:
        content = msgspec.json.decode(payload)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError):  # also `unavailable`, a state
        return None
    if parts[:2] == ["espresense", "devices"] and len(parts) == 4 and isinstance(content, dict):
        device, receiver, level = parts[2], parts[3], float_of(content.get("rssi"))
    elif len(parts) == 4 and parts[1] == "sensor" and (entity := BERMUDA_ENTITY.fullmatch(parts[2])) is not None:
        (device, receiver), (power, exponent), distance = entity.groups(), BERMUDA, float_of(content)
        level = power - 10 * exponent * float(np.log10(distance)) if distance > 0 else np.nan
    else:
        return None
    return (device, receiver, level) if WEAKEST <= level <= LOUDEST else None


async def listen(receivers: Receivers, reception: Reception, say: Say) -> None:
    """Give the levels of all receivers to the walks of their phones, for ever; a lost connection is made again."""

    async def work(client: Any) -> None:
        for topic in (*map(ESPRESENSE.format, receivers.phones), STATE_TOPICS):
            await client.subscribe(topic)
        say(f"mqtt: receivers by {receivers.broker.host}:{receivers.broker.port}")
        async for message in client.messages:
            if not message.retain:  # a retained one is of any age
                take(receivers, reception, heard(str(message.topic), bytes(message.payload)), say)

    await connected(receivers.broker, work, say)


def take(receivers: Receivers, reception: Reception, reading: tuple[str, str, float] | None, say: Say) -> None:
    """Give one level to the walk of its phone. A receiver without a place is named once."""
    if reading is None or (phone := receivers.phones.get(reading[0])) is None:
        return
    _, receiver, level = reading
    if receiver.lower() in receivers.places:
        reception.hear(lambda session: phone_of(session.user, session.name) == phone, receiver, level)
    elif receiver not in receivers.unplaced and len(receivers.unplaced) < MOST_SAID:
        receivers.unplaced.add(receiver)
        say(f"receiver {one_line(receiver)[:40]!r} hears {phone} but has no place: a beacon of that id in the plan?")
