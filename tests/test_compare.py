"""``pdr-graph compare``: trajectories, results and methods in one table and one picture."""

import json

import numpy as np
import pytest
import simulated
from commands import run
from test_cli import inside

from pdr_graph import read_trajectory


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """A walk with its result by two methods."""
    folder = simulated.arcade(tmp_path_factory.mktemp("walks") / "walk")
    for method in ("graph", "filter"):
        inside("smooth", folder, *given(folder), "--method", method, "--out", folder.parent / f"by-{method}")
    return folder


def given(walk):
    return ("--map", walk / "plan.geojson", "--fixes", walk / "fixes.csv")


def test_results_and_tum_files_are_scored_as_evaluate_does(walk, tmp_path):
    graph, other = walk.parent / "by-graph", walk.parent / "by-filter" / "trajectory.tum"
    truth = ("--truth", walk / "truth.csv", "--map", walk / "plan.geojson")
    picture = tmp_path / "picture.png"
    code, printed, errors = run("compare", graph, other, *truth, "--out", picture)
    assert (code, errors) == (0, [])
    lines = printed.splitlines()
    assert lines[0].split()[:4] == ["distance", "[m]", "CE50", "[m]"]
    assert [line.split()[0] for line in lines[1:]] == ["by-graph", "trajectory.tum", "against", "->"]
    assert picture.stat().st_size > 10_000
    compared = json.loads(run("compare", graph, other, *truth, "--out", picture, "--json")[1])
    assert compared["reference"] == "truth.csv"
    alone = json.loads(run("evaluate", graph / "trajectory.csv", walk / "truth.csv", *truth[2:], "--json")[1])
    assert {key: compared["scores"]["by-graph"][key] for key in alone} == alone
    assert compared["scores"]["by-graph"]["ce"]["p50"] < compared["scores"]["trajectory.tum"]["ce"]["p50"]
    assert compared["scores"]["trajectory.tum"]["fe"] is None, "TUM has no floors"


def test_methods_are_estimated_and_compared(walk, tmp_path):
    command = ("compare", "graph", "pdr", "--recording", walk, *given(walk), "--truth", walk / "truth.csv", "--json")
    code, printed, errors = run(*command, cwd=tmp_path)
    assert (code, errors) == (0, [])
    scores = json.loads(printed)["scores"]
    assert scores["graph"]["ce"]["p50"] < scores["pdr"]["ce"]["p50"]
    assert [path.name for path in tmp_path.iterdir()] == ["comparison.png"]


def test_without_truth_the_first_is_the_reference(walk, tmp_path):
    code, printed, _ = run("compare", walk.parent / "by-graph", walk.parent / "by-filter", cwd=tmp_path)
    assert code == 0
    assert [line.split()[0] for line in printed.splitlines()[1:]] == ["by-filter", "against", "->"]


def test_equal_names_are_told_apart_by_their_folders(walk, tmp_path):
    files = [walk.parent / f"by-{method}" / "trajectory.csv" for method in ("graph", "filter")]
    scores = json.loads(run("compare", *files, "--truth", walk / "truth.csv", "--json", cwd=tmp_path)[1])["scores"]
    assert list(scores) == ["by-graph/trajectory.csv", "by-filter/trajectory.csv"]


def test_tum_is_read_with_comments_and_headings(tmp_path):
    (tmp_path / "a.tum").write_text(
        "# time x y z qx qy qz qw\n1.0 2.0 3.0 0 0 0 0.7071068 0.7071068\n2 2 4 0 0 0 0 1\n"
    )
    track = read_trajectory(tmp_path / "a.tum")
    assert track.heading == pytest.approx([np.pi / 2, 0])
    (tmp_path / "b.tum").write_text("1 2 3 0 0 0 0 1\n2 2 4 0 0 0 0 1\n")
    assert np.isnan(read_trajectory(tmp_path / "b.tum").heading).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("a.tum",), "a.tum: found one trajectory, expected two or more, or --truth"),
        (("a.tum", "graph"), "graph: found a method of smooth, and no file of that name, expected --recording"),
        (("a.tum", "a.tum"), "the same trajectory twice"),
        (("a.tum", "later.tum"), "later.tum, time: found 7201.000 to 7202.000 (exactly 2 h late: time zone?)"),
        (("a.tum", "empty"), "a folder without trajectory.csv"),
        (("a.tum", "back.tum"), "back.tum, line 2, time: found 1.000000 after 2.000000"),
        (("a.tum", "short.tum"), "short.tum, line 2: found 3 fields"),
    ],
)
def test_bad_input_ends_with_one_line(tmp_path, arguments, message):
    (tmp_path / "empty").mkdir()
    files = {"a": "1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n", "later": "7201 0 0 0 0 0 0 1\n7202 1 0 0 0 0 0 1\n"}
    files |= {"back": "2 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n", "short": "1 0 0 0 0 0 0 1\n2 1 0\n"}
    for name, text in files.items():
        (tmp_path / f"{name}.tum").write_text(text)
    code, _, errors = run("compare", *arguments, cwd=tmp_path)
    assert (code, len(errors)) == (2, 1), errors
    assert message in errors[0]


def test_results_in_different_frames_are_refused(walk, tmp_path):
    """By latitude from the first fix, and in metres of the plan's frame."""
    for name, frame in (("one", {"kind": "enu", "origin_lat": 1.0}), ("two", {"kind": "enu", "origin_lat": 2.0})):
        (tmp_path / name).mkdir()
        (tmp_path / name / "trajectory.csv").write_text("time,x,y\n1,2,3\n2,3,4\n")
        (tmp_path / name / "summary.json").write_text(json.dumps({"frame": frame}))
    code, _, errors = run("compare", "one", "two", cwd=tmp_path)
    assert (code, len(errors)) == (2, 1)
    assert errors[0].startswith("pdr-graph: two, frame: found kind enu, origin_lat 2.0, expected that of one")
