"""What the documentation says is executed, and leads somewhere."""

import os
import re
import unicodedata
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import commands
import pages
import pytest

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))
FIRST = DOCS / "tutorials" / "first-walk.md"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
FENCED = re.compile(r"^```.*?^```$|`[^`\n]*`", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\(([^)\s]+)\)")
LARGEST = 150_000  # [bytes] of a tutorial's picture


def name(page):
    return str(page.relative_to(ROOT))


@pytest.fixture(scope="module")
def runs(request, tmp_path_factory):
    """Of each tutorial that is tested its folder, and what went wrong in it; as many at once as there are cores.

    The commands of the first one, as of README.md, are the installed program; those of the others are run by copies of
    a process that has imported it.
    """
    tested = [item.callspec.params["page"] for item in request.session.items if "runs" in item.fixturenames]
    folders = {page: tmp_path_factory.mktemp(page.stem) for page in tested}
    programs = commands.program(tmp_path_factory.mktemp("programs")).parent
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        yield {
            page: (folder, pool.submit(pages.execute_apart, page, folder, None if page == FIRST else programs))
            for page, folder in folders.items()
        }


@pytest.mark.parametrize("page", TUTORIALS, ids=name)
def test_a_tutorial_runs_as_printed_and_makes_its_pictures(runs, page):
    folder, wrong = runs[page]
    if wrong.result():
        pytest.fail(wrong.result(), pytrace=False)
    for shown, made in pages.pictures(page):
        assert (folder / made).stat().st_size > 10_000
        assert (page.parent / shown).stat().st_size < LARGEST


def test_a_page_that_says_otherwise_than_it_prints_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("```python\nprint('about', 2.0)\n```\n```text\nabout 3.0\n```\n")
    with pytest.raises(AssertionError, match=r"line 1: says 'about 3.0'"):
        pages.execute(page, tmp_path)
    page.write_text("```sh\necho so; false; true\n```\n")
    with pytest.raises(AssertionError, match="exit 1\nso"):
        pages.execute(page, tmp_path)


@pytest.mark.parametrize(
    ("stated", "line", "alike"),
    [
        ("CE  [m]   p50 0.82 …", "CE  [m]   p50 0.91  p75 1.022", True),
        ("CE  [m]   p50 0.82 …", "CE  [m]   p50 1.21  p75 1.022", False),
        ("2 of 11 fixes", "2 of 12 fixes", True),
        ("2 of 11 fixes", "3 of 11 fixes", False),
        ("no problems found", "problems found", False),
    ],
)
def test_words_are_the_same_and_numbers_about_as_large(stated, line, alike):
    assert pages.alike(stated, line) is alike


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_to_files_and_headings(page):
    """Those of docs/ stay within it, since the site has nothing else."""
    for link in LINK.findall(FENCED.sub("", page.read_text(encoding="utf-8"))):
        if re.match(r"\w+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{name(page)}: {link}"
        assert page.parent == ROOT or target.is_relative_to(DOCS), f"{name(page)}: {link} is not on the site"
        assert not anchor or anchor in anchors(target), f"{name(page)}: {link}"


def test_every_page_is_in_the_navigation():
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:\n")[1]
    assert sorted(re.findall(r"[\w/-]+\.md", nav)) == sorted(str(page.relative_to(DOCS)) for page in PAGES[1:])


def test_the_api_page_has_the_public_names():
    import pdr_graph

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
