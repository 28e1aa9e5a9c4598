"""The `repr` of plans and of the data types of a lifelog is one short line."""

import numpy as np
import pytest
from made_days import MIDNIGHT, overview_of
from plans import MAPS

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

BUILDING = Building.load(MAPS / "two_floors.geojson")
TRACK = Trajectory(np.arange(3.0), np.zeros((3, 2)), np.zeros(3), ("", "", ""))
STAY = Stay(1.0, 9.0, False, np.zeros(2), np.eye(2), np.nan, "", (("Books", 0.7),))
SEGMENT = Segment("walking", 0.0, 2.0, 3.0)
OUTING = Outing(("a",), "walk.txt", MIDNIGHT, enu(48.1, 11.6), "", TRACK, (SEGMENT,), (STAY,), 3)
SEEN = Observation("walk.txt", 0.0, 9.0, Frame(), "", "", None, np.zeros(9), Headings.none(), Fixes.none())
DAY = Day("me", "2024-05-01", (OUTING,))


@pytest.mark.parametrize(
    ("record", "expected"),
    [
        (BUILDING, "Building(2 floors, '1', '2')"),
        (BUILDING["1"], "FloorPlan('1', "),
        (BUILDING.connections[0], ""),
        (FloorSequence.of(BUILDING, ["1", "2"]), ""),
        (DAY, "Day('me', 2024-05-01, 1 outing)"),
        (STAY, "Stay(1.0 to 9.0 s, x 0.0 m, y 0.0 m, 'Books' 70%)"),
        (SEGMENT, "Segment(walking, 0.0 to 2.0 s, 3 m)"),
        (Session((("a", SEEN),)), "Session(1 recording, 9.0 s)"),
        (Entry("a" * 64, "me", "walk.txt", RecordingOptions(floor="1"), duration=9.0), "Entry('me', walk.txt, floor, "),
        (StoredDay("a" * 64, ("b" * 64,), None), "StoredDay(aaaaaaaa, 1 recording)"),
        (private_places(["48.1,11.6,50"], [], b"secret")[0], "PrivatePlace('48.1,11.6,50', radius 50 m)"),
        (HiddenRows(np.zeros((3, 2)), np.ones(3, bool), np.zeros(3, bool), np.zeros(2, bool)), ""),
        (panels(overview_of(DAY))[0], ""),
        (VisiblePlaces.of(BUILDING["1"]), ""),
        (timeline(DAY)[0], ""),
        (OUTING, ""),
        (SEEN, ""),
        (Ends(np.zeros((2, 2)), np.zeros(2)), ""),
    ],
    ids=lambda value: type(value).__name__,
)
def test_the_repr_is_one_short_line(record, expected):
    text = repr(record)
    assert text.startswith(expected)
    assert "\n" not in text
    assert len(text) < 120
