"""Every table of docs/results/ and docs/simulation.md, and docs/accuracy.md from them.

Real recordings are in ../shared/data or $PDR_GRAPH_DATA.
"""

import os
import sys
from pathlib import Path

import accuracy_page
import calibration_walk
import cart
import compass
import covariance
import drift
import every_recording
import fingerprints
import floors
import gps_outage
import heading
import integrity
import integrity_live
import lifelog_chains
import lifelog_days
import lifelog_diary
import lifelog_visits
import live
import localization
import map_matching
import microsoft
import outliers
import own_fixes
import protection
import realism
import settings
import steps
import tables
import topology
import wide_places

DATA = Path(os.environ.get("PDR_GRAPH_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


def lifelog():
    """The six tables of the lifelog."""
    lifelog_chains.lifelog_chains(DATA)
    lifelog_days.lifelog_days(DATA)
    lifelog_diary.lifelog_diary(DATA)
    lifelog_visits.lifelog_visits()


MADE = {  # in the order of the page
    "recordings": lambda: every_recording.every_recording(DATA),
    "heading": lambda: heading.heading(DATA),
    "gps-outage": gps_outage.gps_outage,
    "map-matching": map_matching.map_matching,
    "wide-places": wide_places.wide_places,
    "calibration-walk": calibration_walk.calibration_walk,
    "cart": cart.cart,
    "microsoft": lambda: microsoft.microsoft(DATA),
    "ipin21": lambda: own_fixes.ipin21(DATA),
    "gnss": lambda: own_fixes.gnss(DATA),
    "lifelog": lifelog,
    "live": lambda: live.live(DATA),
    "covariance": lambda: covariance.covariance(DATA, microsoft.microsoft_walks(DATA)),
    "integrity": lambda: integrity.integrity(DATA),
    "integrity-live": integrity_live.integrity_live,
    "protection": lambda: protection.protection(DATA),
    "outliers": lambda: outliers.outliers(DATA, dict(microsoft.microsoft_walks(DATA))["every second waypoint"]),
    "topology": lambda: topology.topology(DATA),
    "localization": lambda: localization.localization(DATA),
    "fingerprints": lambda: fingerprints.fingerprints(DATA),
    "floors": lambda: floors.floors(DATA),
    "steps": lambda: steps.steps(DATA),
    "compass": lambda: compass.compass(DATA),
    "drift": lambda: drift.drift(DATA),
    "settings": lambda: settings.settings(DATA),
    "simulation": lambda: realism.simulation(DATA),
}


def busy():
    """Processor time so far, that of ended children too [s]."""
    return sum(os.times()[:4])


def main(arguments):
    """Make the tables that are named, or all, and say how much processor time each took."""
    if set(arguments) - set(MADE) - {"all", "--write"}:
        raise SystemExit(f"usage: scripts/reproduce [all | {' | '.join(MADE)}] [--write]")
    for name in [name for name in MADE if name in arguments and "all" not in arguments] or MADE:
        began = busy()
        MADE[name]()
        tables.timed("results/index.md", name, busy() - began)
    accuracy_page.accuracy_page()


if __name__ == "__main__":
    main(sys.argv[1:])
