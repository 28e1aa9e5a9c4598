"""From a phone's log and a plan of two floors to the floor of every step."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pdr_graph.apps.cli import app
from pdr_graph.apps.report import evaluation
from pdr_graph.floor.plan_files import Building
from pdr_graph.io.tables import read_trajectory

ROOT = Path(__file__).resolve().parents[1]
PLAN = ROOT / "maps" / "two_floors.geojson"


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    folder = tmp_path_factory.mktemp("walk")
    assert CliRunner().invoke(app, ["simulate", "two_floors", "--out", str(folder)]).exit_code == 0
    return folder


def smooth(walk, out, *options):
    return CliRunner().invoke(app, ["smooth", str(walk), "--map", str(PLAN), *options, "--out", str(out)])


def test_up_the_stairs_and_down_in_the_lift(walk, tmp_path):
    """98 % of the time on the right floor, through no wall of either, changes where stairs and lift are."""
    result = smooth(walk, tmp_path, "--floor", "1", "--fixes", str(walk / "fixes.csv"))
    assert result.exit_code == 0, result.output
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["floors"] == ["1", "2", "1"]
    assert [climb["kind"] for climb in summary["climbs"]] == ["stairs", "lift"]
    track, building = read_trajectory(tmp_path / "trajectory.csv"), Building.load(PLAN)
    scores = evaluation.evaluate(track, read_trajectory(walk / "truth.csv"), building)
    assert scores["fe"] > 0.98
    assert scores["ce"]["p50"] < 1.0
    assert scores["oe"] == 0.0
    for row, (before, after) in enumerate(zip(track.floor, track.floor[1:], strict=False), start=1):
        if before != after:
            leading = [c for c in building.connections if building.index(after) in c.floors]
            assert min(connection.distance(track.position[[row]])[0] for connection in leading) < 1.0


def test_a_building_wants_to_know_where_a_walk_with_fixes_begins(walk, tmp_path):
    rows = [line.split(",")[:4] for line in (walk / "fixes.csv").read_text().splitlines()]
    (tmp_path / "fixes.csv").write_text("\n".join(",".join(row) for row in rows) + "\n")
    result = smooth(walk, tmp_path / "out", "--fixes", str(tmp_path / "fixes.csv"))
    assert "found 2 floors, 1, 2, expected --floor" in str(result.exception)


def test_without_fixes_the_floor_is_sought_with_the_place(walk, tmp_path):
    """The barometer climbs one floor: the walk begins on the lower one."""
    assert smooth(walk, tmp_path).exit_code in (0, 3)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["floors"] == ["1", "2", "1"]
    assert summary["routes"]


def test_a_floor_that_the_plan_has_not_is_refused(walk, tmp_path):
    assert "expected a floor 'B3'" in str(smooth(walk, tmp_path, "--floor", "B3").exception)
