"""Reads a recording of any supported recorder, recognised by its content."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path, PurePosixPath

from pdr_graph.errors import InputError, expect
from pdr_graph.io.signatures import (
    HEAD,
    OTHERS,
    PLAN_FORMATS,
    QUOTED,
    RECORDING_FORMATS,
    SEGMENT,
    columns_of,
    described,
    function,
    names,
    recognized,
)
from pdr_graph.io.source import Source
from pdr_graph.io.validation import build_recording
from pdr_graph.types import Recording


def load(path: str | Path, gnss_latency: float = 0.0) -> Recording:
    """Read the recording in a file, a folder or a zip of any supported recorder, recognised by its content.

    gnss_latency: time by which receiver positions lag behind the other sensors [s]; 0–3 on phones.

    Raises InputError, with the place and what was expected, if no reader recognises the recording or it is damaged.
    """
    expect("load, path", path, str, Path)
    source = Source(Path(path))
    row = recognized(source, RECORDING_FORMATS)
    if row is None:
        raise InputError(path, "", *_unknown(source))
    read, notes = function(row.reader), list[str]()
    if row.positions:
        walk = build_recording(str(source.path), source.path.stem, {}, 0.0, read(source, notes), notes=notes)
    else:
        walk = read(source)
    return replace(walk, fixes=replace(walk.fixes, time=walk.fixes.time - gnss_latency))


def _unknown(source: Source) -> tuple[str, str]:
    """What was found in files of no known recorder, and what is expected."""
    expected = f"a recording of a supported recorder: {names(RECORDING_FORMATS)}"
    files = source.names
    if not files:
        return "an empty folder", expected
    if source.single is None:
        if "summary.json" in files and "trajectory.csv" in files:
            return "a result of pdr-graph", "the recording that it was made from"
        kinds = sorted({PurePosixPath(name).suffix or "no ending" for name in files})
        return f"{len(files)} files ({', '.join(kinds[:4])}), {', '.join(files[:3])[:QUOTED]}", expected
    head = source.head(source.single, HEAD)
    for mark, name, instead in OTHERS:
        if head.startswith(mark):
            return name, instead
    # four numbers in a row may as well be samples
    if plan := [row for row in PLAN_FORMATS if row.head is not SEGMENT and row.begins(head)]:
        return plan[0].name, "a recording (is this a floor plan? --map takes it)"
    cells = columns_of(head)
    if "time" in cells and ({"x", "y"} <= cells or {"lat", "lon"} <= cells):
        if "sigma" in cells:
            expected = "a recording (are these fixes? smooth RECORDING --fixes takes them)"
        elif "z" not in cells:
            expected = "a recording (is this a trajectory? evaluate and --truth take it)"
    elif len(cells) > 1 and any(name.startswith(("time", "seconds")) for name in cells):
        expected = (
            "a recording; a table of an accelerometer has phyphox's header: Time (s),X (m/s^2),Y (m/s^2),Z (m/s^2)"
        )
    found = described(head)
    return found.replace("a text", "a text named .zip", 1) if source.path.suffix.lower() == ".zip" else found, expected
