"""Hostile streams: what cannot be used is counted and changes nothing, and memory and work stay bounded.

A walk of 72 hours, with latency and memory, is scripts/soak.py.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from synthetic_walks import held_by_walls, live_events
from tiers import thorough

from pdr_graph.estimation import fingerprinting
from pdr_graph.estimation.factors import beacon_rssi
from pdr_graph.estimation.live import live_ambiguity
from pdr_graph.estimation.live.window import WAITING
from pdr_graph.gait.step_stream import StepStream
from pdr_graph.online.event_checks import SPAN
from pdr_graph.online.interface import Samples, Scan
from pdr_graph.online.navigator import Navigator
from pdr_graph.priors import SCHEDULE
from pdr_graph.types import Beacons, Fixes, Headings, Levels, Ranges, Sightings, Steps

STEPS = 80
VALUES = [np.nan, np.inf, -np.inf, 0.0, -1.0, 1e300, -1e300, 1e-300, 1e9, 1e-5]


@cache
def walk(count=STEPS):
    return tuple(live_events(*held_by_walls(count, period=0.5)))


def unchecked(data, **columns):
    """A table whose columns were changed after its checks."""
    for name, value in columns.items():
        getattr(data, name)[...] = value
    return data


def bad_row(random, end):
    """A measurement of any kind at ``end`` [s] with one value that is not possible, unchecked."""
    kind = random.integers(9)
    time, one, place = np.array([end]), np.ones(1), np.full((1, 2), 10.0)
    if kind < 3:
        value = random.choice(VALUES if kind == 2 else VALUES[:3] + VALUES[5:7])
        fix = Fixes(time, place, one, source=(random.choice(["", "gnss"]),))
        return unchecked(fix, **{("time", "position", "sigma")[kind]: value})
    if kind < 5:
        value = random.choice(VALUES if kind == 4 else VALUES[:3] + VALUES[5:7])
        return unchecked(Headings(time, one, one.copy()), **{("heading", "sigma")[kind - 3]: value})
    if kind == 5:
        return Levels(time, np.zeros(1, dtype=int), -60 * one, ("x",), place, np.array([random.choice(VALUES)]))
    if kind == 6:
        rssi = np.array([random.choice(VALUES[:3] + VALUES[5:7])])
        return Levels(time, np.zeros(1, dtype=int), rssi, ("x",), place, one)
    if kind == 7:
        ranges = Ranges(time, np.zeros(1, dtype=int), 5 * one, one, ("x",), place, one.copy())
        return unchecked(ranges, **{random.choice(["sigma", "position_sigma"]): random.choice(VALUES)})
    return Scan("bluetooth", Sightings(time, ("b0",), np.array([random.choice(VALUES[:3] + VALUES[5:7])])))


def ranges_of(random, time, anchors=20):
    """A range to one of many anchors."""
    labels, position = tuple(f"a{n}" for n in range(anchors)), np.linspace(0, 45, 2 * anchors).reshape(-1, 2)
    one, many = np.ones(1), np.ones(anchors)
    number = random.integers(0, anchors, 1)
    return Ranges(np.array([time]), number, random.uniform(3, 20, 1), 0.5 * one, labels, position, 0.1 * many)


def pushed(events, **options):
    nav = Navigator(**options)
    for event in events:
        nav.push(event)
    return nav


def track(nav):
    return nav.finish().trajectory.position.tobytes()


@cache
def usual():
    """The track of the walk in order."""
    return track(pushed(walk()))


def said(nav, *words):
    return any(all(word in line for word in words) for line in nav.status.issues)


def test_steps_that_are_repeated_or_late_change_nothing():
    events = walk()
    late = [e for n, event in enumerate(events) for e in (event, event, *events[max(0, n - 20) : n : 7])]
    late = [e for n, e in enumerate(late) if isinstance(e, Steps) or e not in late[:n]]
    nav = pushed(late)
    assert said(nav, "steps", "out of order")
    assert track(nav) == usual()


def test_steps_that_leave_time_out_have_a_gap_between():
    events = [event for event in walk() if isinstance(event, Steps)]
    nav = pushed(events[:30] + events[60:])
    assert any("1 gap" in line for line in nav.unknown)
    assert nav.steps == 50


@pytest.mark.parametrize("value", [1e300, thorough(1e8)])
@pytest.mark.parametrize("column", ["length", "turn", "sigma_length"])
def test_a_step_of_impossible_size_is_a_gap(column, value):
    events = walk()
    nav = pushed([*events[:40], replace(events[40], **{column: np.array([value])}), *events[41:]])
    assert said(nav, "steps: 1 could not be used")
    assert np.isfinite(nav.finish().trajectory.covariance).all()


def test_absurd_rows_of_any_kind_change_nothing():
    """NaN, inf, 0, negative and huge values in every column of every kind."""
    random, disturbed = np.random.default_rng(0), []
    for event in walk():
        disturbed += [event, *(bad_row(random, event.end) for _ in range(8) if isinstance(event, Steps))]
    nav = pushed(disturbed)
    for name in ("fixes", "headings", "ranges", "beacons", "scans"):
        assert said(nav, f"{name}: ", "could not be used"), name
    assert track(nav) == usual()


def test_measurements_far_ahead_are_counted_and_not_stored():
    events = walk()
    random = np.random.default_rng(0)
    future = [m for n in range(200) for m in (ranges_of(random, 1e6 + n), Headings(*np.array([[1e6 + n], [0], [1]])))]
    scans = [Scan("bluetooth", Sightings(np.array([1e6 + n]), ("x",), np.array([-60.0]))) for n in range(200)]
    nav = pushed([*events[:40], *future, *scans, *events[40:]])
    assert nav.status.early == 600
    assert said(nav, "600", "ahead of the sensors")
    assert track(nav) == usual()


def test_late_measurements_are_an_issue():
    events = walk(300)
    nav = pushed([*events, *(event for event in events[:20] if isinstance(event, Fixes))], lag=10.0)
    assert nav.status.late > 0
    assert said(nav, f"{nav.status.late} came too late")


def test_steps_that_are_certain_seconds_later_accuse_no_clock():
    """Of a front end of one's own: its last step is no present time, by which a fix would be of the future."""
    time, one = np.arange(0.5, 38.0), np.ones(1)
    fixes = [Fixes(time[n : n + 1], np.array([[t, 0.0]]), one, source=("GNSS",)) for n, t in enumerate(time)]
    events = [event for event in walk() if isinstance(event, Steps)] + fixes
    events.sort(key=lambda event: event.end + 4.0 if isinstance(event, Steps) else float(event.time[0]))
    assert not said(pushed(events), "clock")


