"""Steps of a phone's own counter are a motion of their own: in a table, in a GPX track, with few positions."""

import json

import numpy as np
import pytest
import recorders
import simulated
from commands import run

from pdr_graph import WalkGraph, detect_steps, load, smooth
from pdr_graph.estimation.gps_track import follow
from pdr_graph.frames import enu
from pdr_graph.gait.step_counter import counted_steps
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import interpolate
from pdr_graph.types import Fixes, Signal
from pdr_graph.walk import observe, read

CADENCE = 1.8  # [1/s]


def readings(every=2.5, duration=60.0, stand=(20.0, 35.0), before=4000):
    """What a counter says as often: a walker who stands for a while."""
    time = np.arange(0.0, duration + 0.1, every)
    walked = np.where(time < stand[0], time, np.where(time < stand[1], stand[0], time - np.ptp(stand)))
    return Signal(time, before + np.floor(CADENCE * walked)[:, None])


def test_steps_are_as_many_as_counted_and_none_while_standing():
    counter = readings()
    steps = counted_steps(counter, Walker(height=1.80))
    assert len(steps) == np.ptp(counter.values)
    assert not ((steps.time > 22.6) & (steps.time < 34.9)).any()
    assert steps.length == pytest.approx(0.26 * 1.80 + 0.31), "[calibration-walk] Eq. (6)"
    assert (steps.turn == 0).all()
    assert steps.sigma_turn.min() > 0.1


def test_a_counter_that_was_reset_or_woke_up_adds_no_step_that_nobody_made():
    reset = Signal(np.array([0.0, 10.0, 20.0, 30.0]), np.array([[900.0], [918.0], [3.0], [21.0]]))
    assert len(counted_steps(reset, Walker())) == 36
    woke = Signal(np.array([0.0, 1.0, 11.0]), np.array([[0.0], [900.0], [918.0]]))
    assert len(counted_steps(woke, Walker())) == 4 + 18, "at most four a second"
    assert counted_steps(Signal(np.arange(3.0), np.full((3, 1), 7.0)), Walker()) is None


@pytest.fixture(scope="module")
def walk():
    """A square of 20 m, which is walked in the sight of nothing but a counter."""
    return simulated.walk_along(np.array([[0.0, 0], [20, 0], [20, 20], [0, 20], [0, 0], [20, 0]]), seed=3)


@pytest.fixture(scope="module")
def counter(walk):
    """The landings as a counter says them, every 2.5 s."""
    time = np.append(np.arange(0.0, walk.time[-1], 2.5), walk.time[-1])
    return Signal(time, np.searchsorted(walk.landings, time, side="right")[:, None].astype(float))


@pytest.fixture(scope="module")
def fixes(walk):
    time = np.arange(1.0, walk.time[-1], 10.0)
    noise = np.random.default_rng(1).normal(0, 1, (len(time), 2))
    return Fixes(time, interpolate(time, walk.time, walk.position) + noise, np.ones(len(time)))


def test_counted_steps_between_positions_are_nearer_than_the_positions_alone(walk, counter, fixes):
    """A position every ten seconds: smoothed positions cut the corners."""
    at = np.arange(fixes.time[0], fixes.time[-1], 0.5)
    true, errors = interpolate(at, walk.time, walk.position), []
    for estimate in (smooth(WalkGraph(counted_steps(counter, Walker()), fixes)), follow(fixes)):
        track = estimate.trajectory
        errors.append(np.median(np.hypot(*(interpolate(at, track.time, track.position) - true).T)))
    assert errors[0] < 0.6 * errors[1]


def test_a_counter_alone_is_a_recording_and_its_track_keeps_the_steps(tmp_path, walk, counter, fixes):
    """By smooth, replay and steps; the GPX track that smooth writes is again a recording with these steps."""
    rows = zip(simulated.START + counter.time, counter.values[:, 0], strict=True)
    (tmp_path / "walk.csv").write_text("time,steps\n" + "".join(f"{t:.3f},{n:.0f}\n" for t, n in rows))
    places = enu(48.0, 11.0).to_lonlat(fixes.position)
    rows = zip(simulated.START + fixes.time, places, strict=True)
    lines = "".join(f"{t:.3f},{lat:.8f},{lon:.8f},1\n" for t, (lon, lat) in rows)
    (tmp_path / "fixes.csv").write_text("time,lat,lon,sigma\n" + lines)
    number = int(np.ptp(counter.values))
    for verb, out in (("smooth", "smoothed"), ("replay", "replayed")):
        assert run(verb, "walk.csv", "--fixes", "fixes.csv", "--no-report", "--out", out, cwd=tmp_path).code == 0
        summary = json.loads((tmp_path / out / "summary.json").read_text())
        assert summary["steps"] == number
        assert 0.8 * 100 < summary["distance"] < 1.2 * 100
    again = load(tmp_path / "smoothed" / "trajectory.gpx")
    assert np.ptp(again.step_counter.values) == number
    assert len(counted_steps(again.step_counter, Walker())) == number
    blind = run("smooth", "walk.csv", "--no-report", "--out", "blind", cwd=tmp_path)
    assert (blind.code, "turns: there is no gyroscope, or it stopped" in blind.errors[0]) == (3, True)
    run("steps", "walk.csv", "--out", "steps.csv", cwd=tmp_path)
    assert len((tmp_path / "steps.csv").read_text().splitlines()) == number + 1


def test_an_acceleration_is_preferred_to_the_counter(tmp_path):
    """SensorLog has both: steps are detected in the acceleration."""
    sampled = recorders.sample()
    (tmp_path / "walk.csv").write_text(recorders.sensor_log(sampled), encoding="utf-8")
    evidence = observe(read(tmp_path / "walk.csv"))
    assert evidence.walk.step_counter is not None
    assert np.ptp(np.diff(evidence.steps.time)) > 0.01
    assert len(evidence.steps) == len(detect_steps(evidence.walk))
