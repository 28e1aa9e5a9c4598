"""The walks of several days and people in one graph: encounters, and blocks of bounded size."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from observations import NOON, estimated_together, median_error, observation, walk

from pdr_graph.apps.lifelog import multi_day
from pdr_graph.apps.lifelog.multi_day import (
    CONTEXT,
    ENCOUNTER_PERIOD,
    ENCOUNTER_SIGMA,
    MAX_CONTEXT_STEPS,
    MAX_STEPS,
    MAX_WALKS,
    MIN_RSSI,
    CarriedPhone,
    WalkPlace,
    blocks,
    encounters,
)
from pdr_graph.apps.lifelog.reconstruct import reconstruct
from pdr_graph.types import Sightings

PHONES = {"anna's": "anna", "ben's": "ben"}
DAY = 86_400.0


def heard(times, level=-55.0, who="ben's"):
    times = np.asarray(times, dtype=float)
    return Sightings(times, (who,) * len(times), np.full(len(times), float(level)))


# Encounters of two people whose phones received each other


def anna(sightings, epoch=1000.0):
    return CarriedPhone("anna", epoch, 0.0, 600.0, sightings)


def ben(sightings=None, epoch=900.0):
    return CarriedPhone("ben", epoch, 0.0, 600.0, sightings)


@pytest.mark.parametrize(
    ("phones", "times"),
    [((anna(heard([50.0])), ben()), [50.0, 150.0]), ((anna(None), ben(heard([150.0], who="anna's"))), [150.0, 50.0])],
)
def test_a_reception_by_either_phone_closes_both_walks_at_its_time(phones, times):
    closures = encounters(phones, PHONES)
    assert closures.time == pytest.approx(np.array([times]))
    assert closures.walk.tolist() == [[0, 1] if times[0] == 50.0 else [1, 0]]


def test_only_the_level_of_a_metre_or_more_is_an_encounter():
    """Levels of ten metres, as closures, contract the walks of a crowd to half of their extent."""
    met = [encounters([anna(heard([50.0], level)), ben()], PHONES).sigma.tolist() for level in (-45, -62, -63, -80)]
    assert met == [[ENCOUNTER_SIGMA], [ENCOUNTER_SIGMA], [], []]


def test_a_conversation_is_one_encounter_per_period():
    closures = encounters([anna(heard(np.arange(0, 60, 0.2))), ben()], PHONES)
    assert len(closures) == 60 / ENCOUNTER_PERIOD


@pytest.mark.parametrize(
    ("sightings", "other"),
    [
        pytest.param(heard([50.0], MIN_RSSI - 1), ben(epoch=800.0), id="weak"),
        pytest.param(heard([50.0], who="a stranger's"), ben(epoch=800.0), id="foreign"),
        pytest.param(heard([50.0], who="anna's"), ben(epoch=800.0), id="her own"),
        pytest.param(heard([590.0]), ben(epoch=800.0), id="after the end of Ben's walk"),
        pytest.param(heard([-10.0]), ben(epoch=800.0), id="before the start of hers"),
        pytest.param(heard([50.0], who="anna's"), anna(None, 950.0), id="walks of one person"),
    ],
)
def test_receptions_that_are_no_encounters(sightings, other):
    assert len(encounters([anna(sightings), other], PHONES)) == 0


# Days estimated together


def side_by_side(seed=3, n=240):
    """Anna, whose phone has fixes, and Ben beside her, whose phone has none; both, and the truth."""
    anna, truth = walk(n, seed)
    anna = replace(anna, bluetooth=heard(np.arange(5.0, anna.duration, 20.0)))
    start = anna.fixes[:1]
    ben = observation(anna.steps, replace(start, time=np.zeros(1), position=truth.position[:1], sigma=np.array([3.0])))
    return anna, ben, truth


def track_of(day):
    return day.outings[0].trajectory


def test_encounters_locate_a_walk_in_any_order_of_people():
    """Ben has a fix at his start and no compass; each encounter is good to a few metres."""
    anna, ben, truth = side_by_side()
    alone = reconstruct("ben", "2023-11-14", {"ben": ben}, None)
    of_anna, of_ben = forth = estimated_together([("anna", anna), ("ben", ben)], PHONES)
    assert median_error(track_of(of_ben), truth) < min(0.3 * median_error(track_of(alone), truth), 3.0)
    assert median_error(track_of(of_anna), truth) < 2.0
    back = estimated_together([("ben", ben), ("anna", anna)], PHONES)[::-1]
    for one, other in zip(forth, back, strict=True):  # segments of calibration begin elsewhere
        assert track_of(one).position == pytest.approx(track_of(other).position, abs=0.3)


@pytest.mark.parametrize(("phones", "later"), [({}, 0.0), (PHONES, DAY)], ids=["no phone", "another day"])
def test_a_day_without_encounters_is_unchanged(phones, later):
    anna, ben, _ = side_by_side()
    people = [("anna", anna), ("ben", replace(ben, epoch=NOON + later))]
    for day, (name, one) in zip(estimated_together(people, phones), people, strict=True):
        alone = reconstruct(name, "2023-11-14", {name: one}, None)
        assert np.array_equal(track_of(day).position, track_of(alone).position)
        assert (day.profile is None) == (alone.profile is None)


# Blocks: each walk is estimated once, in a graph of bounded size, bound to the walks before it


def history(steps, days=None):
    """Walks of ten minutes with these numbers of steps, on a day each."""
    days = range(len(steps)) if days is None else days
    return [
        WalkPlace(n, 0, DAY * day, DAY * day + 600, count)
        for n, (day, count) in enumerate(zip(days, steps, strict=True))
    ]


def own_walks(block):
    return [walk for walk in block.walks if walk not in block.context]


@given(st.lists(st.integers(10, 30_000), min_size=2, max_size=120))
def test_each_walk_is_in_one_block_of_bounded_size(steps):
    walks, made = history(steps), list(blocks(history(steps)))
    own = [walk for block in made for walk in own_walks(block)]
    assert sorted(own) == sorted(set(own))
    assert len(set(walks) - set(own)) <= 1, "a walk that is alone in its block and has no context binds nothing"
    for block in made:
        without = own_walks(block)
        assert len(without) == 1 or (len(without) <= MAX_WALKS and sum(walk.steps for walk in without) <= MAX_STEPS)
        assert len(block.context) <= CONTEXT
        assert len(block.context) <= 1 or sum(walk.steps for walk in block.context) <= MAX_CONTEXT_STEPS
        assert list(block.walks) == sorted(block.walks), "in the order of the history"


def test_a_long_history_has_a_second_block_whose_context_is_the_end_of_the_first():
    walks = history([500] * (MAX_WALKS + 5))
    first, second = blocks(walks[::-1])
    assert (list(first.walks), len(first.context)) == (walks[:MAX_WALKS], 0)
    assert second.context == frozenset(first.walks[-CONTEXT:])


def test_walks_of_the_same_time_are_in_one_block_up_to_a_limit():
    """A crowd of 40 people on two days, and one of 200 on one."""
    made = [{walk.start for walk in own_walks(block)} for block in blocks(history([500] * 80, [0] * 40 + [1] * 40))]
    assert made == [{0.0}, {DAY}]
    crowd = [len(own_walks(block)) for block in blocks(history([500] * 200, [0] * 200))]
    assert (sum(crowd), max(crowd)) == (200, 2 * MAX_WALKS)


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


def test_walks_in_blocks_are_bound_to_the_blocks_before(monkeypatch):
    """Blocks this small cost accuracy: 5.7 m in one graph, 13 m in blocks of four, 23 m each by itself."""
    walks = [scanned(seed) for seed in range(12)]

    def mean_error():
        made = estimated_together([("me", one) for one, _ in walks], {})
        apart = [track_of(day).position - truth.position for day, (_, truth) in zip(made, walks, strict=True)]
        return np.mean(np.hypot(*np.concatenate(apart).T))

    monkeypatch.setattr(multi_day, "MAX_WALKS", 4)
    monkeypatch.setattr(multi_day, "CONTEXT", 3)
    parted = mean_error()
    monkeypatch.setattr(multi_day, "bound_walks", lambda *_: ())
    assert parted < 0.6 * mean_error()