def test_fixes_at_100_hz_are_thinned():
    steps, fixes = held_by_walls(20, period=0.5)
    time = np.arange(0.5, 10.0, 0.01)
    place = np.tile(fixes.position[:1], (len(time), 1)) + np.random.default_rng(0).normal(0, 3, (len(time), 2))
    many = Fixes(time, place, np.full(len(time), 3.0))
    nav = pushed([many[:300], *live_events(steps, many[300:])])
    assert nav.status.fixes <= Fixes.most * len(time) * 0.01 / SPAN + 1
    assert nav.status.keyframes < 100
    assert said(nav, "fixes: ", "came more often than")


def test_fixes_without_steps_are_not_hoarded():
    """But for those that the first steps need."""
    nav = pushed(Fixes(np.array([float(t)]), np.zeros((1, 2)) + t % 3, np.ones(1)) for t in range(WAITING + 500))
    assert len(nav._graph.graph.log.rows(Fixes)) == WAITING
    assert len(nav._graph.ambiguity.history.log.rows(Fixes)) == WAITING
    assert nav.status.fixes == WAITING + 500


def test_a_gyroscope_alone_is_not_hoarded():
    stream, time = StepStream(), np.arange(0, 1, 0.01)
    still = np.zeros((100, 3))
    for second in range(600):
        stream.push("gyroscope", second + time, still)
        if second < 5:
            stream.push("accelerometer", second + time, still + np.array([0.0, 0.0, 9.81]))
        stream.advance()
    assert len(stream._sensors["gyroscope"].time) < 150 * 100


