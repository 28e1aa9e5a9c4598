"""From raw phone samples to steps, on simulated walks."""

import numpy as np
import pytest
from simulated import GYRO_BIAS, walk_along

from pdr_graph import InputError, WalkGraph, detect_steps, smooth
from pdr_graph.gait.steps import uninterrupted
from pdr_graph.geometry import dead_reckon, interpolate
from pdr_graph.types import Fixes, Recording, Signal

ROUTE = np.array([(0.0, 0.0), (20.0, 0.0), (20.0, 12.0), (2.0, 12.0)])


def recorded(walk, rows=slice(None), **missing):
    """A recording of some samples of the walk; missing: other signals in place of its own."""
    sensors = {
        "accelerometer": Signal(walk.time[rows], walk.acceleration[rows]),
        "gyroscope": Signal(walk.time[rows], walk.angular_rate[rows]),
    }
    return Recording("simulated", 0.0, None, **(sensors | missing))


@pytest.fixture(scope="module")
def walk():
    return walk_along(ROUTE, seed=3)


@pytest.fixture(scope="module")
def steps(walk):
    return detect_steps(recorded(walk))


def test_all_steps_are_found_with_plausible_lengths(walk, steps):
    """All landings but the weak first and last ones; lengths within 25 %, by a stride model not fitted to them."""
    way = np.hypot(*np.diff(walk.position, axis=0).T).sum()
    assert len(steps) == pytest.approx(len(walk.landings), abs=2)
    assert steps.length.sum() == pytest.approx(way, rel=0.25)
    assert np.all(np.diff(steps.time) > 0)
    assert np.all(steps.duration <= np.diff(steps.time, prepend=steps.start) + 1e-9)


def test_turns_add_up_to_the_turns_of_the_route(walk, steps):
    """Two left turns make π, up to a few degrees of gyroscope bias and of the phone's motion."""
    turned = steps.turn.sum() + steps.final_turn
    assert turned == pytest.approx(np.pi, abs=0.15)


def test_the_track_has_the_shape_of_the_route(walk, steps):
    track = dead_reckon(steps, heading=0.0)
    truth = interpolate(track.time, walk.time, walk.position)
    truth -= truth[0]
    scale = np.sum(truth * track.position) / np.sum(track.position**2)
    assert np.hypot(*(scale * track.position - truth).T).max() < 4.0


def test_the_gyroscopes_bias_is_estimated_at_rest(walk):
    """0.02 rad/s about all axes would turn this walk by a radian; ten seconds on a table determine it."""
    rest, random = 500, np.random.default_rng(0)

    def on_a_table_first(values, there, noise):
        still = there + random.normal(0, noise, (rest, 3))
        return Signal(np.arange(rest + len(values)) / 50, np.concatenate([still, values]))

    acceleration = on_a_table_first(walk.acceleration, walk.acceleration[0], 0.02)
    rates = [on_a_table_first(walk.angular_rate + bias, GYRO_BIAS + bias, 0.002) for bias in (0.0, 0.02)]
    plain, biased = (detect_steps(recorded(walk, accelerometer=acceleration, gyroscope=rate)) for rate in rates)
    assert biased.turn.sum() == pytest.approx(plain.turn.sum(), abs=0.15)


def test_a_recording_that_begins_in_mid_step_has_the_rest_of_the_step(walk, steps):
    """Cut at 60 % of a step: its length and duration are those of the remaining 40 %."""
    n = 12
    begin = steps.time[n] - 0.4 * steps.duration[n]
    found = detect_steps(recorded(walk, walk.time >= begin))
    assert found.time[0] == pytest.approx(steps.time[n], abs=0.05)
    assert found.length[0] == pytest.approx(0.4 * steps.length[n], rel=0.35)


def test_a_turn_after_the_last_step_is_the_final_turn(walk):
    """The walker stops, then turns by 90° on the spot."""
    turning = (walk.time > walk.time[-1] - 1.5) & (walk.time < walk.time[-1] - 0.5)
    up = walk.acceleration[-1] / np.linalg.norm(walk.acceleration[-1])
    rate = walk.angular_rate + np.outer(turning, up) * np.pi / 2
    plain, turned = (detect_steps(w) for w in (recorded(walk), recorded(walk, gyroscope=Signal(walk.time, rate))))
    assert turned.final_turn - plain.final_turn == pytest.approx(np.pi / 2, abs=0.15)


