"""The example app on a real walk: what a phone recorded, as the events of a browser."""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import chromium
from scipy.ndimage import uniform_filter1d

from pdr_graph.geometry import interpolate
from pdr_graph.io.loading import load
from pdr_graph.types import Fixes, Signal

sys.path.append(str(Path(__file__).parents[1] / "serve"))
from running_server import RunningServer
from streamed_walks import bodies, until
from test_app_page import AppPage

SECONDS = 100.0


@pytest.mark.thorough
@pytest.mark.timeout(180)
def test_a_campus_walk_through_the_browser_is_that_of_its_samples(data, tmp_path):
    """The page's packets, clock, units and signs change its path by less than 3 cm."""
    walk = load(data / "nju_phyphox_outdoor")
    at = walk.accelerometer.time[walk.accelerometer.time < SECONDS]
    acceleration, fixes = walk.accelerometer.values[: len(at)], walk.fixes[walk.fixes.time < SECONDS]
    signals = {
        "accelerometer": Signal(at, acceleration),
        "gyroscope": Signal(at, interpolate(at, walk.gyroscope.time, walk.gyroscope.values)),
    }
    fixes = Fixes(fixes.time, fixes.position, fixes.sigma, epsg=fixes.epsg)  # the page has no course
    others = dict.fromkeys(walk.signals.keys() - signals.keys())
    recording = replace(walk, **others, **signals, fixes=fixes, epoch=round(time.time() - SECONDS))
    up = uniform_filter1d(acceleration, 200, axis=0)
    up /= np.linalg.norm(up, axis=1)[:, None]
    server = RunningServer(tmp_path / "out")
    try:
        with chromium(offline=False) as browser:
            page = AppPage(browser, server.url)
            session = page.start()
            page.walk(recording, up)
            page.until("return !app.state.queue.length")
            page.run("document.getElementById('start').click()")
            server.post(*bodies(recording, "direct"), path="/sensorlogger?platform=android")
            until(lambda: "direct" in server.ask("/walkers")[1])
            server.ask("/walkers/direct/finish", method="POST")
            (own_time, own), (time_, direct) = (ended(server, id_) for id_ in (session, "direct"))
    finally:
        server.kill()
    assert len(direct) > 100
    assert np.allclose(own_time, time_, atol=0.01)
    apart = 111_000.0 * np.abs(own - direct).max()  # [m] of degrees
    print(f"{apart:.3f} m apart at most")
    assert apart < 0.03


def ended(server, id_):
    """Times and positions (longitude, latitude) of a walk that is finished."""
    until(lambda: json.loads(server.ask(f"/walkers/{id_}")[1])["state"] == "finished")
    finalised = json.loads(server.ask(f"/walkers/{id_}.geojson")[1])["features"][0]
    return np.array(finalised["properties"]["times"]), np.array(finalised["geometry"]["coordinates"])
