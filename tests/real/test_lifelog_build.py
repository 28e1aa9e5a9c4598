"""A lifelog of real recordings: who builds it makes no difference."""

import sqlite3
from contextlib import closing

from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.ingest import add
from pdr_graph.apps.lifelog.store import RecordingOptions

FLOOR = ("ms_indoor20", "site1", "B1")  # a walk in four pieces


def built(log, data, **options):
    """All that is in a lifelog of days with positions alone, and two of walks: one on a plan, one with beacons."""
    add(log, [data / "geolife_sample", data / "gpx_sample"], person="Geo")
    add(log, [data.joinpath(*FLOOR)], RecordingOptions(plan=data.joinpath(*FLOOR)), person="Ms")
    add(log, sorted((data / "ipin2023_track3").glob("*Trial24*")), person="Ipin")
    result = build(log, zone="Asia/Shanghai", **options)
    assert (result.failures, result.refusals) == ((), ())
    assert result.built > 5
    with closing(sqlite3.connect(log)) as database:
        names = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        return {name: sorted(database.execute(f"SELECT * FROM {name}").fetchall(), key=repr) for name in names}


def test_real_days_are_the_same_whoever_builds_them(data, tmp_path):
    assert built(tmp_path / "here.db", data) == built(tmp_path / "workers.db", data, workers=2)
