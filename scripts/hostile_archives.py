"""Archives: bombs, overlaps, a million members, wrong sizes, names and links that lead elsewhere."""

import io
import os
import stat
import struct
import zipfile
import zlib

from hostile_attack import EITHER, USED, Attack, honest, walk

MB = 1_000_000


def zipped(path, members, method=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members:
            archive.writestr(name, content)
    return path


def honest_members():
    return list(honest().items())


def blown(path, size, method, name="Accelerometer.csv"):
    """An archive of one member: a header and ``size`` bytes of zeros."""
    with zipfile.ZipFile(path, "w", method) as archive, archive.open(name, "w", force_zip64=True) as member:
        member.write(b'"Time (s)","Acceleration x (m/s^2)","Acceleration y (m/s^2)","Acceleration z (m/s^2)"\n')
        for _ in range(size // MB):
            member.write(bytes(MB))
    return path


def bomb(method, size):
    return lambda folder: (["smooth", blown(folder / "bomb.zip", size, method), "--out", "OUT/s"], 1000 * MB)


def nested(folder):
    content = b"".join(f"{n},1,2,3\n".encode() for n in range(1000))
    for _ in range(8):
        packed = io.BytesIO()
        zipped(packed, [(f"{n}.zip", content) for n in range(10)])
        content = packed.getvalue()
    (folder / "nested.zip").write_bytes(content)
    return ["smooth", folder / "nested.zip", "--out", "OUT/s"], 0


def directory(entries, offset):
    """A central directory of (name, crc, packed, unpacked, place of the local header), and the end record."""
    head = struct.Struct("<4s4B4HL2L5H2L")
    records = b"".join(
        head.pack(b"PK\x01\x02", 20, 3, 20, 0, 0, 8, 0, 33, crc, packed, size, len(name), 0, 0, 0, 0, 0, at) + name
        for name, crc, packed, size, at in entries
    )
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, len(entries), len(entries), len(records), offset, 0)
    return records + end


def local(name, crc, packed, size):
    return struct.pack("<4s2B4HL2L2H", b"PK\x03\x04", 20, 0, 0, 8, 0, 33, crc, packed, size, len(name), 0) + name


def overlapping(folder):
    """100 members whose local headers are quoted by the members before: all unpack the same 10 MB (Fifield 2019)."""
    unpacked = bytes(10 * MB)
    packer = zlib.compressobj(9, wbits=-15)
    content, entries = packer.compress(unpacked) + packer.flush(), []
    for n in reversed(range(100)):
        name = f"{n}.csv".encode()
        facts = zlib.crc32(unpacked), len(content), len(unpacked)
        header = local(name, *facts)
        entries.append((name, *facts, -len(header + content)))
        quoted = struct.pack("<B2H", 0, len(header), len(header) ^ 0xFFFF)  # a stored block: the header, as data
        content, unpacked = quoted + header + content, header + unpacked
    content = content[len(quoted) :]
    entries = [(*entry[:4], len(content) + entry[4]) for entry in reversed(entries)]
    (folder / "overlap.zip").write_bytes(content + directory(entries, len(content)))
    return ["smooth", folder / "overlap.zip", "--out", "OUT/s"], 1000 * MB


def million(folder):
    """10⁶ members in the directory, more than its end record can state."""
    header, path = local(b"a.csv", 0, 0, 0), folder / "million.zip"
    record = directory([(b"a.csv", 0, 0, 0, 0)], 0)[:-22]
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 65_535, 65_535, 1_000_000 * len(record), len(header), 0)
    path.write_bytes(header + 1_000_000 * record + end)
    return path


def lying(stated, real):
    def make(folder):
        path = blown(folder / "lie.zip", real, zipfile.ZIP_DEFLATED)
        with zipfile.ZipFile(path) as archive:
            true = archive.infolist()[0].file_size
        data = path.read_bytes()
        for size in (struct.pack("<Q", true), struct.pack("<L", true)):
            data = data.replace(size, struct.pack("<Q" if len(size) == 8 else "<L", stated))
        path.write_bytes(data)
        return ["smooth", path, "--out", "OUT/s"], max(real, MB)

    return make


def named(name, command=("smooth", "OUT/s")):
    def make(folder):
        path = zipped(folder / "names.zip", [*honest_members(), (name, "0")])
        return [command[0], path, "--out", command[1]], 0

    return make


