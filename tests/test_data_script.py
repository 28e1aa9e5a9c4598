"""scripts/data.py fetches the files of its list, and no others; here from a folder instead of GitHub."""

import hashlib
import importlib.util
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "data.py"


@pytest.fixture
def data(tmp_path, monkeypatch):
    spec = importlib.util.spec_from_file_location("data_script", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    source = tmp_path / "github" / "them" / "walks" / "c0ffee" / "raw one.txt"
    source.parent.mkdir(parents=True)
    source.write_text("a walk")
    row = [hashlib.sha256(b"a walk").hexdigest(), "walks/one.txt", "them/walks", "c0ffee", "raw one.txt"]
    header = ["sha256", "path", "source_repository", "commit", "source_path"]
    (tmp_path / "data.tsv").write_text("\t".join(header) + "\n" + "\t".join(row) + "\n")
    monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(module, "DATA", tmp_path / "data")
    monkeypatch.setattr(module, "ADDRESS", f"file://{tmp_path}/github/{{repository}}/{{commit}}/{{path}}")
    module.source = source
    return module


def ending(data, *folders):
    with pytest.raises(SystemExit) as end:
        data.main(list(folders))
    return end.value.code


def test_files_come_from_their_repository_and_are_not_fetched_again(data):
    assert ending(data, "walks") == 0
    assert (data.DATA / "walks" / "one.txt").read_text() == "a walk"
    data.source.unlink()
    assert ending(data) == 0
    assert "no folder nowhere" in ending(data, "nowhere")


def test_another_file_than_the_list_states_is_named_and_not_kept_or_left_alone(data):
    """Not kept if it comes so, left alone if it was changed here."""
    data.source.write_text("another walk")
    assert "another file than the list states" in ending(data)
    assert list(data.DATA.rglob("*")) == []
    data.source.write_text("a walk")
    assert ending(data) == 0
    (data.DATA / "walks" / "one.txt").write_text("edited")
    assert "another file" in ending(data)
    assert (data.DATA / "walks" / "one.txt").read_text() == "edited"
