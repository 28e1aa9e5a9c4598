"""Attacks on `pdr-graph lifelog export`: random days, places, days and formats; counts what an export gives away.

    scripts/privacy_fuzz.py [COUNT] [SEED]

Each case is a lifelog of one to three days near midnight or noon, anywhere on earth, with one to three private places:
homes, places that overlap them, places on the way. Everything is exported uncut, and then with cuts and blurs into the
same folders, in all formats. Of what lies in the folders then every position, line, name and time is examined, and the
areas and squares that several radii reveal are put together. A tenth as many cases are lifelogs built from files, parts
of which are masked ("not me") or forgotten. Exit code 1 if any attack succeeds.
"""

from __future__ import annotations

import csv
import io
import json
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import shapely

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "lifelog")]

import made_tracks  # noqa: E402
from made_days import STANDING, VEHICLE, WALKING, outing, stay  # noqa: E402

from pdr_graph.apps.lifelog.day import (  # noqa: E402
    GAP,
    Day,
    Outing,
    rows_of,
)
from pdr_graph.apps.lifelog.export import CSV, GEOJSON, GPX, PARQUET, SECRET, export_days  # noqa: E402
from pdr_graph.apps.lifelog.privacy import SQUARE_SIDE, PrivatePlace, nested_squares, private_places  # noqa: E402
from pdr_graph.apps.lifelog.revision import forget, state_not_me  # noqa: E402
from pdr_graph.apps.lifelog.store import Store  # noqa: E402
from pdr_graph.frames import Frame, enu  # noqa: E402

FORMATS = (GPX, GEOJSON, CSV, PARQUET)
MIDNIGHT = datetime(2024, 5, 1, tzinfo=UTC).timestamp()
SECRET_WORDS = re.compile(rb"(?i)grandma|anna/from|5f3b5f3b|a note")  # a stay's name, a path, a hash, a note
POINT = re.compile(r'lat="([-\d.]+)" lon="([-\d.]+)"')
RADII_TRIED = 6  # descriptions of one place


def random_day(random: np.random.Generator, frame: Frame, number: int) -> Day:
    """A day of walks, rides, stands and gaps from home, at noon or about midnight."""
    outings = list[Outing]()
    clock = MIDNIGHT + 86400 * number + float(random.choice([-600.0, 300.0, 30000.0, 36000.5]))
    for _ in range(random.integers(1, 4)):
        legs = [(STANDING, float(random.integers(1, 2000)), 0.0)] * int(random.integers(0, 2))
        heading = random.uniform(0, 2 * np.pi)
        for _ in range(random.integers(2, 9)):
            kind = str(random.choice([WALKING, WALKING, VEHICLE, STANDING, GAP]))
            legs.append((kind, float(random.choice([60, 120, 300, 450, 900])), heading))
            heading += float(random.choice([0.0, np.pi / 2, -np.pi / 2, np.pi]))
        legs.append((WALKING, 60.0, heading))
        home = stay(0.0, legs[0][1], (0.0, 0.0), [("Grandma's", 0.9)])
        outings.append(outing(legs, epoch=clock, frame=frame, stays=[home]))
        clock = outings[-1].epoch + outings[-1].trajectory.time[-1] + float(random.choice([2.0, 120.0, 5000.0]))
    return Day("Anna", str((datetime.fromtimestamp(MIDNIGHT, UTC) + timedelta(days=number)).date()), tuple(outings))


def random_places(random: np.random.Generator, days: Sequence[Day], frame: Frame) -> list[str]:
    """Home, and up to two places that overlap it or lie on the way, as a user describes them."""
    rows = np.concatenate([own.trajectory.position for day in days for own in day.outings])
    middles = [np.zeros(2), *rows[random.integers(len(rows), size=2)], random.normal(0, 200, 2)]
    chosen = [middles[0], *(middles[n] for n in random.choice(3, random.integers(0, 3), replace=False) + 1)]
    lonlat = frame.to_lonlat(np.array(chosen))
    return [f"{lat:.6f},{lon:.6f},{np.exp(random.uniform(np.log(10), np.log(1500))):.0f}" for lon, lat in lonlat]


