"""The navigator on simulated recordings: as good as the batch, and robust to any events."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tiers import thorough
from walks import distances

from pdr_graph import FloorPlan, WalkGraph, detect_steps, smooth
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.online.interface import Samples, Scan, events_of
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import LONLAT, Fixes, Recording, Sightings, Signal

JUMP = 3600.0  # [s]
END = 80.0  # [s] of a walk


def until(end, signal):
    early = signal.time < end
    return Signal(signal.time[early], signal.values[early])


@cache
def walk(name):
    """A scenario of at most 80 s as its phone recorded it, a fix of 1 m each ten seconds, and its truth."""
    simulation = simulate(Scenario.load(name))
    signals = {sensor: until(END, simulation.signals[sensor]) for sensor in ("accelerometer", "gyroscope")}
    at = np.arange(1.0, min(END, simulation.truth.time[-1]) - 1.0, 10.0)
    place = np.column_stack([np.interp(at, simulation.truth.time, axis) for axis in simulation.truth.position.T])
    place += np.random.default_rng(1).normal(0, 1.0, place.shape)
    fixes = Fixes(at, place, np.ones(len(at)), ("",) * len(at))
    return Recording(name, 0.0, None, **signals, fixes=fixes), simulation.truth


@cache
def events(name="figure_eight"):
    return tuple(events_of(walk(name)[0]))


def when(event):
    return float((event.heard if isinstance(event, Scan) else event).time[-1])


def later(event, seconds):
    """The same by a clock that is so much ahead."""
    return replace(event, time=event.time + seconds)


def pushed(given, **options):
    """A navigator that was told all this; its pose and status are looked at every so often, and always finite."""
    nav, issues = Navigator(**options), set()
    for n, event in enumerate(given):
        nav.push(event)
        if n % 20 == 0 or not isinstance(event, Samples):
            pose = nav.pose
            assert pose is None or np.isfinite([pose.time, pose.x, pose.y, pose.heading]).all()
            assert pose is None or np.isfinite(pose.covariance).all()
            issues |= set(nav.status.issues)
    return nav, issues


def checked(given, **options):
    """What it was told of, and the walk that came of it."""
    nav, issues = pushed(given, **options)
    track = nav.finish().trajectory
    assert np.isfinite(track.position).all()
    assert np.isfinite(track.covariance).all()
    assert (np.diff(track.time) > 0).all()
    return nav, issues, track


@cache
def in_order():
    """The navigator, its issues and its track after the usual walk."""
    return checked(events())


def error(track, truth):
    """Median distance from the truth, where there is one. [m]"""
    inside = (track.time >= truth.time[0]) & (track.time <= truth.time[-1])
    return float(np.median(distances(track, truth)[inside]))


@pytest.mark.parametrize(
    ("name", "lag"), [("arcade", 30.0), ("figure_eight", None), thorough("loop", 30.0), thorough("arcade", None)]
)
def test_live_is_as_good_as_the_batch(name, lag):
    """The smoothed walk: at most 1.3 times the error of the batch plus 0.3 m, since finalised rows lack later data."""
    recording, truth = walk(name)
    batch = smooth(WalkGraph(detect_steps(recording), recording.fixes)).trajectory
    nav, _, track = checked(events(name), lag=lag)
    assert error(track, truth) < 1.3 * error(batch, truth) + 0.3
    assert nav.status.state == "running"
    assert nav.status.fixes == len(recording.fixes)
    assert abs(len(track) - len(batch)) < 4


@pytest.mark.parametrize("sensors", [("gyroscope",), ("accelerometer", "gyroscope"), thorough(("accelerometer",))])
def test_a_sensor_that_stops_and_returns(sensors):
    """For 20 s: the status tells it of one that the other outlives, and the walk is found again."""
    truth = walk("figure_eight")[1]
    silent = [e for e in events() if not (isinstance(e, Samples) and e.sensor in sensors and 40 < when(e) < 60)]
    nav, issues, track = checked(silent)
    assert len(sensors) == 2 or any(line.startswith(f"{sensors[0]}: silent for") for line in issues)
    assert not any("silent" in line for line in nav.status.issues), "not any more"
    assert error(track, truth) < 3.0


SENSORS = ("accelerometer", "gyroscope", "magnetometer")
SILENCES = {  # what falls silent: how the issue begins that names it, the state
    SENSORS: ("all sensors: silent for", "fixes alone"),
    ("accelerometer",): ("accelerometer: silent for", "fixes alone"),
    ("gyroscope",): ("gyroscope: silent for", "running"),
    ("magnetometer",): ("magnetometer: silent for", "running"),
    ("GNSS",): ("GNSS: silent for", "running"),
}


@pytest.mark.parametrize("sources", [SENSORS, ("GNSS",), *map(thorough, [*SILENCES][1:-1])], ids=" ".join)
def test_what_falls_silent_is_named_and_nothing_else_is_blamed(sources):
    """For the last 20 s of a walk with a fix a second: no clock, no ride. Fixes alone carry the dot."""
    last = END - 20.0
    simulation = simulate(replace(Scenario.load("figure_eight"), seed=1))
    at = np.arange(0.0, END, 1.0)
    place = np.column_stack([np.interp(at, simulation.truth.time, axis) for axis in simulation.truth.position.T])
    fixes = Fixes(at, place, np.full(len(at), 3.0), source=("GNSS",) * len(at))
    signals = {name: until(last if name in sources else END, simulation.signals[name]) for name in SENSORS}
    recording = Recording("walk", 0.0, None, **signals, fixes=fixes[at < last] if "GNSS" in sources else fixes)
    nav, _ = pushed(events_of(recording))
    line, state = SILENCES[sources]
    assert nav.status.state == state
    [said] = [issue for issue in nav.status.issues if issue.startswith(line)]
    assert float(said.removeprefix(line).split()[0]) == pytest.approx(20.0, abs=1.5)
    blamed = [issue.partition(":")[0] for issue in nav.status.issues if "came twice" not in issue]
    assert set(blamed) <= {"all sensors", *sources}, nav.status.issues
    assert (nav.status.early, nav.status.late) == (0, 0)
    if state == "fixes alone":
        pose = nav.pose
        assert pose.time == fixes.time[-1]
        assert np.hypot(*(place[-1] - (pose.x, pose.y))) < 2.0
        assert 1.0 < pose.sigma < 3.5


def test_a_long_silence_of_the_sensors_has_few_keyframes_however_many_fixes():
    """Four a second; then the walk goes on where it was. All of them at once took minutes after an hour."""
    begin, silence, end, truth = 20.0, 100.0, 45.0, walk("figure_eight")[1]
    at = np.arange(begin, begin + silence, 0.25)
    place = np.array([np.interp(begin, truth.time, axis) for axis in truth.position.T]) + 0.01 * np.sin(at)[:, None]
    standing = [Fixes(at[n : n + 1], place[n : n + 1], np.ones(1), ("",), source=("GNSS",)) for n in range(len(at))]
    early, late = ([event for event in events() if a <= when(event) < b] for a, b in ((0, begin), (begin, end)))
    nav, _ = pushed([*early, *standing, *(later(event, silence) for event in late)], lag=None)
    assert nav.status.state == "running"
    assert nav.status.keyframes < len(standing) / 2
    pose = nav.pose
    there = np.array([np.interp(pose.time - silence, truth.time, axis) for axis in truth.position.T])
    assert np.hypot(*(there - (pose.x, pose.y))) < 3.0


@pytest.mark.parametrize(
    ("seconds", "fixes_too"), [(-JUMP, True), (JUMP, False), thorough(-JUMP, False), thorough(JUMP, True)]
)
def test_a_clock_that_jumps(seconds, fixes_too):
    """By an hour: put back, the walk goes on as if nothing had been; ahead, after a gap of an hour."""
    pushed_events = [
        later(event, seconds) if when(event) > 50 and (fixes_too or isinstance(event, Samples)) else event
        for event in events()
    ]
    nav, issues, track = checked(pushed_events)
    assert nav.status.fixes + nav.status.early == len(walk("figure_eight")[0].fixes)
    if seconds < 0:
        assert any("clock reset 1 times" in line for line in issues)
        assert error(track, walk("figure_eight")[1]) < 1.5
        assert nav.status.late <= 1, "one in the seconds until it is believed that the clock was put back"
    else:
        assert track.time[-1] > JUMP


def repeated(event):
    return [event, event]


def flooded(event):
    """10 kHz for five seconds."""
    if not isinstance(event, Samples) or not 40 < when(event) < 45:
        return [event]
    at = np.linspace(event.time[0], event.time[-1], 1000)
    return [replace(event, time=at, values=np.column_stack([np.interp(at, event.time, v) for v in event.values.T]))]


def absurd(event, random=np.random.default_rng(0)):
    """Values and times that are not finite, or huge."""
    if not isinstance(event, Samples):
        return [event]
    values, at = event.values.copy(), event.time.copy()
    bad, late = random.random(values.shape) < 0.01, random.random(len(at)) < 0.003
    values[bad] = random.choice([np.nan, np.inf, -np.inf, 1e300, -1e300, 1e12], bad.sum())
    at[late] = random.choice([np.nan, np.inf, -1e300, 1e300, 1e12], late.sum())
    return [replace(event, time=at, values=values)]


@pytest.mark.parametrize(
    ("damage", "within", "said"),
    [thorough(repeated, 1.5, "samples came twice"), thorough(flooded, 1.5, ""), (absurd, 2.0, "could not be used")],
)
def test_samples_that_cannot_be_used_leave_the_same_walk(damage, within, said):
    _, issues, track = checked([one for event in events() for one in damage(event)])
    assert any(said in line for line in issues) or not said
    assert error(track, walk("figure_eight")[1]) < within


def one_fix(at=50.0, place=(10.0, 10.0), sigma=1.5, source="", epsg=None):
    return Fixes(np.array([at]), np.array([place]), np.array([sigma]), ("",), epsg, (source,) if source else ())


ABSURD = {
    "far": one_fix(place=(1e9, -1e9)),
    "farther": one_fix(place=(1e150, 0.0)),
    "farthest": one_fix(place=(1e300, 1e300)),
    "late": one_fix(at=1e300),
    "early": one_fix(at=-1e300),
    "in another clock": one_fix(at=1.7e9),
    "too sure": one_fix(place=walk("figure_eight")[1].position[0], sigma=1e-9, at=1.0),
    "of a receiver": one_fix(place=(1e9, -1e9), source="GNSS"),
}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of what overflows, and is thrown away
@pytest.mark.parametrize("names", [[*ABSURD], *(thorough([name]) for name in ABSURD)], ids=str)
def test_absurd_fixes_among_good_ones_change_nothing(names):
    """All of them, or one alone, as the first and in the middle of the walk."""
    fixes, all_events = [ABSURD[name] for name in names], events()
    middle = len(all_events) // 2
    track = checked([*fixes, *all_events[:middle], *fixes, *all_events[middle:]])[2]
    assert error(track, walk("figure_eight")[1]) < 1.5


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("sigma", [1e-300, thorough(1e300)])
def test_an_absurd_fix_alone_is_no_reason_to_stop(sigma):
    samples = [event for event in events("arcade") if isinstance(event, Samples)]
    checked([one_fix(60.0, (40.0, 7.0), sigma), *samples], lag=30.0)


@pytest.mark.parametrize("place", [(1e300, 1e300), thorough((1e3, 1e3)), thorough((139.0, 95.0))])
def test_an_absurd_first_fix_on_earth_does_not_define_the_frame(place):
    """Nor is it an exception, in a projection that has no such place."""
    samples = [event for event in events() if isinstance(event, Samples) and when(event) < 45]
    good = [one_fix(5.0, (139.0, 35.0), 3.0, epsg=LONLAT), one_fix(30.0, (139.0001, 35.0), 3.0, epsg=LONLAT)]
    nav = checked([one_fix(1.0, place, 3.0, epsg=LONLAT), *samples[:300], *good, *samples[300:]])[0]
    assert nav.frame.origin == pytest.approx((35.0, 139.0), abs=1e-3)


def test_fixes_only():
    """No steps: the pose is that of the fixes, smoothed, in any direction, and the status says so."""
    fixes = [event for event in events() if isinstance(event, Fixes)]
    nav, issues, track = checked(fixes)
    assert issues
    assert np.hypot(*(np.array([nav.pose.x, nav.pose.y]) - fixes[-1].position[-1])) < 3 * fixes[-1].sigma[-1]
    assert nav.pose.covariance[2, 2] > 1.0
    assert nav.status.state == "fixes alone"
    assert len(track) == 0


def test_samples_only():
    nav, _, track = checked([event for event in events() if isinstance(event, Samples)])
    assert nav.status.state == "no absolute position"
    assert len(track) > 100


def test_unknown_data_is_ignored():
    """Scans of other radios, and events without a row."""
    strange = [
        Scan("uwb", Sightings(np.array([50.0]), ("x",), np.array([-50.0]))),
        Scan("wifi", Sightings(np.array([np.nan]), ("x",), np.array([np.nan]))),
        Scan("bluetooth", Sightings(np.empty(0), (), np.empty(0))),
        Samples("accelerometer", np.empty(0), np.empty((0, 3))),
        Fixes.none(),
    ]
    all_events = events()
    middle = len(all_events) // 2
    with_strange = [*all_events[:middle], *strange, *all_events[middle:]]
    assert checked(with_strange)[2].position.tobytes() == in_order()[2].position.tobytes()


@pytest.mark.parametrize(("sensor", "hint"), [("sonar", ""), ("acc", " (accelerometer?)"), ("Gyro", " (gyroscope?)")])
def test_an_unknown_sensor_is_an_error_that_lists_the_known(sensor, hint):
    known = "accelerometer, gyroscope, magnetometer, linear_acceleration, barometer"
    with pytest.raises(ValueError, match=r"Samples\.sensor") as raised:
        Samples(sensor, np.array([50.0]), np.zeros((1, 3)))
    assert str(raised.value) == f"Samples.sensor: found {sensor!r}{hint}, expected one of {known}"


@pytest.mark.parametrize(("unit", "factor"), [("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)])
@pytest.mark.parametrize("packet", [1, 10])
def test_a_clock_in_milliseconds_is_an_issue_that_says_so(unit, factor, packet):
    for start in (0.0, 1.7e9):
        nav, time = Navigator(), start + np.arange(0, 4, 0.01)
        for n in range(0, len(time), packet):
            values = np.tile([0.0, 0.0, 9.81], (packet, 1))
            nav.push(Samples("accelerometer", time[n : n + packet] * factor, values))
        expected = f"samples seem to have times in {unit}: seconds are expected"
        assert any(issue.endswith(expected) for issue in nav.status.issues), nav.status.issues


WRONG_UNITS = {  # of a sensor: what an app has done to its samples, and what the status says
    "g": ("accelerometer", lambda values: values / 9.81, "the unit is g; converted to m/s²"),
    "linear": ("accelerometer", lambda values: values - smoothed(values), "the recorder removed it"),
    "degrees": ("gyroscope", np.degrees, "can only be degrees per second; converted to rad/s"),
}


def smoothed(values, samples=100):
    """Means over a second: gravity, where the phone hardly turns."""
    return np.stack([np.convolve(axis, np.ones(samples) / samples, "same") for axis in values.T], axis=1)


@pytest.mark.parametrize("wrong", ["g", thorough("linear"), "degrees"])
def test_another_unit_is_recognised_within_five_seconds_of_walking_and_converted(wrong):
    sensor, changed, said = WRONG_UNITS[wrong]
    recording, truth = walk("figure_eight")
    signal = getattr(recording, sensor)
    nav, at = Navigator(), np.inf
    for event in events_of(replace(recording, **{sensor: Signal(signal.time, changed(signal.values))})):
        nav.push(event)
        if nav.status.issues:
            at = min(at, when(event))
    begins = truth.time[np.flatnonzero(np.hypot(*np.diff(truth.position, axis=0).T) > 0.001)[0]]
    assert at - begins < 5.0
    assert any(issue.startswith(sensor) and issue.endswith(said) for issue in nav.status.issues), nav.status.issues
    usual = in_order()[0]
    assert abs(nav.steps - usual.steps) <= 6, "of the first seconds"
    assert np.hypot(nav.pose.x - usual.pose.x, nav.pose.y - usual.pose.y) < 1.0


@pytest.mark.parametrize(("speed", "said"), [(8.0, "a ride since"), (1.3, "steps that are not recognised")])
def test_the_pose_follows_fixes_that_go_away_while_no_step_is_recognised(speed, said):
    """A ride or a walk of 20 s after a walk; the pose is with the fixes within 12 s, and the state says so."""
    recording, _ = walk("figure_eight")
    nav, far, random = Navigator(), [], np.random.default_rng(0)
    ride = 40.0, 60.0
    for sensor in ("accelerometer", "gyroscope"):
        signal, rest = getattr(recording, sensor), [0.0, 0.0, 9.81] if sensor == "accelerometer" else [0.0, 0.0, 0.0]
        during = (signal.time > ride[0]) & (signal.time < ride[1])
        values = np.where(during[:, None], rest + random.normal(0, 0.003, signal.values.shape), signal.values)
        recording = replace(recording, **{sensor: Signal(signal.time, values)})
    time = np.arange(1.0, 60.0)
    place = np.column_stack(
        [np.interp(time, walk("figure_eight")[1].time, axis) for axis in walk("figure_eight")[1].position.T]
    )
    place[time > ride[0]] = place[39] + np.outer(time[time > ride[0]] - ride[0], [speed, 0.0])
    fixes = Fixes(time, place + random.normal(0, 1.0, place.shape), np.ones(len(time)), ("",) * len(time))
    for event in events_of(replace(recording, fixes=fixes)):
        if when(event) > ride[1]:
            break
        nav.push(event)
        if when(event) > ride[0] + 12.0 and nav.pose is not None:
            far.append(np.hypot(*(np.array([nav.pose.x, nav.pose.y]) - place[int(nav.pose.time) - 1])))
    assert max(far) < 20.0, "one fix behind at most"
    assert nav.status.state == "fixes alone"
    assert any(said in issue for issue in nav.status.issues)
    assert not nav.status.verdict.ok


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_dip_of_the_field_tells_the_sign_where_the_place_is_known(sign):
    route = [[0.0, 0.0], {"stand": 2}, {"to": [[20.0, 0.0], [20.0, 10.0]]}, {"stand": 2}]
    made = simulate(Scenario.of({"seed": 1, "start": 1.7e9, "place": [11.08, 49.45], "route": route}))
    signals = {name: made.signals[name] for name in ("accelerometer", "gyroscope", "magnetometer")}
    accelerometer = signals["accelerometer"]
    signals["accelerometer"] = Signal(accelerometer.time, sign * accelerometer.values)
    nav = Navigator(epoch=1.7e9)
    nav.push(Fixes(0.5, (11.08, 49.45), 5.0, epsg=LONLAT))
    for event in events_of(Recording("walk", 0.0, 1.7e9, **signals)):
        nav.push(event)
    assert any("the dip of the magnetic field" in issue for issue in nav.status.issues) == (sign < 0)
    assert nav.sign == sign


def test_gaps_are_no_milliseconds():
    nav = Navigator()
    for now in (0.0, 0.01, 0.02, 5.0, 5.01, 5.02, 20.0, 20.01):
        nav.push(Samples("accelerometer", np.array([now]), np.array([[0.0, 0.0, 9.81]])))
    assert not any("seem to have" in issue for issue in nav.status.issues)


@pytest.mark.thorough
@settings(max_examples=4, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(st.randoms(use_true_random=False), st.integers(1, 200))
def test_any_order_of_events(random, reach):
    """Each event comes up to so many later than it should."""
    early_events = [event for event in events() if when(event) < 40]
    shuffled = sorted(range(len(early_events)), key=lambda n: n + random.uniform(0, reach))
    checked([early_events[n] for n in shuffled])


@pytest.mark.parametrize("floor", ["loop", thorough(None)])
def test_questions_between_events_change_nothing(floor):
    """A walk is a function of its events, whether its pose, status and path are asked for or not."""
    plan = None if floor is None else FloorPlan.load(Path(__file__).parents[2] / "maps" / f"{floor}.geojson")
    asked, plain = (Navigator(plan, lag=30.0) for _ in range(2))
    for n, event in enumerate(events("loop" if floor else "figure_eight")):
        asked.push(event)
        plain.push(event)
        if n % 5 == 0:
            assert asked.pose is None or asked.status.keyframes
            asked.review()
        if n % 50 == 0:
            len(asked.trajectory)
    assert asked.steps > 100
    assert (asked.pose is None) == (plain.pose is None)
    ends = [nav.finish().trajectory for nav in (asked, plain)]
    assert ends[0].position.tobytes() == ends[1].position.tobytes()
    assert ends[0].covariance.tobytes() == ends[1].covariance.tobytes()
