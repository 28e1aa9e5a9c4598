"""Arguments and options of several commands."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from pdr_graph.errors import InputError

RecordingPath = Annotated[
    Path, typer.Argument(metavar="RECORDING", help="A recording: file, folder or zip of a supported recorder.")
]
WalkerPath = Annotated[
    Path | None, typer.Option("--walker", metavar="TOML", help="The walker: height, stride model, profile.")
]
MapPath = Annotated[Path | None, typer.Option("--map", metavar="PLAN", help="A floor plan; results are in its frame.")]
PlanScale = Annotated[
    float | None,
    typer.Option("--scale", metavar="M", help="Metres per unit of a drawn plan, or per pixel of a picture."),
]
OutFolder = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="Output folder; default: here, named after the recording."),
]
FixesPath = Annotated[
    Path | None,
    typer.Option("--fixes", metavar="CSV", help="time,x,y,sigma[,floor] or time,lat,lon,sigma[,floor]."),
]
RecordedFixes = Annotated[
    bool, typer.Option("--recorded-fixes/--no-recorded-fixes", help="Also use the position fixes in the recording.")
]
Rate = Annotated[float | None, typer.Option(metavar="HZ", help="Resample the trajectory; default: a row per step.")]
FloorLabel = Annotated[
    str | None,
    typer.Option(metavar="LABEL", help="Where the walk begins, on a plan with several floors; default: by the fixes."),
]
StartHeading = Annotated[
    float | None,
    typer.Option(metavar="DEG", help="Direction of the first step, clockwise from north, or from the plan's +y."),
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
        "--truth", metavar="CSV", help="time,x,y[,heading][,floor]; drawn and scored, not used by the estimate."
    ),
]
RadioMapPath = Annotated[
    Path | None,
    typer.Option("--radio-map", metavar="FILE", help="Made by radio-map from earlier walks: fixes by Wi-Fi and BLE."),
]
GnssLatency = Annotated[
    float, typer.Option(metavar="S", min=-60, max=60, help="Latency of the fixes in the recording, 0–3 s on phones.")
]


class Method(StrEnum):
    """Estimation methods."""

    graph = "graph"
    filter = "filter"
    rts = "rts"
    pdr = "pdr"


class Coordinates(StrEnum):
    """Coordinates of the positions of a competition."""

    lonlat = "lonlat"
    xy = "xy"


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
