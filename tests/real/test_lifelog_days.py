"""Days that others recorded, of GPS alone and beside steps."""

from datetime import UTC, datetime
from itertools import pairwise

import numpy as np
import pytest
from cleaned_track import cleaned_length, raw_length

from pdr_graph import Walker, detect_steps
from pdr_graph.apps.lifelog.day import GAP, STANDING, VEHICLE, WALKING
from pdr_graph.apps.lifelog.stays import detect_rides, follow_positions, segments_of, without_rides
from pdr_graph.geometry import dead_reckon, interpolate
from pdr_graph.types import Fixes, Steps
from pdr_graph.walk import read

DAYS = ("geolife_sample/000", "geolife_sample/001", "geolife_sample/005", "geolife_sample/010", "gpx_sample")
WALKS = ("nju_phyphox_outdoor", *(f"ipin2023_track3/*{name}*.txt" for name in ("Trial01", "Trial24", "Trial52")))
FASTEST_WALK = 2.2  # [m/s] in the mean of a segment: between walking fast and cycling slowly


def day(data, folder):
    (path,) = [p for p in (data / folder).iterdir() if p.suffix in (".plt", ".gpx")]
    fixes = read(path).fixes
    return fixes, *follow_positions(fixes)


@pytest.mark.parametrize("folder", DAYS)
def test_a_day_is_told_without_holes(data, folder):
    fixes, way, segments = day(data, folder)
    assert (segments[0].start, segments[-1].end) == (fixes.time[0], fixes.time[-1])
    assert all(one.end == other.start for one, other in pairwise(segments))
    assert all(s.distance == 0 for s in segments if s.kind in (STANDING, GAP))
    assert np.isfinite(way.position).all()


@pytest.mark.parametrize("folder", DAYS)
def test_no_kilometres_are_invented(data, folder):
    """Within 3 % of a cleaning by published recipes; the raw track has up to 84 % more."""
    fixes, _, segments = day(data, folder)
    cleaned = cleaned_length(fixes.time, fixes.position)
    assert raw_length(fixes.position) > 1.1 * cleaned
    assert sum(s.distance for s in segments) == pytest.approx(cleaned, rel=0.03)


@pytest.mark.parametrize("folder", DAYS)
def test_gaps_are_shown_as_gaps(data, folder):
    """Whatever is not recorded for a minute and for five of the usual intervals; nobody knows where they were in it."""
    fixes, way, segments = day(data, folder)
    for begin, end in pairwise(fixes.time):
        if end - begin > max(60.0, 5 * np.median(np.diff(fixes.time))):
            assert any(s.kind == GAP and s.start <= begin and end <= s.end for s in segments)
            inside = (way.time > begin) & (way.time < end)
            assert inside.any()
    longest = max((s for s in segments if s.kind == GAP), key=lambda s: s.end - s.start)
    middle = np.interp((longest.start + longest.end) / 2, way.time, way.covariance[:, 0, 0])
    # a stroll there and back, and of hours a walk to the next quarter
    assert np.sqrt(middle) > min(0.2 * (longest.end - longest.start), 1000.0)


@pytest.mark.parametrize("folder", DAYS)
def test_nobody_walks_as_fast_as_a_bicycle_nor_rides_in_a_garden(data, folder):
    segments = day(data, folder)[2]
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


@pytest.mark.parametrize("bumps", [0.0, 0.7])
def test_a_ride_within_a_real_walk_is_found(data, bumps):
    """After five minutes on the campus a bus, five minutes at 7 m/s; bumps: spurious steps per second of it."""
    given = read(data / "nju_phyphox_outdoor")
    steps, fixes = with_a_ride(detect_steps(given.walk, Walker()), given.fixes, 300.0, 300.0, bumps)
    found = detect_rides(steps, fixes)
    assert found == pytest.approx(np.array([[300.0, 600.0]]), abs=30)
    ridden = without_rides(steps, found)
    kinds = [s.kind for s in segments_of(ridden, dead_reckon(ridden), found)]
    assert kinds.count(VEHICLE) == 1
    assert {WALKING, VEHICLE} <= set(kinds) <= {WALKING, VEHICLE, STANDING}


def with_a_ride(steps, fixes, begin, long, bumps):
    """A walk with a ride straight to the east in it."""
    random = np.random.default_rng(0)
    late = steps.time > begin
    bumpy = np.sort(random.uniform(begin + 5, begin + long - 5, int(bumps * long)))
    bumpy = bumpy[np.diff(bumpy, prepend=0.0) > 0.4]
    time = np.concatenate([steps.time[~late], bumpy, steps.time[late] + long])
    extra = {"duration": 0.3, "length": 0.6, "turn": 0.0, "pause_turn": 0.0, "sigma_length": 0.1, "sigma_turn": 0.05}
    columns = {
        name: np.insert(getattr(steps, name), np.sum(~late), np.full(len(bumpy), value))
        for name, value in extra.items()
    }
    ridden = Steps(steps.start, steps.end + long, time=time, **columns)
    after = fixes.time > begin
    at = np.concatenate([fixes.time[~after], begin + np.arange(1.0, long), fixes.time[after] + long])
    east = 7.0 * np.clip(at - begin, 0, long)
    place = interpolate(np.where(at > begin + long, at - long, np.minimum(at, begin)), fixes.time, fixes.position)
    noise = random.normal(0, 1.5, (len(at), 2))
    place = place + np.column_stack([east, np.zeros(len(at))]) + noise
    n = len(at)
    return ridden, Fixes(at, place, np.full(n, 3.1), ("",) * n, source=("GNSS",) * n)
