"""Days made by hand, for tests of timelines, pictures and exports."""

from dataclasses import replace

import numpy as np

from pdr_graph.apps.lifelog.day import GAP, STANDING, VEHICLE, WALKING, Day, Outing, Segment, Stay
from pdr_graph.apps.lifelog.diary import Diary, DiaryDay
from pdr_graph.apps.lifelog.local_time import period_of
from pdr_graph.apps.lifelog.overview import overview
from pdr_graph.apps.lifelog.timeline import timeline
from pdr_graph.frames import Frame, enu
from pdr_graph.types import Trajectory

MIDNIGHT = 1_714_536_000.0  # Unix time of 2024-05-01T00:00 in Santiago, four hours behind
PACE = {WALKING: 1.25, VEHICLE: 10.0, STANDING: 0.0, GAP: 1.0}  # [m/s]
PERIOD = 1.0  # [s] between rows
HERE = enu(-35.0, -71.0)  # both below zero, as no time or distance is


def walk_along(legs, start=(0.0, 0.0), floor="", sigma=1.0, period=PERIOD):
    """A trajectory and its segments along straight ``(kind, seconds, heading [rad])`` legs, at each kind's pace."""
    time, place, heading, segments = [0.0], [np.array(start, dtype=float)], [legs[0][2]], []
    for kind, seconds, towards in legs:
        begin, origin, step = time[-1], place[-1], PACE[kind] * np.array([np.cos(towards), np.sin(towards)])
        since = np.array([seconds]) if kind == GAP else np.r_[np.arange(period, seconds - period / 2, period), seconds]
        time += (begin + since).tolist()
        place += list(origin + since[:, None] * step)
        heading += [towards] * len(since)
        segments.append(Segment(kind, begin, time[-1], 0.0 if kind == GAP else PACE[kind] * seconds))
    covariance = np.tile(np.diag([sigma**2, sigma**2, 0.01]), (len(time), 1, 1))
    track = Trajectory(np.array(time), np.array(place), np.array(heading), (floor,) * len(time), covariance)
    return track, tuple(segments)


def outing(legs, epoch=MIDNIGHT + 9 * 3600, frame=HERE, stays=(), plan="", **where):
    """An outing along legs; each row that moves is a step."""
    track, segments = walk_along(legs, **where)
    moved = np.hypot(*np.diff(track.position, axis=0).T) > 0
    return Outing(
        recordings=("5f3b" * 16,),
        source="/home/anna/from home.txt",
        epoch=epoch,
        frame=frame,
        plan=plan,
        trajectory=track,
        segments=segments,
        stays=tuple(stays),
        steps=int(moved.sum()),
        notes=("home: a note",),
    )


def stay(start, end, position=(0.0, 0.0), facing=(), passing=False, floor="", sigma=2.0):
    """A stay with unknown heading."""
    return Stay(start, end, passing, np.array(position, float), sigma**2 * np.eye(2), np.nan, floor, tuple(facing))


def day(*outings):
    """A day of Anna."""
    return Day("Anna", "2024-05-01", outings)


def overview_of(made):
    """The overview of a day in Santiago, with its fine entries."""
    entries = [replace(entry, offset=-4 * 3600.0, end_offset=-4 * 3600.0) for entry in timeline(made)]
    own = DiaryDay.of(made.person, made.date, (MIDNIGHT, MIDNIGHT + 86_400.0), entries, made.outings)
    return overview([Diary(made.person, (own,), ())], period_of(day=made.date))


NOWHERE = Frame()
