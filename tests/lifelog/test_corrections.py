"""Corrections are facts: they enter the estimate and the timeline, survive every rebuild, and can be undone."""

import re
import shutil
from dataclasses import replace
from datetime import datetime
from itertools import pairwise
from zoneinfo import ZoneInfo

import commands
import made_tracks as made
import numpy as np
import pytest
from gps_days import METRES
from hypothesis import given, settings
from hypothesis import strategies as some
from made_past import LAT, LON, overland
from made_past import NOON as MIDDAY
from made_tracks import HOUR, OFFICE, at, clock, place
from observations import NOON, observation, walk
from streets import USUAL, seen, streets
from test_activities import walk_and_ride
from walks import drawn_from_the_model, steps_of

from pdr_graph import InputError
from pdr_graph.apps.lifelog import cache, revision
from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.corrections import apply_to_entries, apply_to_observations, distance, place_names
from pdr_graph.apps.lifelog.corrections import corrected as as_corrected
from pdr_graph.apps.lifelog.day import GAP, STANDING, VEHICLE, WALKING
from pdr_graph.apps.lifelog.diary import diary
from pdr_graph.apps.lifelog.facts import AT, FORGOTTEN, MERGE, MODE, NOT_ME, PLACE_NAME, SPLIT, Correction
from pdr_graph.apps.lifelog.ingest import add
from pdr_graph.apps.lifelog.multi_day import estimate_together
from pdr_graph.apps.lifelog.observation import without_times
from pdr_graph.apps.lifelog.past.importing import import_past
from pdr_graph.apps.lifelog.reconstruct import reconstruct
from pdr_graph.apps.lifelog.stays_and_legs import Track
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.apps.lifelog.timeline import STAY, TimelineEntry
from pdr_graph.frames import Frame
from pdr_graph.geometry import horizontal_sigma, interpolate
from pdr_graph.types import Fixes, Headings, Sightings, Signal

DATE = "2024-05-01"
NOWHERE = Track.of([])
OVER_THERE = (3000.0, 560.0)  # [m] 60 m from where the positions say the office is


def stored(store, date=DATE, person="me"):
    """The hash of all rows of a day, and the day as corrected."""
    with Store(store) as log:
        day = log.day(person, date)
        return log.day_hash(person, date), as_corrected(day, log.corrections(person))


def rows_of(store, date=DATE, person="me"):
    with Store(store) as log:
        return [row for day in diary(log, person).days if day.date == date for row in day.entries]


def row_at(store, hours):
    [row] = [row for row in rows_of(store) if row.start <= at(hours) < row.end]
    return row


def metres(entry, where):
    """Distance of an entry from a place in metres from home."""
    longitude, latitude = made.lonlat(*where)
    return distance(latitude, longitude, entry.latitude, entry.longitude)


def longest(outing):
    """The longest stay of an outing."""
    return max(outing.stays, key=lambda stay: stay.end - stay.start)


def stated(longitude, latitude, start, end):
    """A statement of a place for some seconds after NOON."""
    value = {"latitude": latitude, "longitude": longitude, "radius": 15.0}
    return Correction(1, "me", 0.0, AT, NOON + start, NOON + end, value)


def corrected(one, *corrections):
    """The outing of an observation with corrections."""
    [outing] = reconstruct("me", DATE, apply_to_observations({"a": one}, corrections), None).outings
    return outing


# The estimate


