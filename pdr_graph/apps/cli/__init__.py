"""The command line: a function for each command. Each imports what it uses, so that ``--help`` is instant."""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, Parameter
from cyclopts.exceptions import CycloptsError
from cyclopts.utils import default_name_transform

import pdr_graph
from pdr_graph.apps.cli.bench import bench
from pdr_graph.apps.cli.lifelog import lifelog as lifelog_commands
from pdr_graph.apps.cli.parameters import (
    HYPHEN,
    AsJson,
    Count,
    Force,
    OutputOptions,
    PersonOptions,
    PlanOptions,
    Quiet,
    ScaleOption,
    all_but,
    applied,
    path_named_after,
)
from pdr_graph.apps.cli.serve import serve
from pdr_graph.apps.cli.terminal import (
    PlainHelp,
    echo,
    echo_errors,
    echo_lines,
    echo_result,
    print_summary,
    usage_error,
)
from pdr_graph.errors import EXIT_DEGRADED, EXIT_REFUSED, InputError, count, one_line
from pdr_graph.options import LIVE, Options
from pdr_graph.whole_files import check_replaceable

if TYPE_CHECKING:
    from pdr_graph.estimation.fingerprinting import RadioMap


OTHER_NAMES = {"plan": "map", "settings": "set"}  # of fields of `Options` on the command line
HELP = ("--help", "-h")

app = App(
    "pdr-graph",
    help="""Reconstruct the most probable walk from a phone's sensor log and a floor plan.

pdr-graph smooth walk.zip              a recording of any supported app -> walk-smoothed/report.html
pdr-graph simulate arcade              a simulated walk with its truth -> arcade/
""",
    version=f"pdr-graph {pdr_graph.__version__}",
    help_flags=HELP,
    help_format="plaintext",
    help_formatter=PlainHelp(),
    default_parameter=Parameter(
        negative_iterable=(),
        allow_repeating=True,  # the last one counts
        json_dict=False,
        json_list=False,
        name_transform=lambda name: OTHER_NAMES.get(name, default_name_transform(name)),
    ),
)
app.register_install_completion_command(add_to_startup=False, group="Options")
app["--help"].group = app["--version"].group = "Options"
maps = App("map", help="Draw, check and convert floor plans.")
radio_maps = App("radio-map")
for group in (maps, radio_maps, lifelog_commands, bench):
    app.command(group)
app.command(serve)


@app.command
def smooth(
    recording: Path,
    /,
    *,
    options: Annotated[Options, all_but("method", "lag", "journal")] = Options(),
    output: OutputOptions = OutputOptions(),
    method: Literal["graph", "filter", "rts", "pdr"] = "graph",
) -> None:
    """Reconstruct a walk from a recording.

    pdr-graph smooth walk.zip
    pdr-graph smooth walk.txt --map plan.geojson --fixes fixes.csv --out result

    Args:
        recording: A recording: file, folder or zip of a supported recorder.
        method: The factor graph, the causal filter, the filter smoothed (RTS), or dead reckoning.
    """
    from pdr_graph.apps.report.output_files import smooth_recording

    folder = output.folder(recording, "-smoothed", options)
    missing = smooth_recording(recording, folder, replace(options, method=method), output.report)
    print_summary(folder, missing, output.json_)


@app.command
def replay(
    recording: Path,
    /,
    *,
    options: Annotated[Options, all_but("method")] = Options(),
    output: OutputOptions = OutputOptions(),
    rerun: Path | None = None,
) -> None:
    """Estimate a recording as if it were live.

    Each pose is estimated from earlier data only; the computing time of each step is measured.

    pdr-graph replay walk.zip
    pdr-graph replay walk.txt --map plan.geojson --fixes fixes.csv --out live

    Args:
        recording: A recording: file, folder or zip of a supported recorder.
        rerun: Write the replay for Rerun, whose viewer follows the file.
    """
    from pdr_graph.apps.replay import replay_recording

    folder = output.folder(recording, "-replayed", options)
    options = replace(options, method=LIVE)
    issues = replay_recording(recording, folder, options, report=output.report, rerun=rerun)
    print_summary(folder, issues, output.json_)


