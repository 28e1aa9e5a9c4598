"""What commands print and where they write: --quiet, --json, --force, --height and --truth."""

import json
import re
import shutil

import numpy as np
import pytest
import simulated
from commands import run
from test_cli import COMMANDS, inside, rows


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    return simulated.arcade(tmp_path_factory.mktemp("walks") / "walk")


def given(walk, *more):
    return (walk, "--map", walk / "plan.geojson", "--fixes", walk / "fixes.csv", *more)


@pytest.mark.parametrize("command", [(), *COMMANDS, ("lifelog",)], ids=" ".join)
def test_h_is_help(command):
    assert inside(*command, "-h") == inside(*command, "--help")


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_is_in_plain_words(command):
    """Arguments by their names, without types of Python; examples on lines of their own."""
    _, said, *_ = inside(*command, "-h")
    assert not re.search(r"\\b|[<\[{](path|str|int|list|Path|RECORDING|STORE)\b", said), said
    assert not re.search(r"pdr-graph .* pdr-graph ", said), "two examples on one line"


@pytest.fixture(scope="module", params=["smooth", "replay"])
def written(walk, request, tmp_path_factory):
    """A command, its output folder and its ending, with the truth and without other options."""
    out = tmp_path_factory.mktemp(request.param) / "out"
    return request.param, out, run(request.param, *given(walk, "--truth", walk / "truth.csv", "--out", out))


def test_the_first_lines_are_verdict_key_figures_and_errors(written):
    _, out, (code, printed, _) = written
    summary = json.loads((out / "summary.json").read_text())
    lines = printed.splitlines()
    sigma = f"median sigma {summary['sigma']:.2f} m per axis"
    expected = f"{summary['steps']} steps, {summary['distance']:.1f} m in {summary['duration']:.1f} s, {sigma}"
    assert (code, lines[0]) == (0, f"ok: {expected}")
    assert "error 50 / 75 / 95 %: " in lines[1]
    assert lines[-1] == f"-> {out / 'report.html'}"
    assert set(summary["scores"]) == {"ce", "he", "eag", "ve", "ca", "oe", "fe", "n", "in_90"}


def test_the_stored_scores_are_those_of_evaluate(walk, written):
    _, out, _ = written
    stored = json.loads((out / "summary.json").read_text())["scores"]
    printed = run("evaluate", out / "trajectory.csv", walk / "truth.csv", "--map", walk / "plan.geojson", "--json")[1]
    scores = json.loads(printed)
    assert stored["ce"] == pytest.approx(scores["ce"], abs=1e-3)
    assert 0.8 < stored["in_90"] <= 1
    assert stored["n"] == scores["n"]


