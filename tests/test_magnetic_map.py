"""The magnetic map whose worth docs/results/magnetic.md states: scripts/magnetic.py."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def magnetic(scripts_on_path):
    import magnetic

    return magnetic


def field(position):
    """A field whose waves are 5 to 9 m long. [µT]"""
    x, y = position.T
    waves = np.sin(1.1 * x + 0.4 * y), np.cos(0.9 * x - 0.3 * y), np.sin(0.7 * x + 0.8 * y)
    return np.array([0, 28, -32]) + 8 * np.stack(waves, axis=1)


def line(magnetic, piece, y, sigma=3.0):
    """Samples each metre along y, from x = 0 to 60 m."""
    x, number = np.arange(60.0), np.full(60, piece)
    position = np.column_stack([x, np.full(60, y)])
    covariance = np.tile(sigma**2 * np.eye(2), (60, 1, 1))
    return magnetic.Samples(number, number, x, position, np.zeros(60), field(position), covariance)


def joined(magnetic, parts):
    return magnetic.Samples(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))


@pytest.fixture
def learnt(magnetic):
    """Six walks along an aisle of 5 m, and its map."""
    samples = joined(magnetic, [line(magnetic, n, float(n)) for n in range(6)])
    return samples, magnetic.FieldMap(samples, np.array([-25.0, -30.0]), np.array([85.0, 35.0]))


@pytest.mark.parametrize("off", [(2.0, 0.0), (-1.5, 1.5)])
def test_a_sequence_is_drawn_to_its_place(magnetic, learnt, off):
    """An estimate off by two metres: the lines cross within half a metre of the truth, and say so."""
    true = line(magnetic, 9, 2.5)[20:40]
    moved = replace(true, position=true.position + off)
    lines = magnetic.lines_of(moved, learnt[1], 20)
    place = np.linalg.solve(lines.normal, lines.offset)
    apart = place - true.position[10]
    assert np.hypot(*apart) < 0.8
    assert (np.abs(lines.normal @ apart) < 3 * lines.sigma).all()


def test_the_map_is_the_field_where_walks_went_and_knows_nothing_elsewhere(magnetic, learnt):
    samples, field_map = learnt
    at = np.round((samples.position - field_map.low) / magnetic.CELL).astype(int)
    near = field_map.mean[at[:, 0], at[:, 1]] - samples.field
    assert near.std() < 0.5 * samples.field.std(axis=0).mean()
    far = field_map.variance[0, 0] + field_map.constant
    assert far == pytest.approx(samples.field.var(axis=0))


def test_an_unmapped_place_gives_no_line(magnetic, learnt):
    true = line(magnetic, 9, 2.5)[20:40]
    assert magnetic.lines_of(replace(true, position=true.position - (0, 25.0)), learnt[1], 20) is None
