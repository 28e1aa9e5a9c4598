"""OpenStreetMap's Simple Indoor Tagging: the same building from .osm XML and from the GeoJSON of osmtogeojson."""

import json
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest
import shapely
from refusals import refused

from pdr_graph.floor.check import problems
from pdr_graph.floor.formats.osm_indoor import levels_of
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import enu

FRAME = enu(45.0, 5.0)


box = shapely.box


def mall():
    """Level 0 with a corridor and three shops, level 1 with a corridor; stairs and a lift; doors are nodes."""
    return [
        (box(0, 4, 20, 6), {"indoor": "corridor", "level": "0"}),
        (box(0, 4, 20, 6), {"indoor": "corridor", "level": "1"}),
        (box(0, 0, 10, 4), {"indoor": "room", "level": "0", "name": "Books", "shop": "books"}),
        (box(10, 0, 20, 4), {"indoor": "room", "level": "0", "name": "Shoes"}),
        (box(6, 6, 20, 10), {"indoor": "room", "level": "0-1", "name": "Cinema"}),
        (box(0, 6, 3, 10), {"indoor": "room", "room": "stairs", "level": "0;1"}),
        (box(3, 6, 5, 8), {"indoor": "room", "elevator": "yes", "level": "0;1"}),
        (shapely.Point(4, 4), {"door": "yes", "level": "0"}),
        (shapely.Point(4, 6), {"door": "sliding"}),
        (shapely.Point(10, 6), {"door": "no", "level": "0;1"}),
        (shapely.Point(20, 5), {"entrance": "main", "door": "yes", "level": "0"}),
        (shapely.LineString([(5, 8), (5, 10)]), {"indoor": "wall", "level": "0"}),
        (shapely.Point(50, 50), {"amenity": "bench"}),
    ]


def as_geojson(path, elements, nested=False):
    features = []
    for n, (shape, tags) in enumerate(elements):
        lonlat = shapely.transform(shape, FRAME.to_lonlat)
        properties = {"id": f"way/{n}", "tags": tags} if nested else {**tags, "id": f"way/{n}"}
        geometry = json.loads(shapely.to_geojson(lonlat))
        features.append({"type": "Feature", "id": f"way/{n}", "properties": properties, "geometry": geometry})
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


class Xml:
    """Elements as a document of JOSM; nodes of equal place are one."""

    def __init__(self, elements):
        self.nodes, self.node_tags, self.ways, self.relations = {}, {}, [], []
        for shape, tags in elements:
            if shape.geom_type == "Point":
                self.node_tags[self.node(shape.coords[0])] = tags
            elif shape.geom_type == "Polygon" and shape.interiors:
                rings = [("outer", shape.exterior), *(("inner", ring) for ring in shape.interiors)]
                members = [(role, part) for role, ring in rings for part in self.halves(ring)]
                self.relations.append((members, {"type": "multipolygon", **tags}))
            else:
                self.way((shape.exterior if shape.geom_type == "Polygon" else shape).coords, tags)

    def node(self, place):
        return self.nodes.setdefault(tuple(round(c, 6) for c in place), -1 - len(self.nodes))

    def way(self, corners, tags):
        self.ways.append(([self.node(c) for c in corners], tags))
        return -len(self.ways)

    def halves(self, ring):
        corners = list(ring.coords)
        return [self.way(corners[:3], {}), self.way(corners[2:], {})]

    def text(self):
        lines = ["<?xml version='1.0' encoding='UTF-8'?>", "<osm version='0.6' generator='JOSM'>"]
        for place, number in self.nodes.items():
            lon, lat = FRAME.to_lonlat(np.array([place]))[0]
            tags = self.tags(self.node_tags.get(number, {}))
            lines.append(f"<node id='{number}' lat='{lat:.9f}' lon='{lon:.9f}'>{tags}</node>")
        for n, (refs, tags) in enumerate(self.ways):
            nds = "".join(f"<nd ref='{ref}'/>" for ref in refs)
            lines.append(f"<way id='{-1 - n}'>{nds}{self.tags(tags)}</way>")
        for n, (members, tags) in enumerate(self.relations):
            refs = "".join(f"<member type='way' ref='{ref}' role='{role}'/>" for role, ref in members)
            lines.append(f"<relation id='{-1 - n}'>{refs}{self.tags(tags)}</relation>")
        return "\n".join([*lines, "</osm>"])

    @staticmethod
    def tags(tags):
        return "".join(f"<tag k={quoteattr(k)} v={quoteattr(v)}/>" for k, v in tags.items())


