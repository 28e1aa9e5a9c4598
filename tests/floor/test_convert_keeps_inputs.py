"""``map convert`` never writes over its input, which may have the name of its result or of its picture."""

import shutil

import pytest
from matplotlib.figure import Figure
from plans import MAPS
from typer.testing import CliRunner

from pdr_graph import InputError
from pdr_graph.apps.cli import app


def convert(*arguments):
    return CliRunner().invoke(app, ["map", "convert", *map(str, arguments)])


@pytest.mark.parametrize("options", [(), ("--out", "arcade.geojson")])
def test_a_plan_is_not_converted_onto_itself(tmp_path, monkeypatch, options):
    monkeypatch.chdir(tmp_path)
    shutil.copy(MAPS / "arcade.geojson", tmp_path)
    result = convert("arcade.geojson", *options)
    assert isinstance(result.exception, InputError)
    assert str(result.exception) == "--out: found arcade.geojson, which is the input, expected another file"
    assert (tmp_path / "arcade.geojson").read_bytes() == (MAPS / "arcade.geojson").read_bytes()


def test_a_picture_is_not_drawn_over(tmp_path, monkeypatch):
    """A room of 20 m by 10 m, 20 pixels a metre."""
    monkeypatch.chdir(tmp_path)
    figure = Figure(figsize=(6, 4), dpi=100)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(-5, 25), ylim=(-5, 15))
    axes.axis("off")
    axes.plot([0, 20, 20, 0, 0], [0, 0, 10, 10, 0], color="black", linewidth=3)
    figure.savefig("scan.png")
    before = (tmp_path / "scan.png").read_bytes()
    assert convert("scan.png", "--scale", 0.05).exit_code == 0
    assert (tmp_path / "scan.png").read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} == {"scan.png", "scan.geojson", "scan-plan.png"}