def test_a_missing_accelerometer_and_wrong_units_are_refused(walk):
    with pytest.raises(InputError, match="accelerometer: found no samples"):
        detect_steps(recorded(walk, accelerometer=None))
    with pytest.raises(InputError, match=r"median magnitude of (0\.9|1\.0).*9\.8 m/s²"):
        detect_steps(recorded(walk, accelerometer=Signal(walk.time, walk.acceleration / 9.81)))


def test_without_a_gyroscope_turns_are_unknown_and_steps_the_same(walk):
    complete, deaf = detect_steps(recorded(walk)), detect_steps(recorded(walk, gyroscope=None))
    assert deaf.time == pytest.approx(complete.time)
    straight = np.abs(complete.turn + np.roll(complete.turn, 1)) < 0.02
    assert deaf.length[straight] == pytest.approx(complete.length[straight], rel=0.015), "none is known to be in a bend"
    assert not deaf.turn.any()
    assert (deaf.sigma_turn > 10 * complete.sigma_turn).all()
    assert deaf.unknown == ("turns: there is no gyroscope, or it stopped",)


@pytest.mark.parametrize(("begin", "end"), [(-1.0, 14.0), (14.0, 99.0), (10.0, 18.0)], ids=["late", "early", "pauses"])
def test_where_the_gyroscope_does_not_run_turns_are_unknown_and_steps_the_same(walk, steps, begin, end):
    ran = (walk.time < begin) | (walk.time > end)
    found = detect_steps(recorded(walk, gyroscope=Signal(walk.time[ran], walk.angular_rate[ran])))
    assert found.time == pytest.approx(steps.time, abs=0.03)
    blind = (found.time > begin) & (found.time < end)
    assert (found.sigma_turn[blind] > 0.2).all()
    assert np.sum(found.sigma_turn[~blind] > 0.1) <= 2, "those at the edges"
    assert found.turn[blind] == pytest.approx(0.0, abs=0.1)
    measured = ~blind & (np.abs(found.time - begin) > 2) & (np.abs(found.time - end) > 2)
    assert found.turn[measured].sum() == pytest.approx(steps.turn[measured].sum(), abs=0.1)
    assert found.unknown == ("turns: there is no gyroscope, or it stopped",)


@pytest.mark.parametrize("value", [0.1, 0.0])
@pytest.mark.parametrize("begin", [-1.0, 14.0], ids=["throughout", "from 14 s on"])
def test_a_gyroscope_that_hangs_counts_as_none(walk, begin, value):
    """It repeats one value while the phone moves; by it, the walk would turn by 6° a second."""
    hangs = walk.time >= begin
    rate = np.where(hangs[:, None], value, walk.angular_rate)
    found = detect_steps(recorded(walk, gyroscope=Signal(walk.time, rate)))
    without = detect_steps(recorded(walk, gyroscope=Signal(walk.time[~hangs], rate[~hangs]) if begin > 0 else None))
    assert found.unknown == without.unknown == ("turns: there is no gyroscope, or it stopped",)
    assert found.time == pytest.approx(without.time, abs=0.03)
    assert np.abs(found.turn - without.turn).sum() < 0.25, "at rest, before the walk, it may be right"
    assert found.sigma_turn == pytest.approx(without.sigma_turn, rel=0.1)


def test_a_phone_that_lies_still_has_a_gyroscope(walk):
    """Some leave out the noise: zeros at rest are measured, and the walk goes on in the direction before."""
    lying = np.tile(walk.acceleration[0], (1000, 1)) + np.random.default_rng(0).normal(0, 0.02, (1000, 3))
    time = np.concatenate([walk.time, walk.time[-1] + 0.01 * np.arange(1, 1001)])
    rate = np.concatenate([walk.angular_rate, np.zeros((1000, 3))])
    rest = {"accelerometer": Signal(time, np.concatenate([walk.acceleration, lying])), "gyroscope": Signal(time, rate)}
    assert detect_steps(recorded(walk, **rest)).unknown == ()


