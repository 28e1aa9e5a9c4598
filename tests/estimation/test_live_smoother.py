"""The graph of a walk under way, against the batch smoother and other independent answers."""

from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np
import pytest
from synthetic_walks import LOOP, held_by_walls, live_events, walk
from tiers import thorough
from walks import (
    PERIOD,
    drawn_from_the_model,
    fixes_at,
    fixes_on,
    live_rows,
    live_track,
    part,
    pushing,
    straight,
    wandering_walk,
)

from pdr_graph import FloorPlan, Prior, smooth
from pdr_graph.estimation.factors import start
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.estimation.live.window import Path, Window
from pdr_graph.estimation.optimizer import optimize
from pdr_graph.floor.building import Building
from pdr_graph.gait.step_chunks import concatenate_steps, gap, shifted
from pdr_graph.geometry import dead_reckon, rotation, wrap_angle
from pdr_graph.online.navigator import Navigator
from pdr_graph.priors import MOTION
from pdr_graph.types import Fixes

LAG = 60.0  # [s]


@cache
def drawn(seed, n=220):
    """A walk of 120 s: its steps, fixes and truth."""
    return drawn_from_the_model(n, seed)


@cache
def within_lag(seed):
    """The track of a drawn walk with a lag of a minute, by chunks of ten steps."""
    steps, fixes, _ = drawn(seed)
    return live_track(steps, fixes, lag=LAG, size=10)


@cache
def batch_of(seed):
    steps, fixes, _ = drawn(seed)
    return smooth(WalkGraph(steps, fixes)).trajectory


def apart(first, second):
    """Distances between rows of two walks. [m]"""
    return np.hypot(*(first.position - second.position[: len(first)]).T)


@contextmanager
def headings_free():
    """Nobody's first heading is held: the batch holds it where it first lays the walk, live where it last was."""
    with patch.object(start, "ANY_HEADING", 30.0):
        yield


@cache
def one_by_one(lag=np.inf):
    return live_track(*drawn(0, 200)[:2], lag=lag)


@pytest.mark.parametrize(("size", "lag"), [(3, np.inf), (50, np.inf), (7, LAG), (20, LAG)])
def test_the_size_of_chunks_hardly_matters(size, lag):
    """Keyframes may differ, since a fix then comes before or after they close: 4 cm, with fixes of 1.5 m."""
    first, second = one_by_one(lag), live_track(*drawn(0, 200)[:2], lag=lag, size=size)
    assert first.time == pytest.approx(second.time, abs=2e-6)
    within = 0.04 if lag == np.inf else 1.2
    assert apart(first, second).max() < within, "a sigma: some left the window just before a fix"


@pytest.mark.parametrize("late", [10.0, 30.0, 50.0, np.random.default_rng(0).uniform(0, 50, 13)], ids=str)
def test_a_late_fix_is_as_good_as_one_in_time(late):
    """Also where some overtake others. 2 cm: iSAM2 linearises anew where a variable has moved beyond its threshold."""
    steps, fixes, _ = drawn(0, 200)
    assert np.ndim(late) == 0 or (np.diff(fixes.time + late) < 0).any()
    with headings_free():
        assert apart(live_track(steps, fixes, late=late), one_by_one()).max() < 0.02


def test_fixes_from_before_the_window_are_counted_and_not_used():
    steps, fixes, _ = drawn_from_the_model(400, seed=1)
    live = LiveSmoother(lag=LAG)
    for now in pushing(live, steps, fixes):
        if now == 390:
            before, cost = live.graph.window.pose, live.graph.cost
            for time in (0.0, 50.0, steps.time[now - 1] - 1.2 * LAG - 5.0):
                live.append(fixes_at([time], [500.0, 500.0], 1.0))
            assert live.graph.too_late == 3
            assert live.graph.window.pose is before
            assert live.graph.cost == cost


def wild(fixes, seed, share=0.3, far=40.0):
    random = np.random.default_rng(seed)
    off = (random.random(len(fixes)) < share)[:, None] * random.normal(0, far, (len(fixes), 2))
    return replace(fixes, position=fixes.position + off)


