"""What walks teach: ``pdr-graph calibrate``, of one along a known line; ``pdr-graph radio-map``, of several."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pdr_graph.apps.cli.options import Height, Quiet, RecordingPath, WalkerPath
from pdr_graph.apps.cli.terminal import echo
from pdr_graph.errors import InputError, one_line

if TYPE_CHECKING:
    from pdr_graph.estimation.fingerprinting import RadioMap
    from pdr_graph.gait.walker import Profile, Walker


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
    from pdr_graph.gait.walker import COEFFICIENTS
    from pdr_graph.walk import Options

    profile, laps = calibrate_walker(recording, route, out, Options(walker=walker, height=height).person())
    sigma = profile.covariance.diagonal() ** 0.5
    columns = zip(COEFFICIENTS, ("", " rad/m", ""), sigma, strict=True)
    values = ", ".join(f"{name} {getattr(profile, name):+.4f} ± {s:.4f}{unit}" for name, unit, s in columns)
    echo(f"{laps} x the route, rms distance {profile.residual:.2f} m: {values} -> {out}")


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


def calibrate_walker(recording: Path, route: Path, out: Path, walker: Walker | None = None) -> tuple[Profile, int]:
    """Write the profile of a walker who followed a known line to ``out``, with a picture beside it.

    Returns the profile and the number of laps. Raises InputError if an input cannot be used.
    """
    import numpy as np

    from pdr_graph.apps.report.plotting import picture_bytes, plot
    from pdr_graph.estimation.calibration import calibrate as fit
    from pdr_graph.floor.plan_files import read_route
    from pdr_graph.gait.steps import detect_steps
    from pdr_graph.gait.walker import Walker
    from pdr_graph.io.loading import load
    from pdr_graph.types import Trajectory
    from pdr_graph.whole_files import write_file

    walk, person = load(recording), walker or Walker()
    if walk.gyroscope is None:
        raise InputError(recording, "gyroscope", "no samples", "its turns, to tell them from the route's")
    steps = detect_steps(walk, replace(person, profile=None))
    line = read_route(route)
    profile, estimate, laps = fit(steps, line, walk.source)
    reference = Trajectory(np.arange(float(len(line))), line, np.zeros(len(line)), ("",) * len(line))
    title = f"{walk.source} along {route.name}   {profile.residual:.2f} m from it (rms)"
    picture = picture_bytes(plot(replace(estimate, reports={}), truth=reference, title=title))
    write_file(out.with_suffix(".png"), picture)
    replace(person, profile=profile).save(out, f"{walk.source} along {route.name}, {laps} times")
    return profile, laps


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