@pytest.mark.parametrize(
    ("off", "radius", "sigma", "noted"),
    [(10.0, 15.0, (12.0, 25.0), ""), (60.0, 50.0, (40.0, 70.0), ""), (3000.0, 15.0, (12.0, 25.0), "3.0 km away")],
)
def test_a_stated_place_is_believed_within_its_radius_and_noted_if_far_from_the_positions(
    tmp_path, off, radius, sigma, noted
):
    """One statement, however long the stay; the rest of the day is as it was."""
    store, where = made.lifelog(tmp_path), (OFFICE[0], OFFICE[1] + off)
    before = stored(store)[1].outings[0].trajectory
    revision.state_place(store, clock(10), place(*where), radius=radius)
    [outing] = stored(store)[1].outings
    assert np.hypot(*(longest(outing).position - outing.frame.from_lonlat(made.lonlat(*where)[None])[0])) < 30.0
    assert metres(row_at(store, 10), where) < 30.0
    assert sigma[0] < horizontal_sigma(longest(outing).covariance) < sigma[1]
    assert [noted in note for note in outing.notes if "corrected" in note and "away" in note] == [True] * bool(noted)
    elsewhere = (before.time < 3600 - 1200) | (before.time > 4 * HOUR + 1800)
    moved = before.position - interpolate(before.time, outing.trajectory.time, outing.trajectory.position)
    assert np.hypot(*moved[elsewhere].T).max() < 5.0
    assert row_at(store, 10).corrected


def test_a_stated_activity_enters_the_estimate(tmp_path):
    store = made.lifelog(tmp_path)
    revision.state_mode(store, clock(9), clock(9 + 1 / 6), "bicycle")
    [bicycle] = [row for row in rows_of(store) if row.mode == "bicycle"]
    assert (bicycle.kind, bicycle.corrected) == (VEHICLE, True)
    revision.state_mode(store, clock(9), clock(9 + 1 / 6), "walk")
    [outing] = stored(store)[1].outings
    kinds = {s.kind for s in outing.segments if at(9.02) < outing.epoch + s.start and outing.epoch + s.end < at(9.15)}
    assert VEHICLE not in kinds
    assert row_at(store, 9.1).kind == WALKING


def test_a_stated_ride_and_a_stated_walk_change_the_rides_of_a_walk_with_steps():
    steps, fixes, (begin, end), _ = walk_and_ride([("bus", 400)], bumps=1.0, walks=200)
    one = observation(steps, fixes)

    def ridden(*corrections):
        return sum(s.end - s.start for s in corrected(one, *corrections).segments if s.kind == VEHICLE)

    usual = ridden()
    assert usual == pytest.approx(end - begin, abs=120)
    walked = Correction(1, "me", 0.0, MODE, NOON, NOON + steps.end, {"mode": "walk"})
    assert ridden(walked) == 0.0
    bus = Correction(1, "me", 0.0, MODE, NOON, NOON + 200, {"mode": "bus"})
    assert ridden(bus) == pytest.approx(usual + 200, abs=60)


@pytest.mark.parametrize("off", [60.0, 150.0])
def test_a_stated_place_far_from_the_positions_does_not_drag_a_walk_with_steps_along(off):
    where, done = streets([("walk", 600), ("stand", 600), ("walk", 600)], 0)
    foot = np.flatnonzero(done[:-1] == "walk")
    heading = np.unwrap(np.arctan2(*np.diff(where, axis=0).T[::-1]))
    steps = steps_of(np.maximum(np.hypot(*np.diff(where, axis=0).T)[foot], 0.1), np.diff(heading[foot], prepend=0.0))
    steps = replace(steps, time=foot + 1.0, duration=np.full(len(foot), 0.9), end=float(len(where) - 1))
    one = observation(steps, seen(where, USUAL, 5, 0))
    longitude, latitude = one.frame.to_lonlat((where[900] + [0.0, off])[None])[0]
    outing = corrected(one, stated(longitude, latitude, 605.0, 1195.0))
    time = outing.trajectory.time
    error = np.hypot(*(outing.trajectory.position - interpolate(time, np.arange(float(len(where))), where)).T)
    assert np.median(error[(time < 550) | (time > 1250)]) < 10.0, "the walk before and after is where it was"
    assert np.hypot(*(longest(outing).position - where[900] - [0.0, off])) < 15.0
    assert 12.0 < horizontal_sigma(longest(outing).covariance) < 25.0


def test_a_stated_place_is_the_first_position_of_a_walk_without_any():
    steps, fixes, _ = drawn_from_the_model(60, 0)
    frame = observation(steps, fixes).frame
    longitude, latitude = frame.to_lonlat(np.array([[200.0, 100.0]]))[0]
    outing = corrected(observation(steps, Fixes.none(), frame=Frame()), stated(longitude, latitude, 5.0, 8.0))
    assert outing.frame.georeferenced
    where = interpolate(np.array([6.5]), outing.trajectory.time, outing.trajectory.position)
    assert np.hypot(*(where - outing.frame.from_lonlat(np.array([[longitude, latitude]]))).T)[0] < 20.0


