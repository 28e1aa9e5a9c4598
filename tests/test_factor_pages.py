"""docs/factors.md says what the code does: its constants, its equations' form, its pictures and its example."""

import ast
import re
from importlib import import_module
from pathlib import Path

import gtsam
import numpy as np
import pages
from matplotlib.mathtext import MathTextParser
from walks import steps_of

from pdr_graph import FloorPlan, WalkGraph
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.gait.step_chunks import append_steps, gap, shifted
from pdr_graph.geometry import dead_reckon
from pdr_graph.priors import tables
from pdr_graph.types import Closures, Fixes, Headings, Levels

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "factors.md"
TEXT = PAGE.read_text(encoding="utf-8")
FILES = (ROOT / "pdr_graph").rglob("*.py")  # no two have one name
MODULES = {path.stem: ".".join(path.relative_to(ROOT).with_suffix("").parts) for path in FILES}
LARGEST = 60_000  # [bytes] of a picture


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


def test_pictures_are_shown_and_small():
    shown = set(re.findall(r"!\[[^]]+\]\(factors/([\w-]+)\.png\)", TEXT))
    files = {path.stem: path for path in (ROOT / "docs" / "factors").glob("*.png")}
    assert shown == set(files)
    assert max(path.stat().st_size for path in files.values()) <= LARGEST


def graph_of_every_kind():
    """Thirty steps with a gap and one measurement or two of each kind, in the hall of the arcade."""
    first, then = steps_of(np.full(14, 0.7), np.full(14, 0.02)), steps_of(np.full(16, 0.7), np.full(16, -0.04))
    steps = append_steps(append_steps(first, gap(first.end, first.end + 6)), shifted(then, first.end + 6))
    track = dead_reckon(steps, heading=0.4)
    place = track.position + np.array([8.0, 12.0])
    at = [0, 4, 21, len(track) - 1]
    source, sigma = ("", "GNSS", "GNSS", ""), np.array([1.0, 4.0, 4.0, 1.0])
    fixes = Fixes(track.time[at], place[at], sigma, ("",) * 4, source=source)
    heard = Levels(
        track.time[[8, 26]], np.arange(2), np.full(2, -70.0), ("a", "b"), place[[8, 26]] + 2, np.full(2, 0.5)
    )
    headings = Headings(track.time[[11]], track.heading[[11]], np.array([0.3]))
    closures = Closures.of([(steps.start, steps.end, 5.0)])
    arcade = FloorPlan.load(ROOT / "maps" / "arcade.geojson")
    whole = WalkGraph(steps, fixes, headings=headings, levels=heard, closures=closures, floor=arcade)
    return whole.refined(whole.evaluate(whole.start))


def test_every_kind_of_factor_is_on_the_page():
    """Of a graph that has all that are on by default."""
    whole = graph_of_every_kind().to_gtsam()
    kinds = {type(whole.at(n)).__name__ for n in range(whole.size())}
    assert "CustomFactor" in kinds
    assert len(kinds) >= 3
    assert all(f"`{kind}`" in TEXT for kind in kinds)
    assert all(hasattr(gtsam, kind) for kind in kinds)


def test_the_example_runs_as_printed(tmp_path):
    """And says what the page says that it prints."""
    assert "ends at" in pages.execute(PAGE, tmp_path)