@pytest.mark.parametrize("walks", [5, thorough(8)])
def test_outliers_are_rejected(walks):
    """Three in ten are 40 m off: the median error of the walks is at most 1.7 times that without; one may be lost."""
    with_them, without = [], []
    for seed in range(walks):
        steps, fixes, truth = drawn(seed)
        with_them.append(np.median(apart(live_track(steps, wild(fixes, seed), lag=LAG, size=10), truth)))
        without.append(np.median(apart(within_lag(seed), truth)))
    assert np.median(with_them) < 1.7 * np.median(without)
    assert np.sort(with_them)[-2] < 3.0 * np.max(without)


def test_two_initial_outliers_are_overruled_by_later_fixes():
    """Both are within reach and 15 m off; the next twelve agree with one another and the steps."""
    steps, fixes, truth = drawn(3)
    off = np.zeros((len(fixes), 2))
    off[1], off[2] = (-9, 12), (9, -12)
    wrong = replace(fixes, position=fixes.position + off)
    assert np.median(apart(smooth(WalkGraph(steps, wrong)).trajectory, truth)) < 3.0, "it can be told"
    assert np.median(apart(live_track(steps, wrong), truth)) < 3.0


def test_a_jump_of_all_fixes_restarts_the_walk():
    """By 60 m: first they are outliers, then the walk follows them; rows that `pop_finalized` returned stay."""
    steps, fixes, truth = drawn_from_the_model(500, seed=1)
    jumped = replace(fixes, position=fixes.position + np.where(fixes.time > 150.0, 60.0, 0.0)[:, None])
    live, before = LiveSmoother(lag=LAG), None
    for now in pushing(live, steps, jumped):
        if steps.time[now - 1] > 140.0 and before is None:
            before = [rows.pose.copy() for rows in live.graph.finalized.rows]
    assert live.ambiguity.restarts
    assert live.sure
    assert len(before) > 5
    for pose, rows in zip(before, live.graph.finalized.rows, strict=False):
        assert pose == pytest.approx(rows.pose)
    live.finish()
    track = live_rows(live)
    late = track.time > 230.0
    off = track.position[late] - truth.position[: len(track)][late] - 60.0
    assert np.median(np.hypot(*off.T)) < 3.0
    assert not any("outlier" in fix.reason for fix in live.output.reports()["fixes"][-3:])


def test_the_first_rows_to_leave_the_window_are_as_certain_as_in_the_batch():
    """The lag sees less than the batch, so that it may not be surer; the start was once stated to a millimetre."""
    ratios = []
    for seed in range(4):
        rows, batch = within_lag(seed), batch_of(seed)
        at = np.searchsorted(batch.time, rows.time[:20] - 1e-3)
        sigma = np.sqrt(np.trace(rows.covariance[:20, :2, :2], axis1=1, axis2=2))
        ratios.append(sigma / np.sqrt(np.trace(batch.covariance[at, :2, :2], axis1=1, axis2=2)))
    assert np.min(ratios) > 0.9
    assert np.max(ratios) < 1.3


def test_a_window_of_a_minute_is_nearly_as_good_as_the_batch():
    """Six walks of 120 s: at most 1.3 times the error of the batch; 1.05 was measured."""
    live, batch = [], []
    for seed in range(6):
        live.append(apart(within_lag(seed), drawn(seed)[2]))
        batch.append(apart(batch_of(seed), drawn(seed)[2]))
    assert np.sqrt(np.mean(np.square(live))) < 1.3 * np.sqrt(np.mean(np.square(batch)))


@pytest.mark.parametrize("laps", [3, thorough(5)])
def test_memory_is_bounded(laps):
    """400 steps and more than three minutes a lap: only the finalised rows grow, and these are removed."""
    steps, fixes, _ = drawn_from_the_model(400, seed=1, every=30)
    live, sizes, handed = LiveSmoother(lag=LAG), [], 0
    graph = live.graph
    for lap in range(laps):
        shift = lap * (steps.end - steps.start)
        for now in pushing(live, shifted(steps, shift), replace(fixes, time=fixes.time + shift), size=5):
            if now % 50 == 0:
                handed += sum(len(rows.time) for rows in graph.finalized.pop_finalized())
                held = [graph.window.keyframes, graph.window.intervals, graph.window.c, graph.window.steps.chunks]
                held += [graph.log.rows(Fixes), graph.decisions["fixes"]["number"]]
                held += [graph.finalized.rows, graph.finalized.reports]
                held += [graph.marginals, graph.failures, graph._priors, graph._others]
                size = sum(marginal.root.size for marginal in graph.marginals)
                sizes.append([len(store) for store in held] + [size, len(graph.window.steps.whole)])
    assert (np.max(sizes[4 * laps :], axis=0) <= 1.5 * np.max(sizes[4:12], axis=0) + 2).all()
    assert handed + len(live_rows(live)) == 1 + 400 * laps + 1, "the start, and the present"


