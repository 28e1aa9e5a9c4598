"""What evo, QGIS (GDAL by pyogrio) and movingpandas make of the files that ``smooth`` writes."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import simulated
from test_cli import inside

from pdr_graph import read_trajectory

BESIDE = str(Path(sys.executable).parent)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arcade")
    walk, out = folder / "walk", folder / "result"
    simulated.arcade(walk)
    given = ("--map", walk / "plan.geojson", "--fixes", walk / "fixes.csv", "--truth", walk / "truth.csv")
    assert inside("smooth", walk, *given, "--out", out)[0] == 0
    return out


def evo(program, *arguments):
    """Run a program of evo with its default settings; its output."""
    found = shutil.which(program, path=BESIDE) or shutil.which(program)
    if found is None:
        pytest.skip(f"{program} is not installed: pip install evo")
    done = subprocess.run([found, *map(str, arguments)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_evo_ape_has_the_error_of_summary_json(result):
    """With its default matching, 0.01 s, every sample of the truth has a row of the trajectory."""
    printed = evo("evo_ape", "tum", result / "truth.tum", result / "trajectory.tum", "-v")
    values = dict(re.findall(r"(\w+)\t([\d.]+)", printed))
    scores = json.loads((result / "summary.json").read_text())["scores"]
    assert float(values["median"]) == pytest.approx(scores["ce"]["p50"], abs=0.02)
    assert float(values["max"]) == pytest.approx(scores["ce"]["max"], abs=0.05)
    matched = int(re.search(r"Found (\d+) of max\. (\d+) possible", printed)[1])
    assert matched == scores["n"]


def test_evo_traj_reads_both_files(result):
    printed = evo("evo_traj", "tum", result / "trajectory.tum", "--ref", result / "truth.tum")
    lengths = [float(value) for value in re.findall(r"([\d.]+)m path length", printed)]
    assert lengths == pytest.approx([28.3, 26.5], abs=0.1)


def test_a_tum_file_has_a_row_within_evos_tolerance_of_any_time(result):
    time = read_trajectory(result / "trajectory.tum").time
    assert np.diff(time).max() <= 2 * 0.01


def test_tum_and_csv_are_the_same_trajectory(result):
    dense, steps = read_trajectory(result / "trajectory.tum"), read_trajectory(result / "trajectory.csv")
    for axis in range(2):
        at_steps = np.interp(steps.time, dense.time, dense.position[:, axis])
        assert at_steps == pytest.approx(steps.position[:, axis], abs=0.02)
    truth = read_trajectory(result / "truth.tum")
    assert np.isfinite(truth.heading).all()


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
    assert metres == pytest.approx(28.3, abs=0.5)


def test_movingpandas_makes_a_trajectory_of_the_geojson(result):
    """As docs/formats.md shows: a point for each time of the line."""
    geopandas = pytest.importorskip("geopandas", reason="geopandas is not installed: pip install '.[geo]'")
    pandas = pytest.importorskip("pandas")
    movingpandas = pytest.importorskip("movingpandas", reason="movingpandas is not installed: pip install movingpandas")
    line = geopandas.read_file(result / "trajectory.geojson").query("kind == 'trajectory'").iloc[0]
    points = geopandas.points_from_xy(*line.geometry.xy, crs=4326)
    moving = geopandas.GeoDataFrame({"t": pandas.to_datetime(line.times, unit="s")}, geometry=points)
    trajectory = movingpandas.Trajectory(moving, traj_id="walk", t="t")
    assert trajectory.get_length() == pytest.approx(28.3, abs=0.5)
    assert trajectory.get_duration().total_seconds() == pytest.approx(27.3, abs=0.2)


def test_the_rate_option_sets_the_rows_per_second(result, tmp_path):
    walk = result.parent / "walk"
    given = ("--map", walk / "plan.geojson", "--fixes", walk / "fixes.csv")
    assert inside("smooth", walk, *given, "--rate", 5, "--out", tmp_path / "five")[0] == 0
    time = read_trajectory(tmp_path / "five" / "trajectory.tum").time
    assert np.median(np.diff(time)) == pytest.approx(0.2, abs=1e-3)
    assert not (tmp_path / "five" / "truth.tum").exists()
