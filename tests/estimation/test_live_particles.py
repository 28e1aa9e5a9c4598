"""The particle filter keyframe by keyframe: in bounded memory, and robust to faults."""

import tracemalloc

import numpy as np
import pytest
import shapely
from walks import PERIOD, fixes_at, steps_of

from pdr_graph import FloorPlan, Headings, WalkGraph
from pdr_graph.estimation.ambiguity.path_modes import dominant_modes
from pdr_graph.estimation.factors.chain import intervals, whole_pieces
from pdr_graph.estimation.factors.fixes import FixCosts
from pdr_graph.estimation.factors.heading_prior import HeadingCosts
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.particle_filter import COMPILED, ParticleFilter, particle_filter, pose_costs
from pdr_graph.floor.cells import Area
from pdr_graph.frames import Frame

FEWEST, MOST = 400, 500
STRIDE = 0.7  # [m]


def aisle(length=400.0):
    """An aisle of 2 m between shops."""
    outline = shapely.box(-2, -4, length, 6)
    shops = (shapely.box(0, -4, length, 0), shapely.box(0, 2, length, 6))
    return FloorPlan("1", (Area("floor", "", outline), *(Area("shop", "", shop) for shop in shops)), Frame())


def begun(seed=0, **given):
    """A cloud at the start of the aisle, facing along it."""
    cloud = ParticleFilter(Prior(), seed, fewest=FEWEST, most=MOST, **given)
    cloud.begin(np.array([0.5, 1.0]), 0.3, 0.0, 0.1)
    return cloud


def straight(count=10):
    """Ten steps straight on, as one interval."""
    steps = steps_of(np.full(count, STRIDE), np.zeros(count))
    return intervals(whole_pieces(steps), 0.0, 0.0, np.array([PERIOD * count]))


def row(length, seconds, sigma_length, sigma_turn, turn=0.0):
    """A single piece as an interval."""
    piece = np.array([[seconds, length, turn, sigma_length**2, sigma_length**2, sigma_turn**2]])
    return intervals(piece, 0.0, 0.0, np.array([seconds]))


def at(x, y=1.0, sigma=0.5):
    """A fix."""
    return (FixCosts(np.array([[x, y]]), np.array([sigma]), np.zeros(1, dtype=bool)),)


def on(cloud, floor, intervals, seen=None):
    """Straight on, so many intervals."""
    pieces = straight()
    for _ in range(intervals):
        cloud.advance(pieces, [floor.distance] * len(pieces.length), measured=seen or ())


def test_interval_by_interval_equals_the_whole_walk():
    n, floor = 60, aisle()
    steps = steps_of(np.full(n, STRIDE), np.full(n, 0.004))
    there = Headings(np.array([0.0, 12.0]), np.array([0.0, 0.1]), np.array([0.1, 0.3]))
    fixes = fixes_at([0.0, steps.time[30]], [[0.5, 1.0], [21.0, 1.0]], 0.5)
    graph = WalkGraph(steps, fixes, headings=there, floor=floor)
    at_once = particle_filter(graph)

    pieces, place = graph.pieces, graph.positions.fixes.position
    turn, time = 2 * (pieces.to_end - pieces.to_middle)

    def seen(keyframe):
        return pose_costs(graph.measurements, keyframe)

    cloud = ParticleFilter(graph.prior, 0, fewest=1000, most=8000)
    cloud.begin(place[0], 0.5, graph.start.poses[0, 2], graph.sigma_direction, measured=seen(0))
    for interval, (first, last) in enumerate(zip(pieces.first, pieces.last, strict=True)):
        for m in range(first, last + 1):
            cloud.step(float(pieces.length[m]), turn[m], time[m], pieces.variance[m], graph.floor_sequence.field(m))
        cloud.close(seen(interval + 1))
    paths = cloud.paths()
    assert np.array_equal(paths.state, at_once.state)
    assert np.array_equal(paths.weight, at_once.weight)


def test_dropped_keyframes_do_not_change_the_others():
    floor, whole, window = aisle(), begun(), begun()
    for _ in range(12):
        on(whole, floor, 1)
        on(window, floor, 1)
        window.forget(max(0, len(window.paths().state) - 5))
    assert np.array_equal(window.paths().state, whole.paths().state[-5:])
    assert np.array_equal(window.paths().weight, whole.paths().weight)


def test_memory_is_constant():
    floor, cloud, size = aisle(), begun(), []
    COMPILED.load()  # or it is loaded within
    tracemalloc.start()
    for keyframe in range(400):
        on(cloud, floor, 1, at(2.0, sigma=3.0))
        cloud.forget(max(0, len(cloud.paths().state) - 10))
        if keyframe % 100 == 99:
            size.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert size[-1] < 1.1 * size[0], "from the 100th keyframe to the 400th"


FAULTS = {
    "a dead end": lambda cloud, floor: on(cloud, aisle(3.0), 8),
    "a fix 1 km off": lambda cloud, floor: on(cloud, floor, 1, at(1000.0, 1000.0)),
    "fixes 1 km off that agree": lambda cloud, floor: on(cloud, floor, 6, at(1000.0, 1000.0)),
    "a compass that is sure of nonsense": lambda cloud, floor: on(
        cloud, floor, 3, (HeadingCosts(np.full(100, 2.0), np.full(100, 1e-9)),)
    ),
    "a crowd of fixes in another place": lambda cloud, floor: on(
        cloud, floor, 3, (FixCosts(np.full((300, 2), 60.0), np.full(300, 1e-3), np.ones(300, dtype=bool)),)
    ),
    "ten minutes of standing": lambda cloud, floor: [
        cloud.advance(row(0.0, 1.0, 0.0, 0.02), [floor.distance]) for _ in range(600)
    ],
    "a gap that leads anywhere": lambda cloud, floor: cloud.advance(row(0.0, 400.0, 500.0, 3.0), [floor.distance]),
    "a walk out of the plan": lambda cloud, floor: cloud.advance(row(300.0, 1.0, 0.1, 0.01, 3.0), [floor.distance]),
    "a walk far out of the plan": lambda cloud, floor: cloud.advance(row(1e6, 1.0, 0.1, 0.01, 3.0), [floor.distance]),
    "nothing between two keyframes": lambda cloud, floor: [cloud.close() for _ in range(3)],
}


@pytest.mark.parametrize("fault", FAULTS)
def test_after_a_fault_fixes_bring_the_particles_back(fault):
    """Particles stay finite; after six fixes along the aisle they are nearer to the last one than to any other."""
    floor, cloud = aisle(), begun(at_once=1)
    on(cloud, floor, 1)
    with np.errstate(all="raise", under="ignore"):
        FAULTS[fault](cloud, floor)
        for k in range(6):
            on(cloud, floor, 1, at(20.0 + 10 * STRIDE * k))
        paths = cloud.paths()
        share, middle = dominant_modes(paths)[0]
    assert np.isfinite(paths.state).all()
    assert paths.weight.sum() == pytest.approx(1.0)
    assert FEWEST <= len(paths.weight) <= MOST
    assert share > 0.5
    assert paths.state[-1, :2, middle] == pytest.approx([20.0 + 50 * STRIDE, 1.0], abs=5 * STRIDE)
