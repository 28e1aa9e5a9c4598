"""Units and signs of any phone: no walk becomes its mirror image, or the verdict says that it may be one."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from simulated import scenario

from pdr_graph.geometry import interpolate
from pdr_graph.inertial.units import METRIC, AccelerationSign, G
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.online.interface import Samples, events_of
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Fixes, Signal
from pdr_graph.walk import Evidence, Walker, observe

ROUTE = [(0, 0), (25, 0), (25, 15), (5, 20), (5, 40)]
CONVENTIONS = {  # factors of accelerations and angular rates as Android has them
    "CoreMotion": (-1 / 9.80665, 1.0),
    "Chrome": (1.0, 180 / np.pi),
    "Safari": (-1.0, 180 / np.pi),
    "Expo on Android": (1 / 9.80665, 1.0),
    "react-native-sensors on iOS": (-1.0, 1.0),
}


@cache
def walk(hold, every):
    """A walk as its phone recorded it, with a fix every so many seconds, and its truth."""
    made = simulate(scenario(ROUTE, seed=2, phone={"rate": 50, "hold": hold}))
    at = np.arange(1.0, made.truth.time[-1], every)
    place = interpolate(at, made.truth.time, made.truth.position)
    fixes = Fixes(at, place, np.full(len(at), 1.0), ("",) * len(at))
    return replace(made.recording("accelerometer", "gyroscope"), fixes=fixes, sign_odds=None), made.frame, made.truth


def followed(hold, every, convention="Android", finalise=False, **options):
    """A navigator after the walk in a convention, and its error [m]."""
    recording, frame, truth = walk(hold, every)
    factors = dict(zip(("accelerometer", "gyroscope"), CONVENTIONS.get(convention, (1.0, 1.0)), strict=True))
    nav = Navigator(frame=frame, executor=None, **options)
    for event in events_of(recording):
        nav.push(replace(event, values=factors[event.sensor] * event.values) if isinstance(event, Samples) else event)
        if finalise:
            nav.finalized()
    track = nav.finish().trajectory
    return nav, np.hypot(*(interpolate(track.time, truth.time, truth.position) - track.position).T)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_a_phone_in_the_hand_tells_its_sign_by_its_posture(convention):
    """From the first sample: a walk that began in the wrong unit or sign restarts."""
    usual, nearest = followed("hand", 60.0)
    nav, errors = followed("hand", 60.0, convention)
    assert nav.sign == np.sign(CONVENTIONS[convention][0])
    assert nav.steps == usual.steps
    assert np.median(errors) < np.median(nearest) + 0.3
    assert any("sign is opposite" in issue for issue in nav.status.issues) == (nav.sign < 0)


def test_fixes_tell_the_sign_of_a_phone_in_a_pocket_and_mend_the_whole_walk():
    unsure, far = followed("trouser pocket", 60.0, "react-native-sensors on iOS")
    assert np.median(far) > 5.0, "a control: unit and posture say nothing else"
    assert not unsure.status.verdict.ok
    nav, errors = followed("trouser pocket", 8.0, "react-native-sensors on iOS")
    assert nav.sign < 0
    assert np.max(errors) < 4.0
    assert nav.status.verdict.ok


def test_a_phone_in_a_pocket_keeps_its_sign():
    for every in (8.0, 60.0):
        assert followed("trouser pocket", every)[0].sign > 0


def test_rows_that_were_finalised_stay_mirrored_and_the_verdict_says_so():
    nav, errors = followed("trouser pocket", 8.0, "react-native-sensors on iOS", finalise=True, lag=5.0)
    assert nav.sign < 0
    assert np.median(errors[-10:]) < 4.0
    assert any("is its mirror image" in reason.text for reason in nav.status.verdict.reasons)


def test_the_platform_is_a_hint():
    assert followed("trouser pocket", 60.0, "CoreMotion", platform="ios")[0].status.verdict.ok
    nav, _ = followed("trouser pocket", 60.0, "Expo on Android", platform="android")
    assert (nav.sign, nav.status.verdict.ok) == (1.0, True)
    with pytest.raises(ValueError, match="found 'symbian', expected 'android', 'ios'"):
        Navigator(platform="symbian")


def test_arrays_may_be_used_again_after_a_push():
    """Though the walk restarts with the samples so far."""
    recording, frame, _ = walk("hand", 60.0)
    navigators = [Navigator(frame=frame, executor=None) for _ in range(2)]
    for event in events_of(recording):
        for nav in navigators:
            if not isinstance(event, Samples):
                nav.push(event)
                continue
            values = event.values * (-1.0 if event.sensor == "accelerometer" else 1.0)
            nav.push(replace(event, values=values))
            values *= float(nav is navigators[0])
    first, second = (nav.finish().trajectory for nav in navigators)
    assert first.position.tobytes() == second.position.tobytes()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_recording_is_judged_by_the_same_evidence(sign):
    recording, frame, _ = walk("trouser pocket", 8.0)
    signal = recording.accelerometer
    recording = replace(recording, accelerometer=Signal(signal.time, sign * signal.values))
    evidence = Evidence(recording, Walker(), None, frame, recording.fixes)
    observed = observe(evidence)
    assert observed.walk.accelerometer.values == pytest.approx(signal.values)
    assert any("turns between fixes" in note for note in observed.notes) == (sign < 0)
    assert observed.doubts == ()
    (doubt,) = observe(replace(evidence, fixes=recording.fixes[:1])).doubts
    assert "may be its mirror image" in doubt.text


@pytest.mark.parametrize(("unit", "up", "sign"), [(METRIC, 1, 1), (METRIC, -1, -1), (G, 1, 1), (G, -1, -1), (G, 0, -1)])
def test_a_held_phone_faces_up_and_g_is_most_often_of_ios(unit, up, sign):
    time = np.arange(0, 20, 0.02)
    bounce = 1 + 0.3 * np.sin(2 * np.pi * 1.9 * time)
    axis = np.array([0.0, np.sqrt(1 - up**2), up])
    assert AccelerationSign.of(Signal(time, bounce[:, None] * axis), unit).sign == sign
