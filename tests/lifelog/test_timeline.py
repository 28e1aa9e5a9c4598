"""The timeline of a day: it covers all time once, and table and text agree with the day."""

import csv
import io
from dataclasses import replace
from datetime import datetime
from itertools import pairwise
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_days import HERE, MIDNIGHT, NOWHERE, PACE, day, outing, overview_of, stay

from pdr_graph.apps.lifelog.day import ACTIVITIES, GAP, STANDING, VEHICLE, WALKING
from pdr_graph.apps.lifelog.overview import as_text
from pdr_graph.apps.lifelog.timeline import PASSING, STAY, TIMELINE_HEADER, duration_text, timeline, timeline_csv

ZONE = ZoneInfo("America/Santiago")
NINE = MIDNIGHT + 9 * 3600
EAST, NORTH = 0.0, np.pi / 2


def kinds_and_durations(made):
    """Kinds and durations of entries."""
    return [(e.kind, round(e.end - e.start)) for e in timeline(made)]


def rows(made):
    """The rows of the table, by column."""
    return list(csv.DictReader(io.StringIO(timeline_csv(timeline(made), ZONE))))


legs = st.lists(st.tuples(st.sampled_from(ACTIVITIES), st.integers(5, 400), st.floats(-3, 3)), min_size=1, max_size=8)


@given(legs=legs, edges=st.lists(st.integers(0, 500), max_size=6, unique=True), slow=st.booleans())
@settings(max_examples=100, deadline=None)
def test_a_timeline_covers_all_time_once_with_the_whole_distance(legs, edges, slow):
    """Wherever the stays are: entries are contiguous, and their distances sum to those of the segments."""
    made = outing([(kind, float(seconds), heading) for kind, seconds, heading in legs])
    end = made.segments[-1].end
    pairs = zip(sorted(edges)[::2], sorted(edges)[1::2], strict=False)
    made = replace(made, stays=tuple(stay(a * end / 500, b * end / 500, passing=slow) for a, b in pairs))
    entries = timeline(day(made))
    assert entries[0].start == made.epoch
    assert entries[-1].end == made.epoch + end
    assert all(one.end == other.start for one, other in pairwise(entries))
    assert all(e.end > e.start for e in entries)
    way = sum(s.distance for s in made.segments)
    assert sum(e.distance for e in entries) == pytest.approx(way, abs=1e-6)
    kept = [e for e in entries if e.kind in (STAY, PASSING)]
    assert sum(e.end - e.start for e in kept) >= sum(s.end - s.start for s in made.stays) - 1e-6


@pytest.mark.parametrize(
    ("legs", "stays", "entries"),
    [
        pytest.param(
            [(WALKING, 100.0, EAST), (STANDING, 300.0, EAST), (WALKING, 100.0, EAST)],
            [stay(112, 400)],
            [(WALKING, 112), (STAY, 288), (WALKING, 100)],
            id="a stay replaces the standing around it; what comes before its begin is part of the walk",
        ),
        pytest.param(
            [(STANDING, 300.0, EAST), (WALKING, 100.0, EAST)],
            [stay(2, 300)],
            [(STAY, 300), (WALKING, 100)],
            id="short standing beside a stay belongs to the stay",
        ),
        pytest.param(
            [(WALKING, 100.0, EAST), (STANDING, 59.0, EAST), (WALKING, 100.0, EAST), (STANDING, 61.0, EAST)],
            [],
            [(WALKING, 259), (STANDING, 61)],
            id="short standing is part of the walk and long standing is not",
        ),
        pytest.param(
            [(VEHICLE, 100.0, EAST), (STANDING, 59.0, EAST), (VEHICLE, 100.0, EAST)],
            [],
            [(VEHICLE, 259)],
            id="short standing is part of a ride",
        ),
        pytest.param(
            [(GAP, 100.0, EAST), (STANDING, 30.0, EAST), (GAP, 100.0, EAST)],
            [],
            [(GAP, 100), (STANDING, 30), (GAP, 100)],
            id="short standing between gaps is part of nothing",
        ),
        pytest.param(
            [(WALKING, 200.0, EAST)],
            [stay(80, 100, passing=True)],
            [(WALKING, 80), (PASSING, 20), (WALKING, 100)],
            id="a slow pass divides a walk",
        ),
    ],
)
def test_entries_of_an_outing(legs, stays, entries):
    assert kinds_and_durations(day(outing(legs, stays=stays))) == entries


