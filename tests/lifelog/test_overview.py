"""Overviews of a day, week, month, year, place and person, and the timeline of a day: numbers, lists, tables, JSON."""

import csv
import io
import json
from collections import defaultdict
from dataclasses import replace
from datetime import date, datetime
from itertools import pairwise
from zoneinfo import ZoneInfo

import commands
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_days import HERE, MIDNIGHT, NOWHERE, PACE, day, outing, overview_of, stay
from rich.cells import cell_len

from pdr_graph.apps.lifelog.day import ACTIVITIES, GAP, STANDING, VEHICLE, WALKING
from pdr_graph.apps.lifelog.local_time import period_of
from pdr_graph.apps.lifelog.maps import TileServer
from pdr_graph.apps.lifelog.overview import (
    LIST_ROWS,
    as_text,
    day_list,
    overview,
    place_texts,
    row_texts,
    tables,
)
from pdr_graph.apps.lifelog.overview_page import page
from pdr_graph.apps.lifelog.picture import pictures
from pdr_graph.apps.lifelog.places import EVERY_DAY, Place, clock_modes, clock_quartiles, joined_visits
from pdr_graph.apps.lifelog.show import Choice, show
from pdr_graph.apps.lifelog.timeline import (
    PASSING,
    STAY,
    TIMELINE_HEADER,
    TimelineEntry,
    distance_text,
    duration_text,
    timeline,
    timeline_csv,
)
from pdr_graph.errors import InputError

DAY = 86_400.0
HOUR = 3600.0


def shown(log, *persons, place="", **period):
    return show(log, Choice(persons, period_of(**period), place), write=False)


@pytest.fixture(scope="module")
def month(month_log):
    return shown(month_log, "Ada", month="2024-05").overview


def test_a_night_at_home_is_one_visit(month):
    """All nights in Berlin, except those about the day without data: a silence of 31 h parts two stays."""
    [(_, home), *_] = month.places
    nights = [visit for visit in home.visits if visit.duration > 10 * HOUR]
    assert len(nights) == 17
    assert max(visit.duration for visit in home.visits) < 24 * HOUR
    assert all(visit.observed < 1 for visit in nights), "nothing is recorded at night"


def test_usual_hours_are_those_of_the_weekday_and_of_the_place(month):
    """Ada comes to work in Berlin at about ten past eight, in Tokyo too, by the local clock."""
    offices = [place for _, place in month.places if 7.8 < place.hours[0].arrival[1] < 8.3]
    assert len(offices) == 2
    for office in offices:
        assert office.hours[0].weekday == EVERY_DAY
        assert {usual.weekday for usual in office.hours[1:]} <= {"Monday", "Tuesday", "Wednesday", "Thursday", "Friday"}
        assert office.hours[0].departure[1] == pytest.approx(17.5, abs=0.5)


def test_an_arrival_after_a_time_without_data_is_unknown():
    walk = TimelineEntry(WALKING, 0.0, 600.0, 500.0)
    silence = TimelineEntry(GAP, 600.0, 3600.0)
    stay = TimelineEntry(STAY, 3600.0, 7200.0, latitude=1.0, longitude=2.0, place_number=1)
    [visit] = joined_visits([walk, silence, stay])
    assert not visit.arrived
    assert not visit.left, "the last one"
    direct = replace(stay, start=600.0)
    [visit] = joined_visits([walk, direct, replace(walk, start=7200.0, end=9000.0)])
    assert visit.arrived
    assert visit.left


def test_usual_hours_are_the_first_arrival_and_the_last_departure():
    """Lunch is no arrival at the office, and two days are no habit."""
    day = 86_400.0

    def hours(days):
        spans = [(n, a, b) for n in range(days) for a, b in ((8 + 0.1 * n, 12.0), (13.0, 17.5 + 0.1 * n))]
        own = [(n * day + 3600 * a, n * day + 3600 * b) for n, a, b in spans]
        place = Place(1, "", 0.0, 0.0, 1.0, tuple(TimelineEntry(STAY, *span, arrived=True, left=True) for span in own))
        return place.hours[0]

    usual = hours(5)
    assert (usual.arrivals, usual.departures) == (5, 5)
    assert usual.arrival == pytest.approx((8.1, 8.2, 8.3))
    assert usual.departure == pytest.approx((17.6, 17.7, 17.8))
    assert np.isnan(hours(2).arrival).all()


