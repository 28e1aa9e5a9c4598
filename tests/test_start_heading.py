"""A start heading by the user, through the command line and live: it decides where nothing else does, and may lie."""

import csv
import json

import numpy as np
import pytest
import simulated
from commands import run
from test_cli import ROUTE

from pdr_graph.geometry import wrap_angle
from pdr_graph.io.loading import load
from pdr_graph.io.tables import read_trajectory
from pdr_graph.online.interface import events_of
from pdr_graph.online.navigator import Navigator


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return simulated.indoor_location(tmp_path_factory.mktemp("walk"), ROUTE[:4], seed=4)


@pytest.fixture(scope="module")
def truth(folder):
    with (folder / "truth.csv").open(newline="") as file:
        return np.array([[float(row[name]) for name in ("time", "x", "y")] for row in csv.DictReader(file)])


@pytest.fixture(scope="module")
def first_direction():
    """Of the route's first leg, in compass degrees from +y."""
    (x, y), (to_x, to_y) = ROUTE[:2]
    return float(np.degrees(np.arctan2(to_x - x, to_y - y)))


def fixes(folder, truth, out, number):
    """True positions at evenly spaced times, of 1 m."""
    rows = truth[np.linspace(0, len(truth) - 1, number).astype(int)] if number > 1 else truth[:1]
    file = out / "given.csv"
    file.write_text("time,x,y,sigma\n" + "".join(f"{t},{x},{y},1.0\n" for t, x, y in rows))
    return file


def result(verb, folder, truth, out, number, heading):
    """Exit code, verdict and mean position error [m] of a walk with so many fixes and a start heading [deg]."""
    given = [] if heading is None else ["--start-heading", str(wrapped(heading))]
    positions, out = fixes(folder, truth, out, number), out / "result"
    code, _, errors = run(verb, folder / "walk.txt", "--fixes", positions, *given, "--no-report", "--out", out)
    assert code in (0, 3), errors
    track = read_trajectory(out / "trajectory.csv")
    at = [np.interp(truth[:, 0], track.time, track.position[:, k]) for k in (0, 1)]
    verdict = json.loads((out / "summary.json").read_text())["verdict"]
    return code, verdict, float(np.mean(np.hypot(at[0] - truth[:, 1], at[1] - truth[:, 2])))


def wrapped(degrees):
    return (degrees + 180) % 360 - 180


@pytest.mark.parametrize("verb", ["smooth", "replay"])
def test_a_start_heading_decides_the_direction_from_one_fix(verb, folder, truth, first_direction, tmp_path):
    """The control: a quarter turn off, nothing contradicts it, and the walk goes there."""
    _, _, error = result(verb, folder, truth, tmp_path, 1, first_direction)
    assert error < 5
    _, _, error = result(verb, folder, truth, tmp_path, 1, first_direction + 90)
    assert error > 5


@pytest.mark.parametrize("verb", ["smooth", "replay"])
@pytest.mark.parametrize("off", [0, 90, 180])
def test_fixes_overrule_a_wrong_start_heading_and_the_verdict_says_so(
    verb, off, folder, truth, first_direction, tmp_path
):
    code, verdict, error = result(verb, folder, truth, tmp_path, 6, first_direction + off)
    assert error < 2
    wrong = any("the start heading is wrong" in reason["text"] for reason in verdict["reasons"])
    assert wrong == (off > 0)
    assert (code == 3) == (off > 0)


def test_a_navigator_takes_a_start_heading_in_radians(folder, first_direction):
    """The current pose goes that way before anything else tells the direction."""
    heading = np.radians(90 - first_direction)
    nav = Navigator(start_heading=heading, start_heading_sigma=0.1)
    for event in events_of(load(folder / "walk.txt")):
        nav.push(event)
        if nav.steps >= 4:
            break
    assert nav.pose is not None
    assert abs(wrap_angle(nav.pose.heading - heading)) < 0.5


@pytest.mark.parametrize("heading", ["nan", "361", "-400"])
def test_a_start_heading_out_of_range_is_refused(heading, folder, tmp_path):
    code, _, errors = run("smooth", folder / "walk.txt", "--start-heading", heading, "--out", tmp_path)
    assert code == 2
    assert "--start-heading" in errors[0]
