"""Arguments and options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

RecordingPath = Annotated[
    Path, typer.Argument(metavar="RECORDING", help="A recording: file, folder or zip of a supported recorder.")
]
WalkerPath = Annotated[Path | None, typer.Option("--walker", metavar="TOML", help="What is known of the walker.")]
MapPath = Annotated[Path | None, typer.Option("--map", metavar="PLAN", help="A floor plan; its frame is the output's.")]
OutFolder = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="Where results go; default: here, named after the recording."),
]
FixesPath = Annotated[
    Path | None,
    typer.Option("--fixes", metavar="CSV", help="time,x,y,sigma[,floor] or time,lat,lon,sigma[,floor]."),
]
RecordedFixes = Annotated[
    bool, typer.Option("--recorded-fixes/--no-recorded-fixes", help="Use positions inside the recording too.")
]
Rate = Annotated[float | None, typer.Option(metavar="HZ", help="Resample the trajectory; default: a row per step.")]
FloorLabel = Annotated[
    str | None,
    typer.Option(metavar="LABEL", help="Where the walk begins, of a plan with several; default: as fixes say."),
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
    typer.Option("--truth", metavar="CSV", help="time,x,y[,heading][,floor], drawn and scored; no estimate sees it."),
]
RadioMapPath = Annotated[
    Path | None,
    typer.Option("--radio-map", metavar="FILE", help="What earlier walks heard where: fixes by Wi-Fi and BLE."),
]
GnssLatency = Annotated[
    float, typer.Option(metavar="S", min=-60, max=60, help="How late the phone's own positions are, 0–3 s.")
]
