"""Files are untrusted: sizes in a zip directory are ignored, and no member is read or written outside the archive."""

import gzip
import os
import random
import stat
import struct
import tracemalloc
import zipfile

import pytest
from mutations import mutated
from recorders import in_folder, in_zip, phyphox, sample
from refusals import refused

from pdr_graph import InputError
from pdr_graph.io import source
from pdr_graph.io.loading import load
from pdr_graph.io.source import MAXIMUM_FILES


@pytest.fixture(scope="module")
def files():
    return phyphox(sample())


def test_a_zip_bomb_raises_at_the_limit_of_unpacked_bytes(tmp_path, files, monkeypatch):
    """Three megabytes from three kilobytes; the user can raise the limit."""
    big = files["Accelerometer.csv"] + 3_000_000 * "0"
    path = in_zip(tmp_path / "bomb.zip", files | {"Accelerometer.csv": big})
    monkeypatch.setenv("PDR_GRAPH_MAX_MB", "2")
    refused(load, path, "more than 2 MB.*PDR_GRAPH_MAX_MB")
    monkeypatch.setenv("PDR_GRAPH_MAX_MB", "20")
    assert len(load(in_zip(tmp_path / "walk.zip", files)).accelerometer) > 900
    monkeypatch.setenv("PDR_GRAPH_MAX_MB", "lots")
    with pytest.raises(InputError, match="a number of megabytes"):
        load(path)


@pytest.mark.parametrize("packed", [False, True], ids=["a file", "in a zip"])
def test_what_is_packed_by_gzip_is_read_as_it_is(tmp_path, packed):
    """As sites have it in their exports; one that is cut off, or grows beyond the limit, is refused."""
    table = "time,steps\n" + "".join(f"{n},{2 * n}\n" for n in range(60))
    content = gzip.compress(table.encode())
    path = in_zip(tmp_path / "walk.zip", {"walk.csv.gz": content}) if packed else tmp_path / "walk.csv.gz"
    if not packed:
        path.write_bytes(content)
    assert load(path).step_counter.values[-1, 0] == 118
    broken = tmp_path / "cut.csv.gz"
    broken.write_bytes(content[:-20])
    refused(load, broken, "damaged gzip")
    broken.write_bytes(gzip.compress(b"time,steps\n" + bytes(1_100_000_000)))
    refused(load, broken, "more than 1000 MB")


def test_a_packed_file_beside_its_original_is_another(tmp_path):
    folder = in_folder(tmp_path / "two", {"a.csv": "x", "a.csv.gz": "y"})
    assert source.Source(folder).names == ("a.csv", "a.csv.gz")


ELSEWHERE = ["../Accelerometer.csv", "/etc/Accelerometer.csv", "a/../../b.csv", "C:\\b.csv"]


@pytest.mark.parametrize(
    ("members", "message"),
    [
        *(({name: "1"}, "leads elsewhere") for name in ELSEWHERE),
        ({f"{n}.csv": "" for n in range(MAXIMUM_FILES + 1)}, "more than 1000 files"),
    ],
    ids=[*ELSEWHERE, "thousands"],
)
def test_hostile_members_are_refused(tmp_path, files, members, message):
    refused(load, in_zip(tmp_path / "walk.zip", files | members), message)


def test_links_in_archives_raise(tmp_path, files):
    path = in_zip(tmp_path / "walk.zip", files)
    link = zipfile.ZipInfo("Gravity.csv")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(link, "/etc/passwd")
    refused(load, path, "link that leads elsewhere")


def test_two_members_of_one_name_raise(tmp_path, files):
    path = in_zip(tmp_path / "walk.zip", files)
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(path, "a") as archive:
        archive.writestr("Accelerometer.csv", "other")
    refused(load, path, "two members named")


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b[:40] + bytes(9) + b[49:], lambda b: b[:4]])
def test_damaged_archives_raise(tmp_path, files, damage):
    path = in_zip(tmp_path / "walk.zip", files)
    path.write_bytes(damage(path.read_bytes()))
    refused(load, path, "zip|unpacked")


def test_an_archive_with_a_password_raises(tmp_path, files):
    path = in_zip(tmp_path / "walk.zip", files)
    data = bytearray(path.read_bytes())
    for mark, flag in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = data.find(mark)
        while at >= 0:
            data[at + flag] |= 1
            at = data.find(mark, at + 4)
    path.write_bytes(data)
    refused(load, path, "password")


