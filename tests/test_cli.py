"""What commands print and where they write: help, names, output folders, --quiet, --json, --force and --no-report."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import recorders
from commands import run
from plans import MAPS

import pdr_graph
from pdr_graph import read_trajectory
from pdr_graph.apps.cli import app
from pdr_graph.errors import printable
from pdr_graph.lab.simulation import scenario
from pdr_graph.options import Options

COMMANDS = [("smooth",), ("replay",), ("steps",), ("calibrate",), ("radio-map",), ("evaluate",)]
COMMANDS += [("compare",), ("export",), ("simulate",), ("serve",)]
COMMANDS += [("map", command) for command in ("show", "check", "convert")]
COMMANDS += [("lifelog", command) for command in ("add", "import", "build", "show", "export", "serve")]
COMMANDS += [("bench", command) for command in ("ls", "run", "stats")]
CORRECTIONS = ("was-at", "merge", "split", "was", "not-me", "name", "forget", "list", "undo")
COMMANDS += [("lifelog", "correct", command) for command in CORRECTIONS]


@pytest.mark.parametrize("group", [(), ("map",), ("lifelog",), ("lifelog", "correct"), ("bench",)], ids=" ".join)
def test_the_help_of_a_group_lists_its_commands_whole(group):
    """No line of the list is cut off."""
    code, printed, _ = run(*group, "--help")
    listed = printed.split("Commands:")[1]
    assert code == 0
    assert "..." not in listed
    inside = {command[len(group)] for command in COMMANDS if command[: len(group)] == group}
    assert [name for name in inside if f"\n  {name} " not in listed] == []


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_the_help_of_a_command_is_in_plain_words_with_an_example(command):
    """Arguments by their names, without types of Python; examples on lines of their own, with existing options only."""
    code, printed, _ = run(*command, "--help")
    assert (code, printed) == run(*command, "-h")[:2]
    assert code == 0
    about, _, options = printed.partition("\nOptions:\n")
    examples = [line.split() for line in about.splitlines() if line.startswith(f"  pdr-graph {' '.join(command)} ")]
    assert examples
    assert all(f"  {word} " in options for example in examples for word in example if word.startswith("--"))
    assert not re.search(r"\\b|[<\[{](path|str|int|list|Path|RECORDING|STORE)\b", printed)
    assert not re.search(r"pdr-graph .* pdr-graph ", printed), "two examples on one line"
    sections = printed.split("\nArguments:\n")[-1] if "\nArguments:\n" in printed else options
    rows = re.findall(r"^  \S.*(?:\n {5,}.*)*", sections, re.MULTILINE)
    assert [row for row in rows if not re.search(r"\S(?: {2,}|\n +)\S", row)] == [], "without help"


def test_options_stand_anywhere_and_the_last_one_counts():
    words = ["a.db", "walks", "--map", "x.json", "more", "--map=y.json", "--walker", "w.toml", "--", "-1 h.zip"]
    _, given, _ = app.parse_args(["lifelog", "add", *words], exit_on_error=False, print_error=False)
    assert given.args == (Path("a.db"), Path("walks"), Path("more"), Path("-1 h.zip"))
    assert given.kwargs == {"options": Options(plan=Path("y.json"), walker=Path("w.toml"))}


def test_completion_of_bash_knows_the_commands_and_options(tmp_path, monkeypatch):
    """By bash itself: the words that it offers after the beginning of one."""
    monkeypatch.setenv("HOME", str(tmp_path))
    code, output, _ = run("--install-completion", "--shell", "bash", new=True)
    [script] = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert (code, str(script) in output) == (0, True)

    def offered(*words):
        line = f"COMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}; _pdr_graph; echo ${{COMPREPLY[@]}}"
        command = ["bash", "-c", f"source {script}; {line}"]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()

    assert offered("pdr-graph", "smo") == ["smooth"]
    assert "--radio-map" in offered("pdr-graph", "smooth", "walk.zip", "--rad")


def test_a_group_without_a_command_prints_its_help_as_an_error():
    code, printed, errors = run("map")
    assert (code, printed) == (2, "")
    assert "\n".join(errors) == run("map", "--help").output.strip()


def test_version_prints_the_version():
    assert run("--version") == (0, f"pdr-graph {pdr_graph.__version__}\n", [])


def test_ready_scenarios_are_simulated_by_name_and_again(tmp_path):
    """``simulate --help`` lists exactly those that exist; another program's folder is left alone."""
    named = run("simulate", "--help").output.split("Ready scenarios:")[1].split(".")[0].split()
    assert tuple(named) == scenario.names()
    assert run("simulate", "office", cwd=tmp_path).code == 0
    assert (tmp_path / "office" / "plan.geojson").read_bytes() == (MAPS / "office.geojson").read_bytes()
    assert run("simulate", "office", "--seed", 2, cwd=tmp_path).code == 0
    (tmp_path / "notes.txt").write_text("mine")
    assert run("simulate", "loop", "--out", ".", cwd=tmp_path).code == 2


def given(walk, *more):
    return (walk, "--map", walk / "plan.geojson", "--fixes", walk / "fixes.csv", *more)


@pytest.fixture(scope="module", params=["smooth", "replay"])
def written(arcade_walk, request, tmp_path_factory):
    """A command, its output folder and its ending, with the truth and without other options."""
    out = tmp_path_factory.mktemp(request.param) / "out"
    ending = run(request.param, *given(arcade_walk, "--truth", arcade_walk / "truth.csv", "--out", out))
    return request.param, out, ending