def test_removed_gravity_is_restored_along_the_axis_of_the_largest_motion(walk):
    linear = Signal(walk.time, walk.acceleration - 9.80665 * walk.up)
    complete = detect_steps(recorded(walk))
    found = detect_steps(recorded(walk, accelerometer=None, linear_acceleration=linear))
    assert found.time == pytest.approx(complete.time, abs=0.1)
    # the axis is 8° off here, 3–9° on real walks: its turns are short by the cosine
    assert found.turn.sum() == pytest.approx(complete.turn.sum(), rel=0.1)
    assert "gravity" in found.unknown[0]


def holed(walk, start, end):
    """The walk with no samples between two times [s]."""
    return recorded(walk, (walk.time < start) | (walk.time > end))


def test_a_gap_is_a_row_of_length_0_with_a_wide_sigma(walk, steps):
    found = detect_steps(holed(walk, 10.0, 20.0))
    gap = np.flatnonzero(found.is_gap)
    assert len(gap) == 1
    assert found.time[gap] - found.duration[gap] == pytest.approx(10.0, abs=0.05)
    assert found.time[gap] == pytest.approx(20.0, abs=0.05)
    assert found.sigma_length[gap] == pytest.approx(10.0, abs=0.1), "a metre a second"
    assert found.unknown == ("steps in 1 gap of the recording",)
    outside = (steps.time < 10.0) | (steps.time > 20.5)
    assert len(found) - 1 == pytest.approx(outside.sum(), abs=2)


def test_a_part_between_two_gaps_is_kept_if_it_is_longer_than_a_second(walk):
    """Parts of 8 s, 0.6 s and the rest of a walk that begins five minutes after its clock."""
    ran = (walk.time < 8.0) | ((walk.time > 12.0) & (walk.time < 12.6)) | (walk.time > 16.0)
    accelerometer = Signal(walk.time[ran] + 300.0, walk.acceleration[ran])
    parts = uninterrupted(recorded(walk, accelerometer=accelerometer, gyroscope=None))
    spans = np.array([part.accelerometer.time[[0, -1]] for part in parts])
    assert spans == pytest.approx(np.array([[300.0, 308.0], [316.0, 300.0 + walk.time[-1]]]), abs=0.05)


def test_a_stray_sample_a_year_later_is_ignored(walk, steps):
    late = np.append(walk.time[:-1], 3e7)
    stray = recorded(walk, accelerometer=Signal(late, walk.acceleration), gyroscope=Signal(late, walk.angular_rate))
    assert detect_steps(stray).time == pytest.approx(steps.time)


def test_a_recording_that_is_all_gaps_is_refused_with_its_cause(walk):
    """With a sample every three seconds no step can be detected, and gaps are not interpolated."""
    rare = Signal(np.arange(0.0, 60.0, 3.0), np.tile([0.0, 0.0, 9.81], (20, 1)))
    with pytest.raises(InputError, match=r"19 gaps.*expected samples more often"):
        detect_steps(recorded(walk, accelerometer=rare, gyroscope=None))
    slow = Signal(walk.time * 1000, walk.acceleration)
    with pytest.raises(InputError, match=r"gaps.*more often than one a second \(milliseconds in a column of seconds\?"):
        detect_steps(recorded(walk, accelerometer=slow, gyroscope=None))


def test_fixes_determine_the_walk_after_a_gap(walk):
    """Ten seconds around a corner are missing, with a fix every five: the walk after it is within its covariance."""
    at = np.arange(0.0, walk.time[-1], 5.0)
    truth = interpolate(at, walk.time, walk.position)
    fixes = Fixes(at, truth, np.full(len(at), 0.5), ("",) * len(at))[(at < 16.0) | (at > 26.0)]
    track = smooth(WalkGraph(detect_steps(holed(walk, 16.0, 26.0)), fixes)).trajectory
    there = interpolate(track.time, walk.time, walk.position)
    error = np.hypot(*(track.position - there).T)
    recorded_rows = (track.time < 16.0) | (track.time > 26.0)
    assert error[recorded_rows].max() < 1.5
    sigma = np.sqrt(track.covariance[:, 0, 0] + track.covariance[:, 1, 1])
    assert (error < 3.5 * sigma)[recorded_rows].all()
