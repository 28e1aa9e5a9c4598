"""The public surface: what it promises by name and signature, what each name gives, and what it says of a mistake."""

import ast
import inspect
import re
import subprocess
import sys
from dataclasses import is_dataclass, replace
from enum import EnumType
from pathlib import Path
from types import SimpleNamespace
from typing import get_type_hints

import numpy as np
import pytest
from matplotlib.figure import Figure

import pdr_graph as pdr

# What other people's programs may rely on: a change here is a change for them, and belongs into CHANGELOG.md
PROMISED = """
Building(floors)
Calibration(start, value, covariance, prior_sigma, usual=)
Contradiction(source, against, amount, unit, text, check, state=)
Estimate(trajectory, dead_reckoning, calibration, reports, iterations, cost, converged, probability=, warnings=, \
contradictions=, routes=, placed=, assumed=, graph=)
Event
FactorBlock(name, residual, row_of, variables, jacobian, number, rows_each=, loss=, most_rows=, prior=, \
curvature=, native=, constants=)
Fixes(time, position, sigma, floor=, epsg=, source=, speed=, course=, speed_sigma=, course_sigma=)
FloorPlan(label, areas, frame, notes=, repairs=, height=)
Frame(kind=, origin=, epsg=, metres_per_degree=)
Headings(time, heading, sigma, source=)
InputError(source, place, found, expected)
Journal(path, log, make)
KEYFRAME
LONLAT
Measurement()
Mode(probability, x, y, heading, covariance)
Navigator(floor=, *, lag=, walker=, frame=, prior=, beacons=, radio_map=, paths=, start_floor=, start_heading=, \
start_heading_sigma=, epoch=, platform=, executor=)
PathNetwork(lines, classes, notes=, frame=, target=, building=, area=)
Pose(time, x, y, heading, floor, covariance, modes=, display=, placed=)
Prior(mean=, sigma=, change=, correlation=, wall_margin=, wall_sigma=, corridors=, another=, usual=)
ROW
Recording(source, clock_origin, epoch, accelerometer=, gyroscope=, magnetometer=, linear_acceleration=, barometer=, \
fixes=, bluetooth=, wifi=, beacons=, truth=, measurements=, notes=, step_counter=, sign_odds=)
Samples(sensor, time, values)
Scan(radio, heard)
Scenario(name, route, seed=, start=, recorder=, platform=, place=, plan=, plans=, walker=, phone=, gnss=, user_fixes=, \
beacons=, access_points=)
Sensor(accelerometer, gyroscope, magnetometer, linear_acceleration, barometer)
Sightings(time, transmitter, rssi, minor=)
Signal(time, values)
Status(state, sigma, missing, issues, unknown, sensors, keyframes, fixes, late, early, restarts, updates, \
rebuilds, judge)
Steps(start, end, time, duration, length, turn, pause_turn, sigma_length, sigma_turn, final_turn=, unknown=, \
stepless=, missing=, confidence=)
TABLE
Trajectory(time, position, heading, floor=, covariance=, epsg=)
Verdict(state, reasons=)
WalkGraph(steps, fixes=, *, headings=, floor=, floors=, levels=, closures=, measurements=, paths=, prior=, others=)
Walker(height=, sigma_turn=, stride=, constants=, profile=)
dead_reckon(steps, start=, heading=)
detect_steps(recording, walker=)
evaluate(estimate, truth, floor=, pairing=)
events_of(recording, packet=)
floors_of(steps, barometer, start, fixes, building)
frame_of(fixes)
kalman_filter(graph)
kalman_smoother(graph)
load(path, gnss_latency=)
magnetic_headings(recording, frame, near)
plot(estimate, floor=, truth=, title=, paths=)
read_fixes(path, recording, frame=, notes=)
read_trajectory(path, recording=, geodetic=)
register(data_type, kinds)
simulate(scenario)
smooth(graph)
verdict(estimate)
"""


CONSTANTS = {
    "Event",
    "KEYFRAME",
    "LONLAT",
    "ROW",
    "TABLE",
}  # a type alias, a number, declarations of fields: they have no parameters, nor a place of their own


