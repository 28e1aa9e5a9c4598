"""Exports of other programs, written for tests."""

import json
import zipfile
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from pdr_graph.apps.lifelog.past.importing import import_past
from pdr_graph.apps.lifelog.store import Store

NOON = 1_714_564_800  # [s] 2024-05-01T12:00:00Z
LAT, LON = 52.5, 13.4


def iso(time):
    """A Unix time as Google writes it."""
    return datetime.fromtimestamp(time, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def location(time, lat=LAT, lon=LON, accuracy=10, source="GPS", **more):
    """An element of Records.json."""
    place = {"latitudeE7": round(lat * 1e7), "longitudeE7": round(lon * 1e7)}
    return place | {"accuracy": accuracy, "source": source, "timestamp": iso(time)} | more


def records(path, locations, **options):
    """Write a Records.json."""
    path.write_text(json.dumps({"locations": locations}, **options), encoding="utf-8")
    return path


def position(time, lat=LAT, lon=LON, accuracy=10, source="GPS"):
    """A raw signal of Timeline.json."""
    text = f"{lat:.7f}°, {lon:.7f}°"
    return {"position": {"LatLng": text, "accuracyMeters": accuracy, "source": source, "timestamp": iso(time)}}


def scan(time, levels):
    """A Wi-Fi scan of Timeline.json; levels: address -> power [dBm]."""
    devices = [{"mac": mac, "rawRssi": round(rssi)} for mac, rssi in levels.items()]
    return {"wifiScan": {"deliveryTime": iso(time), "devicesRecords": devices}}


def overland(path, times, lonlat, accuracy):
    """Write the locations of an Overland phone. lonlat: ``(n, 2)`` [deg]; accuracy: of all [m]."""
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": place},
            "properties": {"timestamp": iso(time), "horizontal_accuracy": accuracy},
        }
        for time, place in zip(times, np.asarray(lonlat).tolist(), strict=True)
    ]
    path.write_text(json.dumps({"locations": features}), encoding="utf-8")
    return path


def path_of(times, lat=LAT, lon=LON):
    """A segment with a path of Timeline.json."""
    points = [{"point": f"{lat}°, {lon}°", "time": iso(time)} for time in times]
    return {"startTime": iso(min(times)), "endTime": iso(max(times)), "timelinePath": points}


def timeline(path, segments=(), signals=()):
    """Write a Timeline.json of Android."""
    content = {
        "semanticSegments": list(segments),
        "rawSignals": list(signals),
        "userLocationProfile": {"frequentPlaces": []},
    }
    path.write_text(json.dumps(content, ensure_ascii=False), encoding="utf-8")
    return path


def zipped(path, files):
    """Write a zip; files: name -> path."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, file in files.items():
            archive.write(file, name)
    return path


def imported(store, *files, person=None):
    """Import files; returns the result."""
    return import_past(store, files, person)


def content(store):
    """All that a lifelog has of the past: rows of recordings and guesses, and the files of the days by name."""
    with Store(store) as log:
        entries = {(e.hash, e.person, e.path.rpartition("/")[2]) for e in log.entries()}
        days = {file.name: file.read_text() for file in sorted(log.folder.rglob("*.csv"))}
        return entries, [repr(g) for g in log.guesses("me")], days


def rows(store, day="2024-05-01", person="me"):
    """The rows of positions in the file of a day: time [ms], source."""
    with Store(store) as log:
        [file] = [e.path for e in log.entries() if e.path.endswith(f"{day}.csv") and e.person == person]
    lines = Path(file).read_text(encoding="utf-8").split("milliseconds,")[1].splitlines()[1:]
    return [line.split(",") for line in lines]
