"""Plans: bombs of pictures, pages, drawings and GeoJSON; depth, entities, poles and the antimeridian, wild numbers."""

import json
import struct
import zlib

import numpy as np
from hostile_attack import EITHER, USED, Attack

MB = 1_000_000


def check(path, *options):
    return ["map", "check", path, *options], 0


def written(name, content, *options):
    def make(folder):
        (folder / name).write_bytes(content() if callable(content) else content)
        return check(folder / name, *options)

    return make


def box(x, y, width, height, ring=None):
    return [[x, y], [x + width, y], [x + width, y + height], [x, y + height], [x, y]]


def feature(kind, *rings, **properties):
    geometry = {"type": "Polygon", "coordinates": list(rings)}
    return {"type": "Feature", "properties": {"kind": kind, **properties}, "geometry": geometry}


def plan(features, about=None):
    about = {"frame": "local"} if about is None else about
    return json.dumps({"type": "FeatureCollection", "pdr_graph": about, "features": features}).encode()


def corridor(**replaced):
    """A plan of a corridor and a room, with other coordinates put in."""
    features = [
        feature("corridor", box(0, 0, 9, 2)),
        feature("room", box(0, 2, 9, 4)),
        feature("door", box(4, 1.9, 1, 0.2)),
    ]
    return plan(features)


def vertices(number, radius=50.0, waves=0):
    """A corridor whose outline is a circle of so many corners, or one that crosses itself in waves."""
    angle = np.linspace(0, 2 * np.pi, number)
    r = radius * (1 + 0.3 * np.sin(waves * angle))
    ring = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1).round(6)
    ring[-1] = ring[0]
    return plan([feature("corridor", ring.tolist())])


def scribble(number):
    """An outline of random corners: every side crosses every other."""
    ring = np.random.default_rng(0).uniform(0, 50, (number, 2)).round(3).tolist()
    return plan([feature("corridor", [*ring, ring[0]])])


