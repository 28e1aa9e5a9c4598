"""XML as apps write it: damage costs the element that it hits, and the reader says so."""

import io
import random
import re
import time
from contextlib import suppress
from itertools import pairwise

import pytest
from recorders import gpx as whole_walk
from recorders import sample

from pdr_graph.errors import InputError
from pdr_graph.io.gpx import track_points
from pdr_graph.io.loading import load
from pdr_graph.io.xml_elements import XmlElements

HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" creator="test" xmlns="http://www.topografix.com/GPX/1/1">'
POINTS = [
    f'<trkpt lat="48.{n:04d}" lon="11.5"><ele>5</ele><time>2024-06-15T10:{n // 60:02d}:{n % 60:02d}Z</time></trkpt>\n'
    for n in range(100)
]
GPX = f"{HEAD}<trk><name>r</name><trkseg>\n{''.join(POINTS)}</trkseg></trk></gpx>"


def read(content):
    """Time and position of each point, and the reader."""
    elements = XmlElements(io.BytesIO(content if isinstance(content, bytes) else content.encode()), "f", "gpx", "trkpt")
    return [point[:3] for point in track_points(elements)], elements


EXPECTED, _ = read(GPX)
HEART = "<extensions><gpxtpx:Extension><gpxtpx:hr>90</gpxtpx:hr></gpxtpx:Extension></extensions></trkpt>"
MENDED = {
    "undeclared prefix": (GPX.replace("</trkpt>", HEART), "prefix gpxtpx without a declaration"),
    "undeclared prefix of an attribute": (GPX.replace("<trkpt ", '<trkpt x:hr="1" '), None),
    "prefixed root": (re.sub(r"<(/?)(?=[a-z])", r"<\1g:", GPX).replace("xmlns=", "xmlns:g="), None),
    "blank first lines": ("\r\n \n" + GPX, "blank lines before the XML declaration"),
    "byte-order mark": (b"\xef\xbb\xbf" + GPX.encode(), None),
    "UTF-16": (GPX.encode("utf-16"), None),
    "zeros at the end": (GPX + "\0" * 4096, "4096 control characters left out"),
    "bare &": (GPX.replace("<ele>", "<name>Fish & Chips&nbsp;</name><ele>"), None),
    "Latin-1 without a declaration": (GPX.replace("<ele>", "<name>Café</name><ele>").encode("latin-1"), None),
    "Latin-1": (GPX.replace("UTF-8", "ISO-8859-1").replace("<ele>", "<name>Café</name><ele>").encode("latin-1"), None),
    "control characters": (GPX.replace("<ele>", "<name>a\x01b</name><ele>"), "100 control characters left out"),
    "comments": (GPX.replace("<ele>", "<!-- <trkpt> & --><ele>"), None),
    "points in a comment": (GPX.replace("</trkseg>", f"<!-- {''.join(POINTS)} --></trkseg>"), None),
    "an instruction": (GPX.replace("<ele>", "<?x y?><ele>"), None),
    "one line": (GPX.replace("\n", ""), None),
    "spaces in tags": (GPX.replace("</trkpt>", "</trkpt >").replace("</gpx>", "</gpx \n>\n<!-- end -->\n"), None),
}


@pytest.mark.parametrize("name", MENDED)
@pytest.mark.parametrize("piece", [1 << 20, 61])
def test_what_other_readers_take_is_read_whole(monkeypatch, name, piece):
    """However the file falls into pieces."""
    monkeypatch.setattr("pdr_graph.io.xml_elements.PIECE", piece)
    content, note = MENDED[name]
    points, elements = read(content)
    assert points == EXPECTED
    assert (elements.notes, elements.is_cut) == ([note] if note else [], False)


def test_a_file_cut_anywhere_is_read_up_to_there():
    """A value that is cut is no value: 10:01:3 would be a time."""
    content = GPX[: len(HEAD) + 900]
    for end in range(len(HEAD), len(content)):
        points, elements = read(content[:end])
        whole = content[:end].count("</time>")
        assert [point for point in points if point[0]] == EXPECTED[:whole]
        assert elements.is_cut
        assert not elements.notes


@pytest.mark.parametrize("kind", ["zeros", "noise", "loss"])
def test_damage_costs_the_points_that_it_hits(kind):
    """Thirty bytes are zeros or noise, or missing, at 200 places."""
    chance = random.Random(1)
    content = GPX.encode()
    begin, end = content.index(b"<trkpt"), content.index(b"</trkseg>")
    for _ in range(200):
        at = chance.randrange(begin, end - 30)
        damage = {"zeros": bytes(30), "noise": chance.randbytes(30).replace(b"<!", b""), "loss": b""}[kind]
        points, elements = read(content[:at] + damage + content[at + 30 :])
        ends = [match.end() for match in re.finditer(b"</trkpt>\n", content)]
        hit = {n for n, (a, b) in enumerate(pairwise([begin, *ends])) if a < at + 30 and b > at}
        kept = [point for n, point in enumerate(EXPECTED) if n not in hit]
        assert [point for point in points if point in kept] == kept
        assert len(points) <= len(EXPECTED)
        assert not elements.is_cut


def test_the_first_damaged_point_is_named_with_its_line():
    lines = GPX.split("\n")
    for n in (10, 20):
        lines[n] = lines[n].replace("</ele>", "")
    assert read("\n".join(lines))[1].notes == ["2 damaged <trkpt>, the first in line 11"]


def test_a_damaged_walk_is_read_and_its_warnings_say_so(tmp_path):
    text = whole_walk(sample())
    number = len(load_text(tmp_path, text).fixes)
    cut = load_text(tmp_path, text[: text.rindex("<trkpt") + 20])
    assert len(cut.fixes) == number - 1
    assert any("ends in the middle" in note for note in cut.notes)


def load_text(tmp_path, text):
    (tmp_path / "walk.gpx").write_text(text, encoding="utf-8")
    return load(tmp_path / "walk.gpx")


HOSTILE = {
    "a type definition far on": GPX.replace("</trkseg>", '<!DOCTYPE a [<!ENTITY b "b">]></trkseg>'),
    "an entity that is not declared": GPX.replace("<ele>5", "<ele>&b;"),
    "open elements": HEAD + POINTS[0][:-9] * 100_000,
    "deep elements": GPX.replace("<ele>", "<a>" * 5000 + "<ele>", 1),
    "prefixes": HEAD + "".join(f"<a{n}:trkpt>" for n in range(100_000)),
    "open comments": HEAD + "<!--" * 500_000,
    "bare &": HEAD + "&" * 2_000_000,
    "starts": HEAD + "<trkpt " * 300_000,
    "one long start": HEAD + "<trkpt " + " a" * 1_000_000,
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_cost_seconds_at_most(name):
    begin = time.perf_counter()
    with suppress(InputError):
        read(HOSTILE[name])
    assert time.perf_counter() - begin < 10
