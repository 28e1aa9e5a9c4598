"""Live steps equal those of the whole recording, with gaps, clock resets and damaged samples."""

from dataclasses import replace
from functools import cache, reduce
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiers import thorough

from pdr_graph.gait.step_chunks import append_steps
from pdr_graph.gait.step_stream import StepStream
from pdr_graph.gait.steps import detect_steps
from pdr_graph.gait.walker import Profile, Walker
from pdr_graph.geometry import interpolate
from pdr_graph.inertial.attitude import attitude_of
from pdr_graph.inertial.sensor_stream import LATE, REPEATED, SENSOR_VALIDATION, UNUSABLE
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.priors import MOTION
from pdr_graph.types import Recording, Signal

ROUTE = [[0, 0], {"stand": 3}, {"to": [[12, 0], [12, 8]]}, {"stand": 14}, {"to": [[0, 8], [0, 0]]}, {"stand": 2}]
INERTIAL = ("accelerometer", "gyroscope")


@cache
def walk(hold="hand", seed=3, at_once=False):
    """Along a rectangle, with a stop of 14 s; or straight on from the first moment."""
    route = [[0, 0], {"to": [[20, 0]]}] if at_once else ROUTE
    signals = simulate(Scenario.of({"seed": seed, "route": route, "phone": {"hold": hold, "rate": 50}})).signals
    return Recording("simulated", 0.0, None, **{sensor: signals[sensor] for sensor in INERTIAL})


def sent(recording, packet=0.1, sensors=INERTIAL):
    """Packets of (sensor, times, values) in the order of their last samples."""
    packets = []
    for sensor in sensors:
        signal = recording.signals[sensor]
        parts = np.split(np.arange(len(signal)), np.flatnonzero(np.diff(np.floor(signal.time / packet))) + 1)
        packets += [(signal.time[rows[-1]], sensor, signal.time[rows], signal.values[rows]) for rows in parts]
    return [one[1:] for one in sorted(packets, key=lambda one: one[0])]


def live(packets, walker=None, gait=None):
    """Certain chunks, provisional steps and the stream after all packets."""
    gait = gait or StepStream(walker)
    chunks, tails = [], []
    for packet in packets:
        gait.push(*packet)
        certain, tail = gait.advance()
        chunks += [certain] if certain is not None else []
        tails += [tail] if tail is not None else []
    rest = gait.finish()
    return chunks + ([rest] if rest is not None else []), tails, gait


def test_a_gyroscope_that_hangs_counts_as_none():
    """Within two seconds; by the value that it repeats, the walk would turn by a quarter every 16 s."""
    recording = walk()
    gyroscope = recording.gyroscope
    rate = np.where(gyroscope.time[:, None] > 6, 0.1, gyroscope.values)
    chunks, _, _ = live(sent(replace(recording, gyroscope=Signal(gyroscope.time, rate))))
    steps = reduce(append_steps, chunks)
    late = steps.time > 8
    assert (steps.sigma_turn[late] >= MOTION.unmeasured_turn).all()
    assert abs(steps.turn[late].sum()) < 0.3
    assert steps.unknown == ("turns: there is no gyroscope, or it stopped",)


@pytest.mark.parametrize("at_once", [False, True])
def test_the_walk_begins_with_its_first_second_of_samples(at_once):
    """A chunk without steps is certain then, and everything since is provisional up to the latest half second."""
    gait, begun = StepStream(), None
    for sensor, time, values in sent(walk(seed=1, at_once=at_once)):
        gait.push(sensor, time, values)
        certain, tail = gait.advance()
        if begun is None and certain is not None:
            begun = time[-1]
            assert len(certain) == 0
            assert certain.end - certain.start < 0.05
        if 1.2 < time[-1] < 8:
            assert begun <= 1.2
            assert tail.end > time[-1] - 0.75


@cache
def usual():
    """All of the walk, in packets of a tenth of a second."""
    return live(sent(walk()))


