"""``pdr-graph compare``: trajectories, results and methods in one table and one picture."""

import json
from dataclasses import replace
from unittest.mock import patch

import pytest
from commands import run

from pdr_graph.io.loading import load
from pdr_graph.io.tables import read_trajectory


@pytest.fixture(scope="module")
def results(arcade_walk, tmp_path_factory):
    """Results of a walk by two methods."""
    folder = tmp_path_factory.mktemp("results")
    for method in ("graph", "filter"):
        options = ("--method", method, "--no-report", "--out", folder / f"by-{method}")
        run("smooth", arcade_walk, *given(arcade_walk), *options)
    return folder


def given(walk):
    return ("--map", walk / "plan.geojson", "--fixes", walk / "fixes.csv")


def test_results_and_tum_files_are_scored_as_evaluate_does(arcade_walk, results, tmp_path):
    graph, other = results / "by-graph", results / "by-filter" / "trajectory.tum"
    truth = ("--truth", arcade_walk / "truth.csv", "--map", arcade_walk / "plan.geojson")
    picture = tmp_path / "picture.png"
    code, printed, errors = run("compare", graph, other, *truth, "--out", picture)
    assert (code, errors) == (0, [])
    lines = printed.splitlines()
    assert lines[0].split()[:4] == ["distance", "[m]", "CE50", "[m]"]
    assert [line.split()[0] for line in lines[1:]] == ["by-graph", "trajectory.tum", "against", "->"]
    assert picture.stat().st_size > 10_000
    compared = json.loads(run("compare", graph, other, *truth, "--out", picture, "--json")[1])
    assert compared["reference"] == "truth.csv"
    alone = json.loads(run("evaluate", graph / "trajectory.csv", arcade_walk / "truth.csv", *truth[2:], "--json")[1])
    assert {key: compared["scores"]["by-graph"][key] for key in alone} == alone
    assert compared["scores"]["by-graph"]["ce"]["p50"] < compared["scores"]["trajectory.tum"]["ce"]["p50"]
    assert compared["scores"]["trajectory.tum"]["fe"] is None, "TUM has no floors"


def test_methods_are_estimated_and_compared(arcade_walk, tmp_path):
    truth = ("--truth", arcade_walk / "truth.csv", "--json")
    command = ("compare", "graph", "pdr", "--recording", arcade_walk, *given(arcade_walk), *truth)
    code, printed, errors = run(*command, cwd=tmp_path)
    assert (code, errors) == (0, [])
    scores = json.loads(printed)["scores"]
    assert scores["graph"]["ce"]["p50"] < scores["pdr"]["ce"]["p50"]
    assert [path.name for path in tmp_path.iterdir()] == ["comparison.png"]


def test_a_recording_with_its_truth_needs_no_other(arcade_walk, tmp_path):
    """Methods that smooth does not have stand beside ours: particles, live, a function of one's own."""
    walk = replace(load(arcade_walk), truth=read_trajectory(arcade_walk / "truth.csv", load(arcade_walk)))
    (tmp_path / "mine.py").write_text("def ends(evidence):\n    return evidence.walk.truth[[0, -1]]\n")
    methods = ("graph", "live", "particles", "mine:ends")
    with patch("pdr_graph.walk.load", lambda *_: walk):
        command = ("compare", *methods, "--recording", arcade_walk, *given(arcade_walk), "--json")
        code, printed, errors = run(*command, cwd=tmp_path)
    assert (code, errors) == (0, [])
    compared = json.loads(printed)
    assert compared["reference"] == "the recording's truth"
    assert list(compared["scores"]) == list(methods)
    assert compared["scores"]["particles"]["ce"]["p50"] < 1.5
    assert compared["scores"]["graph"]["fe"] == 1.0


def test_without_truth_the_first_is_the_reference(results, tmp_path):
    code, printed, _ = run("compare", results / "by-graph", results / "by-filter", cwd=tmp_path)
    assert code == 0
    assert [line.split()[0] for line in printed.splitlines()[1:]] == ["by-filter", "against", "->"]


def test_equal_names_are_told_apart_by_their_folders(arcade_walk, results, tmp_path):
    files = [results / f"by-{method}" / "trajectory.csv" for method in ("graph", "filter")]
    printed = run("compare", *files, "--truth", arcade_walk / "truth.csv", "--json", cwd=tmp_path).output
    scores = json.loads(printed)["scores"]
    assert list(scores) == ["by-graph/trajectory.csv", "by-filter/trajectory.csv"]
