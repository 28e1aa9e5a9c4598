"""Take part in a competition over the EvAAL API. The same command resumes an interrupted trial (same --out).

python scripts/examples/evaal https://example.org/evaalapi/ mytrial --map maps/mall.geojson --out mytrial
"""

import argparse
import sys
from pathlib import Path
from urllib.parse import quote

from evaal_client import Api
from evaal_trial import run_trial

from pdr_graph import InputError
from pdr_graph.errors import EXIT_DEGRADED, EXIT_REFUSED, printable, shows_progress
from pdr_graph.walk import Options
from pdr_graph.whole_files import check_replaceable


def arguments():
    """The arguments of the command line."""
    parser = argparse.ArgumentParser("evaal", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("url", metavar="URL", help="the server's base URL, which ends in /evaalapi/")
    parser.add_argument("trial", metavar="TRIAL", help="the trial's name")
    parser.add_argument("--map", metavar="PLAN", type=Path, help="a floor plan")
    parser.add_argument("--scale", metavar="METRES", type=float, help="metres per unit of a drawn plan, or per pixel")
    parser.add_argument("--format", choices=("lonlat", "xy"), default="lonlat", help="of positions, with the floor")
    parser.add_argument("--ignore-initial", action="store_true", help="do not start from the trial's initial position")
    parser.add_argument("--beacons", metavar="CSV", type=Path, help="the list of beacons, as of pdr-graph smooth")
    parser.add_argument("--walker", metavar="TOML", type=Path, help="the walker: height, stride model, profile")
    parser.add_argument("--height", metavar="METRES", type=float, help="height of the walker")
    parser.add_argument("--out", metavar="DIR", type=Path, help="output folder; default: evaal-TRIAL")
    parser.add_argument("--force", action="store_true", help="write to --out even if it has other files")
    return parser.parse_args()


def show(text):
    """Print the progress of a trial on one line."""
    print(f"\r{printable(text)} ", end="", file=sys.stderr)


def main():
    """Run a trial; returns the exit code: 0, 2 if an input cannot be used, 3 if something is missing."""
    given = arguments()
    out = given.out or Path(f"evaal-{quote(given.trial, safe='')}")
    options = Options(
        plan=given.map, scale=given.scale, beacons=given.beacons, walker=given.walker, height=given.height
    )
    try:
        check_replaceable(out, "requests.log", given.force)
        api, progress = Api(given.url, given.trial), show if shows_progress() else None
        ending = run_trial(api, out, options, given.format == "lonlat", given.ignore_initial, progress)
    except (InputError, OSError) as error:
        print(f"evaal: {printable(str(error))}", file=sys.stderr)
        return EXIT_REFUSED
    print(printable(f"{ending.text} -> {out}"), file=sys.stdout if ending.normal else sys.stderr)
    for part in () if ending.normal else ending.missing:
        print(printable(f"evaal: without {part}"), file=sys.stderr)
    return 0 if ending.normal else EXIT_DEGRADED


if __name__ == "__main__":
    sys.exit(main())
