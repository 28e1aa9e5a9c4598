"""The `repr` of plans and of the data types of a lifelog is one short line."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from made_days import MIDNIGHT, overview_of

from pdr_graph.apps.lifelog.day import Day, Outing, Segment, Stay
from pdr_graph.apps.lifelog.maps import panels
from pdr_graph.apps.lifelog.observation import Ends, Observation
from pdr_graph.apps.lifelog.privacy import HiddenRows, private_places
from pdr_graph.apps.lifelog.sessions import Session
from pdr_graph.apps.lifelog.stays import VisiblePlaces
from pdr_graph.apps.lifelog.store import Entry, RecordingOptions, StoredDay
from pdr_graph.apps.lifelog.timeline import timeline
from pdr_graph.floor.building import FloorSequence
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import Frame, enu
from pdr_graph.types import Fixes, Headings, Trajectory

MAPS = Path(__file__).parents[2] / "maps"


def test_plans_have_a_repr_of_one_line():
    building = Building.load(MAPS / "two_floors.geojson")
    assert repr(building) == "Building(2 floors, '1', '2')"
    assert repr(building["1"]).startswith("FloorPlan('1', ")
    for value in (building["1"], *building.connections, FloorSequence.of(building, ["1", "2"])):
        assert "\n" not in repr(value)
        assert len(repr(value)) < 120


def test_the_data_types_of_a_lifelog_have_a_repr_of_one_line():
    track = Trajectory(np.arange(3.0), np.zeros((3, 2)), np.zeros(3), ("", "", ""))
    stay = Stay(1.0, 9.0, False, np.zeros(2), np.eye(2), np.nan, "", (("Books", 0.7),))
    segment = Segment("walking", 0.0, 2.0, 3.0)
    outing = Outing(("a",), "walk.txt", 0.0, Frame(), "", track, (segment,), (stay,), 3)
    observation = Observation("walk.txt", 0.0, 9.0, Frame(), "", "", None, np.zeros(9), Headings.none(), Fixes.none())
    day = Day("me", "2024-05-01", (outing,))
    assert repr(day) == "Day('me', 2024-05-01, 1 outing)"
    assert repr(stay) == "Stay(1.0 to 9.0 s, x 0.0 m, y 0.0 m, 'Books' 70%)"
    assert repr(segment) == "Segment(walking, 0.0 to 2.0 s, 3 m)"
    session = Session((("a", observation),))
    entry = Entry("a" * 64, "me", "walk.txt", RecordingOptions(floor="1"), duration=9.0)
    assert repr(session) == "Session(1 recording, 9.0 s)"
    assert repr(entry) == "Entry('me', walk.txt, floor, 9.0 s)"
    assert repr(StoredDay("a" * 64, ("b" * 64,), None)) == "StoredDay(aaaaaaaa, 1 recording)"
    [entry] = timeline(day)[:1]
    [place] = private_places(["48.1,11.6,50"], [], b"secret")
    assert repr(place) == "PrivatePlace('48.1,11.6,50', radius 50 m)"
    hidden = HiddenRows(np.zeros((3, 2)), np.ones(3, bool), np.zeros(3, bool), np.zeros(2, bool))
    drawn = panels(overview_of(replace(day, outings=(replace(outing, frame=enu(48.1, 11.6), epoch=MIDNIGHT),))))
    places = VisiblePlaces.of(Building.load(MAPS / "mall.geojson").floors[0])
    for value in (outing, observation, Ends(np.zeros((2, 2)), np.zeros(2)), entry, hidden, *drawn, places):
        assert "\n" not in repr(value)
        assert len(repr(value)) < 120
