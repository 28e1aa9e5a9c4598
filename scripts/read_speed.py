"""How fast every text format is read, on a simulated walk of ten minutes as each recorder would have written it."""

import sys
import tempfile
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import recorders
import simulated

from pdr_graph import read_trajectory
from pdr_graph.io.loading import load

ROUTE = ((0.0, 0.0), (400.0, 0.0), (400.0, 300.0))


def track_of_fixes(form, head="", tail="", count=50_000):
    """Many rows of latitude, longitude and a UTC time."""
    start = datetime(2023, 11, 14, tzinfo=UTC).timestamp()
    rows = (
        form.format(lat=49.45 + 1e-6 * n, lon=11.1, time=datetime.fromtimestamp(start + n, UTC)) for n in range(count)
    )
    return head + "".join(rows) + tail


def written(folder):
    """Name to path and bytes of each format's file."""
    walk, s = simulated.walk_along(ROUTE), recorders.sample(route=ROUTE)
    point = '<trkpt lat="{lat:.9f}" lon="{lon:.9f}">\n  <ele>542.3</ele>\n'
    point += "  <time>{time:%Y-%m-%dT%H:%M:%SZ}</time>\n</trkpt>\n"
    namespace = 'xmlns="http://www.topografix.com/GPX/1/1"'
    gpx = track_of_fixes(point, f'<gpx version="1.1" {namespace}><trk><trkseg>', "</trkseg></trk></gpx>")
    plt = track_of_fixes(
        "{lat:.6f},{lon:.6f},0,492,39747.1124074074,{time:%Y-%m-%d,%H:%M:%S}\n", "Geolife trajectory\n" * 6
    )
    poses = np.column_stack([walk.time, *walk.position.T, *walk.position.T])
    texts = {
        "Indoor Location Competition": ("walk.txt", recorders.indoor_location(s, ROUTE)),
        "GetSensorData": ("log.txt", recorders.get_sensor_data(s)),
        "Android GnssLogger": ("gnss_log.txt", recorders.gnss_logger(s)),
        "phyphox": ("phyphox", recorders.phyphox(s)),
        "phyphox, decimal commas": ("comma", recorders.phyphox(s, delimiter=";", decimal=",")),
        "Sensor Logger": ("logger", recorders.sensor_logger(s)),
        "IPIN21 folder": ("ipin21", recorders.ipin21(s)),
        "Oxford step counter": ("hand.csv", recorders.oxford_steps(s)),
        "GeoLife PLT": ("day.plt", plt),
        "GPX": ("track.gpx", gpx),
        "trajectory CSV": ("t.csv", "time,x,y\n" + recorders.columns(*poses[:, :3].T, delimiter=",", form="{:.6f}")),
    }
    for name, (file, text) in texts.items():
        files = text if isinstance(text, dict) else {"": text}
        for part, content in files.items():
            path = folder / file / part if part else folder / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content, encoding="utf-8")
        yield name, folder / file, sum(len(content.encode()) for content in files.values())


def reading_rows(median_time):
    """Rows of format, megabytes and megabytes per second; ``median_time(function, runs)`` [s]."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, path, size in written(Path(folder)):
            use = read_trajectory if name.startswith("trajectory") else load
            took = median_time(lambda use=use, path=path: use(path), 5)
            rows.append([name, f"{size / 1e6:.1f}", f"{size / 1e6 / took:.0f}"])
    return rows


if __name__ == "__main__":
    from benchmark import median_time

    for row in reading_rows(median_time):
        print(*row)
