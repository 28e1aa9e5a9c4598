"""The nouns of a lifelog: a person's day, the outings in it, and what each is made of.

Times are seconds from an outing's ``epoch``, positions metres in its frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdr_graph.frames import Frame
from pdr_graph.gait.profile import Profile
from pdr_graph.types import Array, Trajectory

WALKING, STANDING, VEHICLE, GAP = "walking", "standing", "vehicle", "gap"
KINDS = (STANDING, WALKING, VEHICLE, GAP)  # numbered as in `estimation.positions`


@dataclass(frozen=True)
class Segment:
    """A stretch of an outing in which one thing was done; segments follow one another without holes.

    kind: one of KINDS; a gap is what nobody recorded. start, end: [s]. distance: gone along the way [m], 0 of a stretch
    of standing, and of a gap, of which nobody knows it.
    """

    kind: str
    start: float
    end: float
    distance: float


@dataclass(frozen=True)
class Stay:
    """A time at one place, or a slow pass by it.

    start, end: [s]; passing: True of a slow pass; position ``(2,)`` [m] with its covariance ``(2, 2)`` [m²]; heading:
    which way the person faced [rad], NaN where unknown; floor: the plan's label, empty where unknown.
    facing: what it may have been of that was looked at, with probabilities, the most probable first; what they lack
    to 1 is of nothing that the plan names. Empty without a plan.
    """

    start: float
    end: float
    passing: bool
    position: Array
    covariance: Array
    heading: float
    floor: str
    facing: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class Outing:
    """Recordings of one person, one after the other in one frame, as one walk.

    recordings: their content hashes, in order; source: what a message calls it; epoch: Unix time at 0 [s].
    frame: of all positions; plan: path of the floor plan, "" without one.
    trajectory: with covariance, as of ``Estimate``; segments: of all its time; stays: in order of time.
    steps: how many. notes: what a user must know; missing: what could not be estimated, a line each.
    """

    recordings: tuple[str, ...]
    source: str
    epoch: float
    frame: Frame
    plan: str
    trajectory: Trajectory
    segments: tuple[Segment, ...]
    stays: tuple[Stay, ...]
    steps: int
    notes: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()


@dataclass(frozen=True)
class Day:
    """What a person did between two midnights, by the outings that began then.

    date: "2024-05-01", in the lifelog's time zone; profile: what is known of the walker at its end, None if nothing.
    """

    person: str
    date: str
    outings: tuple[Outing, ...]
    profile: Profile | None = None

    def total(self, kind: str) -> tuple[float, float]:
        """Time [s] and distance [m] of all segments of one kind."""
        own = [s for outing in self.outings for s in outing.segments if s.kind == kind]
        return float(np.sum([s.end - s.start for s in own])), float(np.sum([s.distance for s in own]))