def as_xml(path, elements):
    path.write_text(Xml(elements).text())
    return path


def loaded(tmp_path, *more, without=()):
    elements = [element for n, element in enumerate(mall()) if n not in without]
    return Building.load(as_geojson(tmp_path / "mall.geojson", [*elements, *more]))


def at(building, *places):
    """Positions in the building's frame [m]."""
    return building.floors[0].frame.from_lonlat(FRAME.to_lonlat(np.array(places, float)))


def crosses(building, label, *places):
    start, end = at(building, *places)
    return bool(building[label].crosses_wall(start[None], end[None])[0])


def same(one, other):
    assert one.labels == other.labels
    for a, b in zip(one.floors, other.floors, strict=True):
        assert sorted((x.kind, x.name) for x in a.areas) == sorted((x.kind, x.name) for x in b.areas)
        lines = [shapely.transform(b.walkable, lambda p: a.frame.from_frame(b.frame, p)), a.walkable]  # noqa: B023
        assert shapely.area(shapely.symmetric_difference(*lines)) < 0.5
    assert sorted((c.kind, c.floors) for c in one.connections) == sorted((c.kind, c.floors) for c in other.connections)


def test_rooms_corridors_stairs_and_lifts_have_their_levels(tmp_path):
    building = loaded(tmp_path)
    assert building.labels == ("0", "1")
    rooms = [("room", name) for name in ("Books", "Shoes", "Cinema")]
    assert [(a.kind, a.name) for a in building["0"].areas if a.name] == rooms
    assert [a.name for a in building["1"].of_kind("room")] == ["Cinema"]
    assert [(c.kind, c.floors) for c in building.connections] == [("stairs", (0, 1)), ("lift", (0, 1))]
    assert "1 feature without indoor tags were left out" in building.floors[0].notes
    assert problems(building) == (), "the entrance is no door to nowhere"
    building = loaded(tmp_path, (shapely.Point(0, 2), {"door": "yes", "level": "0"}))
    assert "doors that join fewer than two" in "".join(problems(building)), "another door is"
    building = loaded(tmp_path, (box(0, 0, 20, 10), {"indoor": "level", "min_level": "0", "max_level": "1"}))
    assert [len(floor.of_kind("floor")) for floor in building.floors] == [1, 1], "an outline has both levels"
    assert problems(building) == ()


def test_the_xml_and_both_forms_of_geojson_give_the_same_building_in_any_order(tmp_path):
    flat = loaded(tmp_path)
    same(flat, Building.load(as_xml(tmp_path / "mall.osm", mall()[::-1])))
    same(flat, Building.load(as_geojson(tmp_path / "nested.geojson", mall(), nested=True)))


DOORS = {
    "a door node opens the wall that it lies on": ("0", (4, 5), (4, 3), False),
    "the wall beside the door stands": ("0", (6, 5), (6, 3), True),
    "shops are closed to each other": ("0", (9, 2), (11, 2), True),
    "a door without a level is on the lower level of its walls": ("0", (4, 5), (4, 7), False),
    "and on the upper one": ("1", (4, 5), (4, 7), False),
    "a room without a door is open along its corridor": ("0", (15, 5), (15, 3), False),
    "but not through the outer wall": ("0", (15, 3), (15, -1), True),
    "a shop that touches no corridor stays closed to its neighbours": ("0", (5, 1), (5, -1), True),
}


@pytest.mark.parametrize("claim", DOORS)
def test_doors_open_walls(tmp_path, claim):
    level, start, end, wall = DOORS[claim]
    kiosk = (box(0, -5, 10, 0), {"indoor": "room", "level": "0", "name": "Kiosk"})
    assert crosses(loaded(tmp_path, kiosk), level, start, end) == wall


