"""Private places: neither a byte of an export reveals them, nor do many days of exports together."""

import csv
import json
import re
from dataclasses import replace
from itertools import pairwise
from zoneinfo import ZoneInfo

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from made_days import HERE, MIDNIGHT, NOWHERE, PACE, PERIOD, day, outing, stay
from tiers import thorough

from pdr_graph.apps.lifelog.day import GAP, PRIVATE, STANDING, VEHICLE, WALKING, Segment, sampled
from pdr_graph.apps.lifelog.export import as_csv, as_geojson, as_gpx
from pdr_graph.apps.lifelog.privacy import PrivatePlace, nested_squares, private_places, without_private_places
from pdr_graph.apps.lifelog.timeline import timeline, timeline_csv
from pdr_graph.errors import InputError
from pdr_graph.frames import Frame, enu
from pdr_graph.geometry import length_along
from pdr_graph.types import Trajectory

SECRET, RADIUS = b"of one lifelog", 143.0  # [m] in a square of 250 m, the least that hides it
HOME = np.array([0.0, 0.0])  # in made days: where the frame's origin is, as in a lifelog that begins at home
ZONE = ZoneInfo("America/Santiago")


def circle(place=HOME, radius=RADIUS):
    lon, lat = HERE.to_lonlat(np.array([place], dtype=float))[0]
    return f"{lat:.7f},{lon:.7f},{radius}"


def hidden(*places, secret=SECRET):
    return private_places(places or [circle()], [], secret)


def left_of(*outings, cut=None, blur=()):
    """What is left of a day with outings; by default the home is cut."""
    [left], _ = without_private_places([day(*outings)], hidden() if cut is None else cut, list(blur))
    return left


def streets(random, minutes=20, start=HOME):
    """Legs in a town of blocks, in random directions, mostly straight on."""
    heading = random.integers(4) * np.pi / 2
    legs = []
    while sum(seconds for _, seconds, _ in legs) < 60 * minutes:
        legs.append((WALKING, float(random.uniform(40, 160)), heading))
        heading += random.choice([0.0, np.pi / 2, -np.pi / 2], p=[0.4, 0.3, 0.3])
    return outing(legs, start=start)


def backwards(walk):
    """The same legs back to the start."""
    end = walk.trajectory.time[-1]
    track = replace(walk.trajectory, time=end - walk.trajectory.time[::-1], position=walk.trajectory.position[::-1])
    segments = [replace(s, start=end - s.end, end=end - s.start) for s in walk.segments[::-1]]
    return replace(walk, trajectory=track, segments=tuple(segments), epoch=walk.epoch + 7200)


def exported(days, leave_out=()):
    """The exports of days in all formats, without some columns of the tables."""
    tables = [text for own in days for text in (as_csv(own).decode(), timeline_csv(timeline(own)))]
    rows = [row.items() for text in tables for row in csv.DictReader(text.splitlines())]
    cells = [",".join(f"{name}={value}" for name, value in row if name not in leave_out) for row in rows]
    return "\n".join([as_gpx(days).decode(), as_geojson(days).decode(), *cells])


def nearest(text, place=HOME):
    """Distance [m] from a place of all pairs of numbers in a line, tag or bracket that may be degrees nearby.

    Columns of metres may look like degrees; they are tested by the frame's origin below.
    """
    units = [unit for unit in re.split(r"[\n<>\[\]{}]+", text) if "-34." in unit or "-35." in unit]
    numbers = [[float(n) for n in re.findall(r"-?\d+\.\d+", unit)] for unit in units]
    pairs = [(lon, lat) for own in numbers for lat in own if abs(lat + 35) < 0.5 for lon in own if abs(lon + 71) < 0.5]
    return np.hypot(*(HERE.from_lonlat(np.array(pairs)) - place).T).min() if pairs else np.inf


@given(seed=st.integers(0, 10**6), radius=st.floats(20, 400), home=st.booleans())
@settings(max_examples=8)
def test_no_byte_of_an_export_has_a_coordinate_in_a_cut_place(seed, radius, home):
    random = np.random.default_rng(seed)
    place = HOME if home else random.uniform(-300, 300, 2)  # which may lie on the way
    walk = replace(streets(random), stays=(stay(1.0, 30.0, place, [("Home", 0.9)]),))
    there, back = day(walk, backwards(walk)), day(streets(random))
    left, _ = without_private_places([there, back], hidden(circle(place, radius)), [])
    assert nearest(exported(left, leave_out=("x", "y")), place) > radius
    assert not re.search(r"(?i)home|anna/|5f3b", exported(left))  # a stay's name, a path, a hash, a note
    if home:  # the control: the same search finds what was not cut
        assert nearest(exported([there, back], leave_out=("x", "y")), place) < 1


