"""A day from its observations, with ranges to anchors among them."""

import shutil
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import simulated
from observations import HERE, NOON, estimated_together, median_error, observation, positions, walk
from test_multi_day import PHONES, heard
from walks import drawn_from_the_model

from pdr_graph import dead_reckon
from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.day import ACTIVITIES, GAP, WALKING
from pdr_graph.apps.lifelog.ingest import add
from pdr_graph.apps.lifelog.observation import read_observation
from pdr_graph.apps.lifelog.reconstruct import reconstruct
from pdr_graph.apps.lifelog.sessions import join
from pdr_graph.apps.lifelog.store import RecordingOptions, Store
from pdr_graph.apps.report.output_files import smooth_recording
from pdr_graph.frames import Frame, enu
from pdr_graph.geometry import interpolate
from pdr_graph.io.loading import load
from pdr_graph.io.tables import read_trajectory
from pdr_graph.types import Fixes, Ranges, concatenate
from pdr_graph.walk import Options


def day_of(*ones, profile=None):
    return reconstruct("me", "2023-11-14", {f"r{n}": one for n, one in enumerate(ones)}, profile)


def test_segments_cover_every_second_of_an_outing_once():
    one = walk(120)[0]
    two = replace(one, epoch=NOON + one.duration + 120)
    for day in (day_of(one, two), day_of(positions(1200.0)), day_of(one, positions(400.0, NOON + 2000))):
        for outing in day.outings:
            bounds = [(s.start, s.end) for s in outing.segments]
            assert bounds[0][0] == pytest.approx(outing.trajectory.time[0], abs=1e-3)
            assert bounds[-1][1] == pytest.approx(outing.trajectory.time[-1], abs=1e-3)
            assert all(a[1] == pytest.approx(b[0]) for a, b in pairwise(bounds))
            assert {s.kind for s in outing.segments} <= set(ACTIVITIES)


def test_time_without_data_is_a_gap_without_a_distance():
    one = walk(120)[0]
    day = day_of(one, replace(one, epoch=NOON + one.duration + 590))
    [outing] = day.outings
    [gap] = [s for s in outing.segments if s.kind == GAP]
    assert gap.end - gap.start == pytest.approx(590, abs=1.0)
    assert gap.distance == 0.0
    assert (np.diff(outing.trajectory.time) > 500).sum() == 1
    assert np.sqrt(outing.trajectory.covariance[[0, -1], 0, 0]).max() < 5.0
    walked = sum(s.distance for s in outing.segments if s.kind == WALKING)
    assert walked == pytest.approx(2 * day_of(one).total(WALKING)[1], rel=0.05), "as each by itself"


def test_a_walk_without_position_begins_where_the_outing_before_ended():
    """A watch is put away, and half a minute later a phone records in a building."""
    one = walk(120)[0]
    blind = observation(one.steps, one.fixes[:0], NOON + one.duration + 30, Frame())
    inside = day_of(positions(300.0), replace(blind, epoch=NOON + 330.0)).outings[1]
    assert inside.frame == HERE
    assert np.hypot(*(inside.trajectory.position[0] - [1.3 * 295, 0.0])) < 15.0
    assert np.sqrt(inside.trajectory.covariance[0, 0, 0]) == pytest.approx(35.0, rel=0.3), "35 s at 1 m/s"


def test_the_positions_of_a_watch_locate_the_walk_of_a_phone():
    steps, fixes, truth = drawn_from_the_model(240, 4)
    phone = observation(steps, fixes[:0], frame=Frame())
    at = np.arange(4.0, truth.time[-1], 10.0)
    place = interpolate(at, truth.time, truth.position) + np.random.default_rng(0).normal(0, 2, (len(at), 2))
    watch = observation(None, Fixes(at, place, np.full(len(at), 2.0), ("",) * len(at)))
    alone = day_of(phone).outings[0]
    both = day_of(phone, watch).outings[0]
    assert median_error(both.trajectory, truth) < 3.0
    assert set(both.recordings) == {"r0", "r1"}
    assert median_error(alone.trajectory, truth) > 10.0


def test_the_profile_becomes_more_certain_from_day_to_day_and_stays_honest():
    """Ten days of a walker whose stride is 12 % longer than assumed, with few and poor fixes."""
    profile, sigmas, errors = None, [], []
    for seed in range(10):
        steps, _, _ = drawn_from_the_model(200, 50 + seed)
        truth_steps = replace(steps, length=1.12 * steps.length)
        truth = dead_reckon(truth_steps)
        random = np.random.default_rng(seed)
        at = np.array([1, 60, 120, 190])
        fixes = Fixes(truth.time[at], truth.position[at] + random.normal(0, 10, (4, 2)), np.full(4, 10.0), ("",) * 4)
        profile = day_of(observation(steps, fixes, NOON + 86400.0 * seed), profile=profile).profile
        sigmas.append(np.sqrt(profile.covariance[0, 0]))
        errors.append(profile.E_length - 0.12)
    assert np.mean(sigmas[5:]) < 0.8 * sigmas[0]
    assert sigmas[-1] > 0.01, "people change: it never becomes certain"
    assert np.abs(errors[-3:]).max() < 3 * np.mean(sigmas[-3:])


