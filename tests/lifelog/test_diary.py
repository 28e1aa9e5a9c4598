"""A diary has the rows that a person would write: places, ways between them, midnights of where the person was."""

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import pairwise
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from gps_days import gps_day, true_stays
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_days import outing
from made_past import imported, location, overland, records
from pyproj import Geod

from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.corrections import apply_to_entries
from pdr_graph.apps.lifelog.day import GAP, STANDING, VEHICLE, WALKING, Day, Stay, rows_of
from pdr_graph.apps.lifelog.diary import UnpartedDiary, diary, totals_of
from pdr_graph.apps.lifelog.facts import ALWAYS, MODE, PLACE_NAME, Correction
from pdr_graph.apps.lifelog.ingest import add
from pdr_graph.apps.lifelog.past.importing import import_past
from pdr_graph.apps.lifelog.places import likely_home
from pdr_graph.apps.lifelog.stays_and_legs import Track
from pdr_graph.apps.lifelog.store import ZONE, Store
from pdr_graph.apps.lifelog.timeline import STAY, timeline
from pdr_graph.frames import Frame, enu

EAST, WEST, NORTH = 0.0, np.pi, np.pi / 2
HOUR = 3600.0
BERLIN, NEW_YORK = enu(52.5, 13.4), enu(40.7, -74.0)


def at(text):
    """Unix time of an ISO 8601 time, UTC without an offset."""
    time = datetime.fromisoformat(text)
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def diary_of(folder, *outings, zone="", facts=(), person="Anna"):
    """The diary of some outings in a new store, each on the UTC date of its start."""
    dates = sorted({datetime.fromtimestamp(o.epoch, UTC).date().isoformat() for o in outings})
    folder.mkdir(exist_ok=True)
    with Store(folder / "log", new=True) as log:
        log.put_setting(ZONE, zone)
        for date in dates:
            own = [o for o in outings if datetime.fromtimestamp(o.epoch, UTC).date().isoformat() == date]
            log.put_day(rows_of(Day(person, date, tuple(own)), date, ()))
        for fact in facts:
            log.put_correction(fact)
        return diary(log, person)


def halts(legs, epoch, **where):
    """An outing whose stands are stays, as of a day of positions."""
    made = outing(legs, epoch=epoch, **where)
    place = [made.trajectory.position[np.searchsorted(made.trajectory.time, s.start)] for s in made.segments]
    stays = [
        Stay(s.start, s.end, False, at, 4 * np.eye(2), np.nan, "")
        for s, at in zip(made.segments, place, strict=True)
        if s.kind == STANDING
    ]
    return outing(legs, epoch=epoch, stays=stays, **where)


def kinds(day):
    return [entry.kind for entry in day.entries]


@pytest.mark.parametrize(
    ("silence", "apart", "rows"),
    [
        pytest.param(3 * HOUR, 0.0, [[STAY]], id="at one place: one stay"),
        pytest.param(3 * HOUR, 800.0, [[STAY, GAP, STAY]], id="elsewhere: no stay"),
        pytest.param(40 * HOUR, 0.0, [[STAY, GAP], [GAP], [GAP, STAY]], id="longer than a night: no stay"),
    ],
)
def test_two_recordings_of_an_hour_with_a_silence_between(tmp_path, silence, apart, rows):
    """One stay says which share of it was observed."""
    first = at("2024-05-01T08:00")
    one = halts([(STANDING, HOUR, EAST)], first, frame=BERLIN)
    other = halts([(STANDING, HOUR, EAST)], first + HOUR + silence, start=(0.0, apart), frame=BERLIN)
    days = diary_of(tmp_path, one, other).days
    assert [kinds(day) for day in days] == rows
    if rows == [[STAY]]:
        [stay] = days[0].entries
        assert (stay.end - stay.start, stay.place_number) == (5 * HOUR, 1)
        assert stay.observed == pytest.approx(0.4, abs=0.01)
        assert [part.kind for part in stay.parts] == [STAY, GAP, STAY]
    if apart:
        assert [entry.place_number for entry in days[0].entries] == [1, -1, 2]


