"""Make the tables of docs/results/ again, and docs/accuracy.md from them.

    scripts/reproduce [NAME ...] [--quick] [--only WORDS [--walks N] [--development]] [--write | --check]

Without a NAME all are made. --quick: those that take some minutes in all. --check: say which cells differ from the
pages beyond their interval or tolerance (TOLERANCES in scripts/tables.py); exit 1 then. --only: rows of live, integrity
and integrity-live whose name has one of the words (with commas between them), or tables of settings. --walks: simulated
walks of each row. --development: simulated walks for tuning, not those of the published tables.
Real recordings are in ../shared/data or $PDR_GRAPH_DATA; scripts/data.py fetches them.
"""

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass

import accuracy_page
import assumptions
import floors
import gait
import integrity
import lifelog
import live
import paths
import recordings
import routes
import settings
from conditions import DATA
from tables import DIFFERENCES, HELD_BACK, timed


@dataclass(frozen=True)
class Made:
    """How a table is made.

    some: whether ``make`` takes words of rows, number of walks and first seed; quick: True if it takes less than two
    minutes, or a function that makes the part of it which does.
    """

    make: Callable
    some: bool = False
    quick: bool | Callable = False


def quick_settings():
    """The settings that are measured without a plan."""
    settings.settings(DATA, settings.QUICK)


TABLES = {  # in the order of docs/results/index.md
    "microsoft": Made(lambda: recordings.microsoft(DATA), quick=True),
    "recordings": Made(lambda: recordings.every_recording(DATA)),
    "strangers": Made(lambda: recordings.strangers(DATA), quick=True),
    "live": Made(lambda *rows: live.live(DATA, *rows), some=True),
    "integrity": Made(lambda *rows: integrity.integrity(DATA, *rows), some=True),
    "integrity-live": Made(integrity.integrity_live, some=True),
    "paths": Made(lambda *rows: paths.paths(DATA, *rows), some=True),
    "routes": Made(lambda: routes.routes(DATA)),
    "floors": Made(lambda: floors.floors(DATA), quick=True),
    "drift": Made(lambda: assumptions.drift(DATA), quick=True),
    "outliers": Made(lambda: assumptions.outliers(DATA), quick=True),
    "protection": Made(lambda: assumptions.protection(DATA), quick=True),
    "steps": Made(lambda: gait.steps(DATA), quick=True),
    "compass": Made(lambda: gait.compass(DATA), quick=True),
    "lifelog": Made(lifelog.lifelog),
    "settings": Made(lambda words=(), *_: settings.settings(DATA, words), some=True, quick=quick_settings),
}


def busy():
    """Return the processor time so far, that of ended children too [s]."""
    return sum(os.times()[:4])


def main():
    parser = argparse.ArgumentParser(prog="scripts/reproduce", usage=__doc__.split("\n\n")[1].strip())
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(TABLES))
    parser.add_argument("--quick", action="store_true", help=", ".join(n for n, made in TABLES.items() if made.quick))
    parser.add_argument("--only", metavar="WORDS")
    parser.add_argument("--walks", type=int)
    parser.add_argument("--development", action="store_true")
    parser.add_argument("--write", action="store_true", help="into the page, and the time into docs/results/index.md")
    parser.add_argument("--check", action="store_true", help="print the cells that differ from the page; write nothing")
    options = parser.parse_args()
    if unknown := set(options.names) - set(TABLES):
        parser.error(f"no table is named {' or '.join(sorted(unknown))}; there are {', '.join(TABLES)}")
    names = [name for name, made in TABLES.items() if made.quick or not options.quick]
    names = [name for name in names if name in options.names] if options.names else names
    words = [word.strip() for word in (options.only or "").split(",") if word.strip()]
    partial = bool(words or options.walks or options.development)
    if partial and not all(TABLES[name].some for name in names):
        parser.error(f"some rows are only of {', '.join(name for name, made in TABLES.items() if made.some)}")
    if options.check and (partial or options.write):
        parser.error("--check compares whole tables and writes nothing")
    if partial and options.write and names != ["settings"]:
        parser.error("--write needs all rows and the walks of the published table")
    if not DATA.is_dir():
        print(f"no recordings at {DATA}: set PDR_GRAPH_DATA, or fetch them by scripts/data.py", file=sys.stderr)
    for name in names:
        began = busy()
        if partial:
            TABLES[name].make(words, options.walks, 0 if options.development else HELD_BACK)
        elif options.quick and callable(TABLES[name].quick):
            TABLES[name].quick()
        else:
            TABLES[name].make()
            timed("results/index.md", name, busy() - began)
    if options.write:
        accuracy_page.accuracy_page()
    if options.check:
        print("\n".join([*DIFFERENCES, f"{len(DIFFERENCES)} differences in {', '.join(names)}"]))
        sys.exit(bool(DIFFERENCES))


if __name__ == "__main__":
    main()
