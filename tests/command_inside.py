"""The command line in this process, which is quicker than one of its own."""

import sys
import warnings
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from unittest.mock import patch

from pdr_graph.cli import main


def command(*arguments):
    """Run the command line; returns its exit code, output and error lines."""
    out, errors, code = StringIO(), StringIO(), 0
    shown = warnings.showwarning
    with redirect_stdout(out), redirect_stderr(errors), patch.object(sys, "argv", ["pdr-graph", *map(str, arguments)]):
        try:
            main()
        except SystemExit as ended:
            code = ended.code or 0
        finally:
            warnings.showwarning = shown
    return code, out.getvalue(), errors.getvalue().strip().splitlines()