@pytest.mark.parametrize(
    ("silence", "apart", "kind", "speed"),
    [
        pytest.param(HOUR, 240.0, WALKING, (0.6, 1.2), id="a phone that wakes when its walker is on the way"),
        pytest.param(500.0, 250.0, WALKING, (0.6, 1.2), id="minutes"),
        pytest.param(500.0, 1000.0, VEHICLE, (3.0, 15.0), id="at a bus stop"),
        pytest.param(8 * HOUR, 2000.0, VEHICLE, (3.0, 15.0), id="a night with the phone asleep"),
        pytest.param(3 * HOUR, 9000.0, VEHICLE, None, id="a way of more than ten minutes: no data"),
    ],
)
@pytest.mark.parametrize("leaves", [True, False])
def test_a_silence_between_a_stay_and_a_way_has_no_more_of_the_way_than_it_needs(
    tmp_path, silence, apart, kind, speed, leaves
):
    stay, way = [(STANDING, 900, EAST)], [(kind, 900, EAST)]
    first, second = (stay, way) if leaves else (way, stay)
    epoch = at("2024-05-01T08:00")
    one = halts(first, epoch, frame=BERLIN)
    start = one.trajectory.position[-1] + [apart, 0.0]
    [day] = diary_of(tmp_path, one, halts(second, epoch + 900 + silence, start=start, frame=BERLIN)).days
    rows = day.entries if leaves else day.entries[::-1]
    if speed is None:
        assert [row.kind for row in rows] == [STAY, GAP, kind]
        return
    assert [row.kind for row in rows] == [STAY, kind]
    assert apart / speed[1] <= rows[1].duration - 900 <= apart / speed[0]
    assert rows[1].observed == pytest.approx(900 / rows[1].duration)
    assert rows[0].observed == pytest.approx(900 / rows[0].duration)


def test_who_comes_back_has_two_visits_of_one_place(tmp_path):
    there_and_back = [(STANDING, 900, EAST), (WALKING, 600, EAST), (STANDING, 900, EAST), (WALKING, 600, WEST)]
    found = diary_of(tmp_path, halts([*there_and_back, (STANDING, 900, EAST)], at("2024-05-01T09:00"), frame=BERLIN))
    assert kinds(found.days[0]) == [STAY, WALKING, STAY, WALKING, STAY]
    assert [len(place.visits) for place in found.places] == [2, 1]
    assert sum(place.duration for place in found.places) == found.days[0].totals.staying


def test_a_short_stop_is_part_of_the_walk(tmp_path):
    legs = [(STANDING, 900, EAST), (WALKING, 400, EAST), (STANDING, 100, EAST), (WALKING, 400, EAST)]
    [day] = diary_of(tmp_path, halts([*legs, (STANDING, 900, EAST)], at("2024-05-01T09:00"), frame=BERLIN)).days
    assert kinds(day) == [STAY, WALKING, STAY]
    assert STAY in [part.kind for part in day.entries[1].parts]
    assert day.totals.walked == pytest.approx(1000.0, rel=1e-3)


def test_a_ride_over_midnight_is_in_both_days_and_counted_once(tmp_path):
    legs = [(STANDING, 900, EAST), (VEHICLE, 7200, EAST), (STANDING, 900, EAST)]
    first, second = diary_of(tmp_path, halts(legs, at("2024-05-01T22:45+02:00"), frame=BERLIN)).days
    assert [first.date, second.date] == ["2024-05-01", "2024-05-02"]
    assert [kinds(first), kinds(second)] == [[STAY, VEHICLE], [VEHICLE, STAY]]
    assert first.entries[-1].end == second.entries[0].start == first.end == second.start == at("2024-05-02T00:00+02:00")
    totals = [first.totals, second.totals]
    assert [t.riding for t in totals] == pytest.approx([HOUR, HOUR], abs=10.0), "the first 50 m are at the place"
    assert sum(t.ridden for t in totals) == pytest.approx(72_000.0)
    assert sum(t.steps for t in totals) == 7200, "as of the outing"


