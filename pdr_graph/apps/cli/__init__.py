"""The command line: a function for each command. Each imports what it uses, so that ``--help`` is instant."""

from __future__ import annotations

import json
import sys
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

import pdr_graph
from pdr_graph.apps.cli.bench import bench
from pdr_graph.apps.cli.lifelog import lifelog as lifelog_commands
from pdr_graph.apps.cli.options import (
    AsJson,
    Force,
    Height,
    Method,
    OutputOptions,
    Pairing,
    PictureFile,
    PlanScale,
    Quiet,
    Rate,
    RecordingPath,
    WalkerPath,
    WalkOptions,
    lag_seconds,
    path_named_after,
    with_groups,
)
from pdr_graph.apps.cli.serve import serve
from pdr_graph.apps.cli.terminal import App, echo, echo_errors, echo_lines, echo_result, print_summary
from pdr_graph.errors import EXIT_DEGRADED, EXIT_REFUSED, InputError, count, one_line
from pdr_graph.whole_files import check_replaceable

if TYPE_CHECKING:
    from pdr_graph.estimation.fingerprinting import RadioMap


class Commands(TyperGroup):
    """The commands of pdr-graph."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Resolve a command as every group does; if a path is given first, raise InputError that suggests one."""
        if args[0] not in self.commands and Path(args[0]).exists():
            raise InputError(args[0], "", "a path and no command", f"a command before it: pdr-graph smooth {args[0]}")
        return super().resolve_command(ctx, args)


