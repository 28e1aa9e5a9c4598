"""A lifelog of real recordings, in one graph."""

import sqlite3
from contextlib import closing

import pytest

from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.ingest import add
from pdr_graph.apps.lifelog.multi_day import estimate_together
from pdr_graph.apps.lifelog.store import RecordingOptions, Store
from pdr_graph.io.loading import load


@pytest.fixture
def store(tmp_path, data):
    """Two people on one floor: one walked its chain, the other an hour later, with the first and last waypoint each."""
    log, folder = tmp_path / "days.db", data / "ms_indoor20" / "site1" / "F1"
    for path in sorted(folder.glob("*.txt")):
        walk, fixes = load(path), tmp_path / f"{path.stem}.csv"
        truth = walk.truth
        rows = [
            f"{walk.clock_origin + truth.time[n]:.3f},{truth.position[n, 0]},{truth.position[n, 1]},0.5"
            for n in (0, -1)
        ]
        fixes.write_text("\n".join(["time,x,y,sigma", *rows]))
        add(
            log, [path], RecordingOptions(plan=folder, fixes=fixes), person="anna" if "5dda0214" in path.name else "ben"
        )
    build(log)
    return log


def trajectories(store):
    with closing(sqlite3.connect(store)) as database:
        return dict(database.execute("SELECT person, bytes FROM trajectory").fetchall())


def test_walks_that_heard_the_same_are_bound_once(store):
    before = trajectories(store)
    assert estimate_together(store) == 2
    after = trajectories(store)
    assert after.keys() == before.keys() == {"anna", "ben"}
    assert after != before
    assert estimate_together(store) == 0, "nothing has changed since"
    assert build(store).built == 0, "the days themselves are up to date"
    assert trajectories(store) == after


def test_a_person_s_phone_is_known_by_its_name(store):
    add(store, [], person="anna", phone="AA:BB")
    with Store(store) as log:
        assert log.phones() == {"AA:BB": "anna"}
    assert estimate_together(store) == 2, "who carries what may bind others"
