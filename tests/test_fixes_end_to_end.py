"""Fixes that are missing or lie, through the command line: its exit code, and what the summary says."""

import csv
import json

import numpy as np
import pytest
import simulated
from commands import run
from test_cli import ROUTE


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return simulated.indoor_location(tmp_path_factory.mktemp("walk"), ROUTE, seed=4)


def smoothed(folder, out, rows):
    """Exit code, error lines, and the summary of the walk with these fixes, if there is one."""
    given = out / "given.csv"
    given.write_text("time,x,y,sigma\n" + "".join(f"{t},{x},{y},1.0\n" for t, x, y in rows))
    code, _, errors = run("smooth", folder / "walk.txt", "--fixes", given, "--no-report", "--out", out / "result")
    summary = out / "result" / "summary.json"
    return code, errors, json.loads(summary.read_text()) if summary.exists() else None


def times_of(folder):
    with (folder / "truth.csv").open(newline="") as file:
        time = [float(row["time"]) for row in csv.DictReader(file)]
    return time[0], time[-1]


def test_fixes_that_are_all_wrong_end_degraded(folder, tmp_path):
    begin, end = times_of(folder)
    scattered = np.random.default_rng(0).uniform(-500, 500, (12, 2)).tolist()
    rows = [(t, x, y) for t, (x, y) in zip(np.linspace(begin + 1, end - 1, 12).tolist(), scattered, strict=True)]
    code, errors, summary = smoothed(folder, tmp_path, rows)
    assert code == 3
    assert len(errors) == 1
    assert "a place: the fixes contradict the steps and one another" in errors[0]
    assert summary["missing"] == ["a place: the fixes contradict the steps and one another"]
    assert any("is a guess" in warning for warning in summary["warnings"])
    assert len(summary["fixes"]) == 12
    walked = summary["steps"] * 0.7
    assert summary["distance"] == pytest.approx(walked, rel=0.3), "the walk is the steps', not the fixes'"


def test_fixes_of_another_time_are_refused(folder, tmp_path):
    begin, end = times_of(folder)
    for rows in ([(begin - 60, 0, 0)], [(end + 60, 0, 0), (end + 90, 9, 9)]):
        code, errors, _ = smoothed(folder, tmp_path, rows)
        assert code == 2
        assert "times within the recording" in errors[0]


def test_a_fix_that_is_nan_is_refused_with_its_line(folder, tmp_path):
    begin, _ = times_of(folder)
    code, errors, _ = smoothed(folder, tmp_path, [(begin + 1, 0, 0), (begin + 9, "nan", 3)])
    assert code == 2
    assert "line 3, x: found 'nan'" in errors[0]


def test_fixes_a_thousand_times_a_second_cost_no_more_than_those_of_the_fastest_receiver(folder, tmp_path):
    """Each costs the solver milliseconds; of 20 000 in twenty seconds some hundred are used, and a note says so."""
    begin, _ = times_of(folder)
    rows = [(round(begin + 1 + n / 1000, 3), 0, 0) for n in range(20_000)]
    code, _, summary = smoothed(folder, tmp_path, rows)
    assert code in (0, 3)
    assert any("20000 fixes: more than 25 per second" in warning for warning in summary["warnings"])
    assert 100 < len(summary["fixes"]) < 5000


def test_a_csv_says_which_fixes_one_receiver_made(folder, tmp_path):
    """Those of a source share its error: the region of the walk is wider than of independent ones."""
    begin, end = times_of(folder)
    sigma = {}
    for source in ("", "ublox"):
        given, out = tmp_path / f"given{source}.csv", tmp_path / f"result{source}"
        rows = "".join(f"{t},0,0,4.0,{source}\n" for t in np.arange(begin + 1, end - 1, 1.0).tolist())
        given.write_text("time,x,y,sigma,source\n" + rows)
        run("smooth", folder / "walk.txt", "--fixes", given, "--no-report", "--out", out)
        sigma[source] = json.loads((out / "summary.json").read_text())["sigma"]
    assert sigma["ublox"] > 2 * sigma[""]