@app.command
def compare(
    *tracks: Annotated[str, Parameter(required=True)],
    options: Annotated[Options, all_but("method", "rate", "lag", "journal")] = Options(),
    recording: Path | None = None,
    out: Path = Path("comparison.png"),
    quiet: Quiet = False,
    json_: AsJson = False,
) -> None:
    """Compare trajectories of one walk in a table and a picture.

    The scores are those of evaluate, against --truth, else against the truth in the recording, else of the others
    against the first. All are in one frame and on one clock. The options from --fixes to --paths are those of the
    methods.

    pdr-graph compare result other.tum --truth truth.csv --map plan.geojson
    pdr-graph compare graph filter pdr --recording walk.zip --fixes fixes.csv --truth truth.csv

    Args:
        tracks: Trajectories as CSV or TUM, output folders of smooth or replay; with --recording also methods: graph,
            filter, rts, pdr, live, particles (with --map), module:function.
        recording: The recording that methods estimate.
        out: File of the picture.
    """
    from pdr_graph.apps.bench.methods import estimated
    from pdr_graph.apps.report import evaluation
    from pdr_graph.apps.report.plotting import picture_bytes, plot_comparison
    from pdr_graph.floor.plan_files import Building
    from pdr_graph.io.tables import read_trajectory
    from pdr_graph.whole_files import write_file

    by, truth, frame = estimated(tracks, recording, options)
    read = by | evaluation.read_tracks([Path(name) for name in tracks if name not in by], frame)
    reference = "the recording's truth" if options.truth is None else options.truth.name
    truth = read_trajectory(options.truth) if options.truth else truth
    if len(read) < 2 and truth is None:
        raise InputError(tracks[0], "", "one trajectory", "two or more, or --truth")
    building = Building.load(options.plan, options.scale) if options.plan else None
    compared = evaluation.compare(read, truth, reference if truth else "", building)
    write_file(out, picture_bytes(plot_comparison(read, truth, building)))
    if json_:
        echo_result(json.dumps({"reference": compared.reference, "scores": compared.scores}))
    echo_lines(evaluation.comparison_table(compared))
    echo(f"-> {out}")


@app.command
def steps(
    recording: Path,
    /,
    *,
    options: PersonOptions = Options(),
    out: Path | None = None,
    quiet: Quiet = False,
) -> None:
    """Write the detected steps, as input of other back ends.

    Without an acceleration they are those of the phone's own counter. One row per step:
    time,length,turn,sigma_length,sigma_turn,confidence.

    pdr-graph steps walk.zip

    Args:
        recording: A recording: file, folder or zip of a supported recorder.
        out: CSV of the steps; default: here, named after the recording.
    """
    from pdr_graph.gait.steps import detect_steps
    from pdr_graph.io.loading import load
    from pdr_graph.io.writers import write_steps
    from pdr_graph.walk import counted

    walk, person = load(recording), options.person()
    detected = counted(walk, person) or detect_steps(walk, person)
    file = out or path_named_after(recording, "-steps.csv")
    write_steps(file, detected, walk.clock_origin)
    echo(f"{len(detected)} steps, {detected.length.sum():.1f} m in {detected.end - detected.start:.1f} s -> {file}")


