"""docs/examples/live_app.py runs: on a recording, and on what a phone posts."""

import importlib.util
import json
import subprocess
import sys
import threading
import urllib.request
from http.server import HTTPServer
from pathlib import Path

import pytest

import pdr_graph as pdr
from pdr_graph.lab.simulation.recorders import write

APP = Path(__file__).resolve().parent.parent / "docs" / "examples" / "live_app.py"
LONGEST = 60  # lines


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """A simulated walk as the files of a recorder, with its plan and fixes."""
    folder = tmp_path_factory.mktemp("walk")
    write(pdr.simulate(pdr.Scenario.load("arcade")), folder)
    return folder


def test_the_app_is_short():
    assert len(APP.read_text(encoding="utf-8").splitlines()) <= LONGEST


def test_a_recording_is_followed_to_its_end(walk):
    command = [sys.executable, APP, walk, walk / "plan.geojson", walk / "fixes.csv"]
    shown = subprocess.run(command, check=True, timeout=120, capture_output=True, text=True).stdout.splitlines()
    assert len(shown) > 100
    assert "initialising heading" in shown[5]
    assert shown[-2].endswith("; running")
    assert shown[-1].startswith("Estimate(")
    assert shown[-1].endswith(" ok")


def test_a_phone_posts_its_samples(walk, capsys):
    """A message per second, as Sensor Logger writes them: one sample a row, times in nanoseconds of Unix time."""
    spec = importlib.util.spec_from_file_location("live_app", APP)
    app = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(app)
    server = HTTPServer(("127.0.0.1", 0), app.Phone)
    app.Phone.log_message = lambda *_: None
    threading.Thread(target=server.serve_forever, daemon=True).start()
    recording = pdr.load(walk)
    for second in range(20):
        body = json.dumps({"payload": rows(recording, second)}).encode()
        with urllib.request.urlopen(f"http://127.0.0.1:{server.server_port}", body, timeout=60) as answer:
            assert answer.status == 200
    server.shutdown()
    server.server_close()
    assert app.Phone.nav.steps > 15
    assert app.Phone.nav.frame.georeferenced
    assert app.Phone.nav.status.fixes == 2
    assert capsys.readouterr().out.count(" m ± ") > 15


def rows(recording, second):
    """The rows of one second of a recording, and a location in every tenth."""
    begin = 1_700_000_000 + second
    found = []
    for name, signal in (
        ("accelerometeruncalibrated", recording.accelerometer),
        ("gyroscope", recording.gyroscope),
        ("magnetometer", recording.magnetometer),
    ):
        of = (signal.time >= second) & (signal.time < second + 1)
        for time, values in zip(signal.time[of] - second, signal.values[of].tolist(), strict=True):
            found.append(
                {"name": name, "time": int((begin + time) * 1e9), "values": dict(zip("xyz", values, strict=True))}
            )
    if second % 10 == 0:
        place = {"longitude": 11.0 + second * 1.2e-6, "latitude": 48.0, "horizontalAccuracy": 4.5}
        found.append({"name": "location", "time": int(begin * 1e9), "values": place})
    return found
