"""Live walks with late, few and wrong fixes and short windows: no exception, no divergence."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_walks import LOOP, held_by_walls, live_events, walk
from test_live_smoother import walking
from walks import drawn_from_the_model

from pdr_graph import FloorPlan
from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.gait.step_chunks import gap
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Fixes

STEPS = 300
SEEDS = [0, 1, 2, 3, 6, 23]


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


@pytest.mark.parametrize(("lag", "seed"), [*((3.0, seed) for seed in SEEDS), (10.0, 0), (10.0, 1)])
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


@pytest.mark.parametrize("silence", [21.0, 300.0])
def test_a_silence_as_long_as_the_lag_does_not_end_a_walk(silence):
    """Keyframes that close at once, one before and one after the silence, are not in the window together."""
    for at in (110, 135):
        nav = Navigator(FloorPlan.load(LOOP), lag=20.0)
        for event in silenced(silence, at):
            nav.push(event)
        assert np.isfinite(nav.finish().trajectory.position).all()


def test_a_copy_of_the_graph_knows_as_much():
    """At each keyframe, also where the solver has yet to forget a calibration that has left the window."""
    steps, fixes, _ = drawn_from_the_model(220, 1)
    live, compared = LiveSmoother(lag=15.0), 0
    for _ in walking(live, steps, fixes, size=4):
        graph = live.graph
        if len(graph.window.keyframes) < 3:
            continue
        told, known = (one.calibration_covariance()[-1] for one in (graph.copy(), graph))
        assert np.sqrt(np.diag(told)) == pytest.approx(np.sqrt(np.diag(known)), rel=0.1)
        compared += 1
    assert compared > 20