@given(st.lists(st.floats(0, 24), min_size=3, max_size=20), st.floats(0, 24))
def test_quartiles_turn_with_the_clock(hours, later):
    """Property: adding hours to all times adds them to the quartiles, unless the times have no mean direction."""
    angle = np.array(hours) * np.pi / 12
    if np.hypot(np.cos(angle).mean(), np.sin(angle).mean()) < 0.1:
        return
    turned = np.array(clock_quartiles((np.array(hours) + later) % 24))
    off = (turned - np.array(clock_quartiles(np.array(hours))) - later + 12) % 24 - 12
    assert off == pytest.approx(np.zeros(3), abs=1e-6)


def test_usual_hours_are_hours_that_happened_and_two_modes_are_two():
    night, morning, evening = [23.5, 0.25, 0.5, 23.75], [8.0, 8.1, 8.3, 8.0, 7.9], [17.5, 18.0, 18.2]
    assert clock_quartiles(np.array([10.25, 18.15, 18.15])) == pytest.approx((10.25, 18.15, 18.15))
    parted = clock_modes(np.array([*evening, *night, *morning]))
    assert sorted(sorted(mode.round(9).tolist()) for mode in parted) == sorted(map(sorted, (night, morning, evening)))
    for one in (morning, np.arange(8, 20, 0.5), np.random.default_rng(0).normal(12, 2, 200)):
        assert len(clock_modes(np.asarray(one))) == 1, "no gap between two"
    spans = [(n, a, b) for n in range(12) for a, b in [(6.0, 14.0) if n % 2 else (14.0, 22.0)]]
    visits = [TimelineEntry(STAY, 86_400 * n + 3600 * a, 86_400 * n + 3600 * b) for n, a, b in spans]
    work = Place(1, "work", 0.0, 0.0, 1.0, tuple(replace(visit, arrived=True, left=True) for visit in visits))
    early, late = work.hours[:2]
    assert (early.arrivals, early.arrival[1], late.departures, late.departure[1]) == (6, 6.0, 6, 22.0)
    assert place_texts(work)[3] == "06:00 (06:00–06:00), 14:00 (14:00–14:00)"


def entries(seed, n):
    """Entries of a day of random kinds and durations."""
    random = np.random.default_rng(seed)
    bounds = np.sort(random.uniform(0, DAY, n + 1))
    kinds = random.choice([WALKING, VEHICLE, STAY, GAP], n)
    return [
        TimelineEntry(str(kind), start, end, 10.0 if kind in (WALKING, VEHICLE) else 0.0, x=float(place), y=0.0)
        for kind, start, end, place in zip(kinds, bounds[:-1], bounds[1:], random.integers(0, 5, n), strict=True)
    ]


@given(st.integers(0, 10**6), st.integers(1, 200))
def test_the_list_of_a_day_fits_a_screen_and_covers_the_day(seed, n):
    day = entries(seed, n)
    rows = day_list(day)
    assert len(rows) <= LIST_ROWS
    assert (rows[0][0].start, rows[-1][0].end) == (day[0].start, day[-1].end)
    assert all(one.end == other.start for (one, _), (other, _) in pairwise(rows))
    assert sum(row.distance for row, _ in rows) == pytest.approx(sum(entry.distance for entry in day))
    assert (
        len(rows) + sum(sum(merged.values()) for _, merged in rows) <= n
    )  # neighbours that became one are not counted


def test_short_stops_of_a_walk_are_counted():
    kinds = [WALKING, STAY, WALKING, STAY, WALKING, STAY]
    ends = np.cumsum([0, 600, 30, 600, 40, 600, 7200.0])
    day = [
        TimelineEntry(k, a, b, place_number=n)
        for n, (k, a, b) in enumerate(zip(kinds, ends[:-1], ends[1:], strict=True))
    ]
    (walk, merged), (stay, _) = day_list(day, 2)
    assert (walk.kind, stay.kind) == (WALKING, STAY)
    assert row_texts(walk, merged)[5].endswith("and 2 short stops")
    assert (walk.start, walk.end) == (0.0, 1870.0)


def test_distances_and_durations_have_the_usual_units_and_precision():
    distances = [distance_text(d) for d in (0, 640.4, 999.6, 6240, 15_000, 123_456, 1_250_000)]
    assert distances == ["0 m", "640 m", "1.0 km", "6.2 km", "15.0 km", "123 km", "1,250 km"]
    durations = [duration_text(s) for s in (0, 99, 99.6, 5940, 7500)]
    assert durations == ["0 s", "99 s", "2 min", "99 min", "2 h 05 min"]


