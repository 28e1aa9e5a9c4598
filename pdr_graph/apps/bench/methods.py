"""The methods of ``bench`` and ``compare``: ours by name, a function of one's own, or a command that writes TUM."""

from __future__ import annotations

import shlex
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pdr_graph.apps.bench.data_sets import function_of
from pdr_graph.apps.replay import Latency, events_within, navigator_of, walked
from pdr_graph.errors import InputError, one_line
from pdr_graph.estimation.particle_filter import particle_filter
from pdr_graph.geometry import row_times
from pdr_graph.io.tables import read_trajectory
from pdr_graph.io.writers import write_steps
from pdr_graph.online.navigator import Navigator
from pdr_graph.options import LIVE, Options
from pdr_graph.types import Trajectory
from pdr_graph.walk import Evidence, Result, estimate, observe, read

Method = Callable[[Evidence], Trajectory]
LONGEST_COMMAND = 600.0  # [s] for a command
ESTIMATES = ("graph", "filter", "rts", "pdr")  # methods of `walk.estimate`, which has a verdict


def result_of(name: str, evidence: Evidence) -> Result:
    """The result of ``walk.estimate`` by one of ESTIMATES."""
    return estimate(replace(evidence, options=replace(evidence.options, method=name)))


def by_name(name: str, evidence: Evidence) -> Trajectory:
    """The trajectory of one of ESTIMATES."""
    return result_of(name, evidence).estimate.trajectory


def with_verdict(name: str, method: Method, evidence: Evidence) -> tuple[Trajectory, str, Callable[[], Trajectory]]:
    """The trajectory of a method, the state of its verdict, "" if it states none, and a function that returns the walk.

    The walk is the trajectory, or of current poses the walk smoothed at its end: where the direction is not known the
    pose is the mean of all directions, and does not move.
    """
    if name in ESTIMATES:
        result = result_of(name, evidence)
        return result.estimate.trajectory, result.verdict.state, lambda: result.estimate.trajectory
    if method is live:
        track, navigator = _lived(evidence)
        return track, "", lambda: navigator.finish().trajectory
    track = method(evidence)
    return track, "", lambda: track


def live(evidence: Evidence) -> Trajectory:
    """The current poses of the navigator: each from earlier data only."""
    return _lived(evidence)[0]


def _lived(evidence: Evidence) -> tuple[Trajectory, Navigator]:
    """The current poses, and the navigator after the last."""
    evidence = replace(evidence, options=replace(evidence.options, method=LIVE))
    navigator = navigator_of(evidence.options, evidence)()
    return walked(navigator, events_within(evidence)[0], Latency()), navigator


def particles(evidence: Evidence) -> Trajectory:
    """Mean and covariance of the paths of a particle filter between the walls of the plan."""
    graph = evidence.graph()
    if graph is None or graph.floor is None or not graph.positions.used.any():
        raise InputError(evidence.walk.source, "", "no steps, no plan or no fix", "those, for a particle filter")
    paths = particle_filter(graph)
    mean = paths.state[:, :3] @ paths.weight
    mean[:, 2] = np.angle(np.exp(1j * paths.state[:, 2]) @ paths.weight)
    off = paths.state[:, :3] - mean[:, :, None]
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    covariance = np.einsum("kin,kjn,n->kij", off, off, paths.weight)
    rows = np.minimum(np.searchsorted(row_times(graph.steps), graph.chain.time), len(graph.floors) - 1)
    floors = tuple(graph.floors[row] for row in rows.tolist())
    return Trajectory(graph.chain.time, mean[:, :2], mean[:, 2], floors, covariance)


OURS: Mapping[str, Method] = {
    **{name: partial(by_name, name) for name in ESTIMATES},
    "particles": particles,
    "live": live,
}


