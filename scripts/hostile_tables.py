"""Tables of fixes, beacons, ranges and truth, walker profiles, routes, radio maps, and lists of a million rows."""

import io
import json
import zipfile

import numpy as np
from hostile_attack import EITHER, USED, Attack, walk

MB = 1_000_000


def smooth(option, name, content):
    def make(folder):
        path = folder / name
        path.write_bytes(content() if callable(content) else content)
        return ["smooth", walk(folder), option, path, "--out", "OUT/s"], 0

    return make


def rows(header, row, number):
    return lambda: (header + "\n" + "".join(row.format(n) + "\n" for n in range(number))).encode()


def evaluated(truth, track=b"time,x,y,heading\n0,0,0,0\n1,1,1,0\n2,2,2,0\n"):
    def make(folder):
        for name, content in (("track.csv", track), ("truth.csv", truth)):
            (folder / name).write_bytes(content() if callable(content) else content)
        return ["evaluate", folder / "track.csv", folder / "truth.csv"], 0

    return make


class Evil:
    def __reduce__(self):
        import os

        return os.system, ("touch pwned",)


def npz(**changed):
    """A radio map, as ``radio-map`` writes it, with other arrays."""
    arrays = {
        "transmitter": np.array(["a", "b"]),
        "level": np.ones((3, 2), np.float32),
        "position": np.ones((3, 2)),
        "floor": np.array(["", "", ""]),
        "frame": np.array("{}"),
        "range": np.array([0.1, 0.5]),
        "variance": np.array([1.0, 1.0]),
    }
    file = io.BytesIO()
    np.savez_compressed(file, **(arrays | changed))
    return file.getvalue()