@pytest.mark.parametrize(
    "period", [{"day": "2024-05-21"}, {"week": "2024-W20"}, {"month": "2024-05"}, {"year": "2024"}, {}]
)
@pytest.mark.parametrize("persons", [("Ada",), ("Ada", "Ben")])
def test_every_line_has_at_most_100_columns(month_log, period, persons):
    text = shown(month_log, *persons, **period).text
    assert ("1 day without data" in text) == (period.keys() <= {"month", "year"}), "of all periods that have it"
    assert ("days without data" in text) == ("year" in period), "before and after"
    assert max(cell_len(line) for line in text.splitlines()) <= 100
    assert all(person in text for person in persons)


@pytest.mark.parametrize(
    ("option", "first", "last"),
    [
        ({"day": "2024-02-29"}, date(2024, 2, 29), date(2024, 2, 29)),
        ({"week": "2020-W53"}, date(2020, 12, 28), date(2021, 1, 3)),
        ({"month": "2024-02"}, date(2024, 2, 1), date(2024, 2, 29)),
        ({"year": "1999"}, date(1999, 1, 1), date(1999, 12, 31)),
    ],
)
def test_a_period_has_its_dates(option, first, last):
    period = period_of(**option)
    assert (period.first, period.last, len(list(period.dates))) == (first, last, len(period))


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"day": "May"}, "--date: found 'May', expected a day such as 2024-05-01"),
        ({"week": "2024-W60"}, "a week such as 2024-W18"),
        ({"week": "2024"}, "a week such as"),
        ({"month": "2024-13"}, "a month such as 2024-05"),
        ({"year": "0"}, "a year such as 2024"),
        ({"year": "9999"}, "a year such as 2024"),
        ({"year": "2024", "month": "2024-05"}, "found 2 periods, expected one of them"),
    ],
)
def test_another_text_is_refused_with_an_example(options, complaint):
    with pytest.raises(InputError, match=complaint):
        period_of(**options)


def test_a_place_is_chosen_by_number_and_shows_its_visits_alone(month_log, month):
    home = month.places[0][1].number
    own = shown(month_log, "Ada", place=str(home)).overview
    assert {visit.place_number for _, visit in own.visits} == {home}
    assert [place.number for _, place in own.places] == [home]
    with pytest.raises(InputError, match="a place that was visited: place 1, place 2"):
        shown(month_log, "Ada", place="Mars")


@pytest.mark.parametrize(
    ("choice", "complaint"),
    [
        ({"persons": ("Carl",)}, "one of Ada, Ben"),
        ({"day": "2023-05-01"}, "--date: found '2023-05-01', expected a recorded day from 2024-05-01 to 2024-05-30"),
        ({"year": "2023"}, "--year: found '2023', expected a recorded day"),
    ],
)
def test_a_choice_without_data_is_refused(month_log, choice, complaint):
    with pytest.raises(InputError, match=complaint):
        shown(month_log, *choice.pop("persons", ()), **choice)


def test_the_default_is_the_last_day_and_all_days_of_a_person(month_log):
    assert shown(month_log).overview.period.name == "2024-05-30"
    assert shown(month_log).overview.persons == ("Ada", "Ben")
    everything = shown(month_log, "Ben").overview
    assert (everything.period.first, everything.period.last) == (date(2024, 5, 1), date(2024, 5, 30))


def test_home_is_guessed_for_those_who_ask_alone(month_log, month):
    assert not any(place.name for _, place in month.places)
    guessed = show(month_log, Choice(("Ada",), period_of(month="2024-05"), guess_home=True), write=False).overview
    assert guessed.places[0][1].name == "home?"
    assert guessed.places[0][1].number == month.places[0][1].number
    assert not any(place.name for _, place in guessed.places[1:])


def run(*arguments):
    return commands.run("lifelog", *arguments)


KEYS = {
    "": "format version period place persons days places visits",
    "period": "kind name first last",
    "persons": "person days days_with_data walking riding staying no_data observed walked ridden steps",
    "days": "person date start end walking riding staying no_data observed walked ridden steps entries",
    "places": "person number place latitude longitude sigma visits duration first last hours",
    "visits": "person place number start end duration observed arrived left latitude longitude sigma",
}


