"""The cart of [stationary-switch]: the λ rule, and what the switch does for the position."""

from dataclasses import replace

import numpy as np
import pytest

from pdr_graph.lab.papers import stationary_switch as paper

CARTS = [paper.cart(seed) for seed in range(6)]


def test_lambda_is_the_largest_rate_at_rest_and_a_walk_exceeds_it():
    """With noise alone 1 sample in 1000 of a movement of 0.5 rad/s is below: the share of a sphere of radius λ."""
    random = np.random.default_rng(0)
    still, moving = random.normal(0, 0.002, (1500, 3)), random.normal(0, 0.5, (1500, 3))
    threshold = paper.rest_threshold(still)
    assert threshold == max(float(np.sqrt(x * x + y * y + z * z)) for x, y, z in still)
    assert paper.below_threshold(still, threshold).all()
    assert paper.below_threshold(moving, threshold).mean() < 0.01


def test_lambda_of_zero_is_never_at_rest_even_where_the_rate_is_zero():
    assert not paper.below_threshold(np.zeros((10, 3)), 0.0).any()


def test_a_longer_rest_is_required_sample_by_sample():
    rate = np.full((20, 3), 1.0)
    rate[3:5], rate[10:18] = 0.0, 0.0
    assert np.flatnonzero(paper.below_threshold(rate, 0.1)).tolist() == [3, 4, *range(10, 18)]
    assert np.flatnonzero(paper.below_threshold(rate, 0.1, 5)).tolist() == [*range(10, 18)]


def test_the_cart_moves_as_in_the_paper_along_the_axis_of_a_phone_that_faces_magnetic_north():
    """Times of trapezoids: distance over speed, and the time in which 0.5 m/s² reaches the speed. [s]"""
    start, end = CARTS[0].rolling[0]
    back, stop = CARTS[0].rolling[1]
    assert (start, back - end) == pytest.approx((35.3, 4.0), abs=0.05)
    assert end - start == pytest.approx(0.95 / 0.452 + 0.452 / 0.5, abs=0.05)
    assert stop - back == pytest.approx(1.05 / 0.438 + 0.438 / 0.5, abs=0.05)
    still = [each.run.accelerometer.time < start for each in CARTS]
    field = [each.run.magnetometer.values[: mask.sum()].mean(axis=0) for each, mask in zip(CARTS, still, strict=True)]
    east, north, _ = np.median(field, axis=0)
    assert abs(np.degrees(np.arctan2(east, north))) < 25  # steel of the place and the phone's iron: 5 µT of 30


def test_without_the_switch_the_position_drifts_away_and_with_it_the_cart_is_found():
    """Gravity of a tilt by the bias ω over t = 18 s: g ω t³/6 is tens of metres at 0.005 rad/s."""
    drifted = [paper.outcome(each, paper.SWITCH_METHODS["λ = 0"]) for each in CARTS]
    switched = [paper.outcome(each, paper.SWITCH_METHODS[paper.LAMBDA_RULE]) for each in CARTS]
    assert all(each.missed == 1.0 and each.false == 0.0 for each in drifted)
    bias = [np.hypot(*each.rest.gyroscope.values.mean(axis=0)[:2]) for each in CARTS]
    expected = 9.81 * np.array(bias) * 18.0**3 / 6
    assert np.log([each.error for each in drifted]) == pytest.approx(np.log(expected), abs=np.log(2))
    assert np.median([each.error for each in switched]) < np.median([each.error for each in drifted]) / 20


def test_a_wrong_lambda_is_seen_in_the_shares_of_rest():
    """Halved it misses rests; doubled it takes movement for rest."""
    shares = {}
    for scale in (0.5, 1.0, 2.0):
        outcomes = [paper.outcome(each, replace(paper.PAPER_METHOD, scale=scale)) for each in CARTS]
        shares[scale] = np.mean([[each.missed, each.false] for each in outcomes], axis=0)
    assert shares[0.5][0] > 0.1 > shares[1.0][0] >= shares[2.0][0]
    assert shares[0.5][1] < shares[1.0][1] < shares[2.0][1]


def test_a_rest_that_lasts_and_looking_ahead_each_bring_the_cart_nearer():
    methods = (paper.PAPER_METHOD, paper.LONGER, replace(paper.LONGER, look_ahead=True), paper.PRODUCT)
    errors = [np.median([paper.outcome(each, method).error for each in CARTS]) for method in methods]
    assert errors[0] > errors[1] > errors[2]
    assert errors[3] < 0.1


def test_fewer_errors_of_the_gyroscope_lower_lambda_in_proportion():
    """λ is made of errors alone."""
    whole, part = (paper.rest_threshold(paper.cart(0, share).rest.gyroscope.values) for share in (1.0, 0.4))
    assert part == pytest.approx(0.4 * whole, rel=1e-6)


def test_the_table_has_the_papers_lambda_beside_ours(monkeypatch):
    monkeypatch.setattr(paper, "QUICK", 3)
    (table,) = paper.experiment(quick=True)
    assert {len(row) for row in table.rows} == {len(table.header)}
    assert any("[0.0041]" in cell for row in table.rows for cell in row)
