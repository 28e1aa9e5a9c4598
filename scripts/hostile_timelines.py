"""Timelines for ``lifelog import``: cut off, deep, endless, entities, wild numbers."""

import json
import struct

from hostile_attack import EITHER, Attack

MB = 1_000_000
TIME = 1_700_000_000


def imported(name, content):
    def make(folder):
        (folder / name).write_bytes(content() if callable(content) else content)
        return ["lifelog", "import", "OUT/days.db", folder / name], 0

    return make


def location(n, **replaced):
    where = {"latitudeE7": 494_000_000 + n % 1000, "longitudeE7": 110_000_000, "accuracy": 12}
    return where | {"timestampMs": str((TIME + n) * 1000)} | replaced


def records(rows):
    return json.dumps({"locations": rows}).encode()


def cut(content):
    """Records.json, cut off where an element ends."""
    end = content.rindex(b"}", 0, len(content) // 2) + 1
    return content[:end]


def many():
    rows = ",".join(json.dumps(location(60 * n)) for n in range(200_000))
    return f'{{"locations": [{rows}]}}'.encode()


def deep(opening, closing, depth):
    return (
        b'{"locations": ['
        + json.dumps(location(0)).encode()[:-1]
        + b', "x": '
        + opening * depth
        + b"0"
        + closing * depth
        + b"}]}"
    )


def xml(root, doctype="", inside=""):
    return f'<?xml version="1.0"?>{doctype}<{root}>{inside}</{root.split()[0]}>'.encode()


LAUGHS = "".join(f'<!ENTITY l{n} "{f"&l{n - 1};" * 10}">' for n in range(1, 10))
LAUGHS = f'<!DOCTYPE gpx [<!ENTITY l0 "lol">{LAUGHS}]>'
OUTSIDE = '<!DOCTYPE gpx [<!ENTITY x SYSTEM "file:///etc/passwd">]>'
POINT = '<trk><trkseg><trkpt lat="49" lon="11"><name>{}</name><time>2023-11-14T22:13:20Z</time></trkpt></trkseg></trk>'
MARK = (
    "<Placemark><name>{}</name><TimeStamp><when>2023-11-14T22:13:20Z</when></TimeStamp>"
    "<Point><coordinates>11,49</coordinates></Point></Placemark>"
)


def gpx(times, separator="T"):
    points = "".join(f'<trkpt lat="49" lon="11"><time>{time}</time></trkpt>' for time in times)
    return xml("gpx", inside=f"<trk><trkseg>{points}</trkseg></trk>")


def fit(records, claim=None):
    """A FIT activity with so many positions, a byte each of filling; claim: stated size of the data."""
    head = struct.pack("<BBBHB", 0x40, 0, 0, 20, 3) + bytes([253, 4, 0x86, 0, 4, 0x85, 1, 4, 0x85])
    rows = b"".join(struct.pack("<BLll", 0, 1_000_000_000 + n, 589_000_000, 131_000_000) for n in range(records))
    data = head + rows
    return struct.pack("<BBHL4s", 12, 16, 100, claim or len(data), b".FIT") + data + b"\0\0"


def rec(times):
    return "".join(
        f'2023-11-14T22:13:20Z\t*                 \t{{"_type":"location","lat":49,"lon":11,"tst":{t}}}\n' for t in times
    ).encode()


TIMELINES = (
    Attack(
        "Records.json cut off at the end of an element",
        imported("Records.json", cut(records([location(n) for n in range(9)]))),
        (3,),
        "an end in the middle",
    ),
    Attack(
        "two Records.json, one behind the other",
        imported("Records.json", records([location(0)]) + records([location(99)])),
        EITHER,
        "after the end",
    ),
    Attack("Records.json of 2·10⁵ positions", imported("Records.json", many), (0,), "200000 new positions"),
    Attack(
        "Records.json, brackets 10⁶ deep", imported("Records.json", lambda: deep(b"[", b"]", MB)), EITHER, "unreadable"
    ),
    Attack(
        "Records.json, objects 10⁶ deep",
        imported("Records.json", lambda: deep(b'{"a":', b"}", MB)),
        EITHER,
        "unreadable",
    ),
    Attack(
        "Records.json, an element of 1 GB",
        imported("Records.json", lambda: records([location(0)])[:-2] + b',{"x": "' + b"a" * 990 * MB),
        EITHER,
        "64 MB",
    ),
    Attack(
        "Records.json, 1 GB of blanks",
        imported("Records.json", lambda: records([location(0)])[:-2] + b" " * 990 * MB),
        EITHER,
        "64 MB|in the middle",
    ),
    Attack(
        "Records.json, 30 MB of brackets",
        imported("Records.json", lambda: records([location(0)])[:-2] + b"," + b"[]," * 10 * MB),
        EITHER,
    ),
    Attack(
        "Records.json in s, ms, µs and ns",
        imported("Records.json", records([location(n, timestampMs=str((TIME + n) * 1000**n)) for n in range(4)])),
        (0,),
        "4 new positions",
    ),
    Attack(
        "Records.json in UTF-16",
        imported("Records.json", records([location(0)]).decode().encode("utf-16")),
        says="UTF-16",
    ),
    Attack(
        "Records.json, NaN and 1e300",
        imported(
            "Records.json",
            b'{"locations": [{"latitudeE7": 1e300, "longitudeE7": 1, "timestampMs": "1"}, {"latitudeE7": NaN}]}',
        ),
        EITHER,
        "left out",
    ),
    *(
        Attack(
            f"{name}: {what}",
            imported(f"t.{name.lower()}", xml(root, doctype, inside.format(entity))),
            says="document type|amplification",
        )
        for name, root, inside in (("GPX", "gpx", POINT), ("KML", "kml", MARK))
        for what, doctype, entity in (("billion laughs", LAUGHS, "&l9;"), ("external entity", OUTSIDE, "&x;"))
    ),
    Attack(
        "GPX: entities in attributes", imported("t.gpx", xml("gpx", LAUGHS, POINT.replace('lat="49"', 'lat="&l9;"')))
    ),
    Attack("GPX: a document type before no point", imported("t.gpx", xml("gpx", LAUGHS, "<a>&l9;</a>")), EITHER),
    Attack("GPX: elements 10⁶ deep", imported("t.gpx", lambda: xml("gpx", inside="<a>" * MB + "</a>" * MB))),
    Attack("KML: elements 10⁶ deep", imported("t.kml", lambda: xml("kml", inside="<a>" * MB + "</a>" * MB))),
    Attack(
        "GPX: one text of 900 MB", imported("t.gpx", lambda: xml("gpx", inside="<name>" + "a" * 900 * MB + "</name>"))
    ),
    Attack("GPX: 100 MB of empty elements", imported("t.gpx", lambda: xml("gpx", inside="<a/>" * 25 * MB))),
    Attack(
        "KML: a track of 3·10⁶ times without places",
        imported(
            "t.kml", lambda: xml("kml", inside="<Placemark><Track>" + "<when/>" * 3 * MB + "</Track></Placemark>")
        ),
        EITHER,
    ),
    Attack("GPX in UTF-16", imported("t.gpx", gpx(["2023-11-14T22:13:20Z"]).decode().encode("utf-16")), EITHER),
    Attack(
        "GPX: times of the years 1, 9999 and 1e300",
        imported("t.gpx", gpx(["0001-01-01T00:00:00Z", "9999-12-31T23:59:59Z", "1e300", "NaN"])),
        EITHER,
        "left out",
    ),
    Attack("FIT of 10⁵ positions", imported("t.fit", lambda: fit(100_000)), EITHER),
    Attack("FIT of 10⁶ positions", imported("t.fit", lambda: fit(1_000_000)), EITHER, "messages"),
    Attack("FIT, states 4 GB", imported("t.fit", lambda: fit(100, 4_000_000_000)), EITHER),
    Attack("FIT of 100 MB", imported("t.fit", lambda: fit(10) + bytes(100 * MB)), EITHER),
    Attack("OwnTracks: one line of 1 GB", imported("t.rec", lambda: rec([TIME])[:-2] + b"a" * 990 * MB), EITHER),
    Attack(
        "OwnTracks: brackets 10⁵ deep",
        imported("t.rec", rec([TIME, "[" * 100_000 + "]" * 100_000])),
        EITHER,
        "unreadable",
    ),
)
