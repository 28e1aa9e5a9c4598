"""What a file is that no reader takes for a recording, and what to do with it: the text of an error."""

from __future__ import annotations

import re
from pathlib import PurePosixPath

from pdr_graph.source import Source

HEAD = 4096  # bytes of a file that are looked at
QUOTED = 80  # characters of a file's header that are quoted
NUMBER = re.compile(r"[-+]?[\d.]+(?:[eE][-+]?\d+)?")
PACKED = "a zip, a folder or a file (unpack it, or pack it again as zip)"
PLAN = "a recording (is this a floor plan? --map takes it)"
# First bytes of a file: what it is, what to do
MARKS: tuple[tuple[bytes, str, str], ...] = (
    (b"Rar!", "a RAR archive", PACKED),
    (b"7z\xbc\xaf", "a 7z archive", PACKED),
    (b"\x1f\x8b", "a gzip archive", PACKED),
    (b"BZh", "a bzip2 archive", PACKED),
    (b"SQLite format 3", "a database of SQLite", "a recording (is this a lifelog? pdr-graph lifelog show)"),
    (b"\xff\xd8\xff", "a JPEG picture", PLAN),
    (b"\x89PNG", "a PNG picture", PLAN),
    (b"%PDF", "a PDF", PLAN),
    (b"\xd0\xcf\x11\xe0", "an old Excel file", "CSV: save each table as CSV"),
)


def description(source: Source, readers: str) -> tuple[str, str]:
    """What was found in the files, and what is expected. readers: names of all recorders."""
    expected = f"a recording of a supported recorder: {readers}"
    if source.single is None:
        return _folder(source, expected)
    head = source.head(source.single, HEAD)
    if not head.strip(b"\0"):
        return ("an empty file" if not head else "bytes that are all 0", expected)
    for mark, name, instead in MARKS:
        if head.startswith(mark):
            return name, instead
    text = head.decode("utf-8", "replace").lstrip("\ufeff \r\n\t")
    if text[:200].lower().startswith(("<!doctype html", "<html")):
        return "a web page (was the download a login page or a message?)", expected
    if text.startswith("{") and ('"FeatureCollection"' in text or '"features"' in text):
        return "GeoJSON", PLAN
    if text.lower().startswith("<?xml") or text.startswith("<"):
        return f"XML of another kind, {text[:QUOTED]!r}", expected
    if "\ufffd" in text[:200] or "\0" in text[:200]:
        return f"the bytes {head[:24]!r}", expected
    return _table(source, text, expected)


def _folder(source: Source, expected: str) -> tuple[str, str]:
    """The same for several files."""
    names = source.names
    if not names:
        return "an empty folder", expected
    if "summary.json" in names and "trajectory.csv" in names:
        return "a result of pdr-graph", "the recording that it was made from"
    if "[Content_Types].xml" in names and any(name.startswith("xl/") for name in names):
        return "an Excel file", "CSV: save each table as CSV, or export CSV from the app"
    kinds = sorted({PurePosixPath(name).suffix or "no ending" for name in names})
    found = f"{len(names)} files ({', '.join(kinds[:4])}), {', '.join(names[:3])[:QUOTED]}"
    return found, expected


def _table(source: Source, text: str, expected: str) -> tuple[str, str]:
    """The same for a text: its header, or its first line."""
    first = text.split("\n", 1)[0].strip()
    ending = " named .zip" if source.path.suffix.lower() == ".zip" else ""
    cells = [cell.strip().strip('"').lower() for cell in re.split(r"[,;\t]", first)]
    if len(cells) < 2 or all(NUMBER.fullmatch(cell) for cell in cells):
        return f"a text{ending} that begins with {first[:QUOTED]!r}", expected
    found = f"a text{ending} with the header {first[:QUOTED]}"
    names = set(cells)
    position = {"x", "y"} <= names or {"lat", "lon"} <= names
    if "time" in names and position and "sigma" in names:
        return found, "a recording (are these fixes? smooth RECORDING --fixes takes them)"
    if "time" in names and position and "z" not in names:
        return found, "a recording (is this a trajectory? evaluate and --truth take it)"
    if any(cell.startswith(("time", "seconds")) for cell in cells):
        header = "Time (s),X (m/s^2),Y (m/s^2),Z (m/s^2)"
        return found, f"a recording; a table of an accelerometer has phyphox's header: {header}"
    return found, expected
