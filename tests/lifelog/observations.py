"""Observations made of walks drawn from the model, for tests of what is made of them."""

from dataclasses import replace

import numpy as np
from walks import distances, drawn_from_the_model

from pdr_graph.apps.lifelog import multi_day
from pdr_graph.apps.lifelog.day import Day
from pdr_graph.apps.lifelog.observation import Ends, Observation
from pdr_graph.apps.lifelog.reconstruct import as_outings, reconstruct_outings
from pdr_graph.frames import Frame, enu
from pdr_graph.geometry import rotation
from pdr_graph.types import Fixes, Headings, Steps

HERE = enu(48.1, 11.6)
NOON = 1_700_000_000.0 // 86400 * 86400 + 43200  # [s] Unix time, of a day in 2023


def observation(steps: Steps | None, fixes: Fixes, epoch: float = NOON, frame: Frame = HERE, **other) -> Observation:
    duration = float(steps.end if steps is not None else fixes.time[-1])
    looks = np.zeros(0 if steps is None else len(steps) + 1)
    values = {"source": f"at {epoch:.0f}", "plan": "", "floor": "", "headings": Headings.none()} | other
    return Observation(epoch=epoch, duration=duration, frame=frame, steps=steps, looks=looks, fixes=fixes, **values)


def positions(seconds: float, epoch: float = NOON, every: float = 5.0, frame: Frame = HERE) -> Observation:
    """The positions of a watch whose owner walks east at 1.3 m/s."""
    time = np.arange(0.0, seconds, every)
    fixes = Fixes(time, np.column_stack([1.3 * time, 0 * time]), np.full(len(time), 4.0), ("",) * len(time))
    return observation(None, fixes, epoch, frame)


def walk(n: int = 60, seed: int = 0, epoch: float = NOON, **other):
    """An observation of a walk drawn from the model, and the truth."""
    steps, fixes, truth = drawn_from_the_model(n, seed)
    return observation(steps, fixes, epoch, **other), truth


def median_error(track, truth):
    """Median distance of a trajectory from the truth [m]."""
    return np.median(distances(truth, track))


def cut_in_two(n: int, seed: int, gap: float, stood: bool = True, turned: float = 0.0):
    """A walk drawn from the model that was recorded in two pieces, ``gap`` seconds apart, with the truth of both.

    turned: on the spot meanwhile [rad]; stood: if not, they went 1.4 m/s straight on.
    """
    first, after = n // 2, n - n // 2
    one_steps, one_fixes, one_truth = drawn_from_the_model(first, seed)
    two_steps, two_fixes, two_truth = drawn_from_the_model(after, seed + 1000)
    pose = one_truth.position[-1], one_truth.heading[-1]
    way = np.zeros(2) if stood else 1.4 * gap * np.array([np.cos(pose[1]), np.sin(pose[1])])
    two_fixes, two_truth = moved_to(two_fixes, two_truth, pose[0] + way, pose[1] + turned)
    field = np.array([20.0, 15.0]), rotation(-turned) @ [20.0, 15.0]
    ends = [Ends(np.array([seen, seen]), np.full(2, -40.0)) for seen in field]
    one = observation(one_steps, one_fixes, ends=ends[0])
    two = observation(two_steps, two_fixes, NOON + one.duration + gap, ends=ends[1])
    return (one, one_truth), (two, two_truth)


def moved_to(fixes, truth, place, heading):
    """The fixes and the truth of a walk, moved to begin at a position and heading."""
    turn = heading - truth.heading[0]
    R, centre = rotation(turn).T, truth.position[0]
    return (
        replace(fixes, position=(fixes.position - centre) @ R + place),
        replace(truth, position=(truth.position - centre) @ R + place, heading=truth.heading + turn),
    )


def estimated_together(people, phones) -> list[Day]:
    """Days of one recording each, by (person, observation): walks that closures connect are in one graph."""
    made = [reconstruct_outings({person: one}, None) for person, one in people]
    outings = [list(own) for own, _ in made]
    for walks in multi_day.walks_by_area(own for own, _ in made):
        for at, walk in multi_day.bound_walks(walks, lambda day: made[day][0], [who for who, _ in people], phones):
            outings[at.day][at.outing] = walk
    ends = zip(people, outings, made, strict=True)
    return [Day(person, "2023-11-14", as_outings(own), profile) for (person, _), own, (_, profile) in ends]
