"""Recorders in, trajectories out: one format, one file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pdr_graph.errors import InputError, expect
from pdr_graph.io import (
    geolife,
    get_sensor_data,
    gnss_logger,
    gpx,
    indoor_location,
    ipin21,
    oxford_steps,
    phyphox,
    sensor_logger,
)
from pdr_graph.io.source import Source
from pdr_graph.types import Recording

READERS = (
    indoor_location,
    get_sensor_data,
    gnss_logger,
    sensor_logger,
    phyphox,
    ipin21,
    oxford_steps,
    geolife,
    gpx,
)


def load(path: str | Path, gnss_latency: float = 0.0) -> Recording:
    """A recording of any supported recorder, recognised by its content: a file, a folder or a zip.

    gnss_latency: time by which the receiver's positions lag behind its other sensors [s]; phones have 0–3.

    Raises InputError if nothing can read it, with the place and what was needed.
    """
    expect("load, path", path, str, Path)
    source = Source(Path(path))
    for reader in READERS:
        if reader.recognizes(source):
            walk = reader.read(source)
            return replace(walk, fixes=replace(walk.fixes, time=walk.fixes.time - gnss_latency))
    formats = ", ".join(reader.NAME for reader in READERS)
    raise InputError(path, "", _found(source), f"a recording of a supported recorder: {formats}")


def _found(source: Source) -> str:
    """What is there instead."""
    if source.single is None:
        return f"{len(source.names)} files, {', '.join(source.names[:3])[:60]}" if source.names else "an empty folder"
    head = source.head(source.single, 24)
    return f"the bytes {head!r}" if head else "an empty file"
