"""Which rows of the tables of integrity are made, and of which walks: their command line."""

import argparse
import sys
import time

DEVELOPMENT, HELD_BACK = 0, 100_000  # first seed; tuning is done on the former alone


def is_wanted(name, wanted):
    """Whether a row is wanted: its name has one of some words, or there are none."""
    return not wanted or any(word.lower() in name.lower() for word in wanted)


def make_rows(make, arguments, description, walks):
    """Make some rows quickly. make: called with words, walks and first seed; walks: how many by default, as text."""
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("rows", nargs="*", help="words in the names of rows")
    parser.add_argument("--walks", type=int, help=walks)
    parser.add_argument("--held-back", action="store_true", help="not the walks of development")
    parser.add_argument("--write", action="store_true", help="into docs/results/")
    options = parser.parse_args(arguments)
    wanted = [word.strip() for words in options.rows for word in words.split(",")]
    began = time.time()
    make(wanted, options.walks, HELD_BACK if options.held_back else DEVELOPMENT)
    print(f"{time.time() - began:.0f} s", file=sys.stderr)