def test_json_is_one_object_alone_with_the_documented_keys(month_log):
    before = sorted(month_log.parent.iterdir())
    result = run("show", month_log, "--week", "2024-W20", "--person", "Ada", "--json")
    assert result.code == 0, result.errors
    document = json.loads(result.output)
    assert list(document) == KEYS[""].split()
    for name, keys in list(KEYS.items())[1:]:
        rows = document[name] if isinstance(document[name], list) else [document[name]]
        assert all(list(row) == keys.split() for row in rows), name
    assert len(document["days"]) == 7
    [person] = document["persons"]
    for key in ("walking", "riding", "staying", "no_data", "walked", "ridden", "steps"):
        assert person[key] == pytest.approx(sum(day[key] for day in document["days"]), abs=0.01)
    kinds = {entry["kind"] for day in document["days"] for entry in day["entries"]}
    assert kinds == {"stay", "walking", "vehicle"}
    assert document["days"][0]["entries"][0]["start"].endswith("+02:00")
    assert sorted(month_log.parent.iterdir()) == before, "no files without --out"


def test_tables_have_the_rows_of_the_overview(month):
    read = {name: list(csv.DictReader(io.StringIO(table.decode()))) for name, table in tables(month).items()}
    assert [row["date"] for row in read["days.csv"]] == [day.date for day in month.days]
    assert sum(float(row["duration"]) for row in read["visits.csv"]) == pytest.approx(
        sum(float(row["duration"]) for row in read["places.csv"]), abs=len(month.visits)
    )
    every = [row for row in read["hours.csv"] if row["weekday"] == EVERY_DAY]
    assert {int(row["number"]) for row in every} == {place.number for _, place in month.places}
    hour, minute = map(int, every[0]["departure_50"].split(":"))
    assert 60 * hour + minute == pytest.approx(60 * 7.75, abs=9), "she leaves home at 07:45 with a sigma of 9 min"


# The timeline

ZONE = ZoneInfo("America/Santiago")
NINE = MIDNIGHT + 9 * 3600
EAST, NORTH = 0.0, np.pi / 2


def kinds_and_durations(made):
    """Kinds and durations of entries."""
    return [(e.kind, round(e.end - e.start)) for e in timeline(made)]


def rows(made):
    """The rows of the table, by column."""
    return list(csv.DictReader(io.StringIO(timeline_csv(overview_of(made).days[0].entries))))


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


WALK, RIDE, SILENCE = ((kind, 100.0, EAST) for kind in (WALKING, VEHICLE, GAP))
SHORT, LONG, WAIT = ((STANDING, seconds, EAST) for seconds in (59.0, 61.0, 300.0))


