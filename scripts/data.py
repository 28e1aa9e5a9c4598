"""Download the real recordings of others that tests and tables read, and check that each is the expected file.

python scripts/data.py [FOLDER …]     into $PDR_GRAPH_DATA, or ../shared/data; all folders, 260 MB, without names

`data.tsv` lists each file: SHA-256, path here, and repository, commit and path on GitHub.
Files that are there already are checked, not fetched again.
"""

import csv
import hashlib
import os
import sys
import urllib.request
from pathlib import Path
from urllib.parse import quote

ROOT = Path(__file__).resolve().parent
DATA = Path(os.environ.get("PDR_GRAPH_DATA", ROOT.parents[1] / "shared" / "data"))
ADDRESS = "https://raw.githubusercontent.com/{repository}/{commit}/{path}"
LONGEST = 60.0  # [s] without a byte


def fetch(row, target):
    """Download the file of a row of the list. Raises OSError if it cannot be reached or is another file."""
    source = ADDRESS.format(repository=row["source_repository"], commit=row["commit"], path=quote(row["source_path"]))
    with urllib.request.urlopen(source, timeout=LONGEST) as answer:
        content = answer.read()
    if hashlib.sha256(content).hexdigest() != row["sha256"]:
        raise OSError(f"{source}: another file than the list states")
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f"{target.name}.part")
    part.write_bytes(content)
    part.replace(target)


def main(folders):
    """Fetch what is missing, name what cannot be fetched, and exit with 1 then."""
    with (ROOT / "data.tsv").open(encoding="utf-8") as text:
        rows = [
            row for row in csv.DictReader(text, delimiter="\t") if not folders or row["path"].split("/")[0] in folders
        ]
    faults = []
    for row in rows:
        target = DATA / row["path"]
        try:
            if not target.exists():
                fetch(row, target)
            elif hashlib.sha256(target.read_bytes()).hexdigest() != row["sha256"]:
                faults.append(f"{target}: another file than the list states")
        except OSError as fault:
            faults.append(f"{row['path']}: {fault}")
    faults += [] if rows else [f"no folder {' '.join(folders)} in {ROOT / 'data.tsv'}"]
    print(f"{len(rows) - len(faults)} of {len(rows)} files in {DATA}" if rows else "nothing to do")
    sys.exit("\n".join(faults[:10]) or 0)


if __name__ == "__main__":
    main(sys.argv[1:])
