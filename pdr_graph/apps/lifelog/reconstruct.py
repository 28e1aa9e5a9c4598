"""Reconstruct a person's day: group its recordings into sessions, and estimate the walk of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from pdr_graph.apps.lifelog.day import ACTIVITIES, Day, Outing, Segment
from pdr_graph.apps.lifelog.observation import Observation
from pdr_graph.apps.lifelog.sessions import (
    LONGEST_SESSION_GAP,
    Session,
    doubted_positions,
    is_located,
    join,
    local_parts,
    restart_closures,
    sessions_of,
)
from pdr_graph.apps.lifelog.stays import follow_positions, segments_of, stays_of, stays_of_positions
from pdr_graph.estimation.calibration import posterior_profile
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.verdict import PLACE, ROUTE, teaches_profile, verdict
from pdr_graph.floor.paths import PathNetwork
from pdr_graph.floor.plan_files import Building, plan_fingerprint
from pdr_graph.frames import Frame
from pdr_graph.gait.walker import Profile, Walker
from pdr_graph.options import Options
from pdr_graph.priors import MOTION
from pdr_graph.types import INSTANT, Array, Estimate, Fixes, OneLineRepr, Recording, Trajectory
from pdr_graph.walk import Evidence, estimate, with_tables

WITHOUT_WAYS = "", ""  # without a file of ways outdoors


@dataclass(frozen=True)
class EstimatedWalk(OneLineRepr):
    """The estimated walk of a session.

    profile: of the walker before the walk; joined: the recordings as one; rides: ``(r, 2)`` start and end of each [s];
    missing: what could not be estimated, a line each; ways: file of ways outdoors, and its fingerprint.
    """

    session: Session
    profile: Profile | None
    joined: Observation
    building: Building | None
    rides: Array
    graph: WalkGraph
    estimate: Estimate
    missing: tuple[str, ...]
    ways: tuple[str, str] = WITHOUT_WAYS

    @property
    def looks(self) -> Array:
        """As of `Observation`, for the rows of the graph's steps; 0 for rides."""
        old, new = self.joined.walked, self.graph.steps
        row = np.searchsorted(old.time, new.time - INSTANT)  # after the last step if a ride ends the walk
        walked = ~new.is_gap & (np.abs(np.append(old.time, np.inf)[row] - new.time) <= INSTANT)
        return np.append(np.where(walked, self.joined.looks[row], 0.0), self.joined.looks[-1])

    @property
    def profile_after(self) -> Profile | None:
        """Profile of the walker after the walk: that before it, unless the walk may teach one."""
        if not teaches_profile(self.estimate):
            return self.profile
        return posterior_profile(self.estimate, self.graph.steps, self.profile)

    @cached_property
    def outing(self) -> Outing:
        """The walk as an outing of a day."""
        steps, track, reasons = self.graph.steps, self.estimate.trajectory, verdict(self.estimate).reasons
        outing = _outing(self.session, self.joined, track, segments_of(steps, track, self.rides))
        notes = (*(f"{reason.state}: {reason.text}" for reason in reasons), *outing.notes, *self.estimate.warnings)
        return replace(
            outing,
            stays=stays_of(steps, track, self.building, self.looks),
            steps=int((~steps.is_gap).sum()),
            notes=tuple(dict.fromkeys(notes)),
            missing=self.missing,
        )

    @property
    def may_bind(self) -> bool:
        """True if other walks may be bound to this one: no source contradicts another; its route may be open."""
        return all(reason.source in (ROUTE, PLACE) for reason in verdict(self.estimate).reasons)

    def _summary(self) -> list[str]:
        return [repr(self.session), repr(self.estimate)]


def estimate_walk(
    session: Session,
    before: EstimatedWalk | Outing | None,
    profile: Profile | None,
    frame: Frame | None = None,
    ways: tuple[str, str] = WITHOUT_WAYS,
) -> EstimatedWalk:
    """Estimate the walk of a session with steps.

    before: the previous outing of the day; profile: of the walker; frame: a georeferenced frame of the result, by
    default that of the recordings; ways: outdoors. Raises InputError where plan or ways cannot be used.
    """
    # All measurements, in one frame
    first = session.parts[0][1]
    joined = _with_start_after(before, join(session.observations, [one for _, one in session.beside], frame))
    building, fixes = building_of(first.plan) if first.plan else None, joined.fixes
    walk = Recording(
        first.source,
        0.0,
        joined.epoch,
        barometer=joined.barometer,
        bluetooth=joined.bluetooth,
        measurements=(restart_closures(session.observations), *joined.measurements),
    )

    # The steps of this walker, on their floors
    steps = profile.corrected(joined.walked) if profile else joined.walked
    evidence = Evidence(
        walk,
        Walker(profile=profile),
        building,
        joined.frame,
        fixes,
        beacons=joined.beacons,
        options=Options(plan=Path(first.plan) if first.plan else None, floor=first.floor or None),
        steps=steps,
        headings=joined.headings,
        paths=_ways(*ways).seen_from(joined.frame).around([fixes]) if ways[0] else None,
        modes=[(start, end, ACTIVITIES.index(kind)) for start, end, kind in joined.activities],
    )

    # The most probable walk
    result = estimate(with_tables(evidence))
    assert result.graph is not None, "a walk has steps"
    rides, graph = result.evidence.rides, result.graph
    return EstimatedWalk(session, profile, joined, building, rides, graph, result.estimate, result.missing, ways)