def test_gaps_between_outings_are_entries_in_any_order_of_outings():
    morning = outing([(WALKING, 600.0, EAST)], epoch=NINE)
    noon = outing([(WALKING, 300.0, EAST)], epoch=NINE + 3 * 3600)
    assert kinds_and_durations(day(noon, morning)) == [(WALKING, 600), (GAP, 10200), (WALKING, 300)]
    at_once = outing([(WALKING, 300.0, EAST)], epoch=NINE + 600.5)
    assert kinds_and_durations(day(morning, at_once)) == [(WALKING, 600), (WALKING, 300)]


def test_the_table_has_local_times_and_absolute_positions():
    made = outing(
        [(STANDING, 300.0, EAST)], stays=[stay(0, 300, (30.0, 40.0), [("A, B", 0.7), ("C", 0.25)], floor="F1")]
    )
    assert timeline_csv(timeline(day(made)), ZONE).split("\n")[0] == TIMELINE_HEADER
    [row] = rows(day(made))
    assert row["start"] == "2024-05-01T09:00:00-04:00"
    assert datetime.fromisoformat(row["end"]).timestamp() == NINE + 300
    assert (row["kind"], row["floor"], row["place"], row["others"]) == (STAY, "F1", "A, B", "C 0.250")
    assert float(row["probability"]) == 0.7
    place = np.array([[float(row["longitude"]), float(row["latitude"])]])
    assert HERE.from_lonlat(place)[0] == pytest.approx((30, 40), abs=0.02)
    assert (float(row["x"]), float(row["y"]), float(row["sigma"])) == (30, 40, 2)


def test_unknown_values_are_empty():
    made = outing([(WALKING, 100.0, EAST), (GAP, 100.0, EAST), (STANDING, 100.0, EAST)], frame=NOWHERE)
    walking, gap, standing = rows(day(made))
    assert gap["distance"] == gap["x"] == ""
    assert walking["distance"] == "125.0"
    assert walking["place"] == walking["probability"] == walking["x"] == ""
    assert standing["latitude"] == ""
    assert (float(standing["x"]), float(standing["sigma"])) == (225, 1)


def test_the_floors_of_a_walk_are_in_order():
    made = outing([(WALKING, 100.0, EAST)])
    floor = tuple("1" if t < 40 else "" if t < 60 else "2" for t in made.trajectory.time)
    made = replace(made, trajectory=replace(made.trajectory, floor=floor))
    assert rows(day(made))[0]["floor"] == "1 > 2"


def test_totals_are_those_of_segments_and_expected_times_at_places():
    stays = [stay(0, 600, facing=[("A", 0.8), ("B", 0.1)]), stay(700, 1000, facing=[("B", 0.6)])]
    walk = [(STANDING, 600.0, EAST), (WALKING, 100.0, EAST), (STANDING, 300.0, EAST), (GAP, 50.0, EAST)]
    [made] = overview_of(day(outing([*walk, (VEHICLE, 200.0, EAST)], stays=stays))).days
    sums = made.totals
    assert (sums.walked, sums.walking) == (125, 100)
    assert (sums.ridden, sums.riding) == (200 * PACE[VEHICLE], 200)
    assert (sums.staying, sums.unknown) == (900, 86_400 - 1200), "no data is the rest of the day"
    assert dict(sums.places) == pytest.approx({"A": 0.8 * 600, "B": 0.1 * 600 + 0.6 * 300})
    assert [name for name, _ in sums.places] == ["A", "B"]


def test_control_characters_in_names_do_not_reach_the_terminal():
    """Names come from plans of any origin."""
    made = outing([(STANDING, 100.0, EAST)], stays=[stay(0, 100, facing=[("a\x1b[31m\nb", 0.9), ("c\td", 0.05)])])
    text = as_text(overview_of(day(made))) + timeline_csv(timeline(day(made)), ZONE)
    assert "\x1b" not in text
    assert "\t" not in text
    assert len(rows(day(made))) == 1


def test_the_text_agrees_with_the_table():
    stays = [stay(120, 720, (150.0, 0.0), [("Bakery", 0.8), ("Bank", 0.15)])]
    made = day(outing([(WALKING, 120.0, EAST), (STANDING, 600.0, EAST), (GAP, 300.0, NORTH)], stays=stays))
    text = as_text(overview_of(made))
    assert "09:02  09:12  10 min  stay" in text
    assert "Bakery 80% (Bank 15%)" in text
    assert "no data" in text
    assert "walked 150 m in 2 min" in text


@pytest.mark.parametrize(
    ("seconds", "text"), [(0, "0 s"), (99, "99 s"), (99.6, "2 min"), (5940, "99 min"), (7500, "2 h 05 min")]
)
def test_durations_have_usual_units(seconds, text):
    assert duration_text(seconds) == text


def test_a_day_without_outings_is_empty():
    assert timeline(day()) == ()
    assert timeline_csv((), ZONE) == TIMELINE_HEADER + "\n"
