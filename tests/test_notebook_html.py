"""Data types in a notebook: a table of escaped text, a picture of paths, plans and sensors, without matplotlib."""

import subprocess
import sys
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from plans import MAPS
from walks import fixes_at, wandering_walk

import pdr_graph as pdr
from pdr_graph.notebook_html import MOST_POINTS
from pdr_graph.online.interface import Mode, Pose

STEPS = wandering_walk(30)
FIXES = fixes_at([1.0, 9.0], [[0.0, 0.0], [5.0, 5.0]])
ESTIMATE = pdr.smooth(pdr.WalkGraph(STEPS, FIXES))
TIME = np.arange(0, 10, 0.01)
SIGNAL = pdr.Signal(TIME, np.random.default_rng(0).normal(size=(1000, 3)))
RECORDING = pdr.Recording("<script>alert(1)</script>", 0.0, None, accelerometer=SIGNAL, fixes=FIXES)
PLAN = pdr.FloorPlan.load(MAPS / "loop.geojson")
PICTURED = [ESTIMATE, ESTIMATE.trajectory, FIXES, PLAN, RECORDING]
POSE = Pose(3.0, 1.0, 2.0, 0.5, "F1", np.eye(3), (Mode(0.9, 1.0, 2.0, 0.5, np.eye(3)),))
PLAIN = [STEPS, SIGNAL, POSE, POSE.modes[0], pdr.Navigator().status, pdr.Samples("gyroscope", 0.0, (0, 0, 0))]


@pytest.mark.parametrize("record", [*PICTURED, *PLAIN], ids=lambda record: type(record).__name__)
def test_a_notebook_shows_a_table_and_a_picture(record):
    """Well-formed, so that nothing of a record can be markup; as small as a picture of a thousand points."""
    html = record._repr_html_()
    page = ET.fromstring(html.replace("<br>", "<br/>"))
    assert page.find("b").text == repr(record)
    assert len(page.findall("table/tr")) >= 2
    drawn = [e for e in page.iter() if e.tag.endswith("polyline") or e.tag.endswith("circle")]
    assert bool(drawn) is any(record is one for one in PICTURED)
    assert len(html) < 200_000


def test_names_of_files_are_escaped():
    html = RECORDING._repr_html_()
    assert "<script>" not in html
    assert "&lt;script&gt;" in html


def test_a_long_track_is_thinned_and_unknown_places_are_left_out():
    long = np.column_stack([np.arange(1e5), np.zeros(100_000)])
    long[7] = np.nan
    track = pdr.Trajectory(np.arange(1e5), long, np.zeros(100_000))
    (line,) = [e for e in ET.fromstring(track._repr_html_().replace("<br>", "<br/>")).iter() if "points" in e.attrib]
    assert len(line.attrib["points"].split()) == MOST_POINTS
    assert "nan" not in line.attrib["points"]


def test_nothing_to_draw_is_no_picture():
    assert "<svg" not in pdr.Fixes.none()._repr_html_()
    assert "<svg" not in pdr.Recording("empty", 0.0, None)._repr_html_()


def test_a_picture_needs_no_matplotlib():
    code = (
        "import sys, numpy as np, pdr_graph as pdr; t = pdr.Trajectory(np.arange(3.), np.ones((3, 2)), np.zeros(3));"
        "assert '<svg' in t._repr_html_(); assert 'matplotlib' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_a_journal_has_one_line_too(tmp_path):
    with pdr.Journal.open(tmp_path / "a.journal", pdr.Navigator) as journal:
        assert repr(journal) == f"Journal('{tmp_path / 'a.journal'}', 0 events)"


@pytest.mark.parametrize("record", [pdr.Navigator(), POSE, pdr.WalkGraph(STEPS, FIXES), pdr.Prior(), pdr.Frame()])
def test_other_public_types_have_one_line_too(record):
    text = repr(record)
    assert text.startswith(f"{type(record).__name__}(")
    assert "\n" not in text
    assert len(text) < 300
