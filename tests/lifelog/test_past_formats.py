"""Each format is recognised by its keys, and whatever is damaged or hostile in it costs a line at most."""

import json
import time
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_past import LAT, LON, NOON, imported, iso, location, position, records, rows, zipped

from pdr_graph.apps.lifelog.past import past_json, tracks
from pdr_graph.apps.lifelog.past.past_json import pieces
from pdr_graph.apps.lifelog.past.past_rows import unix_time, unix_times
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.errors import InputError
from pdr_graph.io import xml_elements

E7 = {"latE7": round(LAT * 1e7), "lngE7": round(LON * 1e7)}


def saved(path, content):
    """Write a file: bytes, text or JSON."""
    content = content if isinstance(content, bytes | str) else json.dumps(content, ensure_ascii=False)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def gpx(number=2):
    points = [f'<trkpt lat="{LAT}" lon="{LON}"><time>{iso(NOON + n)}</time></trkpt>' for n in range(number)]
    return f'<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{"".join(points)}</trkseg></trk></gpx>'


def kml(inside):
    return f'<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://g.co"><Document>{inside}</Document></kml>'


GX_TRACK = "".join(f"<when>{iso(NOON + n)}</when><gx:coord>{LON} {LAT} 3</gx:coord>" for n in range(2))
STAMPED = "".join(
    f"<Placemark><TimeStamp><when>{iso(NOON + n)}</when></TimeStamp><Point><coordinates>{LON},{LAT},0</coordinates>"
    "</Point></Placemark>"
    for n in range(2)
)
FEATURE = {"geometry": {"type": "Point", "coordinates": [LON, LAT]}, "type": "Feature"}
FORMATS = {
    "records": {"locations": [location(NOON + n) for n in range(2)]},
    "old records": {
        "locations": [
            {"timestampMs": str((NOON + n) * 1000), "latitudeE7": 525000000, "longitudeE7": 134000000} for n in (0, 1)
        ]
    },
    "edits": {
        "timelineEdits": [
            {"rawSignal": {"signal": {"position": {"point": E7, "accuracyMm": 5000, "timestamp": iso(NOON + n)}}}}
            for n in range(2)
        ]
    },
    "ios": [
        {
            "startTime": iso(NOON),
            "endTime": iso(NOON + 3600),
            "timelinePath": [
                {"point": f"geo:{LAT},{LON}", "durationMinutesOffsetFromStartTime": minutes} for minutes in ("0", "1")
            ],
        }
    ],
    "android": {"rawSignals": [position(NOON + n) for n in range(2)]},
    "semantic": {
        "timelineObjects": [
            {
                "activitySegment": {
                    "duration": {"startTimestamp": iso(NOON), "endTimestampMs": str((NOON + 9) * 1000)},
                    "simplifiedRawPath": {"points": [E7 | {"timestamp": iso(NOON + n)} for n in range(2)]},
                }
            }
        ]
    },
    "overland": {"locations": [FEATURE | {"properties": {"timestamp": iso(NOON + n)}} for n in range(2)]},
    "owntracks": "".join(
        f'{iso(NOON)}\t*  \t{{"_type":"location","lat":{LAT},"lon":{LON},"tst":{NOON + n},"acc":9}}\n' for n in range(2)
    ),
    "gpx": gpx(),
    "kml track": kml(f"<Placemark><gx:Track>{GX_TRACK}</gx:Track></Placemark>"),
    "kml points": kml(STAMPED),
    "tcx": '<TrainingCenterDatabase xmlns="http://www.garmin.com/xmlschemas/TrainingCenterDatabase/v2"><Activities><Lap>'
    + "".join(
        f"<Track><Trackpoint><Time>{iso(NOON + n)}</Time><Position><LatitudeDegrees>{LAT}</LatitudeDegrees>"
        f"<LongitudeDegrees>{LON}</LongitudeDegrees></Position></Trackpoint>"
        f"<Trackpoint><Time>{iso(NOON + n)}</Time></Trackpoint></Track>"
        for n in range(2)
    )
    + "</Lap></Activities></TrainingCenterDatabase>",
}


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("bom", [b"", b"\xef\xbb\xbf"])
def test_a_format_is_recognised_by_content_and_read(tmp_path, name, bom):
    file = saved(tmp_path / "file", FORMATS[name])
    file.write_bytes(bom + file.read_bytes())
    log = tmp_path / "log"
    result = imported(log, file)
    assert (result.positions.new, result.refused) == (2, ())
    for _, lat, lon, *_ in rows(log):
        assert (int(lat), int(lon)) == (525000000, 134000000)
    assert int(rows(log)[0][0]) == NOON * 1000