app = App(
    cls=Commands,
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    context_settings={"max_content_width": 100, "help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)
maps = App(no_args_is_help=True, rich_markup_mode=None, help="Draw, check and convert floor plans.")
app.add_typer(maps, name="map")
app.add_typer(lifelog_commands, name="lifelog")
app.add_typer(bench, name="bench")
app.command()(serve)


def _print_version(requested: bool) -> None:
    if requested:
        echo(f"pdr-graph {pdr_graph.__version__}")
        raise typer.Exit


@app.callback()
def about(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Reconstruct the most probable walk from a phone's sensor log and a floor plan.

    \b
    pdr-graph smooth walk.zip              a recording of any supported app -> walk-smoothed/report.html
    pdr-graph simulate arcade              a simulated walk with its truth -> arcade/
    """


@app.command()
@with_groups
def smooth(
    recording: RecordingPath,
    walk: WalkOptions,
    output: OutputOptions,
    method: Annotated[
        Method, typer.Option(help="The factor graph, the causal filter, the filter smoothed (RTS), or dead reckoning.")
    ] = Method.graph,
    rate: Rate = None,
) -> None:
    """Reconstruct a walk from a recording.

    \b
    pdr-graph smooth walk.zip
    pdr-graph smooth walk.txt --map plan.geojson --fixes fixes.csv --out result
    """
    from pdr_graph.apps.report.output_files import smooth_recording

    folder = output.folder(recording, "-smoothed", walk.files)
    options = walk.options(method=str(method), rate=rate)
    missing = smooth_recording(recording, folder, options, output.report)
    print_summary(folder, missing, output.json)


@app.command()
@with_groups
def replay(
    recording: RecordingPath,
    walk: WalkOptions,
    output: OutputOptions,
    rate: Rate = None,
    lag: Annotated[
        str, typer.Option(metavar="SECONDS", help="Finalise steps older than this; inf or none: never.")
    ] = "60",
    journal: Annotated[
        Path | None,
        typer.Option("--journal", metavar="FILE", help="Save the walk in this file, or resume the walk in it."),
    ] = None,
    rerun: Annotated[
        Path | None, typer.Option(metavar="RRD", help="Write the replay for Rerun, whose viewer follows the file.")
    ] = None,
) -> None:
    """Estimate a recording as if it were live.

    Each pose is estimated from earlier data only; the computing time of each step is measured.

    \b
    pdr-graph replay walk.zip
    pdr-graph replay walk.txt --map plan.geojson --fixes fixes.csv --out live
    """
    from pdr_graph.apps.replay import replay_recording
    from pdr_graph.walk import LIVE

    folder = output.folder(recording, "-replayed", [*walk.files, *([journal] if journal else [])])
    options = walk.options(method=LIVE, rate=rate, lag=lag_seconds(lag), journal=journal)
    issues = replay_recording(recording, folder, options, report=output.report, rerun=rerun)
    print_summary(folder, issues, output.json)


Tracks = Annotated[
    list[str],
    typer.Argument(
        metavar="A B ...",
        help="Trajectories as CSV or TUM, output folders of smooth or replay; with --recording also methods: graph, "
        "filter, rts, pdr, live, particles (with --map), module:function.",
    ),
]
Recorded = Annotated[
    Path | None, typer.Option("--recording", metavar="RECORDING", help="The recording that methods estimate.")
]


@app.command()
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

    The scores are those of evaluate, against --truth, else against the truth in the recording, else of the others
    against the first. All are in one frame and on one clock. The options from --fixes to --paths are those of the
    methods.

    \b
    pdr-graph compare result other.tum --truth truth.csv --map plan.geojson
    pdr-graph compare graph filter pdr --recording walk.zip --fixes fixes.csv --truth truth.csv
    """
    from pdr_graph.apps.bench.methods import estimated
    from pdr_graph.apps.report import evaluation
    from pdr_graph.apps.report.plotting import picture_bytes, plot_comparison
    from pdr_graph.floor.plan_files import Building
    from pdr_graph.io.tables import read_trajectory
    from pdr_graph.whole_files import write_file

    by, truth, frame = estimated(tracks, recording, walk.options())
    read = by | evaluation.read_tracks([Path(name) for name in tracks if name not in by], frame)
    reference = "the recording's truth" if walk.truth is None else walk.truth.name
    truth = read_trajectory(walk.truth) if walk.truth else truth
    if len(read) < 2 and truth is None:
        raise InputError(tracks[0], "", "one trajectory", "two or more, or --truth")
    building = Building.load(walk.map, walk.scale) if walk.map else None
    compared = evaluation.compare(read, truth, reference if truth else "", building)
    write_file(out, picture_bytes(plot_comparison(read, truth, building)))
    if json_:
        echo_result(json.dumps({"reference": compared.reference, "scores": compared.scores}))
    echo_lines(evaluation.comparison_table(compared))
    echo(f"-> {out}")


@app.command()
def steps(
    recording: RecordingPath,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="CSV", help="Default: here, named after the recording.")
    ] = None,
    walker: WalkerPath = None,
    height: Height = None,
    quiet: Quiet = False,
) -> None:
    """Write the detected steps, as input of other back ends.

    Without an acceleration they are those of the phone's own counter. One row per step:
    time,length,turn,sigma_length,sigma_turn,confidence.

    \b
    pdr-graph steps walk.zip
    """
    from pdr_graph.gait.steps import detect_steps
    from pdr_graph.io.loading import load
    from pdr_graph.io.writers import write_steps
    from pdr_graph.walk import Options, counted

    walk, person = load(recording), Options(walker=walker, height=height).person()
    detected = counted(walk, person) or detect_steps(walk, person)
    file = out or path_named_after(recording, "-steps.csv")
    write_steps(file, detected, walk.clock_origin)
    echo(f"{len(detected)} steps, {detected.length.sum():.1f} m in {detected.end - detected.start:.1f} s -> {file}")


@app.command()
def calibrate(
    recording: RecordingPath,
    route: Annotated[
        Path,
        typer.Option("--route", metavar="GEOJSON", help="The route that was walked: one feature of kind link."),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="TOML", help="File of the walker's profile.")],
    walker: WalkerPath = None,
    height: Height = None,
    quiet: Quiet = False,
) -> None:
    """Estimate a walker's stride and turn scales on a known route.

    \b
    pdr-graph calibrate walk.zip --route line.geojson --out walker.toml
    """
    import numpy as np

    from pdr_graph.apps.report.plotting import picture_bytes, plot
    from pdr_graph.estimation.calibration import calibrate as fit
    from pdr_graph.floor.plan_files import read_route
    from pdr_graph.gait.steps import detect_steps
    from pdr_graph.gait.walker import COEFFICIENTS
    from pdr_graph.io.loading import load
    from pdr_graph.types import Trajectory
    from pdr_graph.walk import Options
    from pdr_graph.whole_files import write_file

    walk, person = load(recording), Options(walker=walker, height=height).person()
    if walk.gyroscope is None:
        raise InputError(recording, "gyroscope", "no samples", "its turns, to tell them from the route's")
    steps, line = detect_steps(walk, replace(person, profile=None)), read_route(route)
    profile, estimate, laps = fit(steps, line, walk.source)
    reference = Trajectory(np.arange(float(len(line))), line, np.zeros(len(line)), ("",) * len(line))
    title = f"{walk.source} along {route.name}   {profile.residual:.2f} m from it (rms)"
    picture = picture_bytes(plot(replace(estimate, reports={}), truth=reference, title=title))
    write_file(out.with_suffix(".png"), picture)
    replace(person, profile=profile).save(out, f"{walk.source} along {route.name}, {laps} times")
    sigma = profile.covariance.diagonal() ** 0.5
    columns = zip(COEFFICIENTS, ("", " rad/m", ""), sigma, strict=True)
    values = ", ".join(f"{name} {getattr(profile, name):+.4f} ± {s:.4f}{unit}" for name, unit, s in columns)
    echo(f"{laps} x the route, rms distance {profile.residual:.2f} m: {values} -> {out}")


