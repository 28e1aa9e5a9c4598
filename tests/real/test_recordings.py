"""Recordings by others: the figures of their data page, and from raw file to estimate with their own fixes."""

import csv
import json

import numpy as np
import pytest

from pdr_graph import FloorPlan, InputError, WalkGraph, detect_steps, smooth
from pdr_graph.apps.bench.data_sets import walks_of
from pdr_graph.apps.report.evaluation import circular_error, pair
from pdr_graph.frames import enu, projected
from pdr_graph.geometry import interpolate
from pdr_graph.io.loading import load
from pdr_graph.io.tables import read_fixes
from pdr_graph.io.validation import RADIUS_68
from pdr_graph.types import LONLAT, Fixes
from pdr_graph.walk import estimate, observe, read

UTM_32 = 32632


def one(data, pattern):
    (path,) = data.glob(pattern)
    return path


IPIN = {  # trial: gyroscope [Hz], POSI, BLE rows, floors, GNSS error [m] at 50 % against POSI
    "Trial01": (100, 14, 649, {"0"}, 1.5),
    "Trial24": (50, 16, 571, {"-2"}, 10.8),
    "Trial52": (50, 12, 12, {"0", "-2"}, 5.0),
}


@pytest.mark.parametrize("trial", IPIN)
def test_ipin_2023(data, trial):
    rate, landmarks, beacons, floors, error = IPIN[trial]
    walk = load(one(data, f"ipin2023_track3/*{trial}*.txt"))
    assert walk.accelerometer.rate == pytest.approx(50, rel=0.01)
    assert walk.magnetometer.rate == pytest.approx(50, rel=0.01)
    assert walk.gyroscope.rate == pytest.approx(rate, rel=0.01)
    assert 6 < walk.barometer.rate < 10.1
    assert (len(walk.truth), len(walk.bluetooth), set(walk.truth.floor)) == (landmarks, beacons, floors)
    assert walk.truth.time[0] == pytest.approx(61, abs=1.5)
    assert any("duplicate epochs" in note for note in walk.notes), "every epoch is written twice"
    assert np.median(np.diff(walk.fixes.time)) == pytest.approx(1.0, abs=0.05)
    assert 1_686_700_000 < walk.epoch < 1_686_900_000, "14 and 15 June 2023"
    frame = enu(49.461, 11.111)
    fixes, truth = frame.place(walk.fixes), frame.place(walk.truth)
    at = interpolate(truth.time, fixes.time, fixes.position)
    # a median of a dozen landmarks; the data page does not say how it paired them
    assert np.median(np.hypot(*(at - truth.position).T)) == pytest.approx(error, rel=0.5)


def test_ipin_beacon_table_is_no_recording(data):
    with pytest.raises(InputError, match="supported recorder"):
        load(data / "ipin2023_track3" / "BLE_Locations.csv")


def test_nju_phyphox(data):
    walk = load(data / "nju_phyphox_outdoor")
    assert walk.accelerometer.rate == pytest.approx(49.7, abs=0.1)
    assert len(walk.accelerometer) == len(walk.gyroscope) == len(walk.magnetometer) == 29829
    assert len(walk.fixes) == 601
    assert walk.fixes.sigma * RADIUS_68 == pytest.approx(4.73, abs=1.3)
    assert walk.accelerometer.time[-1] == pytest.approx(600, abs=0.1)
    assert walk.barometer.time[0] < 0
    assert walk.epoch is None
    assert np.median(walk.barometer.values) == pytest.approx(1019.8, abs=0.5)


def test_ipin21(data):
    walk = load(data / "ipin21_hcu" / "eight")
    for signal in (walk.accelerometer, walk.gyroscope, walk.magnetometer, walk.barometer):
        assert signal.rate == pytest.approx(100, abs=0.1)
        assert signal.time[-1] == pytest.approx(129, abs=1)
    assert len(walk.truth) == 220
    assert walk.truth.epsg == UTM_32
    way = np.hypot(*np.diff(walk.truth.position, axis=0).T).sum()
    assert way == pytest.approx(146, abs=1)
    assert any("5 sets of simulated fixes" in note for note in walk.notes)


