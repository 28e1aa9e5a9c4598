"""Ranges to anchors go through the lifelog: stored, joined over recordings, and estimated as `smooth` does."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import simulated
from observations import HERE, NOON, estimated_together, median_error, observation, positions, walk
from test_multi_day import PHONES, heard

from pdr_graph.apps.lifelog.build import build
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
    assert median_error(day.outings[0].trajectory, truth) < 0.3


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