@app.command("radio-map")
def radio_map(
    walks: Annotated[
        list[Path],
        typer.Argument(
            metavar="RECORDING DIR ...", help="Recordings, each followed by the output folder of its smooth."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="File of the radio map.")],
    quiet: Quiet = False,
) -> None:
    """Make a radio map of Wi-Fi and BLE from smoothed walks.

    For smooth --radio-map. All walks must have been smoothed with the same plan.

    \b
    pdr-graph radio-map monday.txt monday tuesday.txt tuesday --out mall.npz
    """
    if len(walks) % 2:
        raise InputError(walks[-1], "", f"{len(walks)} paths", "each recording followed by its output folder")
    learnt = learn_radio_map(list(zip(walks[::2], walks[1::2], strict=True)), out)
    echo(f"{len(learnt)} scans of {len(learnt.transmitter)} transmitters -> {out}")


def learn_radio_map(walks: Sequence[tuple[Path, Path]], out: Path) -> RadioMap:
    """Write a radio map of recordings to ``out``; walks: each recording with the output folder of ``pdr-graph smooth``.

    Raises InputError if an input cannot be used, or if the walks are not all in one frame.
    """
    from pdr_graph.estimation.fingerprinting import RadioMap
    from pdr_graph.io.loading import load
    from pdr_graph.io.tables import read_trajectory

    learnt, frames = [], []
    for recording, folder in walks:
        walk, track = load(recording), read_trajectory(folder / "trajectory.csv")
        track = replace(track, time=track.time - walk.clock_origin)
        if track.time[-1] < 0 or track.time[0] > max(s.time[-1] for s in walk.signals.values()):
            raise InputError(folder, "trajectory.csv", "times of another walk", f"those of {walk.source}")
        learnt.append((track, walk))
        frames.append(_frame_of(folder / "summary.json"))
        if frames[-1] != frames[0]:
            raise InputError(folder, "frame", f"{frames[-1]}", f"that of {walks[0][1]}, {frames[0]}: one plan for all")
    try:
        radio_map = RadioMap.learn(learnt, frames[0])
    except ValueError as error:
        raise InputError(out, "", str(error).removeprefix("found "), "more walks or longer ones") from None
    radio_map.save(out)
    return radio_map


def _frame_of(summary: Path) -> dict[str, Any]:
    """The frame of a smoothed walk. Raises InputError if it has none, or if the walk is not to be trusted."""
    from pdr_graph.types import OK

    try:
        content = json.loads(summary.read_text(encoding="utf-8"))
        frame, judged = content["frame"], content.get("verdict", {}).get("state", OK)
    except (ValueError, KeyError, TypeError, AttributeError):
        frame, judged = None, OK
    if judged != OK:
        raise InputError(
            summary, "verdict", one_line(f"{judged}"), "walks that are ok: a radio map is as wrong as they"
        )
    if not isinstance(frame, dict):
        raise InputError(summary, "frame", "none", "the frame of a walk, as pdr-graph smooth writes it")
    return frame


@app.command()
def evaluate(
    trajectory: Annotated[
        Path,
        typer.Argument(metavar="TRAJECTORY", help="trajectory.csv, any CSV with time,x,y[,heading][,floor], or TUM."),
    ],
    truth: Annotated[Path, typer.Argument(metavar="TRUTH", help="CSV with time,x,y[,heading][,floor], or TUM.")],
    map_: Annotated[
        Path | None, typer.Option("--map", metavar="PLAN", help="The floor plan, for the obstacle error OE.")
    ] = None,
    scale: PlanScale = None,
    pairing: Annotated[
        Pairing, typer.Option(help="Interpolate the estimate, or take its nearest row.")
    ] = Pairing.linear,
    json_: AsJson = False,
) -> None:
    """Score a trajectory against ground truth.

    CE, HE, EAG, VE, CA, OE and FE of the draft ISO/IEC 21134 (docs/results/metrics.md).

    \b
    pdr-graph evaluate result/trajectory.csv truth.csv --map plan.geojson
    """
    from pdr_graph.apps.report import evaluation
    from pdr_graph.floor.plan_files import Building
    from pdr_graph.io.tables import clock_hint, read_trajectory

    floor = Building.load(map_, scale) if map_ else None
    tracks = read_trajectory(trajectory), read_trajectory(truth)
    if not len(evaluation.pair(*tracks, str(pairing)).time):
        spans = [(float(track.time[0]), float(track.time[-1])) for track in reversed(tracks)]
        found = f"no row within {evaluation.TOLERANCE} s of {trajectory}{clock_hint(*spans)}"
        raise InputError(truth, "time", found, "the same clock")
    scores = evaluation.evaluate(*tracks, floor, str(pairing))
    echo_result(json.dumps(scores) if json_ else evaluation.table(scores))


