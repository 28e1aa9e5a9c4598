"""Typed dataclasses come back from their bytes as they were; other bytes are refused."""

import struct
import tracemalloc
import zlib
from contextlib import suppress
from dataclasses import dataclass, field, make_dataclass, replace
from typing import Any

import hypothesis.strategies as st
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from pdr_graph.online.interface import Samples, Scan, event_types
from pdr_graph.storage import ARRAY, FORMAT, decode, encode
from pdr_graph.types import SENSORS, Array, Fixes, Sightings, Steps, Trajectory

ANY = st.floats(width=64)  # NaN, infinities and -0.0 too
TEXT = st.text()


def same(one, other):
    """Bit by bit, down to the signs of zeros and the payloads of NaN in arrays."""
    if isinstance(one, np.ndarray):
        return (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    if hasattr(one, "__dataclass_fields__"):
        return type(one) is type(other) and same(vars(one), vars(other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, float):
        return one.hex() == other.hex()
    return type(one) is type(other) and one == other


@st.composite
def events(draw):
    n = draw(st.integers(0, 5))

    def column(*shape, elements=ANY):
        return draw(arrays.arrays(np.float64, (n, *shape), elements=elements))

    texts = st.lists(TEXT, min_size=n, max_size=n).map(tuple)
    finite, positive = st.floats(-1e300, 1e300), st.floats(1e-300, 1e300)
    match draw(st.sampled_from(["Samples", "Scan", "Fixes"])):
        case "Samples":
            return Samples(draw(st.sampled_from(SENSORS)), column(), column(draw(st.integers(0, 3))))
        case "Scan":
            minor = draw(st.sampled_from([(), draw(texts)]))
            return Scan(draw(TEXT), Sightings(column(), draw(texts), column(), minor))
        case "Fixes":
            source = draw(st.sampled_from([(), draw(texts)]))
            epsg = draw(st.none() | st.integers(0, 99999))
            sigma = column(elements=positive)
            return Fixes(column(elements=finite), column(2, elements=finite), sigma, draw(texts), epsg, source)


@given(events())
def test_events_come_back_bit_by_bit(event):
    assert same(decode(encode(event), *event_types()), event)


@dataclass(frozen=True)
class Anything:
    value: Any


TREES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | ANY
    | TEXT
    | st.binary()
    | arrays.arrays(
        st.sampled_from([np.float64, np.float32, np.complex128, np.int64, np.uint64, np.bool_]),
        arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3),
    ),
    lambda parts: st.lists(parts) | st.dictionaries(TEXT, parts),
    max_leaves=20,
)


@given(TREES)
def test_trees_come_back_bit_by_bit(tree):
    assert same(decode(encode(Anything(tree)), Anything).value, tree)


@pytest.mark.parametrize(
    "event",
    [
        Samples("gyroscope", [0.0, 1.0], np.zeros((2, 3))),
        Samples("gyroscope", np.zeros(2, object), np.zeros((2, 3))),
        Samples("gyroscope", np.zeros(2, np.float32), np.zeros((2, 3))),
        Scan("wifi", Sightings(np.zeros(2), [1, 2], np.zeros(2))),
        Anything(np.zeros(2, "U8")),
        Anything(lambda: 0),
        None,
    ],
)
def test_what_would_not_come_back_is_refused(event):
    with pytest.raises(TypeError, match=r"xpected|found"):
        encode(event)


def test_whole_numbers_come_back_as_their_field_has_them():
    event = Steps(0, 1, np.empty(0), *(np.empty(0) for _ in range(6)), final_turn=np.float64(0.5))
    assert same(decode(encode(event), *event_types()), replace(event, start=0.0, end=1.0, final_turn=0.5))


def test_slices_come_back_whole():
    values = np.arange(12.0).reshape(4, 3)
    event = Samples("gyroscope", values[::2, 0], values.T[:, ::2].T)
    assert same(decode(encode(event), *event_types()), event)


@given(st.binary(max_size=200))
def test_random_bytes_are_refused(blob):
    for received in (blob, sealed(blob)):
        with pytest.raises(ValueError, match="bytes"):
            decode(received, *event_types(), Anything)


WHOLE_EVENT = encode(Samples("gyroscope", np.zeros(3), np.ones((3, 3))))


@given(st.integers(0, len(WHOLE_EVENT) - 1), st.integers(0, 7), st.sampled_from(["flip", "cut", "repeat"]))
def test_damaged_events_are_refused(at, bit, damage):
    flipped = WHOLE_EVENT[:at] + bytes([WHOLE_EVENT[at] ^ 1 << bit]) + WHOLE_EVENT[at + 1 :]
    blob = {"flip": flipped, "cut": WHOLE_EVENT[:at], "repeat": WHOLE_EVENT + WHOLE_EVENT[at:]}[damage]
    with pytest.raises(ValueError, match="bytes"):
        decode(blob, *event_types())


@given(st.lists(st.tuples(st.integers(5, len(WHOLE_EVENT) - 1), st.integers(0, 255)), min_size=1, max_size=3))
def test_forged_events_are_refused_or_events(changes):
    """Damaged behind a right checksum: refused, or another event that encodes to these very bytes."""
    payload = bytearray(WHOLE_EVENT)
    for at, byte in changes:
        payload[at] = byte
    blob = sealed(bytes(payload[5:]))
    with suppress(ValueError):
        assert encode(decode(blob, *event_types())) == blob


def sealed(payload, version=FORMAT):
    """Bytes with a right checksum."""
    checked = bytes([version]) + payload
    return struct.pack("<I", zlib.crc32(checked)) + checked