def test_what_is_not_mine_is_shown_as_no_data(tmp_path):
    store = made.lifelog(tmp_path)
    before = stored(store)[0]
    revision.state_not_me(store, clock(10), clock(11))
    bounds = [(s.kind, o.epoch + s.start, o.epoch + s.end) for o in stored(store)[1].outings for s in o.segments]
    assert all(kind == GAP for kind, start, end in bounds if start < at(10.9) and end > at(10.1))
    assert bounds
    assert (row_at(store, 10.5).kind, row_at(store, 10.5).corrected) == (GAP, True)
    revision.undo(store, 1)
    assert stored(store)[0] == before


# Facts


def every_kind(store):
    """Make a correction of each kind."""
    revision.state_place(store, clock(10), place(*OVER_THERE))
    revision.state_mode(store, clock(9), clock(9 + 1 / 6), "bus")
    revision.state_not_me(store, clock(12.5), clock(12.75))
    revision.merge(store, clock(10), clock(11))
    revision.split(store, clock(10.5))
    revision.name_place(store, place(*OFFICE), "office")


def test_a_rebuild_from_scratch_gives_the_same_day_to_the_byte_and_undoing_all_the_first_one(tmp_path):
    store = made.lifelog(tmp_path)
    first, first_rows = stored(store)[0], rows_of(store)
    every_kind(store)
    before, rows = stored(store)[0], rows_of(store)
    assert (before, rows == first_rows) == (first, False), "positions alone are estimated as they were recorded"
    assert build(store).built == 0
    with Store(store) as log:
        left = [len(list((log.folder / name).iterdir())) for name in (cache.DAYS, cache.OBSERVATIONS)]
        assert left == [0, 1], "no stray files"
        log.delete_days(list(log.days()))
        for entry in log.entries():
            log.put(replace(entry, observation="", epoch=None, duration=None, steps=None))
    shutil.rmtree(log.folder)
    assert build(store).built == 1
    assert (stored(store)[0], repr(rows_of(store))) == (before, repr(rows))
    for number in (3, 1, 6, 2, 5, 4):
        revision.undo(store, number)
    assert (stored(store)[0], repr(rows_of(store))) == (first, repr(first_rows))
    assert revision.listing(store) == ["no corrections"]


def test_corrections_of_positions_rebuild_nothing_and_stay(tmp_path):
    store = made.lifelog(tmp_path, days=3)
    revision.state_place(store, clock(10, day=2), place(*OVER_THERE))
    assert build(store).built == 0
    before = [(stored(store, f"2024-05-0{n}")[0], repr(rows_of(store, f"2024-05-0{n}"))) for n in (1, 2, 3)]
    assert estimate_together(store) == 3
    after = [(stored(store, f"2024-05-0{n}")[0], repr(rows_of(store, f"2024-05-0{n}"))) for n in (1, 2, 3)]
    assert after == before, "an estimate of all days keeps it"


def test_labels_rebuild_nothing(tmp_path):
    store = made.lifelog(tmp_path)
    before = stored(store)[0]
    revision.split(store, clock(10.5))
    revision.merge(store, clock(8.5), clock(10))
    lines = revision.name_place(store, clock(11), "office")
    assert stored(store)[0] == before
    assert not any("rebuilt" in line for line in lines)
    assert row_at(store, 11).place == "office"


def test_corrections_of_one_person_do_not_touch_another(tmp_path):
    store = made.lifelog(tmp_path)
    made.write(tmp_path / "ben.plt", *made.positions(seed=9))
    add(store, [tmp_path / "ben.plt"], person="ben")
    build(store)
    before = stored(store, person="ben")[0]
    revision.state_place(store, clock(10), place(*OVER_THERE), person="me")
    assert stored(store, person="ben")[0] == before
    with pytest.raises(InputError, match="no choice, 2 persons, expected one of ben, me"):
        revision.split(store, clock(10))