OXFORD = {"hand": 326, "frontpocket": 327, "bag": 346}


@pytest.mark.parametrize("held", OXFORD)
def test_oxford(data, held):
    """An accelerometer alone: the steps are counted to within 2 %, their turns are unknown."""
    walk = load(one(data, f"oxford_steps/validation/user1_{held}_*.csv"))
    assert walk.accelerometer.rate == pytest.approx(100, abs=1)
    assert walk.gyroscope is None
    steps = detect_steps(walk)
    assert len(steps) == pytest.approx(OXFORD[held], rel=0.02)
    assert steps.unknown == ("turns: there is no gyroscope, or it stopped",)


def test_oxford_swinging_arm(data):
    walk = load(data / "oxford_steps" / "Pixel_Jamie_Hard_SwingingArm_1")
    assert walk.accelerometer.rate == pytest.approx(405, abs=2)
    assert walk.accelerometer.time[-1] == pytest.approx(143, abs=1)


GEOLIFE = {"001/20081024234405": (7075, 11.8), "005/20081024041230": (4298, 11.8), "000/20081028003826": (1477, 4.4)}


@pytest.mark.parametrize("name", [*GEOLIFE, "010/20080402060926"])
def test_geolife(data, name):
    """Against the date and time columns, which the reader does not use."""
    path = data / "geolife_sample" / f"{name}.plt"
    walk = load(path)
    rows = list(csv.reader(path.read_text().splitlines()[6:]))
    stamps = np.array([f"{date}T{time}" for *_, date, time in rows], dtype="datetime64[s]").astype(float)
    fixes, hours = GEOLIFE.get(name, (1004, 5.7))
    assert len(rows) == fixes
    assert np.isin(walk.fixes.time + walk.epoch, stamps).all()
    assert len(walk.fixes) == len(np.unique(stamps))
    assert np.ptp(walk.fixes.time) / 3600 == pytest.approx(hours, abs=0.05)


def test_gpx(data):
    walk = load(data / "gpx_sample" / "cerknicko-jezero.gpx")
    assert len(walk.fixes) == 296
    assert np.ptp(walk.fixes.time) == pytest.approx(2.0 * 3600, rel=0.02)
    assert np.diff(walk.fixes.time).max() == 894
    position = enu(45.77, 14.36).place(walk.fixes).position
    assert np.hypot(*np.diff(position, axis=0).T).sum() == pytest.approx(13_700, rel=0.01)


def test_ipin21_plan_is_walked_by_its_own_route_network(data):
    """369 links that the authors drew to be walked: rooms are entered by doors, and thin walls stand."""
    floor = FloorPlan.load(data / "ipin21_hcu" / "map" / "Plan4OG.geojson")
    route = json.loads((data / "ipin21_hcu" / "map" / "Route4OG.geojson").read_text())
    links = [np.array(f["geometry"]["coordinates"]) for f in route["features"]]
    start, end = np.concatenate([k[:-1] for k in links]), np.concatenate([k[1:] for k in links])
    assert floor.crosses_wall(start, end).mean() < 0.02
    aside = np.stack([-(end - start)[:, 1], (end - start)[:, 0]], axis=1)
    assert floor.crosses_wall(start, start + 3 * aside).mean() > 0.5, "a control: across the way there are walls"


@pytest.mark.parametrize(("fixes", "target"), [("freq10_s_err5m", 1.6), ("Freq30_s_err1", 1.1), ("Freq5_err3m", 1.2)])
def test_ipin21_eight_with_its_simulated_fixes(data, fixes, target):
    """Half of the true steps nearer than the fixes' own error; ``target`` [m] leaves a third above what we measured."""
    folder = data / "ipin21_hcu" / "eight"
    walk = load(folder)
    given = read_fixes(folder / "simulated_fixes" / f"{fixes}.csv", walk, projected(UTM_32))
    track = smooth(WalkGraph(detect_steps(walk), given)).trajectory
    error = circular_error(pair(track, projected(UTM_32).place(walk.truth)))
    assert np.median(error) < target


