"""Make the tables of docs/results/ again, and docs/accuracy.md from them.

    scripts/reproduce [NAME ...] [--only WORDS [--walks N] [--development]] [--write]

Without a NAME all are made. --only: rows of live, integrity and integrity-live whose name has one of the words (with
commas between them), or tables of settings. --walks: simulated walks of each row. --development: simulated walks for
tuning, not those of the published tables. Real recordings are in ../shared/data or $PDR_GRAPH_DATA.
"""

import argparse
import os

import accuracy_page
import gait
import integrity
import lifelog
import live
import recordings
import settings
from conditions import DATA
from tables import HELD_BACK, timed

ROWS = {"live": lambda *rows: live.live(DATA, *rows), "integrity": lambda *rows: integrity.integrity(DATA, *rows)}
ROWS |= {
    "integrity-live": integrity.integrity_live,
    "settings": lambda words, *_: settings.settings(DATA, words or None),
}
MADE = {  # in the order of the page
    "microsoft": lambda: recordings.microsoft(DATA),
    "recordings": lambda: recordings.every_recording(DATA),
    "live": lambda: live.live(DATA),
    "integrity": lambda: integrity.integrity(DATA),
    "integrity-live": lambda: integrity.integrity_live(),
    "steps": lambda: gait.steps(DATA),
    "compass": lambda: gait.compass(DATA),
    "lifelog": lambda: lifelog.lifelog(),
    "settings": lambda: settings.settings(DATA),
}


def busy():
    """Return the processor time so far, that of ended children too [s]."""
    return sum(os.times()[:4])


def main():
    parser = argparse.ArgumentParser(prog="scripts/reproduce", usage=__doc__.split("\n\n")[1].strip())
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(MADE))
    parser.add_argument("--only", metavar="WORDS")
    parser.add_argument("--walks", type=int)
    parser.add_argument("--development", action="store_true")
    parser.add_argument("--write", action="store_true", help="into the page, and the time into docs/results/index.md")
    options = parser.parse_args()
    if unknown := set(options.names) - set(MADE):
        parser.error(f"no table is named {' or '.join(sorted(unknown))}; there are {', '.join(MADE)}")
    words = [word.strip() for word in (options.only or "").split(",") if word.strip()]
    partial = bool(words or options.walks or options.development)
    if partial and (not options.names or not set(options.names) <= set(ROWS)):
        parser.error(f"some rows are only of {', '.join(ROWS)}")
    if partial and options.write and options.names != ["settings"]:
        parser.error("--write needs all rows and the walks of the published table")
    for name in options.names or MADE:
        began = busy()
        if partial:
            ROWS[name](words, options.walks, 0 if options.development else HELD_BACK)
        else:
            MADE[name]()
            timed("results/index.md", name, busy() - began)
    if options.write:
        accuracy_page.accuracy_page()


if __name__ == "__main__":
    main()