def lines_in(folder: Path) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """What the files of a folder draw: kind, positions ``(n, 2)`` [deg], Unix times ``(n,)`` or none."""
    for path in sorted(folder.rglob("*")):
        if path.suffix == ".gpx":
            for part in path.read_text().split("<trkseg>"):
                yield (
                    "gpx",
                    np.array([(float(lon), float(lat)) for lat, lon in POINT.findall(part)]).reshape(-1, 2),
                    np.empty(0),
                )
        elif path.suffix == ".geojson":
            for feature in json.loads(path.read_text())["features"]:
                points = np.array(feature["geometry"]["coordinates"], dtype=float).reshape(-1, 2)
                yield "geojson", points, np.array(feature["properties"].get("times", []))
        elif path.suffix == ".csv":
            yield from _lines_of_csv(path.read_text())
        elif path.suffix == ".parquet":
            yield from _lines_of_parquet(path)


def _lines_of_csv(text: str) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    rows = [row for row in csv.DictReader(io.StringIO(text)) if row["latitude"]]
    for row in rows:  # each by itself: a file has no lines between them
        time = [float(row["time"])] if "time" in row else []
        yield "csv", np.array([[float(row["longitude"]), float(row["latitude"])]]), np.array(time)


def _lines_of_parquet(path: Path) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    import geopandas

    table = geopandas.read_parquet(path)
    times = table["tracked_at"].astype("int64").to_numpy() if "tracked_at" in table else None
    unit = 1e3 if times is None or times.max(initial=0) < 1e14 else 1e9
    for n, shape in enumerate(table.geometry):
        yield "parquet", shapely.get_coordinates(shape), np.empty(0) if times is None else times[n : n + 1] / unit


def examine(folder: Path, cut: Sequence[PrivatePlace], blur: Sequence[PrivatePlace], found: Counter[str]) -> None:
    """Count what the files of a folder give away, and how much was examined."""
    for kind, lonlat, _ in lines_in(folder):
        found[f"positions examined: {kind}"] += len(lonlat)
        for place in cut:
            found[f"GIVEN AWAY position in a cut area: {kind}"] += int(place.hides(lonlat).sum()) if len(lonlat) else 0
            if len(lonlat) > 1:
                found[f"GIVEN AWAY line through a cut area: {kind}"] += int(place.crossed(lonlat).sum())
        for place in blur:
            inside = lonlat[place.hides(lonlat)] if len(lonlat) else lonlat
            sides = [SQUARE_SIDE, *(p.radius for p in blur)]
            middles = np.array([nested_squares(inside, np.full(len(inside), s))[0] for s in sides if s >= SQUARE_SIDE])
            exact = (np.abs(middles - inside).max(axis=2) > 1e-6).all(axis=0) if len(inside) else np.empty(0)
            found[f"GIVEN AWAY exact position in a blurred area: {kind}"] += int(exact.sum())
    for path in folder.rglob("*"):
        found["files searched for names, modes"] += path.is_file()
        found["GIVEN AWAY name, path, hash or note"] += bool(path.is_file() and SECRET_WORDS.search(_bytes(path)))
        found["GIVEN AWAY file readable by others"] += bool(path.is_file() and path.stat().st_mode & 0o077)


def _bytes(path: Path) -> bytes:
    """The bytes of a file; of a Parquet file also its columns and metadata, which are compressed."""
    if path.suffix != ".parquet":
        return path.name.encode() + path.read_bytes()
    from pyarrow import parquet

    table = parquet.read_table(path)
    texts = [
        str(table.column(name).to_pylist()) for name in table.column_names if name not in ("geom", "center", "extent")
    ]
    return " ".join([path.name, str(table.schema.metadata), *texts]).encode() + path.read_bytes()