@app.command
def calibrate(
    recording: Path,
    /,
    *,
    route: Path,
    out: Path,
    options: PersonOptions = Options(),
    quiet: Quiet = False,
) -> None:
    """Estimate a walker's stride and turn scales on a known route.

    pdr-graph calibrate walk.zip --route line.geojson --out walker.toml

    Args:
        recording: A recording: file, folder or zip of a supported recorder.
        route: The route that was walked: GeoJSON with one feature of kind link.
        out: TOML of the walker's profile.
    """
    import numpy as np

    from pdr_graph.apps.report.plotting import picture_bytes, plot
    from pdr_graph.estimation.calibration import calibrate as fit
    from pdr_graph.floor.plan_files import read_route
    from pdr_graph.gait.steps import detect_steps
    from pdr_graph.gait.walker import COEFFICIENTS
    from pdr_graph.io.loading import load
    from pdr_graph.types import Trajectory
    from pdr_graph.whole_files import write_file

    walk, person = load(recording), options.person()
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


Walks = Annotated[Path, Parameter(required=True)]


@radio_maps.default
def radio_map(*walks: Walks, out: Path, quiet: Quiet = False) -> None:
    """Make a radio map of Wi-Fi and BLE from smoothed walks, or add walks to one (radio-map add).

    For smooth --radio-map. All walks must have been smoothed with the same plan.

    pdr-graph radio-map monday.txt monday tuesday.txt tuesday --out mall.npz

    Args:
        walks: Recordings, each followed by the output folder of its smooth.
        out: File of the radio map. Keep it private: where the walks were, and every transmitter's identity.
    """
    _echo_map(learn_radio_map(walks, out), out)


@radio_maps.command(name="add")
def add_to_radio_map(radio_map: Path, /, *walks: Walks, out: Path | None = None, quiet: Quiet = False) -> None:
    """Add walks to a radio map. Of each place it keeps the newest scans.

    pdr-graph radio-map add mall.npz wednesday.txt wednesday

    Args:
        radio_map: File that radio-map wrote.
        walks: Recordings, each followed by the output folder of its smooth.
        out: File of the new map; by default the same.
    """
    from pdr_graph.estimation.fingerprinting import RadioMap

    _echo_map(learn_radio_map(walks, out or radio_map, RadioMap.load(radio_map)), out or radio_map)


def _echo_map(learnt: RadioMap, out: Path) -> None:
    recordings = count(len(set(learnt.recording.tolist())), "recording")
    echo(f"{len(learnt)} scans of {len(learnt.transmitter)} transmitters, {recordings} -> {out}")


def learn_radio_map(walks: Sequence[Path], out: Path, known: RadioMap | None = None) -> RadioMap:
    """Write a radio map of recordings to ``out``.

    walks: each recording, followed by the output folder of ``pdr-graph smooth``; known: a map to which they are added.

    Raises InputError if an input cannot be used, or if the walks are not all in one frame.
    """
    from pdr_graph.estimation.fingerprinting import RadioMap
    from pdr_graph.io.loading import load
    from pdr_graph.io.tables import read_trajectory

    if len(walks) % 2:
        raise InputError(walks[-1], "", count(len(walks), "path"), "each recording followed by its output folder")
    learnt, frames = [], []
    for recording, folder in zip(walks[::2], walks[1::2], strict=True):
        walk, track = load(recording), read_trajectory(folder / "trajectory.csv")
        track = replace(track, time=track.time - walk.clock_origin)
        if track.time[-1] < 0 or track.time[0] > max(s.time[-1] for s in walk.signals.values()):
            raise InputError(folder, "trajectory.csv", "times of another walk", f"those of {walk.source}")
        learnt.append((track, walk))
        frames.append(_frame_of(folder / "summary.json"))
        if frames[-1] != (frame := frames[0] if known is None else known.frame):
            of = walks[1] if known is None else "the map"
            raise InputError(folder, "frame", f"{frames[-1]}", f"that of {of}, {frame}: one plan for all")
    try:
        radio_map = RadioMap.learn(learnt, frames[0], known)
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


