"""A day of positions written as a recording, for tests of what persons correct and delete."""

from datetime import UTC, datetime

import numpy as np

from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.ingest import add
from pdr_graph.frames import enu
from pdr_graph.io.research_recordings import EPOCH_1899
from pdr_graph.types import DAY_LENGTH

MORNING = datetime(2024, 5, 1, 8, tzinfo=UTC).timestamp()  # [s] Unix time
HOUR = 3600.0
HOME = (48.1, 11.5)
FRAME = enu(*HOME)
OFFICE = (3000.0, 500.0)  # [m] from home
PERIOD = 10.0  # [s]


def at(hours):
    """The Unix time of an hour of the first day [s]."""
    return MORNING + (hours - 8) * HOUR


def clock(hours, day=1):
    """A time as a person types it."""
    return f"2024-05-{day:02d} {int(hours):02d}:{round(60 * (hours % 1)):02d}"


def lonlat(x, y):
    """Longitude and latitude of a place in metres from home."""
    return FRAME.to_lonlat(np.array([[x, y]], dtype=float))[0]


def place(x, y):
    """A place in metres from home, as a person types it."""
    longitude, latitude = lonlat(x, y)
    return f"{latitude:.6f},{longitude:.6f}"


def positions(day=0, seed=0):
    """Times [s] and places [m]: home from 8 to 9, a ride of 10 min, the office to 12, and home again."""
    random = np.random.default_rng(seed)
    time = np.arange(8 * HOUR, 13 * HOUR, PERIOD)
    share = np.interp(time / HOUR, [9, 9 + 1 / 6, 12, 12 + 1 / 6], [0, 1, 1, 0])
    where = share[:, None] * np.array(OFFICE) + random.normal(0, 3.0, (len(time), 2))
    return MORNING - 8 * HOUR + day * DAY_LENGTH + time, where


def geolife(path, time, lonlat):
    """Write positions [deg] at Unix times [s] as a GeoLife file."""
    rows = ["Geolife trajectory", "WGS 84", "Altitude is in Feet", "Reserved 3", "0,2,255,My Track,0,0,2,8421376", "0"]
    for seconds, (lon, lat) in zip(time, lonlat, strict=True):
        days = f"{(seconds - EPOCH_1899) / DAY_LENGTH:.10f}"
        rows.append(f"{lat:.7f},{lon:.7f},0,492,{days},{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d,%H:%M:%S}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(rows) + "\n")
    return path


def write(path, time, where):
    """Write positions [m from home] at Unix times [s]."""
    return geolife(path, time, FRAME.to_lonlat(where))


def lifelog(folder, days=1, person="me", **options):
    """A built lifelog of some days of a person."""
    for day in range(days):
        write(folder / "raw" / person / f"{day}.plt", *positions(day, day))
    store = folder / "store" / "days.db"
    store.parent.mkdir(exist_ok=True)
    add(store, [folder / "raw" / person], person=person, **options)
    assert build(store, "UTC").built == days
    return store