# The timeline

ENTRIES = [
    TimelineEntry(STAY, 0.0, 100.0, latitude=48.1, longitude=11.5, sigma=5.0),
    TimelineEntry(WALKING, 100.0, 200.0, 130.0),
    TimelineEntry(STAY, 200.0, 500.0, latitude=48.101, longitude=11.5, sigma=7.0),
    TimelineEntry(GAP, 500.0, 600.0),
    TimelineEntry(VEHICLE, 600.0, 900.0, 3000.0),
]


def correction(kind, start, end, number=1, **value):
    return Correction(number, "me", 0.0, kind, start, end, value)


def test_entries_are_merged_divided_and_filled():
    first, *rest = apply_to_entries(ENTRIES, [correction(MERGE, 0.0, 500.0)], NOWHERE)
    assert (first.kind, first.start, first.end, first.corrected) == (STAY, 0.0, 500.0, True)
    assert first.latitude == pytest.approx(48.1 + 0.001 * 300 / 400), "the mean by time"
    assert rest == ENTRIES[3:]
    *_, first, second = apply_to_entries(ENTRIES, [correction(SPLIT, 700.0, 700.0)], NOWHERE)
    assert (first.end, second.start) == (700.0, 700.0)
    assert (first.distance, second.distance) == (pytest.approx(1000.0), pytest.approx(2000.0))
    value = {"latitude": 48.2, "longitude": 11.6, "radius": 15.0, "name": "the lake"}
    [_, _, _, lake, _] = apply_to_entries(ENTRIES, [correction(AT, 500.0, 600.0, **value)], NOWHERE)
    assert (lake.kind, lake.place, lake.latitude, lake.sigma) == (STAY, "the lake", 48.2, 15.0)


def test_a_later_correction_overrules_an_earlier_one():
    bus, car = correction(MODE, 600.0, 900.0, 1, mode="bus"), correction(MODE, 600.0, 900.0, 2, mode="car")
    assert apply_to_entries(ENTRIES, [bus, car], NOWHERE)[-1].mode == "car"
    assert apply_to_entries(ENTRIES, [bus, correction(NOT_ME, 0.0, 900.0, 2)], NOWHERE)[-1].kind == GAP
    value = {"latitude": 48.1, "longitude": 11.5, "radius": 75.0}
    named = [correction(PLACE_NAME, -np.inf, np.inf, n, **value, name=name) for n, name in enumerate("ab")]
    assert place_names(named) == [(48.1, 11.5, 75.0, "a"), (48.1, 11.5, 75.0, "b")], "in the order stated"


KINDS_AND_VALUES = some.sampled_from([
    (MERGE, {}),
    (SPLIT, {}),
    (NOT_ME, {}),
    (FORGOTTEN, {}),
    (MODE, {"mode": "bus"}),
    (MODE, {"mode": "stop"}),
    (AT, {"latitude": 48.1, "longitude": 11.5, "radius": 15.0}),
])  # fmt: skip
TIMES = some.integers(-100, 1000).map(float)


@settings(max_examples=200)
@given(some.lists(some.tuples(KINDS_AND_VALUES, TIMES, TIMES), max_size=6))
def test_corrected_entries_still_cover_every_second_once(drawn):
    facts = []
    for n, ((kind, value), a, b) in enumerate(drawn):
        start, end = min(a, b), max(a, b)
        facts.append(correction(kind, start, start if kind == SPLIT else end, n, **value))
    found = apply_to_entries(ENTRIES, facts, NOWHERE)
    assert (found[0].start, found[-1].end) == (0.0, 900.0)
    assert all(before.end == after.start for before, after in pairwise(found))
    assert sum(e.distance for e in found) <= 3130.0 + 1e-6
    assert all(e.kind in (STAY, WALKING, VEHICLE, GAP, STANDING) for e in found)


# Masking


