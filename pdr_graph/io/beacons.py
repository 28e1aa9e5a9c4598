"""Lists of Bluetooth beacons and their positions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.io.tables import check_geodetic, read_table
from pdr_graph.types import LONLAT, Beacons, Recording, minor_number

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
