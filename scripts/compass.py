"""Absolute directions: what the compass says of real walks, where gait says ahead is, and re-holds put into walks."""

from functools import partial
from itertools import product

import numpy as np
from heading import HOLDS, walked
from tables import publish, table

from pdr_graph import detect_steps, magnetic_headings
from pdr_graph.frames import enu
from pdr_graph.gait.compass import LiveCompass
from pdr_graph.gait.heading import braking_axis, forward_axis, reading_axis, walking_direction
from pdr_graph.gait.step_stream import StepStream
from pdr_graph.gait.steps import gait_signals
from pdr_graph.geometry import wrap_angle
from pdr_graph.inertial.attitude import attitude_of
from pdr_graph.io.loading import load
from pdr_graph.lab.papers.gait_methods import principal_axis
from pdr_graph.lab.simulation.carrying import with_grip_change
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.online.interface import Samples, events_of

HANGZHOU = (30.3, 120.2)  # [deg] about where the Microsoft walks are, for their field
NEAR = 60.0  # [s] of the walk before and after a heading that it is compared with
AXES = {
    "principal component, signed by the step pattern": principal_axis,
    "what brakes the walker": braking_axis,
    "the y axis of a phone that is read": reading_axis,
    "**both, our default**": forward_axis,
}
LIVE_WALKS, EARLY = 12, 45.0  # per hold; [s] since the first step
SENSORS = ("accelerometer", "gyroscope", "magnetometer")
ROUGHLY = 40  # [deg]
SHARES, TURN = (0.3, 0.4, 0.5, 0.6, 0.7), np.pi / 2  # of the walk; [rad]


def recordings(data):
    """Groups of hand-held walks, by name."""
    return {
        "Microsoft": sorted((data / "ms_indoor20").glob("site*/*/*.txt")),
        "IPIN 2023": sorted((data / "ipin2023_track3").glob("*Trial*.txt")),
        "NJU campus": [data / "nju_phyphox_outdoor"],
    }


def compass(data):
    """The tables."""
    groups = recordings(data)
    rows = []
    for name, paths in groups.items():
        errors, sigmas = np.concatenate([heading_errors(path) for path in paths], axis=1)
        size = np.degrees(np.abs(errors))
        stated = f"{np.degrees(sigmas.min()):.0f}–{np.degrees(sigmas.max()):.0f}"
        cells = [f"{np.median(size):.0f}", f"{size.max():.0f}", stated]
        rows.append([name, len(paths), len(size), *cells, f"{np.sqrt(np.mean((errors / sigmas) ** 2)):.2f}"])
    header = ["walks", "", "headings", "error [deg]: median", "largest", "stated sigma [deg]", "rms error / sigma"]
    publish("results/compass.md", "compass", table(header, rows))
    live(groups)
    ahead([path for paths in groups.values() for path in paths])
    reheld([path for paths in groups.values() for path in paths])
    put_away()


def heading_errors(path):
    """Errors and sigmas of a walk's headings [rad]."""
    walk, frame, truth = with_truth(path)
    gaits = gait_signals(walk)
    headings = magnetic_headings(gaits, frame, np.zeros(2))
    return np.array([errors_of(headings.time, headings.heading, detect_steps(gaits), truth), headings.sigma])


def with_truth(path):
    """A recording, the frame of its truth, and the truth in it."""
    walk = load(path)
    truth = walk.truth if walk.truth is not None else walk.fixes[::12]
    frame = enu(*(truth.position[0][::-1] if truth.epsg else HANGZHOU))
    return walk, frame, frame.place(truth)


def errors_of(times, headings, steps, truth):
    """Errors of headings [rad]: the walked way, turned as they say, against the truth."""
    heading = np.cumsum(steps.turn)
    way, errors = np.cumsum(steps.length * np.exp(1j * (heading - steps.turn / 2))), []
    for time, said in zip(times, headings, strict=True):
        near = np.abs(truth.time - time) < NEAR
        walked_, true = np.diff(np.interp(truth.time[near], steps.time, way)), np.diff(truth.position[near] @ [1, 1j])
        turned = np.angle(np.sum(true * walked_.conj()))
        since_start = np.interp(time, [steps.start, *steps.time], [0.0, *heading])
        errors.append(wrap_angle(said - since_start - turned))
    return np.array(errors)