def building_of(plan: str) -> Building:
    """Read a plan, once for all walks on it until its content changes."""
    return _read(plan, plan_fingerprint(Path(plan)))


@lru_cache(maxsize=8)
def _read(plan: str, content: str) -> Building:
    return Building.load(plan)


@lru_cache(maxsize=1)
def _ways(file: str, content: str) -> PathNetwork:
    """Read ways outdoors, once for all walks until their content changes."""
    return PathNetwork.load(file)


def _with_start_after(last: EstimatedWalk | Outing | None, joined: Observation) -> Observation:
    """Add a fix at the start of a walk without any position: the end of the previous outing, if it was shortly before.

    Its variance grows with the gap, in which the walker goes at `MOTION.gap_speed`.
    """
    if last is None or is_located(joined):
        return joined
    before = last.outing if isinstance(last, EstimatedWalk) else last
    if before.trajectory.covariance is None:
        return joined
    frame = joined.frame if joined.frame.georeferenced else before.frame
    gap = joined.epoch - (before.epoch + before.trajectory.time[-1])
    if gap > LONGEST_SESSION_GAP or not (before.frame.georeferenced or before.frame == frame):
        return joined
    place = frame.from_frame(before.frame, before.trajectory.position[-1:])
    variance = np.trace(before.trajectory.covariance[-1, :2, :2]) / 2 + (MOTION.gap_speed * max(gap, 0.0)) ** 2
    fix = Fixes(np.zeros(1), place, np.array([np.sqrt(variance)]), (before.trajectory.floor[-1],))
    return replace(joined, frame=frame, fixes=fix)


def reconstruct(
    person: str,
    date: str,
    observations: Mapping[str, Observation],
    profile: Profile | None,
    ways: tuple[str, str] = WITHOUT_WAYS,
) -> Day:
    """Reconstruct a day from its observations, by content hash of the recording, and the profile before the day.

    ways: file of ways outdoors, and its fingerprint. Raises InputError where a plan or the ways cannot be used.
    """
    outings, profile = reconstruct_outings(observations, profile, ways)
    return Day(person, date, as_outings(outings), profile)


def as_outings(outings: Sequence[EstimatedWalk | Outing]) -> tuple[Outing, ...]:
    """The outings of a day; those that were estimated as walks, as outings."""
    return tuple(one if isinstance(one, Outing) else one.outing for one in outings)


def reconstruct_outings(
    observations: Mapping[str, Observation], profile: Profile | None, ways: tuple[str, str] = WITHOUT_WAYS
) -> tuple[list[EstimatedWalk | Outing], Profile | None]:
    """Estimate the outings of a day, those with steps as walks; also returns the profile of the walker after the day.

    A walk takes over the profile from the walk before it and, if it has no position of its own, where it begins.
    """
    outings: list[EstimatedWalk | Outing] = []
    profile = profile or next((one.profile for one in observations.values() if one.profile is not None), None)
    for session in sessions_of(observations):
        if session.observations[0].steps is None:
            joined, plan = join(session.observations), session.parts[0][1].plan
            fixes = joined.fixes[np.argsort(joined.fixes.time, kind="stable")]
            sources = [part.source for part in session.observations]
            notes = doubted_positions(fixes.time, fixes.position, fixes.sigma, sources)
            for part in local_parts(joined):
                track, segments = follow_positions(part.fixes)
                if not segments:  # of positions that exclude each other, one remains
                    continue
                stays = stays_of_positions(track, segments, building_of(plan) if plan else None)
                outing = _outing(session, part, track, segments)
                outings.append(replace(outing, stays=stays, notes=(*notes, *outing.notes)))
        else:
            walk = estimate_walk(session, outings[-1] if outings else None, profile, ways=ways)
            profile = walk.profile_after
            outings.append(walk)
    return outings, profile


def _outing(session: Session, joined: Observation, track: Trajectory, segments: tuple[Segment, ...]) -> Outing:
    """The outing of a session without stays and steps, with the notes on its recordings."""
    first, notes = session.parts[0][1], (line for part in session.observations for line in part.notes)
    notes = tuple(dict.fromkeys((*notes, *session.notes)))
    return Outing(session.hashes, first.source, joined.epoch, joined.frame, first.plan, track, segments, (), 0, notes)
