"""What keeps the package fast, as claims about growth and about what is loaded; seconds are for scripts/benchmark."""

import gc
import subprocess
import sys
import textwrap
import time
import tracemalloc

import numpy as np
import pytest
from walks import fixes_on, wandering_walk

from pdr_graph import WalkGraph, dead_reckon, smooth
from pdr_graph.estimation.kalman import kalman_filter

SLOW_TO_LOAD = ("gtsam", "scipy.signal", "scipy.stats", "scipy.optimize", "matplotlib.pyplot", "sklearn", "pandas")
RUNS = 3


def least_time(function, graph_of):
    """CPU time [s]: other processes of the machine add little to it."""
    times = []
    for _ in range(RUNS):
        began = time.process_time()
        function(graph_of())
        times.append(time.process_time() - began)
    return min(times)


@pytest.mark.parametrize("function", [smooth, kalman_filter])
def test_ten_times_the_steps_take_about_ten_times_as_long(function):
    """20 instead of 10, since caches and a noisy machine have their part; what is quadratic would take 100."""

    def graph_of(n):
        steps = wandering_walk(n)
        fixes = fixes_on(dead_reckon(steps), 30, sigma=2.0, seed=1)
        return lambda: WalkGraph(steps, fixes)

    short, long = (least_time(function, graph_of(n)) for n in (1000, 10_000))
    assert long < 20 * short


def test_memory_of_a_walk_does_not_grow_with_its_square():
    """The covariance of every step, not of every pair: 10⁴ steps would need 7 GB of pairs."""
    steps = wandering_walk(10_000)
    track = smooth(WalkGraph(steps, fixes_on(dead_reckon(steps), 100))).trajectory
    assert track.covariance is not None
    assert track.covariance.shape == (10_002, 3, 3)
    assert np.isfinite(track.covariance).all()


def test_a_walk_takes_about_a_kilobyte_per_step():
    """1.3 kB was measured without the garbage collector: states that the search has left are freed at once."""
    steps = wandering_walk(30_000)
    fixes = fixes_on(dead_reckon(steps), 30, sigma=2.0, seed=1)
    gc.disable()
    tracemalloc.start()
    try:
        smooth(WalkGraph(steps, fixes))
        assert tracemalloc.get_traced_memory()[1] < 1400 * len(steps)
    finally:
        tracemalloc.stop()
        gc.enable()


LOADED = "import sys, {}; print(*(name for name in {} if name in sys.modules))"


@pytest.mark.parametrize(
    ("modules", "slow"),
    [
        (
            "pdr_graph.apps.cli, pdr_graph.walk, pdr_graph.apps.report.plotting, pdr_graph.apps.report.content",
            SLOW_TO_LOAD,
        ),
        ("pdr_graph.apps.report.output_files, pdr_graph.apps.report.content", ("matplotlib",)),
        (
            "pdr_graph.apps.lifelog.show, pdr_graph.apps.lifelog.revision",
            ("scipy", "vqf", "matplotlib", "pdr_graph.walk"),
        ),
    ],
)
def test_a_command_loads_nothing_that_takes_long_and_is_not_needed(modules, slow):
    """Each of these takes a tenth of a second to half of one; together as long as an hour's graph."""
    said = LOADED.format(modules, slow)
    loaded = subprocess.run([sys.executable, "-c", said], check=True, capture_output=True, text=True).stdout.split()
    assert loaded == []


def test_the_garbage_of_a_walk_is_not_frozen_with_the_modules():
    """A program that smooths many walks would grow with each."""
    code = """
        import gc
        from pdr_graph.apps.report.output_files import keep_modules

        keep_modules()
        before = gc.get_freeze_count()
        garbage = [[] for _ in range(1000)]
        keep_modules()
        assert gc.get_freeze_count() <= before
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=True, timeout=60)
