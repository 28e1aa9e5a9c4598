"""GPS and dead reckoning of [gps-dr]: each stage against an independent computation, and outages on simulated walks."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pdr_graph.frames import EarthField
from pdr_graph.gait.heading import forward_axis
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.lab.papers import gps_dr as paper
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Fixes, Trajectory


@pytest.fixture(scope="module")
def walk():
    return paper.simulated(3)


@pytest.fixture(scope="module")
def observed(walk):
    return paper.Observed.of(walk)


def steps_and_fixes():
    random = np.random.default_rng(0)
    steps = paper.PaperSteps(np.arange(0.5, 20.0, 0.5), random.normal(0, 1, (39, 2)), random.uniform(0.01, 0.1, 39))
    time = np.arange(0.0, 20.0, 1.7)
    return steps, Fixes(time, random.normal(0, 5, (len(time), 2)), random.uniform(1, 5, len(time)))


def test_the_position_filter_ends_where_least_squares_ends():
    """One row per unknown position: a step ties two of them, a fix one; each weighed by its standard deviation."""
    steps, fixes = steps_and_fixes()
    rows, right = [], []
    for n, variance in enumerate(steps.variance):
        rows.append((np.eye(40)[n + 1] - np.eye(40)[n]) / np.sqrt(variance))
        right.append(steps.displacement[n] / np.sqrt(variance))
    for time, place, sigma in zip(fixes.time, fixes.position, fixes.sigma, strict=True):
        rows.append(np.eye(40)[np.searchsorted(steps.time, time, side="right")] / sigma)
        right.append(place / sigma)
    expected = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0][-1]
    assert paper.position_filter(steps, fixes).position[-1] == pytest.approx(expected, abs=1e-9)


def test_without_fixes_the_position_filter_is_dead_reckoning():
    steps, fixes = steps_and_fixes()
    track = paper.position_filter(steps, fixes[:1]).position
    assert track[-1] - fixes.position[0] == pytest.approx(steps.displacement.sum(axis=0))


def test_dead_reckoning_goes_on_from_the_last_fix():
    fixes = Fixes(np.array([0.0, 2.0]), np.array([[0.0, 0.0], [100.0, 0.0]]), np.ones(2))
    eastwards = Trajectory(np.array([0.0, 10.0]), np.array([[5.0, 5.0], [15.0, 5.0]]), np.zeros(2))
    track = paper.continued(eastwards, fixes, np.array([1.0, 2.0, 5.0]))
    assert track.position.tolist() == [[1.0, 0.0], [100.0, 0.0], [103.0, 0.0]]


def test_outages_are_as_long_as_stated_and_have_fixes_between_them():
    time = np.arange(0.0, 1000.0)
    truth = Trajectory(time, np.zeros((1000, 2)), np.zeros(1000))
    for seconds in paper.OUTAGES.values():
        cut = np.array(paper.outages(truth, seconds))
        assert (cut.sum(axis=1) == seconds).all()
        assert cut.sum(axis=0).max() == 1
        assert np.diff(cut.argmax(axis=1)).min() >= 3 * seconds


EARTH = EarthField(45.0, np.radians(-8.0), np.radians(50.0))


def at_rest_in(field, seconds=200.0, period=0.02, drift=0.0):
    """North by the filter in a world that drifts [rad/s] against a resting phone. field: ``(3,)`` or ``(n, 3)``."""
    time = np.arange(0.0, seconds, period)
    turned = Rotation.from_euler("z", drift * time[:, None])
    still = np.tile([0.0, 0.0, 9.81], (len(time), 1))
    attitude = Attitude(time, period, turned, still, np.tile([0.0, 0.0, drift], (len(time), 1)))
    return paper.causal_north(attitude, np.broadcast_to(field, (len(time), 3)).copy(), EARTH)


def test_true_north_is_magnetic_north_corrected_by_the_declination():
    """The world model's vector points 8° west of true north, which lies at +90° in a world of east and north."""
    assert np.degrees(at_rest_in(EARTH.vector)[-1]) == pytest.approx(90.0, abs=0.1)


def test_north_follows_a_drifting_gyroscope():
    """0.003 rad/s, as of a phone: the lag is the drift over the gain, a few degrees."""
    north = at_rest_in(EARTH.vector, drift=0.003)
    assert np.degrees(north[-1]) == pytest.approx(90 + np.degrees(0.003 * 199.98), abs=3.0)


def test_a_field_with_a_wrong_dip_moves_north_less_than_one_with_a_right_dip():
    """Sec. 3, first test: both fields are turned by 40°, one of them also points 40° less steeply down."""
    turned = Rotation.from_euler("z", 40, degrees=True).apply(EARTH.vector)
    level = np.hypot(*turned[:2])
    shallow = np.append(turned[:2], -level * np.tan(EARTH.dip - np.radians(40)))
    moved = []
    for disturbed in (turned, shallow):
        field = np.tile(EARTH.vector, (10000, 1))
        field[5000:5500] = disturbed
        moved.append(np.degrees(np.abs(at_rest_in(field)[5499] - np.pi / 2)))
    assert moved[1] < moved[0] / 3


def test_constants_of_the_calibration_walk_give_the_length_of_another_walk(walk, observed):
    """The regression is unbiased for the person: 1650 m within 5 %."""
    steps, _ = observed.paper[paper.FILTER]
    true = np.hypot(*np.diff(walk.truth.position, axis=0).T).sum()
    assert np.hypot(*steps.displacement.T).sum() == pytest.approx(true, rel=0.05)


def test_the_forward_axis_of_the_device_outlasts_turns_and_the_drift_of_the_attitude():
    """The axis is calibrated on the first leg; the courses of all others are right too, with the product's axis."""
    route = [[0, 0], {"stand": 5}, {"to": [[60, 0], [60, 40], [0, 40], [0, 0], [60, 0]]}, {"stand": 2}]
    for seed in range(3):
        simulation = simulate(Scenario.of({"seed": seed, "route": route, "phone": {"rate": 50}}))
        gait, course = paper.paper_gait(simulation.recording(), forward_axis)
        time = gait.landings.time - gait.landings.period / 2
        turned = np.interp(time, gait.attitude.time, simulation.world_of(gait.attitude).as_rotvec()[:, 2])
        true = np.interp(time, simulation.body.time, np.unwrap(simulation.body.heading))
        off = np.angle(np.exp(1j * (course - turned - true)))
        assert np.degrees(np.percentile(np.abs(off), 80)) < 35


def test_fixes_after_an_outage_help_the_smoothers_and_true_headings_the_papers_filter(observed):
    """The paper's filter has no state for the heading, so that a wrong one pulls it off between all fixes."""
    _, rows = paper.in_outages([observed], 120.0)
    mean = {row[0]: float(row[1]) for row in rows}
    assert max(mean[paper.RTS], mean[paper.BY_GRAPH]) < mean[paper.EKF] < mean[paper.HELD]
    assert mean[paper.TRUE_COURSE] < mean[paper.FILTER]


def test_the_tables_have_a_row_for_each_method(monkeypatch, tmp_path):
    monkeypatch.setattr(paper, "QUICK_WALKS", 1)
    monkeypatch.setattr(paper, "ROUTE_CORNERS", [[180, 0], [180, 120], [0, 0]])
    monkeypatch.setenv("PDR_GRAPH_DATA", str(tmp_path))
    tables = paper.experiment(quick=True)
    assert len({table.name for table in tables}) == len(tables) == 3
    for table in tables:
        assert {len(row) for row in table.rows} == {len(table.header)}
