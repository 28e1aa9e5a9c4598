"""docs/accuracy.md and docs/results/ have what the scripts write; README, index and accuracy quote their figures."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
DOCS, SCRIPTS = ROOT / "docs", ROOT / "scripts"
DATA = Path(os.environ.get("PDR_GRAPH_DATA", ROOT.parent / "shared" / "data"))
ACCURACY = (DOCS / "accuracy.md").read_text(encoding="utf-8")
RESULTS = {page.stem: page.read_text(encoding="utf-8") for page in (DOCS / "results").glob("*.md")}
MADE = re.findall(r'^    "([a-z-]+)": Made\(', (SCRIPTS / "reproduce.py").read_text(), re.MULTILINE)
QUICK = ("steps", "compass", "settings")  # five minutes in all, on a core of its own
MADE_AT = r"Made at (or before )?commit [0-9a-f]{7}( \+ changes)?(: .*; the others before)?\."
NO_COMMAND = {"index", "metrics"}
MOST_WORDS = 1500

# Page and sentence: the cells that its figures are, each a document, marker, beginning of the row, column, decimals
MICROSOFT, LIVE, VISITS = ("results/microsoft.md", "microsoft"), ("results/live.md", "live"), "results/lifelog.md"
PERFORMANCE = "performance.md"
LIVE_COLUMNS = ("current pose [m]", "filter [m]", "lag 60 s [m]")
README = {
    "{} % of {} simulated visits are assigned to the right shop": [
        (VISITS, "lifelog-visits", ("all",), column, 0) for column in ("named right", "visits")
    ],
    "a month of 10⁶ steps takes {} s to build": [
        (PERFORMANCE, "lifelog", ("30 days, 1000000 steps, one process",), "", 0)
    ],
    "an hour at 100 Hz with a map takes {} s from file to report, {} s of it for the graph": [
        (PERFORMANCE, "hour", ("**the whole command**",), "CPU [s]", 0),
        (PERFORMANCE, "hour", ("**of which the graph**",), "CPU [s]", 1),
    ],
    "is {} to {} times as fast as a filterpy filter with its smoother": [
        (PERFORMANCE, "rivals", (steps, "filterpy: extended Kalman filter and RTS"), "ratio", 1)
        for steps in ("2000", "7000")
    ],
    "has {} m in the median and {} m at 95 %; a causal filter of the same steps has {} and {} m, "
    "the smoothed walk {} and {} m": [
        (*LIVE, ("Microsoft", "first only, plan"), (column, n), 2) for column in LIVE_COLUMNS for n in (0, 2)
    ],
}
ENGINES = {
    "with 7000 steps an iteration of GTSAM's with Python callbacks takes {} to {} times as long, a search by its "
    "optimiser {} times": [
        (PERFORMANCE, "engines", (what, walk), "ratio", 0)
        for what, walk in (
            ("an iteration, Python callbacks", "7000, every 30 steps"),
            ("an iteration, Python callbacks", "7000, every 2 steps"),
            ("the search by LevenbergMarquardtOptimizer", "7000, every 30 steps"),
        )
    ],
}
LIMITS = {
    "[{} m] over walks of 60 m": [(*MICROSOFT, ("first only", "graph"), "CE50 [m]", 1)],
    "[{} m in the median, {} m at 95 %]; batch {} and {} m": [
        (*LIVE, ("NJU campus", "one in 60 s"), column, decimals)
        for *column, decimals in (
            ("current pose [m]", 0, 1),
            ("current pose [m]", 2, 0),
            ("batch [m]", 0, 1),
            ("batch [m]", 2, 1),
        )
    ],
    "in the middle {} m on the same walks": [(*MICROSOFT, ("first and last", "graph"), "CE50 [m]", 1)],
    "the region holds {} % of the current poses with a start 8 m off": [
        ("results/integrity-live.md", "integrity live", ("indoors", "user fixes, start: 8 m off"), "in 90 % (2)", 0)
    ],
    "{} to {} % of the waypoints of real malls are in the region": [
        (*MICROSOFT, (given, "graph with map"), "in 90 % region", 0) for given in ("first and last", "first only")
    ],
}
QUOTES = {"README.md": README | ENGINES, "docs/index.md": ENGINES, "docs/limits.md": LIMITS}
# Numbers of these pages that are no results: names, versions, definitions and settings of the data
SETTINGS = {
    "README.md": [
        "95 % region",
        "kill -9",
        "Location Competition 2.0",
        "98 phone walks on 14 floors",
        "95 % intervals",
        "Python 3.11, 3.12 or 3.13",
        "Python 3.11 to 3.13",
    ],
    "docs/index.md": ["95 % region", "Python 3.11, 3.12 or 3.13"],
    "docs/accuracy.md": [
        "the 50, 75 and 95 % points, a / b the 50 and 95 % points",
        "98 recordings on 14 floors",
        "95 % intervals",
        "90 %",
        "50 / 95 %",
        "95 % radius",
        "15 minutes",
        "1 Hz",
        '"10 m off"',
        "1650 m",
        "1 m",
        "60 s",
        "48 days of stays",
        "20 of visits",
        "3 × r95",
    ],
}


@pytest.fixture
def scripts(scripts_on_path):
    """The modules that read and write tables."""
    import accuracy_page
    import tables

    return accuracy_page, tables


def test_accuracy_is_one_page():
    """Tables too; a word has a letter or a digit."""
    assert sum(bool(re.search(r"\w", word)) for word in ACCURACY.split()) <= MOST_WORDS


def test_the_tables_of_the_page_are_those_of_the_results(scripts):
    made = {name: (ACCURACY, make) for name, make in scripts[0].TABLES.items()}
    made["walks"] = ((ROOT / "README.md").read_text(encoding="utf-8"), scripts[0].readme)
    for name, (page, make) in made.items():
        assert f"<!-- {name} -->\n{make()}\n<!-- /{name} -->" in page, (
            f"{name}: run python scripts/accuracy_page.py --write"
        )


def test_every_table_has_a_command_and_its_time():
    """In the order in which all are made."""
    listed = re.findall(r"^\| `([a-z0-9-]+)` \|.*\| (.*) \|$", RESULTS["index"], re.MULTILINE)
    assert [name for name, _ in listed] == MADE
    assert all(re.fullmatch(r"\d+ (s|min)", said) for _, said in listed), listed


def test_every_page_of_results_begins_with_its_command():
    assert set(MADE) == set(RESULTS) - NO_COMMAND
    for name in MADE:
        assert RESULTS[name].splitlines()[2].startswith(f"Command: `scripts/reproduce {name} --write`"), name
        assert "<!-- " in RESULTS[name], name


def test_every_script_finds_the_place_of_its_table(scripts):
    """What a script publishes has markers on its page, and every marker a script."""
    published = set()
    for script in SCRIPTS.glob("*.py"):
        text = script.read_text(encoding="utf-8")
        published |= set(re.findall(r'publish\(\s*"results/([\w-]+)\.md",\s*"([^"]+)"', text))
        experiments = re.findall(r'^    "([\w-]+)": .*\w+\.experiment', text, re.MULTILINE)
        published |= {("seeds", name) for name in experiments}
    markers = {(page, name) for page, text in RESULTS.items() for name in re.findall(r"<!-- ([^/].*?) -->", text)}
    assert published == markers
    assert set(scripts[1].LEFT_OUT) <= {name for _, name in published}


def test_every_table_has_its_commit():
    """The last line before its end."""
    for page in MADE:
        for name in re.findall(r"<!-- ([^/].*?) -->", RESULTS[page]):
            assert re.search(rf"\n\n{MADE_AT}\n<!-- /{name} -->", RESULTS[page]), (page, name)


@pytest.mark.parametrize(
    ("old", "new", "column", "same"),
    [
        ("0.83 (0.64–1.00)", "0.99 (0.8–1.2)", "CE50 [m]", True),
        ("0.83 (0.64–1.00)", "1.01 (0.8–1.2)", "CE50 [m]", False),
        ("97 % (94–99)", "93 % (90–96)", "in 90 % region", False),
        ("0.5 / 1.0 / 10.0", "0.6 / 1.1 / 11.0", "error [m]", True),
        ("0.5 / 1.0 / 10.0", "0.5 / 1.0 / 11.1", "error [m]", False),
        ("**83 %**", "87 %", "in 90 % region", True),
        ("83 %", "89 %", "in 90 % region", False),
        ("—", "1.0", "error [m]", False),
        ("3 of 80", "5 of 80", "walks", True),
        ("fails", "+0.1 / +0.1 / +0", "halved", False),
        ("1.2 / 14.6", "9.9 / 99.9", "push and pose, CPU [ms]", True),
    ],
)
def test_a_cell_differs_beyond_its_interval_or_tolerance(scripts, old, new, column, same):
    assert scripts[1].is_same(old, new, column) is same


def test_a_check_names_rows_and_cells_that_differ(scripts):
    """One cell changed, one row gone, one new."""
    document, name = MICROSOFT
    text = "\n\n".join(scripts[1].table(*header_and_rows(rows)) for rows in scripts[1].published(document, name))
    assert scripts[1].differences(document, name, text) == []
    changed = text.replace("| first only | graph with map |", "| first only | magic |")
    changed = re.sub(r"(first and last \| graph \| )[\d.]+", r"\g<1>9.99", changed)
    lines = scripts[1].differences(document, name, changed)
    assert [line.split(":")[0] for line in lines] == [
        "first only, graph with map",
        "first only, magic",
        "first and last, graph, CE50 [m]",
    ]


def test_an_excerpt_lacks_columns_rows_and_titles_with_all_below_them(scripts):
    """And a paragraph is there once."""
    text = "**One**\n\n| a | b |\n| --- | --- |\n| x | 1 |\n| y | 2 |\n\nNote.\n\n**Two**\n\n| a |\n| --- |\n| z |"
    shown = scripts[1].excerpt(f"{text}\n\nLost.\n\n**Three**\n\nNote.", ("b",), "y|Two")
    assert shown == "**One**\n\n| a |\n| --- |\n| x |\n\nNote.\n\n**Three**"


def header_and_rows(rows):
    return list(rows[0]), [list(row.values()) for row in rows]


@pytest.mark.thorough
@pytest.mark.parametrize("name", QUICK)
def test_a_quick_table_is_that_of_its_page(name):
    """Made again from the real recordings, it agrees within its intervals."""
    if not DATA.is_dir():
        pytest.skip(f"no real recordings at {DATA}: set PDR_GRAPH_DATA, get them by scripts/data.py")
    command = [sys.executable, SCRIPTS / "reproduce.py", "--check", "--quick", name]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]


def test_markers_come_in_pairs():
    """Each once, so that a script finds its place."""
    for page, text in (RESULTS | {"accuracy": ACCURACY}).items():
        begun, ended = re.findall(r"<!-- ([^/].*?) -->", text), re.findall(r"<!-- /(.*?) -->", text)
        assert begun == ended, page
        assert len(set(begun)) == len(begun), page


def test_two_scripts_agree_on_the_walks_in_malls(scripts):
    """The summary pools its errors from one case per recording, the other table from all walks at once."""
    pages = ((ROOT / "docs/results" / name).read_text() for name in ("microsoft.md", "recordings.md"))
    if len({re.findall(r"^Made at commit (\w+)", page, re.MULTILINE)[0] for page in pages}) > 1:
        pytest.skip("made at two commits")
    rows = scripts[1].published("results/microsoft.md", "microsoft")[0]
    by_method = {(row["given"], row["method"]): row for row in rows}
    aligned_and_filter = {"PDR, rigidly aligned [m]": "dead reckoning", "filter [m]": "filter (causal)"}
    seen = 0
    for row in scripts[1].published("results/recordings.md", "summary")[0]:
        if row["recordings"] == "malls":
            what = row["given"].removesuffix(", plan")
            plan = "graph with map" if row["given"] != what else "graph"
            for column, method in aligned_and_filter.items():
                other = by_method[what, method]
                assert row[column].split(" / ") == [other[f"CE{p} [m]"].split()[0] for p in (50, 95)], (what, method)
                seen += 1
            for p in (50, 75, 95):
                assert row[f"graph: CE{p} [m]"] == by_method[what, plan][f"CE{p} [m]"], (row["given"], plan)
                seen += 1
    assert seen == 25


def cell_of(tables, document, name, row, column, decimals):
    """A number of a cell, rounded; column: its header, or header and which number."""
    header, nth = (column, 0) if isinstance(column, str) else column
    rows = [r for t in tables.published(document, name) for r in t if header in r]
    found = [r for r in rows if tuple(r.values())[: len(row)] == row]
    assert len(found) == 1, (document, name, row)
    return f"{float(re.findall(r'[0-9][0-9.e+]*', found[0][header])[nth]):.{decimals}f}"


def test_a_quoted_figure_is_that_of_its_table(scripts):
    for page, quotes in QUOTES.items():
        said = {sentence.format(*(cell_of(scripts[1], *source) for source in at)) for sentence, at in quotes.items()}
        assert {sentence for sentence in said if sentence not in prose(page)} == set(), page


@pytest.mark.parametrize("page", SETTINGS)
def test_no_figure_stands_in_prose_without_its_table(page):
    """All numbers of the page are in `QUOTES`, in `SETTINGS` or in a table that a script wrote."""
    text = prose(page)
    sentences = [re.escape(sentence).replace(r"\{\}", r"[\d.]+") for sentence in QUOTES.get(page, ())]
    for pattern in [*sentences, *map(re.escape, SETTINGS[page])]:
        text = re.sub(pattern, "", text)
    assert re.findall(r".{0,40}(?<![\w.])\d.{0,20}", text) == []


def prose(page):
    """A page without the tables of scripts, code, addresses and bold type."""
    text = (ROOT / page).read_text(encoding="utf-8")
    text = re.sub(r"<!-- (.*?) -->\n.*?<!-- /\1 -->", "", text, flags=re.DOTALL)
    text = re.sub(r"^```.*?^```|`[^`\n]*`", "", text, flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"\]\([^)]*\)", "]", text).replace("**", "")
