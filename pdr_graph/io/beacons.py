"""Lists of Bluetooth beacons: which is where."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor.areas import Area
from pdr_graph.io.tables import check_geodetic, read_table
from pdr_graph.types import LONLAT, Beacons, Recording

BESIDE = "BLE_Locations.csv"  # the organisers of IPIN competitions put it beside their logs
SURVEY_SIGMA, LEAST_SIGMA = 1.0, 1e-3  # [m] per axis, where a list does not say; and at least
NUMBER = re.compile(r"\d+$")


def beside(recording: Path) -> Path | None:
    """The list beside a recording, if there is one."""
    path = recording.parent / BESIDE
    return path if recording.is_file() and path.is_file() else None


def read_beacons(path: str | Path, recording: Recording | None = None) -> Beacons:
    """Beacons of a table ``beacon,x,y[,sigma][,floor]`` in the output frame, ``beacon,lat,lon[,sigma][,floor]``, or
    IPIN's ``bleID,Lat,Lon,floor``.

    ``beacon`` is its address as the recording has it, or a name that ends in an iBeacon's minor number, as BLE3 does.
    Without a recording the names are those of the list.
    Raises InputError naming the line.
    """
    required = [("x", "y"), ("lat", "lon")]
    numbers, words = read_table(Path(path), required, optional=("sigma",), words=("beacon", "bleid", "floor"))
    geodetic = "lat" in numbers
    if geodetic:
        check_geodetic(path, numbers)
    label = words["beacon"] if any(words["beacon"]) else words["bleid"]
    position = np.stack([numbers[n] for n in (("lon", "lat") if geodetic else ("x", "y"))], axis=1)
    sigma = np.nan_to_num(numbers.get("sigma", np.full(len(label), np.nan)), nan=SURVEY_SIGMA)
    for n, of in enumerate(label):
        if not of or of in label[:n]:
            found = f"{of[:40]!r} twice" if of else "no name"
            raise InputError(path, f"data row {n + 1}", found, "a row for each beacon, by its name")
    epsg = LONLAT if geodetic else None
    return Beacons(_names(label, recording), position, np.maximum(sigma, LEAST_SIGMA), words["floor"], label, epsg)


def drawn_beacons(drawn: Sequence[tuple[Area, str]], recording: Recording) -> Beacons:
    """Beacons of a plan, each with the label of its floor; their id or name is as ``beacon`` in a list."""
    keys = ("id", "mac", "uuid")
    label = tuple(str(next((a.properties[k] for k in keys if a.properties.get(k)), a.name)) for a, _ in drawn)
    position = np.array([shapely.get_coordinates(area.shape).mean(axis=0) for area, _ in drawn])
    sigma = np.full(len(label), SURVEY_SIGMA)
    return Beacons(_names(label, recording), position, sigma, tuple(floor for _, floor in drawn), label)


def _names(label: Sequence[str], recording: Recording | None) -> tuple[str, ...]:
    """The transmitters in the recording that are called so."""
    heard = None if recording is None else recording.bluetooth
    by_address, by_number = dict[str, str](), dict[str, str]()
    if heard is not None:
        by_address = {name.lower(): name for name in heard.transmitter}
        by_number = dict(zip(heard.minor, heard.transmitter, strict=False))
    return tuple(by_address.get(of.lower()) or by_number.get(number_of(of), of) for of in label)


def number_of(label: str) -> str:
    """The number that a name ends in, without leading zeros; empty without one."""
    found = NUMBER.search(label)
    return str(int(found.group())) if found else ""
