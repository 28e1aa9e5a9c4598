"""Microsoft's chains: one walk that was recorded in pieces."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from pdr_graph.apps.lifelog.observation import observe
from pdr_graph.apps.lifelog.reconstruct import estimate_walk
from pdr_graph.apps.lifelog.sessions import Session, sessions_of, turn_by_field
from pdr_graph.apps.lifelog.store import RecordingOptions
from pdr_graph.apps.report.evaluation import circular_error, pair
from pdr_graph.geometry import wrap_angle
from pdr_graph.io.loading import load
from pdr_graph.types import Fixes, Trajectory

CHAINS = {"site1/B1": 4, "site1/F1": 6, "site2/F1": 2}
NO_PIECE = "5dda0214"  # of site1/F1, an hour later


@pytest.fixture(scope="module")
def chains(data):
    """The pieces of each in order of time, observed, with their waypoints."""
    found = {}
    for name in CHAINS:
        folder = data / "ms_indoor20" / name
        paths = [path for path in folder.glob("*.txt") if NO_PIECE not in path.name]
        pieces = [(observe(path, RecordingOptions(plan=folder)), load(path).truth) for path in paths]
        found[name] = sorted(pieces, key=lambda piece: piece[0].epoch)
    return found


def by_ends(pieces):
    """The first waypoint of the first and the last of the last piece."""
    ones = [replace(one, fixes=Fixes.none()) for one, _ in pieces]
    for n, at in ((0, 0), (-1, -1)):
        truth = pieces[n][1]
        end = Fixes(truth.time[[at]], truth.position[[at]], np.array([0.5]), ("",))
        ones[n] = replace(ones[n], fixes=Fixes.concatenate([ones[n].fixes, end]))
    return Session(tuple((str(n), one) for n, one in enumerate(ones)))


def between_the_ends(pieces):
    first = pieces[0][0].epoch
    time = np.concatenate([truth.time + one.epoch - first for one, truth in pieces])[1:-1]
    return Trajectory(time, np.concatenate([truth.position for _, truth in pieces])[1:-1], 0 * time, ("",) * len(time))


def test_pieces_of_one_walk_are_one_outing(chains):
    for name, pieces in chains.items():
        [group] = sessions_of({str(n): one for n, (one, _) in enumerate(pieces)})
        assert len(group.parts) == CHAINS[name]


def test_each_chain_is_one_walk_by_its_ends_and_the_plan(chains):
    """All together CE50 and CE75 within 1.6 and 2.4 m, which the issue asks; each alone within a fifth more."""
    errors = []
    for pieces in chains.values():
        track = estimate_walk(by_ends(pieces), None, None).estimate.trajectory
        errors.append(circular_error(pair(track, between_the_ends(pieces))))
        assert np.percentile(errors[-1], 50) < 1.2 * 1.6
        assert np.percentile(errors[-1], 75) < 1.2 * 2.4
    assert np.percentile(np.concatenate(errors), 50) < 1.6
    assert np.percentile(np.concatenate(errors), 75) < 2.4


def course(truth, leg):
    """The direction of a leg between two waypoints. [rad]"""
    east, north = np.diff(truth.position, axis=0)[leg]
    return np.arctan2(north, east)


def test_the_field_tells_the_turn_between_two_pieces(chains):
    """Against the legs about it, which surveyors do not walk quite straight: 25° in the median."""
    off = []
    for pieces in chains.values():
        for (before, one), (after, two) in pairwise(pieces):
            turn = turn_by_field(before, after)
            if turn is not None:
                off.append(abs(wrap_angle(turn - course(two, 0) + course(one, -1))))
    assert len(off) >= 7
    assert np.median(off) < np.radians(25)
