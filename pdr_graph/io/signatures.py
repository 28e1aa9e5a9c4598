"""Signatures of all formats of recordings, fixes and floor plans: the names and the first bytes by which each is known.

A reader is imported when a file has its signature, and not before. A format is one row of `RECORDING_FORMATS`,
`FIX_FORMATS` or `PLAN_FORMATS`; the first row that matches is the format.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path, PurePosixPath
from typing import Any

from pdr_graph.errors import quoted
from pdr_graph.io.source import Source

HEAD = 16_384  # [bytes] of a file by which it is recognised: some logs begin with a page of comments


@dataclass(frozen=True)
class Signature:
    """How the files of one format are recognised, and what reads them.

    name: in messages; reader: its function, ``module:function``; head: pattern that the first HEAD bytes match, or a
    test of them. files: pattern of the name, without folders and in lower case, of a recording's files; named: True if
    the only file of a recording must have that name too.
    folder: names that a plan's folder has; parts: of all its files that are read, any of which stands for the folder;
    scaled: True if the reader takes a scale [m per unit]; positions: True if it returns fixes at Unix times, and not a
    recording.
    """

    name: str
    reader: str
    head: bytes | Callable[[bytes], bool] = rb"(?!)"
    files: str = ""
    named: bool = False
    folder: tuple[str, ...] = ()
    parts: tuple[str, ...] = ()
    scaled: bool = False
    positions: bool = False

    def begins(self, head: bytes) -> bool:
        """True if the first bytes of a file are those of the format."""
        return self.head(head) if callable(self.head) else re.match(self.head, head) is not None

    def within(self, source: Source, head: Callable[[str, int], bytes]) -> Iterator[str]:
        """The names of the files that have the signature, the shortest first. head: `source.head`, or a cache of it."""
        for name in sorted(source.names, key=lambda name: (len(name), name)):
            known = re.fullmatch(self.files, PurePosixPath(name).name.lower()) is not None
            if (known or (source.single and not self.named)) and self.begins(head(name, HEAD)):
                yield name

    def is_folder(self, path: Path) -> bool:
        """True for the folder of a plan of this format."""
        return bool(self.folder) and all((path / name).is_file() for name in self.folder)


def function(reader: str) -> Callable[..., Any]:
    """The function ``module:function`` of the package, imported now."""
    module, _, name = reader.partition(":")
    return getattr(import_module(f"pdr_graph.{module}"), name)


def recognized(source: Source, table: Iterable[Signature]) -> Signature | None:
    """The first format whose signature one of the files has; None without one."""
    head = cache(source.head)
    return next((row for row in table if next(row.within(source, head), None) is not None), None)


def plain(name: str) -> str:
    """A column's name in lower case, without its unit, spaces, dots and underscores."""
    return re.sub(r"\([^()]*\)|[^a-z0-9]", "", name.lower())


# The header of a table of Movella's stands below lines about the device
ABOVE_HEADER = re.compile(rb'\A(?:(?!"?PacketCounter\b)[^\n]*\n)*?(?="?PacketCounter\b)')


def columns_of(head: bytes) -> set[str]:
    """The plain names of the columns in the header of a table."""
    above = ABOVE_HEADER.match(head)
    line = head[above.end() if above else 0 :].lstrip().split(b"\n", 1)[0].decode("utf-8", "replace")
    return {plain(cell) for cell in re.split("[,;\t]", line)}


def has_columns(*names: str) -> Callable[[bytes], bool]:
    """A test of the first bytes of a file: True if they are a header with columns of these plain names."""
    return lambda head: columns_of(head).issuperset(names)