def test_days_are_those_of_where_the_person_was(tmp_path):
    """Seven in the evening in New York is the next day in Berlin."""
    legs = [(STANDING, 1800, EAST)]
    home, away = at("2024-05-01T09:00+02:00"), at("2024-05-02T19:30-04:00")
    found = diary_of(tmp_path, halts(legs, home, frame=BERLIN), halts(legs, away, frame=NEW_YORK))
    stays = [(day.date, e.offset, e.end_offset) for day in found.days for e in day.entries if e.kind == STAY]
    assert stays == [("2024-05-01", 7200.0, 7200.0), ("2024-05-02", -14400.0, -14400.0)]
    chosen = diary_of(tmp_path / "chosen", halts(legs, away, frame=NEW_YORK), zone="Europe/Berlin").days
    assert [(day.date, day.entries[0].offset) for day in chosen] == [("2024-05-03", 7200.0)]


@pytest.mark.parametrize(("date", "hours"), [("2024-03-31", 23), ("2024-10-27", 25), ("2024-06-01", 24)])
def test_a_day_is_as_long_as_daylight_saving_makes_it(tmp_path, date, hours):
    made = halts([(STANDING, 1800, EAST)], at(f"{date}T12:00"), frame=BERLIN)
    [day] = diary_of(tmp_path, made).days
    assert (day.date, day.end - day.start) == (date, hours * HOUR)


def test_a_place_has_the_name_that_the_person_gave_it(tmp_path):
    value = {"latitude": 52.5, "longitude": 13.4, "radius": 150.0, "name": "the garden"}
    fact = Correction(0, "Anna", 0.0, PLACE_NAME, *ALWAYS, value)
    found = diary_of(tmp_path, halts([(STANDING, 900, EAST)], at("2024-05-01T09:00"), frame=BERLIN), facts=[fact])
    assert [place.name for place in found.places] == ["the garden"]
    assert found.days[0].entries[0].place == "the garden"
    assert found.days[0].totals.places == (("the garden", 900.0),)


def test_a_place_on_a_plan_has_the_name_of_the_plan(tmp_path):
    stay = Stay(0.0, 400.0, False, np.zeros(2), np.eye(2), 0.0, "0", (("Bookshop", 0.9), ("Cafe", 0.1)))
    made = outing([(STANDING, 400, EAST), (WALKING, 60, EAST)], stays=[stay], plan="mall.geojson", floor="0")
    found = diary_of(tmp_path, made)
    assert kinds(found.days[0]) == [STAY, WALKING], "its rows remain fine"
    assert [place.name for place in found.places] == ["Bookshop"]


def test_outings_without_positions_on_earth_keep_their_rows(tmp_path):
    made = outing([(WALKING, 300, EAST), (STANDING, 90, EAST), (WALKING, 300, EAST)], frame=Frame())
    [day] = diary_of(tmp_path, made).days
    assert kinds(day) == [entry.kind for entry in timeline(Day("", "", (made,)))]


def test_a_home_is_guessed_from_three_nights_only(tmp_path):
    """Nights at one place, days at another."""
    days = [at(f"2024-05-0{day}T00:00+02:00") for day in range(1, 5)]
    nights = [halts([(STANDING, 7 * HOUR, EAST)], day, frame=BERLIN) for day in days]
    work = [halts([(STANDING, 12 * HOUR, EAST)], day + 9 * HOUR, start=(2000.0, 0.0), frame=BERLIN) for day in days]
    found = diary_of(tmp_path / "four", *nights, *work)
    home = likely_home(found.places)
    assert home is not None
    assert (home.number, home.name) == (1, ""), "a guess names nothing"
    assert likely_home(diary_of(tmp_path / "two", *nights[:2], *work).places) is None


