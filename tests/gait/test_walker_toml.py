"""walker.toml: what is written can be read, and what cannot be used is refused in one line."""

import numpy as np
import pytest
from refusals import refused

from pdr_graph import Walker
from pdr_graph.gait.walker import Profile
from pdr_graph.types import Steps

PROFILE = Profile(0.05, -0.002, 0.03, np.diag([1e-3, 1e-6, 4e-4]) + 1e-5 * np.eye(3)[::-1], 0.3, 1.25)
STEPS = Steps(
    0.0,
    5.0,
    np.array([1.0, 2.0, 3.0]),
    np.full(3, 0.5),
    np.array([0.7, 0.0, 0.8]),
    np.array([0.1, 0.0, -0.2]),
    np.array([0.02, 0.0, 0.0]),
    np.array([0.2, 3.0, 0.2]),
    np.full(3, 0.02),
    final_turn=0.4,
)
GOOD = """
height = 1.80
[stride]
model = "cadence"
normal_step = 0.75
normal_cadence = 112
[calibration]
E_length = 0.1
E_straight = 0.001
E_corner = -0.02
covariance = [[1e-3, 0, 0], [0, 1e-6, 0], [0, 0, 1e-4]]
residual = 0.4
speed = 1.3
"""


def written(tmp_path, text):
    path = tmp_path / "walker.toml"
    path.write_text(text)
    return path


def test_a_saved_walker_is_loaded_unchanged(tmp_path):
    walker = Walker(1.83, 0.03, "cadence", {"normal_step": 0.72}, PROFILE)
    walker.save(tmp_path / "w.toml", "a walk")
    again = Walker.load(tmp_path / "w.toml")
    assert (again.height, again.sigma_turn, again.stride) == (1.83, 0.03, "cadence")
    assert again.constants == {"normal_step": 0.72}
    assert again.profile is not None
    assert again.profile.E_length == pytest.approx(0.05)
    assert again.profile.covariance == pytest.approx(PROFILE.covariance, rel=1e-5)
    assert (tmp_path / "w.toml").read_text().startswith("# a walk")


def test_constants_of_a_stride_model_are_read_from_a_table(tmp_path):
    walker = Walker.load(written(tmp_path, GOOD))
    assert walker.constants == {"normal_step": 0.75, "normal_cadence": 112.0}
    assert Walker.load(written(tmp_path, 'stride = "height"')).stride == "height"


def test_the_profile_corrects_by_the_papers_equations():
    """[calibration-walk] Eqs. (8), (9): L' = (1 + E_length) L, θ' = θ'₋₁ + (1 + E_corner) Δθ + E_straight L."""
    found = PROFILE.corrected(STEPS)
    assert found.length == pytest.approx([1.05 * 0.7, 0.0, 1.05 * 0.8])
    assert found.turn == pytest.approx([1.03 * 0.1 - 0.002 * 0.7, 0.0, -1.03 * 0.2 - 0.002 * 0.8])
    assert found.sigma_length == pytest.approx([0.21, 3.0, 0.21]), "a gap is no step"
    assert found.final_turn == pytest.approx(1.03 * 0.4)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"cadence"', '"moonwalk"', "stride"),
        ("normal_step", "abnormal_step", "stride.abnormal_step"),
        ("1.80", "180", "height"),
        ("height", "heigth", "heigth"),
        ("E_length = 0.1", "E_length = 12.0", "calibration.E_length"),
        ("E_corner = -0.02\n", "", "calibration.E_corner"),
        ("[[1e-3, 0, 0], [0, 1e-6, 0], [0, 0, 1e-4]]", "[[1e-3, 0], [0, 1e-6]]", "calibration.covariance"),
        ("[[1e-3, 0, 0], [0, 1e-6, 0]", "[[-1e-3, 0, 0], [0, 1e-6, 0]", "calibration.covariance"),
        ("[[1e-3, 0, 0]", "[[nan, 0, 0]", "calibration.covariance"),
        ("speed = 1.3", "speed = true", "calibration.speed"),
        ("speed = 1.3", "speed = 0", "calibration.speed"),
    ],
)
def test_invalid_entries_are_refused_with_their_names(tmp_path, old, new, message):
    assert old in GOOD
    refused(Walker.load, written(tmp_path, GOOD.replace(old, new)), message.replace(".", r"\."))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("calibration = 3", "a table"),
        ("height = true", "number"),
        ("height", "TOML"),
        ("height = " + "9" * 10_000, "TOML"),
        ("height = " + "[" * 10_000, "TOML"),
        ("a" + ".a" * 100_000 + " = 1", "a name of more than 20 parts"),
        ("#" * 1_000_001, "more than 1000000 bytes"),
    ],
    ids=lambda value: value[:12],
)
def test_files_that_are_no_walker_are_refused(tmp_path, text, message):
    refused(Walker.load, written(tmp_path, text), message)
