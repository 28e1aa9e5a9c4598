"""An errand in a mall with four re-holds and four visits: what the plan is worth."""

from dataclasses import replace
from pathlib import Path

import pytest

from pdr_graph import FloorPlan, WalkGraph, detect_steps, evaluate, smooth
from pdr_graph.simulation.scenario import GivenFixes, Scenario
from pdr_graph.simulation.simulate import simulate

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_the_plan_does_not_talk_a_walk_out_of_its_fixes(seed):
    """One fix of 2 m in 40 s; started from where the fixes lay it alone, walls led it 15 m astray and blamed a fix."""
    scenario = Scenario.load(ROOT / "scenarios" / "mall.toml")
    walk = simulate(replace(scenario, seed=seed, given=GivenFixes(period=40, sigma=2.0)))
    floor = FloorPlan.load(ROOT / "maps" / "mall.geojson")
    steps = detect_steps(walk.recording("accelerometer", "gyroscope"))
    alone, mapped = (smooth(WalkGraph(steps, walk.given, floor=plan)) for plan in (None, floor))
    assert all(fix.weight > 0.3 for fix in mapped.fixes)
    error = [evaluate(found.trajectory, walk.truth)["ce"]["p50"] for found in (alone, mapped)]
    assert error[1] < min(error[0] + 0.1, 3.5)
