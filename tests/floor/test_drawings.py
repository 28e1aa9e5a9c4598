"""Drawings and pictures of a building of known geometry give its walkable area, rooms and doors."""

import struct
import sys
import zlib
from pathlib import Path

import drawn_plans as drawn
import numpy as np
import pytest
import shapely
from plans import MAPS
from refusals import refused

from pdr_graph import InputError
from pdr_graph.floor import plan_files
from pdr_graph.floor.cells import DOOR
from pdr_graph.floor.check import problems
from pdr_graph.floor.formats.line_drawing import UNCLEAR, Lines, areas_of, drawing_of_lines
from pdr_graph.floor.plan_files import Building

pytest.importorskip("ezdxf")
pytest.importorskip("skimage")
pytest.importorskip("pypdfium2")


def notes_of(path, scale=None):
    return " ".join(Building.load(path, scale).floors[0].notes)


@pytest.fixture
def lines(tmp_path):
    path = tmp_path / "lines.csv"
    path.write_text(drawn.csv(drawn.segments(drawn.walls()), 0.5))
    return path


# From files to areas


def test_lines_without_an_outline_give_the_walkable_area(lines):
    plan = Building.load(lines, 0.5).floors[0]
    assert drawn.agreement(plan.walkable) > 0.98
    assert problems(Building.of(plan)) == ()
    assert not plan.frame.georeferenced
    assert "gaps of up to 1 m closed" in " ".join(plan.notes)


@pytest.mark.parametrize("delimiter", ["", ";", "\t"])
def test_a_table_of_segments_has_other_delimiters_or_no_header(lines, delimiter):
    text = lines.read_text()
    lines.write_text(text.replace(",", delimiter) if delimiter else text.split("\n", 1)[1])
    assert drawn.agreement(Building.load(lines, 0.5).floors[0].walkable) > 0.98


@pytest.mark.parametrize("layer", ["A-WALL", "Wände", "MURS"])
def test_doors_on_a_layer_of_doors_join_rooms_and_corridor(tmp_path, layer):
    drawn.dxf(tmp_path / "plan.dxf", layer=layer)
    plan = Building.load(tmp_path / "plan.dxf").floors[0]
    assert len(plan.of_kind("room")) == 2 * drawn.ROOMS
    assert len(plan.of_kind(DOOR)) == 2 * drawn.ROOMS
    assert drawn.agreement(plan.walkable) > 0.98
    assert problems(Building.of(plan)) == ()
    assert "16 TEXT" in " ".join(plan.notes)


def test_doors_are_recognised_by_their_swing_where_layers_say_nothing(tmp_path):
    drawn.dxf(tmp_path / "plan.dxf", layer="0", door_layer="0", texts=False)
    plan = Building.load(tmp_path / "plan.dxf").floors[0]
    openings = shapely.union_all(drawn.openings())
    assert len(plan.of_kind(DOOR)) == 2 * drawn.ROOMS
    assert all(shapely.distance(door.shape, openings) < 0.05 for door in plan.of_kind(DOOR))
    assert all(0.85 < shapely.length(door.shape) < 0.95 for door in plan.of_kind(DOOR))
    assert problems(Building.of(plan)) == ()


@pytest.mark.parametrize(("units", "metres"), [(1, 0.0254), (4, 0.001), (5, 0.01), (6, 1.0)])
def test_the_unit_of_a_dxf_drawing_is_read(tmp_path, units, metres):
    drawn.dxf(tmp_path / "plan.dxf", scale=metres, units=units)
    assert drawn.agreement(Building.load(tmp_path / "plan.dxf").floors[0].walkable) > 0.98


def test_a_stated_scale_overrides_a_wrong_unit_of_a_dxf_drawing(tmp_path):
    drawn.dxf(tmp_path / "plan.dxf", scale=0.001, units=6)
    with pytest.raises(InputError, match=r"1000 times too large: millimetres\? --scale 0.001"):
        Building.load(tmp_path / "plan.dxf")
    assert "not $INSUNITS" in notes_of(tmp_path / "plan.dxf", 0.001)