def test_files_that_operating_systems_add_are_ignored(tmp_path, files):
    """A name ends at its first zero byte; of one that is its first byte."""
    clutter = {"__MACOSX/._Accelerometer.csv": "\x00", ".DS_Store": "x", "Walk/._Gyroscope.csv": "y", "nameless": "x"}
    path = in_zip(tmp_path / "walk.zip", {f"Walk/{n}": t for n, t in files.items()} | clutter)
    path.write_bytes(path.read_bytes().replace(b"nameless", b"\0ameless"))
    walk = load(path)
    assert len(walk.accelerometer) == len(walk.gyroscope) > 900


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_pipes_and_devices_do_not_hang(tmp_path, files):
    refused(load, tmp_path, "an empty folder")
    os.mkfifo(tmp_path / "pipe")
    refused(load, tmp_path / "pipe", "neither a file nor a folder")
    folder = in_folder(tmp_path / "walk", files)
    os.mkfifo(folder / "Gravity.csv")
    assert len(load(folder).accelerometer) > 900


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_methods_that_unpack_without_bound_are_refused(tmp_path, files, method):
    """A block of bzip2 or LZMA unpacks to megabytes from a few bytes, whatever is asked for."""
    path = tmp_path / "walk.zip"
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    refused(load, path, "packed by (bzip2|lzma), expected an archive whose files are stored or deflated")


def test_the_directory_of_a_million_members_is_refused_before_it_is_read(tmp_path, files):
    """zipfile would make an object of each, of a gigabyte together."""
    path = tmp_path / "many.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.csv", "1")
    data, size = path.read_bytes(), 90_000_000
    record = data[data.index(b"PK\x01\x02") : data.index(b"PK\x05\x06")]
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 65_535, 65_535, size, data.index(b"PK\x01\x02"), 0)
    path.write_bytes(data[: data.index(b"PK\x01\x02")] + (record * (size // len(record) + 1))[:size] + end)
    tracemalloc.start()
    refused(load, path, "a directory of 90.0 MB, expected an archive of at most 1000 files")
    assert tracemalloc.get_traced_memory()[1] < 5_000_000
    tracemalloc.stop()


def test_more_lines_than_ten_hours_have_are_refused_before_they_are_split(tmp_path, files, monkeypatch):
    """A row of one digit takes a hundred times its size in memory."""
    path = in_zip(tmp_path / "walk.zip", files)
    monkeypatch.setattr(source, "MOST_LINES", 1000)
    assert len(load(path).accelerometer) > 900
    long = files["Accelerometer.csv"] + 1001 * "1\n"
    refused(
        load, in_zip(tmp_path / "rows.zip", files | {"Accelerometer.csv": long}), r"\d+ lines, expected at most 1000"
    )


@pytest.mark.parametrize("copies", [40, pytest.param(300, marks=pytest.mark.thorough)])
def test_isal_unpacks_what_zlib_does_and_refuses_it_with_the_same_words(tmp_path, files, monkeypatch, copies):
    pytest.importorskip("isal")
    unpack, by_isal = source.Source._inflated, []

    def outcome(path):
        try:
            opened = source.Source(path)
            return {name: opened.content(name) for name in opened.names}
        except InputError as error:
            return str(error)

    def counted(opened, name):
        by_isal.append(unpack(opened, name) is not None)
        return unpack(opened, name)

    path = tmp_path / "walk.zip"
    for n in range(copies):
        path.write_bytes(mutated(files, random.Random(n)))
        monkeypatch.setattr(source.Source, "_inflated", lambda *_: None)
        expected = outcome(path)
        monkeypatch.setattr(source.Source, "_inflated", counted)
        assert outcome(path) == expected
    assert copies / 3 < sum(by_isal) < len(by_isal), "a control: some members are damaged, some are not"


def test_a_link_in_a_folder_that_leads_elsewhere_is_refused(tmp_path):
    """What it leads to would be in results that are passed on; links within the folder are files."""
    secret, folder = tmp_path / "secret", tmp_path / "walk"
    secret.write_text("private")
    folder.mkdir()
    (folder / "a.csv").write_text("1")
    (folder / "b.csv").symlink_to("a.csv")
    (tmp_path / "link").symlink_to(folder)
    assert source.Source(folder).names == source.Source(tmp_path / "link").names == ("a.csv", "b.csv")
    (folder / "notes.txt").symlink_to(secret)
    refused(source.Source, folder, "a link that leads elsewhere, 'notes.txt'")