def test_nju_walks_on_through_a_minute_without_gps(data):
    """Fixes withheld for 60 s, of 2.5–3.6 m per axis: half of them within 3.2 m of the walk that never saw them."""
    walk = load(data / "nju_phyphox_outdoor")
    assert walk.fixes.epsg == LONLAT
    fixes = enu(*walk.fixes.position[0, ::-1].tolist()).place(walk.fixes)
    withheld = (fixes.time > 300) & (fixes.time < 360)
    track = smooth(WalkGraph(detect_steps(walk), fixes[~withheld])).trajectory
    at = interpolate(fixes.time[withheld], track.time, track.position)
    assert np.median(np.hypot(*(at - fixes.position[withheld]).T)) < 3.2


START_SIGMA = 0.3  # [m] of who stands on a marked place


@pytest.fixture(scope="module")
def eight(data):
    """The plan, the truth in its frame, and the walk as the graph has it: one fix, no heading."""
    folder = data / "ipin21_hcu"
    plan, walk = FloorPlan.load(folder / "map" / "Plan4OG.geojson"), load(folder / "eight")
    truth, steps = plan.frame.place(walk.truth), detect_steps(walk)
    start = Fixes(np.array([steps.start]), truth.position[:1], np.array([START_SIGMA]), ("",))
    return plan, truth, smooth(WalkGraph(steps, start, floor=plan))


def test_half_of_the_steps_are_within_a_metre_and_none_is_in_a_wrong_corridor(eight):
    """Corridors are 3 m wide: one cell all round the eight, and beside it 205 rooms behind walls of 12 cm."""
    plan, truth, estimate = eight
    error, position = circular_error(pair(estimate.trajectory, truth)), estimate.trajectory.position
    assert np.median(error) <= 1.0
    assert error.max() < 3.0
    assert not plan.crosses_wall(position[:-1], position[1:]).any()
    walked = set(plan.cells.at(truth.position).tolist())
    assert {plan.cells.cells[c].kind for c in walked} == {"corridor"}
    assert set(plan.cells.at(position).tolist()) == walked
    assert len(plan.regions) > 200


def test_a_tram_among_walks_is_named_and_the_fixes_carry_it(data):
    """30 s at 10 m/s between straight walks of two minutes: before, 80 % of fixes were rejected."""
    result = estimate(observe(read(one(data, "found/ride-in-smooth/*.zip"))))
    assert result.evidence.rides == pytest.approx(np.array([[120.0, 150.0]]), abs=5)
    assert result.verdict.ok
    assert np.mean([fix.weight > 0 for fix in result.estimate.fixes]) > 0.9
    track = result.estimate.trajectory
    first, last = track[track.time < 120].position, track[track.time > 155].position
    assert np.abs(first[:, 1]).max() < 5, "due east"
    turn = np.arctan2(*(last[-1] - last[0])[::-1])
    assert turn == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(("name", "paths"), [("strides", "strides/*-25-11-33-56.txt"), ("ridi", "ridi/hao_leg2.xlsx")])
def test_walks_of_research_data_are_those_of_the_bench(data, name, paths):
    (path,) = data.glob(paths)
    walk, of_bench = load(path), next(read for walk, read in walks_of(name, data) if walk in path.stem)()
    for sensor, signal in of_bench.evidence.walk.signals.items():
        assert walk.signals[sensor].time[-1] == pytest.approx(signal.time[-1])
        assert walk.signals[sensor].values.mean(axis=0) == pytest.approx(signal.values.mean(axis=0), rel=1e-2, abs=1e-3)
    if walk.truth:
        ways = [np.hypot(*np.diff(truth.position, axis=0).T).sum() for truth in (walk.truth, of_bench.truth)]
        assert ways[0] == pytest.approx(ways[1])
