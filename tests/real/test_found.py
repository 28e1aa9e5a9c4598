"""Faults that strangers met, as small inputs (`found/`, each with its right value): commands as they were typed."""

import json

import pytest
from commands import run

# Folder, file: steps and their tolerance, duration [s], text of the output (a note, or what is missing)
WALKS = {
    "gyroscope-stops/gyro_half.zip": (215, 3, 120, "turns: there is no gyroscope"),
    "no-gyroscope-does-not-converge/ng5.zip": (343, 5, 191, "turns: there is no gyroscope"),
    "sensor-logger-2021/v2.zip": (107, 3, 60, ""),
    "slow-walk/slow20.zip": (20, 2, 24, ""),
    "step-counter-in-milliseconds/wheel.csv": (568, 0, 299, ""),
}
# Positions, exit code, text of the output
IMPORTS = {
    "google-same-minute/same_minute_android.json": (40, 0, ""),
    "gps-week-rollover/two_of_three.gpx": (480, 0, "1024 weeks early"),
    "gpx-that-others-read/leading_newline.gpx": (60, 0, "blank lines"),
    "gpx-that-others-read/unbound_prefix.gpx": (60, 0, "gpxtpx without a declaration"),
    "gzip-in-exports/walk.gpx.gz": (480, 0, ""),
    "stray-position/spike30.rec": (480, 0, ""),
    "times-without-zone/local.gpx": (480, 0, "taken as UTC (--zone)"),
    "xml-cut-off/trunc.gpx": (98, 3, "found an end in the middle"),
}


@pytest.mark.parametrize("file", WALKS)
def test_a_walk_is_counted_right_and_says_what_is_missing(data, tmp_path, file):
    steps, tolerance, duration, said = WALKS[file]
    code, output, errors = run("smooth", data / "found" / file, "--no-report", "--out", tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert code in (0, 3)
    assert summary["steps"] == pytest.approx(steps, abs=tolerance)
    assert summary["duration"] == pytest.approx(duration, abs=1.0)
    assert summary["verdict"]["state"] == "ok"
    assert said in "\n".join([output, *errors])


@pytest.mark.parametrize("file", IMPORTS)
def test_positions_are_imported_and_what_was_done_is_said(data, tmp_path, file):
    count, ends, said = IMPORTS[file]
    code, output, errors = run("lifelog", "import", tmp_path / "d.db", data / "found" / file)
    assert code == ends
    text = "\n".join([output, *errors])
    assert f"{count} new positions, 0 there already, 1 day changed" in text
    assert said in text


@pytest.mark.parametrize("name", ["spike30", "spike300"])
def test_one_stray_position_is_no_ride(data, tmp_path, name):
    """Three stays and two walks of 1.1 km."""
    day = tmp_path / "d.db"
    run("lifelog", "import", day, data / "found" / "stray-position" / f"{name}.rec")
    run("lifelog", "build", day)
    output = run("lifelog", "show", day).output
    assert (output.count("  stay  "), output.count("  walking  ")) == (3, 2)
    assert "walked 2.1 km in 30 min" in output
    assert "rode" not in output


def test_accuracies_of_health_apps_are_read(data, tmp_path):
    """35 m for each position, without a note that none is stated."""
    output = run("smooth", data / "found" / "gpx-accuracy" / "hacc35.gpx", "--no-report", "--out", tmp_path).output
    assert "have no accuracy" not in output
    fixes = json.loads((tmp_path / "summary.json").read_text())["fixes"]
    assert {round(fix["sigma"]) for fix in fixes} == {23}
