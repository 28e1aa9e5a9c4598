"""The options of an estimate, and which files belong to it; this module loads at once, before any other is needed."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pdr_graph.errors import InputError

if TYPE_CHECKING:
    from pdr_graph.gait.walker import Walker

FASTEST_RATE = 1000.0  # [Hz] largest rate of output rows
LARGEST_LATENCY = 60.0  # [s]
SHORTEST, TALLEST = 0.5, 2.8  # [m] height of a walker
LIVE = "live"  # the method of a navigator
LIVE_ONLY = ("lag", "journal")  # options of that method alone


@dataclass(frozen=True)
class Options:
    """Options of an estimate, and its input files beside the recording; the defaults of every command."""

    plan: Path | None = None
    """Floor plan; its frame is the output's."""
    scale: float | None = None
    """Metres per unit of the plan, for a drawing or a picture that does not state it [m]."""
    fixes: Path | None = None
    """CSV of positions, `time,x,y,sigma[,floor]` or `time,lat,lon,sigma[,floor]`."""
    beacons: Path | None = None
    """CSV of surveyed beacons; default: the list beside the recording, else the plan's."""
    ranges: Path | None = None
    """CSV of ranges to anchors, `time,anchor,range[,sigma]`; their places are those of `beacons`, else the plan's."""
    radio_map: Path | None = None
    """Radio map of earlier walks, as `pdr-graph radio-map` writes it."""
    walker: Path | None = None
    """TOML of the walker's height, stride and profile."""
    height: float | None = None
    """Height of the walker [m]; None: that of `walker`."""
    truth: Path | None = None
    """CSV of the true trajectory, for drawings and scores only."""
    method: str = "graph"
    """`graph`, `filter`, `rts`, `pdr`, or `live` (the navigator of `replay`)."""
    recorded_fixes: bool = True
    """Also use positions inside the recording."""
    rate: float | None = None
    """Rows of the trajectory per second [Hz]; None: a row per step."""
    gnss_latency: float = 0.0
    """Delay of the phone's own positions [s]."""
    floor: str | None = None
    """Label of the floor on which the walk begins; None: as the fixes say."""
    start_heading: float | None = None
    """Direction of the first step, clockwise from north (from +y in a frame without latitude) [deg]."""
    lag: float | None = 60.0
    """Time after which a live navigator finalizes a step [s]; None: never."""
    journal: Path | None = None
    """File that stores a live walk, and from which it is resumed."""

    def __post_init__(self) -> None:
        """Raise InputError if a number is out of range."""
        if self.rate is not None and not 0 < self.rate <= FASTEST_RATE:
            raise InputError("--rate", "", f"{self.rate}", f"a rate above 0 and up to {FASTEST_RATE:.0f} Hz")
        if self.start_heading is not None and not abs(self.start_heading) <= 360:
            expected = "degrees clockwise from north, -360 to 360"
            raise InputError("--start-heading", "", f"{self.start_heading}", expected)
        if not abs(self.gnss_latency) <= LARGEST_LATENCY:
            hint = " (milliseconds?)" if LARGEST_LATENCY < abs(self.gnss_latency) <= 1000 * LARGEST_LATENCY else ""
            expected = f"seconds from -{LARGEST_LATENCY:.0f} to {LARGEST_LATENCY:.0f}"
            raise InputError("--gnss-latency", "", f"{self.gnss_latency}{hint}", expected)
        if self.height is not None and not SHORTEST <= self.height <= TALLEST:
            hint = " (centimetres?)" if 100 * SHORTEST <= self.height <= 100 * TALLEST else ""
            expected = f"metres from {SHORTEST} to {TALLEST}"
            raise InputError("--height", "", f"{self.height}{hint}", expected)

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
