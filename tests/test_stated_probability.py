"""A probability is stated only of a walk with a position, and is near 0 where the route contradicts the plan."""

import json

import numpy as np
import pytest
from plans import ARCADE
from simulated import ROUTE
from tiers import thorough

from pdr_graph.apps.replay import replay_recording
from pdr_graph.apps.report.output_files import smooth_recording
from pdr_graph.errors import percent
from pdr_graph.estimation.results import stated_probability
from pdr_graph.floor.plan_files import Building
from pdr_graph.types import Estimate, FixReport, Trajectory
from pdr_graph.walk import Options

PLAN = Building.load(ARCADE)


def estimate(path, fixes=((0.0, 0.0),), probability=0.95):
    """An estimated walk along points with fixes at places."""
    path = np.array(path, dtype=float)
    track = Trajectory(np.arange(float(len(path))), path, np.zeros(len(path)))
    reports = tuple(FixReport(0.0, x, y, 1.0, 0.0, 1.0, "") for x, y in fixes)
    return Estimate(track, track, None, {"fixes": reports}, 1, 0.0, converged=True, probability=probability)


UNKNOWN = pytest.approx(np.nan, nan_ok=True)
THROUGH_WALLS = np.stack([np.linspace(-20, 60, 100), np.linspace(-20, 50, 100)], axis=1)


@pytest.mark.parametrize(
    ("path", "fixes", "plan", "expected"),
    [
        pytest.param(ROUTE, (), None, UNKNOWN, id="no position"),
        pytest.param(ROUTE, (), PLAN, UNKNOWN, id="no position on the plan"),
        pytest.param(ROUTE, ROUTE[:1], None, 0.95, id="a route without a plan keeps its probability"),
        pytest.param(ROUTE, ROUTE[:1], PLAN, 0.95, id="and one between walls"),
        pytest.param(THROUGH_WALLS, THROUGH_WALLS[50:51], PLAN, pytest.approx(0, abs=1e-3), id="through many walls"),
        pytest.param(ROUTE, [(9000.0, 0.0)], PLAN, 0.0, id="no fix near the plan"),
    ],
)
def test_a_probability_is_that_of_a_route_that_the_plan_allows(path, fixes, plan, expected):
    assert stated_probability(estimate(path, fixes), plan) == expected


def test_only_certainty_is_said_to_be_certain():
    stated = [percent(p) for p in (0.0, 0.004, 0.43, 0.994, 0.996, 1.0)]
    assert stated == ["0 %", "less than 1 %", "43 %", "99 %", "more than 99 %", "100 %"]


@pytest.mark.parametrize("write", [smooth_recording, thorough(replay_recording)])
def test_a_plan_without_any_fix_states_how_probable_the_place_is(write, long_walk, tmp_path):
    write(long_walk / "walk.txt", tmp_path, Options(plan=ARCADE, recorded_fixes=False))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["probability"] > 0.9
    assert any("sought on the whole plan" in warning for warning in summary["warnings"])
    stated = percent(summary["probability"])
    assert f'["probability of this route","{stated}"]' in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("method", ["graph", "pdr"])
def test_only_a_method_that_compares_routes_states_a_probability(method, long_walk, tmp_path):
    options = Options(plan=ARCADE, fixes=long_walk / "fixes.csv", method=method)
    smooth_recording(long_walk / "walk.txt", tmp_path, options)
    probability = json.loads((tmp_path / "summary.json").read_text())["probability"]
    assert (probability is None) == (method == "pdr")
