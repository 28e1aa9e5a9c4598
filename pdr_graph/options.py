"""Options of an estimate: what each command of the command line reads, and what `pdr_graph.walk` runs.

The command line takes name, type, default and help of an option from the field and the docstring below it, so that
this module imports nothing that takes long.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pdr_graph.errors import InputError

if TYPE_CHECKING:
    from pdr_graph.gait.walker import Walker

FASTEST_OUTPUT = 1000.0  # [Hz] largest rate of output rows
LARGEST_LATENCY = 60.0  # [s]
SHORTEST_WALKER, TALLEST_WALKER = 0.5, 2.8  # [m] height of a walker
LIVE = "live"  # the method of a navigator
LIVE_ONLY = ("lag", "journal")  # options of that method alone


@dataclass(frozen=True)
class Options:
    """Options of an estimate, and its input files beside the recording; the defaults of every command.

    settings: for the record: the command line has set these numbers, and in Python `pdr_graph.priors.changed` does.
    """

    plan: Path | None = None
    """A floor plan; results are in its frame."""
    scale: float | None = None
    """Metres per unit of a drawn plan, or per pixel of a picture [m]."""
    fixes: Path | None = None
    """Positions: CSV time,x,y,sigma or time,lat,lon,sigma[,floor][,source], GPX or GeoLife."""
    beacons: Path | None = None
    """Surveyed beacons: CSV beacon,x,y or beacon,lat,lon; default: BLE_Locations.csv beside the recording, else those
    on the plan."""
    ranges: Path | None = None
    """Ranges to anchors: CSV time,anchor,range[,sigma]; the anchors are those of --beacons, else those on the plan."""
    visited: Path | None = None
    """Places visited at unknown times: CSV of place (a name on the plan), x,y or lat,lon [,earliest,latest][,sigma];
    of the graph alone."""
    paths: Path | None = None
    """Ways outdoors: an OpenStreetMap extract, GeoJSON lines, GPX routes."""
    learned: Path | None = None
    """An ONNX network of your own, from inertial samples to velocities (see gait.learned); of the graph alone."""
    radio_map: Path | None = None
    """Made by radio-map from earlier walks: fixes by Wi-Fi and BLE."""
    walker: Path | None = None
    """The walker: TOML of height, stride model and profile."""
    height: float | None = None
    """Height of the walker, by which steps are longer [m]; default: that of --walker, else 1.70."""
    truth: Path | None = None
    """The true trajectory: CSV time,x,y[,heading][,floor], or TUM; drawn and scored, not used by the estimate."""
    method: str = "graph"
    """`graph`, `filter`, `rts`, `pdr`, or `live` (the navigator of `replay`)."""
    recorded_fixes: bool = True
    """Use the position fixes in the recording, or not; default: use them."""
    rate: float | None = None
    """Rows per second of the trajectory files [Hz]; default: CSV a row per step, TUM 60."""
    gnss_latency: float = 0.0
    """Latency of the fixes in the recording [s], 0 to 3 on phones."""
    floor: str | None = None
    """Label of the floor where the walk begins, on a plan with several floors; default: by the fixes."""
    start_heading: float | None = None
    """Direction of the first step, clockwise from north, or from +y in a frame without latitude [deg]."""
    lag: float | None = 60.0
    """Finalise steps older than this [s]; inf or none: never."""
    journal: Path | None = None
    """Save the live walk in this file, or resume the walk in it."""
    settings: tuple[str, ...] = ()
    """A number of docs/results/settings.md, as WALKER.pace=0.3, or a TOML file of them; repeatable."""

    def __post_init__(self) -> None:
        """Raise InputError if a number is out of range. An infinite lag becomes None."""
        if self.rate is not None and not 0 < self.rate <= FASTEST_OUTPUT:
            raise InputError("--rate", "", f"{self.rate}", f"a rate above 0 and up to {FASTEST_OUTPUT:.0f} Hz")
        if self.start_heading is not None and not abs(self.start_heading) <= 360:
            expected = "degrees clockwise from north, -360 to 360"
            raise InputError("--start-heading", "", f"{self.start_heading}", expected)
        if not abs(self.gnss_latency) <= LARGEST_LATENCY:
            hint = " (milliseconds?)" if LARGEST_LATENCY < abs(self.gnss_latency) <= 1000 * LARGEST_LATENCY else ""
            expected = f"seconds from -{LARGEST_LATENCY:.0f} to {LARGEST_LATENCY:.0f}"
            raise InputError("--gnss-latency", "", f"{self.gnss_latency}{hint}", expected)
        if self.height is not None and not SHORTEST_WALKER <= self.height <= TALLEST_WALKER:
            hint = " (centimetres?)" if 100 * SHORTEST_WALKER <= self.height <= 100 * TALLEST_WALKER else ""
            expected = f"metres from {SHORTEST_WALKER} to {TALLEST_WALKER}"
            raise InputError("--height", "", f"{self.height}{hint}", expected)
        if self.lag is not None and not self.lag > 0:
            raise InputError("--lag", "", f"{self.lag}", "seconds above 0, inf or none")
        if self.lag == float("inf"):
            object.__setattr__(self, "lag", None)

    @property
    def files(self) -> list[Path]:
        """The files and folders that are given."""
        return [value for value in vars(self).values() if isinstance(value, Path)]

    def person(self) -> Walker:
        """The walker. Raises InputError if the file cannot be used."""
        from pdr_graph.gait.walker import Walker

        walker = Walker.load(self.walker) if self.walker else Walker()
        return walker if self.height is None else replace(walker, height=self.height)

    def describe(self) -> dict[str, Any]:
        """Return the options for `summary.json`, with the names of the command line."""
        names = [field.name for field in fields(self) if self.method == LIVE or field.name not in LIVE_ONLY]
        values = {"map" if name == "plan" else name: getattr(self, name) for name in names}
        return {name: str(value) if isinstance(value, Path) else value for name, value in values.items()}