@given(seed=st.integers(0, 10**6))
@settings(max_examples=8)
def test_activities_in_a_cut_place_change_no_byte(seed):
    """Positions, durations within a quarter of an hour, recordings and looks in it."""
    random = np.random.default_rng(seed)
    [place] = hidden()
    out = streets(random)
    back = backwards(out)
    inside = np.flatnonzero(place.hides(HERE.to_lonlat(out.trajectory.position)))
    first = 1 + inside[np.flatnonzero(np.diff(inside, append=np.inf) > 1)[0]]  # the first row outside

    def moved(walk, rows):
        """The outing with its hidden rows elsewhere in the place."""
        position = walk.trajectory.position.copy()
        position[rows] = place.frame.from_lonlat(HERE.to_lonlat(position[rows])) * 0.3 + random.uniform(-40, 40, 2)
        return replace(walk, trajectory=replace(walk.trajectory, position=position))

    other = moved(out, slice(0, first - 3)), moved(back, slice(len(back.trajectory) - first + 3, None))
    other = tuple(
        replace(walk, recordings=("77" * 32,), source="other", stays=(stay(0, 20, HOME, [("Bank", 1.0)]),))
        for walk in other
    )
    assert "Bank" in exported([day(*other)])
    one, another = (exported([left_of(*walks)]) for walks in ((out, back), other))
    rounded_distance = r'(?<="distance": )[\d.]+|(?<=distance=)[\d.]+'
    assert re.sub(rounded_distance, "", one) == re.sub(rounded_distance, "", another)


def rows_of(track, rows):
    """Some rows of a trajectory."""
    columns = (track.time[rows], track.position[rows], track.heading[rows], tuple(np.array(track.floor)[rows]))
    return Trajectory(*columns, track.covariance[rows])


def test_a_recording_that_began_elsewhere_in_a_cut_place_gives_the_same_bytes():
    """Also one that began earlier: the time to the first row would reveal the distance from home."""
    legs = [(WALKING, 900.0, 0.0), (WALKING, 600.0, np.pi / 2)]
    whole = outing(legs)
    track = rows_of(whole.trajectory, whole.trajectory.time >= 60)
    begun_late = replace(
        whole,
        epoch=whole.epoch + 60,
        trajectory=replace(track, time=track.time - 60),
        segments=(Segment(WALKING, 0.0, 840.0, 840 * PACE[WALKING]), Segment(WALKING, 840.0, 1440.0, 750.0)),
    )
    one, other = left_of(whole), left_of(begun_late)
    assert one.outings
    assert exported([one]) == exported([other])


def test_the_length_of_a_hidden_path_is_not_revealed():
    """A gap that begins at home is bridged by rows on the line to it."""
    made = outing([(STANDING, 100.0, 0.0), (GAP, 3000.0, 0.0), (WALKING, 600.0, 1.0)])
    time = made.trajectory.time
    bridge = np.r_[time[time <= 100], np.arange(400.0, 3000.0, 300.0), time[time >= 3100]]
    bridged = replace(made, trajectory=sampled(made.trajectory, bridge))
    one, other = left_of(made), left_of(bridged)
    assert [s.kind for s in other.outings[0].segments] == [WALKING]
    assert exported([one]) == exported([other])


def test_the_distance_of_a_short_hidden_visit_is_not_revealed():
    """A visit to the door and one to the far end, through the same entrance, have the same export."""

    def visit(seconds):
        into = [(WALKING, 900.0, 0.0), (WALKING, seconds / 2, np.pi / 2), (WALKING, seconds / 2, -np.pi / 2)]
        walk = outing([*into, (WALKING, 900.0, np.pi)], epoch=MIDNIGHT)
        left = left_of(walk, cut=hidden(circle((900 * PACE[WALKING], 40.0), 100)))
        return [(s.kind, s.start, s.end) for o in left.outings for s in o.segments]

    one, other = visit(60), visit(300)  # either leaves within the same quarter of an hour
    assert [kind for kind, *_ in one] == [WALKING, PRIVATE, WALKING]
    assert np.allclose([t for _, *t in one], [t for _, *t in other], atol=PERIOD)


