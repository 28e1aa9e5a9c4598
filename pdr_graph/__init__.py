"""pdr_graph: a factor-graph smoothing backend for pedestrian dead reckoning.

The public names, loaded when first used, so that the command line answers at once.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pdr_graph.errors import InputError as InputError
    from pdr_graph.estimation.filters import kalman_filter as kalman_filter
    from pdr_graph.estimation.floors import floors_of as floors_of
    from pdr_graph.estimation.graph import Prior as Prior
    from pdr_graph.estimation.graph import WalkGraph as WalkGraph
    from pdr_graph.estimation.rts import kalman_smoother as kalman_smoother
    from pdr_graph.estimation.smoothers import smooth as smooth
    from pdr_graph.evaluation import evaluate as evaluate
    from pdr_graph.floor.building import Building as Building
    from pdr_graph.floor.plan import FloorPlan as FloorPlan
    from pdr_graph.gait.heading import magnetic_headings as magnetic_headings
    from pdr_graph.gait.pdr import detect_steps as detect_steps
    from pdr_graph.gait.walker import Walker as Walker
    from pdr_graph.geometry import dead_reckon as dead_reckon
    from pdr_graph.io import load as load
    from pdr_graph.io.tables import read_fixes as read_fixes
    from pdr_graph.io.tables import read_trajectory as read_trajectory
    from pdr_graph.online.events import Samples as Samples
    from pdr_graph.online.events import Scan as Scan
    from pdr_graph.online.events import events_of as events_of
    from pdr_graph.online.navigator import Navigator as Navigator
    from pdr_graph.plotting import plot as plot
    from pdr_graph.types import Calibration as Calibration
    from pdr_graph.types import Estimate as Estimate
    from pdr_graph.types import Fixes as Fixes
    from pdr_graph.types import Headings as Headings
    from pdr_graph.types import Recording as Recording
    from pdr_graph.types import Steps as Steps
    from pdr_graph.types import Trajectory as Trajectory

_HOME = {
    "InputError": "errors",
    "kalman_filter": "estimation.filters",
    "kalman_smoother": "estimation.rts",
    "Prior": "estimation.graph",
    "WalkGraph": "estimation.graph",
    "smooth": "estimation.smoothers",
    "evaluate": "evaluation",
    "floors_of": "estimation.floors",
    "Building": "floor.building",
    "FloorPlan": "floor.plan",
    "magnetic_headings": "gait.heading",
    "Walker": "gait.walker",
    "detect_steps": "gait.pdr",
    "dead_reckon": "geometry",
    "load": "io",
    "read_fixes": "io.tables",
    "read_trajectory": "io.tables",
    "Navigator": "online.navigator",
    "Samples": "online.events",
    "Scan": "online.events",
    "events_of": "online.events",
    "plot": "plotting",
    "Calibration": "types",
    "Estimate": "types",
    "Fixes": "types",
    "Headings": "types",
    "Recording": "types",
    "Steps": "types",
    "Trajectory": "types",
}
__all__ = [
    "Building",
    "Calibration",
    "Estimate",
    "Fixes",
    "FloorPlan",
    "Headings",
    "InputError",
    "Navigator",
    "Prior",
    "Recording",
    "Samples",
    "Scan",
    "Steps",
    "Trajectory",
    "WalkGraph",
    "Walker",
    "dead_reckon",
    "detect_steps",
    "evaluate",
    "events_of",
    "floors_of",
    "kalman_filter",
    "kalman_smoother",
    "load",
    "magnetic_headings",
    "plot",
    "read_fixes",
    "read_trajectory",
    "smooth",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'pdr_graph' has no attribute {name!r}")
    return getattr(import_module(f"pdr_graph.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
