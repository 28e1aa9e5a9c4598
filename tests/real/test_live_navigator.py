"""Live, from end to end, on real recordings with surveyed truth or GNSS: about as good as the batch."""

from dataclasses import replace

import numpy as np
import pytest

from pdr_graph import FloorPlan, WalkGraph, detect_steps, smooth
from pdr_graph.io.loading import load
from pdr_graph.online.interface import Samples, events_of
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Fixes, Signal
from pdr_graph.walk import read

MINUTES = 2.5
WALKS = {"IPIN": "ipin2023_track3/*Trial01*.txt", "NJU": "nju_phyphox_outdoor"}


def beginning_of(given):
    """The first MINUTES of a walk with its fixes; the truth remains."""
    end = given.walk.accelerometer.time[0] + 60.0 * MINUTES
    signals = {
        name: Signal(signal.time[signal.time < end], signal.values[signal.time < end])
        for name, signal in given.walk.signals.items()
    }
    return replace(given, walk=replace(given.walk, **signals), fixes=given.fixes[given.fixes.time < end])


def distance(track, at, place):
    """Median distance of a track from places at some times. [m]"""
    known = (at >= track.time[0]) & (at <= track.time[-1])
    there = np.column_stack([np.interp(at[known], track.time, axis) for axis in track.position.T])
    return float(np.median(np.hypot(*(there - place[known]).T)))


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "lag"), [("IPIN", 60.0), ("NJU", None)])
def test_live_is_about_as_good_as_the_batch(data, name, lag):
    """Smoothed, by the truth where it was surveyed, else by the GNSS fixes; both without the compass or a plan.

    The first MINUTES of each.
    """
    given = beginning_of(read(sorted(data.glob(WALKS[name]))[0]))
    batch = smooth(WalkGraph(detect_steps(given.walk), given.fixes)).trajectory
    nav = Navigator(lag=lag, frame=given.frame)
    for n, event in enumerate(events_of(replace(given.walk, fixes=given.fixes, magnetometer=None))):
        nav.push(event)
        assert n % 50 or nav.pose is None or np.isfinite(nav.pose.covariance).all()
    track = nav.finish().trajectory
    told = given.frame.place(given.walk.truth) if given.walk.truth is not None else given.fixes
    live, whole = (distance(one, told.time, told.position) for one in (track, batch))
    print(f"{name}, lag {lag}: live {live:.2f} m, batch {whole:.2f} m, {nav.status.restarts} restarts")
    limit = 1.3 * whole + 0.3
    assert live < (limit if given.walk.truth is not None else max(limit, 2.0)), "GNSS is no truth: some metres off"


@pytest.mark.thorough
@pytest.mark.parametrize("name", WALKS)
@pytest.mark.parametrize("silent", ["accelerometer", "all sensors", "GNSS"])
def test_the_silence_of_a_source_is_named(data, name, silent):
    """From the end of the first minute on, for 45 s. The fixes carry the dot, with their region; none is refused."""
    given = beginning_of(read(sorted(data.glob(WALKS[name]))[0]))
    start = float(given.walk.accelerometer.time[0])
    last, end = start + 60.0, start + 105.0
    signals = {
        sensor: Signal(signal.time[early], signal.values[early])
        for sensor, signal in given.walk.signals.items()
        if (early := signal.time < (last if silent in (sensor, "all sensors") else end)).any()
    }
    told = given.fixes[given.fixes.time < (last if silent == "GNSS" else end)]
    nav, off = Navigator(frame=given.frame), []
    for event in events_of(replace(given.walk, **signals, fixes=told, bluetooth=None, wifi=None)):
        nav.push(event)
        if isinstance(event, Fixes) and event.time[-1] > last + 6.0:
            pose = nav.pose
            off.append(np.hypot(*(given.frame.place(event).position[-1] - (pose.x, pose.y))) / pose.sigma)
    [said] = [line for line in nav.status.issues if line.startswith(f"{silent}: silent for")]
    assert float(said.split("silent for ")[1].split()[0]) == pytest.approx(45.0, abs=4.0)
    assert not any("ride" in line or "clock" in line for line in nav.status.issues)
    assert nav.status.early == 0
    if silent != "GNSS":
        assert nav.status.state == "fixes alone"
        assert nav.pose.time > end - 4.0
        assert np.median(off) < 1.5


def test_the_pose_stands_where_its_first_fix_says(data):
    """Before the steps that it lies among are certain: a frame's origin may be far away, UTM's 6000 km."""
    walk = load(data / "ipin21_hcu" / "eight")
    floor = FloorPlan.load(data / "ipin21_hcu" / "map" / "Plan4OG.geojson")
    truth = floor.frame.place(walk.truth)
    first = Fixes(truth.time[:1], truth.position[:1], np.array([0.3]), ("",))
    nav, told = Navigator(frame=floor.frame), []
    for event in events_of(replace(walk, fixes=first)):
        nav.push(event)
        if isinstance(event, Samples) and (pose := nav.pose) is not None and pose.time > first.time[0]:
            told.append((pose.time, pose.x, pose.y))
            if pose.time > 20.0:
                break
    time, *place = np.array(told).T
    walked = 1.5 * (time - first.time[0])  # [m] nobody walks faster in an office
    assert (np.hypot(*(np.array(place).T - first.position[0]).T) < walked + 5.0).all()