@pytest.mark.parametrize(
    ("text", "levels"),
    [
        ("0", (0,)),
        ("-1;0", (-1, 0)),
        ("0;1;0", (0, 1)),
        ("0-3", (0, 1, 2, 3)),
        ("-2--1", (-2, -1)),
        ("-1-1", (-1, 0, 1)),
        ("0.5", (0.5,)),
        (" 1 ; 2 ", (1, 2)),
        ("1,2", (1, 2)),
        (3, (3,)),
    ],
)
def test_levels_are_lists_and_ranges(text, levels):
    assert levels_of(text) == levels


@pytest.mark.parametrize("text", ["", "ground", "3-1", "1e9", "0-99999", "999", "0;;1", "nan", None, ["0"]])
def test_other_levels_raise(text):
    with pytest.raises(ValueError, match="level"):
        levels_of(text)


HALL = box(20, 4, 25, 6)


HOTEL = (box(-1, -1, 30, 10), {"building": "hotel", "non_existent_levels": "2-11;13"})
LEVELS = {
    "half a level is half a storey high": ({"level": "0.5"}, {"0": 0, "0.5": 1.9, "1": 3.8}),
    "a feature is repeated": ({"level": "0", "repeat_on": "14-15"}, {"0": 0, "1": 3.8, "14": 11.4, "15": 15.2}),
    "some levels of a hotel do not exist": ({"level": "12-14"}, {"0": 0, "1": 3.8, "12": 7.6, "14": 11.4}),
}


@pytest.mark.parametrize("claim", LEVELS)
def test_levels_are_floors(tmp_path, claim):
    tags, heights = LEVELS[claim]
    building = loaded(tmp_path, (HALL, {"indoor": "corridor"} | tags), HOTEL)
    assert building.labels == tuple(heights)
    assert building.heights == pytest.approx([*heights.values()])


def test_steps_drawn_as_a_line_and_lifts_drawn_as_a_point_have_an_area(tmp_path):
    building = loaded(
        tmp_path,
        (shapely.LineString([(17, 5), (19, 5)]), {"highway": "steps", "level": "0;1"}),
        (shapely.Point(15, 5), {"highway": "elevator", "level": "0;1"}),
    )
    assert sorted(c.kind for c in building.connections) == ["lift", "lift", "stairs", "stairs"]
    added = [c.polygon for c in building.connections[2:]]
    assert sorted(map(shapely.area, added)) == pytest.approx([1.6**2, 2 * 1.5], rel=0.01)
    assert problems(building) == (), "both are open to the corridor around them"


def test_steps_within_stairs_and_a_lift_in_its_cabin_are_one(tmp_path):
    """The polygons are on one level only; the line and the point say which levels they join."""
    elements = mall()
    elements[5] = (box(0, 6, 3, 10), {"indoor": "room", "stairs": "yes", "level": "0"})
    elements[6] = (box(3, 6, 5, 8), {"indoor": "room", "level": "0"})
    elements += [
        (shapely.LineString([(1, 7), (1, 9)]), {"highway": "steps", "level": "0;1"}),
        (shapely.Point(4, 7), {"highway": "elevator", "level": "0;1"}),
    ]
    building = Building.load(as_geojson(tmp_path / "mall.geojson", elements))
    assert [(c.kind, c.floors) for c in building.connections] == [("stairs", (0, 1)), ("lift", (0, 1))]
    areas = [shapely.area(c.polygon) for c in building.connections]
    assert areas == pytest.approx([12, 4], rel=0.01)
    assert len(building["0"].of_kind("room")) == 3


def test_a_multipolygon_has_holes(tmp_path):
    """A corridor around a courtyard, whose rings are two ways each."""
    ring = box(0, -20, 20, -5) - box(5, -15, 15, -10)
    element = (ring, {"indoor": "corridor", "level": "0"})
    building = Building.load(as_xml(tmp_path / "court.osm", [*mall(), element]))
    same(loaded(tmp_path, element), building)
    assert crosses(building, "0", (2, -12), (10, -12))
    assert not crosses(building, "0", (2, -12), (2, -18))


def test_rooms_drawn_inside_a_corridor_are_cut_out_of_it(tmp_path):
    building = loaded(tmp_path, (box(0, 0, 20, 10), {"indoor": "area", "level": "0"}), without=(0,))
    [hall] = building["0"].of_kind("corridor")
    assert shapely.area(hall.shape) == pytest.approx(40 + 4 + 4, rel=0.01), "the corridor, and what lies by the lift"