def linked(folder):
    info = zipfile.ZipInfo("Gyroscope2.csv")
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    path = zipped(folder / "link.zip", [*honest_members(), (info, "/etc/passwd")])
    return ["smooth", path, "--out", "OUT/s"], 0


def device(folder):
    """A folder with a link to a device without end, and a pipe into which nobody writes."""
    path = walk(folder)
    (path / "Gyroscope.csv").unlink()
    (path / "Gyroscope.csv").symlink_to("/dev/zero")
    os.mkfifo(path / "Light.csv")
    return ["smooth", path, "--out", "OUT/s"], 0


def pipe(folder):
    os.mkfifo(folder / "pipe.csv")
    return ["smooth", folder / "pipe.csv", "--out", "OUT/s"], 0


def locked(folder):
    path = zipped(folder / "locked.zip", honest_members())
    data = bytearray(path.read_bytes())
    for sign, flag in ((b"PK\x01\x02", 8), (b"PK\x03\x04", 6)):
        at = data.find(sign)
        while at >= 0:
            data[at + flag] |= 1
            at = data.find(sign, at + 4)
    path.write_bytes(data)
    return ["smooth", path, "--out", "OUT/s"], 0


def other_doors(path):
    return {
        "lifelog add": ["lifelog", "add", "OUT/d.db", path],
        "lifelog import": ["lifelog", "import", "OUT/d.db", path],
        "map check": ["map", "check", path],
        "map convert": ["map", "convert", path, "--out", "OUT/plan.geojson"],
        "evaluate": ["evaluate", path, path],
        "smooth --fixes": ["smooth", None, "--fixes", path, "--out", "OUT/s"],
    }


def at_door(door, bomb_of):
    def make(folder):
        arguments = other_doors(bomb_of(folder))[door]
        return [walk(folder) if a is None else a for a in arguments], 1000 * MB

    return make


def big(folder):
    return blown(folder / "bomb.zip", 1100 * MB, zipfile.ZIP_DEFLATED)


def timeline_bomb(folder):
    """An import reads up to 20 GB, but no element of more than 64 MB."""
    path = folder / "takeout.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("Records.json", "w") as member:
        member.write(b'{"locations": [{"latitudeE7": 1, "x": "')
        for _ in range(1000):
            member.write(b"a" * MB)
    return path


ARCHIVES = (
    Attack("zip, 2 GB of zeros, deflate", bomb(zipfile.ZIP_DEFLATED, 2000 * MB)),
    Attack("zip, 200 MB of zeros, bzip2", bomb(zipfile.ZIP_BZIP2, 200 * MB)),
    Attack("zip, 200 MB of zeros, LZMA", bomb(zipfile.ZIP_LZMA, 200 * MB)),
    Attack("zip in zip, 8 deep, 10 wide", nested),
    Attack("zip of overlapping members", overlapping),
    Attack("zip of 10⁶ members", lambda folder: (["smooth", million(folder), "--out", "OUT/s"], 0)),
    Attack("zip, states 10 bytes for 500 MB", lying(10, 500 * MB)),
    Attack("zip, states 3 GB for 1 MB", lying(3_000_000_000, MB)),
    Attack("zip member ../../evil.csv", named("../../evil.csv")),
    Attack("zip member /etc/evil.csv", named("/etc/evil.csv")),
    Attack("zip member C:\\evil.csv", named("C:\\evil.csv")),
    Attack("zip member name of 60 000 letters", named("a" * 60_000 + ".csv"), EITHER),
    Attack("zip member with line breaks and escapes in its name", named("a\n\x1b[31m\r.csv"), EITHER),
    Attack("zip member is a link to /etc/passwd", linked),
    Attack("zip, encrypted", locked, says="without a password"),
    Attack("folder with a link to /dev/zero and a pipe", device, USED),
    Attack("a pipe instead of a file", pipe),
    *(Attack(f"{door}: zip, 1.1 GB of zeros", at_door(door, big)) for door in other_doors(None)),
    *(Attack(f"{door}: zip of 10⁶ members", at_door(door, million)) for door in other_doors(None)),
    Attack("lifelog import: zip, 1 GB in one element", at_door("lifelog import", timeline_bomb)),
)
