"""``pdr-graph compare``: several trajectories, or the methods of an estimate, in one table and one picture."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from pdr_graph.apps.cli.options import AsJson, Method, PictureFile, Quiet, WalkOptions, with_groups
from pdr_graph.apps.cli.terminal import echo, echo_lines, echo_result
from pdr_graph.errors import InputError

Tracks = Annotated[
    list[str],
    typer.Argument(
        metavar="A B ...",
        help="Trajectories as CSV or TUM, output folders of smooth or replay; with --recording also methods of smooth: "
        "graph, filter, rts, pdr.",
    ),
]
Recorded = Annotated[
    Path | None, typer.Option("--recording", metavar="RECORDING", help="The recording that methods estimate.")
]


@with_groups
def compare(
    tracks: Tracks,
    walk: WalkOptions,
    recording: Recorded = None,
    out: PictureFile = Path("comparison.png"),
    quiet: Quiet = False,
    json_: AsJson = False,
) -> None:
    """Compare trajectories of one walk in a table and a picture.

    The scores are those of evaluate. All are in one frame and on one clock. Without --truth the others are scored
    against the first. The options from --fixes to --radio-map are those of the methods.

    \b
    pdr-graph compare result other.tum --truth truth.csv --map plan.geojson
    pdr-graph compare graph filter pdr --recording walk.zip --fixes fixes.csv --truth truth.csv
    """
    from pdr_graph.apps.report import evaluation
    from pdr_graph.apps.report.plotting import picture_bytes, plot_comparison
    from pdr_graph.floor.plan_files import Building
    from pdr_graph.io.tables import read_trajectory
    from pdr_graph.whole_files import write_file

    if len(tracks) < 2 and walk.truth is None:
        raise InputError(tracks[0], "", "one trajectory", "two or more, or --truth")
    with tempfile.TemporaryDirectory() as folder:
        results = [_estimated(name, recording, Path(folder), walk) for name in tracks]
        read = evaluation.read_tracks(results)
    truth = read_trajectory(walk.truth) if walk.truth else None
    building = Building.load(walk.map, walk.scale) if walk.map else None
    compared = evaluation.compare(read, truth, walk.truth.name if walk.truth else "", building)
    write_file(out, picture_bytes(plot_comparison(read, truth, building)))
    if json_:
        echo_result(json.dumps({"reference": compared.reference, "scores": compared.scores}))
    echo_lines(evaluation.comparison_table(compared))
    echo(f"-> {out}")


def _estimated(name: str, recording: Path | None, folder: Path, walk: WalkOptions) -> Path:
    """The path of a trajectory; if it is the name of a method, its result in a folder."""
    if name not in set(Method) or Path(name).exists():
        return Path(name)
    if recording is None:
        raise InputError(name, "", "a method of smooth, and no file of that name", "--recording, which it estimates")
    from pdr_graph.apps.report.output_files import smooth_recording

    smooth_recording(recording, folder / name, walk.options(method=name), report=False)
    return folder / name