def spelt(name):
    """A public name with its parameters, those with a default have a ``=``; an enumeration with its values."""
    public = getattr(pdr, name)
    if name in CONSTANTS:
        return name
    if isinstance(public, EnumType):
        return f"{name}({', '.join(public)})"
    said, keyword = [], False
    for parameter in inspect.signature(public).parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY and not keyword:
            said, keyword = [*said, "*"], True
        said.append(parameter.name + "=" * (parameter.default is not parameter.empty))
    return f"{name}({', '.join(said)})"


def test_the_public_surface_is_what_was_promised():
    assert [spelt(name) for name in sorted(pdr.__all__)] == PROMISED.split("\n")[1:-1]


def test_names_load_when_first_used():
    """The package and its command line, for which ``--help`` waits, import no array library."""
    slow = "{'numpy', 'gtsam', 'scipy', 'shapely', 'matplotlib'}"
    code = f"import sys, pdr_graph.apps.cli; assert not {slow} & set(sys.modules), {slow} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
    with pytest.raises(AttributeError, match="smoothe"):
        _ = pdr.smoothe


def test_a_type_checker_sees_each_name_where_it_is():
    """The stub is the one list: what it imports is what is there, and nothing is defined twice."""
    stub = ast.parse(Path(pdr.__file__).with_suffix(".pyi").read_text())
    listed = [(node.module, alias) for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names]
    assert sorted(alias.name for _, alias in listed) == sorted(pdr.__all__)
    assert all(alias.asname == alias.name for _, alias in listed), "or it would not be exported"
    for module, alias in listed:
        where = f"pdr_graph.{module}"
        assert alias.name in CONSTANTS or getattr(pdr, alias.name).__module__ == where
        assert hasattr(sys.modules[where], alias.name)
    assert Path(pdr.__file__).with_name("py.typed").exists()


def test_help_names_everything_there_is():
    """`help(pdr_graph)` begins with each public name, and each explains its parameters."""
    words = set(re.findall(r"\w+", pdr.__doc__ or ""))
    assert set(pdr.__all__) <= words
    for name in set(pdr.__all__) - CONSTANTS - {"Sensor"}:
        public = getattr(pdr, name)
        told = set(re.findall(r"\w+", inspect.getdoc(public) or ""))
        if name != "Journal":  # made by `Journal.open`
            assert set(inspect.signature(public).parameters) - {"path"} <= told, name


def test_the_version_is_that_of_the_citation():
    """The package's is the distribution's, which does not say it again."""
    root = Path(__file__).parent.parent
    assert re.fullmatch(r"\d+\.\d+\.\d+", pdr.__version__)
    assert pdr.__version__ not in (root / "pyproject.toml").read_text()
    assert set(re.findall(r"^ *version: (.*)$", (root / "CITATION.cff").read_text(), re.M)) == {pdr.__version__}


@pytest.fixture(scope="module")
def given(arcade_walk):
    """Arguments by the name of the parameter that takes them, of a short simulated walk."""
    recording, plan = pdr.load(arcade_walk), pdr.FloorPlan.load(arcade_walk / "plan.geojson")
    fixes = pdr.read_fixes(arcade_walk / "fixes.csv", recording, plan.frame)
    steps = pdr.detect_steps(recording)
    graph = pdr.WalkGraph(steps, fixes)
    return SimpleNamespace(
        scenario=pdr.Scenario.load("arcade"),
        recording=recording,
        frame=plan.frame,
        fixes=fixes,
        near=fixes.position[0],
        steps=steps,
        graph=graph,
        estimate=pdr.smooth(graph),
        truth=pdr.read_trajectory(arcade_walk / "truth.csv", recording),
        path=arcade_walk,
    )


RETURNS = {
    "dead_reckon": pdr.Trajectory,
    "detect_steps": pdr.Steps,
    "frame_of": pdr.Frame,
    "kalman_filter": pdr.Estimate,
    "kalman_smoother": pdr.Estimate,
    "load": pdr.Recording,
    "magnetic_headings": pdr.Headings,
    "smooth": pdr.Estimate,
    "plot": Figure,
    "verdict": pdr.Verdict,
}


@pytest.mark.parametrize("name", RETURNS)
def test_each_verb_returns_the_noun_that_its_signature_names(given, name):
    verb = getattr(pdr, name)
    required = [p.name for p in inspect.signature(verb).parameters.values() if p.default is p.empty]
    assert get_type_hints(verb)["return"] is RETURNS[name]
    assert isinstance(verb(*(getattr(given, parameter) for parameter in required)), RETURNS[name])