def full_observation():
    """A walk of 60 steps with a value of every kind of table."""
    one = walk(60)[0]
    time = np.arange(0.0, one.duration, 0.5)
    heard = Sightings(time, tuple(f"ap {n}" for n in range(len(time))), -time)
    headings = Headings(time, 0 * time, 0 * time + 0.1)
    return replace(
        one,
        headings=headings,
        barometer=Signal(time, time[:, None]),
        wifi=heard,
        bluetooth=heard,
        measurements=(headings,),
        notes=("a note of everything",),
    )


@settings(max_examples=100)
@given(some.lists(some.tuples(some.floats(-5, 40), some.floats(0, 20)), min_size=1, max_size=3))
def test_nothing_measured_in_a_masked_time_remains(drawn):
    one = full_observation()
    spans = [(NOON + start, NOON + start + long) for start, long in drawn]
    cut = without_times(one, spans, "masked")
    if cut is None:
        assert max(end for _, end in spans) > NOON
        return
    tables = (cut.fixes, cut.headings, cut.barometer, cut.wifi, cut.bluetooth, *cut.measurements)
    times = [table.time for table in tables if table is not None]
    if cut.steps is not None:
        walked = ~cut.steps.is_gap
        times += [cut.steps.time[walked], (cut.steps.time - cut.steps.duration)[walked]]
        assert len(cut.looks) == len(cut.steps) + 1
    for start, end in spans:
        for time in times:
            inside = (cut.epoch + time > start + 1e-5) & (cut.epoch + time < end - 1e-5)
            assert not inside.any()
    if cut is not one:
        assert cut.notes == ("masked",)


def test_outside_of_a_masked_time_everything_remains():
    one = full_observation()
    cut = without_times(one, [(NOON + 10.0, NOON + 20.0)], "masked")
    assert cut.wifi.time.tolist() == [time for time in one.wifi.time if not 10 <= time <= 20]
    kept = (one.steps.time <= 10) | (one.steps.time - one.steps.duration >= 20)
    assert cut.steps.length[~cut.steps.is_gap].tolist() == one.steps.length[kept].tolist()
    [gap] = np.flatnonzero(cut.steps.is_gap)
    assert cut.steps.time[gap] >= 20.0
    assert without_times(one, [(NOON + 1e4, NOON + 2e4)], "masked") is one


def test_the_frame_is_not_about_a_masked_position():
    one = full_observation()
    cut = without_times(one, [(NOON - 10.0, NOON + 15.0)], "masked")
    assert cut.frame.origin != one.frame.origin
    assert cut.epoch == pytest.approx(NOON + 15.0)
    there = cut.frame.to_lonlat(cut.fixes.position)
    was = one.frame.to_lonlat(one.fixes.position[one.fixes.time > 15.0])
    assert there == pytest.approx(was, abs=1e-9)


# The command line


def run(*arguments):
    return commands.run("lifelog", "correct", *arguments)


def test_the_commands_correct_list_and_undo(tmp_path):
    store = made.lifelog(tmp_path)
    code, printed, _ = run("was-at", store, clock(10), place(*OVER_THERE))
    assert (code, "corrected" in printed) == (0, True)
    for name, *rest in (
        ("was", clock(9), clock(9.1), "tram"),
        ("merge", clock(10), clock(11)),
        ("split", clock(10.5)),
        ("not-me", clock(8), clock(8.25)),
        ("name", clock(11), "office"),
        ("name", "-33.45,-70.66", "far south"),
    ):
        assert run(name, store, *rest)[0] == 0
    code, printed, _ = run("list", store)
    assert (code, len(printed.splitlines())) == (0, 7)
    assert "was tram" in printed
    assert "(made 20" in printed
    code, printed, _ = run("undo", store, 2)
    assert re.match(r"undone: 2  me  2024-05-01 0[89]:\S+ to 09:06:00: was tram", printed)
    assert len(run("list", store)[1].splitlines()) == 6


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """A lifelog that no test changes."""
    return made.lifelog(tmp_path_factory.mktemp("shared"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("was-at", "2024-05-01 10:00", "nowhere"), "LAT,LON in degrees or the name of a place"),
        (("was-at", "2024-05-01 10:00", "111.5,48.1"), "swapped?"),
        (("was-at", "2024-06-01 10:00", "48.1,11.5"), "nothing of me at 2024-06-01 10:00"),
        (("was-at", "ten", "48.1,11.5"), "a local time such as"),
        (("was", "2024-05-01 10:00", "2024-05-01 09:00", "bus"), "a later time"),
        (("was", "2024-05-01 09:00", "2024-05-01 09:10", "rocket"), "one of bus, car"),
        (("undo", "7"), "the number of a correction"),
        (("name", "2024-05-01 09:05", "on the way"), "the time of a stay, or LAT,LON"),
        (("forget", "2024-05-01 09:05"), "FROM and TO"),
    ],
)
def test_a_correction_that_cannot_be_made_is_one_line(shared, arguments, message):
    name, *rest = arguments
    code, _, errors = run(name, shared, *rest)
    assert (code, len(errors)) == (2, 1)
    assert message in errors[0]
    assert revision.listing(shared) == ["no corrections"]


