"""Lossless encoding of typed dataclasses without pickle.

One format serves the events of a journal and the blobs of a lifelog:

    CRC-32 of what follows (4 bytes) · format (1) · msgpack: [name of the type, fields by name in alphabetical order]

A numeric array is an extension of msgpack: its dtype, its shape, its bytes. `decode` checks every field against its
type hint, and that encoding the result gives the same bytes, so additional fields are errors. Fields with a default may
be missing, as in bytes of older versions.
"""

from __future__ import annotations

import hashlib
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import msgspec
import numpy as np

FORMAT = 2  # of the bytes; 1 was JSON with the arrays behind it
HEADER = struct.Struct("<IB")  # checksum, format
CHECKSUM = 4  # bytes
ARRAY = 1  # code of the msgpack extension
ARRAY_SHAPE = struct.Struct("<4sB")  # dtype and number of dimensions, before the dimensions
SIMPLE = (str, float, int, np.ndarray, type(None))  # values without fields
DTYPES = frozenset(np.dtype(name).str for name in ("f8", "f4", "c16", "i8", "i4", "u8", "u4", "u1", "?"))
UNREADABLE = (
    *(msgspec.MsgspecError, struct.error, ValueError, TypeError, AttributeError),
    *(LookupError, RecursionError, OverflowError),
)
Value = TypeVar("Value")


def encode(value: object) -> bytes:
    """Encode a dataclass. Raises TypeError if a field is not of its type, since it could not be decoded."""
    return encode_and_decode(value)[0]


def encode_and_decode(value: Value) -> tuple[bytes, Value]:
    """The bytes of a dataclass, and the result of `decode` for these bytes. Raises TypeError as `encode`."""
    kind = type(value)
    if not is_dataclass(value):
        raise TypeError(f"found {kind.__name__}, expected a dataclass")
    try:
        again = _decoder(kind).decode(_ENCODER.encode(value))
        payload = _ENCODER.encode([kind.__name__, again])
    except UNREADABLE as error:
        raise TypeError(f"{kind.__name__}: {_on_one_line(error)}") from None
    checked = bytes([FORMAT]) + payload
    return struct.pack("<I", zlib.crc32(checked)) + checked, again


def decode(blob: bytes, *kinds: type) -> Any:
    """Decode the bytes of a dataclass of one of these kinds.

    Raises ValueError for other bytes; memory is allocated for no more than there are bytes.
    """
    try:
        return _decoded(blob, {kind.__name__: kind for kind in kinds})
    except UNREADABLE as error:
        names = " or ".join(kind.__name__ for kind in kinds)
        raise ValueError(f"bytes of no {names[:80]}: {_on_one_line(error)}") from None


def _decoded(blob: bytes, kinds: Mapping[str, type]) -> Any:
    checksum, version = HEADER.unpack_from(blob)
    if zlib.crc32(memoryview(blob)[CHECKSUM:]) != checksum:
        raise ValueError("their checksum does not match")
    if version != FORMAT:
        raise ValueError(f"found format {version}, expected {FORMAT}")
    payload = memoryview(blob)[HEADER.size :]
    name, raw = _ENVELOPE.decode(payload)
    if name not in kinds:
        raise ValueError(f"found a {name[:40]!r}")
    value = _decoder(kinds[name]).decode(raw)
    again = _ENCODER.encode([name, value])
    if again != bytes(payload):  # of a memoryview every byte would be compared by itself
        raise ValueError("found a field or an encoding that this version does not have")
    return value


def _on_one_line(error: Exception) -> str:
    return " ".join((str(error) or type(error).__name__).split())[:120]


def _plain(value: Any) -> Any:
    """A numpy value as a type that msgspec encodes. Raises TypeError for other values."""
    if isinstance(value, np.generic):
        return value.item()
    if not isinstance(value, np.ndarray) or value.dtype.str not in DTYPES:
        what = f"an array of {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
        raise TypeError(f"found {what}, expected texts, numbers, numeric arrays and dataclasses of these")
    code = value.dtype.str.ljust(4).encode()
    head = ARRAY_SHAPE.pack(code, value.ndim) + struct.pack(f"<{value.ndim}Q", *value.shape)
    return msgspec.msgpack.Ext(ARRAY, head + value.tobytes())