@pytest.mark.parametrize("lag", [20.0, LAG, np.inf])
def test_every_step_has_one_row_in_order(lag):
    """At any time, over finalised rows, the window and predicted rows."""
    steps, fixes, _ = drawn_from_the_model(250, seed=4)
    live, handed = LiveSmoother(lag=lag), []
    expected = np.append(steps.start, steps.time)
    for now in pushing(live, steps, fixes, size=7):
        if now % 2:
            handed += live.graph.finalized.pop_finalized()
        times = np.concatenate([*(rows.time for rows in handed), live_rows(live).time])
        if now < 250:
            assert times == pytest.approx(expected[: now + 1], abs=2e-6)


@pytest.mark.parametrize(("angle", "way"), [(0.3, (10.0, -20.0)), (2.0, (0.0, 0.0)), (0.0, (-300.0, 400.0))])
def test_the_track_rotates_and_moves_with_the_world(angle, way):
    """Moved, to rounding; turned, to a centimetre: factors are linearised again after 0.2 m along either axis."""
    steps, fixes, _ = drawn_from_the_model(200, seed=2)
    R = rotation(angle)
    moved = replace(fixes, position=fixes.position @ R.T + way)
    with headings_free():
        there, here = (live_track(steps, used, lag=LAG) for used in (fixes, moved))
    close = 1e-6 if angle == 0 else 0.01
    assert here.position == pytest.approx(there.position @ R.T + way, abs=close)
    assert wrap_angle(here.heading - there.heading - angle) == pytest.approx(0, abs=0.1 * close)
    assert here.covariance[:, :2, :2] == pytest.approx(R @ there.covariance[:, :2, :2] @ R.T, abs=close)


@pytest.mark.parametrize("far", [200.0, 600.0])
def test_a_gap_is_bridged_from_both_sides(far):
    """Two minutes on a bus: the walk continues at the fixes, as in the batch."""
    steps, fixes, truth = drawn(2, 200)
    lost = 120.0
    first, rest = part(steps, 0, 100), shifted(part(steps, 100, 200), lost)
    gone = concatenate_steps([first, gap(first.end, rest.start), rest])
    after = fixes.time > first.end
    moved = replace(fixes, time=fixes.time + lost * after, position=fixes.position + [far, 0.0] * after[:, None])
    track = live_track(gone, moved)
    assert len(track) == 203
    off = track.position[102:202] - truth.position[101:201] - [far, 0.0]
    assert np.median(np.hypot(*off.T)) < 4.0
    assert np.isfinite(track.covariance).all()


def test_finalised_rows_move_with_the_first_fix():
    """They come after five minutes: all rows, most of them finalised, move rigidly with the window.

    None was returned before: who takes them stores them, and they could not be moved afterwards.
    """
    steps = wandering_walk(700, seed=3)
    R, way = rotation(2.0), np.array([300.0, -100.0])
    truth = dead_reckon(steps)
    truth = replace(truth, position=truth.position @ R.T + way)
    fixes = fixes_on(truth, every=15)
    fixes = fixes[fixes.time > 300.0]
    live = LiveSmoother(lag=LAG)
    for now in pushing(live, steps, fixes):
        if steps.time[now - 1] < 300.0:
            assert not live.graph.finalized.pop_finalized()
    live.finish()
    track = live_rows(live)
    assert len(track) == 702
    assert np.median(apart(track, truth)[-100:]) < 0.3
    # a dead reckoning of five minutes that is turned by what a minute of fixes says: exact steps, 2° over 450 m
    assert apart(track, truth).max() < 0.035 * np.hypot(*np.ptp(truth.position, axis=0))