def live(groups):
    """The first headings of the live compass: when, and how honest, on real walks and simulated ones in five holds."""
    rows = [live_row(name, [live_recorded(path) for path in paths]) for name, paths in groups.items()]
    rows += [
        live_row(f"simulated, {hold}", [live_simulated(hold, seed) for seed in range(LIVE_WALKS)]) for hold in HOLDS
    ]
    first = [
        "first heading after [s]: median",
        "90 %",
        "error [deg]: median",
        "largest",
        "sigma: median",
        "rms error / sigma",
    ]
    early = ["headings of the first 45 s", "error: largest [deg]", "rms error / sigma", "beyond 2 sigma"]
    publish("results/compass.md", "live compass", table(["walks", "", "with a heading", *first, *early], rows))


def live_row(name, walks):
    """A row of the table from the headings of each walk: seconds since the first step, error and sigma [rad]."""
    first, early = np.array([walk[0] for walk in walks if len(walk)]), np.concatenate(walks)
    early = early[early[:, 0] < EARLY]
    error, z = np.degrees(np.abs(first[:, 1])), first[:, 1] / first[:, 2]
    later = early[:, 1] / early[:, 2]
    when = [f"{np.percentile(first[:, 0], share):.0f}" for share in (50, 90)]
    cells = [f"{np.median(error):.0f}", f"{error.max():.0f}", f"{np.degrees(np.median(first[:, 2])):.0f}"]
    largest = f"{np.degrees(np.abs(early[:, 1]).max()):.0f}"
    honest = [f"{np.sqrt(np.mean(later**2)):.2f}", f"{100 * np.mean(np.abs(later) > 2):.0f} %"]
    return [name, len(walks), len(first), *when, *cells, f"{np.sqrt(np.mean(z**2)):.2f}", len(early), largest, *honest]


def live_headings(recording, frame):
    """The headings as they are reported: moment of the report [s], time [s], heading and sigma [rad]."""
    compass, found = LiveCompass(), []
    compass.locate(frame, np.zeros(2), recording.epoch)
    gait = StepStream(listener=compass.update, preview=compass.preview)
    for event in events_of(recording):
        if isinstance(event, Samples):
            push = compass.push if event.sensor == "magnetometer" else partial(gait.push, event.sensor)
            push(event.time, event.values)
            gait.advance()
            found += [(event.time[-1], one.time, one.heading, one.sigma) for one in compass.advance()]
    return np.array([row for row in found if np.isfinite(row[3])]).reshape(-1, 4)


def live_recorded(path):
    """Of a real walk: seconds since the first step, error and sigma of each heading."""
    walk, frame, truth = with_truth(path)
    (moment, time, heading, sigma), steps = live_headings(walk, frame).T, detect_steps(walk)
    start = steps.time[0] - steps.duration[0]
    return np.column_stack([moment - start, errors_of(time, heading, steps, truth), sigma])


def live_simulated(hold, seed):
    """The same of a simulated walk: 110 m with two corners, after three seconds of standing."""
    route = [[0, 0], {"stand": 3}, {"to": [[40, 0], [40, 30], [0, 30]]}]
    walk = simulate(Scenario.of({"seed": seed, "route": route, "phone": {"hold": hold, "rate": 50}}))
    moment, time, heading, sigma = live_headings(walk.recording(*SENSORS), walk.frame).T
    error = wrap_angle(heading - np.interp(time, walk.body.time, walk.body.heading))
    return np.column_stack([moment - 3, error, sigma])


def ahead(paths):
    """Where each method says is ahead: simulated walks in five holds, and real ones against the phone's y axis."""
    found = {name: [[] for _ in (*HOLDS, "real")] for name in AXES}
    for column, hold in enumerate(HOLDS):
        for seed in range(10):
            walk = walked(hold, seed)
            gait = seen(walk.recording("accelerometer", "gyroscope"))
            wanted = true_ahead(walk, *gait[:3])
            for name, method in AXES.items():
                found[name][column].append(difference(method(*gait), wanted))
    for path in paths:
        gait = seen(load(path))
        wanted = reading_axis(*gait).angle
        for name, method in AXES.items():
            found[name][-1].append(difference(method(*gait), wanted))
    rows = [[name, *(cell(np.array(errors)) for errors in columns)] for name, columns in found.items()]
    publish("results/compass.md", "ahead", table(["median error [deg] (silent)", *HOLDS, "real hands, to y"], rows))


