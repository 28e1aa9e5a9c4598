"""Place recognition by radio scans."""

import numpy as np
import pytest

from pdr_graph.estimation.fingerprinting import Scans, revisits
from pdr_graph.priors import SCANS, changed
from pdr_graph.types import Trajectory

ACCESS_POINTS = np.random.default_rng(0).uniform(0, 60, (40, 2))


def heard_along(track, seed=0):
    """Scans at every second, by path loss and 3 dB of noise."""
    distance = np.hypot(*(track.position[:, None] - ACCESS_POINTS).transpose(2, 0, 1))
    level = -40 - 25 * np.log10(distance.clip(1)) + np.random.default_rng(seed).normal(0, 3, distance.shape)
    names = tuple(f"ap{n}" for n in range(len(ACCESS_POINTS)))
    return Scans(track.time, names, np.maximum(level - SCANS.faintest - 20, 0.0))


def along(start, end, seconds=60, floor=""):
    position = np.linspace(start, end, seconds)
    heading = np.full(seconds, np.arctan2(*(np.subtract(end, start)[::-1])))
    return Trajectory(np.arange(seconds, dtype=float), position, heading, (floor,) * seconds)


def places(closures, walks):
    return [
        np.array([walks[w].position[round(t)] for w, t in zip(closures.walk[:, k], closures.time[:, k], strict=True)])
        for k in (0, 1)
    ]


def found(walks, known=None):
    return revisits([(known or track, heard_along(track, n)) for n, track in enumerate(walks)])


def test_two_walks_of_one_corridor_are_linked_at_the_same_places():
    """One there and one back: 90 % of the closures within three of their stated sigmas, and those of a few metres."""
    walks = [along((5, 5), (55, 5)), along((55, 6), (5, 6))]
    closures = found(walks)
    first, second = places(closures, walks)
    assert len(closures) >= 10
    apart = np.hypot(*(first - second).T)
    assert np.mean(apart < 3 * closures.sigma) > 0.9
    assert np.median(apart) < 5.0


def test_walks_of_different_floors_or_transmitters_and_single_ones_are_not_linked():
    assert len(found([along((5, 5), (55, 5), floor="1"), along((5, 6), (55, 6), floor="2")])) == 0
    walk = along((5, 5), (55, 5))
    scans = heard_along(walk)
    other = Scans(scans.time, tuple(name + "'" for name in scans.transmitter), scans.level)
    assert len(revisits([(walk, scans), (walk, other)])) == 0
    assert len(found([along((5, 5), (30, 5), 20)])) == len(found([])) == 0


def test_a_walk_is_linked_with_itself_only_at_later_revisits():
    """There and back within two minutes: moments a minute apart at least."""
    there, back = along((5, 5), (55, 5)), along((55, 5), (5, 5))
    track = Trajectory(np.arange(120.0), np.concatenate([there.position, back.position]), np.zeros(120), ("",) * 120)
    closures = found([track])
    assert len(closures)
    assert (closures.walk == 0).all()
    assert (np.abs(np.diff(closures.time, axis=1)) >= 60).all()


def test_correlated_links_count_as_one():
    """Twice as many closures of a stretch have the information of half of them, within a third."""
    walks, worth = [along((5, 5), (55, 5)), along((5, 6), (55, 6))], []
    for every in (1.0, 2.0):
        with changed(SCANS, scan_spacing=every):
            closures = found(walks)
            worth.append((len(closures), np.sum(closures.sigma**-2.0)))
    (many, of_many), (few, of_few) = worth
    assert many > 1.5 * few
    assert of_many == pytest.approx(of_few, rel=0.35)


def test_uncertain_walks_are_linked_with_the_default_sigma():
    """They are placed 100 m apart, so that no places are near each other."""
    walks = [along((5, 5), (55, 5)), along((5, 6), (55, 6))]
    moved = [walks[0], along((105, 106), (155, 106))]
    closures = revisits(
        [(estimate, heard_along(track, n)) for n, (estimate, track) in enumerate(zip(moved, walks, strict=True))]
    )
    first, second = places(closures, walks)
    assert len(closures)
    assert np.median(np.hypot(*(first - second).T)) < 5.0
