"""Radio maps of a real floor: walks of the others place one that was told nothing."""

import numpy as np
import pytest

from pdr_graph import FloorPlan, WalkGraph, detect_steps, magnetic_headings, smooth
from pdr_graph.apps.report.evaluation import circular_error, pair
from pdr_graph.estimation.fingerprinting import RadioMap
from pdr_graph.geometry import interpolate
from pdr_graph.io.loading import load
from pdr_graph.priors import SCANS
from pdr_graph.types import Fixes

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def floor(data):
    """Site 1, floor B1: the plan; each walk, its steps and headings, and the walk smoothed with its waypoints."""
    folder = data / "ms_indoor20" / "site1" / "B1"
    plan, walks = FloorPlan.load(folder), []
    for path in sorted(folder.glob("*.txt")):
        walk = load(path)
        steps, headings, truth = detect_steps(walk), magnetic_headings(walk, plan.frame, np.zeros(2)), walk.truth
        given = Fixes(truth.time, truth.position, np.full(len(truth), 0.5), ("",) * len(truth))
        track = smooth(WalkGraph(steps, given, headings=headings, floor=plan)).trajectory
        walks.append((walk, steps, headings, track))
    return plan, walks


def held_out(walks):
    """Each walk, and the fixes of a map of the others."""
    for n, (walk, steps, headings, track) in enumerate(walks):
        others = [(t, w) for m, (w, _, _, t) in enumerate(walks) if m != n]
        yield walk, steps, headings, track, RadioMap.learn(others).fixes(walk)


def test_fixes_are_as_good_as_they_say(floor):
    errors, sigma = [], []
    for _, _, _, track, fixes in held_out(floor[1]):
        errors.append(fixes.position - interpolate(fixes.time, track.time, track.position))
        sigma.append(fixes.sigma / SCANS.shared)
    errors, ratios = np.concatenate(errors), np.concatenate(errors) / np.concatenate(sigma)[:, None]
    assert np.median(np.hypot(*errors.T)) < 5.0
    assert np.mean(np.abs(ratios) < 1) == pytest.approx(0.68, abs=0.1)


def test_a_walk_that_was_told_nothing_is_found_better_than_by_fingerprints_alone(floor):
    """Straight lines between the fixes miss the waypoints by 3.7 m in the median, the graph with the plan by half."""
    plan, walks = floor
    lines, graph = [], []
    for walk, steps, headings, _, fixes in held_out(walks):
        at = interpolate(walk.truth.time, fixes.time, fixes.position)
        lines += np.hypot(*(at - walk.truth.position).T).tolist()
        track = smooth(WalkGraph(steps, fixes, headings=headings, floor=plan)).trajectory
        graph += circular_error(pair(track, walk.truth)).tolist()
    assert np.median(graph) < 0.6 * np.median(lines)
