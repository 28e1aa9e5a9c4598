"""Tables of docs/ that scripts make: printed, and with --write put between their markers in the document."""

import re
import sys
from pathlib import Path

HELD_BACK = 100_000  # first seed of the simulated walks of published tables; tune on those from 0 on
DOCS = Path(__file__).resolve().parent.parent / "docs"
LEFT_OUT = {  # by table, what its page leaves out: columns, and rows that match
    "live": (
        ("places", "within 0.5 rad [s]", "causes", "drawn [m]", "outside", "jitter [m]", "wall [ms]"),
        r"Microsoft \| (every second waypoint|first only) \||IPIN21, eight \| (freq10|Freq1_s_err1m|Freq30|Freq5)"
        r"|IPIN21, eight \| .*, plan|Trial\w+ \| GNSS \||NJU campus \| one in (30|120)|APF|scenario \| (arcade|loop)"
        r"|simulated \| (outdoors, samples|indoors, fixes every 60 s)",
    ),
    "integrity": (
        ("walks", "mean over 3 × r95", "worst place over 3 × r95"),
        r"\w+ \| (GNSS, )?beacons: (one missing|three)|\w+ \| beacons, GNSS: (jump|5 s|frozen|3 times)"
        r"|outdoors \| GNSS: frozen|indoors \| (compass: none|stride)|indoors \| (user fixes|start), plan: a door"
        r"|indoors \| start: 8 m off, user fixes, plan|indoors \| radio map, plan|indoors \| compass: 40° off, user"
        r"|indoors \| beacons, GNSS: 10|indoors \| user fixes, start \||indoors \| start, (end|radio map) \|"
        r"|indoors \| ranges, start: 8 m|indoors \| user fixes, plan: of another|indoors \| GNSS: 10 m off",
    ),
    "integrity recorded": (
        ("mean over 3 × r95", "worst place over 3 × r95"),
        r"Microsoft|IPIN 2023, Trial|IPIN21|NJU campus \| one in (30|120)",
    ),
    "integrity live": (("its radius [m]",), "(?!)"),
    "live compass": (
        ("headings of the first 45 s", "error: largest [deg]", "rms error / sigma", "beyond 2 sigma"),
        "(?!)",
    ),
    "stride by walk": ((), r"site(1/B1 5ddb8a0[367]|1/F1 5dd9efa[589]|1/F1 5dda|1/F2|2)"),
    "lifelog-visits": ((), r"(\d+ \| )?(mall|market) \|"),
}


def table(header, rows):
    """A Markdown table."""
    lines = [" | ".join(header), " | ".join("---" for _ in header), *(" | ".join(map(str, row)) for row in rows)]
    return "\n".join(f"| {line} |" for line in lines)


def publish(document, name, text):
    """Print a text; under --write its excerpt replaces what stands between ``<!-- name -->`` and ``<!-- /name -->``."""
    print(text)
    if "--write" in sys.argv:
        shown = excerpt(text, *LEFT_OUT.get(name, ((), "(?!)")))
        _replace(DOCS / document, rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", f"{shown}\n", name)


def excerpt(text, columns, rows):
    """A text whose tables lack some columns and the rows that match a pattern; a table without rows is left out."""
    parts = []
    for part in text.split("\n\n"):
        if part.startswith("| "):
            header, _, *lines = [line[2:-2].split(" | ") for line in part.splitlines()]
            lines = [line for line in lines if not re.match(rows, " | ".join(line))]
            kept = [n for n, name in enumerate(header) if name not in columns]
            part = table([header[n] for n in kept], [[line[n] for n in kept] for line in lines]) if lines else ""
        parts.append(part)
    return "\n\n".join(filter(None, parts))


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
