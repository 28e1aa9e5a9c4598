"""Over seeded walks drawn from the model, the normalised error follows its χ² distribution; a wrong model does not."""

import numpy as np
import pytest
from nees import (
    STEPS,
    a_receiver,
    a_receiver_taken_for_independent,
    beacons,
    gaussian,
    independent_fixes,
    interval,
    nees_of,
    normalised_errors,
    twice_as_bad,
    twice_as_noisy,
)
from test_together import first_of_both, one_that_met, one_that_met_far_off
from tiers import thorough
from walks import drawn_from_the_model, live_rows, pushing

from pdr_graph import kalman_smoother, smooth
from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.priors import LOSSES, changed

HONEST = {
    "fixes": (independent_fixes, smooth, 120),
    "fixes, by the Kalman smoother": (independent_fixes, kalman_smoother, 120),
    "a receiver's offset and lag": (a_receiver, smooth, 80),
    "beacons": (beacons, smooth, 80),
    "two walks that met": (one_that_met, first_of_both, 60),
}
WRONG = {
    "fixes twice as bad as stated": (twice_as_bad, smooth, 25),
    "such fixes, by the Kalman smoother": (twice_as_bad, kalman_smoother, 25),
    "a receiver's fixes taken for independent": (a_receiver_taken_for_independent, smooth, 25),
    "levels twice as noisy as assumed": (twice_as_noisy, smooth, 25),
    "an encounter five times as far as stated": (one_that_met_far_off, first_of_both, 20),
}


@pytest.fixture(autouse=True)
def _gaussian():
    with gaussian(), changed(LOSSES, closure=1e6):
        yield


@pytest.mark.parametrize("share", [3, thorough(1)])
@pytest.mark.parametrize(("drawn", "method", "seeds"), HONEST.values(), ids=HONEST)
def test_covariance_is_honest(drawn, method, seeds, share):
    """Of a third of the seeds, and of all."""
    seeds //= share
    low, high = interval(seeds)
    assert low < normalised_errors(drawn, method, seeds).mean() < high


@pytest.mark.parametrize(("drawn", "method", "seeds"), WRONG.values(), ids=WRONG)
def test_a_wrong_model_fails_the_test(drawn, method, seeds):
    """Control."""
    assert normalised_errors(drawn, method, seeds).mean() > interval(seeds)[1]


def live_errors(wrong, seeds):
    """NEES of the belief of a walk under way at a random moment, and of a random row of its window ``(2, seeds)``."""
    found = []
    for seed in range(seeds):
        steps, fixes, truth = drawn_from_the_model(STEPS, seed, wrong=wrong)
        random, live = np.random.default_rng(seed), LiveSmoother()
        moment, row = 5 * random.integers(8, 18), random.integers(0, STEPS + 1)
        for now in pushing(live, steps, fixes, size=5):
            if now == moment:
                belief = live.output.belief(until=steps.time[now - 1])
                causal = nees_of(belief.mean[:3], belief.covariance[:3, :3], truth, now)
        live.graph.solve(40)
        track = live_rows(live)
        smoothed = nees_of([*track.position[row], track.heading[row]], track.covariance[row], truth, row)
        found.append((causal, smoothed))
    return np.transpose(found)


@pytest.mark.parametrize("seeds", [15, thorough(40)])
def test_the_covariance_of_a_walk_under_way_is_honest(seeds):
    low, high = interval(seeds)
    for errors in live_errors(wrong=1.0, seeds=seeds):
        assert low < errors.mean() < high


def test_under_way_fixes_twice_as_bad_as_stated_fail_the_test():
    """Control."""
    for errors in live_errors(wrong=2.0, seeds=6):
        assert errors.mean() > interval(6)[1]
