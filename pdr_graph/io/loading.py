"""Reads a recording of any supported recorder, recognised by its content: one module per format."""

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
    past_day,
    phyphox,
    sensor_logger,
)
from pdr_graph.io.likely_causes import description
from pdr_graph.io.source import Source
from pdr_graph.types import Recording

# Modules with NAME, recognizes(source) and read(source); the first that recognises a recording reads it
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
    past_day,
)


def load(path: str | Path, gnss_latency: float = 0.0) -> Recording:
    """Read the recording in a file, a folder or a zip of any supported recorder, recognised by its content.

    gnss_latency: time by which receiver positions lag behind the other sensors [s]; 0–3 on phones.

    Raises InputError, with the place and what was expected, if no reader recognises the recording or it is damaged.
    """
    expect("load, path", path, str, Path)
    source = Source(Path(path))
    for reader in READERS:
        if reader.recognizes(source):
            walk = reader.read(source)
            return replace(walk, fixes=replace(walk.fixes, time=walk.fixes.time - gnss_latency))
    found, expected = description(source, ", ".join(reader.NAME for reader in READERS))
    raise InputError(path, "", found, expected)
