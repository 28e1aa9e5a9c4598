"""Samples of timelines that others published are imported, or refused in a line that says what they are."""

import csv
import json

import numpy as np
import pytest

from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.day import VEHICLE, WALKING
from pdr_graph.apps.lifelog.diary import diary
from pdr_graph.apps.lifelog.past.importing import import_past
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.apps.lifelog.timeline import STAY
from pdr_graph.io.loading import load

# Sample: positions and guesses in it, counted by hand
SAMPLES = {
    "google/edge_cases_phone_takeout_array_timeline_path.json": (3, 0),
    "google/edge_cases_semantic_history_with_bom.json": (0, 1),
    "google/edge_cases_timeline_edits.json": (1, 0),
    "google/location-history.json": (7, 1),  # 10 points of the path, three of them twice
    "google/phone-takeout_w_3_duplicates.json": (3, 1),
    "google/records.json": (3, 0),
    "google/semantic_history.json": (0, 3),
    "google/timeline_new_format.json": (3, 2),
    "overland_geodata.json": (1, 0),
    "owntracks_2023-02_old.rec": (8, 0),  # 10 messages, two of them repeated
    "owntracks_2024-03.rec": (7, 0),  # one of them repeated, one elsewhere in the same second
}


@pytest.mark.parametrize("name", SAMPLES)
def test_a_sample_is_read_whole(tmp_path, data, name):
    result = import_past(tmp_path / "log", [data / "timelines" / name])
    assert (result.positions.new, result.guesses) == SAMPLES[name]
    assert (result.notes, result.refused, result.skipped) == ((), (), 0)
    again = import_past(tmp_path / "log", [data / "timelines" / name])
    assert (again.positions.new, again.positions.days, again.guesses) == (0, 0, 0)


def test_settings_are_named_as_such(tmp_path, data):
    [line] = import_past(tmp_path / "log", [data / "timelines" / "google" / "edge_cases_device_settings.json"]).refused
    assert "found settings of Google's timeline, expected a timeline" in line


def test_all_samples_are_one_past_that_is_built(tmp_path, data):
    log = tmp_path / "log"
    result = import_past(log, [data / "timelines", data / "gpx_sample"])
    assert result.positions.new == sum(number for number, _ in SAMPLES.values()) + 296
    assert (result.guesses, result.skipped, result.refused) == (8, 3, ())
    built = build(log)
    assert (built.built, built.failures, built.refusals) == (7, (), ())
    with Store(log) as store:
        assert all(store.day(person, date) for person, date in store.days())


def test_positions_and_accuracies_are_those_of_the_file(tmp_path, data):
    file = data / "timelines" / "owntracks_2024-03.rec"
    import_past(tmp_path / "log", [file])
    [day] = (tmp_path / "log.d").rglob("*.csv")
    walk = load(day)
    messages = [json.loads(line[line.index("{") :]) for line in file.read_text().splitlines()]
    first = next(m for m in messages if m["_type"] == "location")
    assert walk.epoch == first["tst"]
    assert walk.fixes.position[0].tolist() == [first["lon"], first["lat"]]
    assert walk.fixes.sigma[0] == pytest.approx(first["acc"] / 1.51)


@pytest.mark.parametrize("phone", ["ucb-sdb-android-3", "ucb-sdb-ios-3"])
def test_rows_are_right_as_often_as_they_state(tmp_path, data, phone):
    """MobilityNet, a day whose sections were timed by hand: at moments of these, 0.1 more or less."""
    file = data / "mobilitynet" / phone / "2019-11-19.rec"
    import_past(tmp_path / "log", [file])
    build(tmp_path / "log")
    with Store(tmp_path / "log") as store:
        rows = [row for day in diary(store, "me", outings=False).days for row in day.entries if row.likely]
    kind = {"walk": WALKING, "ride": VEHICLE, "stop": STAY}
    stated, right = [], []
    for section in csv.DictReader(file.with_suffix(".truth.csv").open()):
        for moment in np.arange(float(section["begin"]), float(section["end"]), 20.0):
            for row in rows:
                if row.start <= moment < row.end and row.duration < 3600:
                    stated.append(row.likely[0][1])
                    right.append(row.likely[0][0] == kind[section["kind"]])
    assert len(right) > 500
    assert np.mean(stated) == pytest.approx(np.mean(right), abs=0.1)