# Columns by which tables with named columns are told apart, the first first
NAMED_COLUMNS = {
    "SensorLog": ("loggingtime",),
    "DeviceMotion": ("rotationratealpha",),
    "Movella": ("packetcounter", "accx"),
    "step counter": ("time", "steps"),
}
# Patterns that first bytes match
DECIMAL = rb"[-+]?[0-9.]+(?:[eE][+-]?[0-9]+)?"
TAGGED = rb"(?s:.*)GetSensorData|(?:[^\n]*\n)*?(?:ACCE|GYRO|MAGN|PRES|GNSS|POSI|BLE4|WIFI)([;,\t])\s*-?[0-9.]+\1"
ELAPSED = rb"[\s\S]{0,500}?seconds_elapsed"
NANOSECONDS = ELAPSED + rb'|"?time"?,[^\n]*\n"?\d{18,19}"?,'  # of Sensor Logger in 2021
LOGGED = r"(?:(?:accelerometer|gyroscope)(?:uncalibrated)?|totalacceleration|gravity|location|barometer)\.csv"
TIME_COLUMN = rb'"?[^",;\t\r\n()]{1,20} \((?:s|ms)\)"?[,;\t][^\n]*'  # and more, before a sensor's unit
UNIT = rb"\(\s*(?i:m/s\^?(?:2|\xc2\xb2)|rad/s|\xc2\xb0(?:/s)?|[u\xc2\xb5\xce\xbc]*t|hpa)\s*\)\s*\"?\s*(?:[,;\t\n]|\Z)"
BAG = rb"(?:\x89MCAP0\r\n|SQLite format 3[\s\S]*serialization_format)"
IPIN21 = rb"\s*1[0-9.]+(?:e\+12)?[0-9]*[ \t]+-?[0-9.]+(?:e[+-][0-9]+)?(?:[ \t]|\r?\n)"
IPIN21_FIXES = rb"\s*1\.?[0-9]+(?:e\+12)?,[0-9.]+(?:e\+05)?,[0-9.]+(?:e\+06)?,"
OXFORD_WITH_ACCURACY = rb"[0-9]{9,19},[0-3](?:,%b){3}\r?\n" % DECIMAL  # of each sample
OXFORD_ROW = OXFORD_WITH_ACCURACY + rb"|[0-9]{9,19}(?:,%b){3}(?:,[0-9]+){3}\r?\n" % DECIMAL
STRIDES = rb"test(?: %b){9} 1[0-9]{12} " % DECIMAL
EDINBURGH = rb"\s*(?:<\?xml[^>]*>\s*)?<data\s[^>]*>\s*<(?:[agm]|wr)\s"
WORKBOOK = r"workbook\.(?:xml|bin)"  # in an Excel file
GPX_ROOT = rb"[\s\S]{0,4000}?<\0?(?:(?:[\w.-]\0?)+:\0?)?g\0?p\0?x\0?[\s>]"  # also in UTF-16
OSM_ROOT = rb"[\s\S]{0,2048}?<\0?o\0?s\0?m"
DXF = rb"(?:AutoCAD Binary DXF|\s*(?:0\s+SECTION|999)(?!\S))"
MAP_KEYS = rb"(?ms)(?=.*^[ \t]*image\s*:)(?=.*^[ \t]*resolution\s*:)(?=.*^[ \t]*origin\s*:)"
SEGMENT = rb"[ \t]*%b(?:[ \t]*[,;\t][ \t]*%b){3}[ \t]*(?:\r?\n|\Z)" % (DECIMAL, DECIMAL)

PHYPHOX = Signature("phyphox", "io.phyphox:read", TIME_COLUMN + UNIT, r".*\.(?:csv|txt|tsv)")
GEOLIFE = Signature("GeoLife", "io.research_recordings:geolife_fixes", rb"Geolife trajectory", positions=True)
RECORDING_FORMATS: tuple[Signature, ...] = (
    Signature("Indoor Location Competition 2.0", "io.indoor_location:read", rb"#\tstartTime:|(?s:.*)\tTYPE_"),
    Signature("GetSensorData (IPIN, xDR)", "io.get_sensor_data:read", TAGGED),
    Signature("GnssLogger", "io.gnss_logger:read", rb"(?=#)[\s\S]*?# (?:Fix|Raw|UncalAccel),"),
    Signature("Sensor Logger", "io.sensor_logger:read", NANOSECONDS, LOGGED, named=True),
    Signature("Sensor Logger", "io.sensor_logger:read", ELAPSED),  # one table, renamed by its user
    PHYPHOX,
    *(Signature(name, "io.named_columns:read", has_columns(*columns)) for name, columns in NAMED_COLUMNS.items()),
    Signature("ROS 2", "io.ros_bags:read", BAG),
    Signature("ROS 2", "io.ros_bags:read", rb"rosbag2_bagfile_information:", r"metadata\.yaml", named=True),
    Signature("IPIN21Data", "io.research_recordings:read_ipin21", IPIN21, r"(?:acc|gyr)\.csv", named=True),
    Signature("Oxford step counter", "io.research_recordings:read_oxford", OXFORD_ROW, r"accelerometer\.csv"),
    Signature("strides", "io.research_recordings:read_strides", STRIDES),
    Signature("RIDI", "io.research_recordings:read_ridi", rb"", WORKBOOK, named=True),
    Signature("Edinburgh", "io.research_recordings:read_edinburgh", EDINBURGH, r".*\.xml"),
    GEOLIFE,
    Signature("GPX", "io.gpx:read", GPX_ROOT),
    Signature("imported past", "io.past_day:read_fixes", rb"# pdr_graph past", positions=True),
)
# Files of positions with Unix times, other than tables with a header
FIX_FORMATS: tuple[Signature, ...] = (
    Signature("GPX", "io.gpx:read_fixes", GPX_ROOT),
    GEOLIFE,
    Signature("IPIN21Data", "io.research_recordings:ipin21_fixes", IPIN21_FIXES),
)

