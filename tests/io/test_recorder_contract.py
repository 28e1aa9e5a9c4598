"""What holds for the files of every recorder: harmless differences change nothing, and damage is one line."""

import random
import subprocess
import sys
from functools import cache

import pytest
from mutations import small
from recorders import EXPORTS, in_folder, in_zip
from refusals import refused

from pdr_graph import InputError
from pdr_graph.io.loading import load
from pdr_graph.io.signatures import FIX_FORMATS, PLAN_FORMATS, RECORDING_FORMATS, recognized
from pdr_graph.io.source import Source


@cache
def export(name):
    """The file of a recorder and its text, or its files and their texts."""
    file, write = EXPORTS[name]
    return file, write(small())


def written(folder, name, change=lambda text: text):
    """A sample of a recorder, whose tables are changed."""
    file, content = export(name)
    if isinstance(content, str):
        (folder / file).write_text(change(content), newline="")
        return folder / file
    content = {member: change(text) if "meta" not in member.lower() else text for member, text in content.items()}
    return in_zip(folder / file, content) if file.endswith("zip") else in_folder(folder / file, content)


def sizes(path):
    recording = load(path)
    return [*(len(signal) for signal in recording.signals.values()), len(recording.fixes)]


def shuffled(text):
    rows = text.splitlines(keepends=True)
    random.Random(1).shuffle(rows)
    return "".join(rows)


def test_every_signature_has_a_sample_whose_first_match_it_is(tmp_path):
    """But for bags and step counters, which have tests of their own."""
    for name in EXPORTS:
        (tmp_path / name).mkdir()
    known = [recognized(Source(written(tmp_path / name, name)), RECORDING_FORMATS) for name in EXPORTS]
    assert {row.name for row in known if row} == {row.name for row in RECORDING_FORMATS} - {"ROS 2", "step counter"}


def test_a_reader_is_imported_for_its_files_alone(tmp_path):
    path = written(tmp_path, "gpx")
    code = f"import sys; from pdr_graph.io.loading import load; load({str(path)!r}); print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    readers = {f"pdr_graph.{row.reader.partition(':')[0]}" for row in (*RECORDING_FORMATS, *FIX_FORMATS, *PLAN_FORMATS)}
    assert readers & set(modules) == {"pdr_graph.io.gpx"}


HARMLESS = {
    "line ends of Windows": (lambda text: text.replace("\n", "\r\n"), {"past_day"}),  # our own has no editor
    "blank lines at the end": (lambda text: text + "\n\n", set()),
    "a byte-order mark": (lambda text: "\ufeff" + text, set()),
}
DAMAGE = {
    "no bytes": lambda text: "",
    "other bytes": lambda text: "\x00\x01" * 500,
    "words in the place of digits": lambda text: text.replace("0", "zero", 40),
    "shuffled rows": shuffled,
}


@pytest.mark.parametrize("name", EXPORTS)
@pytest.mark.parametrize("difference", HARMLESS)
def test_harmless_differences_change_nothing(tmp_path, name, difference):
    change, strict = HARMLESS[difference]
    whole = sizes(written(tmp_path, name))
    if name in strict:
        refused(load, written(tmp_path, name, change), "found")
    else:
        assert sizes(written(tmp_path, name, change)) == whole


@pytest.mark.parametrize("name", EXPORTS)
@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_refused_in_one_line(tmp_path, name, damage):
    if (name, damage) == ("gpx", "shuffled rows"):
        pytest.skip("it is one line")
    refused(load, written(tmp_path, name, DAMAGE[damage]), "found")


@pytest.mark.parametrize("name", EXPORTS)
def test_the_first_half_of_a_file_is_refused_or_read_as_such(tmp_path, name):
    whole = sum(sizes(written(tmp_path, name)))
    path = written(tmp_path, name, lambda text: text[: len(text) // 2])
    try:
        half = sum(sizes(path))
    except InputError:
        refused(load, path, "found")
    else:
        assert 0 < half < 0.7 * whole
