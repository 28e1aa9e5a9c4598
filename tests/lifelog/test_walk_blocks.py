"""Blocks of walks: each walk is estimated once, in a graph of bounded size, bound to the walks before it."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from observations import NOON, estimated_together, walk

from pdr_graph.apps.lifelog import multi_day
from pdr_graph.apps.lifelog.multi_day import (
    CONTEXT,
    MAX_CONTEXT_STEPS,
    MAX_STEPS,
    MAX_WALKS,
    WalkPlace,
    blocks,
)
from pdr_graph.estimation.fingerprinting import _alike
from pdr_graph.priors import SCANS
from pdr_graph.types import Sightings

DAY = 86_400.0


def history(steps, days=None):
    """Walks of ten minutes with these numbers of steps, on a day each."""
    days = range(len(steps)) if days is None else days
    return [
        WalkPlace(n, 0, DAY * day, DAY * day + 600, count)
        for n, (day, count) in enumerate(zip(days, steps, strict=True))
    ]


@given(st.lists(st.integers(10, 30_000), min_size=2, max_size=120))
def test_each_walk_is_in_one_block_of_bounded_size(steps):
    walks, made = history(steps), list(blocks(history(steps)))
    own = [walk for block in made for walk in block.walks if walk not in block.context]
    lone = set(walks) - set(own)
    assert sorted(own) == sorted(set(own))
    assert len(lone) <= 1, "a walk that is alone in its block and has no context binds nothing"
    for block in made:
        without = [walk for walk in block.walks if walk not in block.context]
        assert len(without) == 1 or (len(without) <= MAX_WALKS and sum(walk.steps for walk in without) <= MAX_STEPS)
        assert len(block.context) <= CONTEXT
        assert len(block.context) <= 1 or sum(walk.steps for walk in block.context) <= MAX_CONTEXT_STEPS
        assert list(block.walks) == sorted(block.walks), "in the order of the history"


def test_a_short_history_is_one_block():
    walks = history([500] * MAX_WALKS)
    assert [(list(block.walks), len(block.context)) for block in blocks(walks[::-1])] == [(walks, 0)]


def test_the_context_is_the_end_of_the_block_before():
    first, second = blocks(history([500] * (MAX_WALKS + 5)))
    assert second.context == frozenset(first.walks[-CONTEXT:])


def test_walks_of_the_same_time_are_in_one_block():
    """A crowd of 40 people on two days."""
    walks = history([500] * 80, [n // 40 for n in range(80)])
    made = [{walk.start for walk in block.walks if walk not in block.context} for block in blocks(walks)]
    assert made == [{0.0}, {DAY}]


def test_a_crowd_has_limits():
    made = [len(block.walks) - len(block.context) for block in blocks(history([500] * 200, [0] * 200))]
    assert sum(made) == 200
    assert max(made) == 2 * MAX_WALKS


@given(st.lists(st.tuples(st.integers(0, 3), st.floats(0, 300)), max_size=60))
def test_closures_with_one_error_are_counted_pair_by_pair(rows):
    pair, way = np.array([p for p, _ in rows], dtype=int), np.array([w for _, w in rows], dtype=float)
    near = (pair[:, None] == pair) & (np.abs(way[:, None] - way) < SCANS.along)
    assert _alike(pair, way).tolist() == near.sum(axis=1).tolist()


def scanned(seed, steps=150):
    """A walk from the model with scans of sixty access points, every second one with a single fix, and the truth."""
    one, truth = walk(steps, seed, NOON + DAY * seed)
    one = replace(one, fixes=one.fixes[:1]) if seed % 2 else one
    points = np.random.default_rng(7).uniform(-100, 100, (60, 2))
    time, random = np.arange(2.0, one.duration, 4.0), np.random.default_rng(seed)
    place = np.column_stack([np.interp(time, truth.time, truth.position[:, axis]) for axis in (0, 1)])
    distance = np.hypot(*(place[:, None] - points).transpose(2, 0, 1)).clip(1.0)
    level = np.round(-40 - 25 * np.log10(distance) + random.normal(0, 4, distance.shape))
    rows, which = np.nonzero(level > -85)
    return replace(one, wifi=Sightings(time[rows], tuple(f"{n:02}" for n in which), level[rows, which])), truth


def errors(made, truths):
    """Distance of all places of all days from the truth [m]."""
    tracks = [day.outings[0].trajectory for day in made]
    return np.concatenate([np.hypot(*(t.position - truth.position).T) for t, truth in zip(tracks, truths, strict=True)])


def test_walks_in_blocks_are_bound_to_the_blocks_before(monkeypatch):
    """Blocks this small cost accuracy: 4.6 m in one graph, 9 m in blocks of four, 31 m each by itself."""
    walks = [scanned(seed) for seed in range(12)]
    days = [("me", one) for one, _ in walks]
    truths = [truth for _, truth in walks]
    monkeypatch.setattr(multi_day, "MAX_WALKS", 4)
    monkeypatch.setattr(multi_day, "CONTEXT", 3)
    parted = errors(estimated_together(days, {}), truths)
    monkeypatch.setattr(multi_day, "bound_walks", lambda *_: ())
    alone = errors(estimated_together(days, {}), truths)
    assert np.mean(parted) < 0.5 * np.mean(alone)
