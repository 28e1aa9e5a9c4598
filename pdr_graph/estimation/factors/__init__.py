"""The measurement kinds of the package: one file and one class each, registered here."""

from __future__ import annotations

from typing import TypeAlias

from pdr_graph.estimation.factors.beacon_rssi import BeaconRssiFactor, LevelCollector
from pdr_graph.estimation.factors.corridors import CorridorFactor, PathFactor, TurnFactor
from pdr_graph.estimation.factors.fixes import FixFactor
from pdr_graph.estimation.factors.gnss_bias import GnssBias
from pdr_graph.estimation.factors.gyro_drift import DriftFactor
from pdr_graph.estimation.factors.heading_prior import HeadingFactor
from pdr_graph.estimation.factors.learned_velocity import LearnedVelocityFactor
from pdr_graph.estimation.factors.loop_closure import LoopClosureFactor
from pdr_graph.estimation.factors.ranging import RangeFactor
from pdr_graph.estimation.factors.registry import COLLECTORS, ON_PLAN, RESERVED, WAYS_OUTDOORS, register
from pdr_graph.estimation.factors.start import CalibrationFactor, StartFactor
from pdr_graph.estimation.factors.steps_and_walls import StepFactor, WallFactor
from pdr_graph.estimation.factors.untimed_fixes import UntimedFixFactor
from pdr_graph.gait.learned import Velocities
from pdr_graph.types import Beacons, Closures, Drifts, Fixes, Headings, Levels, Ranges, UntimedFixes

ON_PLAN |= {"directions": CorridorFactor, "turns": TurnFactor, WAYS_OUTDOORS: PathFactor}
RESERVED |= {kind.name for kind in (StepFactor, WallFactor, CorridorFactor, PathFactor, CalibrationFactor, StartFactor)}
COLLECTORS |= {Beacons: LevelCollector}
register(Fixes, FixFactor, GnssBias)
register(Headings, HeadingFactor)
register(Drifts, DriftFactor)
register(Levels, BeaconRssiFactor)
register(Closures, LoopClosureFactor)
register(Ranges, RangeFactor)
register(UntimedFixes, UntimedFixFactor)
register(Velocities, LearnedVelocityFactor)

# What fixes, headings and ways outdoors are in a graph, which starts from them and follows these
Positions: TypeAlias = FixFactor
Directions: TypeAlias = HeadingFactor
Ways: TypeAlias = PathFactor
