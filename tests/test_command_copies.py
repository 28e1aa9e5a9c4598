"""A copied process runs a command as a new interpreter does: the other tests of commands may use it."""

import os
import subprocess
import sys

import commands
import pytest
import simulated

ELSEWHERE = {"PYTHONHASHSEED": "1", "TZ": "Asia/Kathmandu", "LC_ALL": "C", "OMP_NUM_THREADS": "2"}


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    return simulated.arcade(tmp_path_factory.mktemp("walks") / "walk")


@pytest.mark.parametrize("command", ["smooth", "replay"])
def test_both_print_and_write_the_same(walk, tmp_path, monkeypatch, command):
    """The new interpreter with another hash seed, time zone, locale and number of threads."""
    endings = {}
    for new in (False, True):
        folder = tmp_path / str(new)
        folder.mkdir()
        options = ("--map", walk / "plan.geojson", "--fixes", walk / "fixes.csv", "--no-report", "--out", "out")
        if new:
            for name, value in ELSEWHERE.items():
                monkeypatch.setenv(name, value)
        endings[new] = commands.run(command, walk, *options, cwd=folder, new=new)
    assert endings[False] == endings[True]
    assert endings[True].code == 0
    for name in ("trajectory.csv", "figure.png"):
        assert (tmp_path / "False" / "out" / name).read_bytes() == (tmp_path / "True" / "out" / name).read_bytes()


@pytest.mark.parametrize("arguments", [("--version",), ("smoth", "walk.txt"), ("smooth", "nowhere-\udcff.txt"), ()])
def test_both_end_with_the_same_code_and_lines(tmp_path, arguments):
    assert commands.run(*arguments, cwd=tmp_path) == commands.run(*arguments, cwd=tmp_path, new=True)


@pytest.mark.parametrize(
    ("raised", "code", "line"),
    [("1 / 0", 1, "ZeroDivisionError: division by zero"), ("exit(3)", 3, ""), ("exit('no')", 1, "no")],
)
def test_an_exception_is_a_traceback_and_an_exit_code(raised, code, line):
    program = f"import commands, pdr_graph.__main__ as program; program.main = lambda: {raised}; "
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-c", program + "commands.end_as_an_interpreter()"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=60)
    assert (done.returncode, "".join(done.stderr.splitlines()[-1:])) == (code, line)


def test_a_program_of_a_shell_has_its_files_and_its_exit_code(tmp_path):
    path = os.pathsep.join([str(commands.program(tmp_path).parent), os.environ["PATH"]])
    line = "pdr-graph --version | tr a-z A-Z; pdr-graph smooth nowhere 2> errors.txt || echo exit $?"
    environment = os.environ | {"PATH": path}
    done = subprocess.run(["bash", "-c", line], env=environment, cwd=tmp_path, capture_output=True, timeout=60)
    assert done.stdout.splitlines()[0].startswith(b"PDR-GRAPH ")
    assert done.stdout.splitlines()[1] == b"exit 2"
    assert "found no such file" in (tmp_path / "errors.txt").read_text()
