"""docs/factors.md says what the code does: its constants, its equations' form, its pictures and its example."""

import ast
import re
import sys
from importlib import import_module
from pathlib import Path

import gtsam
import pages
import pytest
from matplotlib.mathtext import MathTextParser

from pdr_graph.estimation.factors.start import Prior
from pdr_graph.priors import tables

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "factors.md"
TEXT = PAGE.read_text(encoding="utf-8")
FILES = (ROOT / "pdr_graph").rglob("*.py")  # no two have one name
MODULES = {path.stem: ".".join(path.relative_to(ROOT).with_suffix("").parts) for path in FILES}
LARGEST = 60_000  # [bytes] of a picture
QUICK = ("graph", "bridge", "wall", "turn", "beacon", "closure")  # to draw, and of all kinds of code


@pytest.fixture
def pictures(monkeypatch, tmp_path):
    """scripts/factor_pictures.py, drawing into a folder of its own."""
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    yield import_module("factor_pictures")
    for name in ("factor_pictures", "simulations", "recorded", "tables"):
        sys.modules.pop(name, None)


def test_constants_are_the_codes():
    """Each `module.NAME` or `TABLE.name` = value of the page."""
    stated = re.findall(r"`(\w+)\.(\w+)` = (\([^)]*\)|[-\d.]+\d)", TEXT)
    assert len(stated) > 45
    for home, name, value in stated:
        of = tables().get(home) or (Prior() if home == "Prior" else import_module(MODULES[home]))
        found = getattr(of, name)
        found = tuple(found) if isinstance(ast.literal_eval(value), tuple) else found
        assert found == ast.literal_eval(value), f"{home}.{name}: the page says {value}, the code {found}"


def test_equations_are_well_formed():
    """Matplotlib reads them; and nothing in them is eaten by Markdown before KaTeX or MathJax come to see it."""
    displayed = re.findall(r"^\$\$\n(.*?)\n\$\$$", TEXT, re.DOTALL | re.MULTILINE)
    prose = re.sub(r"^(\$\$\n.*?\n\$\$|```.*?```)$", "", TEXT, flags=re.DOTALL | re.MULTILINE)
    inline = re.findall(r"\$([^$\n]+)\$", prose)
    assert len(displayed) > 20
    assert len(inline) > 50
    for equation in displayed + inline:
        assert not re.search(r"\\[\\,;!{}]|\}_|\*|<|>|\n", equation), equation
        MathTextParser("path").parse(f"${equation}$")
    assert all(text == text.strip() for text in inline)


def test_pictures_are_shown_small_and_drawn_by_the_script(pictures):
    shown = set(re.findall(r"!\[[^]]+\]\(factors/([\w-]+)\.png\)", TEXT))
    files = {path.stem: path for path in (ROOT / "docs" / "factors").glob("*.png")}
    assert shown == set(files) == set(pictures.PICTURES)
    assert max(path.stat().st_size for path in files.values()) <= LARGEST


@pytest.mark.parametrize("name", QUICK)
def test_pictures_can_be_drawn(pictures, monkeypatch, tmp_path, name):
    (tmp_path / "maps").symlink_to(ROOT / "maps")
    monkeypatch.setattr(pictures, "OUT", tmp_path / "factors")
    pictures.PICTURES[name]()
    assert 5_000 < (tmp_path / "factors" / f"{name}.png").stat().st_size <= LARGEST


def test_every_kind_of_factor_is_on_the_page(pictures):
    """Of a graph that has all that are on by default."""
    whole = pictures.a_short_walk().to_gtsam()
    kinds = {type(whole.at(n)).__name__ for n in range(whole.size())}
    assert "CustomFactor" in kinds
    assert len(kinds) >= 5
    assert all(f"`{kind}`" in TEXT for kind in kinds)
    assert all(hasattr(gtsam, kind) for kind in kinds)


def test_the_example_runs_as_printed(tmp_path):
    """And says what the page says that it prints."""
    assert "ends at" in pages.execute(PAGE, tmp_path)