def grid(number, kind="room"):
    side = int(number**0.5)
    rooms = [feature(kind, box(3 * (n % side), 3 * (n // side), 2.9, 2.9)) for n in range(number)]
    return plan([feature("corridor", box(-5, -5, 4, 4)), *rooms])


def stacked(number):
    """As many corridors on one place."""
    return plan([feature("corridor", box(0, 0, 9, 2)) for _ in range(number)])


def holes(number):
    side = int(number**0.5)
    outer = box(0, 0, 2 * side, 2 * side)
    return plan(
        [feature("corridor", outer, *(box(2 * (n % side) + 0.5, 2 * (n // side) + 0.5, 1, 1) for n in range(number)))]
    )


def about_earth(lon, lat):
    """A plan of 20 m in degrees about a place."""
    d = 1e-4
    rings = [[[lon + x * d, lat + y * d] for x, y in ring] for ring in (box(0, 0, 9, 2), box(0, 2, 9, 4))]
    return plan([feature(kind, ring) for kind, ring in zip(("corridor", "room"), rings, strict=True)], {})


def coordinates(text):
    return corridor().replace(b"[9, 2]", text)


def deep(opening, closing, depth, around=(b'{"type": "FeatureCollection", "features": ', b"}")):
    return around[0] + opening * depth + closing * depth + around[1]


def floors(number):
    return plan([feature("corridor", box(0, 0, 9, 2), floor=str(n)) for n in range(number)])


def osm(level):
    nodes = "".join(
        f"<node id='{n}' lat='{49 + y * 1e-4}' lon='{8 + x * 1e-4}'/>" for n, (x, y) in enumerate(box(0, 0, 9, 2)[:4])
    )
    refs = "".join(f"<nd ref='{n % 4}'/>" for n in range(5))
    tags = f"<tag k='indoor' v='corridor'/><tag k='level' v='{level}'/>"
    return f"<osm version='0.6'>{nodes}<way id='1'>{refs}{tags}</way></osm>".encode()


LAUGHS = "".join(f'<!ENTITY l{n} "{f"&l{n - 1};" * 10}">' for n in range(1, 10))
LAUGHS = f'<!DOCTYPE osm [<!ENTITY l0 "lol">{LAUGHS}]>'


def osm_with(doctype, place):
    text = osm("0").decode().replace("v='corridor'", f"v='{place}'")
    return f"<?xml version='1.0'?>{doctype}{text}"


def png(width, height, rows=True):
    """A PNG of one colour; without rows its header only."""

    def part(kind, data):
        return struct.pack(">L", len(data)) + kind + data + struct.pack(">L", zlib.crc32(kind + data))

    packer, data = zlib.compressobj(9), b""
    if rows:
        row = bytes(width // 8 + 2)
        data = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    header = struct.pack(">LL5B", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", header) + part(b"IDAT", data) + part(b"IEND", b"")


def png_text_bomb():
    """A small PNG with a compressed text of 500 MB."""

    def part(kind, data):
        return struct.pack(">L", len(data)) + kind + data + struct.pack(">L", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    text = b"".join(packer.compress(bytes(MB)) for _ in range(500)) + packer.flush()
    whole = png(100, 100)
    return whole[:33] + part(b"zTXt", b"k\0\0" + text) + whole[33:]


def pdf(content, packed=False, page=(595, 842)):
    """A page with a content stream."""
    data = zlib.compress(content, 9) if packed else content
    about = f"<< /Length {len(data)} {'/Filter /FlateDecode' if packed else ''} >>"
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {page[0]} {page[1]}] /Contents 4 0 R >>".encode(),
        about.encode() + b"\nstream\n" + data + b"\nendstream",
    ]
    out, places = b"%PDF-1.4\n", []
    for n, item in enumerate(objects, 1):
        places.append(len(out))
        out += f"{n} 0 obj\n".encode() + item + b"\nendobj\n"
    table = "".join(f"{place:010} 00000 n \n" for place in places)
    end = f"trailer << /Size 5 /Root 1 0 R >>\nstartxref\n{len(out)}\n%%EOF"
    return out + f"xref\n0 5\n0000000000 65535 f \n{table}{end}".encode()


def pdf_paths(number):
    rows = (f"{n % 500} {n // 500 % 800} m {n % 500 + 1} {n // 500 % 800 + 1} l S" for n in range(number))
    return pdf("\n".join(rows).encode())


def dxf(blocks, entities, units=6):
    text = ["0 SECTION 2 HEADER 9 $INSUNITS 70", str(units), "0 ENDSEC 0 SECTION 2 BLOCKS"]
    for name, inside in blocks:
        text.append(f"0 BLOCK 2 {name} 70 0 10 0 20 0 {inside} 0 ENDBLK")
    text.append(f"0 ENDSEC 0 SECTION 2 ENTITIES {entities} 0 ENDSEC 0 EOF")
    return "\n".join(" ".join(text).split()).encode() + b"\n"


def insert(name, *more):
    return f"0 INSERT 8 0 2 {name} 10 0 20 0 {' '.join(more)}"


LINE = "0 LINE 8 0 10 0 20 0 11 5 21 5"


def recursive_blocks():
    return dxf([("A", insert("B") + " " + LINE), ("B", insert("A"))], insert("A"))


def doubling_blocks(depth):
    blocks = [(f"B{n}", " ".join([insert(f"B{n + 1}")] * 10)) for n in range(depth)]
    return dxf([*blocks, (f"B{depth}", LINE)], insert("B0"))


def array_of_blocks():
    return dxf([("A", LINE)], insert("A", "70 30000 71 30000 44 1 45 1"))


def circles(number):
    return dxf([], " ".join(f"0 CIRCLE 8 0 10 {n} 20 0 40 1e9" for n in range(number)))


def yaml_map(text):
    def make(folder):
        (folder / "m.yaml").write_bytes(text)
        (folder / "m.png").write_bytes(png(100, 100))
        return check(folder / "m.yaml")

    return make


YAML = b"image: m.png\nresolution: 0.05\norigin: [0, 0, 0]\n"
YAML_LAUGHS = b"a0: &a0 [l,l]\n" + b"".join(
    b"a%d: &a%d [%s]\n" % (n, n, b",".join([b"*a%d" % (n - 1)] * 10)) for n in range(1, 12)
)


def imdf(level_features):
    def make(folder):
        from mutations import imdf as whole

        for name, text in whole().items():
            (folder / "plan" / name).parent.mkdir(exist_ok=True)
            value = json.loads(text)
            if name == "unit.geojson":
                value["features"] = value["features"] * level_features
            (folder / "plan" / name).write_text(json.dumps(value))
        return check(folder / "plan")

    return make


def smooth_with(content, name="plan.geojson"):
    from hostile_attack import walk

    def make(folder):
        (folder / name).write_bytes(content())
        return ["smooth", walk(folder), "--map", folder / name, "--out", "OUT/s"], 0

    return make


PLANS = (
    Attack("GeoJSON: an outline of 10⁶ corners", written("p.geojson", lambda: vertices(1_000_000)), EITHER),
    Attack(
        "GeoJSON: an outline of 10⁵ corners in waves",
        written("p.geojson", lambda: vertices(100_000, waves=1000)),
        EITHER,
    ),
    Attack("smooth: a plan of 10⁵ corners", smooth_with(lambda: vertices(100_000)), EITHER),
    Attack("GeoJSON: an outline of 2000 random corners", written("p.geojson", lambda: scribble(2000)), EITHER),
    Attack("GeoJSON: 3 · 10⁴ rooms", written("p.geojson", lambda: grid(30_000)), EITHER),
    Attack("GeoJSON: 10⁵ rooms", written("p.geojson", lambda: grid(100_000)), says="features"),
    Attack("GeoJSON: 10⁴ corridors on one place", written("p.geojson", lambda: stacked(10_000)), EITHER),
    Attack("GeoJSON: a corridor with 10⁴ holes", written("p.geojson", lambda: holes(10_000)), EITHER),
    Attack("GeoJSON: a corridor with 10⁵ holes", written("p.geojson", lambda: holes(100_000)), says="holes"),
    Attack("GeoJSON: 10⁴ floors", written("p.geojson", lambda: floors(10_000)), EITHER),
    Attack("GeoJSON: brackets 10⁶ deep", written("p.geojson", lambda: deep(b"[", b"]", MB))),
    Attack(
        "GeoJSON: 90 MB of empty lists",
        written("p.geojson", lambda: deep(b"[],", b"", 30 * MB, (b'{"a": [', b"[]]}"))),
    ),
    Attack("GeoJSON: a number of 10⁶ digits", written("p.geojson", lambda: coordinates(b"[9, " + b"9" * MB + b"]"))),
    Attack("GeoJSON: at the north pole", written("p.geojson", about_earth(0, 89.9999)), EITHER),
    Attack("GeoJSON: across the antimeridian", written("p.geojson", about_earth(179.9999, 10)), EITHER),
    Attack(
        "GeoJSON: across the antimeridian, signs changed",
        written("p.geojson", about_earth(179.9999, 10).replace(b"180.0", b"-179.9")),
        EITHER,
    ),
    Attack("GeoJSON: three coordinates", written("p.geojson", coordinates(b"[9, 2, 1e300]")), EITHER),
    *(
        Attack(f"GeoJSON: {v} as a coordinate", written("p.geojson", coordinates(f"[{v}, 2]".encode())))
        for v in ("NaN", "1e300", "-Infinity", "1e9", '"9"', "true", "null")
    ),
    Attack("GeoJSON in UTF-16", written("p.geojson", corridor().decode().encode("utf-16")), EITHER),
    Attack("GeoJSON in UTF-8 with its mark", written("p.geojson", b"\xef\xbb\xbf" + corridor()), USED),
    Attack(
        "GeoJSON with a name in Latin-1",
        written("p.geojson", corridor().replace(b'"kind": "room"', b'"kind": "room", "name": "Caf\xe9"')),
    ),
    Attack("OSM: levels 0 to 10⁹", written("p.osm", osm("0-1000000000")), EITHER),
    Attack(
        "OSM: levels -200 to 200, ten thousand times", written("p.osm", osm(";".join(["-200-200"] * 10_000))), EITHER
    ),
    Attack("OSM: elements 10⁶ deep", written("p.osm", lambda: b"<osm>" + b"<a>" * MB + b"</a>" * MB + b"</osm>")),
    Attack("OSM: billion laughs", written("p.osm", osm_with(LAUGHS, "&l9;").encode())),
    Attack("OSM: billion laughs in UTF-16", written("p.osm", osm_with(LAUGHS, "&l9;").encode("utf-16"))),
    Attack(
        "OSM: external entity",
        written("p.osm", osm_with('<!DOCTYPE osm [<!ENTITY x SYSTEM "file:///etc/passwd">]>', "&x;").encode()),
    ),
    Attack("PNG of 100 000 x 100 000", written("p.png", lambda: png(100_000, 100_000), "--scale", "0.05")),
    Attack("PNG of 8900 x 8900, all white", written("p.png", lambda: png(8900, 8900), "--scale", "0.05")),
    Attack(
        "PNG, header of 2³¹ x 2³¹ without rows",
        written("p.png", lambda: png(2**31 - 1, 2**31 - 1, False), "--scale", "0.05"),
    ),
    Attack("PNG with a compressed text of 500 MB", written("p.png", png_text_bomb, "--scale", "0.05")),
    Attack("PDF of 10⁶ paths", written("p.pdf", lambda: pdf_paths(1_000_000), "--scale", "0.0353")),
    Attack(
        "PDF stream of 500 MB in 500 kB",
        written("p.pdf", lambda: pdf(b"0 0 m 9 9 l S\n" * 36 * MB, True), "--scale", "0.0353"),
    ),
    Attack("PDF stream of 500 MB of blanks", written("p.pdf", lambda: pdf(b" " * 500 * MB, True), "--scale", "0.0353")),
    Attack(
        "PDF page of 10⁹ points",
        written("p.pdf", lambda: pdf(b"0 0 m 9 9 l S\n", page=(10**9, 10**9)), "--scale", "0.0353"),
    ),
    Attack("DXF: blocks in themselves", written("p.dxf", recursive_blocks)),
    Attack("DXF: ten blocks in each of ten, 12 deep", written("p.dxf", lambda: doubling_blocks(12))),
    Attack("DXF: an array of 9·10⁸ blocks", written("p.dxf", array_of_blocks)),
    Attack("DXF: 10⁵ circles of 10⁹ m", written("p.dxf", lambda: circles(100_000))),
    Attack("ROS map: billion laughs", yaml_map(YAML + YAML_LAUGHS), EITHER),
    Attack("ROS map: a picture elsewhere", yaml_map(YAML.replace(b"m.png", b"../../../etc/passwd"))),
    Attack("ROS map: a Python object", yaml_map(YAML + b'x: !!python/object/apply:os.system ["touch pwned"]\n')),
    Attack("ROS map: lists 10⁴ deep", yaml_map(YAML + b"a: " + b"[" * 10_000 + b"]" * 10_000)),
    Attack("IMDF: 30 000 units on one place", imdf(10_000), EITHER),
)
