"""Commands of pdr-graph in this process, or in a new interpreter where that is what a test is about."""

import contextlib
import io
import subprocess
import sys
import warnings
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

from pdr_graph.apps import cli

LONGEST = 240.0  # [s] of one command in a new interpreter, on a machine under load
NEW = "import sys; from pdr_graph.__main__ import main; sys.argv[0] = 'pdr-graph'; main()"
UNSHOWN = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)  # as an interpreter has it


class Ending(NamedTuple):
    """What a command leaves: exit code, output, and the lines of its errors."""

    code: int
    output: str
    errors: list[str]


def run(*arguments, cwd=None, new=False):
    """Run a command; new: in a new interpreter, which has imported nothing."""
    if new:
        command = [sys.executable, "-c", NEW, *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=LONGEST)
        return Ending(done.returncode, done.stdout, done.stderr.strip().splitlines())
    code, out, err = 0, io.StringIO(), io.StringIO()
    with (
        contextlib.chdir(cwd or Path.cwd()),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        patch.object(sys, "argv", ["pdr-graph", *map(str, arguments)]),
        warnings.catch_warnings(),
    ):
        for category in UNSHOWN:
            warnings.simplefilter("ignore", category)
        try:
            cli.main()
        except SystemExit as end:
            code = end.code or 0
    return Ending(code, out.getvalue(), err.getvalue().strip().splitlines())
