"""What the reader sees is executed."""

import re
import tomllib
from pathlib import Path

import pages

ROOT = Path(__file__).parent.parent


def test_the_readme_examples_run_as_printed(tmp_path):
    """In an empty folder: what they need they make."""
    said = pages.execute(ROOT / "README.md", tmp_path)
    assert (tmp_path / "walk.png").stat().st_size > 20_000
    median = re.search(r"^median error (\d\.\d\d) m$", said, re.MULTILINE)
    assert median
    assert 0.3 < float(median[1]) < 1.5
    assert "Pose(" in said
    verdicts = re.findall(r"^(?:Pose\(.*\) )?(ok|doubtful|failed)\b", said, re.MULTILINE)
    assert verdicts == ["ok"] * 3  # by the command, in Python and live


def test_the_first_block_installs_into_an_environment_and_the_second_needs_nothing_else():
    """Python versions are those of pyproject.toml; the commands after the installation use no file of the reader's."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    before, install, between, simulated = re.split(r"```(?:console|sh)\n(.*?)```", readme, maxsplit=2, flags=re.DOTALL)[
        :4
    ]
    assert "clone" in before
    assert re.findall(r"3\.\d+", before) == re.findall(r"Python :: (3\.\d+)", "\n".join(project["classifiers"]))
    assert project["requires-python"] == ">=" + re.findall(r"3\.\d+", before)[0]
    assert install.splitlines() == ["python3 -m venv .venv", ". .venv/bin/activate", "pip install ."]
    assert "Simulate" in between
    assert simulated.startswith("pdr-graph simulate")