def _array(code: int, data: memoryview) -> Any:
    """The numeric array of a msgpack extension, aligned and writable. Raises ValueError for other bytes."""
    if code != ARRAY:
        raise ValueError(f"found msgpack extension {code}")
    name, dimensions = ARRAY_SHAPE.unpack_from(data)
    text = name.decode("ascii").rstrip()
    if text not in DTYPES or dimensions > 8:  # most dimensions
        raise ValueError(f"found an array of dtype {text!r} and {dimensions} dimensions")
    shape, dtype = struct.unpack_from(f"<{dimensions}Q", data, ARRAY_SHAPE.size), np.dtype(text)
    begin = ARRAY_SHAPE.size + 8 * dimensions
    if math.prod(shape) * dtype.itemsize != len(data) - begin:
        raise ValueError(f"found an array of shape {shape} in {len(data) - begin} bytes")
    array = np.frombuffer(data, dtype, offset=begin).reshape(shape).copy()
    if dtype.kind == "b" and array.view(np.uint8).max(initial=0) > 1:
        raise ValueError("found truth values beyond 1")
    return array


def _typed(kind: Any, value: Any) -> Any:
    """The value of a field whose type msgspec does not know: an array of the declared dtype, if one is declared."""
    if kind is not np.ndarray and get_origin(kind) is not np.ndarray:
        raise TypeError(f"a field of type {kind} cannot be stored")
    if not isinstance(value, np.ndarray):
        raise ValueError(f"Expected `array of numbers`, got `{type(value).__name__}`")
    declared: Any = Any if kind is np.ndarray else get_args(get_args(kind)[1])[0]
    if declared is not Any and value.dtype != np.dtype(declared):
        raise ValueError(f"Expected `array of {np.dtype(declared)}`, got `array of {value.dtype}`")
    return value


@cache
def _decoder(kind: type) -> msgspec.msgpack.Decoder[Any]:
    return msgspec.msgpack.Decoder(kind, dec_hook=_typed, ext_hook=_array)


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_plain, order="sorted")
_ENVELOPE = msgspec.msgpack.Decoder(tuple[str, msgspec.Raw])


def compress(value: object) -> bytes:
    """`encode`, compressed."""
    # level of zlib: the next ones take twice the time for a hundredth of the size of random digits
    return zlib.compress(encode(value), 1)


def decompress(blob: bytes, *kinds: type) -> Any:
    """The dataclass, one of these kinds, that `compress` made the bytes of. Raises ValueError for other bytes."""
    try:
        return decode(zlib.decompress(blob), *kinds)
    except zlib.error as error:
        raise ValueError(f"bytes of no {kinds[0].__name__}: {_on_one_line(error)}") from None


def encode_json(value: object) -> str:
    """A dataclass of texts and numbers as JSON."""
    return msgspec.json.encode(value).decode()


def decode_json(text: str, kind: type[Value]) -> Value:
    """The dataclass of which `encode_json` made the text. Raises ValueError for other texts."""
    try:
        return msgspec.json.decode(text, type=kind)
    except UNREADABLE as error:
        raise ValueError(f"no JSON of {kind.__name__}: {_on_one_line(error)}") from None


def fingerprint(path: Path, files: Sequence[Path] = ()) -> str:
    """The name of an input with the SHA-256 of names and contents of its files, by default of ``path`` itself."""
    digest = hashlib.sha256()
    for file in files or (path,):
        with file.open("rb") as content:
            content_hash = hashlib.file_digest(content, "sha256").hexdigest()
        digest.update(f"{file.name}\0{content_hash}\n".encode(errors="surrogateescape"))
    return f"{path.resolve().name}, sha256 {digest.hexdigest()}"


def write_text(path: Path, text: str) -> None:
    r"""Write a text as UTF-8; bytes of a file name that are not UTF-8 become escapes, which JSON reads back: \udcff."""
    path.write_text(text, encoding="utf-8", errors="backslashreplace")