def forged(name, fields):
    return sealed(msgspec.msgpack.encode([name, fields], order="sorted"))


def array(dtype, *shape, tail=b"", code=ARRAY):
    head = dtype.ljust(4).encode() + bytes([len(shape) % 256]) + b"".join(struct.pack("<Q", n) for n in shape)
    return msgspec.msgpack.Ext(code, head + tail)


def samples(time, values=None):
    return forged(
        "Samples", {"sensor": "gyroscope", "time": time, "values": array("<f8", 0, 3) if values is None else values}
    )


def test_a_forgery_can_be_right():
    """A control: so that what follows is refused for what is wrong with it."""
    event = decode(samples(array("<f8", 1, tail=bytes(8))), *event_types())
    assert same(event, Samples("gyroscope", np.zeros(1), np.empty((0, 3))))


@pytest.mark.parametrize(
    "blob",
    [
        samples(array("<f8", 2**60)),
        samples(array("<f8", 0, 2**62, 2**62)),
        samples(array("<f8", 2**63, 2)),
        samples(array("<f8", 1, tail=bytes(7))),
        samples(array("|O8", 1, tail=bytes(8))),
        samples(array("|V9", 1, tail=bytes(9))),
        samples(array("<i8", 1, tail=bytes(8))),
        samples(array("<f8", *[1] * 70, tail=bytes(8))),
        samples(array("<f8", 1, tail=bytes(8), code=2)),
        samples(array("<f8", tail=b"")),
        samples(msgspec.msgpack.Ext(ARRAY, b"")),
        samples([1.0]),
        samples(None),
        samples({"time": 1.0}),
        forged("Samples", {"sensor": "gyroscope"}),
        forged("Samples", {"sensor": "a", "time": array("<f8", 0, 3), "values": array("<f8", 0, 3)}),
        forged("Samples", ["sensor"]),
        forged("Scan", {"radio": "wifi", "heard": None}),
        forged("system", {"command": "true"}),
        forged("Trajectory", {}),
        forged("Samples", None),
        sealed(b""),
        sealed(b"\x91\xa7Samples"),
        sealed(b"\xdd\xff\xff\xff\xff"),
        sealed(b"\x92\xa7Samples\xdf\xff\xff\xff\xff"),
        sealed(b"\x92\xa7Samples\xdd\xff\xff\xff\xff"),
        sealed(b"\x92\xa7Samples\xc9\xff\xff\xff\xff\x01"),
        sealed(b"\x92\xa8Anything\x81\xa5value" + b"\x91" * 100_000),
        sealed(b"\x92\xa8Anything\x81\xa5value" + b"\xdd\xff\xff\xff\xff" * 900),
        sealed(b"\x92\xa8Anything\x81\xa5value" + b"\xdf\xff\xff\xff\xff\x01" * 900),
        sealed(b"\x92\xa8Anything\x81\xa5value\xc6\xff\xff\xff\xff"),
        sealed(b"\xff\xfe"),
        encode(Samples("gyroscope", np.zeros(1), np.zeros((1, 3)))) + b"\x00",
        sealed(encode(Samples("gyroscope", np.zeros(1), np.zeros((1, 3))))[5:], version=1),
        b"",
    ],
)
def test_forged_events_are_refused_without_the_memory_they_ask_for(blob):
    tracemalloc.start()
    with pytest.raises(ValueError, match="bytes") as refusal:
        decode(blob, *event_types(), Anything)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 20 * len(blob) + 200_000
    assert str(refusal.value).isprintable()
    assert len(str(refusal.value)) < 250


def test_only_what_was_asked_for_is_read():
    steps = Trajectory(np.zeros(1), np.zeros((1, 2)), np.zeros(1), ("",))
    with pytest.raises(ValueError, match="Trajectory"):
        decode(encode(steps), *event_types())
    assert same(decode(encode(steps), Trajectory), steps)


@dataclass(frozen=True)
class Part:
    rows: Array
    flags: NDArray[np.bool_] | None = None
    note: str = ""


@dataclass(frozen=True)
class Whole:
    parts: list[Part]
    by_name: dict[str, tuple[float, ...]] = field(default_factory=dict)


WHOLE = Whole([Part(np.ones((2, 3))), Part(np.empty((0, 3)), np.array([True, False]), "…")], {"b": (1.0,), "a": ()})


def test_nested_dataclasses_come_back_bit_by_bit():
    assert same(decode(encode(WHOLE), Whole), WHOLE)


def test_the_order_of_fields_decides_nothing():
    other = make_dataclass("Whole", [("by_name", dict[str, tuple[float, ...]]), ("parts", list[Part])], frozen=True)
    assert encode(other(WHOLE.by_name, WHOLE.parts)) == encode(WHOLE)


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ([("parts", list[Part])], "found a field or an encoding that this version does not have"),
        ([*[("parts", list[Part]), ("by_name", dict)], ("more", int)], "missing required field `more`"),
        ([("parts", list[Sightings]), ("by_name", dict)], "missing required field"),
        ([("parts", list[Part]), ("by_name", list)], "Expected `array`, got `object`"),
    ],
)
def test_other_fields_are_refused_in_one_line(fields, match):
    blob, kind = encode(WHOLE), make_dataclass("Whole", fields, frozen=True)
    with pytest.raises(ValueError, match=match) as refusal:
        decode(blob, kind)
    assert str(refusal.value).isprintable()


def test_what_comes_back_is_its_owners():
    back = decode(encode(WHOLE), Whole).parts[0].rows
    assert back.flags.writeable
    assert back.flags.aligned
    assert back.flags.owndata