@given(seed=st.integers(0, 10**6), radius=st.floats(1, 1e5), lat=st.floats(-89, 89), lon=st.floats(-180, 180))
@settings(max_examples=50)
def test_the_hidden_area_covers_the_place_and_depends_on_the_secret_alone(seed, radius, lat, lon):
    text = f"{lat:.6f},{lon:.6f},{radius:.1f}"
    (one,), (again,), (other,) = (hidden(text, secret=s) for s in (SECRET, SECRET, b"other"))
    assert shapely.covers(one.hidden, one.shape)
    assert shapely.equals(one.hidden, again.hidden)
    assert shapely.distance(shapely.centroid(one.hidden), shapely.centroid(other.hidden)) > 0
    assert 2.2 * radius < np.sqrt(shapely.area(one.hidden) / np.pi) < 3.6 * radius


def test_the_hidden_area_locates_the_place_to_a_square_that_the_secret_shifts():
    """Its middle is 0.38 of a side and at least 2/3 r away on average, over 500 secrets, to 4 standard deviations."""
    areas = [hidden(secret=n.to_bytes(4, "big"))[0] for n in range(500)]
    apart = np.array([HERE.from_lonlat(a.frame.to_lonlat(np.zeros((1, 2))))[0] - HOME for a in areas])
    side = nested_squares(np.array([[-71.0, -35.0]]), np.array([1.75 * RADIUS]))[1][0]
    assert (np.abs(apart) <= 0.501 * side).all()
    assert (apart.var(axis=0) / (side**2 / 12)) == pytest.approx(np.ones(2), abs=4 * np.sqrt(0.8 / 500))
    assert np.hypot(*apart.T).mean() == pytest.approx(0.3826 * side, abs=4 * 0.142 * side / np.sqrt(500))
    assert 0.3826 * side > 2 / 3 * RADIUS


@given(number=st.integers(0, 10**6), lat=st.floats(-80, 80), lon=st.floats(-179, 179))
@settings(max_examples=50)
def test_several_radii_reveal_no_more_than_the_smallest_square(number, lat, lon):
    """Each hidden area gives its square away; they lie within one another, so the smallest is all that is learned."""
    texts = [f"{lat:.7f},{lon:.7f},{radius}" for radius in (60, 90, 143, 200, 320, 450, 800)]
    squares = [square_of(place) for place in hidden(*texts, secret=number.to_bytes(4, "big"))]
    assert all(shapely.covers(rounded(square), shapely.Point(round(lon, 7), round(lat, 7))) for square in squares)
    assert all(shapely.covers(rounded(outer), inner) for inner, outer in pairwise(squares))


def square_of(place):
    """The square [deg] whose middle is that of a hidden area, as anyone finds out who locates it."""
    half = np.sqrt(0.5) * (np.sqrt(shapely.area(place.hidden) / np.pi) / 1.001 - place.radius)
    return shapely.Polygon(place.frame.to_lonlat(half * np.array([(-1, -1), (-1, 1), (1, 1), (1, -1)])))


def rounded(square):
    """A square and 0.5 % of its side around it: a circle of an area is a polygon."""
    return shapely.buffer(square, 0.005 * np.sqrt(square.area))


def ends(days):
    """Where tracks from home begin and tracks to home end, and the tracks there ``(n, 2)`` each."""
    found = []
    for walk in (o for own in days for o in own.outings):
        track = HERE.from_lonlat(walk.frame.to_lonlat(walk.trajectory.position))
        track = track if walk.epoch < MIDNIGHT + 10.5 * 3600 else track[::-1]
        found.append((track[0], track[0] - track[30]))
    return np.array(found).reshape(-1, 2, 2).transpose(1, 0, 2)


def centre_of_circle(points, _):
    """Least squares: x² + y² = 2ax + 2by + c."""
    solution = np.linalg.lstsq(np.column_stack([2 * points, np.ones(len(points))]), (points**2).sum(1), rcond=None)[0]
    return solution[:2]


def middle(points, _):
    return points.mean(axis=0)


def where_lines_meet(points, ways):
    """The point nearest to all lines."""
    ways = ways / np.hypot(*ways.T)[:, None]
    across = np.eye(2) - ways[:, :, None] * ways[:, None, :]
    return np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, points), rcond=None)[0]


ATTACKS = (centre_of_circle, middle, where_lines_meet)


