"""A walk under way whose direction is measured roughly, and whose walls say which way it went."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from walks import PERIOD, fixes_at, steps_of

from pdr_graph import FloorPlan
from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.floor.building import Building
from pdr_graph.floor.cells import Area
from pdr_graph.frames import Frame

STRIDE, HALF = 0.7, 1.5  # [m] of a step; half the width of the corridor
OFF = 0.3  # [rad] of the measured direction, one sigma


def corridor(*beside):
    """A corridor, and others at these ordinates [m]."""
    shapes = [shapely.box(-1, y - HALF, 200, y + HALF) for y in (0.0, *beside)]
    return Building.around(FloorPlan("1", tuple(Area("corridor", "", shape) for shape in shapes), Frame()))


def walking(off, steps, lag=60.0, beside=()):
    """A walk along the corridor from one fix, with a first heading that is so far off [rad]; yields after each step."""
    live = LiveSmoother(lag=lag, plan=corridor(*beside))
    step = steps_of(np.full(1, STRIDE), np.zeros(1))
    live.extend(replace(step, start=0.0, end=PERIOD, time=np.array([PERIOD])))
    live.append(fixes_at([PERIOD], [[STRIDE, 0.0]], 1.0))
    live.set_heading(0, PERIOD, off, OFF)
    for n in range(1, steps):
        begin, end = PERIOD * n, PERIOD * (n + 1)
        live.extend(replace(step, start=begin, end=end, time=np.array([end])))
        yield live


@pytest.mark.parametrize("off", [-OFF, OFF])
def test_a_solution_of_the_batch_is_adopted_with_its_walls(off):
    """A solver without them would turn the walk to the measured direction: 11 m out of the corridor."""
    outside, solvers = 0.0, set()
    for live in walking(off, steps=80):
        solvers.add(live.ambiguity.next_batch)
        outside = max(outside, float(np.abs(live.graph.window.pose[:, 1]).max()) - HALF)
    assert len(solvers) > 3, "the batch has been adopted so often"
    assert live.sure
    assert outside < 1.2, "[m], for a step or two"
    assert live.graph.window.pose[-1, 1:] == pytest.approx(0.0, abs=HALF)


@pytest.mark.parametrize("off", [-OFF, OFF])
def test_the_end_of_a_walk_costs_no_more_than_before(off):
    """Everything is linearised again there, where hardly any wall pulls; undamped it ends 30 m out of the corridor."""
    *_, live = walking(off, steps=150, lag=20.0)
    before = live.graph.at.cost
    live.finish()
    assert live.graph.at.cost <= before + 1e-6
    assert np.abs(live.graph.window.pose[:, 1]).max() < HALF
    assert np.abs(live.graph.window.pose[-1, 0] - 150 * STRIDE) < 15.0


@pytest.mark.parametrize(("beside", "asked"), [((), 0), ((20.0,), 0), ((6.0,), 1)])
def test_a_fix_beyond_a_wall_leads_to_a_search_only_where_one_can_walk_there(beside, asked, monkeypatch):
    """Two sigmas aside, where nobody can walk: the present way is the nearest; or in a corridor beside this one."""
    steps, searches = 80, []
    *_, live = walking(0.0, steps, beside=beside)
    assert live.sure
    live.ambiguity.trial.cancel()
    monkeypatch.setattr(live.ambiguity, "ask_batch_for_alternative", lambda: searches.append(1))
    live.append(fixes_at([PERIOD * steps], [[STRIDE * steps, 6.0]], 3.0))
    assert len(searches) == asked