def test_the_first_lines_are_verdict_key_figures_and_errors(written):
    _, out, (code, printed, errors) = written
    summary = json.loads((out / "summary.json").read_text())
    lines = printed.splitlines()
    sigma = f"median sigma {summary['sigma']:.2f} m per axis"
    expected = f"{summary['steps']} steps, {summary['distance']:.1f} m in {summary['duration']:.1f} s, {sigma}"
    assert (code, errors, lines[0]) == (0, [], f"ok: {expected}")
    assert "error 50 / 75 / 95 %: " in lines[1]
    assert lines[-1] == f"-> {out / 'report.html'}"
    assert set(summary["scores"]) == {"ce", "he", "eag", "ve", "ca", "oe", "fe", "n", "in_90"}


def test_the_stored_scores_are_those_of_evaluate(arcade_walk, written):
    _, out, _ = written
    stored = json.loads((out / "summary.json").read_text())["scores"]
    truth = (arcade_walk / "truth.csv", "--map", arcade_walk / "plan.geojson")
    scores = json.loads(run("evaluate", out / "trajectory.csv", *truth, "--json").output)
    assert stored["ce"] == pytest.approx(scores["ce"], abs=1e-3)
    assert 0.8 < stored["in_90"] <= 1
    assert stored["n"] == scores["n"]
    assert np.isfinite(read_trajectory(out / "truth.tum").heading).all()


def test_truth_is_scored_and_not_used_and_no_report_writes_the_rest(arcade_walk, written, tmp_path):
    """Into a copy of the earlier result, in which the earlier report does not stay."""
    command, earlier, _ = written
    assert "Accuracy against ground truth" in (earlier / "report.html").read_text(encoding="utf-8")
    out = shutil.copytree(earlier, tmp_path / "out")
    code, printed, _ = run(command, *given(arcade_walk, "--no-report", "--out", out))
    assert (code, printed.splitlines()[-1]) == (0, f"-> {out / 'figure.png'}")
    names = {path.name for path in earlier.iterdir()}
    assert {path.name for path in out.iterdir()} == names - {"report.html"}
    for name in ("trajectory.csv", "trajectory.tum", "trajectory.gpx"):
        assert (out / name).read_bytes() == (earlier / name).read_bytes()


@pytest.mark.parametrize("command", ["smooth", "replay"])
def test_json_prints_the_summary_alone(arcade_walk, tmp_path, command):
    code, printed, errors = run(command, *given(arcade_walk, "--out", tmp_path, "--json", "--no-report", "--force"))
    assert (code, errors) == (0, [])
    assert json.loads(printed) == json.loads((tmp_path / "summary.json").read_text())


def test_quiet_prints_nothing_but_errors_and_does_not_silence_the_next_command(arcade_walk, tmp_path):
    assert run("smooth", *given(arcade_walk, "--out", tmp_path / "a", "--quiet", "--no-report")) == (0, "", [])
    code, printed, errors = run("smooth", "nowhere.zip", "-q", cwd=tmp_path)
    assert (code, printed, len(errors)) == (2, "", 1)
    assert run("steps", arcade_walk, "--out", tmp_path / "a.csv", "--quiet").output == ""
    assert "steps," in run("steps", arcade_walk, "--out", tmp_path / "b.csv").output


def test_a_folder_of_something_else_is_refused_unless_forced(arcade_walk, tmp_path):
    """A summary.json of another program is something else too; an earlier result is replaced, hidden files are none."""
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "cat.jpg").write_bytes(b"cat")
    (photos / ".DS_Store").touch()
    code, _, errors = run("smooth", *given(arcade_walk, "--out", photos))
    assert (code, len(errors)) == (2, 1)
    assert "found a folder with 1 other file (cat.jpg)" in errors[0]
    assert errors[0].endswith("(--force writes there anyway)")
    assert {path.name for path in photos.iterdir()} == {"cat.jpg", ".DS_Store"}
    assert run("smooth", *given(arcade_walk, "--out", photos, "--force", "--no-report")).code == 0
    assert (photos / "cat.jpg").read_bytes() == b"cat"
    assert run("smooth", *given(arcade_walk, "--out", photos, "--no-report")).code == 0
    (tmp_path / "summary.json").write_text("{}")
    assert run("smooth", *given(arcade_walk, "--out", tmp_path)).code == 2


def test_inputs_and_folders_may_lie_in_the_output_folder(arcade_walk, tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "mine.csv").write_bytes((arcade_walk / "fixes.csv").read_bytes())
    journal = ("--journal", tmp_path / "walk.journal")
    options = ("--fixes", tmp_path / "mine.csv", *journal, "--no-report", "--out", tmp_path)
    assert run("replay", arcade_walk, *options).code in (0, 3)
    assert (tmp_path / "mine.csv").exists()


HOSTILE = ("walk-\udcff", "walk\x1b[31mred\a", "$\\frac", "two\nlines")  # not UTF-8; what terminals, TeX, lines obey


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("command", ["smooth", pytest.param("replay", marks=pytest.mark.thorough)])
def test_a_name_of_any_bytes_is_data_and_no_command(tmp_path, command, name):
    """Every result is written, the summary has the exact name, and the terminal gets one printable line for each."""
    (tmp_path / name).write_text(recorders.gpx(recorders.sample()))
    code, out, err = run(command, name, cwd=tmp_path)
    assert (code, err) == (0, [])
    assert all(line.isprintable() for line in out.splitlines())
    [result] = (path for path in tmp_path.iterdir() if path.is_dir())
    assert out.splitlines()[-1] == f"-> {printable(str(result.relative_to(tmp_path)))}/report.html"
    assert {"figure.png", "report.html", "trajectory.csv"} <= {path.name for path in result.iterdir()}
    assert json.loads((result / "summary.json").read_text())["recording"].startswith(name)
