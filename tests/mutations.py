"""Damaged inputs: one input of each kind that is read, and ways to damage it."""

import io as memory
import json
import random
import zipfile

import drawn_plans
import shapely
from recorders import EXPORTS, Sample, phyphox, sample

from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate

SAMPLES = 80
NUMBERS = (b"nan", b"inf", b"-inf", b"1e308", b"-1", b"0", b"", b"9" * 400, b"1e-320", b"0x10", b"1,5", b"true")
NUMBERS += (b"\xff\xfe",)
BYTES = (b"\x00", b'"', b",", b";", b"\t", b"\n", b"\r", b"\\", b"<", b"&", b"{", b"[", b"\xef\xbb\xbf", "٣".encode())


def small():
    """The first second and a half of the walk, with two fixes."""
    whole = vars(sample())
    few = {"fix_time", "lonlat", "accuracy", "bearing"}
    return Sample(**{name: column[: 2 if name in few else SAMPLES] for name, column in whole.items()})


def zipped(files):
    out = memory.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return out.getvalue()


def gpx():
    point = '<trkpt lat="49.4{}" lon="11.1"><ele>3</ele><time>2023-11-14T22:13:2{}Z</time><hdop>1.2</hdop></trkpt>'
    points = "".join(point.format(n, n) for n in range(5))
    return f'<?xml version="1.0"?><gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{points}</trkseg></trk></gpx>'


def plan(ipin=False, local=False):
    """A corridor, a room and stairs between two floors."""
    shift, scale = ((566e3, 5932e3), 1.0) if ipin else ((8, 49), 1.0 if local else 1e-5)
    boxes = {"corridor": (0, 0, 9, 2), "room": (0, 2, 9, 6), "wall": (0, 2, 4, 2.2), "door": (4, 2, 5, 2.2)}
    features = []
    for kind, box in (boxes | {"stairs": (0, -3, 2, 0)}).items():
        properties = {"Type": kind.title()} if ipin else {"kind": kind, "name": kind, "floor": ["0", "1"]}
        features.append({"type": "Feature", "properties": properties, "geometry": placed(box, shift, scale)})
    frame = {"frame": "local"} if local else {"origin": [8.0, 49.0]}
    ours = {"pdr_graph": frame | {"heights": {"0": 0, "1": 4}}}
    about = {"crs": {"properties": {"name": "EPSG::32632"}}} if ipin else ours
    return json.dumps({"type": "FeatureCollection", **about, "features": features})


def placed(box, shift=(8, 49), scale=1e-5):
    """The GeoJSON geometry of a box in metres."""
    moved = shapely.box(*(v * scale + o for v, o in zip(box, shift * 2, strict=True)))
    return json.loads(shapely.to_geojson(moved))


def imdf():
    """A level with a walkway, an office and stairs, and an opening."""

    def file(*features):
        return json.dumps({"type": "FeatureCollection", "features": list(features)})

    def feature(box, **properties):
        return {"type": "Feature", "id": properties.pop("id", "x"), "properties": properties, "geometry": placed(box)}

    level = feature((0, 0, 9, 9), id="g", ordinal=0, short_name={"en": "G"}, building_ids=["b"], outdoor=False)
    boxes = {"walkway": (0, 0, 9, 2), "office": (0, 2, 5, 6), "stairs": (5, 2, 9, 6)}
    units = [feature(box, id=c, category=c, level_id="g", name={"en": c}) for c, box in boxes.items()]
    return {
        "level.geojson": file(level),
        "unit.geojson": file(*units),
        "opening.geojson": file(feature((2, 1.9, 3, 2.1), level_id="g", category="pedestrian")),
        "manifest.json": json.dumps({"version": "1.0.0", "language": "en"}),
    }


INDOOR = {
    "corridor": ((0, 0, 9, 2), {"indoor": "corridor", "level": "0;1"}),
    "room": ((0, 2, 5, 6), {"indoor": "room", "level": "0", "name": "shop"}),
    "stairs": ((5, 2, 9, 6), {"indoor": "room", "stairs": "yes", "level": "0-1"}),
}


def osm_geojson(first=0):
    """INDOOR on the levels from `first` on, and a door."""
    features = [{"type": "Feature", "properties": tags, "geometry": placed(box)} for box, tags in INDOOR.values()]
    door = {"type": "Point", "coordinates": [8.00002, 49.00002]}
    features.append({"type": "Feature", "properties": {"door": "yes", "level": "0"}, "geometry": door})
    text = json.dumps({"type": "FeatureCollection", "features": features})
    return text.replace('"0;1"', f'"{first};{first + 1}"').replace('"0-1"', f'"{first}"').replace('"0"', f'"{first}"')


def osm():
    lines = ["<?xml version='1.0' encoding='UTF-8'?>", "<osm version='0.6'>"]
    for n, (box, tags) in enumerate(INDOOR.values()):
        corners = placed(box)["coordinates"][0][:4]
        lines += [f"<node id='{4 * n + k}' lat='{lat}' lon='{lon}'/>" for k, (lon, lat) in enumerate(corners)]
        refs = "".join(f"<nd ref='{4 * n + k % 4}'/>" for k in range(5))
        lines.append(f"<way id='{n}'>{refs}" + "".join(f"<tag k='{k}' v='{v}'/>" for k, v in tags.items()) + "</way>")
    return "\n".join([*lines, "<node id='99' lat='49.00002' lon='8.00002'><tag k='door' v='yes'/></node>", "</osm>"])


