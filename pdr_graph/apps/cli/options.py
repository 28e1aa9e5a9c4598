"""Arguments and options of several commands, each declared once.

A command takes a group of them as one parameter, a dataclass whose fields are the options; `with_groups` tells typer.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from pdr_graph.errors import SILENT, InputError
from pdr_graph.whole_files import LAST, check_replaceable

if TYPE_CHECKING:
    from pdr_graph.walk import Options

RecordingPath = Annotated[
    Path, typer.Argument(metavar="RECORDING", help="A recording: file, folder or zip of a supported recorder.")
]
WalkerPath = Annotated[
    Path | None, typer.Option("--walker", metavar="TOML", help="The walker: height, stride model, profile.")
]
Height = Annotated[
    float | None,
    typer.Option(
        "--height",
        metavar="METRES",
        help="Height of the walker, by which steps are longer; default: of --walker, else 1.70.",
    ),
]
MapPath = Annotated[Path | None, typer.Option("--map", metavar="PLAN", help="A floor plan; results are in its frame.")]
PlanScale = Annotated[
    float | None,
    typer.Option("--scale", metavar="METRES", help="Metres per unit of a drawn plan, or per pixel of a picture."),
]
OutFolder = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="Output folder; default: here, named after the recording."),
]
FixesPath = Annotated[
    Path | None,
    typer.Option(
        "--fixes", metavar="FILE", help="CSV time,x,y,sigma or time,lat,lon,sigma[,floor][,source], GPX or GeoLife."
    ),
]
RecordedFixes = Annotated[
    bool,
    typer.Option(
        "--recorded-fixes/--no-recorded-fixes",
        help="Use the position fixes in the recording, or not; default: use them.",
        show_default=False,
    ),
]
Rate = Annotated[
    float | None,
    typer.Option(metavar="HZ", help="Rows per second of the trajectory files; default: CSV a row per step, TUM 60."),
]
FloorLabel = Annotated[
    str | None,
    typer.Option(metavar="LABEL", help="Where the walk begins, on a plan with several floors; default: by the fixes."),
]
StartHeading = Annotated[
    float | None,
    typer.Option(metavar="DEGREES", help="Direction of the first step, clockwise from north, or from the plan's +y."),
]
BeaconsPath = Annotated[
    Path | None,
    typer.Option(metavar="CSV", help="beacon,x,y or beacon,lat,lon; default: BLE_Locations.csv beside the log."),
]
RangesPath = Annotated[
    Path | None,
    typer.Option("--ranges", metavar="CSV", help="time,anchor,range[,sigma]; anchors by --beacons or the plan."),
]
TruthPath = Annotated[
    Path | None,
    typer.Option(
        "--truth",
        metavar="FILE",
        help="CSV time,x,y[,heading][,floor], or TUM; drawn and scored, not used by the estimate.",
    ),
]
PathsPath = Annotated[
    Path | None,
    typer.Option("--paths", metavar="FILE", help="Ways outdoors: an OpenStreetMap extract, GeoJSON lines, GPX routes."),
]
LearnedPath = Annotated[
    Path | None,
    typer.Option("--learned", metavar="ONNX", help="A network of your own: inertial samples to velocities; of smooth."),
]
RadioMapPath = Annotated[
    Path | None,
    typer.Option("--radio-map", metavar="FILE", help="Made by radio-map from earlier walks: fixes by Wi-Fi and BLE."),
]
GnssLatency = Annotated[
    float,
    typer.Option(
        metavar="SECONDS",
        help="Latency of the fixes in the recording, 0 to 3 s on phones; default: 0.",
        show_default=False,
    ),
]


def _set_numbers(context: typer.Context, given: list[str] | None) -> list[str]:
    """Set numbers of `pdr_graph.priors` until the command ends."""
    if not given:
        return []
    from pdr_graph.walk import settings_changed

    return context.with_resource(settings_changed(given))


Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        callback=_set_numbers,
        help="A number of docs/results/settings.md, as WALKER.pace=0.3, or a TOML file of them; repeatable.",
    ),
]


class Method(StrEnum):
    """Estimation methods."""

    graph = "graph"
    filter = "filter"
    rts = "rts"
    pdr = "pdr"


class Pairing(StrEnum):
    """How an estimate is paired with a sample of the truth."""

    linear = "linear"
    nearest = "nearest"


def lag_seconds(text: str) -> float | None:
    """The value of --lag [s]; None for an endless lag."""
    try:
        seconds = float("inf" if text.lower() == "none" else text)
    except ValueError:
        seconds = 0.0
    if not seconds > 0:
        raise InputError("--lag", "", text, "seconds above 0, inf or none")
    return None if seconds == float("inf") else seconds


def _silence(context: typer.Context, requested: bool) -> bool:
    """Print nothing but errors until the command ends, if `requested`."""
    if requested:
        token = SILENT.set(True)
        context.call_on_close(lambda: SILENT.reset(token))
    return requested


Quiet = Annotated[bool, typer.Option("--quiet", "-q", callback=_silence, help="Print nothing but errors.")]
AsJson = Annotated[
    bool, typer.Option("--json", callback=_silence, help="Print the numbers as one JSON object, and no other text.")
]
PictureFile = Annotated[Path, typer.Option("--out", metavar="PNG", help="File of the picture.")]
Report = Annotated[
    bool,
    typer.Option(
        "--report/--no-report",
        help="Write report.html, or everything but it; default: write it.",
        show_default=False,
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Write to --out even if it is a folder with other files.")]


@dataclass(frozen=True)
class WalkOptions:
    """The options of an estimate, as of `pdr_graph.walk.Options`, with the names of the command line."""

    map: MapPath = None
    scale: PlanScale = None
    fixes: FixesPath = None
    walker: WalkerPath = None
    height: Height = None
    recorded_fixes: RecordedFixes = True
    gnss_latency: GnssLatency = 0.0
    floor: FloorLabel = None
    start_heading: StartHeading = None
    beacons: BeaconsPath = None
    ranges: RangesPath = None
    radio_map: RadioMapPath = None
    paths: PathsPath = None
    learned: LearnedPath = None
    truth: TruthPath = None
    settings: Settings = None

    @property
    def files(self) -> list[Path]:
        """The files and folders that are given."""
        return [value for value in vars(self).values() if isinstance(value, Path)]

    def options(self, **more: Any) -> Options:
        """The options of the estimate. more: further ones, by name."""
        from pdr_graph.walk import Options

        values = {field.name: getattr(self, field.name) for field in fields(self)}
        changed = tuple(values.pop("settings") or ())
        return Options(plan=values.pop("map"), settings=changed, **values, **more)


@dataclass(frozen=True)
class OutputOptions:
    """Where the files of a walk go, and what is printed."""

    out: OutFolder = None
    report: Report = True
    force: Force = False
    quiet: Quiet = False
    json: AsJson = False

    def folder(self, recording: Path, ending: str, given: Sequence[Path] = ()) -> Path:
        """The output folder. Raises InputError if it has files that pdr-graph did not write, unless forced.

        ending: of its name after the recording's, without ``--out``; given: other inputs, which may lie in it.
        """
        folder = self.out or path_named_after(recording, ending)
        check_replaceable(folder, LAST, self.force, [recording, *given])
        return folder


def path_named_after(recording: Path, ending: str) -> Path:
    """A path in the current folder, named after a recording: walk-smoothed for walk.zip."""
    path = recording.resolve()
    return Path(f"{path.name if path.is_dir() else path.stem}{ending}")


def with_groups(command: Callable[..., None]) -> Callable[..., None]:
    """A command whose parameters of a dataclass are replaced by its fields, one option each, as typer reads them."""
    hints = get_type_hints(command, include_extras=True)
    parameters, groups = [], {}
    for parameter in inspect.signature(command).parameters.values():
        hint = hints[parameter.name]
        if not is_dataclass(hint):
            parameters.append(parameter.replace(annotation=hint, kind=parameter.KEYWORD_ONLY))
            continue
        types = get_type_hints(hint, include_extras=True)
        groups[parameter.name] = hint, [field.name for field in fields(hint)]
        parameters += [
            inspect.Parameter(field.name, parameter.KEYWORD_ONLY, default=field.default, annotation=types[field.name])
            for field in fields(hint)
        ]

    @wraps(command)
    def grouped(**values: Any) -> None:
        made = {name: kind(**{of: values.pop(of) for of in names}) for name, (kind, names) in groups.items()}
        command(**values, **made)

    grouped.__signature__ = inspect.Signature(parameters)  # pyright: ignore[reportAttributeAccessIssue] typer reads it
    grouped.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return grouped
