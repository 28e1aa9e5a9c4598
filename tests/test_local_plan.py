"""A plan without georeference: everything is in metres along its own axes, as it is with a georeferenced one."""

import json
from dataclasses import replace
from pathlib import Path

import drawn_plans
import numpy as np
import pytest
import simulated
from plans import ARCADE
from simulated import ROUTE
from typer.testing import CliRunner

from pdr_graph.apps.cli import app
from pdr_graph.apps.serve.publishing import plan_layers
from pdr_graph.floor import plan_files
from pdr_graph.floor.formats import geojson
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import Frame
from pdr_graph.io.tables import read_trajectory
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.walk import Options, read


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A walk, its fixes, and its plan in metres."""
    folder = simulated.arcade(tmp_path_factory.mktemp("walk"), recorder="indoor_location")
    geojson.write(folder / "local.geojson", replace(plan_files.read(ARCADE), frame=Frame()))
    return folder


def run(*arguments):
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done


@pytest.mark.parametrize(("verb", "farthest"), [("smooth", 0.5), ("replay", 4.0)])
def test_a_walk_is_the_same_on_a_plan_in_metres_but_for_the_compass(folder, tmp_path, verb, farthest):
    tracks = {}
    for plan in (ARCADE, folder / "local.geojson"):
        out = tmp_path / plan.stem
        done = run(verb, folder / "walk.txt", "--map", plan, "--fixes", folder / "fixes.csv", "--out", out)
        assert done.exit_code in (0, 3), done.output  # 3: doubtful, live and without a compass
        assert (out / "report.html").exists()
        tracks[plan.stem] = read_trajectory(out / "trajectory.csv")
    summary = json.loads((tmp_path / "local" / "summary.json").read_text())
    assert summary["frame"]["kind"] == "local"
    assert summary["headings"] == [], "there is no north"
    apart = tracks["local"].position[[0, -1]] - tracks["arcade"].position[[0, -1]]
    assert np.hypot(*apart.T).max() < farthest


def test_recorded_positions_are_left_out_with_a_note(tmp_path):
    write(simulate(simulated.scenario(ROUTE, gnss={}, recorder="phyphox", place=[135.0, 35.0])), tmp_path / "walk")
    geojson.write(tmp_path / "local.geojson", replace(plan_files.read(ARCADE), frame=Frame()))
    inputs = read(tmp_path / "walk", Options(plan=tmp_path / "local.geojson"))
    assert len(inputs.fixes) == 0
    assert any("fixes inside the recording were left out: no latitude in the plan" in note for note in inputs.notes)


def test_commands_and_layers_take_a_plan_in_metres(folder, tmp_path):
    plan = folder / "local.geojson"
    assert run("map", "check", plan).exit_code == 0
    assert run("map", "show", plan, "--out", tmp_path / "plan.png").exit_code == 0
    layers = plan_layers(Building.load(plan))
    assert layers["pdr_graph"]["georeferenced"] is False
    assert layers["features"]


def test_a_lifelog_keeps_such_a_walk_without_a_place_on_earth(folder, tmp_path):
    store = tmp_path / "days.db"
    options = ("--map", folder / "local.geojson", "--fixes", folder / "fixes.csv")
    assert run("lifelog", "add", store, folder / "walk.txt", *options).exit_code == 0
    assert run("lifelog", "build", store).exit_code == 0


@pytest.mark.parametrize("command", [("lifelog", "add"), ("serve",)])
def test_programs_without_a_scale_name_the_conversion(folder, tmp_path, command):
    lines = tmp_path / "lines.csv"
    lines.write_text(drawn_plans.csv(drawn_plans.segments(drawn_plans.walls())))
    target = [tmp_path / "days.db", folder / "walk.txt"] if command == ("lifelog", "add") else []
    done = CliRunner().invoke(app, [*command, *map(str, target), "--map", str(lines)])
    assert "pdr-graph map convert" in f"{done.output} {done.exception}"


def test_a_journal_of_another_scale_is_another_walk(tmp_path):
    path = Path(tmp_path / "lines.csv")
    path.write_text("x1,y1,x2,y2\n0,0,1,1\n")
    one, other, none = (plan_files.plan_fingerprint(path, scale) for scale in (0.5, 0.25, None))
    assert len({one, other, none}) == 3
