"""Receipts and photos are named where they fit, make a walk better, and bend no day when they lie."""

from contextlib import suppress
from datetime import UTC, datetime

import commands
import made_tracks as made
import numpy as np
import pytest
from made_tracks import HOUR, OFFICE, at, lonlat
from observations import NOON, median_error, observation
from PIL import Image, TiffImagePlugin
from test_activities import walk_and_ride
from walks import drawn_from_the_model

from pdr_graph import InputError
from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.corrections import apply_to_observations
from pdr_graph.apps.lifelog.diary import diary
from pdr_graph.apps.lifelog.facts import VISITED, Correction
from pdr_graph.apps.lifelog.ingest import add
from pdr_graph.apps.lifelog.overview import evidence_text
from pdr_graph.apps.lifelog.reconstruct import reconstruct
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.apps.lifelog.visited import read_photo


def photo(path, where, hours, offset="+00:00", stamp=None, error=None):
    """A JPEG taken at a place in metres from home. hours: on the camera's clock; stamp: of GPS, UTC."""
    longitude, latitude = lonlat(*where)
    exif, own = Image.Exif(), {36867: f"{datetime.fromtimestamp(at(hours), UTC):%Y:%m:%d %H:%M:%S}"}
    if offset:
        own[36881] = offset
    parts = [
        (int(v), int(v * 60 % 60), TiffImagePlugin.IFDRational(round(v * 3600 % 60 * 1e4), 10_000))
        for v in (latitude, longitude)
    ]
    gps = {1: "N", 2: parts[0], 3: "E", 4: parts[1]} | ({31: TiffImagePlugin.IFDRational(error)} if error else {})
    if stamp is not None:
        gps |= {7: (int(stamp), round(60 * (stamp % 1)), 0), 29: "2024:05:01"}
    exif._ifds[0x8769], exif._ifds[0x8825] = own, gps
    exif[0x8769], exif[0x8825] = own, gps
    path.parent.mkdir(exist_ok=True)
    Image.new("RGB", (8, 8)).save(path, exif=exif)
    return path


def receipts(path, *rows):
    path.write_text("\n".join(["place,lat,lon,time", *rows]) + "\n")
    return path


def row(name, where, time):
    longitude, latitude = lonlat(*where)
    return f"{name},{latitude:.6f},{longitude:.6f},{time}"


def shown(store):
    """Texts beside the rows by hour of the row's start, and those that do not fit."""
    with Store(store) as log:
        found = diary(log, "me")
    rows = [entry for day in found.days for entry in day.entries if entry.evidence]
    return {round((entry.start - at(0)) / HOUR, 1): evidence_text(entry) for entry in rows}, found.doubts


def visited(place, start, end, radius=5.0, frame=None):
    longitude, latitude = frame.to_lonlat(np.array([place]))[0]
    value = {"latitude": latitude, "longitude": longitude, "radius": radius, "name": "shop", "source": "receipt"}
    return Correction(1, "me", 0.0, VISITED, NOON + start, NOON + end, value)


@pytest.mark.parametrize(
    ("offset", "stamp", "hours"),
    [("+02:00", None, 8.0), ("", 7.98, 8.0), ("", None, 8.0)],
    ids=["offset", "GPS in UTC", "zone of the place"],
)
def test_the_time_of_a_photo_is_that_of_its_zone(tmp_path, offset, stamp, hours):
    """10:00 in Munich in May is 8:00 UTC."""
    (start, end), value = read_photo(photo(tmp_path / "a.jpg", OFFICE, 10.0, offset, stamp, error=6.04))
    assert (start + end) / 2 == pytest.approx(at(hours))
    assert (value["longitude"], value["latitude"]) == pytest.approx(tuple(lonlat(*OFFICE)), abs=1e-7)
    assert value["radius"] == pytest.approx(4.0), "the radius of 68 % as a standard deviation"