def fit_file(path, number, **degrees):
    """An activity of a sports watch, a position per second."""
    fit = pytest.importorskip("garmin_fit_sdk")
    if not hasattr(fit, "Encoder"):
        pytest.skip("this version writes no files")
    encoder, begin = fit.Encoder(), NOON - 631_065_600
    encoder.write_mesg({"mesg_num": 0, "type": "activity", "time_created": begin})
    for n in range(number):
        place = {name: round(value * 2**31 / 180) for name, value in degrees.items()}
        encoder.write_mesg({"mesg_num": 20, "timestamp": begin + n, **place})
    return saved(path, bytes(encoder.close()))


def test_fit_activities_are_read_by_the_library_of_the_extra(tmp_path):
    file, log = fit_file(tmp_path / "ride", 3, position_lat=LAT, position_long=LON), tmp_path / "log"
    assert imported(log, file).positions.new == 3
    assert [abs(int(row[1]) - 525000000) < 2 for row in rows(log)] == [True] * 3
    saved(file, file.read_bytes()[:-20])
    damaged = imported(tmp_path / "other", file)
    assert damaged.refused or damaged.notes


def test_fit_activities_of_more_messages_than_days_of_riding_have_are_refused(tmp_path, monkeypatch):
    """A message may be a byte in the file, and a kilobyte in memory."""
    monkeypatch.setattr(tracks, "MOST_MESSAGES", 20)
    refused = [imported(tmp_path / f"log{n}", fit_file(tmp_path / f"ride{n}", n)).refused for n in (15, 25)]
    assert ["more than 20 messages" in str(lines) for lines in refused] == [False, True]


def test_a_semantic_visit_has_its_place_and_confidence(tmp_path):
    place = {"latitudeE7": 525000000, "longitudeE7": 134000000, "name": "Café", "locationConfidence": 77}
    times = {"startTimestamp": iso(NOON), "endTimestamp": iso(NOON + 600)}
    visit = {"placeVisit": {"location": place, "duration": times, "childVisits": [{"location": {}, "duration": times}]}}
    imported(tmp_path / "log", saved(tmp_path / "s", {"timelineObjects": [visit, {}, {"placeVisit": None}]}))
    with Store(tmp_path / "log") as log:
        unnamed, named = log.guesses("me")
    assert (named.name, named.probability, named.latitude) == ("Café", 0.77, 52.5)
    assert (unnamed.name, np.isnan(unnamed.latitude)) == ("", True)


def test_google_kml_days_are_guesses(tmp_path):
    span = f"<TimeSpan><begin>{iso(NOON)}</begin><end>{iso(NOON + 60)}</end></TimeSpan>"
    line = "<LineString><coordinates>1,2,0 3,4,0</coordinates></LineString>"
    line = f"<Placemark><name>Walking</name>{span}{line}</Placemark>"
    point = f"<Placemark><name>Home</name>{span}<Point><coordinates>1,2,0</coordinates></Point></Placemark>"
    untimed = "<Placemark><Point><coordinates>1,2,0</coordinates></Point></Placemark>"
    result = imported(tmp_path / "log", saved(tmp_path / "k", kml(line + point + untimed)))
    assert (result.guesses, result.positions.new) == (2, 0)
    assert "1 of 1 positions were left out: 1 no time" in result.notes[0]