@app.command()
def export(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="An output folder of smooth or replay.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="BAG", help="A file .mcap, or a folder of rosbag2; default: RESULT.mcap here."),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Write a walk as a bag of ROS 2 for Foxglove and RViz.

    PoseWithCovarianceStamped, and in a frame with latitudes Foxglove's LocationFix and GeoJSON. Needs the extra ros.

    \b
    pdr-graph export walk-smoothed
    """
    from pdr_graph.io.ros_bags import write
    from pdr_graph.io.tables import read_trajectory

    bag, drawn = out or path_named_after(result, ".mcap"), result / "trajectory.geojson"
    if bag.exists() and not bag.is_file():
        raise InputError(bag, "", "a folder", "a name for a new bag")
    track = read_trajectory(result / "trajectory.csv")
    write(bag, track, drawn.read_text(encoding="utf-8") if drawn.is_file() else "")
    echo(f"{len(track)} poses -> {bag}")


@app.command()
def simulate(
    scenario: Annotated[
        Path,
        typer.Argument(metavar="SCENARIO", help="A TOML file (docs/simulation.md), or the name of a ready scenario."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="Folder of recording, truth and plan; default: SCENARIO's name, here."
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, metavar="N", help="Replaces the scenario's seed: another walk.")
    ] = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Simulate the recording of a walk, with its truth.

    Ready scenarios: arcade campus cart figure_eight l_corridor loop mall office
    outdoors stairs two_floors.

    \b
    pdr-graph simulate arcade --out walk
    pdr-graph smooth walk --map walk/plan.geojson --fixes walk/fixes.csv
    """
    from pdr_graph.lab.simulation.recorders import write
    from pdr_graph.lab.simulation.scenario import Scenario
    from pdr_graph.lab.simulation.simulate import simulate as simulated

    loaded = Scenario.load(scenario)
    folder = out or Path(loaded.name)
    check_replaceable(folder, "events.csv", force)
    walk = simulated(loaded if seed is None else replace(loaded, seed=seed))
    write(walk, folder)
    body = walk.body
    echo(f"{len(body.landings)} steps, {body.lengths.sum():.1f} m in {body.time[-1]:.1f} s -> {folder}")


PlanPath = Annotated[
    Path, typer.Argument(metavar="PLAN", help="A floor plan of any format in docs/formats.md: a file, folder or zip.")
]


@maps.command("show")
def map_show(
    plan: PlanPath,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="PNG", help="Default: PLAN's name with .png, here.")
    ] = None,
    scale: PlanScale = None,
    paths: Annotated[bool, typer.Option("--paths", help="PLAN has ways outdoors, as for smooth --paths.")] = False,
) -> None:
    """Draw a floor plan, all its floors, or ways.

    \b
    pdr-graph map show plan.geojson --out plan.png
    pdr-graph map show town.osm.pbf --paths
    """
    from pdr_graph.apps.report.plotting import picture_bytes, plot_plan, plot_ways
    from pdr_graph.floor.paths import PathNetwork
    from pdr_graph.floor.plan_files import FloorPlan
    from pdr_graph.whole_files import write_file

    target = out or Path(plan.resolve().name.split(".")[0] + ".png")
    if paths:
        network = PathNetwork.load(plan)
        write_file(target, picture_bytes(plot_ways(network), dpi=150))
        echo(f"{network!r} -> {target}")
        return
    floors = FloorPlan.load_all(plan, scale)
    write_file(target, picture_bytes(plot_plan(*floors), dpi=150))
    for floor in floors:
        size = f"{len(floor.areas)} areas, {len(floor.cells)} cells, {floor.walkable_area:.0f} m² walkable"
        echo(f"{floor.label or plan.stem}: {size} -> {target}")


@maps.command("check")
def map_check(plan: PlanPath, scale: PlanScale = None) -> None:
    """Check a plan for errors that would mislead a walk.

    Sealed rooms, doors to nowhere, links through walls; exit code 3 if there are any.

    \b
    pdr-graph map check plan.geojson
    """
    _report_check(plan, scale)