def guesses(hide, secrets, days):
    """Distance of each attack's guess from home ``(attacks, secrets)`` in radii, from the exports of some days."""
    found = []
    for n in range(secrets):
        random = np.random.default_rng(n)
        walks = [[streets(random, minutes=16) for _ in range(2)] for _ in range(days)]
        points, ways = ends(without_private_places([day(out, backwards(back)) for out, back in walks], hide(n), [])[0])
        if len(points) > 2:  # a circle takes three; some walks never leave what is hidden
            found.append([np.hypot(*(attack(points, ways) - HOME)) / RADIUS for attack in ATTACKS])
    assert len(found) > 0.8 * secrets
    return np.array(found).T


@pytest.mark.parametrize("days", [2, thorough(6)])
def test_the_ends_of_tracks_reveal_no_more_than_the_hidden_area(days):
    """On average 2/3 r from home, or √π r / √n by n ends of walks that lead as often anywhere; less 4 standard errors.

    A guess that is as good as the hidden area's middle is 2/3 r away with a variance of r²/18.
    """
    away = guesses(lambda n: hidden(secret=n.to_bytes(4, "big")), secrets := 30, days)
    bound = min(2 / 3, np.sqrt(np.pi / (2 * days)))
    assert (away.mean(axis=1) > bound - 4 * np.sqrt(1 / 18 / secrets)).all(), away.mean(axis=1)


def test_a_plain_circle_would_reveal_its_centre():
    """The control: the same attacks on tracks cut at a plain circle."""

    def plainly(_):
        shape = shapely.Point(0, 0).buffer(RADIUS, quad_segs=64)
        return [PrivatePlace("", HERE, shape, shape, 0.0)]

    away = guesses(plainly, 5, 6)
    assert away.min(axis=0).max() < 0.05


def test_no_track_points_at_a_hidden_area_nearby():
    [place] = hidden()
    checked = 0
    for seed in range(30):
        for walk in left_of(streets(np.random.default_rng(seed)), cut=[place]).outings:
            if (walk.epoch - MIDNIGHT) % 900:
                continue
            track = place.frame.from_lonlat(walk.frame.to_lonlat(walk.trajectory.position))
            leg = np.flatnonzero(np.hypot(*(track - track[0]).T) >= 30)[0]
            ray = shapely.LineString([track[0], track[0] + 50 * (track[0] - track[leg])])
            away = shapely.distance(place.hidden, shapely.Point(track[0]))
            assert not shapely.intersects(ray, place.hidden) or away > 2 * RADIUS - 1, seed
            checked += 1
    assert checked > 20


def test_the_origin_of_a_frame_is_not_home():
    """The first position is often at home; x and y beside latitude and longitude would reveal it."""
    home = enu(-35.00341, -71.00482)
    walk = replace(streets(np.random.default_rng(3)), frame=home)
    left = left_of(walk, cut=hidden("-35.00341,-71.00482,150"))
    text = as_csv(left).decode()
    row = next(csv.DictReader(text.splitlines()))
    x, y, lat, lon = (float(row[name]) for name in ("x", "y", "latitude", "longitude"))
    assert left.outings[0].frame.from_lonlat(np.array([[lon, lat]]))[0] == pytest.approx((x, y), abs=0.01)
    origin = home.from_lonlat(np.array([left.outings[0].frame.origin[::-1]]))[0]
    assert np.hypot(*origin) > 150
    assert np.hypot(*(origin - home.from_lonlat(np.array([[lon, lat]]))[0])) < 800  # near what is shown: half of 0.01°


def test_tracks_far_from_private_places_are_unchanged():
    far = outing([(WALKING, 300.0, 0.3), (STANDING, 100.0, 0.3)], start=(9000.0, 0.0), stays=[stay(300, 400)])
    far = replace(far, stays=(stay(301, 399, (9300.0, 100.0), [("Kiosk", 0.8)]),))
    [left], notes = without_private_places([day(far)], hidden(), hidden(circle((0, -4000.0))))
    [same] = left.outings
    assert not notes
    assert (same.epoch, same.segments, same.steps) == (far.epoch, far.segments, far.steps)
    assert same.stays[0].facing == far.stays[0].facing
    before, after = (o.frame.to_lonlat(o.trajectory.position) for o in (far, same))
    assert after == pytest.approx(before, abs=1e-7)  # a centimetre: there and back through another origin
    plan = Frame("plan", (35.0, 135.0), metres_per_degree=(91_000.0, 111_000.0))
    assert left_of(replace(far, frame=plan)).outings[0].frame == plan, "the frame of a plan is that of everybody"
    days = [day(far)]
    assert without_private_places(days, [], []) == (days, [])