@pytest.mark.parametrize(
    ("thick", "skew"),
    [
        (False, -7.5),
        *(pytest.param(*other, marks=pytest.mark.thorough) for other in ((True, 0), (False, 0), (True, 3))),
    ],
)
def test_a_skewed_scan_with_a_gap_of_a_pixel_gives_the_walkable_area(tmp_path, skew, thick):
    path = tmp_path / "scan.png"
    drawn.picture(skew=skew, thick=thick, gap=True).save(path)
    drawing = plan_files.read(path, 0.02)
    affine = np.array(drawing.affine).reshape(2, 3)

    def place(points):
        return drawn.on_picture(points, skew=skew) @ affine[:, :2].T + affine[:, 2]

    plan = Building.load(path, 0.02).floors[0]
    assert drawn.agreement(plan.walkable, place) > 0.96
    assert problems(Building.of(plan)) == ()
    assert (f"skew of {abs(skew):.1f}°" in " ".join(plan.notes)) == bool(skew)


def test_a_jpeg_of_bright_lines_on_a_dark_ground_is_read(tmp_path):
    from PIL import ImageOps

    ImageOps.invert(drawn.picture()).save(tmp_path / "dark.jpg", quality=60)
    assert Building.load(tmp_path / "dark.jpg", 0.02).floors[0].walkable_area == pytest.approx(
        shapely.area(drawn.free()), rel=0.03
    )


@pytest.mark.parametrize("negate", [0, 1])
@pytest.mark.parametrize("origin", [(-3.0, -2.0, 0.0), (10.0, 5.0, 0.6)])
def test_a_ros_map_lies_where_its_origin_and_yaw_say(tmp_path, origin, negate):
    path = drawn.occupancy(tmp_path, origin=origin, negate=negate)
    if negate:
        from PIL import Image, ImageOps

        ImageOps.invert(Image.open(tmp_path / "map.pgm")).save(tmp_path / "map.pgm")
    cos, sin = np.cos(origin[2]), np.sin(origin[2])
    turn = np.array([[cos, -sin], [sin, cos]])
    plan = Building.load(path).floors[0]
    assert drawn.agreement(plan.walkable, lambda p: (p + 1.0) @ turn.T + origin[:2]) > 0.95
    assert len(plan_files.files_of(path)) == 2, "the fingerprint covers the picture"


def test_vector_lines_of_a_pdf_page_are_read_without_its_frame(tmp_path):
    drawn.pdf(tmp_path / "plan.pdf")
    plan = Building.load(tmp_path / "plan.pdf", 0.0353).floors[0]
    assert drawn.agreement(plan.walkable, lambda p: p + 2) > 0.98
    assert "a frame around the drawing was left out" in plan.notes


def test_a_pdf_page_with_a_picture_is_traced(tmp_path):
    drawn.picture(texts=False).save(tmp_path / "scan.pdf", resolution=72)  # a point is a pixel
    plan = Building.load(tmp_path / "scan.pdf", 0.02).floors[0]
    assert drawn.agreement(plan.walkable, lambda p: p + 0.8) > 0.96
    assert "its picture was traced" in " ".join(plan.notes)


# Walls, doors and rooms among bare lines


def room_beside_corridor(between):
    """A corridor below a room, walls of 0.2 m drawn as two lines, and segments in the opening from x = 4 to 5."""
    solid = shapely.box(-0.2, -0.2, 10.2, 7.4) - shapely.box(0, 0, 10, 3) - shapely.box(0, 3.2, 10, 7.2)
    return np.concatenate([drawn.segments(solid - shapely.box(4, 2.9, 5, 3.3)), *between])


def test_a_line_between_two_jambs_is_a_closed_door():
    leaf = np.array([[[4.0, 3.1], [5.0, 3.1]]])
    areas, _ = areas_of(Lines(room_beside_corridor([leaf])), [])
    (door,) = [area for area in areas if area.kind == DOOR]
    assert shapely.equals(door.shape, shapely.LineString(leaf[0]))


def test_a_wall_across_the_opening_stays_a_wall_and_the_check_names_the_room(tmp_path):
    closed = np.array([[[4.0, 3.0], [5.0, 3.0]], [[4.0, 3.2], [5.0, 3.2]]])
    (tmp_path / "a.csv").write_text(drawn.csv(room_beside_corridor([closed])))
    building = Building.load(tmp_path / "a.csv", 1.0)
    assert building.floors[0].of_kind(DOOR) == ()
    assert any("cannot be reached" in line for line in problems(building))