def test_without_truth_or_position_scores_and_sigma_are_null(walk, tmp_path):
    code, printed, _ = run("smooth", walk, "--no-recorded-fixes", "--out", tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (code, summary["scores"], summary["sigma"]) == (0, None, None)
    assert printed.splitlines()[0].endswith("s, no absolute position")


@pytest.mark.parametrize("command", ["smooth", "replay"])
def test_quiet_prints_nothing(walk, tmp_path, command):
    assert run(command, *given(walk, "--out", tmp_path / "out", "--quiet")) == (0, "", [])


def test_quiet_leaves_errors(tmp_path):
    code, printed, errors = run("smooth", "nowhere.zip", "-q", cwd=tmp_path)
    assert (code, printed, len(errors)) == (2, "", 1)


@pytest.mark.parametrize("command", ["smooth", "replay"])
def test_json_prints_the_summary_alone(walk, tmp_path, command):
    code, printed, errors = run(command, *given(walk, "--out", tmp_path / "out", "--json", "--no-report"))
    assert (code, errors) == (0, [])
    assert json.loads(printed) == json.loads((tmp_path / "out" / "summary.json").read_text())


def test_a_silent_command_does_not_silence_the_next(walk, tmp_path):
    """In one process, as programs call it."""
    assert inside("steps", walk, "--out", tmp_path / "a.csv", "--quiet")[1] == ""
    assert "steps," in inside("steps", walk, "--out", tmp_path / "b.csv")[1]


def test_a_folder_of_something_else_is_refused_unless_forced(walk, tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "cat.jpg").write_bytes(b"cat")
    code, _, errors = run("smooth", *given(walk, "--out", photos))
    assert (code, len(errors)) == (2, 1)
    assert "found a folder with 1 other file (cat.jpg)" in errors[0]
    assert errors[0].endswith("(--force writes there anyway)")
    assert [path.name for path in photos.iterdir()] == ["cat.jpg"]
    assert run("smooth", *given(walk, "--out", photos, "--force", "--no-report"))[0] == 0
    assert (photos / "cat.jpg").read_bytes() == b"cat"
    assert run("smooth", *given(walk, "--out", photos, "--no-report"))[0] == 0, "an earlier result is replaced"


def test_inputs_and_folders_may_lie_in_the_output_folder(walk, tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "mine.csv").write_bytes((walk / "fixes.csv").read_bytes())
    journal = ("--journal", tmp_path / "walk.journal")
    given_twice = (walk, "--fixes", tmp_path / "mine.csv", "--no-report")
    assert run("smooth", *given_twice, "--out", tmp_path)[0] == 0
    (tmp_path / "summary.json").unlink()
    for file in tmp_path.glob("[tfrw]*.*"):
        file.unlink()
    assert run("replay", *given_twice, *journal, "--out", tmp_path)[0] in (0, 3)


def test_the_recording_is_no_output_folder(walk):
    code, _, errors = run("smooth", *given(walk, "--out", walk))
    assert (code, "--out: found a folder with" in errors[0]) == (2, True)


def test_a_summary_of_another_program_is_something_else(walk, tmp_path):
    (tmp_path / "summary.json").write_text("{}")
    assert run("smooth", *given(walk, "--out", tmp_path))[0] == 2


def test_a_simulated_folder_may_be_simulated_again(walk, tmp_path):
    assert inside("simulate", "loop", "--out", tmp_path / "loop")[0] == 0
    assert inside("simulate", "loop", "--out", tmp_path / "loop", "--seed", 2)[0] == 0
    (tmp_path / "notes.txt").write_text("mine")
    assert run("simulate", "loop", "--out", tmp_path)[0] == 2


def test_a_taller_walker_takes_longer_steps(walk, tmp_path):
    lengths = {}
    for height in (1.5, 1.9):
        file = tmp_path / f"{height}.csv"
        assert run("steps", walk, "--height", height, "--out", file)[0] == 0
        lengths[height] = sum(float(row["length"]) for row in rows(file))
    assert lengths[1.9] / lengths[1.5] == pytest.approx(1.9 / 1.5, rel=0.02)
    out = tmp_path / "out"
    assert run("smooth", walk, "--height", 1.9, "--no-recorded-fixes", "--no-report", "--out", out)[0] == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["settings"]["walker"]["height"] == 1.9
    assert summary["distance"] == pytest.approx(np.sum(lengths[1.9]), rel=0.02)


def test_the_height_option_comes_before_that_of_the_walkers_file(walk, tmp_path):
    (tmp_path / "walker.toml").write_text("height = 1.50\n")
    out = tmp_path / "out"
    assert (
        run("smooth", walk, "--walker", tmp_path / "walker.toml", "--height", 1.8, "--no-report", "--out", out)[0] == 0
    )
    assert json.loads((out / "summary.json").read_text())["settings"]["walker"]["height"] == 1.8


def test_no_report_writes_everything_but_the_report(walk, written, tmp_path):
    """Of two runs that are otherwise alike; an earlier report does not stay beside a later result."""
    command, with_report, _ = written
    options = ("--truth", walk / "truth.csv", "--no-report", "--out")
    code, printed, _ = run(command, *given(walk, *options, tmp_path / "without"))
    names = {path.name for path in with_report.iterdir()}
    assert "report.html" in names
    assert (code, {path.name for path in (tmp_path / "without").iterdir()}) == (0, names - {"report.html"})
    assert printed.splitlines()[-1] == f"-> {tmp_path / 'without' / 'figure.png'}"
    for name in ("trajectory.csv", "trajectory.tum", "figure.png"):
        assert (with_report / name).read_bytes() == (tmp_path / "without" / name).read_bytes()
    earlier = shutil.copytree(with_report, tmp_path / "earlier")
    assert run(command, *given(walk, *options, earlier))[0] == 0
    assert not (earlier / "report.html").exists()
