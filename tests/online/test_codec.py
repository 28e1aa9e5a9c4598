"""Events and snapshots come back from their bytes as they were; other bytes are refused."""

import json
import struct
import tracemalloc
import zlib

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra import numpy as arrays

from pdr_graph.online.codec import EVENTS, decode, encode, pack, unpack
from pdr_graph.online.events import Samples, Scan
from pdr_graph.types import Fixes, Sightings, Steps, Trajectory

ANY = st.floats(width=64)  # NaN, infinities and -0.0 too
TEXT = st.text()


def same(one, other):
    """Bit by bit, down to the signs of zeros and the payloads of NaN in arrays."""
    if isinstance(one, np.ndarray):
        return (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    if hasattr(one, "__dataclass_fields__"):
        return type(one) is type(other) and same(vars(one), vars(other))
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
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
    match draw(st.sampled_from(EVENTS)).__name__:
        case "Samples":
            return Samples(draw(TEXT), column(), column(draw(st.integers(0, 3))))
        case "Scan":
            minor = draw(st.sampled_from([(), draw(texts)]))
            return Scan(draw(TEXT), Sightings(column(), draw(texts), column(), minor))
        case "Fixes":
            source = draw(st.sampled_from([(), draw(texts)]))
            epsg = draw(st.none() | st.integers(0, 99999))
            sigma = column(elements=positive)
            return Fixes(column(elements=finite), column(2, elements=finite), sigma, draw(texts), epsg, source)
        case "Steps":
            ends, sigmas = np.arange(1.0, n + 1), (column(elements=positive), column(elements=positive))
            moved = [column(elements=finite) for _ in range(3)]
            return Steps(0.0, n + 1.0, ends, np.full(n, 0.5), *moved, *sigmas, draw(finite), draw(texts))


@given(events())
def test_events_come_back_bit_by_bit(event):
    assert same(decode(encode(event), EVENTS), event)


TREES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**200), 2**200)
    | ANY.filter(lambda value: value == value)  # which NaN a lone number is, is not kept
    | TEXT
    | arrays.arrays(
        st.sampled_from([np.float64, np.float32, np.complex128, np.int64, np.uint64, np.bool_]),
        arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3),
    ),
    lambda parts: st.lists(parts) | st.dictionaries(TEXT.filter(lambda key: "@" not in key), parts),
    max_leaves=20,
)


@given(TREES)
def test_snapshots_come_back_bit_by_bit(tree):
    assert same(unpack(pack(tree)), tree)


def test_what_would_not_come_back_is_refused():
    time = np.zeros(2)
    for event in (
        Samples("gyroscope", [0.0, 1.0], np.zeros((2, 3))),
        Samples("gyroscope", time.astype(object), np.zeros((2, 3))),
        Scan("wifi", Sightings(time, ["a", "b"], time)),
        Samples(7, time, time),
    ):
        with pytest.raises(TypeError, match="needed"):
            encode(event)
    with pytest.raises(TypeError, match="@"):
        pack({"@": ["<f8", 1]})


def test_slices_come_back_whole():
    values = np.arange(12.0).reshape(4, 3)
    event = Samples("gyroscope", values[::2, 0], values.T[:, ::2].T)
    assert same(decode(encode(event), EVENTS), event)


@given(st.binary(max_size=200))
def test_random_bytes_are_refused(blob):
    with pytest.raises(ValueError, match="bytes"):
        decode(blob, EVENTS)


@given(st.data())
def test_damaged_events_are_refused(data):
    blob = bytearray(encode(Samples("gyroscope", np.zeros(3), np.ones((3, 3)))))
    at = data.draw(st.integers(0, len(blob) - 1))
    damage = data.draw(st.sampled_from(["flip", "cut", "repeat"]))
    if damage == "flip":
        blob[at] ^= 1 << data.draw(st.integers(0, 7))
    elif damage == "cut":
        del blob[at:]
    else:
        blob += blob[at:]
    with pytest.raises(ValueError, match="bytes"):
        decode(bytes(blob), EVENTS)


def forged(told, tail=b""):
    """Bytes with a right checksum."""
    text = told if isinstance(told, bytes) else json.dumps(told).encode()
    checked = struct.pack("<I", len(text)) + text + tail
    return struct.pack("<I", zlib.crc32(checked)) + checked


@pytest.mark.parametrize(
    "blob",
    [
        forged({"Samples": {"sensor": "gyroscope", "time": {"@": ["<f8", 2**60]}, "values": {"@": ["<f8", 0, 3]}}}),
        forged({"Samples": {"sensor": "a", "time": {"@": ["<f8", 0]}, "values": {"@": ["<f8", 0, 2**62, 2**62]}}}),
        forged({"Samples": {"sensor": "a", "time": {"@": ["<f8", -1]}, "values": {"@": ["<f8", 0]}}}, bytes(8)),
        forged({"Samples": {"sensor": "a", "time": {"@": ["|O", 1]}, "values": {"@": ["<f8", 0]}}}, bytes(8)),
        forged({"Samples": {"sensor": "a", "time": {"@": ["|V1000000000", 1]}, "values": 1}}),
        forged({"Samples": {"sensor": "a", "time": {"@": [*["<f8"], *[1] * 70]}, "values": 1}}, bytes(8)),
        forged({"Samples": {"sensor": "a", "time": {"@": []}, "values": {"@": None}}}),
        forged({"Samples": {"sensor": "a", "time": [1.0], "values": [1.0]}}),
        forged({"Samples": {"sensor": "a"}}),
        forged({"Samples": ["sensor"]}),
        forged({"Scan": {"radio": "wifi", "heard": None}}),
        forged({"system": {"command": "true"}}),
        forged({"Trajectory": {}}),
        forged({}),
        forged([]),
        forged(1),
        forged({"Samples": {}}, bytes(8)),
        forged(b"[" * 100_000),
        forged(b"\xff\xfe"),
        forged(b"9" * 100_000),
        struct.pack("<II", zlib.crc32(struct.pack("<I", 2**32 - 1)), 2**32 - 1),
        b"",
    ],
)
def test_forged_events_are_refused_without_the_memory_they_ask_for(blob):
    tracemalloc.start()
    with pytest.raises(ValueError, match="bytes") as refusal:
        decode(blob, EVENTS)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 20 * len(blob) + 100_000
    assert len(str(refusal.value)) < 200


def test_only_what_was_asked_for_is_read():
    steps = Trajectory(np.zeros(1), np.zeros((1, 2)), np.zeros(1), ("",))
    with pytest.raises(ValueError, match="Trajectory"):
        decode(encode(steps), EVENTS)
    assert same(decode(encode(steps), (Trajectory,)), steps)
