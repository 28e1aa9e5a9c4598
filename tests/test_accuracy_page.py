"""docs/accuracy.md says what scripts/reproduce writes, and its own prose says the same."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "accuracy.md").read_text()
MADE = re.findall(r'^    "([a-z0-9-]+)": ', (ROOT / "scripts" / "reproduce.py").read_text(), re.MULTILINE)


def cells(line):
    return [cell.strip() for cell in line.strip("|\n").split(" | ")]


def block(name):
    """The rows between two markers, but for the header."""
    (text,) = re.findall(rf"<!-- {name} -->\n(.*?)<!-- /{name} -->", PAGE, re.DOTALL)
    return [cells(line) for line in text.splitlines() if line.startswith("| ")][2:]


def slug(title):
    """The anchor of a heading, as GitHub and Markdown make it."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def sections():
    """Anchor to text of each section, with all below it."""
    heads = [(m.start(), len(m[1]), m[2]) for m in re.finditer(r"^(#+) (.*)$", PAGE, re.MULTILINE)]
    for start, depth, title in heads:
        ends = [at for at, other, _ in heads if at > start and other <= depth]
        yield slug(title), PAGE[start : min(ends, default=len(PAGE))]


def test_every_table_has_a_command_and_its_time():
    """In the order in which ``all`` makes them."""
    listed = re.findall(r"^\| `([a-z0-9-]+)` \|.*\| (.*) \|$", PAGE, re.MULTILINE)
    assert [name for name, _ in listed] == MADE
    assert all(re.fullmatch(r"\d+ (s|min)", said) for _, said in listed), listed


def test_every_command_of_the_page_exists():
    """And every section that has tables names one, itself or where it begins."""
    named = re.findall(r"scripts/reproduce ([a-z0-9-]+)", PAGE)
    assert set(named) <= {*MADE, "all"}
    assert set(named) >= {*MADE} - {"simulation"}


def test_markers_come_in_pairs():
    """Each once, so that a script finds its place."""
    begun, ended = re.findall(r"<!-- ([^/].*?) -->", PAGE), re.findall(r"<!-- /(.*?) -->", PAGE)
    assert begun == ended
    assert len(set(begun)) == len(begun)


def test_links_within_the_page_lead_somewhere():
    """Also those of the index of papers."""
    assert set(re.findall(r"\]\(#(.*?)\)", PAGE)) <= {anchor for anchor, _ in sections()}


def test_two_scripts_agree_on_microsofts_walks():
    """The summary pools its errors from one case per recording, the other table from all walks at once."""
    by_method = {(given, method): [cell.split()[0] for cell in rest[:3]] for given, method, *rest in block("microsoft")}
    seen = 0
    for recordings, given, laid, causal, _, graph, _ in block("summary"):
        if recordings.startswith("Microsoft, 15"):
            help_ = given.removesuffix(", plan")
            plan = "graph with map" if given != help_ else "graph"
            for cell, method in ((laid, "dead reckoning"), (causal, "filter (causal)"), (graph, plan)):
                assert cell.split(" / ") == by_method[help_, method][::2], (given, method)
                seen += 1
    assert seen == 15


@pytest.mark.parametrize("row", [line for line in dict(sections())["the-five-papers"].splitlines() if "](#" in line])
def test_figures_of_the_papers_stand_in_their_sections(row):
    """Published or ours, whatever has a decimal."""
    _, _, published, ours, _, link = cells(row)
    section = dict(sections())[re.findall(r"\(#(.*?)\)", link)[0]]
    for figure in re.findall(r"\d+\.\d+", f"{published} {ours}"):
        assert re.search(rf"(?<![\d.]){re.escape(figure)}(?!\d)", section), (figure, row)