@app.command
def evaluate(
    trajectory: Path,
    truth: Path,
    /,
    *,
    options: PlanOptions = Options(),
    pairing: Literal["linear", "nearest"] = "linear",
    json_: AsJson = False,
) -> None:
    """Score a trajectory against ground truth.

    CE, HE, EAG, VE, CA, OE and FE of the draft ISO/IEC 21134 (docs/results/metrics.md).

    pdr-graph evaluate result/trajectory.csv truth.csv --map plan.geojson

    Args:
        trajectory: trajectory.csv, any CSV with time,x,y[,heading][,floor], or TUM.
        truth: CSV with time,x,y[,heading][,floor], or TUM.
        pairing: Interpolate the estimate, or take its nearest row.
    """
    from pdr_graph.apps.report import evaluation
    from pdr_graph.floor.plan_files import Building
    from pdr_graph.io.tables import clock_hint, read_trajectory

    floor = Building.load(options.plan, options.scale) if options.plan else None
    tracks = read_trajectory(trajectory), read_trajectory(truth)
    if not len(evaluation.pair(*tracks, pairing).time):
        spans = [(float(track.time[0]), float(track.time[-1])) for track in reversed(tracks)]
        found = f"no row within {evaluation.TOLERANCE} s of {trajectory}{clock_hint(*spans)}"
        raise InputError(truth, "time", found, "the same clock")
    scores = evaluation.evaluate(*tracks, floor, pairing)
    echo_result(json.dumps(scores) if json_ else evaluation.table(scores))


@app.command
def export(result: Path, /, *, out: Path | None = None, quiet: Quiet = False) -> None:
    """Write a walk as a bag of ROS 2 for Foxglove and RViz.

    PoseWithCovarianceStamped, and in a frame with latitudes Foxglove's LocationFix and GeoJSON. Needs the extra ros.

    pdr-graph export walk-smoothed

    Args:
        result: An output folder of smooth or replay.
        out: A file .mcap, or a folder of rosbag2; default: RESULT.mcap here.
    """
    from pdr_graph.io.ros_bags import write
    from pdr_graph.io.tables import read_trajectory

    bag, drawn = out or path_named_after(result, ".mcap"), result / "trajectory.geojson"
    if bag.exists() and not bag.is_file():
        raise InputError(bag, "", "a folder", "a name for a new bag")
    track = read_trajectory(result / "trajectory.csv")
    write(bag, track, drawn.read_text(encoding="utf-8") if drawn.is_file() else "")
    echo(f"{len(track)} poses -> {bag}")