SITE_JSON = ("geojson_map.json", "floor_info.json")  # of Microsoft: areas; size of the floor
IMDF_TYPES = ("level", "unit", "opening", "fixture", "kiosk", "amenity", "anchor", "occupant")
IMDF_PARTS = ("manifest.json", *(f"{kind}.geojson" for kind in IMDF_TYPES))
MICROSOFT = Signature("Microsoft", "floor.formats.research_plans:read_microsoft", folder=SITE_JSON[:1], parts=SITE_JSON)
ROS_MAP = Signature("a ROS map", "floor.formats.ros_map:read", MAP_KEYS, scaled=True)
GEOJSON = Signature("GeoJSON", "floor.formats.geojson:read_plan", rb'\s*\{[\s\S]*"(?:FeatureCollection|features)"')
PLAN_FORMATS: tuple[Signature, ...] = (
    MICROSOFT,
    Signature("IMDF", "floor.formats.imdf:read", folder=IMDF_PARTS[1:3], parts=IMDF_PARTS),
    Signature("a DXF drawing", "floor.formats.cad:read_dxf", DXF, scaled=True),
    Signature("a PDF", "floor.formats.pdf_page:read", rb"\s*%PDF-", scaled=True),
    Signature("a PNG picture", "floor.formats.floor_picture:read", rb"\x89PNG\r\n", scaled=True),
    Signature("a JPEG picture", "floor.formats.floor_picture:read", rb"\xff\xd8\xff", scaled=True),
    ROS_MAP,
    Signature("CAD lines", "floor.formats.cad:read_segments", has_columns("x1", "y1", "x2", "y2"), scaled=True),
    Signature("CAD lines", "floor.formats.cad:read_segments", SEGMENT, scaled=True),  # without a header
    Signature("OpenStreetMap", "floor.formats.osm_indoor:read_xml", OSM_ROOT),
    GEOJSON,
)

ARCHIVES = {b"Rar!": "RAR", b"7z\xbc\xaf": "7z", b"\x1f\x8b": "gzip", b"BZh": "bzip2"}
AN_ARCHIVE = "a zip, a folder or a file (unpack it, or pack it again as zip)"
# First bytes of files that no reader takes: what they are, what to do
OTHERS: tuple[tuple[bytes, str, str], ...] = (
    *((mark, f"a {name} archive", AN_ARCHIVE) for mark, name in ARCHIVES.items()),
    (b"SQLite format 3", "a database of SQLite", "a recording (is this a lifelog? pdr-graph lifelog show)"),
    (b"\xd0\xcf\x11\xe0", "an old Excel file", "CSV: save each table as CSV"),
    (b"AC10", "a DWG drawing", "the same saved as DXF"),
    (b"P5", "the picture of a ROS map", "its .yaml file"),
)


def geojson_reader(properties: Sequence[dict[str, Any]]) -> str:
    """The reader of a GeoJSON plan, ``module:function``, by the properties of its features: of our own have a kind."""
    tags = [tags_of(each) for each in properties]
    if any("indoor" in each for each in tags) and not any("kind" in each and "indoor" not in each for each in tags):
        return "floor.formats.osm_indoor:read"
    if any("Type" in each and "kind" not in each for each in properties):
        return "floor.formats.research_plans:read_ipin21"
    return "floor.formats.geojson:read"


def tags_of(properties: dict[str, Any]) -> dict[str, Any]:
    """The tags of a feature of OpenStreetMap: its properties, or their member ``tags``."""
    tags = properties.get("tags")
    return tags if isinstance(tags, dict) else properties


def names(table: Iterable[Signature]) -> str:
    """The names of all formats of a table, for messages."""
    return ", ".join(dict.fromkeys(row.name for row in table))


QUOTED = 80  # characters of a file's header that are quoted


def described(head: bytes) -> str:
    """What a file of no known format is, by its first bytes, for messages."""
    if not head.strip(b"\0"):
        return "bytes that are all 0" if head else "an empty file"
    text = head.decode("utf-8", "replace").lstrip("\ufeff \r\n\t")
    if text[:200].lower().startswith(("<!doctype html", "<html")):
        return "a web page (was the download a login page or a message?)"
    if text.startswith("<"):
        return f"XML of another kind, {text[:QUOTED]!r}"
    if "\ufffd" in text[:200] or "\0" in text[:200]:
        return quoted(head[:24])
    first = text.split("\n", 1)[0].strip()
    cells = columns_of(head)
    is_header = len(cells) > 1 and any(cell[:1].isalpha() for cell in cells)
    return f"a text with the header {first[:QUOTED]}" if is_header else f"a text that begins with {first[:QUOTED]!r}"
