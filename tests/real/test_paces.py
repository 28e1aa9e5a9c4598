"""Steps and lengths of walks at 0.4 to 1.5 m/s against other sensors: at the foot (strides), a camera (RIDI)."""

import numpy as np
import pytest
from tiers import thorough

from pdr_graph import detect_steps
from pdr_graph.apps.bench.data_sets import given, walks_of
from pdr_graph.apps.bench.matrix import places
from pdr_graph.apps.bench.methods import OURS, with_verdict
from pdr_graph.apps.report.output_files import summarize
from pdr_graph.gait.step_detection import StepDetector, walking_steps
from pdr_graph.lab.papers.attitude_filters import on_one_grid
from pdr_graph.walk import estimate, observe


@pytest.fixture(scope="module", params=["strides", thorough("ridi")])
def walks(data, request):
    walks = {name: read() for name, read in walks_of(request.param, data)}
    return [(name, walk, detect_steps(walk.evidence.walk)) for name, walk in walks.items()]


def test_every_step_counts_once_at_any_pace(walks):
    """Within 4 %, the first and last of a walk apart; within 10 % below 0.5 m/s, where the smallest are lost."""
    for name, walk, steps in walks:
        slow = walk.length / np.ptp(walk.evidence.walk.accelerometer.time) < 0.5
        assert len(steps) == pytest.approx(walk.steps, rel=0.1 if slow else 0.04), name


def test_uncalibrated_lengths_are_true_at_any_pace(walks):
    """The total of every walk within 12 %, half of them within 6.5 % (asked: 5)."""
    errors = np.array([steps.length.sum() / walk.length - 1 for _, walk, steps in walks])
    assert np.abs(errors).max() < 0.12
    assert np.median(np.abs(errors)) < 0.065


def test_the_length_of_a_walk_without_a_fix_has_an_honest_sigma(walks):
    """Every one within 2 sigma, and not twice as wide as usual errors need."""
    ratios = []
    for _, walk, _ in walks:
        summary = summarize(estimate(observe(given(walk, "nothing").evidence)))
        ratios.append((summary["distance"] - walk.length) / summary["distance_sigma"])
    assert np.abs(ratios).max() < 2.0
    assert np.sqrt(np.mean(np.square(ratios))) > 0.2


def test_slow_steps_are_found_live_too(data):
    """By samples in packets of half a second, exactly those of the whole recording."""
    for _, read in list(walks_of("strides", data))[-3:]:
        time, _, (acceleration,) = on_one_grid(read().evidence.walk, "accelerometer")
        period = float(time[-1] - time[0]) / (len(time) - 1)
        detector = StepDetector(period, float(time[0]))
        packets = np.array_split(acceleration, round(len(time) * period / 0.5))
        live = np.concatenate([*(detector.update(packet) for packet in packets), detector.finish()])[:, 0]
        assert live == pytest.approx(walking_steps(time, acceleration).time)


@pytest.mark.parametrize("carry", ["handheld", *map(thorough, ["leg", "bag", "body"])])
def test_the_region_holds_however_the_phone_is_carried_and_whichever_way_somebody_walks(data, carry):
    """RIDI, by two positions: no walk has less than 80 % in its region, those with steps sideways or backwards too."""
    errors = []
    for name, read in walks_of("ridi", data):
        if carry in name:
            walk = given(read(), "first and 25 %, no compass")
            error, inside = places(OURS["graph"](observe(walk.evidence)), walk.truth, walk.noise)
            errors.append(np.sqrt(np.nanmean(error**2)))
            assert np.nanmean(inside) > 0.8, name
    assert np.median(errors) < 1.2


@pytest.mark.thorough
def test_with_a_compass_and_one_place_the_dot_moves_and_without_one_it_says_that_the_direction_is_unknown(data):
    """RIDI live, by the first place alone; every third walk, those in a bag and sideways among them."""
    medians, lengths = {"": [], ", no compass": []}, []
    for _, read in list(walks_of("ridi", data))[::3]:
        walk = read()
        for compass, of in medians.items():
            told = given(walk, f"first{compass}")
            track, _, whole = with_verdict("live", OURS["live"], observe(told.evidence))
            error, inside = places(track, told.truth, told.noise)
            assert np.nanmean(inside) > 0.9
            of.append(np.nanmedian(error))
            lengths.append(float(np.hypot(*np.diff(whole().position, axis=0).T).sum()) / walk.length)
            unsure = np.asarray(track.covariance)[-1, 2, 2] ** 0.5
            assert (unsure > 1.5) == bool(compass)
    assert max(medians[""]) < 4.5
    assert np.median(medians[""]) < 3.0 < 10.0 < np.median(medians[", no compass"])
    assert lengths == pytest.approx(np.ones(len(lengths)), abs=0.15), "of the walk, whatever the pose shows"