def test_a_changed_day_changes_the_diary(tmp_path):
    """The digest of a day in STORE.d is that of its present rows."""
    early = halts([(STANDING, 900, EAST)], at("2024-05-01T09:00"), frame=BERLIN)
    late = halts([(STANDING, 900, EAST), (WALKING, 600, EAST)], at("2024-05-01T09:00"), frame=BERLIN)
    assert [kinds(diary_of(tmp_path, own).days[0]) for own in (early, late)] == [[STAY], [STAY, WALKING]]


LEG = st.tuples(st.sampled_from([WALKING, STANDING, VEHICLE, GAP]), st.integers(5, 4000), st.floats(-3.0, 3.0))


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(legs=st.lists(LEG, min_size=1, max_size=12), hour=st.integers(0, 47), north=st.floats(-60.0, 60.0))
def test_each_moment_is_in_one_row(tmp_path_factory, legs, hour, north):
    made = halts(legs, at("2024-05-01") + HOUR * hour, frame=enu(north, 10.0))
    days = diary_of(tmp_path_factory.mktemp("log"), made).days
    rows = [row for day in days for row in day.entries]
    assert (rows[0].start, rows[-1].end) == (made.epoch, pytest.approx(made.epoch + sum(s for _, s, _ in legs)))
    assert all(one.end == other.start for one, other in pairwise(rows))
    assert [day.date for day in days] == sorted({day.date for day in days})
    for day in days:
        sums = day.totals
        assert sums.walking + sums.riding + sums.staying + sums.unknown == pytest.approx(day.end - day.start)
        assert 0 <= sums.observed <= day.end - day.start
        assert all(day.start <= row.start < row.end <= day.end for row in day.entries)
    for row in rows:
        assert 0 <= row.observed <= 1 + 1e-9
        if row.parts:
            assert (row.parts[0].start, row.parts[-1].end) == (row.start, row.end)
    fine = timeline(Day("", "", (made,)))
    least = sum(entry.distance for entry in fine)
    assert sum(d.totals.walked + d.totals.ridden for d in days) >= least - 1e-6, "silences on the way are added"


def test_a_simulated_day_has_its_stays_and_few_rows(tmp_path):
    made = [gps_day(41, number) for number in range(2)]
    for number, day in enumerate(made):
        day.write(tmp_path / "raw" / f"{number}.plt")
    add(tmp_path / "log", [tmp_path / "raw"])
    build(tmp_path / "log")
    with Store(tmp_path / "log") as log:
        found = diary(log, "me")
    rows = [row for day in found.days for row in day.entries if row.kind == STAY]
    true = true_stays(made, 600.0)
    for start, end, name in true:
        best = max(min(end, row.end) - max(start, row.start) for row in rows if row.end > start and row.start < end)
        assert best > 0.4 * (end - start), name  # a night is parted by midnight
    assert sum(row.end - row.start for row in rows) == pytest.approx(sum(e - s for s, e, _ in true), rel=0.05)
    assert max(len(day.entries) for day in found.days) <= 30
    assert [day.date for day in found.days] == ["2024-05-14", "2024-05-15"]
    moments = [(row, t) for start, end, _ in true for t in np.arange(start, end, 60.0) for row in rows]
    here = [(row, t) for row, t in moments if row.start <= t < row.end]
    stated = np.mean([dict(row.likely)[STAY] for row, _ in here])
    assert 0.9 < stated < len(here) / sum(len(np.arange(a, b, 60.0)) for a, b, _ in true) + 0.05, "not too sure"


