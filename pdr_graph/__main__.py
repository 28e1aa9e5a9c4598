"""The program: its first lines make Ctrl-C and a request to end it one line of text, at any moment."""

from __future__ import annotations

import signal
import sys
from typing import Any

from pdr_graph.errors import INTERRUPTIONS, Interrupted


def main() -> None:
    """Run the command line; an interruption ends it with one line and the exit code of its signal."""
    try:
        for number in INTERRUPTIONS:
            signal.signal(number, _interrupt)
        from pdr_graph.apps.cli import main as run

        run()
    except Interrupted as interruption:
        [number] = interruption.args
        print(f"pdr-graph: {'interrupted' if number == signal.SIGINT else 'told to end'}", file=sys.stderr)
        sys.exit(128 + number)


def _interrupt(number: int, _: Any) -> None:
    raise Interrupted(number)


if __name__ == "__main__":
    main()
