"""``pdr-graph smooth``: one walk, from input files to output files.

This module imports little, so that a recording that cannot be read is refused at once.
"""

from __future__ import annotations

import gc
from functools import cache
from pathlib import Path

from pdr_graph.io.loading import load
from pdr_graph.progress import Stages
from pdr_graph.walk_options import Options
from pdr_graph.whole_files import output_folder


def smooth_recording(
    recording: Path, out: Path, options: Options | None = None, report: bool = True
) -> tuple[str, ...]:
    """Reconstruct one walk; write trajectory, picture, report and summary to ``out``.

    report: False writes everything else, and removes the report of an earlier walk from ``out``. Returns what could not
    be estimated or written, a line each; empty if all went well. Raises InputError if an input cannot be used.
    """
    options, stage = options or Options(), Stages()
    with stage("reading"):
        walk = load(recording, options.gnss_latency)
        from pdr_graph.inputs import read
        from pdr_graph.outputs import REPORT, write
        from pdr_graph.pipeline import estimate, observe, positions_alone

        keep_modules()
        inputs = read(recording, options, walk=walk)
    with stage("steps"):
        evidence = observe(inputs, options)
    with output_folder(out, without=() if report else (REPORT,)) as staged:
        with stage("estimate"):
            result = estimate(evidence, options.method) if inputs.walk.signals else positions_alone(inputs.fixes)
        return write(staged, inputs, result, options, stage, report)


@cache
def keep_modules() -> None:
    """Leave imported modules out of garbage collection; once, since what later calls freeze is never collected."""
    gc.freeze()