@pytest.mark.parametrize("prefix", ["", "ns2:"])
def test_xml_that_is_cut_off_is_imported_up_to_there(tmp_path, prefix):
    """Also within the only placemark, whose track has as many points as are whole."""
    track = "".join(f"<when>{iso(NOON + n)}</when><gx:coord>{LON} {LAT} 3</gx:coord>" for n in range(50))
    for text in (gpx(50), kml(f"<Placemark><gx:Track>{track}</gx:Track></Placemark>")):
        text = text.replace("<", f"<{prefix}").replace(f"<{prefix}/", f"</{prefix}").replace("ns2:gx:", "gx:")
        cut = text[: len(text) // 2]
        result = imported(tmp_path / "log", saved(tmp_path / "a", cut))
        whole = cut.count("</gx:coord>") or cut.count(f"</{prefix}trkpt>")
        assert result.positions.new + result.positions.existing == whole > 20
        [line] = result.refused
        assert "an end in the middle" in line
        assert f"imported up to there: {whole} positions" in line


def test_a_damaged_point_is_left_out_and_the_rest_imported(tmp_path):
    points = gpx(50).split("<trkpt")
    points[20] = points[20][:40] + "\0\0\x1b<<>\"'"
    result = imported(tmp_path / "log", saved(tmp_path / "a", "<trkpt".join(points)))
    assert (result.positions.new, result.refused) == (49, ())
    assert "1 damaged <trkpt>, the first in line 1" in result.notes[-1]


@pytest.mark.parametrize("name", ["overland", "owntracks", "records", "gpx"])
def test_names_in_latin_1_cost_no_position(tmp_path, name):
    text = FORMATS[name] if isinstance(FORMATS[name], str) else json.dumps(FORMATS[name])
    text = (
        text.replace('"lat":', '"desc":"Café","lat":')
        .replace('"type"', '"name": "Café", "type"')
        .replace("<time", "<name>é</name><time")
    )
    text = text.replace('"latitudeE7"', '"name": "Café", "latitudeE7"')
    assert "é" in text
    result = imported(tmp_path / "log", saved(tmp_path / "a", text.encode("latin-1")))
    assert (result.positions.new, result.refused, result.notes) == (2, (), ())


@pytest.mark.parametrize(
    ("content", "found"), [(b"hello you", "'hello you'"), (bytes(range(40)), "the bytes 00 01 02 ")]
)
def test_what_a_file_is_instead_is_shown_as_text_or_digits(tmp_path, content, found):
    [line] = imported(tmp_path / "log", saved(tmp_path / "a", content)).refused
    assert f"found {found}" in line


def test_xml_with_a_document_type_is_refused(tmp_path):
    bomb = '<!DOCTYPE kml [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]>'
    for text in (kml("<Placemark><name>&b;</name></Placemark>"), gpx()):
        [line] = imported(tmp_path / "log", saved(tmp_path / "x", bomb + text)).refused
        assert "document type" in line or "broken XML" in line


def test_invalid_positions_are_counted_by_reason(tmp_path):
    good = [location(NOON), location(NOON + 1)]
    bad = [
        {"latitudeE7": 1, "longitudeE7": 1},
        {"timestamp": iso(NOON)},
        location(-5.0),
        location(NOON) | {"latitudeE7": 1e300},
        location(NOON) | {"latitudeE7": 1340000000, "longitudeE7": 525000000},
        location(NOON, 0, 0),
        location(NOON, accuracy=-1),
        location(NOON, accuracy=float("nan")),
        location(NOON) | {"timestamp": "yesterday"},
        [1, 2],
    ]
    result = imported(tmp_path / "log", records(tmp_path / "a.json", good + bad))
    assert result.positions.new == 2
    [line] = result.notes
    assert "10 of 12 positions were left out: " in line
    for reason in ("2 unreadable", "2 no time", "1 no position", "1980", "swapped?", "latitude 0", "negative accuracy"):
        assert reason in line


def test_times_are_understood_in_any_unit_and_zone():
    for unit in (1, 10**3, 10**6, 10**9):
        assert unix_time(NOON * unit) == unix_time(str(NOON * unit)) == pytest.approx(NOON)
    texts = ["2024-05-01T12:00:00Z", "2024-05-01T14:00:00.000+02:00", "2024-05-01T05:00:00-0700", "2024-05-01T12:00:00"]
    assert unix_times(texts).tolist() == unix_times(texts[:1] * 4).tolist() == [NOON] * 4
    assert np.isnan(unix_times(["", None, "Z", "soon", {}, True, "2024-13-01T00:00:00Z"])).all()


def test_times_without_a_zone_are_said_to_be_taken_as_utc(tmp_path):
    point = '<trkpt lat="48" lon="11"><time>2024-05-01T09:00:{:02}{}</time></trkpt>'
    for zone, notes in (("Z", 0), ("+02:00", 0), ("", 1)):
        track = "".join(point.format(n, zone) for n in range(20))
        path = tmp_path / f"track{len(zone)}.gpx"
        path.write_text(f'<gpx version="1.1"><trk><trkseg>{track}</trkseg></trk></gpx>')
        result = imported(tmp_path / f"d{len(zone)}.db", path)
        assert len([note for note in result.notes if "UTC" in note]) == notes


def test_longitudes_that_lost_their_sign_get_it_back(tmp_path):
    unsigned = [location(NOON + n) | {"longitudeE7": 2**32 - 734_000_000} for n in range(2)]
    imported(tmp_path / "log", records(tmp_path / "a", unsigned))
    assert [row[2] for row in rows(tmp_path / "log")] == ["-734000000"] * 2


def test_a_file_that_is_cut_off_is_imported_up_to_there(tmp_path):
    text = json.dumps({"locations": [location(NOON + n) for n in range(50)]})
    result = imported(tmp_path / "log", saved(tmp_path / "a", text[: len(text) // 2]))
    assert 20 < result.positions.new < 26
    assert "an end in the middle" in result.refused[0]
    assert "imported up to there" in result.refused[0]


@pytest.mark.parametrize("indent", [None, 1])
@pytest.mark.parametrize("root", ["locations", "semanticSegments", ""])
def test_a_document_that_is_cut_anywhere_is_said_to_be(tmp_path, root, indent):
    """Also behind an element, a bracket or a comma, where what remains looks whole."""
    rows = [location(NOON + n) for n in range(2)]
    text = json.dumps({root: rows, "other": rows} if root else rows, indent=indent).encode()
    for end in range(1, len(text)):
        with (
            saved(tmp_path / "a", text[:end]).open("rb") as stream,
            pytest.raises(InputError, match="an end in the middle"),
        ):
            list(pieces(stream, "a"))


def test_two_documents_in_one_file_are_not_read_as_the_first(tmp_path):
    one = json.dumps({"locations": [location(NOON)]})
    result = imported(tmp_path / "log", saved(tmp_path / "a", one + one))
    assert result.positions.new == 1
    assert "after the end, expected one document" in result.refused[0]
    assert not imported(tmp_path / "log", saved(tmp_path / "a", one + "\r\n\n")).refused


def test_a_damaged_zip_is_refused_in_one_line(tmp_path):
    file = zipped(tmp_path / "t.zip", {"a.json": records(tmp_path / "a", [location(NOON + n) for n in range(9000)])})
    damaged = bytearray(file.read_bytes())
    damaged[len(damaged) // 2 : len(damaged) // 2 + 50] = bytes(50)
    file.write_bytes(damaged)
    assert len(imported(tmp_path / "log", file).refused) == 1
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("../evil.json", "{}")
    assert "leads elsewhere" in imported(tmp_path / "log", file).refused[0]


def test_hostile_documents_cost_a_line_and_no_time(tmp_path, monkeypatch):
    monkeypatch.setattr(past_json, "LONGEST_JSON_ELEMENT", 8_000_000)
    monkeypatch.setattr(xml_elements, "LONGEST_ELEMENT", 4_000_000)
    deep = b'{"locations": [' + b'{"latitudeE7":' + b"[" * 100_000 + b"]" * 100_000 + b"}, "
    hostile = [
        deep + json.dumps(location(NOON)).encode() + b", " + json.dumps(location(NOON + 1)).encode() + b"]}",
        b'{"locations": [{"latitudeE7": 1}, {"timestampMs": "' + b"x" * 12_000_000 + b'"}]}',
        b'{"locations": [{"latitudeE7": 1}' + b", 1" * 5_000_000 + b"]}",
        b'{"timelineEdits": [], ' + b'"a": [], ' * 5000 + b'"b": 1}',
        b'{"rawSignals": [' + b'"\\"' * 2_000_000,
        b'[{"startTime": 1, "visit": ' + b"{" * 5_000_000,
        b"2024-05-01T12:00:00Z * {" + b" " * 5_000_000,
        b"<gpx><trk>" + b"<trkseg>x</trkseg>" * 300_000,
    ]
    begin = time.perf_counter()
    for n, text in enumerate(hostile):
        result = imported(tmp_path / str(n), saved(tmp_path / "x", text))
        assert len(result.refused) + len(result.notes) == 1, text[:60]
    assert imported(tmp_path / "0", saved(tmp_path / "x", hostile[0])).positions.existing == 2
    assert time.perf_counter() - begin < 60


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-9, 9) | st.text('a"\\{}[],: é', max_size=6),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text('ab"{[', max_size=3), inner, max_size=3),
    max_leaves=8,
)


@settings(deadline=None)
@given(
    st.dictionaries(st.text("xyz", min_size=1), st.lists(st.dictionaries(st.text("ab", max_size=2), JSON)), max_size=3),
    JSON,
    st.integers(1, 40),
    st.sampled_from([None, 1]),
)
def test_the_pieces_of_a_document_are_its_elements(tmp_path_factory, lists, other, size, indent):
    document = {"0": other if not isinstance(other, list) else 0} | lists
    for root, expected in ((document, lists), (lists.get("x", []), {"": lists.get("x", [])})):
        file = tmp_path_factory.mktemp("json") / "a"
        file.write_text(json.dumps(root, indent=indent), encoding="utf-8")
        found = {}
        before, past_json.PIECE_SIZE = past_json.PIECE_SIZE, size
        try:
            with file.open("rb") as stream:
                for piece in pieces(stream, "a"):
                    found.setdefault(piece.key, []).extend(map(json.loads, piece.each()))
        finally:
            past_json.PIECE_SIZE = before
        assert found == {key: value for key, value in expected.items() if value}
