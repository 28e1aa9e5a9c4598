"""Recordings are added once, whatever their names and folders; a file that is none costs one line."""

import shutil
import zipfile
from datetime import UTC, datetime
from pathlib import Path

import days_standin as standin
import pytest
import recorders
from plans import MAPS

from pdr_graph import InputError
from pdr_graph.apps.lifelog.ingest import AddResult, add, find_recordings, time_of
from pdr_graph.apps.lifelog.observation import observe
from pdr_graph.apps.lifelog.store import Entry, RecordingOptions, Store


def entries(path):
    with Store(path) as log:
        return {entry.path.rpartition("/")[2]: entry for entry in log.entries()}


def phyphox(folder, **options):
    """Write a recording that is a folder of tables without a date."""
    for name, text in recorders.phyphox(recorders.sample(), **options).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def test_a_recording_is_added_once(tmp_path):
    log, walk = tmp_path / "log", standin.recording(tmp_path / "walk.plt")
    assert add(log, [walk]) == AddResult(added=1)
    assert add(log, [walk]) == AddResult(existing=1)
    other = shutil.copy(walk, tmp_path / "the same.plt")
    assert add(log, [other, walk, other]) == AddResult(existing=2), "a path that is given twice is one"
    [entry] = entries(log).values()
    assert entry == Entry(entry.hash, "me", str(walk))
    standin.recording(walk, seed=1)
    assert add(log, [walk]) == AddResult(added=1), "another content is another recording"


def test_a_moved_recording_gets_its_new_path_when_added_again(tmp_path):
    log, walk = tmp_path / "log", standin.recording(tmp_path / "walk.plt")
    add(log, [walk], person="Ada")
    moved = walk.rename(tmp_path / "moved.plt")
    assert add(log, [moved]) == AddResult(existing=1)
    assert entries(log)["moved.plt"].person == "Ada", "an option that is not given stays"


def test_options_replace_earlier_ones(tmp_path):
    log, walk = tmp_path / "log", standin.recording(tmp_path / "walk.plt")
    toml = tmp_path / "walker.toml"
    toml.write_text("height = 1.6\n")
    assert add(log, [walk], person="Ada") == AddResult(added=1)
    assert add(log, [walk], RecordingOptions(walker=toml, floor="2")) == AddResult(existing=1, changed=1)
    assert add(log, [walk], RecordingOptions(walker=toml)) == AddResult(existing=1)
    assert add(log, [walk], RecordingOptions(begins=1.7e9), person="Grace") == AddResult(existing=1, changed=1)
    [entry] = entries(log).values()
    assert entry == Entry(entry.hash, "Grace", str(walk), RecordingOptions(walker=toml, floor="2", begins=1.7e9))


def test_all_recordings_in_a_folder_are_added(tmp_path):
    folder = tmp_path / "days"
    expected = [standin.recording(folder / "may" / f"{n}.plt", n) for n in range(3)]
    expected += [standin.recording(folder / "june" / "1.plt", 30), phyphox(folder / "experiment")]
    zipped = folder / "july.zip"
    with zipfile.ZipFile(zipped, "w") as archive:
        archive.write(standin.recording(tmp_path / "july.plt", 60), "july.plt")
    (folder / "notes.txt").write_text("It rained.")
    (folder / "loop").symlink_to(folder)
    found, passed, refused = find_recordings([folder])
    assert sorted(found) == sorted([*expected, zipped])
    assert (passed, refused) == (1, [])
    begin = standin.FIRST
    assert add(tmp_path / "log", [folder / "may", folder / "june"]) == AddResult(added=4)
    result = add(tmp_path / "log", [folder])
    assert (result.added, result.existing, result.skipped) == (1, 4, 1)
    assert [line.partition(": ")[2] for line in result.refused] == [
        "found no date, expected a start time: give --begins with a time such as 2024-05-01T09:30:00+02:00"
    ]
    assert add(tmp_path / "log", [folder / "experiment"], RecordingOptions(begins=begin)) == AddResult(added=1)


def test_a_folder_with_one_recording_is_one_recording(tmp_path):
    folder = phyphox(tmp_path / "experiment")
    log = tmp_path / "log"
    assert add(log, [folder], RecordingOptions(begins=1.7e9)) == AddResult(added=1)
    (folder / ".DS_Store").write_text("a window's place")
    copied = shutil.copytree(folder, tmp_path / "elsewhere" / "experiment")
    assert add(log, [copied.parent]) == AddResult(existing=1), "its content is what a reader sees in it"