def test_a_walker_file_is_the_first_profile():
    one = walk(200, seed=8)[0]
    known = day_of(one).profile
    assert known is not None
    blind = observation(one.steps, one.fixes[:1])
    began = day_of(replace(blind, profile=known)).profile
    assert began.E_length == pytest.approx(known.E_length, abs=2 * np.sqrt(known.covariance[0, 0]))
    assert day_of(blind).profile is None


def test_a_day_whose_sources_contradict_each_other_teaches_no_profile_and_its_notes_say_why():
    one = walk(200, seed=8)[0]
    known = day_of(one).profile
    away = np.random.default_rng(0).normal(0, 6, one.fixes.position.shape)  # they state 1.5 m
    wrong = replace(one, fixes=replace(one.fixes, position=one.fixes.position + away))
    for before in (None, known):
        day = day_of(wrong, profile=before)
        assert day.profile is before
        assert day.outings[0].notes[0].startswith("doubtful: ")


# Ranges to anchors

ROUTE = np.array([(40.0, 30.0), (65.0, 30.0), (65.0, 42.0), (40.0, 42.0), (40.0, 32.0)])
ANCHORS = np.array([(36.0, 26.0), (36.0, 46.0), (69.0, 46.0), (69.0, 26.0)])
SIGMA, SURVEY_SIGMA = 0.3, 0.1  # [m]


def ranges_along(time, position, seed=0, anchors=ANCHORS):
    """A range to one of the anchors every 0.25 s, in turn, with 0.3 m noise, along a true path."""
    random = np.random.default_rng(seed)
    at = np.arange(time[0] + 0.5, time[-1], 0.25)
    anchor = np.arange(len(at), dtype=np.intp) % len(anchors)
    distance = np.hypot(*(interpolate(at, time, position) - anchors[anchor]).T) + random.normal(0, SIGMA, len(at))
    labels = tuple(f"A{m}" for m in range(len(anchors)))
    sigma, survey = np.full(len(at), SIGMA), np.full(len(anchors), SURVEY_SIGMA)
    return Ranges(at, anchor, np.maximum(distance, 0.0), sigma, labels, anchors, survey)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A simulated recording without any fix, ranges.csv and anchors.csv; and the options of both verbs."""
    folder = tmp_path_factory.mktemp("ranges")
    simulated.indoor_location(folder, ROUTE, seed=4)
    recording = folder / "walk.txt"
    walk = load(recording)
    truth = read_trajectory(folder / "truth.csv", walk)
    table = ranges_along(truth.time, truth.position)
    columns = zip(table.time + walk.clock_origin, table.anchor, table.range, strict=True)
    rows = [f"{time:.3f},A{anchor},{distance:.3f}" for time, anchor, distance in columns]
    (folder / "ranges.csv").write_text("\n".join(["time,anchor,range", *rows]) + "\n")
    rows = [f"A{m},{x},{y}" for m, (x, y) in enumerate(ANCHORS.tolist())]
    (folder / "anchors.csv").write_text("\n".join(["beacon,x,y", *rows]) + "\n")
    return recording, {"beacons": folder / "anchors.csv", "ranges": folder / "ranges.csv"}, truth


def built_day(log):
    with Store(log) as store:
        [(person, date)] = store.days()
        return store.day(person, date)


def test_a_walk_with_ranges_and_no_fix_equals_that_of_smooth(files, tmp_path):
    recording, paths, truth = files
    add(tmp_path / "log", [recording], RecordingOptions(**paths))
    assert build(tmp_path / "log").failures == ()
    [outing] = built_day(tmp_path / "log").outings
    options = Options(**paths, recorded_fixes=False)
    smooth_recording(recording, tmp_path / "smoothed", options)
    smoothed = read_trajectory(tmp_path / "smoothed" / "trajectory.csv", load(recording))
    assert median_error(outing.trajectory, truth) < 0.3
    assert interpolate(smoothed.time, outing.trajectory.time, outing.trajectory.position) == pytest.approx(
        smoothed.position, abs=2e-3
    ), "to the digits of the CSV"
    add(tmp_path / "lost", [recording])
    build(tmp_path / "lost")
    assert median_error(built_day(tmp_path / "lost").outings[0].trajectory, truth) > 1.0, "a control"


def test_a_rebuilt_store_has_the_same_day(files, tmp_path):
    """Days are built from the observation file alone, from scratch, and again after the ranges changed."""
    recording, paths, _ = files
    ranges = shutil.copy(paths["ranges"], tmp_path / "ranges.csv")
    add(tmp_path / "log", [recording], RecordingOptions(beacons=paths["beacons"], ranges=ranges))
    assert build(tmp_path / "log").built == 1
    first = built_day(tmp_path / "log").outings[0].trajectory
    for source in ("its observation", "the recording"):
        with Store(tmp_path / "log") as log:
            [entry] = log.entries()
            [table] = read_observation(log.folder / "observations" / entry.observation).measurements
            log.begin_build([("me", date) for _, date in log.days()])
        assert len(table) > 100
        if source == "the recording":
            shutil.rmtree(tmp_path / "log.d")
        assert build(tmp_path / "log").built == 1, source
        assert np.array_equal(built_day(tmp_path / "log").outings[0].trajectory.position, first.position)
    ranges.write_text("\n".join(ranges.read_text().splitlines()[:-9]))
    assert build(tmp_path / "log").built == 1, "other ranges are another day"


def test_ranges_that_cannot_be_read_are_refused_when_they_are_added(files, tmp_path):
    recording, paths, _ = files
    result = add(tmp_path / "log", [recording], RecordingOptions(ranges=paths["ranges"]))
    assert result.added == 0
    assert "found no places of anchors, expected --beacons" in result.refused[0]


def with_ranges(n, seed, **other):
    """A walk drawn from the model with ranges and no fix, and its truth."""
    one, truth = walk(n, seed, **other)
    corners = np.array([truth.position.min(axis=0) - 5, truth.position.max(axis=0) + 5])
    anchors = np.array([(x, y) for x in corners[:, 0] for y in corners[:, 1]])
    table = ranges_along(truth.time, truth.position, seed, anchors)
    return replace(one, fixes=Fixes.none(), measurements=(table,)), truth


def test_two_recordings_of_one_outing_keep_their_ranges():
    """The second recording's ranges are later by its start, and both refer to the same anchors."""
    first, truth = with_ranges(100, 1)
    [table] = first.measurements
    later = replace(first, epoch=NOON + first.duration + 100)
    both = join([first, later])
    [ranges] = both.measurements
    assert len(ranges) == 2 * len(table)
    assert ranges.time[len(table) :] == pytest.approx(table.time + first.duration + 100)
    assert (np.diff(ranges.time) >= 0).all()
    assert ranges.label == table.label
    day = reconstruct("me", "2023-11-14", {"one": first, "two": later}, None)
    [outing] = day.outings
    for begin in (0.0, first.duration + 100):
        own = replace(truth, time=truth.time + begin)
        assert median_error(outing.trajectory, own) < 0.3


