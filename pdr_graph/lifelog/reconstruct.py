"""One person's day: observed recordings become outings, each the most probable walk and what it was made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from pdr_graph.estimation.calibration import posterior_profile
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.floor.building import Building
from pdr_graph.floor.formats import plan_fingerprint
from pdr_graph.frames import Frame
from pdr_graph.gait.steps import GAP_SPEED
from pdr_graph.gait.walker import Profile
from pdr_graph.lifelog.activities import follow_positions, rides, segments_of, without_rides
from pdr_graph.lifelog.day import Day, Outing
from pdr_graph.lifelog.observation import Observation
from pdr_graph.lifelog.sessions import LONGEST_GAP, Group, Joined, groups_of, is_located, joined, joined_fixes
from pdr_graph.lifelog.stays import stays_of, stays_of_positions
from pdr_graph.pipeline import Evidence, estimate, with_beacon_levels, with_floors, with_measurements
from pdr_graph.types import INSTANT, Array, Estimate, Fixes


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
        walked = ~new.is_gap & (np.abs(old.time[row] - new.time) <= INSTANT)
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
            steps=int((~steps.is_gap).sum()),
            notes=tuple(dict.fromkeys((*said, *self.group.notes, *self.estimate.warnings))),
            missing=self.missing,
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
    evidence = Evidence(without_rides(steps, ridden), fixes, walk.headings, building, profile=profile)
    evidence = with_measurements(evidence, (walk.closures, *walk.measurements))
    evidence = with_floors(evidence, walk.barometer, first.floor or None, Path(first.plan))
    evidence = with_beacon_levels(evidence, walk.bluetooth, walk.beacons)

    # The most probable walk
    result = estimate(evidence)
    assert result.graph is not None, "a walk has steps"
    return Walked(group, profile, walk, building, ridden, result.graph, result.estimate, result.missing)


def building_of(plan: str) -> Building:
    """A plan, read once for all walks on it until its content changes."""
    return _read(plan, plan_fingerprint(Path(plan)))


@lru_cache(maxsize=8)
def _read(plan: str, content: str) -> Building:
    return Building.load(plan)


def _handed_over(last: Walked | Outing | None, walk: Joined) -> Joined:
    """A walk without any position, begun not far from where the outing just before it ended."""
    if last is None or is_located(walk):
        return walk
    before = last.outing if isinstance(last, Walked) else last
    if before.trajectory.covariance is None:
        return walk
    frame = walk.frame if walk.frame.georeferenced else before.frame
    gap = walk.epoch - (before.epoch + before.trajectory.time[-1])
    if gap > LONGEST_GAP or not (before.frame.georeferenced or before.frame == frame):
        return walk
    place = frame.from_frame(before.frame, before.trajectory.position[-1:])
    variance = np.trace(before.trajectory.covariance[-1, :2, :2]) / 2 + (GAP_SPEED * max(gap, 0.0)) ** 2
    fix = Fixes(np.zeros(1), place, np.array([np.sqrt(variance)]), (before.trajectory.floor[-1],))
    return replace(walk, frame=frame, fixes=fix)


def reconstruct(person: str, date: str, observations: Mapping[str, Observation], profile: Profile | None) -> Day:
    """A day from what its recordings tell, and from what is known of the walker beforehand.

    observations: by the recording's content hash. Raises InputError where a plan cannot be used.
    """
    made, profile = outings_of(observations, profile)
    return Day(person, date, tuple(one if isinstance(one, Outing) else one.outing for one in made), profile)


def outings_of(
    observations: Mapping[str, Observation], profile: Profile | None
) -> tuple[list[Walked | Outing], Profile | None]:
    """The outings of a day, those with steps as they were estimated; and what is known of the walker after them.

    A walk learns from the one before how its walker steps, and, if it has no position of its own, where it began.
    """
    made: list[Walked | Outing] = []
    profile = profile or next((one.profile for one in observations.values() if one.profile is not None), None)
    for group in groups_of(observations):
        if group.observations[0].steps is None:
            made.append(_positions(group))
        else:
            walk = walked(group, made[-1] if made else None, profile)
            profile = walk.learnt
            made.append(walk)
    return made, profile


def _positions(group: Group) -> Outing:
    """An outing of which there are positions alone."""
    first = group.parts[0][1]
    frame, fixes = joined_fixes(group.observations)
    trajectory, segments = follow_positions(fixes)
    building = building_of(first.plan) if first.plan else None
    return Outing(
        recordings=group.names,
        source=first.source,
        epoch=group.epoch,
        frame=frame,
        plan=first.plan,
        trajectory=trajectory,
        segments=segments,
        stays=stays_of_positions(trajectory, segments, building),
        steps=0,
        notes=tuple(dict.fromkeys((*(line for one in group.observations for line in one.notes), *group.notes))),
    )
