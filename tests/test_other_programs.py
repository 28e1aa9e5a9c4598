"""What evo, QGIS (GDAL by pyogrio) and movingpandas make of the files that ``smooth`` writes."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import run

pytestmark = pytest.mark.thorough  # tests/test_results.py has the rows of both files
BESIDE = str(Path(sys.executable).parent)


@pytest.fixture(scope="module")
def result(arcade_walk, tmp_path_factory):
    walk, out = arcade_walk, tmp_path_factory.mktemp("result")
    given = ("--map", walk / "plan.geojson", "--fixes", walk / "fixes.csv", "--truth", walk / "truth.csv")
    assert run("smooth", walk, *given, "--no-report", "--out", out).code == 0
    return out


def evo(program, *arguments):
    """Run a program of evo with its default settings; its output."""
    found = shutil.which(program, path=BESIDE) or shutil.which(program)
    if found is None:
        pytest.skip(f"{program} is not installed: pip install evo")
    done = subprocess.run([found, *map(str, arguments)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def walked(result):
    """Length of the trajectory. [m]"""
    rows = np.genfromtxt(result / "trajectory.csv", delimiter=",", names=True)
    return np.hypot(np.diff(rows["x"]), np.diff(rows["y"])).sum()


def test_evo_ape_has_the_error_of_summary_json(result):
    """With its default matching, 0.01 s, every sample of the truth has a row of the trajectory."""
    printed = evo("evo_ape", "tum", result / "truth.tum", result / "trajectory.tum", "-v")
    values = dict(re.findall(r"(\w+)\t([\d.]+)", printed))
    scores = json.loads((result / "summary.json").read_text())["scores"]
    assert float(values["median"]) == pytest.approx(scores["ce"]["p50"], abs=0.02)
    assert float(values["max"]) == pytest.approx(scores["ce"]["max"], abs=0.05)
    matched = int(re.search(r"Found (\d+) of max\. (\d+) possible", printed)[1])
    assert matched == scores["n"]


def test_qgis_reads_line_and_fixes(result):
    """By GDAL, as QGIS does: longitude and latitude, one line and a point for each fix with its weight."""
    pyogrio = pytest.importorskip("pyogrio", reason="pyogrio is not installed: pip install '.[geo]'")
    file = result / "trajectory.geojson"
    assert pyogrio.read_info(file)["crs"] == "EPSG:4326"
    table = pyogrio.read_dataframe(file)
    fixes = table[table.kind == "fix"]
    assert list(table.geometry.geom_type) == ["LineString", *["Point"] * len(fixes)]
    assert fixes.weight.between(0, 1).all()
    metres = table[table.kind == "trajectory"].to_crs(table.estimate_utm_crs()).length.iloc[0]
    assert metres == pytest.approx(walked(result), rel=0.01)


def test_movingpandas_makes_a_trajectory_of_the_geojson(result):
    """As docs/formats.md shows: a point for each time of the line."""
    geopandas = pytest.importorskip("geopandas", reason="geopandas is not installed: pip install '.[geo]'")
    pandas = pytest.importorskip("pandas")
    movingpandas = pytest.importorskip("movingpandas", reason="movingpandas is not installed: pip install movingpandas")
    line = geopandas.read_file(result / "trajectory.geojson").query("kind == 'trajectory'").iloc[0]
    points = geopandas.points_from_xy(*line.geometry.xy, crs=4326)
    moving = geopandas.GeoDataFrame({"t": pandas.to_datetime(line.times, unit="s")}, geometry=points)
    trajectory = movingpandas.Trajectory(moving, traj_id="walk", t="t")
    assert trajectory.get_length() == pytest.approx(walked(result), rel=0.01)
    assert trajectory.get_duration().total_seconds() == pytest.approx(27.3, abs=0.2)