def method_of(name: str, commands: Mapping[str, str] | None = None) -> Method:
    """The method of a name: one of OURS, of the commands, or ``module:function``. Raises InputError if there is none.

    A function gets the evidence, as ``walk.observe`` returns it (``walk``, ``steps``, ``fixes``, ``headings``,
    ``building``), and returns a `Trajectory`, or rows ``(n, 3)`` of time [s], x and y [m].
    """
    if name in OURS:
        return OURS[name]
    if commands and name in commands:
        return partial(by_command, commands[name])
    if ":" not in name:
        raise InputError("methods", "", repr(name), f"one of {', '.join(OURS)}, of [commands], or module:function")
    own = function_of(name, "methods")
    return lambda evidence: _checked(own(evidence), name)


def estimated(
    names: Sequence[str], recording: Path | None, options: Options
) -> tuple[dict[str, Trajectory], Trajectory | None, dict[str, Any] | None]:
    """The trajectories of those names that are methods and no paths, the truth in the recording, and their frame.

    Truth and frame are None without methods, and the truth if the recording has none. All are on the recorder's clock
    and in the output frame, as the files of ``smooth``. Raises InputError for a method without a recording.
    """
    wanted = [name for name in names if (name in OURS or ":" in name) and not Path(name).exists()]
    if not wanted:
        return {}, None, None
    if recording is None:
        raise InputError(wanted[0], "", "a method, and no file of that name", "--recording, which it estimates")
    methods = {name: method_of(name) for name in wanted}
    evidence = observe(read(recording, options))

    def on_clock(track: Trajectory) -> Trajectory:
        return replace(track, time=track.time + evidence.walk.clock_origin)

    tracks = {name: on_clock(method(evidence)) for name, method in methods.items()}
    truth = None if evidence.truth is None else on_clock(evidence.truth)
    return tracks, truth, evidence.frame.describe()


def _checked(found: object, name: str) -> Trajectory:
    """A trajectory from what a method returned. Raises InputError if it is none."""
    if not isinstance(found, Trajectory):
        rows = np.asarray(found, dtype=float) if isinstance(found, np.ndarray | list | tuple) else np.empty(0)
        if rows.ndim != 2 or rows.shape[-1] != 3 or not len(rows):
            expected = "a Trajectory, or rows (n, 3) of time, x, y"
            raise InputError(name, "", f"{type(found).__name__} of shape {rows.shape}", expected)
        found = Trajectory(rows[:, 0], rows[:, 1:], np.full(len(rows), np.nan))
    if not (np.isfinite(found.time).all() and np.isfinite(found.position).all() and (np.diff(found.time) >= 0).all()):
        raise InputError(name, "", "NaN, or times out of order", "finite positions in order of time")
    return found


def by_command(command: str, evidence: Evidence) -> Trajectory:
    """The trajectory that a command writes to ``{out}``, as TUM or CSV, from the tables in the folder ``{folder}``."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_tables(evidence, folder)
        out = folder / "out.tum"
        words = [word.format(folder=folder, out=out) for word in shlex.split(command)]
        try:
            ended = subprocess.run(words, capture_output=True, text=True, timeout=LONGEST_COMMAND, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise InputError(command, "", one_line(str(error)), "a command that runs and ends") from None
        if ended.returncode or not out.exists():
            said = ended.stderr.strip().splitlines()[-1:] or [f"exit code {ended.returncode}"]
            raise InputError(command, "", one_line(said[0]), f"a trajectory in {{out}}, here {out.name}")
        return read_trajectory(out)


def write_tables(evidence: Evidence, folder: Path) -> None:
    """Write the samples (``accelerometer.csv``, …: time,x,y,z; barometer: time,value), steps and fixes of a walk."""
    for sensor, signal in evidence.walk.signals.items():
        values = np.column_stack([signal.time, signal.values])
        header = "time,x,y,z" if values.shape[1] == 4 else "time,value"
        np.savetxt(folder / f"{sensor}.csv", values, "%.6f", ",", header=header, comments="")
    if evidence.steps is not None:
        write_steps(folder / "steps.csv", evidence.steps, 0.0)
    fixes = np.column_stack([evidence.fixes.time, evidence.fixes.position, evidence.fixes.sigma])
    np.savetxt(folder / "fixes.csv", fixes, "%.6f", ",", header="time,x,y,sigma", comments="")
