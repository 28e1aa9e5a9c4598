"""The file that a replay writes for Rerun, as Rerun's reader has it."""

import sys
from collections import defaultdict

import numpy as np
import pytest
from refusals import refused

from pdr_graph.apps.replay import replay_recording
from pdr_graph.apps.report.rerun_view import RerunView
from pdr_graph.errors import InputError
from pdr_graph.io.tables import read_trajectory
from pdr_graph.types import Fixes
from pdr_graph.walk import Options

rerun = pytest.importorskip("rerun")


def rows(file):
    """Of each entity its rows: time [s], None where it has none, and what was logged, by name."""
    from rerun.chunk import RrdReader

    found = defaultdict(list)
    for chunk in RrdReader(file).stream():
        for row in chunk.to_record_batch().to_pylist():
            time = row.pop("walk", None)
            values = {name.split(":")[-1]: value for name, value in row.items()}
            found[chunk.entity_path].append((None if time is None else time.total_seconds(), values))
    return {name: sorted(each, key=lambda row: row[0] or 0.0) for name, each in found.items()}


@pytest.fixture(scope="module")
def replayed(arcade_walk, tmp_path_factory):
    folder = tmp_path_factory.mktemp("rerun")
    options = Options(plan=arcade_walk / "plan.geojson", fixes=arcade_walk / "fixes.csv")
    replay_recording(arcade_walk, folder / "live", options, report=False, rerun=folder / "walk.rrd")
    return folder, rows(folder / "walk.rrd")


def test_poses_and_path_are_those_of_the_tables(replayed):
    folder, entities = replayed
    causal, smoothed = (read_trajectory(folder / "live" / name) for name in ("causal.csv", "trajectory.csv"))
    time = [time for time, _ in entities["/map/pose"]]
    assert time == pytest.approx(causal.time - causal.time[0] + time[0], abs=1e-3)
    shown = np.array([values["positions"][0][:2] for _, values in entities["/map/pose"]])
    assert shown == pytest.approx(causal.position, abs=2e-3)
    ahead = np.array([values["vectors"][0][:2] for _, values in entities["/map/heading"]])
    assert ahead / 2 == pytest.approx(np.column_stack([np.cos(causal.heading), np.sin(causal.heading)]), abs=1e-3)
    [path] = entities["/map/path"][-1][1]["strips"]
    assert np.array(path)[:, :2] == pytest.approx(smoothed.position, abs=2e-3)


def test_region_modes_fixes_and_plan_are_there(replayed):
    _, entities = replayed
    sigma = np.array([values["scalars"][0] for _, values in entities["/sigma"]])
    widths = [np.ptp(values["strips"][0], axis=0)[:2].max() for _, values in entities["/map/region"]][-len(sigma) :]
    ratio = np.array(widths) / sigma
    assert ((ratio > 4.2) & (ratio < 6.2)).all(), "90 %: 2 √4.6 sigma, of the longer axis up to √2 more"
    assert {len(values["positions"]) for _, values in entities["/map/modes"]} > {0}
    assert len(entities["/map/fix"]) > 1
    assert any(name.startswith("/map/plan") for name in entities)


def test_coordinates_of_a_country_keep_their_centimetres(tmp_path):
    position = np.array([[691_234.56, 5_334_567.89]])
    fixes = Fixes(np.zeros(1), position, np.ones(1), ("",))
    view = RerunView(tmp_path / "far.rrd", None, fixes)
    view._fix(0, "")
    view.close()
    entities = rows(tmp_path / "far.rrd")
    [(_, origin)], [(_, fix)] = entities["/map/origin"], entities["/map/fix"]
    shown = np.add(fix["positions"][0][:2], (origin["x"][0], origin["y"][0]))
    assert shown == pytest.approx(position[0], abs=0.01)


def test_what_is_no_file_of_rerun_is_refused(tmp_path, monkeypatch):
    for file in (tmp_path / "walk.csv", tmp_path / "nowhere" / "walk.rrd"):
        refused(RerunView, file, "a file .rrd in a folder that exists", None, Fixes.none())
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match="rerun"):
        RerunView(tmp_path / "walk.rrd", None, Fixes.none())
