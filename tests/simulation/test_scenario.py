"""Scenarios are reproducible, raise errors that name the place, and their recordings read back as simulated."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import run
from tiers import thorough

from pdr_graph import FloorPlan, InputError, WalkGraph, detect_steps, evaluate, read_fixes, read_trajectory, smooth
from pdr_graph.geometry import interpolate
from pdr_graph.io.loading import load
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.scenario import Scenario, UserFixes
from pdr_graph.lab.simulation.simulate import simulate

ROOT = Path(__file__).resolve().parents[2]
SHORT = {"seed": 5, "route": [[0, 0], {"stand": 2}, {"to": [[12, 0], [12, 6]]}], "phone": {"rate": 50}}


def test_equal_seeds_give_equal_walks_and_different_seeds_different_walks():
    one, again, other = (simulate(Scenario.of(SHORT | {"seed": seed})) for seed in (5, 5, 6))
    assert np.array_equal(one.signals["accelerometer"].values, again.signals["accelerometer"].values)
    assert one.walker == again.walker != other.walker


def test_added_fixes_and_radios_leave_the_sensors_unchanged():
    """Each part has its own random generator, so that experiments differ in the stated part only."""
    plain = simulate(Scenario.of(SHORT))
    added = {"gnss": {}, "beacons": {"a": [1, 2]}, "fixes": {}, "wifi": {"access_points": 3}}
    more = simulate(Scenario.of(SHORT | added))
    for name, signal in plain.signals.items():
        assert np.array_equal(signal.values, more.signals[name].values)


@pytest.mark.parametrize(
    ("recorder", "platform", "sensors"),
    [
        ("sensor_logger", "android", ("accelerometer", "gyroscope", "magnetometer", "barometer")),
        ("sensor_logger", "ios", ("accelerometer", "gyroscope", "magnetometer", "barometer")),
        ("phyphox", "android", ("accelerometer", "gyroscope", "magnetometer", "barometer")),
        ("indoor_location", "android", ("accelerometer", "gyroscope", "magnetometer")),
    ],
)
def test_an_export_reads_back_as_simulated(tmp_path, recorder, platform, sensors):
    phone = {"rate": 50, "lost": 0, "repeated": 0}
    walk = simulate(Scenario.of(SHORT | {"recorder": recorder, "platform": platform, "phone": phone}))
    write(walk, tmp_path)
    recording = load(tmp_path / "walk.txt" if recorder == "indoor_location" else tmp_path)
    assert recording.epoch == pytest.approx(walk.scenario.start, abs=0.05)
    for name in sensors:
        simulated, read = walk.signals[name], recording.signals[name]
        offset = recording.epoch - walk.scenario.start
        expected = interpolate(read.time + offset, simulated.time, simulated.values)
        assert read.values[3:-3] == pytest.approx(expected[3:-3], abs=0.25 if name == "accelerometer" else 0.2)
        assert np.median(np.abs(read.values - expected)) < 0.01


def test_gnss_beacons_and_access_points_read_back(tmp_path):
    more = {"gnss": {"accuracy": 3}, "beacons": {"a": [6, 2]}, "wifi": {"access_points": 4}}
    walk = simulate(Scenario.of(SHORT | more))
    write(walk, tmp_path)
    recording = load(tmp_path)
    assert len(recording.fixes) == len(walk.gnss.fixes)
    assert len(recording.bluetooth.time) == len(walk.bluetooth.time)
    assert len(recording.wifi.time) == len(walk.wifi.time)
    table = np.loadtxt(tmp_path / "gnss.csv", delimiter=",", skiprows=1)
    assert table[:, 3:] == pytest.approx(np.column_stack([walk.gnss.accuracy, walk.gnss.hdop]), abs=0.006)


def test_the_files_beside_the_recording_have_the_truth(tmp_path):
    walk = simulate(Scenario.of(SHORT | {"fixes": {"period": 3, "sigma": 0.5}}))
    write(walk, tmp_path)
    recording = load(tmp_path)
    truth = read_trajectory(tmp_path / "truth.csv")
    assert truth.position[-1] == pytest.approx(walk.body.position[-1], abs=0.1)
    fixes = read_fixes(tmp_path / "fixes.csv", recording)
    assert fixes.position == pytest.approx(walk.user_fixes.position, abs=0.001)
    steps = np.loadtxt(tmp_path / "steps.csv", delimiter=",", skiprows=1)
    assert steps == pytest.approx(
        np.column_stack([walk.scenario.start + walk.body.landings, walk.body.lengths]), abs=0.001
    )
    assert (tmp_path / "events.csv").read_text().splitlines()[1:] == [
        f"{walk.scenario.start:.3f},{walk.scenario.start:.3f},hold,hand",
        f"{walk.scenario.start:.3f},{walk.scenario.start + 2.01:.3f},stand,",
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("route = [[0, 0], [9, 0]]\nspeed = 3", "speed: found an unknown name"),
        ("route = 3", "route: found 3"),
        ("seed = 1", "route: found None"),
        ("route = [[0, 0], [9, 0]]\n[phone]\nhold = 'ear'", "phone.hold: found 'ear', expected one of hand"),
        ("route = [[0, 0], [9, 0]]\n[phone]\nrate = 3", "phone.rate: found 3, expected 20 to 1000 Hz"),
        ("route = [[0, 0], [9, 0]]\n[phone]\nrate = 'fast'", "phone.rate: found 'fast', expected a number"),
        ("route = [[0, 0], [9, 0]]\n[walker]\nheight = 172", "walker.height: found 172, expected 0.5 to 2.5 m"),
        ("route = [[0, 0], {go = 3}]", "route, item 2: found {'go': 3}"),
        ("route = [[0, 0], {stand = 3, for = 4}]", "route, item 2: found an unknown name 'for'"),
        ("route = [[0, 0], {stand = -1}]", "route, item 2: found -1"),
        ("route = [[0, 0], [0.1, 0]]", "route, item 2: found a leg of less than 0.2 m"),
        ("route = [[0, 0], [nan, 0]]", "route, item 2: found"),
        ("route = [[0, 0], {stand = 90000}, {stand = 90000}]", "route: found about 18000000 samples"),
        ("route = [[0, 0], {visit = 'Books'}]", "route, item 2: found a visit to 'Books'"),
        ("route = [[0, 0], [9, 0]]\n[gnss]\nperiod = 0", "gnss.period: found 0"),
        ("route = [[0, 0], [9, 0]]\n[gnss]\noutages = [[1]]", "gnss.outages: found"),
        ("route = [[0, 0], [9, 0]]\n[phone]\nsensors = ['nose']", "phone.sensors: found 'nose', expected one of acc"),
        ("route = [[0, 0], [9, 0]]\n[wifi]\naccess_points = true", "wifi.access_points: found True"),
        ("route = [[0, 0], [9, 0]]\nstart = 'noon'", "start: found 'noon'"),
        ("route = [[0, 0], [9, 0]]\nplace = [200, 10]", "place: found"),
        ("route = [[0, 0", "Unclosed array"),
        ("plan = 'none.geojson'\nroute = [[0, 0], [9, 0]]", "none.geojson"),
    ],
)
def test_a_wrong_scenario_raises_one_line(tmp_path, text, message):
    path = tmp_path / "walk.toml"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        Scenario.load(path)
    assert message in str(error.value)
    assert str(error.value).isprintable()


def test_a_wrong_scenario_writes_no_folder(tmp_path):
    path = tmp_path / "walk.toml"
    path.write_text("route = 3")
    code, _, errors = run("simulate", path, "--out", tmp_path / "out")
    assert code == 2
    assert [line.endswith("expected a list: the start, then what the walker does") for line in errors] == [True]
    assert not (tmp_path / "out").exists()


def test_a_route_through_a_wall_raises():
    content = {"plan": str(ROOT / "maps" / "arcade.geojson"), "route": [[2.5, 18.0], [2.5, 60.0]]}
    with pytest.raises(InputError, match=r"route, item 2: found a leg from \(2.5, 18\) to \(2.5, 60\) through a wall"):
        Scenario.of(content)


@pytest.mark.parametrize("seed", [3, *(thorough(seed) for seed in (4, 5))])
def test_the_plan_does_not_make_correct_fixes_outliers(seed):
    """A fix of 2 m every 40 s. Initialised by fixes alone, a walk was led 15 m off by walls and a fix lost weight."""
    scenario = Scenario.load("mall")
    walk = simulate(replace(scenario, seed=seed, user_fixes=UserFixes(period=40, sigma=2.0)))
    floor = FloorPlan.load(ROOT / "maps" / "mall.geojson")
    steps = detect_steps(walk.recording("accelerometer", "gyroscope"))
    alone, mapped = (smooth(WalkGraph(steps, walk.user_fixes, floor=plan)) for plan in (None, floor))
    assert all(fix.weight > 0.3 for fix in mapped.fixes)
    error = [evaluate(found.trajectory, walk.truth)["ce"]["p50"] for found in (alone, mapped)]
    assert error[1] < min(error[0] + 0.1, 3.5)