@app.command
def simulate(
    scenario: Path,
    /,
    *,
    out: Path | None = None,
    seed: Count | None = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Simulate the recording of a walk, with its truth.

    Ready scenarios: arcade campus cart figure_eight l_corridor loop mall office
    outdoors stairs two_floors.

    pdr-graph simulate arcade --out walk
    pdr-graph smooth walk --map walk/plan.geojson --fixes walk/fixes.csv

    Args:
        scenario: A TOML file (docs/simulation.md), or the name of a ready scenario.
        out: Folder of recording, truth and plan; default: SCENARIO's name, here.
        seed: Replaces the scenario's seed: another walk.
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


@maps.command(name="show")
def map_show(plan: Path, /, *, out: Path | None = None, options: ScaleOption = Options(), paths: bool = False) -> None:
    """Draw a floor plan, all its floors, or ways.

    pdr-graph map show plan.geojson --out plan.png
    pdr-graph map show town.osm.pbf --paths

    Args:
        plan: A floor plan of any format in docs/formats.md: a file, folder or zip.
        out: The picture; default: PLAN's name with .png, here.
        paths: PLAN has ways outdoors, as for smooth --paths.
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
    floors = FloorPlan.load_all(plan, options.scale)
    write_file(target, picture_bytes(plot_plan(*floors), dpi=150))
    for floor in floors:
        size = f"{len(floor.areas)} areas, {len(floor.cells)} cells, {floor.walkable_area:.0f} m² walkable"
        echo(f"{floor.label or plan.stem}: {size} -> {target}")


@maps.command(name="check")
def map_check(plan: Path, /, *, options: ScaleOption = Options()) -> None:
    """Check a plan for errors that would mislead a walk.

    Sealed rooms, doors to nowhere, links through walls; exit code 3 if there are any.

    pdr-graph map check plan.geojson

    Args:
        plan: A floor plan of any format in docs/formats.md: a file, folder or zip.
    """
    _report_check(plan, options.scale)


@maps.command(name="convert")
def map_convert(
    plan: Annotated[Path, Parameter("INPUT")],
    /,
    *,
    out: Path | None = None,
    options: ScaleOption = Options(),
    two_points: Annotated[str | None, HYPHEN] = None,
    georeference: Annotated[str | None, HYPHEN] = None,
    floor: str | None = None,
) -> None:
    """Convert a plan to GeoJSON, draw and check it.

    Points are in INPUT's own coordinates: units of a drawing, pixels of a picture from its upper
    left corner, points of a PDF page. Without a georeference the result is in metres along
    INPUT's own axes. Exit code 3 if the check finds problems.

    pdr-graph map convert floor.dxf --out plan.geojson
    pdr-graph map convert scan.png --two-points "120,80 920,80 = 24.5"

    Args:
        plan: A plan in any format: DXF, CSV, PDF, PNG, JPEG, ROS map, GeoJSON ...
        out: GeoJSON; default: INPUT's name with .geojson, here.
        two_points: The scale by a distance: "x1,y1 x2,y2 = METRES".
        georeference: Two points or more: "x,y=lat,lon x,y=lat,lon".
        floor: The label of the only floor.
    """
    from pdr_graph.apps.report.plotting import picture_bytes, plot_conversion
    from pdr_graph.floor.formats.conversion import convert
    from pdr_graph.floor.plan_files import FloorPlan
    from pdr_graph.whole_files import write_file

    target = out or Path(plan.resolve().stem + ".geojson")
    drawing = convert(plan, target, options.scale, two_points, georeference, floor)
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
        sys.exit(EXIT_DEGRADED)
    echo("no problems found")


_PYTHONS = warnings.showwarning


def _show_warning(message: Warning | str, kind: type[Warning], *rest: Any) -> None:
    """Print what a power cut has cost on one line."""
    from pdr_graph.recovery import DataLossWarning  # it takes numpy, long to import

    if issubclass(kind, DataLossWarning):
        echo_errors(message)
    else:
        _PYTHONS(message, kind, *rest)


def run(tokens: Sequence[str]) -> None:
    """Run a command. Raises CycloptsError for a command line that cannot be read, InputError for bad input."""
    if tokens and tokens[0] not in app and Path(tokens[0]).exists():
        expected = f"a command before it: pdr-graph smooth {tokens[0]}"
        raise InputError(tokens[0], "", "a path and no command", expected)
    command, bound, _ = app.parse_args(tokens, exit_on_error=False, print_error=False)
    if command == app.help_print and not set(HELP) & set(tokens):  # a group without a command
        app.help_print(tokens, console=app.error_console)
        sys.exit(EXIT_REFUSED)
    with applied(bound.arguments) as parameters:
        bound.arguments.update(parameters)
        command(*bound.args, **bound.kwargs)


def main() -> None:
    """Run the command of `sys.argv` and exit. Bad input ends with one line of text and code 2, never a traceback."""
    warnings.showwarning = _show_warning
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a pipe of Windows has 256 characters
    try:
        run(sys.argv[1:])
        sys.exit()
    except CycloptsError as error:
        echo_errors(usage_error(error))
        sys.exit(EXIT_REFUSED)
    except InputError as error:
        echo_errors(error)
        sys.exit(EXIT_REFUSED)
    except BrokenPipeError:  # of head, for one: the rest is not wanted
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except (FileExistsError, NotADirectoryError) as error:
        echo_errors(InputError(error.filename or "", "", "a file", "a folder"))
        sys.exit(EXIT_REFUSED)
    except OSError as error:
        echo_errors(f"{error.filename or ''}: {error.strerror or error}")
        sys.exit(EXIT_REFUSED)
