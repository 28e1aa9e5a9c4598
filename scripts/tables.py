"""Tables of docs/ that scripts make: printed, with --write put between their markers in the document, or checked."""

import re
import subprocess
import sys
from functools import cache
from itertools import takewhile
from pathlib import Path

HELD_BACK = 100_000  # first seed of the simulated walks of published tables; tune on those from 0 on
DOCS = Path(__file__).resolve().parent.parent / "docs"
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?")
# What --check accepts where a cell has no interval of its own: a share of the page's number, or at least so much
TOLERANCES = {"[m]": (0.1, 0.1), "[deg]": (0.1, 2.0), "%": (0.0, 5.0), " of ": (0.1, 2.0)}
OTHERWISE = (0.1, 0.1)
MACHINE = ("CPU", "wall", "[ms]")  # in the names of columns that depend on the machine; they are not checked
DIFFERENCES = []  # found under --check
SAMPLED = set()  # under --sample: document, table, row and column of the cells that are compared, all others are not
LEFT_OUT = {  # by table, what its page leaves out: columns, and rows or whole tables whose row or title matches
    "microsoft": (
        ("in 50 %", "in 99 %", "energy score [m]", "walks up to 60 % in 90 %", "rows that cross a wall", "places"),
        "(?!)",
    ),
    "places": (("in 50 %", "in 99 %", "energy score [m]", "walks up to 60 % in 90 %"), "(?!)"),
    "summary": (
        ("graph: in 50 %", "graph: in 99 %", "graph: energy score [m]", "graph: walks up to 60 % in 90 %", "places"),
        "(?!)",
    ),
    "out of order": (("places",), "(?!)"),
    "live": (
        ("walks", "places"),
        r"Microsoft \| (every|first only \|)|IPIN21|Trial\w+ \| GNSS \||Trial01|NJU campus \| one in (10|30|120)"
        r"|simulated \| (outdoors, GNSS|indoors, (samples|fixes))",
    ),
    "live behaviour": (
        ("within 0.5 rad [s]", "outside", "jitter [m]"),
        r"Microsoft \| (every second waypoint|first only \||first and last)|IPIN21|Trial(01|52)"
        r"|Trial\w+ \| GNSS \||NJU campus \| one in (10|30|120)|simulated \| (indoors, (fixes|start)|outdoors, GNSS)",
    ),
    "integrity": (
        ("walks", "mean over 3 × r95"),
        r"\w+ \| (GNSS, )?beacons: (one|three|another)|\w+ \| beacons, GNSS|indoors \| GNSS: 10"
        r"|outdoors \| GNSS: (frozen|3 times|jumping)|indoors \| (compass: none|stride|ranges|radio map)"
        r"|indoors \| (user fixes|start), plan: (a door|of an)|indoors \| start: 8 m off, user fixes, plan"
        r"|indoors \| compass: 40° off, user|indoors \| user fixes, start \||indoors \| start, (end|radio map) \|"
        r"|indoors \| (profile(: of somebody else)?, user|start, ranges|gyroscope: drifts by 1.9°/s, user)"
        r"|indoors \| (GNSS, beacons: of another floor|user fixes, plan: 5 m|user fixes, start: 8 m)"
        r"|outdoors \| GNSS and speed: courses|loops \| compass: none",
    ),
    "integrity sharpness": (
        ("50 % region", "99 %", "error, 90 % [m]", "its radius [m]"),
        r"\w+ \| (beacons, GNSS|compass: none|profile|ranges|radio map|user fixes, start|GNSS and speed)"
        r"|indoors \| start, end \|",
    ),
    "integrity network": (
        ("walks", "mean over 3 × r95"),
        r"start, end, network: (zero|half|constant|mirrored|turned by)|honest sources|one source",
    ),
    "integrity recorded": (
        ("mean over 3 × r95",),
        r"Microsoft|IPIN21|NJU campus \| one in (30|120)|IPIN 2023, all \| .*: another",
    ),
    "integrity probability": ((), r"(nothing|a source) lies \| (50|70)"),
    "integrity live": (
        ("walks",),
        r"indoors \| (GNSS, beacons: one moved|GNSS: 10 m off, beacons)|outdoors \| GNSS: 3",
    ),
    "protection": ((), r"Microsoft, [^,|]* \||IPIN21 \||NJU campus, one in (30|60)"),
    "stride": (("spread",), r"lasso|cadence"),
    "live compass": (("with a heading",), r"simulated, (breast|trouser)"),
    "lifelog-visits": ((), r"0\.(05–0\.20|20–0\.40|60–0\.80) "),
    "quiet": ((), r"IPIN21"),
    "carry and pace": (("sprint",), "breast"),
    "floors simulated": ((), r"20 Hz"),
    "carried": (("rms [m]",), "(?!)"),
    "routes": (("a listed route within 5 m",), r"(50|70|90)–"),
    "no position": (("a listed route within 5 m",), "(?!)"),
    "lifelog-recipe": ((), r".*trackintel, silences"),
    "runs": ((), r"jog|walk, jog"),
    "heading": (
        ("– reversed at the end [%]", "– axis"),
        r"– (median|greatest|least|range)|simulated, |paper, ",
    ),
    "gps-dr": (
        ("median [m]", "at the end, median [m]"),
        r"the same, σ|\w+: dead reckoning|\[gps-dr\] Sec\. 4: error within 4 outages",
    ),
    "map-matching": (("least [m] (paper)",), r"Error at 13 points of a lap, the same"),
    "calibration-walk": ((), r"the same, (learnt|T the)|Steps with|Features|Turns at"),
    "reference-positions": (
        ("75 % [m]", "median at the end [m]", "references per walk"),
        r"\+ encounters with a fixed|False encounters",
    ),
    "stationary-switch": (("λ, median [rad/s]",), r"\d+ of these|λ rule, (λ|sample by sample, a)"),
}


