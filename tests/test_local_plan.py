"""A plan without georeference: everything is in metres along its own axes, as it is with a georeferenced one."""

import json
from dataclasses import replace

import drawn_plans
import numpy as np
import pytest
import simulated
from commands import run
from plans import ARCADE
from simulated import ROUTE
from tiers import thorough

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
def plan(tmp_path_factory):
    """The plan of the arcade in metres."""
    path = tmp_path_factory.mktemp("plan") / "local.geojson"
    geojson.write(path, replace(plan_files.read(ARCADE), frame=Frame()))
    return path


@pytest.mark.parametrize(("verb", "farthest"), [("smooth", 0.5), thorough("replay", 4.0)])
def test_a_walk_is_the_same_on_a_plan_in_metres_but_for_the_compass(arcade_walk, plan, tmp_path, verb, farthest):
    tracks = {}
    for path in (ARCADE, plan):
        out = tmp_path / path.stem
        code, _, errors = run(verb, arcade_walk, "--map", path, "--fixes", arcade_walk / "fixes.csv", "--out", out)
        assert code in (0, 3), errors  # 3: doubtful, live and without a compass
        assert (out / "report.html").exists()
        tracks[path.stem] = read_trajectory(out / "trajectory.csv")
    summary = json.loads((tmp_path / "local" / "summary.json").read_text())
    assert summary["frame"]["kind"] == "local"
    assert summary["headings"] == [], "there is no north"
    apart = tracks["local"].position[[0, -1]] - tracks["arcade"].position[[0, -1]]
    assert np.hypot(*apart.T).max() < farthest


def test_recorded_positions_are_left_out_with_a_note(plan, tmp_path):
    write(simulate(simulated.scenario(ROUTE, gnss={}, recorder="phyphox", place=[135.0, 35.0])), tmp_path / "walk")
    inputs = read(tmp_path / "walk", Options(plan=plan))
    assert len(inputs.fixes) == 0
    assert any("fixes inside the recording were left out: no latitude in the plan" in note for note in inputs.notes)


def test_commands_layers_and_lifelogs_take_a_plan_in_metres(arcade_walk, plan, tmp_path):
    assert run("map", "check", plan).code == 0
    assert run("map", "show", plan, "--out", tmp_path / "plan.png").code == 0
    layers = plan_layers(Building.load(plan))
    assert layers["pdr_graph"]["georeferenced"] is False
    assert layers["features"]
    store, options = tmp_path / "days.db", ("--map", plan, "--fixes", arcade_walk / "fixes.csv")
    assert run("lifelog", "add", store, arcade_walk, *options).code == 0
    assert run("lifelog", "build", store).code == 0


@pytest.mark.parametrize("command", ["lifelog add days.db walk", "serve"])
def test_programs_without_a_scale_name_the_conversion(arcade_walk, tmp_path, command):
    (tmp_path / "walk").symlink_to(arcade_walk)
    (tmp_path / "lines.csv").write_text(drawn_plans.csv(drawn_plans.segments(drawn_plans.walls())))
    code, _, errors = run(*command.split(), "--map", "lines.csv", cwd=tmp_path)
    assert code == 2
    assert "pdr-graph map convert" in errors[0]


def test_a_journal_of_another_scale_is_another_walk(tmp_path):
    path = tmp_path / "lines.csv"
    path.write_text("x1,y1,x2,y2\n0,0,1,1\n")
    one, other, none = (plan_files.plan_fingerprint(path, scale) for scale in (0.5, 0.25, None))
    assert len({one, other, none}) == 3