def npz_of(header, size, method=zipfile.ZIP_DEFLATED):
    """A radio map whose levels have another header of the array, and so many zeros."""

    def make():
        file = io.BytesIO(npz())
        with zipfile.ZipFile(file) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w", method) as archive:
            for name, content in members.items():
                if name != "level.npy":
                    archive.writestr(name, content)
            with archive.open("level.npy", "w", force_zip64=True) as member:
                text = header.encode().ljust(117) + b"\n"
                member.write(b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text)
                for _ in range(size // MB):
                    member.write(bytes(MB))
        return out.getvalue()

    return make


def shape(*sides):
    return f"{{'descr': '<f4', 'fortran_order': False, 'shape': {sides}, }}"


def route(corners):
    def make(folder):
        line = {"type": "LineString", "coordinates": corners() if callable(corners) else corners}
        collection = {"type": "FeatureCollection", "pdr_graph": {"frame": "local"}}
        collection["features"] = [{"type": "Feature", "properties": {"kind": "link"}, "geometry": line}]
        (folder / "route.geojson").write_text(json.dumps(collection))
        return ["calibrate", walk(folder), "--route", folder / "route.geojson", "--out", "OUT/w.toml"], 0

    return make


def toml(text):
    return smooth("--walker", "walker.toml", text)


FIXES = "time,x,y,sigma"
CORNERS = np.column_stack([np.linspace(0, 20, 1_000_000), np.zeros(1_000_000)])
TABLES = (
    Attack("--fixes: 10⁶ rows", smooth("--fixes", "f.csv", rows(FIXES, "{0}e-5,0,0,5", 1_000_000)), EITHER),
    Attack("--fixes: one line of 300 MB", smooth("--fixes", "f.csv", lambda: b"time,x,y,sigma\n" + b"1" * 300 * MB)),
    Attack(
        "--fixes: a cell of 10⁶ digits",
        smooth("--fixes", "f.csv", lambda: b"time,x,y,sigma\n1,1,1," + b"9" * MB + b"\n"),
    ),
    *(
        Attack(
            f"--fixes: Unix {unit}",
            smooth("--fixes", "f.csv", rows(FIXES, f"170000000{{0}}{zeros},0,0,5", 9)),
            says="time",
        )
        for unit, zeros in (("s", ""), ("ms", "000"), ("µs", "000000"), ("ns", "000000000"))
    ),
    *(
        Attack(f"--fixes: {value} as {what}", smooth("--fixes", "f.csv", f"{FIXES}\n1,0,0,5\n{row}\n".encode()))
        for value in ("NaN", "inf", "1e300", "-1e300")
        for what, row in (("a time", f"{value},0,0,5"), ("a place", f"2,{value},0,5"), ("a sigma", f"2,0,0,{value}"))
    ),
    Attack(
        "--fixes: a place of 1e15 m", smooth("--fixes", "f.csv", f"{FIXES}\n1,0,0,5\n2,1e15,0,5\n".encode()), EITHER
    ),
    Attack(
        "--fixes: a sigma of 1e-300 m",
        smooth("--fixes", "f.csv", f"{FIXES}\n1,0,0,1e-300\n2,1,0,1e-300\n".encode()),
        says="standard deviation",
    ),
    Attack(
        "--fixes: at the north pole",
        smooth("--fixes", "f.csv", b"time,lat,lon,sigma\n1,90,0,5\n9,89.9999,120,5\n"),
        EITHER,
    ),
    Attack(
        "--fixes: across the antimeridian",
        smooth("--fixes", "f.csv", b"time,lat,lon,sigma\n1,10,179.99999,5\n9,10,-179.9999,5\n"),
        EITHER,
    ),
    Attack("--fixes in UTF-16", smooth("--fixes", "f.csv", f"{FIXES}\n1,0,0,5\n9,1,0,5\n".encode("utf-16")), USED),
    Attack("--fixes with a label in Latin-1", smooth("--fixes", "f.csv", b"time,x,y,sigma,floor\n1,0,0,5,\xe9\n")),
    Attack("--beacons: 3·10⁵ rows", smooth("--beacons", "b.csv", rows("beacon,x,y", "b{0},0,0", 300_000)), EITHER),
    Attack("--beacons: NaN", smooth("--beacons", "b.csv", b"beacon,x,y\na,NaN,0\n")),
    Attack("evaluate: a truth of 10⁶ rows", evaluated(rows("time,x,y", "{0}e-5,0,0", 1_000_000)), (0,)),
    Attack("evaluate: a truth in ms", evaluated(b"time,x,y\n0,0,0\n1000,1,1\n2000,2,2\n"), EITHER),
    Attack("evaluate: a truth of 1e300 m", evaluated(b"time,x,y\n0,0,0\n1,1e300,1\n2,2,2\n")),
    Attack("evaluate: a truth of 1e19 m", evaluated(b"time,x,y\n0,0,0\n1,1e19,1\n2,2,2\n"), EITHER),
    Attack("walker TOML: NaN", toml(b"[steps]\nlength = nan\n")),
    Attack("walker TOML: a number of 10⁶ digits", toml(lambda: b"a = " + b"9" * MB)),
    Attack("walker TOML: lists 10⁵ deep", toml(lambda: b"a = " + b"[" * 100_000)),
    Attack("walker TOML: 10⁵ dots", toml(lambda: b"a" + b".a" * 100_000 + b" = 1")),
    Attack("walker TOML: a million tables", toml(lambda: b"".join(b"[t%d]\n" % n for n in range(MB)))),
    Attack("walker TOML: 300 MB", toml(lambda: b"#" * 300 * MB)),
    Attack("calibrate: a route of 10⁶ corners", route(lambda: CORNERS.round(6).tolist()), EITHER),
    Attack("calibrate: a route of NaN", route([[0, 0], [float("nan"), 1]])),
    Attack(
        "radio map: pickled objects",
        smooth("--radio-map", "m.npz", lambda: npz(floor=np.array([Evil(), "", ""], object))),
    ),
    Attack(
        "radio map: a pickle instead of a zip",
        smooth("--radio-map", "m.npz", b"\x80\x04cos\nsystem\n(S'touch pwned'\ntR."),
    ),
    Attack("radio map: 4 GB of zeros", smooth("--radio-map", "m.npz", npz_of(shape(1000, 1_000_000), 4000 * MB))),
    Attack("radio map: states 4 TB", smooth("--radio-map", "m.npz", npz_of(shape(1_000_000, 1_000_000), MB))),
    Attack("radio map: NaN", smooth("--radio-map", "m.npz", lambda: npz(position=np.full((3, 2), np.nan)))),
)
