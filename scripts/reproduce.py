"""Make the tables of docs/results/ again, and docs/accuracy.md from them.

    scripts/reproduce [NAME ...] [--quick] [--only WORDS [--walks N] [--development]] [--write | --check [--sample N]]

Without a NAME all are made. --quick: those that take some minutes in all. --check: say which cells differ from the
pages beyond their interval or tolerance (TOLERANCES in scripts/tables.py); exit 1 then. --sample: of N cells that the
commit draws at random, from tables that take minutes or whose rows are made alone. --only: rows of live, integrity and
integrity-live, walks of microsoft and recordings whose name has one of the words (commas between them), or tables of
settings. --walks: simulated walks of each row; of microsoft and recordings, walks of each data set. --development:
simulated walks for tuning, not those of the published tables.
Real recordings are in ../shared/data or $PDR_GRAPH_DATA; scripts/data.py fetches them.
"""

import argparse
import os
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from random import Random

import accuracy_page
import assumptions
import floors
import gait
import integrity
import lifelog
import live
import magnetic
import paths
import radio
import recordings
import routes
import settings
import signs
from conditions import DATA
from tables import (
    DIFFERENCES,
    DOCS,
    HELD_BACK,
    MACHINE,
    NUMBER,
    SAMPLED,
    cells_of,
    commit,
    publish,
    published,
    table,
    timed,
)

from pdr_graph.apps.report.plotting import plot_regions
from pdr_graph.lab.papers import (
    calibration_walk,
    gps_dr,
    heading_experiment,
    map_matching_loop,
    reference_positions,
    stationary_switch,
)
from pdr_graph.lab.papers.map_matching import correct

EXPERIMENTS = {
    "heading": partial(heading_experiment.experiment, data=DATA),
    "gps-dr": partial(gps_dr.experiment, data=DATA),
    "map-matching": map_matching_loop.experiment,
    "calibration-walk": calibration_walk.experiment,
    "reference-positions": reference_positions.experiment,
    "stationary-switch": stationary_switch.experiment,
}


def seeds(quick=False):
    """The experiments of the five papers, published figures beside ours; quick: fewer trials, in five minutes of CPU.

    With --write also docs/regions.png, the regions of (R_d, R_s) of one lap.
    """
    for name, experiment in EXPERIMENTS.items():
        parts = []
        for made in experiment(quick=quick):
            parts += [f"**{made.title}**", table(made.header, made.rows), made.note]
        publish("results/seeds.md", name, "\n\n".join(filter(None, parts)))
    if "--write" in sys.argv:
        lap = map_matching_loop.simulate_lap(HELD_BACK)
        stretches = correct(lap.steps, lap.plan, lap.start, 0.0, 1).stretches
        regions = [(stretch.region.R_d, stretch.region.R_s, stretch.region.feasible) for stretch in stretches]
        plot_regions(regions, [stretch.pair for stretch in stretches]).savefig(DOCS / "regions.png")


@dataclass(frozen=True)
class Made:
    """How a table is made.

    some: whether ``make`` takes words of rows, number of walks and first seed; alone: its table whose rows are chosen
    by their second cell; quick: True if it takes less than two minutes, or a function that makes the part which does.
    """

    make: Callable
    some: bool = False
    alone: str = ""
    quick: bool | Callable = False


def quick_settings():
    """The settings that are measured without a plan."""
    settings.settings(DATA, settings.QUICK)


TABLES = {  # in the order of docs/results/index.md
    "seeds": Made(seeds, quick=partial(seeds, quick=True)),
    "microsoft": Made(lambda *rows: recordings.microsoft(DATA, *rows), some=True),
    "recordings": Made(lambda *rows: recordings.every_recording(DATA, *rows), some=True),
    "live": Made(lambda *rows: live.live(DATA, *rows), some=True, alone="live"),
    "integrity": Made(lambda *rows: integrity.integrity(DATA, *rows), some=True, alone="integrity"),
    "integrity-live": Made(integrity.integrity_live, some=True, alone="integrity live"),
    "paths": Made(lambda *rows: paths.paths(DATA, *rows), some=True),
    "routes": Made(lambda: routes.routes(DATA)),
    "floors": Made(lambda: floors.floors(DATA), quick=True),
    "drift": Made(lambda: assumptions.drift(DATA), quick=True),
    "outliers": Made(lambda: assumptions.outliers(DATA), quick=True),
    "protection": Made(lambda: assumptions.protection(DATA), quick=True),
    "steps": Made(lambda: gait.steps(DATA), quick=True),
    "compass": Made(lambda: gait.compass(DATA), quick=True),
    "magnetic": Made(lambda: magnetic.magnetic(DATA)),
    "radio": Made(lambda: radio.radio(DATA)),
    "signs": Made(lambda: signs.signs(DATA)),
    "lifelog": Made(lifelog.lifelog),
    "settings": Made(lambda words=(), *_: settings.settings(DATA, words), some=True, quick=quick_settings),
}


def sampled(count, names):
    """Some published cells with a number, as table's name and cell; the present commit draws them."""
    cells = []
    for name in names:
        document, made = f"results/{name}.md", TABLES[name]
        markers = (
            re.findall(r"<!-- ([^/].*?) -->", (DOCS / document).read_text()) if made.quick is True else [made.alone]
        )
        for marker in filter(None, markers):
            first = published(document, marker)[0]  # a second one has sums over all rows
            for (row, column), cell in cells_of([first]).items():
                if NUMBER.search(cell) and not row.startswith(cell) and not any(word in column for word in MACHINE):
                    cells.append((name, (document, marker, row, column)))
    return Random(commit()).sample(cells, min(count, len(cells)))


def check_sample(count, names):
    """Make the rows of some cells again, and compare these cells."""
    chosen = sampled(count, names)
    SAMPLED.update(cell for _, cell in chosen)
    for name in dict.fromkeys(name for name, _ in chosen):
        rows = sorted({row for of, (_, _, row, _) in chosen if of == name})
        print(f"{name}: {'; '.join(rows)}", file=sys.stderr)
        if TABLES[name].alone:
            TABLES[name].make([f"={row.split(', ', 1)[1]}" for row in rows], None, HELD_BACK)
        else:
            TABLES[name].make()


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
    parser.add_argument("--sample", type=int, metavar="N", help="with --check: N cells that the commit draws")
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
    if options.sample and (partial or not options.check):
        parser.error("--sample needs --check, and no rows by name")
    if not DATA.is_dir():
        print(f"no recordings at {DATA}: set PDR_GRAPH_DATA, or fetch them by scripts/data.py", file=sys.stderr)
    if options.sample:
        check_sample(options.sample, names)
        names = []
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
        where = f"{options.sample} cells" if options.sample else ", ".join(names)
        print("\n".join([*DIFFERENCES, f"{len(DIFFERENCES)} differences in {where}"]))
        sys.exit(bool(DIFFERENCES))


if __name__ == "__main__":
    main()