def test_photos_and_receipts_stand_beside_the_rows_and_false_ones_are_named(tmp_path):
    store = made.lifelog(tmp_path)
    with Store(store) as log:
        before = log.day_hash("me", "2024-05-01")
    photo(tmp_path / "p" / "office.jpg", OFFICE, 10.0)
    photo(tmp_path / "p" / "friend.jpg", (9000.0, 0.0), 10.5)
    photo(tmp_path / "p" / "abroad.jpg", (0.0, 0.0), 10.5 + 2, "+02:00")  # home is left at 9, and taken up at 12:10 UTC
    Image.new("RGB", (8, 8)).save(tmp_path / "p" / "plain.jpg")
    till = receipts(
        tmp_path / "till.csv",
        row("canteen", OFFICE, "2024-05-01"),
        row("elsewhere", (0.0, 5000.0), "2024-05-01 11:00"),
    )
    assert (
        "5 places of receipts and photos, 1 photo without place or time"
        in commands.run("lifelog", "add", store, tmp_path / "p", "--visited", till).output
    )
    assert "5 places there already" in commands.run("lifelog", "add", store, tmp_path / "p", "--visited", till).output
    assert build(store).failures == ()
    beside, doubts = shown(store)
    assert "photo office.jpg" in beside[9.2]
    assert "receipt canteen" in beside[9.2]
    assert len(doubts) == 3
    assert "photo friend.jpg does not fit: 6.0 km from the way: somebody else's?" in doubts
    assert any("abroad.jpg" in line and "there 2 h" in line and "time zone?" in line for line in doubts)
    assert any("receipt elsewhere" in line for line in doubts)
    with Store(store) as log:
        assert log.day_hash("me", "2024-05-01") == before, "positions alone are as they were"
    text = commands.run("lifelog", "show", store, "--out", tmp_path / "out").output
    assert "10:00 photo office.jpg" in text
    assert "friend.jpg does not fit" in text
    assert "friend.jpg does not fit" in (tmp_path / "out" / "overview.html").read_text()


def test_a_receipt_of_a_day_before_says_when_the_person_was_there(tmp_path):
    store = made.lifelog(tmp_path, days=2)
    till = receipts(tmp_path / "till.csv", row("office", OFFICE, "2024-05-02 08:30"))
    add(store, [], visited=till)
    _, [doubt] = shown(store)
    assert "there at 2024-05-02 09:1" in doubt or "there at 2024-05-02 09:0" in doubt


@pytest.mark.parametrize("lie", [None, (150.0, 80.0), (60.0, -400.0), (5000.0, 0.0)])
def test_a_walk_follows_true_places_and_ignores_a_false_one(lie):
    """Three receipts of a walk without fixes in its second half, their time open but for the walk."""
    steps, fixes, truth = drawn_from_the_model(400, 3)
    one = observation(steps, fixes[: len(fixes) // 3])
    rows = (np.array([0.5, 0.7, 0.95]) * (len(truth) - 1)).astype(int)
    places = [visited(truth.position[n], 0.0, steps.end, frame=one.frame) for n in rows]
    lies = [] if lie is None else [visited(truth.position[300] + np.array(lie), 0.0, steps.end, frame=one.frame)]

    def outing(*facts):
        [found] = reconstruct("me", "2023-11-14", apply_to_observations({"a": one}, facts), None).outings
        return found

    alone, made_of = outing(), outing(*places, *lies)
    assert median_error(made_of.trajectory, truth) < 0.7 * median_error(alone.trajectory, truth)


def test_a_false_place_alone_does_not_move_a_walk_with_fixes():
    steps, fixes, _, place = walk_and_ride([("stand", 30)], every=5, walks=300)
    one, wrong = observation(steps, fixes), place[200] + [70.0, 70.0]

    def track(*facts):
        [found] = reconstruct("me", "2023-11-14", apply_to_observations({"a": one}, facts), None).outings
        return found.trajectory

    usual, bent = track(), track(visited(wrong, 0.0, steps.end, frame=one.frame))
    assert np.hypot(*(usual.position - bent.position).T).max() < 2.0
    assert apply_to_observations({"a": one}, [visited((9e4, 0.0), 0.0, 9.0, frame=one.frame)]) == {"a": one}


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("place,lat,lon\nshop,48.1,11.5\n", "no time"),
        ("place,lat,lon,time\nshop,48.1,11.5,yesterday\n", "data row 1, time"),
        ("place,lat,lon,earliest,latest\nshop,48.1,11.5,2024-05-02,2024-05-01\n", "latest"),
        ("place,time\nnowhere,2024-05-01\n", "'nowhere'"),
    ],
)
def test_a_bad_receipt_is_one_line(tmp_path, text, what):
    (tmp_path / "till.csv").write_text(text)
    with pytest.raises(InputError, match=what):
        add(tmp_path / "days.db", [], visited=tmp_path / "till.csv")


def test_a_damaged_photo_is_refused_or_has_no_place(tmp_path):
    path = photo(tmp_path / "a.jpg", OFFICE, 10.0)
    for length in range(0, path.stat().st_size, 37):
        (tmp_path / "cut.jpg").write_bytes(path.read_bytes()[:length])
        with suppress(InputError):
            read_photo(tmp_path / "cut.jpg")