@maps.command("convert")
def map_convert(
    plan: Annotated[
        Path,
        typer.Argument(metavar="INPUT", help="A plan in any format: DXF, CSV, PDF, PNG, JPEG, ROS map, GeoJSON ..."),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="GEOJSON", help="Default: INPUT's name with .geojson, here.")
    ] = None,
    scale: PlanScale = None,
    two_points: Annotated[
        str | None,
        typer.Option("--two-points", metavar="POINTS", help='The scale by a distance: "x1,y1 x2,y2 = METRES".'),
    ] = None,
    georeference: Annotated[
        str | None,
        typer.Option("--georeference", metavar="POINTS", help='Two points or more: "x,y=lat,lon x,y=lat,lon".'),
    ] = None,
    floor: Annotated[str | None, typer.Option("--floor", metavar="LABEL", help="The label of the only floor.")] = None,
) -> None:
    """Convert a plan to GeoJSON, draw and check it.

    Points are in INPUT's own coordinates: units of a drawing, pixels of a picture from its upper
    left corner, points of a PDF page. Without a georeference the result is in metres along
    INPUT's own axes. Exit code 3 if the check finds problems.

    \b
    pdr-graph map convert floor.dxf --out plan.geojson
    pdr-graph map convert scan.png --two-points "120,80 920,80 = 24.5"
    """
    from pdr_graph.apps.report.plotting import picture_bytes, plot_conversion
    from pdr_graph.floor.formats.conversion import convert
    from pdr_graph.floor.plan_files import FloorPlan
    from pdr_graph.whole_files import write_file

    target = out or Path(plan.resolve().stem + ".geojson")
    drawing = convert(plan, target, scale, two_points, georeference, floor)
    picture = _picture_beside(target, plan)
    write_file(picture, picture_bytes(plot_conversion(drawing.ignored, *FloorPlan.of(plan, drawing)), dpi=150))
    frame = "longitude and latitude" if drawing.frame.georeferenced else "metres along the drawing's own axes"
    for note in drawing.notes:
        echo(f"note: {note}")
    echo(f"-> {target} ({frame}), {picture}")
    _report_check(target)


def _picture_beside(target: Path, plan: Path) -> Path:
    """The PNG beside a conversion's GeoJSON, of another name if that is a file of the input."""
    from pdr_graph.floor.plan_files import is_file_of

    picture = target.with_suffix(".png")
    return target.with_name(f"{target.stem}-plan.png") if is_file_of(picture, plan) else picture


def _report_check(plan: Path, scale: float | None = None) -> None:
    """Print notes, floors, connections and problems of a plan; exit with EXIT_DEGRADED if there are problems."""
    from pdr_graph.floor.check import problems
    from pdr_graph.floor.plan_files import Building

    building = Building.load(plan, scale)
    for note in building.floors[0].notes:
        echo(f"note: {note}")
    for floor in building.floors:
        kinds = Counter(area.kind for area in floor.areas)
        drawn = ", ".join(count(n, kind) for kind, n in sorted(kinds.items()))
        height = f"at {floor.height:g} m, " if len(building.floors) > 1 else ""
        echo(f"{floor.label or plan.stem}: {height}{floor.walkable_area:.0f} m² walkable; {drawn}")
    for connection in building.connections:
        joined = ", ".join(building.labels[n] for n in connection.floors)
        echo(f"{connection.kind} {connection.name}".strip() + f": {joined}")
    errors = problems(building)
    for problem in errors:
        echo(f"problem: {problem}")
    if errors:
        raise typer.Exit(EXIT_DEGRADED)
    echo("no problems found")


_PYTHONS = warnings.showwarning


def _show_warning(message: Warning | str, kind: type[Warning], *rest: Any) -> None:
    """Print what a power cut has cost on one line."""
    from pdr_graph.recovery import DataLossWarning  # it takes numpy, long to import

    if issubclass(kind, DataLossWarning):
        echo_errors(message)
    else:
        _PYTHONS(message, kind, *rest)


def main() -> None:
    """Run a command. Bad input ends with one line of text and exit code 2, never with a traceback."""
    warnings.showwarning = _show_warning
    try:
        app()
    except InputError as error:
        echo_errors(error)
        sys.exit(EXIT_REFUSED)
    except (FileExistsError, NotADirectoryError) as error:
        echo_errors(InputError(error.filename or "", "", "a file", "a folder"))
        sys.exit(EXIT_REFUSED)
    except OSError as error:
        echo_errors(f"{error.filename or ''}: {error.strerror or error}")
        sys.exit(EXIT_REFUSED)
