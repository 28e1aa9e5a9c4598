"""docs/examples/live_app.py runs: on a recording, and on what a phone posts."""

import importlib.util
import subprocess
import sys
import urllib.request

import simulated
from plans import ROOT
from stand_in_server import served

from pdr_graph.lab.simulation.streaming import batches, message

APP = ROOT / "docs" / "examples" / "live_app.py"
LONGEST = 60  # lines


def test_a_recording_is_followed_to_its_end(arcade_walk):
    assert len(APP.read_text(encoding="utf-8").splitlines()) <= LONGEST
    command = [sys.executable, APP, arcade_walk, arcade_walk / "plan.geojson", arcade_walk / "fixes.csv"]
    shown = subprocess.run(command, check=True, timeout=120, capture_output=True, text=True).stdout.splitlines()
    assert len(shown) > 20
    assert any("initialising heading" in line for line in shown[:6])
    assert shown[-2].endswith("; running")
    assert shown[-1].startswith("Estimate(")
    assert shown[-1].endswith(" ok")


def test_a_phone_posts_its_samples(capsys):
    """A message per second, as Sensor Logger writes them: one sample a row, times in nanoseconds of Unix time."""
    spec = importlib.util.spec_from_file_location("live_app", APP)
    app = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(app)
    app.Phone.log_message = lambda *_: None
    walk = simulated.walk_along(simulated.ROUTE[:4])
    payloads = batches(simulated.with_receiver(walk, round(10 * simulated.RATE)))[:20]
    with served(app.Phone) as server:
        for number, payload in enumerate(payloads):
            address = f"http://127.0.0.1:{server.server_port}"
            with urllib.request.urlopen(address, message("session", number, payload), timeout=60) as answer:
                assert answer.status == 200
    assert app.Phone.nav.steps > 15
    assert app.Phone.nav.frame.georeferenced
    assert app.Phone.nav.status.fixes == 2
    assert capsys.readouterr().out.count(" m ± ") > 15
