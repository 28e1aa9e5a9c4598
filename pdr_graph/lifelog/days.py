"""One person's day, the page that tells the story: observed recordings become outings, each the most probable walk."""

from __future__ import annotations

from collections.abc import Mapping

from pdr_graph.gait.profile import Profile
from pdr_graph.lifelog.day import Day, Outing
from pdr_graph.lifelog.grouping import Group, groups_of
from pdr_graph.lifelog.joining import joined_fixes
from pdr_graph.lifelog.observation import Observation
from pdr_graph.lifelog.places import stays_of_positions
from pdr_graph.lifelog.segments import follow_positions
from pdr_graph.lifelog.walks import Walked, building_of, walked


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