def seen(recording):
    """Attitude, heading, when they walk, and the duration of a step, of a recording's first part."""
    gait = gait_signals(recording)[0]
    return gait.attitude, gait.direction.heading, gait.walking, gait.landings.usual_step


def true_ahead(walk, attitude, heading, walking):
    """The angle that is to be found, from the simulation's truth."""
    truth = np.interp(attitude.time, walk.body.time, walk.body.heading)
    east = walk.world_of(attitude).apply([1.0, 0.0, 0.0]) @ [1, 1j, 0]
    return float(np.angle(np.mean((east * np.exp(1j * (truth - heading)))[walking])))


def difference(forward, wanted):
    """[deg], NaN where nothing was said."""
    return np.degrees(np.abs(wrap_angle(forward.angle - wanted))) if forward.determined else np.nan


def cell(errors):
    silent = int(np.isnan(errors).sum())
    if silent == len(errors):
        return "—"
    return f"{np.nanmedian(errors):.0f}" + (f" ({silent} of {len(errors)})" if silent else "")


def reheld(paths):
    """Real walks in which the phone is turned by a quarter in the hand: is that a turn of the walker?"""
    told, tried, errors = 0, 0, []
    for path in paths:
        gait = gait_signals(load(path))[0]
        recording, attitude, heading = gait.recording, gait.attitude, gait.direction.heading
        landed, step = gait.landings.time, gait.landings.usual_step
        if len(landed) < 60:
            continue
        for share in SHARES:
            for angle in (TURN, -TURN):
                begin = float(landed[int(len(landed) * share)])
                up = attitude.R_world_device[int(np.searchsorted(attitude.time, begin))].inv().apply([0.0, 0.0, 1.0])
                turned = with_grip_change(recording, up, begin, angle)
                direction = walking_direction(attitude_of(turned), step)
                gained = (direction.heading[-1] - direction.heading[0]) - (heading[-1] - heading[0])
                error = np.degrees(abs(gained))
                tried += 1
                if error < 60:
                    told += 1
                    errors.append(error)
    rows = [[tried, told, f"{np.median(errors):.0f}", f"{max(errors):.0f}"]]
    header = ["re-holds put in", "detected as grip changes", "error [deg]: median", "largest"]
    publish("results/compass.md", "reheld", table(header, rows))


def put_away():
    """Simulated walks in which the phone goes from any hold to any other, and the walker goes on, aside or back."""
    rows = []
    for name, angle, onwards in (("straight on", 0, [50, 0]), ("aside", 90, [25, 25]), ("back", 180, [0, 0])):
        errors = [turn_error(*case, angle, onwards) for case in product(HOLDS, HOLDS, range(3)) if case[0] != case[1]]
        within = f"{100 * np.mean(np.array(errors) < ROUGHLY):.0f} %"
        rows.append([name, len(errors), f"{np.median(errors):.0f}", f"{np.percentile(errors, 90):.0f}", within])
    header = ["the walker goes on", "walks", "error [deg]: median", "90 %", f"within {ROUGHLY}°"]
    publish("results/compass.md", "put away", table(header, rows))


def turn_error(before, after, seed, angle, onwards):
    """Of the whole turn of a walk [deg]: 25 m, standing, turning on the spot, taking the phone otherwise, 25 m."""
    standing = {"stand": 1, "turn": angle} if angle else {"stand": 1}
    route = [[0, 0], {"stand": 2}, {"to": [[25, 0]]}, standing, {"hold": after}, {"to": [onwards]}, {"stand": 2}]
    walk = simulate(Scenario.of({"seed": seed, "route": route, "phone": {"hold": before, "rate": 50}}))
    attitude = attitude_of(walk.recording("accelerometer", "gyroscope"))
    heading = walking_direction(attitude, 1 / walk.walker.cadence).heading
    truth = np.interp(attitude.time, walk.body.time, walk.body.heading)
    return np.degrees(abs(wrap_angle(heading[-1] - heading[0] - truth[-1] + truth[0])))
