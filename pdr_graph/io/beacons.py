"""Lists of beacons and anchors with their positions, and tables of ranges to anchors: UWB, Wi-Fi RTT, BLE ranging."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.io.tables import check_clock, check_geodetic, check_rows, read_table
from pdr_graph.types import LONLAT, Beacons, Ranges, Recording, minor_number

if TYPE_CHECKING:
    from pdr_graph.floor.cells import Area

BEACON_LIST = "BLE_Locations.csv"  # the list that the organisers of IPIN competitions put in the folder of a log
SURVEY_SIGMA = 1.0  # [m] per axis, of a position without a stated sigma; chosen by hand


def beside(recording: Path) -> Path | None:
    """The path of the BEACON_LIST in the folder of a recording file; None without one."""
    path = recording.parent / BEACON_LIST
    return path if recording.is_file() and path.is_file() else None


def read_beacons(path: str | Path, recording: Recording | None = None, unstated: float = SURVEY_SIGMA) -> Beacons:
    """Read a table of beacons.

    Columns are ``beacon,x,y[,sigma][,floor]`` in the output frame, ``beacon,lat,lon[,sigma][,floor]``, or IPIN's
    ``bleID,Lat,Lon,floor``. ``beacon`` is the address as in the recording, or a name that ends in the minor number of
    an iBeacon, such as BLE3. Without a recording the names stay as in the list. unstated: sigma of places without a
    stated one [m].

    Raises InputError naming the line.
    """
    required = [("x", "y"), ("lat", "lon")]
    numbers, words = read_table(Path(path), required, optional=("sigma",), words=("beacon", "bleid", "floor"))
    geodetic = "lat" in numbers
    if geodetic:
        check_geodetic(path, numbers)
    label = words["beacon"] if any(words["beacon"]) else words["bleid"]
    position = np.stack([numbers[n] for n in (("lon", "lat") if geodetic else ("x", "y"))], axis=1)
    sigma = np.nan_to_num(numbers.get("sigma", np.full(len(label), np.nan)), nan=unstated)
    before = set[str]()
    for n, name in enumerate(label):
        if not name or name in before:
            found = f"{name[:40]!r} twice" if name else "no name"
            raise InputError(path, f"data row {n + 1}", found, "one row for each beacon, with its name")
        before.add(name)
    epsg = LONLAT if geodetic else None
    # minimum sigma [m] per axis; chosen by hand
    return Beacons(_names(label, recording), position, np.maximum(sigma, 1e-3), words["floor"], label, epsg)


def drawn_beacons(drawn: Sequence[tuple[Area, str]], recording: Recording, unstated: float = SURVEY_SIGMA) -> Beacons:
    """The beacons drawn in a plan, named by their id, mac, uuid or name. drawn: areas and the label of their floor."""
    names = ([a.properties.get(key) for key in ("id", "mac", "uuid")] for a, _ in drawn)
    label = tuple(str(next(filter(None, each), a.name)) for each, (a, _) in zip(names, drawn, strict=True))
    position = np.array([shapely.get_coordinates(area.shape).mean(axis=0) for area, _ in drawn])
    sigma = np.full(len(label), unstated)
    return Beacons(_names(label, recording), position, sigma, tuple(floor for _, floor in drawn), label)


def _names(label: Sequence[str], recording: Recording | None) -> tuple[str, ...]:
    """The transmitter in the recording for each label, by address or minor number; else the label itself."""
    received = None if recording is None else recording.bluetooth
    by_address, by_number = dict[str, str](), dict[str, str]()
    if received is not None:
        by_address = {name.lower(): name for name in received.transmitter}
        by_number = dict(zip(received.minor, received.transmitter, strict=False))
    return tuple(by_address.get(name.lower()) or by_number.get(minor_number(name), name) for name in label)


RANGE_SIGMA = 0.3  # [m] of a range with line of sight, if the table has no sigma; chosen by hand
ANCHOR_SIGMA = 0.1  # [m] per axis of an anchor's place whose list states none: tape or laser; chosen by hand
MAXIMUM_RANGE = 1000.0  # [m]; a larger distance is in other units


def read_ranges(path: Path, recording: Recording, anchors: Beacons) -> Ranges:
    """Read a table of ranges ``time,anchor,range[,sigma]``, sorted by time.

    time: on the recorder's clock [s]; anchor: a name in the list of anchors; range, sigma: [m]. anchors: in the frame
    of the walk. Raises InputError naming the row, also if no range lies within the recording.
    """
    numbers, words = read_table(path, [("time", "range")], optional=("sigma",), words=("anchor",), recording=recording)
    time, distance = numbers["time"] - recording.clock_origin, numbers["range"]
    sigma = np.nan_to_num(numbers.get("sigma", np.full(len(time), np.nan)), nan=RANGE_SIGMA)
    least_most = f"metres, from 0 to {MAXIMUM_RANGE:.0f}"
    check_rows(path, (distance < 0) | (distance > MAXIMUM_RANGE), distance, "range", least_most)
    check_rows(path, sigma <= 0, sigma, "sigma", "a standard deviation above 0 m")
    number = {label.lower(): m for m, label in enumerate(anchors.label)}
    anchor = np.array([number.get(name.lower(), -1) for name in words["anchor"]], dtype=np.intp)
    if (anchor < 0).any():
        unknown = words["anchor"][int(np.argmax(anchor < 0))]
        expected = f"one of {', '.join(anchors.label)[:80]}"
        raise InputError(path, f"data row {int(np.argmax(anchor < 0)) + 1}, anchor", f"{unknown[:40]!r}", expected)
    order = np.argsort(time, kind="stable")
    check_clock(path, time, recording)
    measured = time[order], anchor[order], distance[order], sigma[order]
    return Ranges(*measured, anchors.label, anchors.position, anchors.sigma)