def put_together(random: np.random.Generator, text: str, secret: bytes, found: Counter[str]) -> None:
    """What several radii about one place reveal to somebody who locates each hidden area exactly."""
    lat, lon, _ = (float(word) for word in text.split(","))
    radii = np.exp(random.uniform(np.log(20), np.log(1500), RADII_TRIED)).round()
    areas = [private_places([f"{lat},{lon},{radius:.0f}"], [], secret)[0] for radius in radii]
    own = enu(lat, lon)
    middles = np.concatenate([own.from_lonlat(area.frame.to_lonlat(np.zeros((1, 2)))) for area in areas])
    smallest = int(np.argmin(radii))
    found["places described with several radii"] += 1
    distance = np.hypot(*middles.T)
    found["sum of errors [% of the least radius]: one description"] += round(100 * distance[smallest] / radii[smallest])
    weighted = np.average(middles, axis=0, weights=1 / radii**2)
    found["sum of errors [% of the least radius]: mean of all"] += round(100 * np.hypot(*weighted) / radii[smallest])
    squares = [nested_squares(np.array([[lon, lat]]), np.array([side]))[2][0] for side in (500 * radii / radii.min())]
    around = [(corners - (lon - 180, -90)) % 360 for corners in squares]  # in one piece at the antimeridian
    boxes = [shapely.box(*corners.min(axis=0), *corners.max(axis=0)) for corners in around]
    ratio = shapely.area(shapely.intersection_all(boxes)) / min(shapely.area(box) for box in boxes)
    found["GIVEN AWAY less than the smallest square by several blurs"] += bool(ratio < 0.999)


def one_case(seed: int, found: Counter[str]) -> None:
    """Export a random lifelog uncut and with random cuts and blurs, and examine what lies there then."""
    random = np.random.default_rng(seed)
    frame = enu(float(random.uniform(-70, 75)), float(random.choice([random.uniform(-180, 180), 179.9995, 0.0])))
    days = [random_day(random, frame, n) for n in range(random.integers(1, 4))]
    texts = random_places(random, days, frame)
    first_blurred = int(random.integers(0, len(texts) + 1))
    with tempfile.TemporaryDirectory() as folder:
        store, out = Path(folder) / "days.db", Path(folder) / "out"
        with Store(store, new=True) as log:
            for day in days:
                log.put_day(rows_of(day, "key", ["5f3b5f3b" * 8]))
        for file_format in FORMATS:
            export_days(store, out / file_format, file_format)
        cut, blur = texts[:first_blurred], texts[first_blurred:]
        for file_format in FORMATS:
            export_days(store, out / file_format, file_format, cut=cut, blur=blur)
        with Store(store) as log:
            secret = bytes.fromhex(log.setting(SECRET))
        examine(out, private_places(cut, [], secret), private_places(blur, [], secret), found)
        put_together(random, texts[0], secret, found)
    found["cases of random days"] += 1


def masked_case(seed: int, found: Counter[str]) -> None:
    """Mask and forget random hours of a day built from a file, and look for their times in all formats."""
    random = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        store = made_tracks.lifelog(Path(folder))
        spans = []
        for state in (state_not_me, forget):
            start = made_tracks.MORNING + 60 * int(random.integers(0, 270))
            spans.append((start, start + 60 * int(random.integers(1, 60))))
            state(store, *(f"{datetime.fromtimestamp(time, UTC):%Y-%m-%d %H:%M}" for time in spans[-1]))
        for file_format in FORMATS:
            export_days(store, Path(folder) / "out" / file_format, file_format)
        for kind, _, time in lines_in(Path(folder) / "out"):
            inside = np.any([(time > a + 0.1) & (time < b - 0.1) for a, b in spans], axis=0)
            found[f"times examined: {kind}"] += len(time)
            found[f"GIVEN AWAY position of a masked or forgotten time: {kind}"] += int(inside.sum())
    found["cases of masked and forgotten hours"] += 1


if __name__ == "__main__":
    number, first = int((sys.argv[1:] or ["200"])[0]), int((sys.argv[2:] or ["0"])[0])
    counts: Counter[str] = Counter()
    for seed in range(first, first + number):
        one_case(seed, counts)
    for seed in range(first, first + number // 10):
        masked_case(seed, counts)
    for name in sorted(counts):
        print(f"{counts[name]:>10}  {name}")
    raise SystemExit(any(n for name, n in counts.items() if name.startswith("GIVEN AWAY")))
