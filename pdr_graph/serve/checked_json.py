"""JSON files with a checksum: a byte that a disk or a power cut has changed is noticed."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import msgspec

from pdr_graph.lifelog.cache import write

SUM = "crc32"  # of the file without this field


def write_checked(path: Path, fields: dict[str, Any]) -> None:
    """Write fields as JSON; after the return they are on the disk. Raises OSError of the disk."""
    checksum = zlib.crc32(msgspec.json.encode(fields))
    write(path, msgspec.json.encode(fields | {SUM: checksum}), durable=True)


def read_checked(path: Path) -> dict[str, Any]:
    """The fields of a file. Raises ValueError if they are damaged; OSError if it cannot be read.

    Files of earlier versions have no checksum.
    """
    try:
        fields = msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"damaged: {error}") from None
    checksum = fields.pop(SUM, None)
    if checksum is not None and checksum != zlib.crc32(msgspec.json.encode(fields)):
        raise ValueError("damaged: its checksum does not match")
    return fields
