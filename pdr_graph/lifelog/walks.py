"""An outing with steps: what its recordings tell in one frame, the most probable walk, and what it was made of."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from pdr_graph.estimation.beacons import Levels, levels
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.profiles import posterior_profile
from pdr_graph.floor.building import Building
from pdr_graph.frames import Frame
from pdr_graph.gait.gaps import SPEED
from pdr_graph.gait.profile import Profile
from pdr_graph.gait.treads import on_treads
from pdr_graph.gait.walker import Walker
from pdr_graph.lifelog.content import plan_hash
from pdr_graph.lifelog.day import Outing
from pdr_graph.lifelog.grouping import LONGEST_GAP, Group
from pdr_graph.lifelog.joining import Joined, joined
from pdr_graph.lifelog.places import stays_of
from pdr_graph.lifelog.rides import rides, without_rides
from pdr_graph.lifelog.segments import segments_of
from pdr_graph.pipeline import floors_walked, smoothed, walk_graph
from pdr_graph.types import INSTANT, Array, Estimate, Fixes, Steps


@dataclass(frozen=True)
class Walked:
    """A walk, estimated. profile: what was known of the walker beforehand; ridden: ``(r, 2)`` from when to when of
    rides [s]; missing: what could not be had of it.
    """

    group: Group
    profile: Profile | None
    joined: Joined
    building: Building | None
    ridden: Array
    graph: WalkGraph
    estimate: Estimate
    missing: tuple[str, ...]

    @property
    def looks(self) -> Array:
        """As of `Observation`, of the rows that are no ride."""
        old, new = self.joined.steps, self.graph.steps
        row = np.searchsorted(old.time, new.time - INSTANT)
        walked = (new.length > 0) & (np.abs(old.time[row] - new.time) <= INSTANT)
        return np.append(np.where(walked, self.joined.looks[row], 0.0), self.joined.looks[-1])

    @property
    def learnt(self) -> Profile | None:
        """What is known of the walker after it; a walk that taught nothing leaves them less well known than before."""
        calibration = self.estimate.calibration
        if calibration is None or not (self.profile is not None or calibration.learnt[-1, 0]):
            return self.profile
        return posterior_profile(self.estimate, self.graph.steps, self.profile)

    @cached_property
    def outing(self) -> Outing:
        """What the day has of it."""
        first, steps, track = self.group.parts[0][1], self.graph.steps, self.estimate.trajectory
        said = (line for one in self.group.observations for line in one.notes)
        return Outing(
            recordings=self.group.names,
            source=first.source,
            epoch=self.joined.epoch,
            frame=self.joined.frame,
            plan=first.plan,
            trajectory=track,
            segments=segments_of(steps, track, self.ridden),
            stays=stays_of(steps, track, self.building, self.looks),
            steps=int((steps.length > 0).sum()),
            notes=tuple(dict.fromkeys((*said, *self.group.notes, *self.estimate.warnings))),
            missing=(*steps.unknown, *self.missing),
        )


def walked(group: Group, before: Walked | Outing | None, profile: Profile | None, frame: Frame | None = None) -> Walked:
    """The most probable walk of recordings with steps.

    before: the outing before it on that day; profile: what is known of the walker; frame: on earth, if it is not to be
    the recordings' own. Raises InputError where the plan cannot be used.
    """
    # What was measured, in one frame
    first = group.parts[0][1]
    walk = _handed_over(before, joined(group.observations, [one for _, one in group.beside], frame))
    building, fixes = building_of(first.plan) if first.plan else None, walk.fixes

    # The steps of this walker, without what was ridden, on their floors
    steps = profile.corrected(walk.steps) if profile else walk.steps
    ridden = rides(steps, fixes)
    steps = without_rides(steps, ridden)
    floors = floors_walked(walk.barometer, steps, fixes, building, first.floor or None, Path(first.plan))
    if floors is not None:
        steps = on_treads(steps, floors.climbs, floors.kinds)

    # The most probable walk
    heard = _levels(walk, steps)
    graph = walk_graph(steps, fixes, walk.headings, building, floors, heard, Walker(profile=profile), walk.closures)
    estimate, missing = smoothed(graph)
    return Walked(group, profile, walk, building, ridden, graph, estimate, missing)


def building_of(plan: str) -> Building:
    """A plan, read once for all walks on it until its content changes."""
    return _read(plan, plan_hash(Path(plan)))


@lru_cache(maxsize=8)
def _read(plan: str, content: str) -> Building:
    return Building.load(plan)


def _handed_over(last: Walked | Outing | None, walk: Joined) -> Joined:
    """A walk without any position, begun not far from where the outing just before it ended."""
    if len(walk.fixes) or last is None:
        return walk
    before = last.outing if isinstance(last, Walked) else last
    if before.trajectory.covariance is None:
        return walk
    frame = walk.frame if walk.frame.georeferenced else before.frame
    gap = walk.epoch - (before.epoch + before.trajectory.time[-1])
    if gap > LONGEST_GAP or not (before.frame.georeferenced or before.frame == frame):
        return walk
    place = frame.from_frame(before.frame, before.trajectory.position[-1:])
    variance = np.trace(before.trajectory.covariance[-1, :2, :2]) / 2 + (SPEED * max(gap, 0.0)) ** 2
    fix = Fixes(np.zeros(1), place, np.array([np.sqrt(variance)]), (before.trajectory.floor[-1],))
    return replace(walk, frame=frame, fixes=fix)


def _levels(walk: Joined, steps: Steps) -> Levels | None:
    """How loud the surveyed beacons were along the walk."""
    if walk.bluetooth is None or walk.beacons is None:
        return None
    return levels(walk.bluetooth, walk.beacons, steps)