def test_an_estimate_is_scored_in_the_clock_of_the_recording(given):
    """Truth read with its recording has the estimate's times; the fixes err by 1 m along each axis."""
    scores = pdr.evaluate(given.estimate.trajectory, given.truth)
    assert scores["n"] == len(given.truth) > 200
    assert scores["ce"]["p50"] < 1.5
    own = pdr.read_trajectory(given.path / "truth.csv")
    assert own.time - given.truth.time == pytest.approx(given.recording.clock_origin)


def test_live_events_make_a_pose_and_nouns_are_frozen(given):
    nav = pdr.Navigator()
    for event in (e for e in pdr.events_of(given.recording) if isinstance(e, pdr.Samples) and e.time[0] < 20):
        nav.push(event)
    assert isinstance(nav.pose, pdr.Pose)
    assert isinstance(nav.finish(), pdr.Estimate)
    nouns = [getattr(pdr, name) for name in pdr.__all__ if is_dataclass(getattr(pdr, name))]
    assert len(nouns) > 10
    assert all(noun.__dataclass_params__.frozen for noun in nouns)


def test_lists_and_single_values_will_do_for_columns():
    """Who types three fixes by hand need not know numpy; one sample, fix or reception is an array of one row."""
    fixes = pdr.Fixes([0, 10], [[0, 0], [10, 5]], [1, 2])
    assert fixes.time.dtype == fixes.position.dtype == np.float64
    assert fixes.floor == ("", "")
    one = pdr.Samples(pdr.Sensor.ACCELEROMETER, 0.01, (0, 0, 9.8))
    assert (one.sensor, one.time.tolist(), one.values.tolist()) == ("accelerometer", [0.01], [[0.0, 0.0, 9.8]])
    assert pdr.Samples("barometer", 3, 1013.2).values.tolist() == [[1013.2]]
    fix = pdr.Fixes(3, (1, 2), 1.5, floor="F1", source="gnss")
    assert (len(fix), fix.position.tolist(), fix.floor, fix.source) == (1, [[1.0, 2.0]], ("F1",), ("gnss",))
    assert len(pdr.Headings(3, 0.5, 0.1)) == 1
    heard = pdr.Scan("wifi", pdr.Sightings(3, "aa:bb", -60)).heard
    assert (heard.transmitter, heard.rssi.tolist()) == (("aa:bb",), [-60.0])


def test_a_walk_pushed_sample_by_sample_is_that_of_packets(given):
    """Scalars as an app's callbacks have them; the steps do not depend on how the samples are packed."""
    navs = pdr.Navigator(), pdr.Navigator()
    for event in pdr.events_of(given.recording):
        if isinstance(event, pdr.Samples) and event.time[0] < 20:
            navs[0].push(event)
            for time, values in zip(event.time.tolist(), event.values.tolist(), strict=True):
                navs[1].push(pdr.Samples(pdr.Sensor(event.sensor), time, values))
    assert navs[0].steps == navs[1].steps > 15
    assert navs[1].pose.x == pytest.approx(navs[0].pose.x, abs=0.5)


def test_a_sensor_is_its_name():
    """An enumeration for those who like to have names completed; texts will do."""
    assert pdr.Sensor.GYROSCOPE == f"{pdr.Sensor.GYROSCOPE}" == "gyroscope"
    assert pdr.Sensor("gyroscope") is pdr.Sensor.GYROSCOPE


