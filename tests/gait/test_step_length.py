"""Stride models against their equations, computed by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pdr_graph import Fixes, WalkGraph, detect_steps, smooth
from pdr_graph.gait import walker
from pdr_graph.gait.steps import gait_signals, steps_of
from pdr_graph.gait.walker import StepFeatures, Walker
from pdr_graph.geometry import interpolate
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate


def features(**values):
    given = {
        "amplitude": [4.0],
        "period": [0.5],
        "rhythm": [0.5],
        "turn": [0.0],
        "bend": [0.0],
        "vertical": [5.0],
        "lift": [0.3],
        "power": [[0, 0, 0, 0]],
    }
    return SimpleNamespace(**{name: np.array(value, dtype=float) for name, value in (given | values).items()})


@pytest.fixture(scope="module")
def walked():
    """A walk from browsing to hurrying."""
    to = [{"to": [[20 * (n + 1), 0]], "manner": m} for n, m in enumerate(("browse", "slow", "normal", "fast"))]
    walk = simulate(Scenario.of({"seed": 4, "route": [[0, 0], {"stand": 2}, *to, {"stand": 2}]}))
    return walk, StepFeatures(gait_signals(walk.recording("accelerometer", "gyroscope"))[0])


NORMAL = {"normal_step": 0.7, "normal_cadence": 100.0}
EQUATIONS = {
    "[calibration-walk] Eq. (6): 0.26 · 1.70 + 0.31": (walker.by_height, {}, {"height": 1.70}, 0.752),
    "[map-matching] Eqs. (1)–(3): at 120 steps/min": (walker.by_cadence, {}, NORMAL, 0.84),
    "in a turn by 30° 66.28 %": (walker.by_cadence, {"turn": [-np.pi / 6]}, NORMAL, 0.84 * (1 - 0.01124 * 30)),
    "clipped at 89°": (walker.by_cadence, {"turn": [3.0]}, NORMAL, 0.2),
    "Weinberg: the fourth root": (walker.weinberg, {"vertical": [16.0]}, {"k": 0.4}, 0.8),
}


@pytest.mark.parametrize("name", EQUATIONS)
def test_a_stride_model_is_its_equation(name):
    model, step, constants, length = EQUATIONS[name]
    assert model(features(**step), **constants)[0] == pytest.approx(length)


def test_the_default_model_is_shorter_in_bends():
    """[map-matching] Eq. (2): by 11.24 % in a bend of 10° a step, to either side."""
    straight, left, right = (walker.inverted_pendulum(features(bend=[np.radians(v)]))[0] for v in (0, 10, -10))
    assert left == pytest.approx(straight * (1 - 0.1124))
    assert right == left


def test_regression_fits_the_constants_of_by_amplitude():
    """[gps-dr] Sec. 2.3: slope, intercept and residual variance."""
    random = np.random.default_rng(0)
    amplitude = random.uniform(2, 10, 4000)
    constants = walker.regression(amplitude, 0.4 + 0.05 * amplitude + random.normal(0, 0.03, 4000))
    assert constants == pytest.approx({"intercept": 0.4, "slope": 0.05, "variance": 0.0009}, rel=0.06)
    found, sigma = walker.by_amplitude(features(), **constants)
    assert found == pytest.approx(0.65, abs=0.01)
    assert sigma == pytest.approx(0.03, rel=0.05)
    with pytest.raises(ValueError, match="three or more"):
        walker.regression(np.ones(9), np.ones(9))


def test_lasso_uses_the_five_terms_of_the_paper():
    """[calibration-walk] Eq. (7)."""
    terms = walker.lasso_features(features(power=[[1, 2, 3, 4]]), 1.8)
    assert terms[0] == pytest.approx([1.8 / 0.3, 1, 2, 3, 4])
    assert walker.lasso(features(power=[[1, 2, 3, 4]]), 1.8)[0] == pytest.approx(terms @ walker.lasso_weights())


def test_taller_people_take_longer_steps():
    step = features(power=[[9.8**2, 0.2, 0.1, 0]])
    for model in (walker.inverted_pendulum, walker.by_height, walker.lasso):
        assert model(step, height=1.9)[0] > model(step, height=1.5)[0]


@pytest.mark.parametrize("name", walker.MODELS)
def test_every_model_gives_plausible_lengths_and_a_sigma(walked, name):
    found, sigma = walker.MODELS[name](walked[1])
    assert found.shape == sigma.shape == walked[1].period.shape
    assert np.all((found >= 0.2) & (found <= 1.8))
    assert np.all((sigma > 0.02) & (sigma < 0.5))


def test_the_default_model_follows_from_browsing_to_hurrying(walked):
    """Each quarter within 55 %: steps from 0.42 to 0.78 m, for which a constant length errs by 80 %.

    The model is fitted to real walkers, whose steps at 0.4 m/s are 0.55 to 0.6 m long; simulated browsers take 0.42 m.
    """
    walk, steps = walked
    found, _ = walker.inverted_pendulum(steps, walk.walker.height)
    ends = np.interp([20, 40, 60, 80], np.cumsum(walk.body.lengths), walk.body.landings)
    landed = steps.gait.landings.time
    sums = np.array([found[(landed > a) & (landed <= b)].sum() for a, b in zip([0, *ends[:-1]], ends, strict=True)])
    assert sums == pytest.approx([20] * 4, rel=0.55)


@pytest.mark.parametrize("manner", ["jog", "run", "sprint"])
def test_runs_are_off_by_a_fifth_and_fixes_calibrate_them(manner):
    """The model by a quarter at most; with a fix of 1.5 m every ten seconds within 12 %, and in the stated region."""
    for seed in range(2):
        route = [[0, 0], {"stand": 3}, {"to": [[40, 0]]}, {"to": [[150, 0], [150, 90]], "manner": manner}, {"stand": 3}]
        walk = simulate(Scenario.of({"seed": seed, "route": route, "phone": {"hold": "trouser pocket"}}))
        body, steps = walk.body, detect_steps(walk.recording(), Walker(height=walk.walker.height))
        assert steps.length.sum() == pytest.approx(body.lengths.sum(), rel=0.25)
        time = np.arange(0.5, body.time[-1], 10.0)
        place = interpolate(time, body.time, body.position) + np.random.default_rng(seed).normal(0, 1.5, (len(time), 2))
        track = smooth(WalkGraph(steps, Fixes(time, place, np.full(len(time), 1.5)))).trajectory
        assert np.hypot(*np.diff(track.position, axis=0).T).sum() == pytest.approx(body.lengths.sum(), rel=0.12)
        error = track.position - interpolate(track.time, body.time, body.position)
        assert np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(track.covariance[:, :2, :2]), error) < 4.61) > 0.8


def test_lift_is_shorter_than_a_step_and_power_falls_with_frequency(walked):
    """Up to 5 Hz."""
    _, steps = walked
    assert np.all((steps.lift > 0) & (steps.lift < 1.2 * steps.period))
    assert steps.power[:, 1].mean() > steps.power[:, 3].mean() > 0


def test_steps_of_a_more_irregular_gait_are_less_sure_and_as_long(walked):
    gait = walked[1].gait
    landings = [replace(gait.landings, irregularity=np.full(len(gait.landings), m)) for m in (0.01, 0.03, 0.05)]
    regular, usual, irregular = (steps_of(replace(gait, landings=each), Walker()) for each in landings)
    assert np.all(regular.sigma_length < usual.sigma_length)
    assert np.all(usual.sigma_length < irregular.sigma_length)
    np.testing.assert_array_equal(regular.length, irregular.length)