@pytest.mark.parametrize(
    ("legs", "stays", "entries"),
    [
        ([WALK, WAIT, WALK], [stay(112, 400)], [(WALKING, 112), (STAY, 288), (WALKING, 100)]),
        ([WAIT, WALK], [stay(2, 300)], [(STAY, 300), (WALKING, 100)]),
        ([WALK, SHORT, WALK, LONG], [], [(WALKING, 259), (STANDING, 61)]),
        ([RIDE, SHORT, RIDE], [], [(VEHICLE, 259)]),
        ([SILENCE, SHORT, SILENCE], [], [(GAP, 100), (STANDING, 59), (GAP, 100)]),
        ([(WALKING, 200.0, EAST)], [stay(80, 100, passing=True)], [(WALKING, 80), (PASSING, 20), (WALKING, 100)]),
    ],
    ids=[
        "a stay replaces the standing around it, of which the begin is part of the walk",
        "short standing beside a stay belongs to the stay",
        "short standing is part of the walk and long standing is not",
        "short standing is part of a ride",
        "short standing between gaps is part of nothing",
        "a slow pass divides a walk",
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
    assert timeline_csv(timeline(day(made))).split("\n")[0] == TIMELINE_HEADER
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
    text = as_text(overview_of(day(made))) + timeline_csv(timeline(day(made)))
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


def fleet(number):
    """An overview of a day of some persons at a kiosk (80 %) or a bank; the nth stays for 100 (n + 1) s."""
    diaries = []
    for n in range(number):
        lasts = 100.0 * (n + 1)
        facing = [("Kiosk", 0.8), ("Bank", 0.2)]
        made = outing([(WALKING, 60.0, EAST), (STANDING, lasts, EAST)], stays=[stay(60, 60 + lasts, (75, 0), facing)])
        own = replace(day(made), person=f"walker {n}")
        diaries += overview_of(own).diaries
    return overview(diaries, period_of(day="2024-05-01"))


def test_time_at_places_over_all_persons_is_the_expected_one_with_its_spread():
    """Against 20,000 draws of where each stay was."""
    shown = fleet(20)
    kiosk, bank = shown.dwells
    lasted = 100.0 * np.arange(1, 21)
    drawn = (np.random.default_rng(0).random((20_000, 20)) < 0.8) @ lasted
    assert kiosk.time == pytest.approx(drawn.mean(), rel=0.01)
    assert kiosk.sigma == pytest.approx(drawn.std(), rel=0.02)
    assert (kiosk.stops, kiosk.persons, kiosk.hour) == (pytest.approx(16), pytest.approx(16), 9)
    assert kiosk.time + bank.time == pytest.approx(lasted.sum())
    [first, *_] = csv.DictReader(io.StringIO(tables(shown)["dwell.csv"].decode()))
    assert (first["place"], float(first["time"])) == ("Kiosk", pytest.approx(kiosk.time, abs=0.1))


def test_flows_and_hours_of_places_are_those_of_draws_of_where_each_stay_was():
    """Twelve persons stop four times: Kiosk, Bank, neither, Kiosk; against 20,000 draws of all stays."""
    chance = [{"Kiosk": 0.7, "Bank": 0.2}, {"Bank": 0.6, "Cafe": 0.3}, {"Cafe": 0.2}, {"Kiosk": 0.5, "Bank": 0.5}]
    legs, stays, now = [], [], 0.0
    for facing in chance:
        legs += [(WALKING, 60.0, EAST), (STANDING, 1500.0, EAST)]
        stays.append(stay(now + 60, now + 1560, facing=tuple(facing.items())))
        now += 1560
    diaries = []
    for n in range(12):
        diaries += overview_of(replace(day(outing(legs, stays=stays)), person=f"walker {n}")).diaries
    shown = overview(diaries, period_of(day="2024-05-01"))

    random, drawn = np.random.default_rng(0), defaultdict(list)
    names = [[*facing, ""] for facing in chance]
    shares = [[*facing.values(), max(1 - sum(facing.values()), 0.0)] for facing in chance]
    for _ in range(20_000):
        went = [name for own, p in zip(names, shares, strict=True) if (name := own[random.choice(len(own), p=p)])]
        for pair in {*pairwise(went)}:
            drawn[pair].append(sum(pair == other for other in pairwise(went)) if pair[0] != pair[1] else 0)
    for flow in shown.flows:
        one = np.pad(drawn[flow.origin, flow.target], (0, 20_000 - len(drawn[flow.origin, flow.target])))
        assert flow.number == pytest.approx(12 * one.mean(), abs=0.15)
        assert flow.sigma == pytest.approx(np.sqrt(12 * one.var()), rel=0.1)
    assert {(f.origin, f.target) for f in shown.flows} == {pair for pair in drawn if pair[0] != pair[1]}

    made = tables(shown)
    rows = [list(csv.DictReader(io.StringIO(made[f"{name}.csv"].decode()))) for name in ("flows", "dwell", "busy")]
    assert (rows[0][0]["origin"], rows[0][0]["target"]) == (shown.flows[0].origin, shown.flows[0].target)
    for dwelt in rows[1]:
        hours = {row["hour"]: float(row["time"]) for row in rows[2] if row["place"] == dwelt["place"]}
        assert sum(hours.values()) == pytest.approx(float(dwelt["time"]), abs=0.5)
        assert dwelt["busiest"] == max(hours, key=hours.get)
    assert f"{shown.flows[0].number:.1f} ±" in as_text(shown)


def test_the_page_of_fifty_persons_is_bounded_and_names_places_and_persons():
    few, many = (page(fleet(number), "", ())[0].decode() for number in (20, 50))
    assert many.count("<table") == few.count("<table") == 2
    assert all(f"walker {n}" in many for n in range(50))
    assert "Kiosk" in many
    assert len(as_text(fleet(50)).splitlines()) < 60
    heights = [sum(part.height for part in pictures(fleet(number), TileServer())) for number in (20, 50, 100)]
    assert heights[2] < heights[1] < 2300