def whole(chunks):
    return reduce(append_steps, chunks)


def heading(steps, time):
    """Heading since the start, linear between rows."""
    turned = np.cumsum(np.concatenate([[0.0], steps.turn, [steps.final_turn]]))
    return np.interp(time, np.concatenate([[steps.start], steps.time, [steps.end]]), turned)


def same(one, other, rounding=0.0):
    """True if all columns are equal bit by bit; turns but for rounding [rad], since other chunks add up otherwise."""
    names = ("start", "end", "time", "duration", "length", "sigma_length", "sigma_turn", "unknown")
    turns = all(
        np.allclose(getattr(one, name), getattr(other, name), rtol=0, atol=rounding)
        for name in ("turn", "pause_turn", "final_turn")
    )
    return turns and all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


@pytest.mark.parametrize(("hold", "degrees"), [("hand", 4), ("trouser pocket", 4), ("swinging arm", 10)])
def test_certain_steps_equal_those_of_the_whole_recording(hold, degrees):
    """Times to a sample or so, as the grid differs; turns to the difference between filtered and smoothed bias."""
    steps, found = detect_steps(walk(hold)), whole(live(sent(walk(hold)))[0])
    assert len(found) == len(steps)
    assert found.time == pytest.approx(steps.time, abs=0.025)
    assert found.length == pytest.approx(steps.length, abs=0.02)
    assert np.ptp(heading(found, steps.time) - heading(steps, steps.time)) < np.radians(degrees)


OTHER_MODELS = [thorough(stride) for stride in ("amplitude", "cadence", "height")]


@pytest.mark.parametrize("stride", ["weinberg", *OTHER_MODELS])
def test_stride_model_and_profile_apply_to_live_steps(stride):
    """All stride models work on the last seconds, and the profile corrects live steps."""
    profile = Profile(0.1, 0.002, -0.02, np.eye(3) * 1e-4, 1.0, 1.2)
    walker = Walker(height=1.8, stride=stride, profile=profile)
    steps, found = detect_steps(walk(), walker), whole(live(sent(walk()), walker)[0])
    assert found.length == pytest.approx(steps.length, abs=0.03)
    assert found.turn.sum() == pytest.approx(steps.turn.sum(), abs=0.07)


@settings(max_examples=5, deadline=None)
@given(st.floats(0.01, 20.0))
def test_packets_of_any_size_give_the_same_steps(packet):
    assert same(whole(live(sent(walk(), packet))[0]), whole(usual()[0]), rounding=1e-12)


def test_chunks_follow_one_another_and_cover_the_walk():
    """From the first sample to the last; standing becomes certain too."""
    chunks, _, _ = usual()
    assert all(one.end == then.start for one, then in pairwise(chunks))
    end = walk().signals["accelerometer"].time[-1]
    assert (chunks[0].start, chunks[-1].end) == pytest.approx((0, end), abs=0.05)
    assert sum(len(chunk) == 0 for chunk in chunks) >= 3  # while standing


def test_a_step_is_certain_in_time():
    """After five seconds, twelve more if the phone turned fast, a few more after standing."""
    gait, end, delays = StepStream(), 0.0, []
    for packet in sent(walk()):
        gait.push(*packet)
        certain, _ = gait.advance()
        end = certain.end if certain is not None else end
        delays.append(packet[1][-1] - end)
    assert np.median(delays) < 8
    assert max(delays) < 18


def test_provisional_steps_predict_the_certain_ones():
    """They begin at the end of the certain steps, and about as many become certain."""
    chunks, tails, _ = usual()
    ends = {chunk.end for chunk in chunks} | {chunks[0].start}
    assert all(tail.start in ends for tail in tails)
    time = whole(chunks).time
    apart = [len(t) - np.sum((time > t.start) & (time <= t.end)) for t in tails]
    assert np.max(np.abs(apart)) <= 5  # who sets out is believed after FEWEST steps
    assert np.mean(np.abs(apart)) < 1


