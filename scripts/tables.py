"""Tables of docs/ that scripts make: printed, and with --write put between their markers in the document."""

import re
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent.parent / "docs"


def table(header, rows):
    """A Markdown table."""
    lines = [" | ".join(header), " | ".join("---" for _ in header), *(" | ".join(map(str, row)) for row in rows)]
    return "\n".join(f"| {line} |" for line in lines)


def publish(document, name, text):
    """Print a text; under --write replace what stands between ``<!-- name -->`` and ``<!-- /name -->``."""
    print(text)
    if "--write" in sys.argv:
        path = DOCS / document
        pattern = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
        page, count = pattern.subn(lambda m: f"{m[1]}{text}\n{m[2]}", path.read_text())
        if count != 1:
            raise SystemExit(f"{path}: {count} places for {name}, needed 1")
        path.write_text(page)