def test_the_probability_of_a_row_grows_with_its_length_and_is_of_positions_alone(tmp_path):
    """Whoever states what it was, or measures steps, leaves no doubt of that kind."""
    legs = [(STANDING, 400, EAST), (WALKING, 600, EAST), (STANDING, 20 * HOUR, EAST)]
    made = replace(halts(legs, at("2024-05-01T20:00"), frame=BERLIN), steps=0)
    rows = [row for day in diary_of(tmp_path / "a", made).days for row in day.entries]
    short, _, evening, night = (dict(row.likely) for row in rows)
    assert short[STAY] < 0.6 < 0.95 < night[STAY] < 1.0
    assert evening == night, "midnight parts the row, not what is known of it"
    assert all(sum(dict(row.likely).values()) == pytest.approx(1.0) for row in rows)
    assert list(dict(rows[1].likely)) == [WALKING, VEHICLE, STAY]
    for other in (replace(made, steps=700), replace(made, plan="mall.geojson")):
        assert not any(row.likely for day in diary_of(tmp_path / f"b{other.steps}", other).days for row in day.entries)
    said = Correction(1, "me", 0.0, MODE, rows[1].start, rows[1].end, {"mode": "bus"})
    assert [row.likely for row in apply_to_entries(rows, [said], Track.of([made])) if row.corrected] == [()]


@dataclass(frozen=True, repr=False)
class Log:
    """Positions of a phone in a town. time: ``(n,)`` Unix times [s]; place: ``(n, 2)`` [m]; accuracy: [m]."""

    time: np.ndarray
    place: np.ndarray
    accuracy: float

    def diary(self, folder):
        """The rows of its diary, undivided, and the days."""
        import_past(folder / "log", [overland(folder / "x.json", self.time, TOWN.to_lonlat(self.place), self.accuracy)])
        assert not build(folder / "log").failures
        with Store(folder / "log") as log:
            return UnpartedDiary.of(log, "me", [date for _, date in log.days()]).rows, diary(log, "me").days


TOWN = enu(52.5, 13.4)


@st.composite
def logs(draw):
    """Days of stays, silences of minutes to a month, walks, rides and jumps, at any rate and accuracy."""
    random = np.random.default_rng(draw(st.integers(0, 10_000)))
    places, accuracy = random.uniform(-4000, 4000, (4, 2)), draw(st.sampled_from([5.0, 20.0, 65.0, 113.0, 250.0]))
    every = draw(st.sampled_from([10.0, 60.0, 300.0, 600.0, 1800.0]))
    now, here, time, place = at("2024-05-06T13:00"), places[0], [np.empty(0)], [np.empty((0, 2))]
    for _ in range(draw(st.integers(2, 6))):
        stay = draw(st.sampled_from([0.25, 1.0, 4.0, 10.0])) * HOUR
        time.append(now + np.arange(0, stay, every))
        place.append(np.tile(here, (len(time[-1]), 1)))
        now += stay + draw(st.sampled_from([0.0, 1900.0, 3500.0, 7200.0, 15 * HOUR, 19 * HOUR, 40 * HOUR, 720 * HOUR]))
        to, speed = places[draw(st.integers(0, 3))], draw(st.sampled_from([1.3, 9.0, np.inf]))
        lasts = np.hypot(*(to - here)) / speed
        along = np.arange(0, lasts, min(every, 60.0))
        time.append(now + along)
        place.append(here + (to - here) * along[:, None] / max(lasts, 1.0))
        now, here = now + lasts + every, to
    every_place = np.concatenate(place) + random.normal(0, accuracy / 4, (sum(map(len, place)), 2))
    return Log(np.concatenate(time), every_place, accuracy)


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(logs())
def test_no_stay_is_longer_than_its_silences_allow(tmp_path_factory, log):
    """And a walk has the speed of a walker, and the parts of a day are as long as the day by the clock."""
    rows, days = log.diary(tmp_path_factory.mktemp("log"))
    for row in rows:
        inside = (log.time >= row.start - 1) & (log.time <= row.end + 1)
        silences = np.diff([row.start, *log.time[inside], row.end])
        jumps = np.hypot(*np.diff(log.place[inside], axis=0).T)
        if row.kind == STAY:
            assert silences.max() <= 18 * HOUR + 1
            assert jumps.max(initial=0.0) <= 300 + 3 * log.accuracy
        assert row.kind != WALKING or row.distance <= 3.0 * row.duration
    assert [one.end for one in rows[:-1]] == [other.start for other in rows[1:]]
    for day in days:
        total = day.totals.walking + day.totals.riding + day.totals.staying + day.totals.unknown
        assert total == pytest.approx(day.end - day.start, abs=1)
        assert sum(row.distance for row in day.entries) == pytest.approx(day.totals.walked + day.totals.ridden)


