"""Days that others recorded, of GPS alone and beside steps."""

from datetime import UTC, datetime

import numpy as np
import pytest
from cleaned_track import cleaned_length, raw_length

from pdr_graph import Walker, detect_steps
from pdr_graph.apps.lifelog.day import GAP, VEHICLE, WALKING
from pdr_graph.apps.lifelog.stays import detect_rides, follow_positions
from pdr_graph.walk import read

DAYS = ("geolife_sample/000", "geolife_sample/001", "geolife_sample/005", "geolife_sample/010", "gpx_sample")
WALKS = ("nju_phyphox_outdoor", *(f"ipin2023_track3/*{name}*.txt" for name in ("Trial01", "Trial24", "Trial52")))
FASTEST_WALK = 2.2  # [m/s] in the mean of a segment: between walking fast and cycling slowly


def day(data, folder):
    (path,) = [p for p in (data / folder).iterdir() if p.suffix in (".plt", ".gpx")]
    fixes = read(path).fixes
    return fixes, follow_positions(fixes)[1]


@pytest.mark.parametrize("folder", DAYS)
def test_no_kilometres_are_invented(data, folder):
    """Within 3 % of a cleaning by published recipes; the raw track has up to 84 % more."""
    fixes, segments = day(data, folder)
    cleaned = cleaned_length(fixes.time, fixes.position)
    assert raw_length(fixes.position) > 1.1 * cleaned
    assert sum(s.distance for s in segments) == pytest.approx(cleaned, rel=0.03)


@pytest.mark.parametrize("folder", DAYS)
def test_nobody_walks_as_fast_as_a_bicycle_nor_rides_in_a_garden(data, folder):
    _, segments = day(data, folder)
    for s in segments:
        speed = s.distance / (s.end - s.start)
        assert s.kind != WALKING or 0.3 < speed < FASTEST_WALK
        assert s.kind != VEHICLE or speed > 1.5
    # who is in the same house for four hours (5.9 to 9.9 h) does not ride
    if folder.endswith("005"):
        assert sum(s.distance for s in segments if 5.9 * 3600 < s.start < 9.5 * 3600) < 500


def unix(text):
    return datetime.strptime(text, "%Y/%m/%d %H:%M:%S").replace(tzinfo=UTC).timestamp()


def test_a_volunteer_says_the_same(data):
    """GeoLife 010: on foot, by taxi, by bus; where the labels overlap the shorter one is meant."""
    (path,) = data.glob("geolife_sample/010/*.plt")
    given, both = read(path), np.zeros((2, 2))
    rows = [line.split("\t") for line in path.with_name("labels.txt").read_text().splitlines()[1:]]
    labels = [(unix(begin), unix(end), mode.strip() in ("walk", "run")) for begin, end, mode in rows]
    labels.sort(key=lambda label: label[1] - label[0])
    for segment in follow_positions(given.fixes)[1]:
        for second in np.arange(segment.start, segment.end) if segment.kind != GAP else ():
            at = given.walk.epoch + second
            on_foot = next((foot for begin, end, foot in labels if begin <= at <= end), None)
            if on_foot is not None:
                both[int(not on_foot), int(segment.kind == VEHICLE)] += 1
    assert both.sum() > 30 * 60
    assert np.trace(both) > 0.97 * both.sum()


@pytest.mark.parametrize("walk", WALKS)
def test_a_real_walk_has_no_ride(data, walk):
    """Outdoors, and indoors where the receiver is 10 to 30 m off and its first fixes may be 400 m off."""
    (path,) = data.glob(walk)
    given = read(path)
    assert len(given.fixes) > 100
    assert not len(detect_rides(detect_steps(given.walk, Walker()), given.fixes))