def test_a_barometer_alone_is_not_hoarded():
    nav = pushed(Samples("barometer", np.array([float(t)]), np.array([[1000.0]])) for t in range(3000))
    assert len(nav._floors.pressure) < 1500


def test_a_walk_whose_direction_stays_open_leaves_the_window(monkeypatch):
    """One fix and nothing else: the direction is never known, and the window would hold all of the walk."""
    monkeypatch.setattr(live_ambiguity, "SCHEDULE", replace(SCHEDULE, longest_open=60.0))
    steps, fixes = held_by_walls(600, period=0.5)
    nav, most = Navigator(lag=20.0), 0
    for event in live_events(steps, fixes[:1]):
        nav.push(event)
        most = max(most, nav.status.keyframes)
    assert most < 20
    assert nav.status.state == "initialising heading"
    assert np.isfinite(nav.pose.covariance).all()


def listed(count):
    names = tuple(f"b{n}" for n in range(count))
    return Beacons(names, np.random.default_rng(0).uniform(0, 45, (count, 2)), np.ones(count), ("",) * count, names)


def test_ten_thousand_beacons_in_every_scan_are_as_few_as_can_be_used():
    """The strongest of each stretch, and of these the ones that are received most often."""
    random, count = np.random.default_rng(0), 10_000
    names = listed(count).name
    nav = Navigator(beacons=listed(count))
    for event in walk(40):
        nav.push(event)
        if isinstance(event, Steps) and round(event.end) % 4 == 0:
            nav.push(Scan("bluetooth", Sightings(np.full(count, event.end), names, random.uniform(-95, -60, count))))
    measurements = nav._graph.graph.factors.measurements
    [beacons] = [kind for kind in measurements if kind.name == "beacons"]
    assert 0 < len(beacons.position) <= beacon_rssi.MOST_BEACONS
    assert np.unique(beacons.listed.time, return_counts=True)[1].max() <= beacon_rssi.STRONGEST


def test_the_names_of_transmitters_are_forgotten(monkeypatch):
    monkeypatch.setattr(fingerprinting, "MOST_LEVELS", 100)
    radio_map = type("Map", (), {"transmitter": ("a", "b"), "located": lambda self, scans: Fixes.none()})()
    collector = fingerprinting.ScanCollector(radio_map, lambda fixes: None)
    for n in range(50):
        names = (*(f"x{n}.{k}" for k in range(30)), "b")
        collector.collect(Sightings(np.full(31, float(n)), names, np.full(31, -60.0)), "wifi")
        list(collector.due(float(n), None))
    assert len(collector._received) <= 100
    assert collector._received.transmitter[-2:] == ("x49.29", "b")


def test_a_scan_of_another_hour_takes_no_memory():
    """A window for each second between the scans, times the transmitters, would be 80 GB."""
    radio_map = type("Map", (), {"transmitter": ("a",), "located": lambda self, scans: Fixes.none()})()
    collector = fingerprinting.ScanCollector(radio_map, lambda fixes: None)
    names = tuple(f"x{n}" for n in range(100))
    collector.collect(Sightings(np.append(np.zeros(99), 1e8), names, np.full(100, -60.0)), "wifi")
    assert list(collector.due(1e8 + 10, None)) == []


def test_ranges_are_used_at_few_moments_and_to_many_anchors():
    """Each moment is a keyframe: of 25 in a quarter of a second four are used, with all anchors that share one."""
    events = [event for event in walk() if isinstance(event, Steps)][:10]
    begin, random = np.ceil(events[-1].end), np.random.default_rng(0)
    alone = pushed([*events, *(ranges_of(random, begin + 0.01 * n) for n in range(25))])
    assert said(alone, "ranges: 21 came more often")
    shared = pushed([*events, *(ranges_of(random, begin) for _ in range(9)), ranges_of(random, begin + 0.1)])
    assert not said(shared, "ranges")
