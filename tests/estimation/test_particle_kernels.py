"""Compiled steps of particles: those of NumPy to the last bit, and only where they can be had."""

import sys

import numpy as np
import pytest
import shapely
from plans import plan

from pdr_graph import estimation
from pdr_graph.estimation import particle_filter as filter_module
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.particle_filter import (
    COMPILED,
    LOAD_AFTER,
    Compiled,
    ParticleFilter,
    Walls,
    stepped,
)

NUMPYS = filter_module._first_try


@pytest.fixture
def compiled():
    """The compiled functions, also where numba is missing in other runs."""
    pytest.importorskip("numba", reason="the extra fast")
    loader = Compiled()
    loader.load()
    assert loader.functions is not None
    return loader.functions


def by(functions, monkeypatch, run):
    """The result of ``run`` by some functions, NumPy's if None, and how many particles NumPy moved."""
    monkeypatch.setattr(COMPILED, "functions", functions)
    monkeypatch.setattr(COMPILED, "moved", LOAD_AFTER)
    tried = []
    monkeypatch.setattr(
        filter_module, "_first_try", lambda state, *rest: tried.append(state.shape[1]) or NUMPYS(state, *rest)
    )
    result = run()
    monkeypatch.undo()
    return result, sum(tried)


def shops():
    """A hall with a shop, a thin wall with a door, and slanted walls."""
    return plan(
        ("room", shapely.Polygon([(0, 0), (20, -3), (22, 8), (0, 10)])),
        ("room", shapely.box(-10, 0, 0, 10)),
        ("door", shapely.Point(0, 5)),
        ("shop", shapely.box(8, 2, 12, 6)),
    )


def crowd(n, seed):
    """Particles all over a plan and around it, in all directions."""
    random = np.random.default_rng(seed)
    place = random.uniform([[-14], [-6]], [[26], [14]], (2, n))
    c = np.array([[1.0], [1.0], [0.0]]) + [[0.1], [0.05], [0.01]] * random.standard_normal((3, n))
    return np.concatenate([place, random.uniform(-np.pi, np.pi, (1, n)), c])


@pytest.mark.parametrize("length", [0.1, 0.7, 5.0, 200.0])
@pytest.mark.parametrize("turn_sigma", [0.02, 1.2], ids=["walking", "the phone may turn"])
def test_a_compiled_step_is_that_of_numpy_to_the_last_bit(compiled, monkeypatch, length, turn_sigma):
    floor, sigma = shops().distance, np.array([0.07, 0.25, turn_sigma])
    for n, seed in ((1, 1), (7, 2), (5000, 3)):
        state = crowd(n, seed)

        def step(state=state, seed=seed):
            random = np.random.default_rng(seed)
            return *stepped(state, length, 0.3, 0.5, sigma, Walls(floor), random), random.random()

        (after, price, next_random), count = by(None, monkeypatch, step)
        (after_too, price_too, next_too), by_numpy = by(compiled, monkeypatch, step)
        assert np.array_equal(after, after_too)
        assert np.array_equal(price, price_too)
        assert next_random == next_too, "as many random numbers were drawn"
        assert (count, by_numpy) == (n, 0), "the second was compiled"


def test_a_step_into_tiles_that_are_missing_is_that_of_numpy(compiled, monkeypatch):
    """A live step computes one tile at most, and takes other places for free until then."""
    state, sigma = crowd(3000, 4), np.array([0.07, 0.25, 0.02])

    def walked():
        floor, random = shops().distance, np.random.default_rng(0)
        walls, states = Walls(floor, 1, floor.no_tiles()), [state]
        for _ in range(40):
            states.append(stepped(states[-1], 0.7, 0.1, 0.5, sigma, walls, random)[0])
        return states

    expected, _ = by(None, monkeypatch, walked)
    states, by_numpy = by(compiled, monkeypatch, walked)
    assert np.array_equal(states, expected)
    assert 0 < by_numpy < 40 * 3000, "some steps met missing tiles, others did not"


def moved(loader, monkeypatch, **given):
    """Move 1000 particles until loading is repaid, and once more."""
    monkeypatch.setattr(filter_module, "COMPILED", loader)
    monkeypatch.setattr(filter_module, "LOAD_AFTER", 3000)
    particles = ParticleFilter(Prior(), 0, fewest=1000, most=1000, **given)
    particles.begin_at(crowd(1000, 5))
    for _ in range(4):
        particles.step(0.7, 0.1, 0.5, np.array([0.01, 0.06, 0.001]), shops().distance)
    return particles.state


def forget(monkeypatch):
    """Import the compiled functions anew."""
    monkeypatch.delitem(sys.modules, f"{estimation.__name__}.particle_kernels", raising=False)
    monkeypatch.delattr(estimation, "particle_kernels", raising=False)


def test_functions_are_loaded_when_that_has_paid_but_never_in_a_live_step(compiled, monkeypatch):
    late, live = Compiled(), Compiled()
    moved(late, monkeypatch)
    moved(live, monkeypatch, at_once=1)
    assert late.functions is compiled
    assert live.functions is None


def no_numba(monkeypatch):
    monkeypatch.setitem(sys.modules, "numba", None)


def no_folder(monkeypatch):
    """Nowhere to keep what numba compiles."""
    caching = pytest.importorskip("numba.core.caching", reason="the extra fast")
    cache = getattr(caching, "CacheImpl", None) or caching._CacheImpl  # its name in older versions
    monkeypatch.setattr(cache, "_locator_classes", [])


@pytest.mark.parametrize("without", [no_numba, no_folder])
def test_where_nothing_can_be_compiled_numpy_moves_all_particles(without, monkeypatch):
    expected, loader = moved(Compiled(), monkeypatch), Compiled()
    forget(monkeypatch)
    without(monkeypatch)
    assert np.array_equal(moved(loader, monkeypatch), expected)
    assert loader.functions is None