def test_treads_are_stairs_and_no_walls():
    treads = np.array([[[7.0, y], [8.6, y]] for y in np.arange(0.4, 2.3, 0.28)])
    segments = room_beside_corridor([treads])
    drawing = drawing_of_lines(Path("plan"), segments, [UNCLEAR] * len(segments), 1.0, None, [])
    (stairs,) = [area for area in drawing.floors[""] if area.kind == "stairs"]
    assert shapely.area(stairs.shape) == pytest.approx(1.6 * 0.28 * (len(treads) - 1), rel=0.01)


def test_small_columns_and_narrow_cavities_are_solid():
    column, cavity = shapely.box(2, 1, 2.8, 1.8), shapely.box(3, 6.1, 9, 7.2)
    areas, _ = areas_of(Lines(room_beside_corridor([drawn.segments(column), drawn.segments(cavity)])), notes := [])
    free = [area.shape for area in areas if area.kind in ("room", "corridor")]
    for solid in (column, cavity):
        assert not shapely.intersects(shapely.union_all(free), solid.centroid)
    assert "2 enclosed spaces without a door were taken as solid" in " ".join(notes)


# Units


def test_a_drawing_without_a_unit_is_refused_with_a_guess(lines, tmp_path):
    guess = r"140 segments, 72 by 28.8 units, unit not stated.*--scale 1 if drawn in metres"
    refused(Building.load, lines, guess)
    drawn.picture(0.05).save(tmp_path / "scan.png")
    refused(Building.load, tmp_path / "scan.png", r"a picture of \d+ by \d+ pixels and no scale, .*--two-points")


@pytest.mark.parametrize("scale", [0.001, 500.0, 0.0, -1.0, float("nan"), float("inf")])
def test_a_scale_that_cannot_be_is_refused(lines, scale):
    with pytest.raises(InputError, match=r"m(etres)? per unit"):
        Building.load(lines, scale)


def test_a_scale_is_refused_where_the_format_states_its_own(tmp_path):
    for path in (MAPS / "arcade.geojson", drawn.occupancy(tmp_path)):
        with pytest.raises(InputError, match="--scale"):
            Building.load(path, 2.0)


# Hostile files


