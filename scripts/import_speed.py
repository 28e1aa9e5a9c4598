"""Speed and memory of `pdr-graph lifelog import` on a generated Records.json.

    scripts/import_speed.py [MEGABYTES] [compact]

Years of a person: a position about every two minutes, as Takeout writes them (indented, some with activities).
"""

import json
import resource
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

START = 1_262_304_000  # [s] 2010-01-01


def write_records(path, size, compact=False, seed=0):
    """Write about `size` bytes of positions; returns how many."""
    rng = np.random.default_rng(seed)
    indent = None if compact else 2
    when, lat, lon, number = float(START), 525_000_000, 134_000_000, 0
    with path.open("w", encoding="utf-8") as file:
        file.write('{\n  "locations": [')
        while file.tell() < size:
            block = []
            steps = zip(rng.exponential(60, 1000).tolist(), rng.normal(0, 2000, (1000, 2)).tolist(), strict=True)
            for wait, (north, east) in steps:
                when, lat, lon = when + 1 + wait, lat + int(north), lon + int(east)
                iso = datetime.fromtimestamp(when, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
                row = {"latitudeE7": lat, "longitudeE7": lon, "accuracy": int(5 + wait), "source": "WIFI"}
                if number % 3 == 0:
                    guesses = [{"type": "STILL", "confidence": 90}, {"type": "IN_VEHICLE", "confidence": 5}]
                    row["activity"] = [{"timestamp": iso, "activity": guesses}]
                block.append(json.dumps(row | {"deviceTag": 1184882232, "timestamp": iso}, indent=indent))
                number += 1
            file.write(("" if number == 1000 else ", ") + ", ".join(block))
        file.write("\n  ]\n}\n")
    return number


def main():
    size = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    with tempfile.TemporaryDirectory() as folder:
        file, store = Path(folder, "Records.json"), Path(folder, "past.db")
        number = write_records(file, size * 10**6, "compact" in sys.argv)
        for run in ("first import", "second import"):
            begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
            command = [sys.executable, "-c", "from pdr_graph.apps.cli import main; main()", "lifelog", "import"]
            done = subprocess.run([*command, store, file], capture_output=True, text=True, check=True)
            took = time.perf_counter() - begin
            used = resource.getrusage(resource.RUSAGE_CHILDREN)
            busy = used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime
            mb = file.stat().st_size / 1e6
            print(f"{run}: {mb:.0f} MB, {number} positions, {took:.1f} s, {mb / took:.0f} MB/s")
            print(f"  processor {busy:.1f} s, {mb / busy:.0f} MB/s; peak {used.ru_maxrss / 1e3:.0f} MB")
            print(f"  {done.stdout.strip()}")


if __name__ == "__main__":
    main()