def test_many_fixes_at_one_moment_are_one_keyframe():
    steps, fixes, _ = drawn_from_the_model(60, seed=1)
    live = LiveSmoother(lag=LAG)
    for now in pushing(live, steps, fixes):
        if now == 30:
            for _ in range(20):
                live.append(fixes_at([steps.time[20] - PERIOD / 3], np.array([1.0, 1.0]), 5.0))
    assert (np.diff(np.round(live.graph.window.times, 6)) > 0).all()


# Late, few and wrong fixes, and short windows: no exception, no divergence

STEPS = 300


def disturbed(seed, on_plan):
    """Events of a walk: a tenth of the fixes are 40 m off, three tenths come up to 60 events late."""
    random = np.random.default_rng(seed)
    steps, fixes = held_by_walls(STEPS) if on_plan else walk(STEPS, int(random.integers(1, 40)))
    wrong = random.random(len(fixes)) < 0.1
    position = fixes.position + wrong[:, None] * random.normal(0, 40, fixes.position.shape)
    source = "gps" if random.random() < 0.5 else ""
    fixes = Fixes(fixes.time, position, fixes.sigma, (source,) * len(fixes))
    late = []
    for event in live_events(steps, fixes):
        if isinstance(event, Fixes) and random.random() < 0.3:
            late.append((int(random.integers(1, 60)), event))
        else:
            yield event
        yield from (fix for left, fix in late if left == 0)
        late = [(left - 1, fix) for left, fix in late if left > 0]


@pytest.mark.parametrize(
    ("lag", "seed"),
    [(3.0, 1), *(thorough(3.0, seed) for seed in (0, 2, 3, 6, 23)), thorough(10.0, 0), thorough(10.0, 1)],
)
def test_a_disturbed_walk_stays_finite_and_its_window_matches_the_solver(seed, lag):
    """Windows shorter than an interval between keyframes: each calibration is linked to the one before."""
    nav = Navigator(FloorPlan.load(LOOP) if seed % 3 == 0 else None, lag=lag)
    for event in disturbed(seed, on_plan=seed % 3 == 0):
        nav.push(event)
        graph = nav._graph.graph
        if graph.window.keyframes:
            assert graph.at.state.number("x").tolist() == graph.window.keyframes
            assert max(np.abs(c).max() for c in graph.window.c.values()) < 3
        assert nav.pose is None or np.isfinite([nav.pose.x, nav.pose.y]).all()
    assert np.isfinite(nav.finish().trajectory.position).all()


def silenced(silence, at):
    """Events of a walk on a plan: no data for so long [s] after a number of events, then all goes on later."""
    events = list(live_events(*held_by_walls(STEPS)))
    begin = next(event.end for event in reversed(events[:at]) if not isinstance(event, Fixes))
    yield from events[:at]
    yield gap(begin, begin + silence)
    for event in events[at:]:
        later = {} if isinstance(event, Fixes) else {"start": event.start + silence, "end": event.end + silence}
        yield replace(event, time=event.time + silence, **later)


@pytest.mark.parametrize(
    ("silence", "at"), [(21.0, 110), thorough(21.0, 135), thorough(300.0, 110), thorough(300.0, 135)]
)
def test_a_silence_as_long_as_the_lag_does_not_end_a_walk(silence, at):
    """Keyframes that close at once, one before and one after the silence, are not in the window together."""
    nav = Navigator(FloorPlan.load(LOOP), lag=20.0)
    for event in silenced(silence, at):
        nav.push(event)
    assert np.isfinite(nav.finish().trajectory.position).all()


def test_the_frozen_graph_of_a_question_knows_as_much():
    """At each keyframe: the marginal is that of iSAM2, and the solver is the batch's."""
    steps, fixes, _ = drawn_from_the_model(220, 1)
    live, compared = LiveSmoother(lag=15.0), 0
    for _ in pushing(live, steps, fixes, size=4):
        graph = live.graph
        if len(graph.window.keyframes) < 3:
            continue
        walk, known = graph.frozen(), graph.calibration_covariance()[-1]
        told = optimize(walk, walk.start).solution.joint(("c", np.array([len(walk.start.c) - 1])))[0]
        assert np.sqrt(np.diag(told)) == pytest.approx(np.sqrt(np.diag(known)), rel=0.1)
        compared += 1
    assert compared > 20