def test_the_list_and_the_page_of_a_day_show_what_was_corrected(tmp_path):
    store = made.lifelog(tmp_path)
    revision.state_mode(store, clock(9), clock(9 + 1 / 6), "bus")
    revision.name_place(store, place(*OFFICE), "office")
    revision.state_place(store, clock(10), "office")
    done = commands.run("lifelog", "show", store, "--date", DATE, "--out", tmp_path / "out")
    assert done.code == 0
    assert " bus " in done.output
    assert "office; corrected" in done.output
    assert "office; corrected" in (tmp_path / "out" / "overview.html").read_text()


@pytest.fixture(scope="module")
def ridden(tmp_path_factory):
    """A lifelog with stays, walks and a ride."""
    folder = tmp_path_factory.mktemp("ridden")
    speeds = [(0.0, 3600), (1.3, 600), (7.8, 700), (0.0, 2700), (1.3, 480), (0.0, 1800)]
    east = np.cumsum(np.repeat(*zip(*speeds, strict=True)))
    time = np.arange(0, len(east), 10)
    metres = np.random.default_rng(0).normal(0, 4, (len(time), 2)) + np.outer(east[time], [1, 0])
    file = overland(folder / "a.json", MIDDAY + time, np.array([LON, LAT]) + metres / METRES, 10)
    import_past(folder / "log", [file])
    build(folder / "log")
    return folder


def as_mode(mode):
    return lambda store, row, *span: revision.state_mode(store, *span, mode)


def as_place(store, row, start, end):
    """600 m north of where it was."""
    if row.kind == STAY:
        revision.state_place(store, start, f"{row.latitude + 600 / 111_195},{row.longitude}")


CORRECTIONS = {
    "not me": lambda store, row, *span: revision.state_not_me(store, *span),
    "forget": lambda store, row, *span: revision.forget(store, *span),
    "merge": lambda store, row, *span: revision.merge(store, *span),
    "place": as_place,
    **{mode: as_mode(mode) for mode in ("bus", "walk", "stop")},
}


@pytest.mark.parametrize("state", CORRECTIONS)
def test_a_correction_changes_no_metre_or_minute_outside_its_row(tmp_path, ridden, state):
    """Of each row in turn; the stays, walks and ride beside it keep their ends to 10 s and their metres to 3 %."""
    known = [row for row in rows_of(ridden / "log") if row.is_known]
    assert [row.kind for row in known] == [STAY, WALKING, VEHICLE, STAY, WALKING, STAY]
    for n, row in enumerate(known):
        folder = tmp_path / str(n)
        shutil.copytree(ridden, folder)
        local = [
            datetime.fromtimestamp(t, ZoneInfo("Europe/Berlin")).strftime("%Y-%m-%d %H:%M:%S")
            for t in (row.start, row.end)
        ]
        CORRECTIONS[state](folder / "log", row, *local)
        after = [other for other in rows_of(folder / "log") if other.is_known and other.start != row.start]
        kept = [other for other in known if other is not row]
        assert [other.kind for other in after] == [other.kind for other in kept]
        for one, other in zip(kept, after, strict=True):
            assert (other.start, other.end) == pytest.approx((one.start, one.end), abs=10)
            assert other.distance == pytest.approx(one.distance, rel=0.03)