def test_unreadable_files_do_not_stop_the_others(tmp_path):
    good, torn = standin.recording(tmp_path / "good.plt"), tmp_path / "torn.zip"
    torn.write_bytes(b"PK\x03\x04 and no more")
    other, empty, odd = tmp_path / "letter.txt", tmp_path / "empty", tmp_path / "walk\udcff.plt"
    other.write_text("Dear Ada")
    empty.mkdir()
    shutil.copy(good, odd)
    result = add(tmp_path / "log", [torn, good, other, empty, odd, tmp_path / "none"])
    assert result.added == 1
    assert {line.partition(": ")[2].partition(",")[0] for line in result.refused} > {
        "found 0 files",
        "found a damaged zip (File is not a zip file)",
        "found a text that begins with 'Dear Ada'",
        "found no such file",
    }
    assert all(line.isprintable() for line in result.refused)


def test_a_recording_without_steps_and_positions_is_refused(tmp_path):
    """A gyroscope alone and a single position are refused; fixes beside the gyroscope are accepted."""
    folder, log = phyphox(tmp_path / "experiment"), tmp_path / "log"
    for file in folder.glob("*.csv"):
        if file.name != "Gyroscope.csv":
            file.unlink()
    single = standin.recording(tmp_path / "single.plt")
    single.write_text("".join(single.read_text().splitlines(keepends=True)[:7]))
    message = [add(log, [one], RecordingOptions(begins=1.7e9)).refused for one in (folder, single)]
    assert [line.partition(": ")[2] for (line,) in message] == [
        f"found no acceleration and {n} positions, expected an accelerometer, or at least 2 positions" for n in (0, 1)
    ]
    with pytest.raises(InputError, match="found no acceleration and 0 positions"):
        observe(folder, RecordingOptions(begins=1.7e9))  # as of a lifelog that an older version made
    fixes = tmp_path / "fixes.csv"
    fixes.write_text("time,x,y,sigma\n1,0,0,3\n9,10,0,3\n")
    assert add(log, [folder], RecordingOptions(begins=1.7e9, fixes=fixes)).added == 1


ARCADE = MAPS / "arcade.geojson"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"person": " "}, "--person: found ' ', expected a name"),
        ({"plan": Path("none.geojson")}, "found no such file"),
        ({"walker": Path("none.toml")}, "expected a TOML file"),
        ({"begins": 1.7e9}, "--begins: found 2 recordings, expected a single recording"),
        ({"plan": ARCADE, "floor": "attic"}, "found the floors 1, expected a floor 'attic'"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, dict) else "",
)
def test_an_unusable_option_is_refused(tmp_path, options, message):
    standin.recordings(tmp_path / "days", 1, 2)
    person = options.pop("person", None)
    with pytest.raises(InputError, match=message):
        add(tmp_path / "log", [tmp_path / "days"], RecordingOptions(**options), person=person)
    assert not (tmp_path / "log").exists(), "nothing is made of it"


def test_a_copy_replaces_the_original(tmp_path):
    log, folder = tmp_path / "log", phyphox(tmp_path / "experiment")
    walk = standin.recording(tmp_path / "walk.plt")
    (tmp_path / "BLE_Locations.csv").write_text("beacon,lat,lon\na,52.5,13.4\n")
    add(log, [walk], copy=True)
    add(log, [folder], RecordingOptions(begins=1.7e9), copy=True)
    content, copied = walk.read_bytes(), Path(entries(log)["walk.plt"].path)
    walk.unlink()
    shutil.rmtree(folder)
    assert copied.read_bytes() == content
    assert copied.with_name("BLE_Locations.csv").exists(), "the list of beacons beside it is a part of it"
    back = tmp_path / "back.plt"
    back.write_bytes(content)
    assert add(log, [back]) == AddResult(existing=1)
    assert entries(log)["walk.plt"].path == str(copied), "what is copied stays the copy"
    assert add(log, [copied.parent.parent]) == AddResult(existing=2, skipped=1), (
        "the copies are the recordings that they are of"
    )


def test_times_without_an_offset_are_utc():
    assert time_of("2024-05-01T09:30:00") == datetime(2024, 5, 1, 9, 30, tzinfo=UTC).timestamp()
    assert time_of("2024-05-01T09:30:00+02:00") == datetime(2024, 5, 1, 7, 30, tzinfo=UTC).timestamp()
    with pytest.raises(InputError, match=r"--begins: found yesterday, expected a time such as"):
        time_of("yesterday")
