"""Damage the files of a journal, a lifelog and a live session many times, as power cuts do, and count what comes back.

python scripts/power_cuts.py [COUNT] [NAME …]   COUNT: of each kind of damage
"""

import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from power_loss import DAMAGES, FAILED, OUTCOMES, TARGETS, count


def main():
    number = int(sys.argv[1]) if len(sys.argv) > 1 else 250
    wanted, failures = sys.argv[2:], 0
    print(f"{'kind of file':<28}{'damage':<8}" + "".join(f"{name:>20}" for name in OUTCOMES))
    for name, make in TARGETS.items():
        if wanted and name not in wanted:
            continue
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "made").mkdir()
            target = make(Path(folder) / "made")
            for damage in DAMAGES:
                began = time.time()
                outcomes = count(
                    target, damage, number, Path(folder) / "made" / "store", lambda line: print("  " + line)
                )
                row = "".join(f"{outcomes[outcome]:>20}" for outcome in OUTCOMES)
                print(f"{name:<28}{damage:<8}{row}   {time.time() - began:.0f} s", flush=True)
                failures += outcomes[FAILED]
    sys.exit(failures > 0)


if __name__ == "__main__":
    main()