SCENARIO = """seed = 3
start = 2026-05-01T10:00:00Z
recorder = "phyphox"
place = [11.08, 49.45]
heading = 90
route = [[0, 0], {stand = 1, turn = 20}, {to = [[3, 0], [3, 2]], manner = "slow", zigzag = 0.3, hold = "bag"}, [4, 4],
    {stairs = "2", to = [5, 4], climb = 1}, {lift = "1"}, {shake = 1}, {hold = "cart"}, {roll = [5, 5], speed = 0.5}]
[walker]
height = 1.7
sex = "f"
[phone]
rate = 50
lost = 0.01
sensors = ["accelerometer", "gyroscope", "barometer"]
[gnss]
latency = 1
outages = [[2, 4]]
[fixes]
period = 2
[beacons]
a = [1, 2]
[wifi]
access_points = 3
"""


PLAN_SCALES = {"cad lines": 1.0, "dxf": None, "picture": 0.1, "pdf": 0.0353}  # [m] per unit, of plans that need one


def simulated_if_short(path):
    """A scenario, walked unless damage has made it long."""
    scenario = Scenario.load(path)
    if scenario.route.duration * scenario.phone.rate < 6000 and len(scenario.access_points) < 10:
        simulate(scenario)


def inputs():
    """Name to (file name, bytes or files of a folder) of a whole input of every kind."""
    s = small()
    recordings = {name: (path, write(s)) for name, (path, write) in EXPORTS.items()}
    recordings = {n: (path, t.encode() if isinstance(t, str) else t) for n, (path, t) in recordings.items()}
    recordings |= {
        "phyphox": ("walk.zip", phyphox(s) | {"meta/time.csv": '"event","a","b"\n"START",0.0,1.7E9\n'}),
        "gpx": ("track.gpx", gpx().encode()),
    }
    tables = {
        "fixes": ("fixes.csv", b"time,x,y,sigma,floor\n1700000000.5,1,2,0.5,F1\n1700000001,3,4,2,\n"),
        "scenario": ("walk.toml", SCENARIO.encode()),
        "trajectory": ("t.csv", b"time,x,y,heading,floor\n1,0,0,0.1,F1\n2,1,0,,\n3,2,0,nan,F1\n"),
    }
    plans = {
        "own plan": ("plan.geojson", plan().encode()),
        "ipin21 plan": ("Plan4OG.geojson", plan(ipin=True).encode()),
        "imdf archive": ("imdf.zip", imdf()),
        "osm indoor xml": ("mall.osm", osm().encode()),
        "osm indoor geojson": ("mall.geojson", osm_geojson().encode()),
        "a file per floor": ("house.zip", {"house/0.geojson": plan(), "house/2.geojson": osm_geojson(first=2)}),
        "local plan": ("local.geojson", plan(local=True).encode()),
        "cad lines": ("lines.csv", drawn_plans.csv(drawn_plans.segments(drawn_plans.walls())).encode()),
        "dxf": ("plan.dxf", drawn_plans.file_bytes(lambda folder: drawn_plans.dxf(folder / "a.dxf"))),
        "picture": ("plan.png", drawn_plans.file_bytes(lambda folder: drawn_plans.picture(0.1).save(folder / "a.png"))),
        "pdf": ("plan.pdf", drawn_plans.file_bytes(lambda folder: drawn_plans.pdf(folder / "a.pdf"))),
    }
    return recordings, tables, plans


def mutated(whole, chance: random.Random):
    """A damaged copy: of the bytes, or of the files in a zip, or of the zip itself."""
    if isinstance(whole, bytes):
        return _damage(whole, chance)
    files = {name: text.encode() for name, text in whole.items()}
    for _ in range(chance.randint(1, 2)):
        name = chance.choice(list(files))
        files[name] = _damage(files[name], chance)
    if chance.random() < 0.1:
        del files[chance.choice(list(files))]
    archive = zipped(files)
    return _damage(archive, chance) if chance.random() < 0.2 else archive


def _damage(data: bytes, chance: random.Random) -> bytes:
    for _ in range(chance.choice((1, 1, 1, 2, 5))):
        data = chance.choice((_cut, _flip, _insert, _repeat, _drop, _number, _swap_lines))(data, chance)
    return data


def _span(data, chance, longest=200):
    start = chance.randrange(len(data) + 1)
    return start, min(len(data), start + chance.randint(1, longest))


def _cut(data, chance):
    return data[: chance.randrange(len(data) + 1)]


def _flip(data, chance):
    if not data:
        return data
    at = chance.randrange(len(data))
    return data[:at] + bytes([data[at] ^ (1 << chance.randrange(8))]) + data[at + 1 :]


def _insert(data, chance):
    at = chance.randrange(len(data) + 1)
    return data[:at] + chance.choice(BYTES) * chance.choice((1, 1, 3, 100)) + data[at:]


def _repeat(data, chance):
    start, end = _span(data, chance)
    return data[:end] + data[start:end] * chance.choice((1, 2, 20)) + data[end:]


def _drop(data, chance):
    start, end = _span(data, chance)
    return data[:start] + data[end:]


def _number(data, chance):
    """One number becomes something else."""
    digits = [n for n in range(len(data)) if data[n : n + 1].isdigit()]
    if not digits:
        return data
    start = end = chance.choice(digits)
    while end < len(data) and data[end : end + 1] in b"0123456789.eE+-":
        end += 1
    return data[:start] + chance.choice(NUMBERS) + data[end:]


def _swap_lines(data, chance):
    lines = data.split(b"\n")
    i, j = chance.randrange(len(lines)), chance.randrange(len(lines))
    lines[i], lines[j] = lines[j], lines[i]
    return b"\n".join(lines)