# The window: keyframes, the intervals between them, and the estimate

PLAIN = Prior(mean=(1.0, 1.0, 0.0))  # steps as they are


def window_of(steps, plan=None):
    """The window of a walk without measurements, all of whose intervals were closed at once."""
    window = Window(PLAIN, plan, "")
    window.steps.append(steps)
    window.begin()
    window.cut(window.steps.keyframe_ends(window.times[-1], []))
    assert len(window.intervals) > 3
    return window


def test_intervals_that_are_closed_at_once_are_dead_reckoned_one_after_the_other():
    steps = wandering_walk(60)
    window, track = window_of(steps), dead_reckon(steps)
    rows = np.searchsorted(track.time, np.array(window.times) - 1e-3)
    assert window.pose[:, :2] == pytest.approx(track.position[rows], abs=1e-9)
    assert wrap_angle(window.pose[:, 2] - track.heading[rows]) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("share", [0.1, 0.7])
def test_a_keyframe_that_is_inserted_lies_on_the_way_between_its_neighbours(share):
    """Of a walk at a constant speed: where the walker is at that time."""
    steps = straight(60)
    window, speed = window_of(steps), 0.7 / PERIOD
    before, after = window.times[2:4]
    time = before + share * (after - before)
    window.split(time)
    assert window.times[3] == time
    assert window.pose[:, 0] == pytest.approx(speed * np.array(window.times), abs=1e-5)
    assert [interval.delta[0] for interval in window.intervals] == pytest.approx(np.diff(window.pose[:, 0]), abs=1e-5)


def test_a_path_of_the_end_of_a_window_has_the_calibrations_of_that_end():
    """Those of the segments before it stay, and so do their poses."""
    window = window_of(straight(4 * MOTION.steps_per_segment))
    assert window.segments[-1] >= 2
    first = next(n for n, interval in enumerate(window.intervals) if interval.segment == 1)
    other = np.array([0.9, 1.1, 0.01])
    times = np.array(window.times[first:])
    path = Path(times, window.pose[first:] + np.array([0.0, 5.0, 0.0]), times[:1], other[None])
    window.place_on(path)
    assert window.c[0] == pytest.approx(PLAIN.mean)
    assert np.array([window.c[n] for n in window.segments[1:]]) == pytest.approx(np.tile(other, (len(window.c) - 1, 1)))
    assert (window.pose[:, 1] > 2.5).tolist() == [n >= first for n in range(len(window.times))]


def test_steps_that_turn_out_to_be_on_stairs_shorten_the_walk_by_the_treads():
    """Five steps of 0.7 m become 0.28 m long, in the intervals too; said again, nothing changes."""
    steps = straight(60)
    window = window_of(steps)
    goings = np.array([[steps.time[20] + 0.1, steps.time[25] - 0.1, 0.28]])
    last = np.searchsorted(steps.time, window.times[-1] + 1e-3)
    assert window.set_goings(goings)
    assert sum(interval.delta[0] for interval in window.intervals) == pytest.approx(0.7 * last - 5 * 0.42)
    assert not window.set_goings(goings)


def test_every_piece_of_a_window_has_a_floor():
    window = window_of(straight(60), Building.around(FloorPlan.load(LOOP)))
    window.floor = window.plan.labels[0]
    floors = window.floors()
    assert len(floors.level) == len(window.chain().pieces.length)


def test_a_time_beyond_the_keyframes_has_none_unless_the_window_begins_or_the_walk_ends_there():
    window = window_of(straight(60))
    times, last = np.array([-1.0, window.times[2], window.times[-1], window.times[-1] + 1.0]), len(window.times) - 1
    assert window.chain().keyframe(times).tolist() == [0, 2, last, -1]
    assert window.chain(first=2).keyframe(times).tolist() == [-1, 0, last - 2, -1]
    window.finished = True
    assert window.chain().keyframe(times).tolist() == [0, 2, last, last]