def table(header, rows):
    """A Markdown table."""
    lines = [" | ".join(header), " | ".join("---" for _ in header), *(" | ".join(map(str, row)) for row in rows)]
    return "\n".join(f"| {line} |" for line in lines)


def publish(document, name, text, part=""):
    """Print a text, its excerpt under --check or --write.

    --write: it replaces what stands between ``<!-- name -->`` and ``<!-- /name -->``, with the commit on a page of
    results. --check: what differs from there is added to `DIFFERENCES`. part: the rows made now, "" for all.
    """
    shown = excerpt(text, *LEFT_OUT.get(name, ((), "(?!)")))
    if "--check" in sys.argv:
        DIFFERENCES.extend(f"{document}, {name}: {line}" for line in differences(document, name, shown))
        return
    print(text)
    if "--write" in sys.argv:
        which = f": {part}; the others before" if part else ""
        made = f"\n\nMade at commit {commit()}{which}." if document.startswith("results/") else ""
        _replace(DOCS / document, rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", f"{shown}{made}\n", name)


@cache
def commit():
    """The commit of the code that makes the tables, "+ changes" behind it where files of the code differ from it."""
    git = ["git", "-C", str(DOCS.parent)]
    head = subprocess.run([*git, "rev-parse", "--short=7", "HEAD"], capture_output=True, text=True, check=True).stdout
    changed = [*git, "status", "--porcelain", "--untracked-files=no", "pdr_graph", "scripts", "maps"]
    dirty = subprocess.run(changed, capture_output=True, text=True, check=True).stdout
    return head.strip() + " + changes" * bool(dirty)


def differences(document, name, text):
    """Lines that say which cells of a new text differ from the page beyond their interval, or their tolerance."""
    old, new = published(document, name), parsed(text)
    if SAMPLED:
        now = cells_of(new)
        return [
            f"{row}, {column}: {cell} on the page, {now.get((row, column), 'no cell')} now"
            for (row, column), cell in cells_of(old).items()
            if (document, name, row, column) in SAMPLED and not is_same(cell, now.get((row, column), ""), column)
        ]
    if len(old) != len(new):
        return [f"{len(new)} tables instead of {len(old)}"]
    lines = []
    for was, now in zip(map(_by_name, old), map(_by_name, new), strict=True):
        lines += [f"{row}: no longer a row" for row in was if row not in now]
        lines += [f"{row}: a new row" for row in now if row not in was]
        for row, cells in was.items():
            for column, cell in cells.items():
                other = now.get(row, cells).get(column, "no column")
                if not is_same(cell, other, column):
                    lines.append(f"{row}, {column}: {cell} on the page, {other} now")
    return lines


def cells_of(tables):
    """The cells of tables by row and column; in several tables of a text, the first of a name."""
    found = {}
    for rows in tables:
        for row, cells in _by_name(rows).items():
            found = {(row, column): cell for column, cell in cells.items()} | found
    return found


def _by_name(rows):
    """Rows by their first cells, those before the first number; of the same name, in order."""
    named = {}
    for row in rows:
        first, *cells = row.values()
        name = ", ".join([first, *takewhile(lambda cell: re.match(r"[^\d*+;`—-][^;]*$", cell), cells)])
        same = sum(other.partition(" (")[0] == name for other in named)
        named[f"{name} ({same + 1})" if same else name] = row
    return named


def is_same(old, new, column):
    """True if a new cell lies within the interval of the old one, or differs by no more than its tolerance."""
    if any(word in column for word in MACHINE):
        return True
    if interval := re.match(r"\**([\d.]+)( %)? \(([\d.]+)–([\d.]+)\)", old):
        number = NUMBER.search(new)
        return number is not None and float(interval[3]) <= float(number[0]) <= float(interval[4])
    was, now = NUMBER.findall(old), NUMBER.findall(new)
    if NUMBER.sub("", old).replace("*", "") != NUMBER.sub("", new).replace("*", "") or len(was) != len(now):
        return False
    units = (unit for place in (old, column) for unit in TOLERANCES if unit in place)
    share, least = TOLERANCES.get(next(units, ""), OTHERWISE)
    bounds = [max(share * abs(float(a)), least) + 1e-9 for a in was]
    return all(abs(float(a) - float(b)) <= bound for a, b, bound in zip(was, now, bounds, strict=True))


def excerpt(text, columns, rows):
    """A text whose tables lack some columns and the rows that match a pattern.

    A title ``**…**`` that matches is left out with all up to the next title, and so is a table without rows and a
    paragraph that was there before.
    """
    parts, shown = [], True
    for part in text.split("\n\n"):
        if part.startswith("**"):
            shown = not re.match(rows, part[2:])
        if part.startswith("| "):
            header, _, *lines = [line[2:-2].split(" | ") for line in part.splitlines()]
            lines = [line for line in lines if not re.match(rows, " | ".join(line))]
            kept = [n for n, name in enumerate(header) if name not in columns]
            part = table([header[n] for n in kept], [[line[n] for n in kept] for line in lines]) if lines else ""
        if shown and part not in parts:
            parts.append(part)
    return "\n\n".join(filter(None, parts))


def marked(text, missed):
    """A cell; bold where it misses a target."""
    return f"**{text}**" if missed else text


def is_wanted(name, words):
    """True if a row has one of the words in its name, or is one of those that begin with =; without words too."""
    exact = f"={name.partition(': ')[2]}"
    return not words or any(word == exact or word.lower() in name.lower() for word in words)


def published(document, name):
    """The tables between two markers of a document, see `parsed`."""
    return parsed(re.search(rf"<!-- {name} -->\n(.*?)<!-- /{name} -->", (DOCS / document).read_text(), re.DOTALL)[1])


def parsed(text):
    """The tables of a text: a list of rows each, a row as a dict from header to cell.

    A second column of the same header has " (2)" behind it, a third one " (3)".
    """
    tables = []
    for part in re.findall(r"(?:^\|.*\n)+", f"{text}\n", re.MULTILINE):
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
