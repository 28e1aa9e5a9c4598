"""Over seeded walks drawn from the model, the normalised error follows its χ² distribution; a wrong model does not."""

import pytest
from nees import (
    a_receiver,
    a_receiver_taken_for_independent,
    beacons,
    gaussian,
    independent_fixes,
    interval,
    normalised_errors,
    twice_as_bad,
    twice_as_noisy,
)

from pdr_graph import kalman_smoother, smooth

MANY = 80  # of walks that take longer to smooth
FEWER = 25  # for controls, which fail by far


@pytest.fixture(autouse=True)
def _gaussian():
    with gaussian():
        yield


@pytest.mark.parametrize("method", [smooth, kalman_smoother])
def test_covariance_is_honest(method):
    low, high = interval()
    assert low < normalised_errors(independent_fixes, method).mean() < high


@pytest.mark.parametrize("method", [smooth, kalman_smoother])
def test_fixes_twice_as_bad_as_stated_fail_the_test(method):
    """Control."""
    assert normalised_errors(twice_as_bad, method, FEWER).mean() > interval(FEWER)[1]


def test_the_covariance_is_honest_with_a_receivers_offset_and_lag():
    low, high = interval(MANY)
    assert low < normalised_errors(a_receiver, seeds=MANY).mean() < high


def test_a_receivers_fixes_without_source_fail_the_test():
    """Control: the same draws without a source, so that they are treated as independent."""
    assert normalised_errors(a_receiver_taken_for_independent, seeds=FEWER).mean() > interval(FEWER)[1]


def test_the_covariance_is_honest_with_beacons():
    low, high = interval(MANY)
    assert low < normalised_errors(beacons, seeds=MANY).mean() < high


def test_levels_twice_as_noisy_as_assumed_fail_the_test():
    """Control."""
    assert normalised_errors(twice_as_noisy, seeds=FEWER).mean() > interval(FEWER)[1]