HEADER = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
BILLIONS = struct.pack(">I", 13) + b"IHDR" + HEADER + struct.pack(">I", zlib.crc32(b"IHDR" + HEADER))
HOSTILE = {
    "a.pdf": (b"%PDF-1.7\n" + bytes(range(256)) * 20, "damaged PDF"),
    "a.png": (b"\x89PNG\r\n\x1a\n" + bytes(100), "damaged picture"),
    "billions.png": (b"\x89PNG\r\n\x1a\n" + BILLIONS, "60000 by 60000 pixels|damaged picture"),
    "nan.csv": (b"x1,y1,x2,y2\n0,0,1,nan\n0,0,1,1\n0,0,1,2\n", "line 2.*finite"),
    "short.csv": (b"x1,y1,x2,y2\n0,0,1,1\n0,0,1\n", "line 3.*expected at least 4 fields"),
    "open.csv": (b"x1,y1,x2,y2\n0,0,40,0\n0,20,40,20\n0,40,40,40\n", "enclose no building"),
    "few.csv": (b"x1,y1,x2,y2\n0,0,1,1\n", "1 segment, expected the walls of a floor"),
    "a.dwg": (b"AC1032" + bytes(100), "saved as DXF"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_garbage_is_refused_in_one_line(tmp_path, name):
    content, message = HOSTILE[name]
    (tmp_path / name).write_bytes(content)
    refused(Building.load, tmp_path / name, message, 1.0)


def test_blocks_in_blocks_without_end_are_refused(tmp_path, monkeypatch):
    """Of 10¹¹ insertions those up to the limit are followed, here a lower one."""
    import ezdxf

    from pdr_graph.floor.formats import cad

    assert cad.MOST_BLOCKS <= 100_000, "some seconds"
    monkeypatch.setattr(cad, "MOST_BLOCKS", 2000)
    document = ezdxf.new()
    for n in range(12):
        block = document.blocks.new(f"B{n}")
        for _ in range(10):
            block.add_blockref(f"B{n + 1}", (0, 0)) if n < 11 else block.add_line((0, 0), (1, 1))
    document.modelspace().add_blockref("B0", (0, 0))
    document.saveas(tmp_path / "bomb.dxf")
    refused(Building.load, tmp_path / "bomb.dxf", "too many blocks in blocks, expected at most 2000 insertions")


@pytest.mark.parametrize("far", [float("nan"), float("inf"), 1e13, 1e9])
def test_curves_with_impossible_coordinates_come_to_an_end(tmp_path, far):
    """ezdxf halves a chord until it is near its curve: with NaN, or where rounding is larger than the chord, never."""
    import ezdxf

    document = ezdxf.new()
    space = document.modelspace()
    space.add_lwpolyline([(0, 0), (10_000, 0), (10_000, 8_000), (0, 8_000)], close=True, dxfattribs={"layer": "WALL"})
    space.add_circle((far, 0), 50)
    space.add_spline([(0, 0, 0), (1, far, 0), (5, 5, 0), (8, 8, 0)])
    document.saveas(tmp_path / "plan.dxf")
    if far < 1e10:
        assert Building.load(tmp_path / "plan.dxf", 0.001).floors[0].walkable.area == pytest.approx(80, rel=0.01)
    else:
        refused(Building.load, tmp_path / "plan.dxf", "no numbers or too large", 0.001)


@pytest.mark.parametrize("name", ["../secret.pgm", "/etc/hostname", "missing.pgm", "[1, 2]"])
def test_a_ros_map_reads_no_picture_elsewhere(tmp_path, name):
    folder = tmp_path / "map"
    folder.mkdir()
    (tmp_path / "secret.pgm").write_bytes(b"P5 8 8 255\n" + bytes(64))
    (folder / "map.yaml").write_text(f"image: {name}\nresolution: 0.05\norigin: [0, 0, 0]\n")
    refused(Building.load, folder / "map.yaml", "map.yaml, image")


def test_a_python_object_in_a_ros_map_is_not_made(tmp_path):
    drawn.occupancy(tmp_path)
    with (tmp_path / "map.yaml").open("a") as file:
        file.write(
            f"more: !!python/object/apply:pathlib.Path.touch [!!python/object/apply:pathlib.Path [{tmp_path}/made]]\n"
        )
    refused(Building.load, tmp_path / "map.yaml", "map.yaml")
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("module", ["skimage.measure", "yaml"])
def test_a_ros_map_without_its_libraries_says_what_to_install(tmp_path, monkeypatch, module):
    drawn.occupancy(tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    refused(
        Building.load,
        tmp_path / "map.yaml",
        r"a ROS map and no (scikit-image|PyYAML), expected pip install '\.\[plans\]'",
    )


@pytest.mark.parametrize(
    "origin", ["0", "[0]", "[0, .nan, 0]", "[0, 0, .inf]", "[1" + "0" * 400 + ", 0, 0]", "[a, 0, 0]"]
)
@pytest.mark.parametrize("resolution", ["0.05", "0", "-1", ".nan", "x", "1" + "0" * 400])
def test_numbers_of_a_ros_map_are_checked(tmp_path, origin, resolution):
    drawn.occupancy(tmp_path)
    (tmp_path / "map.yaml").write_text(f"image: map.pgm\nresolution: {resolution}\norigin: {origin}\n")
    refused(Building.load, tmp_path / "map.yaml", "map.yaml")


def test_blocks_that_ezdxf_cannot_place_are_left_out_and_counted(tmp_path, monkeypatch):
    """Of a damaged file: a normal without length, by which ezdxf divides."""
    from ezdxf.entities import Insert

    drawn.dxf(tmp_path / "plan.dxf")
    monkeypatch.setattr(Insert, "virtual_entities", lambda _: (1 / 0 for _ in range(1)))
    assert " blocks that cannot be placed" in notes_of(tmp_path / "plan.dxf")
