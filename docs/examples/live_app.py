"""A live app: prints where the walker is, from a recording as if it were live, or from a phone that posts to it.

python live_app.py walk walk/plan.geojson walk/fixes.csv
python live_app.py          Sensor Logger, Push URL: http://THIS-COMPUTER:8000, units and frames standardised
"""

import json
import sys
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer

import pdr_graph as pdr

NAMES = {"accelerometeruncalibrated": pdr.Sensor.ACCELEROMETER, "gyroscope": pdr.Sensor.GYROSCOPE}
NAMES["magnetometer"] = pdr.Sensor.MAGNETOMETER  # from Sensor Logger's names
SIGMA = 1.51  # radius of 68 % that phones state, in standard deviations per axis


def events_of_message(message):
    """Samples and fixes of one posted message, in order of time [s, Unix]."""
    for row in sorted(message["payload"], key=lambda row: row["time"]):
        time, values = row["time"] / 1e9, row["values"]
        if row["name"] in NAMES:
            yield pdr.Samples(NAMES[row["name"]], time, [values[axis] for axis in "xyz"])
        elif row["name"] == "location":
            place = values["longitude"], values["latitude"]
            yield pdr.Fixes(time, place, values["horizontalAccuracy"] / SIGMA, epsg=pdr.LONLAT, source="gnss")


def follow(nav, events, shown=-1.0):
    """Push events; print pose and status once per second of the walk; return the time of the last line [s]."""
    for event in events:
        nav.push(event)
        if isinstance(event, pdr.Samples) and event.time[-1] >= shown + 1 and (pose := nav.pose) is not None:
            shown, status = float(event.time[-1]), nav.status
            place = f"{shown:.0f} s: ({pose.x:.1f}, {pose.y:.1f}) m ± {pose.sigma:.1f} m"
            print(place, status.state, *status.missing, *status.issues, sep="; ", flush=True)
    return shown


class Phone(BaseHTTPRequestHandler):
    nav, shown = pdr.Navigator(), -1.0

    def do_POST(self):
        message = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        Phone.shown = follow(Phone.nav, events_of_message(message), Phone.shown)
        self.send_response(200)
        self.end_headers()


if __name__ == "__main__":
    if len(sys.argv) == 1:
        HTTPServer(("", 8000), Phone).serve_forever()
    recording, plan, fixes = sys.argv[1:]
    floor, walk = pdr.FloorPlan.load(plan), pdr.load(recording)
    nav = pdr.Navigator(floor)
    follow(nav, pdr.events_of(replace(walk, fixes=pdr.read_fixes(fixes, walk, floor.frame))))
    walked = nav.finish()
    print(walked, pdr.verdict(walked).state)