def test_a_wall_around_rooms_is_its_line_and_a_thick_wall_is_solid(tmp_path):
    around = (box(0, 0, 20, 10), {"indoor": "wall", "level": "0"})
    pillar = (box(9, 4.5, 10, 5.5), {"indoor": "wall", "level": "0"})
    building = loaded(tmp_path, around, pillar)
    assert crosses(building, "0", (8, 5), (12, 5)), "the pillar"
    assert not crosses(building, "0", (12, 5), (15, 5))


@pytest.mark.parametrize(
    ("tags", "halls", "note"),
    [
        ({}, 2, "1 feature without a level: taken as level 0"),
        ({"level": "ground"}, 1, "1 feature with an unreadable level 'ground' left out"),
    ],
)
def test_features_without_a_readable_level_are_noted(tmp_path, tags, halls, note):
    building = loaded(tmp_path, (HALL, {"indoor": "corridor", **tags}))
    assert note in building.floors[0].notes
    assert len(building["0"].of_kind("corridor")) == halls


def test_elements_that_an_editor_has_deleted_are_left_out(tmp_path):
    text = Xml(mall()).text().replace("<way id='-3'>", "<way id='-3' action='delete'>")
    (tmp_path / "mall.osm").write_text(text)
    assert [a.name for a in Building.load(tmp_path / "mall.osm")["0"].of_kind("room")] == ["Shoes", "Cinema"]


ENTITIES = "<!DOCTYPE osm [<!ENTITY a 'ha'><!ENTITY b '&a;&a;&a;&a;&a;&a;&a;&a;'><!ENTITY c '&b;&b;&b;&b;'>]>"
OUTSIDE = "<!DOCTYPE osm [<!ENTITY a SYSTEM 'file:///etc/passwd'>]>"


@pytest.mark.parametrize("begin", [ENTITIES, OUTSIDE, "<!DOCTYPE osm SYSTEM 'http://localhost:1/osm.dtd'>"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_document_types_and_entities_are_refused(tmp_path, begin, encoding):
    text = Xml(mall()).text().replace("<osm ", begin + "<osm ", 1).replace("Books", "&a;").replace("UTF-8", encoding)
    (tmp_path / "mall.osm").write_bytes(text.encode(encoding))
    refused(Building.load, tmp_path / "mall.osm", "a document type definition")


WHOLE = Xml(mall()).text()


BROKEN = {
    "cut": (WHOLE[:-200], "broken XML"),
    "deep": ("<osm version='0.6'>" + "<way>" * 300 + "</way>" * 300 + "</osm>", "broken XML"),
    "no latitude": (WHOLE.replace("lat='45", "lat='145"), "lat and lon in degrees"),
    "no number": (WHOLE.replace("lat='45", "lat='x45"), "lat and lon in degrees"),
    "empty": ("<osm></osm>", "no room, corridor or area"),
    "no OpenStreetMap": ("<gpx><!-- <osm --></gpx>", "an element 'gpx'"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_xml_is_refused(tmp_path, name):
    text, message = BROKEN[name]
    (tmp_path / "mall.osm").write_text(text)
    refused(Building.load, tmp_path / "mall.osm", message)


def test_ways_without_their_nodes_are_noted(tmp_path):
    text = WHOLE.replace("<nd ref='-1'/>", "<nd ref='99'/>").replace("<nd ref='-2'/>", "")
    (tmp_path / "mall.osm").write_text(text.replace("<way id='-1'>", "<way id='-1'>" + "<nd ref='98'/>" * 3))
    notes = " ".join(Building.load(tmp_path / "mall.osm").floors[0].notes)
    assert "2 rooms without an area left out" in notes


def test_a_million_levels_and_no_rooms_at_all_are_refused(tmp_path):
    tags = {"indoor": "room", "level": "0-100", "repeat_on": "-99-0"}  # on 200 levels each
    tower = as_geojson(tmp_path / "tower.geojson", [(box(n, 0, n + 1, 1), tags) for n in range(600)])
    refused(Building.load, tower, "features on too many levels")
    nothing = as_geojson(tmp_path / "nothing.geojson", [(box(0, 0, 1, 1), {"indoor": "level"})])
    refused(Building.load, nothing, "no room, corridor")
