"""What the documentation says is executed, and leads somewhere."""

import os
import re
import tomllib
import unicodedata
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pages
import pytest

import pdr_graph

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
FENCED = re.compile(r"^```.*?^```$|`[^`\n]*`", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\(([^)\s]+)\)")
LARGEST = 150_000  # [bytes] of a tutorial's picture
OTHERS = {
    "obstacleplanarsdffactor",
    "gnclmoptimizer",
    "t_max_diff",
    "acc_x",
    "gyr_x",
    "freq1_s_err5m",
}  # names of other programs


def name(page):
    return str(page.relative_to(ROOT))


@pytest.fixture(scope="module")
def runs(request, tmp_path_factory):
    """Of each tutorial that is tested its folder, and what went wrong in it; as many at once as there are cores."""
    tested = [item.callspec.params["page"] for item in request.session.items if "runs" in item.fixturenames]
    folders = {page: tmp_path_factory.mktemp(page.stem) for page in tested}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        yield {page: (folder, pool.submit(pages.execute_apart, page, folder)) for page, folder in folders.items()}


@pytest.mark.thorough
@pytest.mark.parametrize("page", TUTORIALS, ids=name)
def test_a_tutorial_runs_as_printed_and_makes_its_pictures(runs, page):
    folder, wrong = runs[page]
    if wrong.result():
        pytest.fail(wrong.result(), pytrace=False)
    for _, made in pages.pictures(page):
        assert (folder / made).stat().st_size > 10_000


@pytest.mark.thorough
def test_the_readme_examples_run_as_printed(tmp_path):
    """In an empty folder: what they need they make. tests/test_factor_pages.py has a page that runs in no time."""
    printed = pages.execute(ROOT / "README.md", tmp_path)
    assert (tmp_path / "walk.png").stat().st_size > 20_000
    [median] = re.findall(r"^median error (\d\.\d\d) m$", printed, re.MULTILINE)
    assert 0.3 < float(median) < 1.5
    assert "Pose(" in printed
    verdicts = re.findall(r"^(?:Pose\(.*\) )?(ok|doubtful|failed)\b", printed, re.MULTILINE)
    assert verdicts == ["ok"] * 3  # by the command, in Python and live


def test_the_first_block_of_the_readme_installs_and_the_second_needs_nothing_else():
    """Python versions are those of pyproject.toml; the commands after the installation use no file of the reader's."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    parts = re.split(r"```(?:console|sh)\n(.*?)```", readme, maxsplit=2, flags=re.DOTALL)
    before, install, between, simulated = parts[:4]
    assert "clone" in before
    assert re.findall(r"3\.\d+", before) == re.findall(r"Python :: (3\.\d+)", "\n".join(project["classifiers"]))
    assert project["requires-python"] == ">=" + re.findall(r"3\.\d+", before)[0]
    assert install.splitlines() == ["python3 -m venv .venv", ". .venv/bin/activate", "pip install ."]
    assert "Simulate" in between
    assert simulated.startswith("pdr-graph simulate")


def test_pictures_of_tutorials_are_there_and_small():
    sizes = {page.parent / shown: 0 for page in TUTORIALS for shown, _ in pages.pictures(page)}
    assert len(sizes) > 5
    assert {path for path in sizes if not 0 < path.stat().st_size < LARGEST} == set()


def test_links_lead_to_files_and_headings():
    """Those of docs/ stay within it, since the site has nothing else."""
    assert [wrong for page in PAGES for wrong in broken_links(page)] == []


def broken_links(page):
    """The links of a page that lead nowhere, or from docs/ to what is not on the site."""
    for link in LINK.findall(FENCED.sub("", page.read_text(encoding="utf-8"))):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        on_the_site = page.parent == ROOT or target.is_relative_to(DOCS)
        found = target.exists() and (not anchor or anchor in anchors(target))
        if not re.match(r"\w+:", link) and not (found and on_the_site):
            yield f"{name(page)}: {link}"


def test_every_page_is_in_the_navigation():
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:\n")[1]
    assert sorted(re.findall(r"[\w/-]+\.md", nav)) == sorted(str(page.relative_to(DOCS)) for page in PAGES[1:])


def test_the_api_page_has_the_public_names():
    said = re.findall(r"^::: pdr_graph\.(\w+)$", (DOCS / "api.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(said) == sorted(set(pdr_graph.__all__))


def anchors(page):
    """Of a page's headings, where the site and GitHub agree on them."""
    text = pages.FENCE.sub("", page.read_text(encoding="utf-8"))
    return {slug for heading in re.findall(r"^#+ (.+)$", text, re.MULTILINE) if (slug := anchor(heading))}


def anchor(heading):
    """Lower case, letters, digits and hyphens; empty where GitHub would keep what Python-Markdown drops or joins."""
    plain = re.sub(r"[^\w\s-]", "", heading).strip().lower()
    github = plain.replace(" ", "-")
    site = re.sub(r"[-\s]+", "-", unicodedata.normalize("NFKD", plain).encode("ascii", "ignore").decode())
    return github if github == site else ""


def test_lines_of_code_that_the_reading_page_links_to_define_what_it_names():
    """pdr_graph/README.md: a name in backticks, linked to path#Lnumber."""
    page, wrong = ROOT / "pdr_graph" / "README.md", {}
    links = re.findall(r"\[`(\w+)`\]\(([\w/.]+)#L(\d+)\)", page.read_text(encoding="utf-8"))
    for name, path, line in links:
        code = (page.parent / path).read_text(encoding="utf-8").splitlines()
        defined = [n for n, text in enumerate(code, 1) if re.match(rf"\s*(class|def) {name}\b", text)]
        if int(line) not in defined:
            wrong[name] = f"{path}#L{defined[0] if defined else None}"
    assert len(links) > 30
    assert wrong == {}


def test_names_on_pages_exist():
    """In backticks: the parts of a name are words of code, scripts, tests or plans, and a path leads to a file."""
    kinds = {".py", ".toml", ".js", ".html", ".geojson"}
    paths = [
        path.relative_to(ROOT)
        for folder in ("pdr_graph", "scripts", "tests", "maps")
        for path in (ROOT / folder).rglob("*")
    ]
    texts = ((ROOT / path).read_text(encoding="utf-8") for path in paths if path.suffix in kinds)
    words, files = OTHERS.union(*(re.findall(r"\w+", text.lower()) for text in texts)), [f"/{path}" for path in paths]
    missing = {}
    for page in [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "pdr_graph" / "README.md"]:
        quoted = re.findall(r"`([^`\n]+)`", pages.FENCE.sub("", page.read_text(encoding="utf-8")))
        names = [text for text in quoted if re.fullmatch(r"[A-Za-z_][\w.]*(\(.*\))?", text) and ".py" not in text]
        parts = {part for text in names for part in re.findall(r"\w*[a-z]_\w+|(?<!\w)[A-Z]\w*[a-z][A-Z]\w*", text)}
        there = re.findall(
            r"[\w./-]+\.py\b|\b(?:scripts|maps)/[\w.-]+", " ".join(text for text in quoted if "NAME" not in text)
        )
        missing[name(page)] = [part for part in parts if part.lower() not in words]
        missing[name(page)] += [path for path in there if not any(file.endswith(f"/{path}") for file in files)]
    assert {page: found for page, found in missing.items() if found} == {}
