"""Tables of docs/ that scripts make: printed, and with --write put between their markers in the document."""

import re
import sys
from pathlib import Path

HELD_BACK = 100_000  # first seed of the simulated walks of published tables; tune on those from 0 on
DOCS = Path(__file__).resolve().parent.parent / "docs"


def table(header, rows):
    """A Markdown table."""
    lines = [" | ".join(header), " | ".join("---" for _ in header), *(" | ".join(map(str, row)) for row in rows)]
    return "\n".join(f"| {line} |" for line in lines)


def publish(document, name, text):
    """Print a text; under --write replace what stands between ``<!-- name -->`` and ``<!-- /name -->``."""
    print(text)
    if "--write" in sys.argv:
        _replace(DOCS / document, rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", f"{text}\n", name)


def is_wanted(name, words):
    """True if the name of a row has one of the words, or if there are none."""
    return not words or any(word.lower() in name.lower() for word in words)


def published(document, name):
    """The tables between two markers of a document: a list of rows each, a row as a dict from header to cell.

    A second column of the same header has " (2)" behind it, a third one " (3)".
    """
    text = re.search(rf"<!-- {name} -->\n(.*?)<!-- /{name} -->", (DOCS / document).read_text(), re.DOTALL)[1]
    tables = []
    for part in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        header, _, *rows = [[cell.strip() for cell in line.strip()[1:-1].split("|")] for line in part.splitlines()]
        before = [header[:n].count(name) for n, name in enumerate(header)]
        header = [f"{name} ({n + 1})" if n else name for name, n in zip(header, before, strict=True)]
        tables.append([dict(zip(header, row, strict=True)) for row in rows])
    return tables


def timed(document, name, seconds):
    """Say how long ``scripts/reproduce name`` kept a processor busy; under --write in the last cell of its row."""
    said = f"{seconds / 60:.0f} min" if seconds >= 90 else f"{seconds:.0f} s"
    print(f"\n{name}: {said}\n", file=sys.stderr)
    if "--write" in sys.argv:
        _replace(DOCS / document, rf"(\| `{name}` \|[^\n]*\| )[^|\n]*( \|\n)", said, f"the time of {name}")


def _replace(path, pattern, text, name):
    """Put a text between the two groups of a pattern that is in the file once."""
    page, count = re.subn(pattern, lambda m: f"{m[1]}{text}{m[2]}", path.read_text(), flags=re.DOTALL)
    if count != 1:
        raise SystemExit(f"{path}: {count} places for {name}, expected 1")
    path.write_text(page)
