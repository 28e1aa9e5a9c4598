"""A replay as a recording of Rerun, which its viewer follows while it is written: ``replay --rerun walk.rrd``.

Axes are those of the output frame, x and y [m], with the height of the floor [m] as z. Rerun has single precision, so
that whole kilometres are subtracted, as `map/origin` states. `walk` is the time from the start of the recording [s].
Source: rerun.io, logging and ingestion.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from pdr_graph.apps.report.page import plan_layers
from pdr_graph.errors import InputError, install
from pdr_graph.geometry import horizontal_sigma
from pdr_graph.types import Array, Fixes, Trajectory

if TYPE_CHECKING:
    from pdr_graph.floor.building import Building
    from pdr_graph.online.interface import LiveEstimator, Pose

PATH_PERIOD = 10.0  # [s] between two smoothed paths: each is logged as a whole
ENDING = ".rrd"


class RerunView:
    """The file of a replay. fixes: those that come, in the output frame.

    Raises InputError without rerun-sdk, and for a file that cannot be written.
    """

    def __init__(self, file: Path, building: Building | None, fixes: Fixes):
        try:
            import rerun
        except ImportError:
            raise InputError("--rerun", "", "no rerun-sdk", install("rerun")) from None
        if file.suffix != ENDING or not file.parent.is_dir():
            raise InputError("--rerun", "", str(file), f"a file {ENDING} in a folder that exists")
        self._rr, self._log = rerun, rerun.RecordingStream("pdr_graph", recording_id=file.stem)
        self._log.save(file)
        self._heights = {} if building is None else {floor.label: floor.height for floor in building.floors}
        self._fixes, self._shown, self._next_path = fixes[np.argsort(fixes.time, kind="stable")], 0, -np.inf
        near = fixes.position if building is None else building.corners
        self._origin = np.round(near[0], -3) if len(near) else np.zeros(2)
        self._log.log("map/origin", rerun.AnyValues(x=self._origin[0], y=self._origin[1]), static=True)
        self._log.log("map", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for floor in () if building is None else building.floors:
            lines = [part for layer in plan_layers(floor) if layer.name != "ground" for part in _lines(layer.shape)]
            strips = [self._raised(line, floor.label) for line in lines]
            drawn = rerun.LineStrips3D(strips, colors=[120, 120, 120], radii=0.03)
            self._log.log(["map", "plan", floor.label], drawn, static=True)

    def show(self, nav: LiveEstimator, pose: Pose) -> None:
        """Log the pose, its region, heading and modes; fixes up to its time; now and then the smoothed path."""
        rr, label = self._rr, pose.floor
        while self._shown < len(self._fixes) and self._fixes.time[self._shown] <= pose.time:
            self._fix(self._shown, label)
            self._shown += 1
        self._log.set_time("walk", duration=pose.time)
        [here] = self._raised(np.array([[pose.x, pose.y]]), label)
        ahead = [2 * np.cos(pose.heading), 2 * np.sin(pose.heading), 0.0]  # 2 m
        self._log.log("map/pose", rr.Points3D([here], radii=0.4, colors=[220, 60, 40]))
        self._log.log("map/heading", rr.Arrows3D(origins=[here], vectors=[ahead], colors=[220, 60, 40]))
        region = [self._raised(line, label) for line in _lines(pose.region(0.9))]
        self._log.log("map/region", rr.LineStrips3D(region, colors=[220, 60, 40], radii=0.05))
        modes = self._raised(np.array([(mode.x, mode.y) for mode in pose.modes]).reshape(-1, 2), label)
        share = [mode.probability for mode in pose.modes]
        texts = [f"{part:.0%}" for part in share]
        self._log.log("map/modes", rr.Points3D(modes, radii=np.sqrt(share) / 2, labels=texts, colors=[230, 160, 40]))
        if pose.placed:
            self._log.log("sigma", rr.Scalars(float(horizontal_sigma(pose.covariance))))
        if pose.time >= self._next_path:
            self.path(nav.trajectory)
            self._next_path = pose.time + PATH_PERIOD

    def path(self, path: Trajectory) -> None:
        """Log the smoothed path at its end."""
        if not len(path):
            return
        self._log.set_time("walk", duration=float(path.time[-1]))
        heights = [self._heights.get(label, 0.0) for label in path.floor]
        line = np.column_stack([path.position - self._origin, heights])
        self._log.log("map/path", self._rr.LineStrips3D([line], colors=[40, 100, 220], radii=0.1))

    def close(self) -> None:
        """Complete the file."""
        self._log.flush()
        self._log.disconnect()

    def _fix(self, n: int, label: str) -> None:
        """Log a fix and the circle of its sigma."""
        fix, rr = self._fixes[n], self._rr
        self._log.set_time("walk", duration=float(fix.time[0]))
        places = self._raised(fix.position, label)
        circle = self._raised(shapely.get_coordinates(shapely.Point(fix.position[0]).buffer(fix.sigma[0])), label)
        self._log.log("map/fix", rr.Points3D(places, radii=0.3, colors=[40, 160, 80]))
        self._log.log("map/fix/sigma", rr.LineStrips3D([circle], colors=[40, 160, 80], radii=0.03))

    def _raised(self, position: Array, label: str) -> Array:
        """Points ``(n, 3)`` on a floor; those without one are on the ground."""
        return np.column_stack([position - self._origin, np.full(len(position), self._heights.get(label, 0.0))])


def _lines(shape: shapely.Geometry) -> list[Any]:
    """The coordinates ``(n, 2)`` of all rings and lines of a shape."""
    parts = shapely.get_parts(shape)
    edges = shapely.get_parts(shapely.boundary(parts[shapely.get_dimensions(parts) == 2]))
    lines = [*edges, *parts[shapely.get_dimensions(parts) == 1]]
    return [shapely.get_coordinates(line) for each in lines for line in shapely.get_parts(each)]