def size_of(value):
    """Bytes of all arrays in an object."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else None
    if parts is None and type(value).__module__.startswith("pdr_graph"):
        parts = vars(value).values()
    return sum(map(size_of, parts or ()))


@pytest.mark.thorough
def test_the_state_does_not_grow():
    """Ten minutes of standing and walking have the state of two laps."""
    packets, gait, sizes = sent(walk(), 1.0), StepStream(), []
    length = packets[-1][1][-1] + 0.02
    for turn in range(12):
        for sensor, time, values in packets:
            gait.push(sensor, time + turn * length, values)
            gait.advance()
        sizes.append(size_of(gait))
    assert max(sizes[2:]) < 1.3 * max(sizes[:2])


# What a phone does


def test_without_samples_there_are_no_steps():
    gait = StepStream()
    gait.push("accelerometer", np.empty(0), np.empty((0, 3)))
    gait.push("barometer", np.array([1.0]), np.array([[1013.0]]))
    assert gait.advance() == (None, None)
    assert gait.finish() is None
    assert gait.health["accelerometer"].samples == 0
    assert np.isnan(gait.health["accelerometer"].last)
    chunks, tails, gait = live(sent(walk(), sensors=("gyroscope",)))
    assert (chunks, tails) == ([], [])
    assert gait.health["gyroscope"].samples > 1000
    with pytest.raises(ValueError, match=r"found shape \(4, 2\) at 4 times, expected \(4, 3\)"):
        gait.push("gyroscope", np.arange(4.0), np.zeros((4, 2)))


CONSTANT = [(50, (0.0, 0.0, 0.0)), (50, (1e-300, 0.0, 0.0)), (50, (900.0, 900.0, 900.0))]


@pytest.mark.parametrize(("rate", "values"), [*CONSTANT, *((rate, (0.0, 0.0, 9.81)) for rate in (50, 3, 0.5))])
def test_constant_samples_give_no_steps(rate, values):
    """At low rates there may be gaps."""
    time = np.arange(0, 60, 1 / rate)
    chunks, _, _ = live([(sensor, time, np.tile(values, (len(time), 1))) for sensor in INERTIAL])
    assert not any(chunk.length.any() for chunk in chunks)
    assert rate < 50 or (len(whole(chunks)), whole(chunks).end) == (0, pytest.approx(time[-1]))


def test_bad_samples_are_dropped_and_counted():
    """Not a number, infinite, out of range, repeated or late: the steps are those without them."""
    packets = sent(walk())
    bad = []
    for n, (sensor, time, values) in enumerate(packets):
        bad.append((sensor, time, values))
        if n % 7 == 0:
            bad.append((sensor, time, values))  # the same again
        if n % 5 == 0:
            wrong = [np.nan, np.inf, 1e300, -1e300][n // 5 % 4]
            bad.append((sensor, time[-1:] + 1e-3, np.full((1, 3), wrong)))
        if n % 11 == 0:
            bad.append((sensor, np.array([[np.nan, np.inf, 1e300, time[0] + 4000][n // 11 % 4]]), values[:1]))
    chunks, _, gait = live(bad)
    assert same(whole(chunks), whole(usual()[0]))
    assert all(sum(health.left_out.values()) > 100 for health in gait.health.values())
    assert all(health.gaps == health.clock_resets == 0 for health in gait.health.values())


@pytest.mark.parametrize(("delay", "most"), [(0.5, 0.0), (1.5, 0.03)])
def test_packets_that_overtake_each_other_are_put_in_order(delay, most):
    """Of packets later than the first second shows a few may be lost; of others none, and no clock is reset."""
    packets = sent(walk())
    random = np.random.default_rng(0)
    arrival = np.array([time[-1] for _, time, _ in packets]) + delay * random.random(len(packets))
    chunks, _, gait = live([packets[n] for n in np.argsort(arrival, kind="stable")])
    lost = sum(health.left_out.get(LATE, 0) for health in gait.health.values())
    assert lost <= most * sum(len(time) for _, time, _ in packets)
    assert all(health.clock_resets == 0 for health in gait.health.values())
    assert len(whole(chunks)) == pytest.approx(len(whole(usual()[0])), abs=1)
    assert heading(whole(chunks), 30.0) == pytest.approx(heading(whole(usual()[0]), 30.0), abs=0.1)


def test_what_is_left_out_is_named():
    """Twice the same and no numbers, each by its reason; of orderly samples only the row that its recorder repeated."""
    packets, (_, _, gait) = sent(walk()), usual()
    assert [sum(health.left_out.values()) for health in gait.health.values()] == [1, 1]
    assert [health.left_out[REPEATED] for health in gait.health.values()] == [1, 1]
    lies = {30: packets[20], 50: packets[50], 70: (packets[70][0], packets[70][1] + 1e-3, packets[70][2] * np.nan)}
    _, _, gait = live([packet for n, first in enumerate(packets) for packet in (first, lies.get(n)) if packet])
    counted = {why for health in gait.health.values() for why, number in health.left_out.items() if number}
    assert counted == {REPEATED, UNUSABLE}


@pytest.mark.parametrize("jump", [-3600.0, -1e6])
def test_a_walk_continues_after_a_clock_reset(jump):
    """The number of steps is the same, and `health` states the offset of the times."""
    packets = [(s, time + jump * (time[0] > 10.05), values) for s, time, values in sent(walk())]
    chunks, _, gait = live(packets)
    steps = detect_steps(walk())
    assert len(whole(chunks)) == pytest.approx(len(steps), abs=1)
    assert whole(chunks).end == pytest.approx(steps.end, abs=0.1)
    assert heading(whole(chunks), steps.end) == pytest.approx(heading(steps, steps.end), abs=0.1)
    offsets = [health.offset for health in gait.health.values()]
    assert all(health.clock_resets == 1 for health in gait.health.values())
    assert offsets == pytest.approx([-jump, -jump], abs=0.1)
    assert offsets[0] == offsets[1]


def test_a_few_late_packets_are_not_a_clock_reset():
    packets = sent(walk())
    mixed = packets[:400] + packets[360:400] + packets[400:]
    assert len(packets[360:400]) * 0.05 <= SENSOR_VALIDATION.clock_reset
    assert same(whole(live(mixed)[0]), whole(usual()[0]))


@pytest.mark.parametrize("silence", [3.0, 3600.0])
def test_a_pause_of_both_sensors_is_a_gap(silence):
    """A row of length 0 with a wide sigma, and steps before and after it."""
    packets = [(s, time + silence * (time[0] > 10.05), values) for s, time, values in sent(walk())]
    found, steps = whole(live(packets)[0]), detect_steps(walk())
    (row,) = np.flatnonzero(found.is_gap)
    assert found.duration[row] == pytest.approx(silence, abs=0.1)
    assert found.sigma_length[row] == pytest.approx(silence, abs=0.1)
    assert len(found) == pytest.approx(len(steps) + 1, abs=3)  # a step or two at the edges


def without(name, begin=-np.inf, end=np.inf):
    """A signal of the walk without the samples between two times."""
    signal = walk().signals[name]
    rows = (signal.time < begin) | (signal.time > end)
    return Signal(signal.time[rows], signal.values[rows])


def linear():
    """The acceleration without gravity."""
    signal, attitude = walk().accelerometer, attitude_of(walk())
    gravity = attitude.R_world_device.inv().apply([0, 0, 9.81])
    return Signal(signal.time, signal.values - interpolate(signal.time, attitude.time, gravity))


LACKING = {
    "samples for four seconds": lambda: {name: without(name, 10, 14) for name in INERTIAL},
    "the gyroscope": lambda: {"gyroscope": None},
    "the gyroscope for eight seconds": lambda: {"gyroscope": without("gyroscope", 6, 14)},
    "gravity": lambda: {"accelerometer": None, "linear_acceleration": linear()},
}


@pytest.mark.parametrize("name", LACKING)
def test_where_something_is_missing_live_steps_are_those_of_the_whole_recording_too(name):
    """As many, with as many gaps and unmeasured turns, which `unknown` names."""
    recording = replace(walk(), **LACKING[name]())
    steps, found = detect_steps(recording), whole(live(sent(recording, sensors=recording.signals))[0])
    assert len(found) == pytest.approx(len(steps), abs=2)
    assert set(found.unknown) == {text for text in steps.unknown if "of the recording" not in text}
    assert found.length.sum() == pytest.approx(steps.length.sum(), rel=0.05)
    assert found.turn.sum() == pytest.approx(steps.turn.sum(), abs=0.15)
    unmeasured = [np.sum(s.sigma_turn == MOTION.unmeasured_turn) for s in (found, steps)]
    assert unmeasured[0] == pytest.approx(unmeasured[1], abs=2)
    gaps = [int(row) for row in np.flatnonzero(steps.is_gap)]
    for row, other in zip(np.flatnonzero(found.is_gap), gaps, strict=True):
        for column in ("time", "duration", "sigma_length", "sigma_turn"):
            assert getattr(found, column)[row] == pytest.approx(getattr(steps, column)[other], abs=0.05)


def test_where_there_is_an_accelerometer_linear_acceleration_is_not_asked():
    both = replace(walk(), linear_acceleration=linear())
    assert same(whole(live(sent(both, sensors=both.signals))[0]), whole(usual()[0]))


def test_a_high_sampling_rate_is_reduced():
    """Ten thousand samples a second, always or for a while: the same steps, and the state does not grow."""
    recording = walk()
    for begin in (-1.0, 8.0):
        flood = []
        for sensor, time, values in sent(recording):
            signal = recording.signals[sensor]
            if begin < time[0] < begin + 4:
                time = np.arange(time[0], time[-1] + 0.02, 1e-4)
                values = np.stack([np.interp(time, signal.time, axis) for axis in signal.values.T], axis=1)
            flood.append((sensor, time, values))
        chunks, _, gait = live(flood)
        assert len(whole(chunks)) == pytest.approx(len(detect_steps(recording)), abs=2)
        assert size_of(gait) < 1.6e6


@pytest.mark.parametrize("seed", [0, *(thorough(seed) for seed in (1, 2, 3))])
def test_chunks_are_a_valid_walk_for_any_packets(seed):
    """With random clock jumps, lost, repeated and swapped packets, high rates, and wrong values and times."""
    random, shift, packets = np.random.default_rng(seed), 0.0, []
    for sensor, time, values in sent(walk(), 10 ** random.uniform(-2, 1)):
        time, values = time.copy(), values.copy()
        fault, row = random.integers(100), random.integers(len(time))
        if fault == 0:
            shift += random.choice([-3600, 3600, -2.5, 2.5, -0.5, 1e5])
        elif fault < 3:
            values[row] = random.choice([np.nan, np.inf, 1e300, 900, 0])
        elif fault < 5:
            time[row] = random.choice([np.nan, -np.inf, 1e300, time[0] + 3, time[0] - 3])
        elif fault < 7:
            time, values = np.sort(random.uniform(time[0], time[-1] + 1e-3, 1500)), np.resize(values, (1500, 3))
        packets += [(sensor, time + shift, values)] * random.choice([0, 1, 2], p=[0.03, 0.95, 0.02])
        if fault == 7:
            packets[-2:] = packets[:-3:-1]
    chunks, tails, _ = live(packets)
    assert all(one.end == then.start for one, then in pairwise(chunks))
    assert {tail.start for tail in tails} <= {chunk.end for chunk in chunks} | {chunks[0].start}
    assert len(whole(chunks)) > 11, "of 57 steps"
