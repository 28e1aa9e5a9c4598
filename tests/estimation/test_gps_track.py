"""The smoothed track of positions alone, and its covariance."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from streets import SIGMA

from pdr_graph.estimation.gps_track import LOST, RIDES, WALKS, GpsKnots, Motion, plausible, smooth_track, way_through
from pdr_graph.priors import TRACK
from pdr_graph.types import Fixes


def kernel(time, speed, keeps):
    """Covariance of positions in a correlated random walk from time[0] on: the double integral of s² exp(−|u − w| / τ),
    by hand.
    """
    a, b = time[:, None] - time[0], time[None] - time[0]
    fades = np.exp(-a / keeps) + np.exp(-b / keeps) - np.exp(-abs(a - b) / keeps)
    return speed**2 * keeps**2 * (2 * np.minimum(a, b) / keeps - 1 + fades)


def test_the_smoother_is_the_gaussian_process_of_its_kernel():
    """Dense kriging with the kernel in closed form: mean and variance of every row."""
    random = np.random.default_rng(1)
    time = np.cumsum(random.choice([0.2, 1.0, 5.0, 40.0], 60))
    z = np.cumsum(random.normal(0, 3, (60, 2)), axis=0)
    slow, white = random.uniform(2, 20, 60), random.uniform(1, 5, 60)
    n = len(time) - 1
    way = smooth_track(
        GpsKnots(time, z, slow, white), Motion(np.full(n, 0.9), np.full(n, 40.0), np.zeros(n, dtype=bool)), ()
    )
    everywhere = 1e6  # [m²] where it begins
    of_way = kernel(time, 0.9, 40.0) + everywhere
    offset = np.outer(slow, slow) * np.exp(-abs(time[:, None] - time) / 120.0)
    gain = np.linalg.solve(of_way + offset + np.diag(white**2), of_way).T
    # the oracle's start is vague by 1 km, ours by 1000 km
    assert way.position == pytest.approx(gain @ z, abs=2e-2)
    assert way.variances()[:, 0] == pytest.approx(np.diag(of_way - gain @ of_way), rel=2e-3)


def test_the_covariance_of_a_gap_is_honest():
    """Walkers drawn from the model, without fixes for half an hour: at the rows, and linear between them."""
    time = np.r_[np.arange(0, 600, 5.0), np.arange(700, 2400, 100.0), np.arange(2400, 3000, 5.0)]
    received = (time < 600) | (time >= 2400)
    root = np.linalg.cholesky(
        kernel(time, np.array(TRACK.speed)[LOST], np.array(TRACK.keeps)[LOST]) + 1e-6 * np.eye(len(time))
    )
    inside = []
    for seed in range(60):
        truth = root @ np.random.default_rng(seed).normal(size=(len(time), 2))
        fixes = Fixes(time[received], truth[received], np.full(received.sum(), SIGMA), ("",) * received.sum())
        way = way_through(fixes).trajectory
        for at in (900.0, 1500.0, 2200.0):
            mean = [np.interp(at, way.time, axis) for axis in way.position.T]
            variance = np.interp(at, way.time, way.covariance[:, 0, 0])
            inside.append(np.sum((truth[time == at][0] - mean) ** 2) / variance < chi2.ppf(0.9, 2))
    assert 0.8 < np.mean(inside) < 0.98


@pytest.mark.parametrize(
    ("length", "sigma", "error"),
    [(400.0, sigma, error) for sigma in (40.0, 50.0) for error in (0.0, 15.0, 35.0)]
    + [(200.0, sigma, error) for sigma in (20.0, 30.0) for error in (0.0, 15.0)],
)
def test_a_short_walk_between_coarse_positions_is_found_and_none_where_there_is_none(length, sigma, error):
    """A walk at 1.3 m/s, to a place of 40 minutes and back, a position a minute; and as long at one place."""
    walk = length / 1.3
    bounds = np.cumsum([0.0, 7200.0, walk, 2400.0, walk, 7200.0])
    time = np.arange(0.0, bounds[-1], 60.0)
    there = np.interp(time, bounds, [0.0, 0.0, length, length, 0.0, 0.0])
    noise = np.random.default_rng(0).normal(0, 1, (len(time), 2)) * error

    def walks(east):
        place = np.column_stack([east, np.zeros(len(time))]) + noise
        way = way_through(Fixes(time, place, np.full(len(time), sigma), source=("GNSS",) * len(time)))
        edge = np.flatnonzero(np.diff(np.r_[False, way.kind == WALKS, False]))
        assert not (way.kind == RIDES).any()
        return way.trajectory.time[edge.reshape(-1, 2)]

    assert walks(there) == pytest.approx(bounds[1:5].reshape(2, 2), abs=180.0)
    assert not len(walks(np.zeros(len(time))))


@pytest.mark.parametrize("every", [10.0, 60.0])
@pytest.mark.parametrize(("speed", "is_train"), [(30.0, True), (60.0, True), (90.0, True), (200.0, False)])
def test_a_fast_train_is_a_ride_and_a_flight_is_no_data(every, speed, is_train):
    """Half an hour between two hours at a place; positions that jump there and back stay outliers."""
    time = np.arange(0.0, 9000.0, every)
    east = np.clip(time - 3600.0, 0.0, 1800.0) * speed
    fixes = Fixes(time, np.column_stack([east, 0 * east]), np.full(len(time), 10.0), source=("GNSS",) * len(time))
    way = way_through(fixes)
    under_way = (time > 3600.0) & (time < 5400.0)
    assert np.isin(np.flatnonzero(under_way), way.used).mean() == pytest.approx(float(is_train), abs=0.1)
    middle = np.searchsorted(way.trajectory.time, 4500.0)
    assert way.kind[middle - 1] == (RIDES if is_train else LOST)
    jumping = fixes.position + np.where(np.arange(len(time)) % 5 == 2, 3000.0 + speed * every, 0.0)[:, None]
    assert len(plausible(replace(fixes, position=jumping))) < 0.85 * len(time)