MISTAKES = [
    ("found Steps, expected WalkGraph", lambda g: pdr.smooth(g.steps)),
    ("found Steps, expected WalkGraph", lambda g: pdr.kalman_filter(g.steps)),
    ("found Recording, expected Steps", lambda g: pdr.WalkGraph(g.recording, g.fixes)),
    ("found Fixes, expected Steps", lambda g: pdr.WalkGraph(g.fixes, g.steps)),
    ("found ndarray, expected Fixes", lambda g: pdr.WalkGraph(g.steps, g.fixes.position)),
    ("found str 'plan.geojson', expected", lambda g: pdr.WalkGraph(g.steps, floor="plan.geojson")),
    (
        "found those of EPSG:4326, expected metres",
        lambda g: pdr.WalkGraph(g.steps, replace(g.fixes, epsg=4326, position=g.frame.to_lonlat(g.fixes.position))),
    ),
    ("found str 'walk.zip', expected Recording", lambda g: pdr.detect_steps("walk.zip")),
    ("found float 1.72, expected Walker", lambda g: pdr.detect_steps(g.recording, 1.72)),
    ("found 172, expected metres", lambda g: pdr.Walker(height=172)),
    ("found 'long', expected one of", lambda g: pdr.Walker(stride="long")),
    ("found 90, expected radians", lambda g: pdr.dead_reckon(g.steps, heading=90)),
    ("found 90.0, expected radians", lambda g: pdr.Headings([1], [90], [5])),
    ("found row 1: nan, expected", lambda g: pdr.Fixes([0, np.nan], [[0, 0], [1, 1]], [1, 1])),
    ("found float, expected an array", lambda g: pdr.Fixes([0], [[0, 0]], 1.0)),
    ("found shape (1, 3), expected (n, 2)", lambda g: pdr.Fixes([0], [[0, 0, 0]], [1])),
    ("expected times that increase", lambda g: replace(g.steps, time=g.steps.time[::-1])),
    ("expected (n,) and (n, 3)", lambda g: pdr.Signal(np.arange(3.0), np.zeros((2, 3)))),
    ("found shapes (3, 2) and (2,) at", lambda g: pdr.Trajectory(np.arange(3.0), np.zeros((3, 2)), np.zeros(2))),
    ("found ndarray, expected Signal", lambda g: pdr.Recording("mine", 0.0, None, accelerometer=np.zeros((9, 3)))),
    ("found Estimate, expected Trajectory, as of smooth(graph)", lambda g: pdr.evaluate(g.estimate, g.truth)),
    ("found None, expected Trajectory", lambda g: pdr.evaluate(g.estimate.trajectory, None)),
    (
        "expected the same clock",
        lambda g: pdr.evaluate(g.estimate.trajectory, pdr.read_trajectory(g.path / "truth.csv")),
    ),
    ("found Trajectory, expected Estimate", lambda g: pdr.plot(g.truth)),
    (
        "found FloorPlan, expected Frame",
        lambda g: pdr.read_fixes(g.path / "fixes.csv", g.recording, pdr.FloorPlan.load(g.path / "plan.geojson")),
    ),
    ("expected a floor plan, a file", lambda g: pdr.FloorPlan.load(Path(__file__).parent)),
    ("found a text with the header time,x,y,sigma,floor", lambda g: pdr.FloorPlan.load(g.path / "fixes.csv")),
    ("found no such file, expected a table", lambda g: pdr.read_fixes("nowhere.csv", g.recording)),
    ("found Recording, expected Samples", lambda g: pdr.Navigator().push(g.recording)),
    (
        "Samples.sensor: found 'acc' (accelerometer?), expected one of accelerometer, gyroscope, magnetometer",
        lambda g: pdr.Navigator().push(pdr.Samples("acc", 0.01, (0, 0, 9.8))),
    ),
    (
        "found shape (2, 1) at 2 times, expected (2, 3)",
        lambda g: pdr.Navigator().push(pdr.Samples("gyroscope", np.zeros(2), np.zeros((2, 1)))),
    ),
    ("expected FloorPlan or Building or None", lambda g: pdr.Navigator("plan.geojson")),
    ("Navigator.push, event: found float 1.0, expected", lambda g: pdr.Navigator().push(1.0)),
    ("found 'Acceleration' (accelerometer?), expected one of acc", lambda g: pdr.Sensor("Acceleration")),
    ("found 0, expected seconds above 0", lambda g: pdr.Navigator(lag=0)),
    ('as of Scenario.load("arcade")', lambda g: pdr.simulate("arcade")),
    ("one of arcade, campus", lambda g: pdr.Scenario.load("atlantis")),
    ("found a local frame, expected", lambda g: pdr.Frame().to_lonlat(np.zeros((1, 2)))),
    ("found (0, 0, 0), expected standard deviations", lambda g: pdr.Prior(sigma=(0, 0, 0))),
]


@pytest.mark.parametrize(("said", "make"), MISTAKES, ids=[said for said, _ in MISTAKES])
def test_a_mistake_is_one_line_with_what_was_found_and_expected(given, said, make):
    """Every slip of a first hour: never an error from the depths, never a wrong result in silence."""
    with pytest.raises((TypeError, ValueError), match=re.escape(said)) as caught:
        make(given)
    message = str(caught.value)
    assert "found " in message
    assert "expected " in message
    assert "\n" not in message