@pytest.mark.parametrize("recorded", [False, True])
@pytest.mark.parametrize(
    ("to", "hours", "zone"), [((40.75, -73.98), 9, "America/New_York"), ((35.68, 139.76), 12, "Asia/Tokyo")]
)
def test_a_flight_is_said_and_either_end_has_its_own_metres_and_clock(tmp_path, to, hours, zone, recorded):
    """Against geodesics: a walk of 4 km and a ride of 15 km after the flight, with and without positions in the air."""
    geod, random = Geod(ellps="WGS84"), np.random.default_rng(1)
    track = [(at("2024-05-20T05:00"), 13.4, 52.52)]

    def go(metres, seconds, bearing=None, step=10.0):
        time, lon, lat = track[-1]
        for share in np.arange(step, seconds + 1, step) / seconds:
            track.append((time + share * seconds, *geod.fwd(lon, lat, bearing or 0.0, share * metres)[:2]))

    def walk_and_ride():
        go(0, 3600, step=60.0)
        for bearing in (0, 90, 180, 270):
            go(1000, 800, bearing)
        go(0, 900)
        go(15000, 1000, 60)
        go(0, 3600, step=60.0)

    walk_and_ride()
    bearing, _, far = geod.inv(*track[-1][1:], *to[::-1])
    if recorded:
        go(far, hours * 3600, bearing, step=60.0)
    else:
        track.append((track[-1][0] + hours * 3600, *to[::-1]))
    walk_and_ride()
    noise = random.normal(0, 3 / 111_000, (len(track), 2))
    export = records(
        tmp_path / "Records.json",
        [location(t, lat + e, lon + n) for (t, lon, lat), (e, n) in zip(track, noise, strict=True)],
    )
    imported(tmp_path / "log", export)
    assert build(tmp_path / "log").failures == ()
    with Store(tmp_path / "log") as log:
        own = diary(log, "me")
        outings = [one for person, date in log.days() for one in log.day(person, date).outings]
    rows = [row for day in own.days for row in day.entries if row.is_known]
    [plane] = [row for row in rows if row.mode == "plane"]
    assert (plane.kind, plane.observed) == (VEHICLE, 0.0)
    assert plane.distance == pytest.approx(far, rel=0.005)
    assert plane.duration == pytest.approx(hours * 3600, abs=300)
    for kind, metres in ((WALKING, 4000), (VEHICLE, 15000)):
        found = [row.distance for row in rows if row.kind == kind and row is not plane]
        assert found == pytest.approx([metres, metres], rel=0.01)
    offsets = [ZoneInfo(name).utcoffset(datetime(2024, 5, 20)).total_seconds() for name in ("Europe/Berlin", zone)]
    assert [(row.offset, row.end_offset) for row in (rows[0], plane, rows[-1])] == [
        (offsets[0], offsets[0]),
        tuple(offsets),
        (offsets[1], offsets[1]),
    ]
    for one in outings:  # near its frame's origin, whose north is true
        assert np.hypot(*one.trajectory.position.T).max() < 20_000
    week = totals_of(own.days, 7)
    assert week.walking + week.riding + week.staying + week.unknown <= 168 * 3600 + 1
    for day in own.days:
        own_sum = day.totals.walking + day.totals.riding + day.totals.staying + day.totals.unknown
        assert own_sum == pytest.approx(day.end - day.start)
