"""The table of integrity: its scores are right, and each lie changes what it should and nothing else."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pdr_graph.types import Trajectory

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def script(scripts_on_path):
    """The modules of the script."""
    import conditions
    import integrity

    return SimpleNamespace(scores=integrity, walks=conditions)


def estimate_with(covariance, error):
    """An estimate that stands still at (0, 0), and the truth beside it."""
    time, still = np.arange(5.0), np.zeros((5, 2))
    full = np.tile(np.diag([*np.diag(covariance), 1.0]), (5, 1, 1))
    track = Trajectory(time, still, np.zeros(5), covariance=full)
    truth = Trajectory(time, still + error, np.zeros(5))
    return SimpleNamespace(trajectory=track, probability=1.0, reports={}, fixes=(), contradictions=()), truth


@pytest.fixture
def score(script, monkeypatch):
    """A function of a covariance and an error ``(2,)`` [m]."""
    monkeypatch.setattr(script.scores, "verdict", lambda estimate: SimpleNamespace(state="ok"))
    return lambda *given: script.scores.score(*estimate_with(*given))


@pytest.mark.parametrize(("sigmas", "radius"), [((1, 1), 2.4477), ((1, 1e-4), 1.9600), ((1, 0.5), None)])
def test_the_stated_radius_holds_95_percent_of_a_gaussian(score, sigmas, radius):
    """The chi distribution of two degrees of freedom, the normal one, and a million draws of each ellipse."""
    stated = score(np.diag(np.square(sigmas)), [0.1, 0.0]).radius
    assert radius is None or stated == pytest.approx(np.full(5, radius), abs=4e-3)
    drawn = np.random.default_rng(0).normal(0, sigmas, (1_000_000, 2))
    assert (np.hypot(*drawn.T) < stated[0]).mean() == pytest.approx(0.95, abs=2e-3)


def test_a_walk_is_broken_beyond_three_radii(score):
    """2.4477 m hold 95 % of a sigma of 1 m: 7.3 m off is within three of them, 7.4 m is not."""
    nearer, near, far = (score(np.eye(2), [off, 0.0]) for off in (5.0, 7.3, 7.4))
    assert not near.broken
    assert far.broken
    assert far.harmless(near)
    assert not far.harmless(nearer)


def test_a_lying_receiver_is_seen_in_the_table(script):
    """One walk by a receiver 10 m off: about 10 m wrong where the honest one is not, and out of its region."""
    honest, lie = (("GNSS",), ("GNSS: 10 m off",))
    scores = script.scores.scores_of(("outdoors", 0, (honest, lie)))
    assert 6 < scores[lie].error.mean() < 15
    assert scores[lie].error.mean() > scores[honest].error.mean() + 3
    assert scores[lie].inside.mean() < scores[honest].inside.mean()
    row = script.scores.cells([scores[lie]], [scores[honest]])
    assert len(row) == len(script.scores.HEADER)
    assert row[-2] == "**0 %**"


def test_lies_about_a_list_change_the_list_alone(script):
    """What was received stays; a swapped pair has each other's places, another building's are all 30 m off."""
    walk = script.walks.simulated_walk("indoors", 1)
    honest, swapped, other = (
        script.walks.measured(walk, (source,)).measurements[-1]
        for source in ("beacons", "beacons: a pair swapped", "beacons: of another building")
    )
    for lie in (swapped, other):
        assert np.array_equal(lie.time, honest.time)
        assert np.array_equal(lie.rssi, honest.rssi)
    changed = np.flatnonzero((swapped.position != honest.position).any(axis=1))
    assert len(changed) == 2
    assert np.array_equal(swapped.position[changed], honest.position[changed[::-1]])
    assert np.hypot(*(other.position - honest.position).T) == pytest.approx(np.full(len(honest.position), 30.0))