def test_distance_and_steps_count_the_shown_parts():
    walk = streets(np.random.default_rng(1))
    left = left_of(walk)
    for part in left.outings:
        line = length_along(part.trajectory.position)[-1]
        assert sum(s.distance for s in part.segments) == pytest.approx(line, rel=0.01)
        assert part.steps == pytest.approx(line / (PACE[WALKING] * PERIOD), abs=2)
    assert left.profile is None


def test_the_name_of_a_hidden_stay_is_removed_everywhere():
    away = stay(1500.0, 1600.0, (1000.0, 0.0), [("Kiosk", 0.6), ("Grandma's", 0.3)])
    home = stay(0.0, 60.0, HOME, [("Grandma's", 0.9)])
    legs = [(STANDING, 60.0, 0.0), (WALKING, 1200.0, 0.0), (WALKING, 200.0, 1.5), (STANDING, 600.0, 1.5)]
    left = left_of(outing(legs, stays=[home, away]))
    assert [s.facing for o in left.outings for s in o.stays] == [(("Kiosk", 0.6),)]


def test_a_ride_through_a_cut_place_without_a_row_in_it_is_cut_too():
    """A straight line through the place would be drawn."""
    walk = outing([(VEHICLE, 400.0, 0.0)], start=(-2000.0, 0.0))
    walk = replace(walk, trajectory=rows_of(walk.trajectory, slice(0, None, 160)))  # 800 m apart
    left = left_of(walk, cut=hidden(circle((-800, 0.0), 60)))
    lines = [f["geometry"]["coordinates"] for f in json.loads(as_geojson([left]))["features"]]
    where = HERE.to_lonlat(np.array([[-800.0, 0.0]]))[0]
    assert lines
    assert all(shapely.distance(shapely.LineString(line), shapely.Point(where)) > 60 / 111_320 for line in lines)


def test_outings_without_absolute_position_are_left_out():
    [left], [note] = without_private_places([day(outing([(WALKING, 100.0, 0.0)], frame=NOWHERE))], hidden(), [])
    assert not left.outings
    assert "2024-05-01" in note


@given(seed=st.integers(0, 10**6), radius=st.floats(50, 800))
@settings(max_examples=25)
def test_a_blurred_place_is_a_grid_square_per_quarter_of_an_hour(seed, radius):
    random = np.random.default_rng(seed)
    home = random.uniform(-400, 400, 2)
    legs = [(STANDING, float(random.uniform(0, 7200)), 0.0), *[(WALKING, 200.0, h * np.pi / 2) for h in (0, 0, 1, 0)]]
    walk = outing(legs, start=home, stays=[stay(0.0, legs[0][1], home, [("Home", 0.9)])])
    [place] = hidden(circle(home, radius))
    left = left_of(walk, cut=[], blur=[place])
    side = 2 * max(500.0, place.radius)  # at most
    for part in left.outings:
        private = [s for s in part.segments if s.kind == PRIVATE]
        lonlat = part.frame.to_lonlat(part.trajectory.position)
        blurred = np.any([(part.trajectory.time > s.start) & (part.trajectory.time < s.end) for s in private], axis=0)
        assert not (place.hides(lonlat) & ~blurred).any()
        times = part.epoch + part.trajectory.time[blurred]
        assert times % 900 == pytest.approx(450)
        middle, sides, _ = nested_squares(lonlat[blurred], np.full(len(times), max(500.0, place.radius)))
        assert lonlat[blurred] == pytest.approx(middle, abs=1e-7)  # the middle of a square, wherever home is
        apart = HERE.from_lonlat(lonlat[blurred]) - home
        assert np.abs(apart).max(initial=0) <= side / 2 + 7 * radius
        assert part.trajectory.covariance[blurred][:, 0, 0] == pytest.approx(sides**2 / 12)
        for s in part.stays:
            assert s.facing == ()
            assert (part.epoch + np.array([s.start, s.end])) % 900 == pytest.approx([0, 0])
            assert np.abs(HERE.from_lonlat(part.frame.to_lonlat(s.position[None]))[0] - home).max() <= 1.01 * side / 2


def test_the_covariance_of_blurred_rows_is_honest():
    """Over many homes the mean square error of a square's middle is 1 variance per axis."""
    random, errors = np.random.default_rng(5), []
    for _ in range(200):
        home = random.uniform(-2000, 2000, 2)
        walk = outing([(STANDING, 2000.0, 0.0)], start=home)
        left = left_of(walk, cut=[], blur=hidden(circle(home)))
        track, frame = left.outings[0].trajectory, left.outings[0].frame
        error = HERE.from_lonlat(frame.to_lonlat(track.position[:1]))[0] - home
        errors.append(error**2 / np.diag(track.covariance[0])[:2])
    # the fourth moment of a uniform error is 9/5 of its variance squared: 4 standard errors of 400 numbers
    assert np.mean(errors) == pytest.approx(1, abs=4 * np.sqrt(0.8 / 400))