def test_anchors_of_two_lists_are_merged_by_label():
    one = ranges_along(np.array([0.0, 9.0]), np.zeros((2, 2)))
    other = replace(one, label=("A3", "B", "A1", "A0"), position=one.position[[3, 0, 1, 0]] + [0.0, 1.0])
    both = concatenate([one, other])
    assert both.label == ("A0", "A1", "A2", "A3", "B")
    assert [both.label[m] for m in both.anchor[-4:]] == [other.label[m] for m in other.anchor[-4:]]
    assert np.array_equal(both.position, [*one.position, other.position[1]]), "the first list's places"
    twice = concatenate([replace(one, label=("", "", "a", "a"))] * 2)
    assert twice.label == ("", "", "a", "a"), "one label of one list may name several anchors"
    assert np.array_equal(twice.anchor, np.tile(one.anchor, 2))


def test_anchors_in_another_frame_are_converted_to_that_of_the_first_recording():
    first, truth = with_ranges(100, 2)
    [table] = first.measurements
    there = enu(48.101, 11.601)
    moved = replace(table, position=there.from_lonlat(HERE.to_lonlat(table.position)))
    later = replace(first, epoch=NOON + first.duration + 60, frame=there, measurements=(moved,))
    [ranges] = join([first, later]).measurements
    assert ranges.position == pytest.approx(table.position)
    elsewhere = replace(later, frame=Frame())
    day = reconstruct("me", "2023-11-14", {"one": first, "two": elsewhere}, None)
    assert len(day.outings) == 2, "anchors on no common ground are two outings"
    assert median_error(day.outings[0].trajectory, truth) < 0.4


def test_a_walk_with_ranges_does_not_begin_where_the_outing_before_ended():
    inside, truth = with_ranges(100, 3, epoch=NOON + 330.0, frame=Frame())
    day = reconstruct("me", "2023-11-14", {"watch": positions(300.0), "phone": inside}, None)
    assert day.outings[1].frame == Frame()
    assert median_error(day.outings[1].trajectory, truth) < 0.3


def test_ranges_are_used_when_walks_are_estimated_together():
    """Two people who met: the one with ranges stays where the ranges put the walk, and places the other."""
    anna, truth = with_ranges(240, 3)
    anna = replace(anna, bluetooth=heard(np.arange(5.0, anna.duration, 20.0)))
    ben = observation(anna.steps, Fixes(np.zeros(1), truth.position[:1], np.array([3.0])))
    of_anna, of_ben = estimated_together([("anna", anna), ("ben", ben)], PHONES)
    assert median_error(of_anna.outings[0].trajectory, truth) < 0.3
    assert median_error(of_ben.outings[0].trajectory, truth) < 3.0
