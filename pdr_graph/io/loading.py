"""Reads a recording of any supported recorder, recognised by its content: one module per format."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path, PurePosixPath

from pdr_graph.errors import InputError, expect, quoted
from pdr_graph.io import (
    geolife,
    get_sensor_data,
    gnss_logger,
    gpx,
    indoor_location,
    ipin21,
    named_columns,
    oxford_steps,
    past_day,
    phyphox,
    ros_bags,
    sensor_logger,
)
from pdr_graph.io.source import Source
from pdr_graph.io.tables import NUMBER
from pdr_graph.types import Recording

# Modules with NAME, recognizes(source) and read(source); the first that recognises a recording reads it
READERS = (
    indoor_location,
    get_sensor_data,
    gnss_logger,
    sensor_logger,
    phyphox,
    named_columns,
    ros_bags,
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


QUOTED = 80  # characters of a file's header that are quoted
AN_ARCHIVE = "a zip, a folder or a file (unpack it, or pack it again as zip)"
A_RECORDING = "a recording (is this a floor plan? --map takes it)"
# First bytes of a file: what it is, what to do
MARKS: tuple[tuple[bytes, str, str], ...] = (
    (b"Rar!", "a RAR archive", AN_ARCHIVE),
    (b"7z\xbc\xaf", "a 7z archive", AN_ARCHIVE),
    (b"\x1f\x8b", "a gzip archive", AN_ARCHIVE),
    (b"BZh", "a bzip2 archive", AN_ARCHIVE),
    (b"SQLite format 3", "a database of SQLite", "a recording (is this a lifelog? pdr-graph lifelog show)"),
    (b"\xff\xd8\xff", "a JPEG picture", A_RECORDING),
    (b"\x89PNG", "a PNG picture", A_RECORDING),
    (b"%PDF", "a PDF", A_RECORDING),
    (b"\xd0\xcf\x11\xe0", "an old Excel file", "CSV: save each table as CSV"),
)


def description(source: Source, readers: str) -> tuple[str, str]:
    """What was found in the files, and what is expected. readers: names of all recorders."""
    expected = f"a recording of a supported recorder: {readers}"
    names = source.names
    if not names:
        return "an empty folder", expected
    if source.single is None:
        if "summary.json" in names and "trajectory.csv" in names:
            return "a result of pdr-graph", "the recording that it was made from"
        if "[Content_Types].xml" in names and any(name.startswith("xl/") for name in names):
            return "an Excel file", "CSV: save each table as CSV, or export CSV from the app"
        kinds = sorted({PurePosixPath(name).suffix or "no ending" for name in names})
        return f"{len(names)} files ({', '.join(kinds[:4])}), {', '.join(names[:3])[:QUOTED]}", expected
    head = source.head(source.single)
    if not head.strip(b"\0"):
        return ("an empty file" if not head else "bytes that are all 0", expected)
    for mark, name, instead in MARKS:
        if head.startswith(mark):
            return name, instead
    text = head.decode("utf-8", "replace").lstrip("\ufeff \r\n\t")
    if text[:200].lower().startswith(("<!doctype html", "<html")):
        return "a web page (was the download a login page or a message?)", expected
    if text.startswith("{") and ('"FeatureCollection"' in text or '"features"' in text):
        return "GeoJSON", A_RECORDING
    if text.lower().startswith("<?xml") or text.startswith("<"):
        return f"XML of another kind, {text[:QUOTED]!r}", expected
    if "\ufffd" in text[:200] or "\0" in text[:200]:
        return quoted(head[:24]), expected
    first = text.split("\n", 1)[0].strip()
    ending = " named .zip" if source.path.suffix.lower() == ".zip" else ""
    names = {cell.strip().strip('"').lower() for cell in re.split(r"[,;\t]", first)}
    if len(names) < 2 or all(re.fullmatch(NUMBER, name) for name in names):
        return f"a text{ending} that begins with {first[:QUOTED]!r}", expected
    if "time" in names and ({"x", "y"} <= names or {"lat", "lon"} <= names):
        if "sigma" in names:
            expected = "a recording (are these fixes? smooth RECORDING --fixes takes them)"
        elif "z" not in names:
            expected = "a recording (is this a trajectory? evaluate and --truth take it)"
    elif any(name.startswith(("time", "seconds")) for name in names):
        header = "Time (s),X (m/s^2),Y (m/s^2),Z (m/s^2)"
        expected = f"a recording; a table of an accelerometer has phyphox's header: {header}"
    return f"a text{ending} with the header {first[:QUOTED]}", expected