@pytest.mark.parametrize("every", [6.0, thorough(1.0)])
def test_parts_that_follow_one_another_to_the_second_are_not_joined_across_a_cut_place(every):
    """A part of exactly 15 min begins and ends on a quarter, when the next one could begin."""
    [place] = hidden(circle((0.0, 0.0), 60))
    through = shapely.bounds(place.hidden)[2] * 2  # [m]
    before, inside = 900.0 * PACE[VEHICLE], through / PACE[VEHICLE]
    for extra in np.arange(0.0, 120.0, every):
        walk = outing([(VEHICLE, 900.0 + extra + inside + 900.0, 0.0)], start=(-before - through / 2 - extra * 10, 0.0))
        for feature in json.loads(as_geojson([left_of(walk, cut=[place])]))["features"]:
            line = np.array(feature["geometry"]["coordinates"])
            assert not place.crossed(line).any(), extra


def test_headings_do_not_reveal_the_origin_of_the_old_frame():
    """North of a frame is that of its origin, often home: the angle between both norths gives its longitude away."""
    home = enu(-35.0, -71.0)
    walk = replace(outing([(WALKING, 3000.0, 0.3)], start=(4000.0, 0.0)), frame=home)
    left = left_of(walk)
    track, frame = left.outings[0].trajectory, left.outings[0].frame
    here = frame.to_lonlat(track.position)
    own = enu(*here[0, ::-1]).from_lonlat(here)
    towards = np.arctan2(*(own[-1] - own[0])[::-1])
    north = frame.bearing_of_east(track.position[0])  # of the export's frame, whose origin everybody knows
    assert track.heading[0] - north == pytest.approx(towards, abs=1e-6)
    assert abs(walk.trajectory.heading[0] - track.heading[0]) > 1e-5  # it had to be turned


def test_a_track_does_not_point_at_a_second_hidden_area_either():
    """It ends at the nearest area, a small one, on the way to a larger one."""
    home, kiosk = hidden(circle(radius=200.0), circle((900.0, 0.0), 10.0))
    walk = outing([(WALKING, 1600.0, np.pi)], start=(2000.0, 0.0))
    left = left_of(walk, cut=[home, kiosk])
    lonlat = np.concatenate([o.frame.to_lonlat(o.trajectory.position) for o in left.outings])
    assert home.distance(lonlat).min() > 2 * home.radius - 2


def test_time_never_goes_back():
    for seed in range(20):
        random = np.random.default_rng(seed)
        walk = streets(random, minutes=60)
        after = replace(streets(random), epoch=walk.epoch + walk.trajectory.time[-1] + 30)
        left = left_of(walk, after, blur=hidden(circle(random.uniform(-500, 500, 2))))
        entries = timeline(left)
        assert all(e.end >= e.start for e in entries)
        assert all(b.start >= a.end - 1e-3 for a, b in pairwise(entries))
        for part in left.outings:
            assert (np.diff(part.trajectory.time) > 0).all()


def test_areas_of_a_file_are_hidden(tmp_path):
    ring = [[135.0, 35.0], [135.01, 35.0], [135.01, 35.001], [135.0, 35.001], [135.0, 35.0]]
    features = [
        {"type": "Feature", "properties": {"name": "River"}, "geometry": {"type": "Polygon", "coordinates": [ring]}},
        {"type": "Feature", "properties": {"radius": 80}, "geometry": {"type": "Point", "coordinates": [135.1, 35.1]}},
    ]
    file = tmp_path / "areas.geojson"
    file.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    river, point = hidden(str(file))
    assert river.hides(np.array([*ring, [135.005, 35.0005]])).all()
    assert point.hides(np.array([[135.1, 35.1]])).all()
    features[1]["properties"] = {}
    file.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    with pytest.raises(InputError, match="radius"):
        hidden(str(file))


@pytest.mark.parametrize(
    "text", ["95.0,10.0,100", "10.0,190.0,100", "1.0,2.0,0.1", "1.0,2.0,1e9", "nowhere.geojson", "1.0.0,2.0,3.0", ""]
)
def test_a_text_that_is_no_place_is_refused(text):
    with pytest.raises(InputError):
        hidden(text)
