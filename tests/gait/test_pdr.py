"""From raw phone samples to steps, on simulated walks."""

import numpy as np
import pytest

from pdr_graph import InputError, Walker, detect_steps
from pdr_graph.geometry import dead_reckon
from pdr_graph.simulation.walk import walk_along
from pdr_graph.types import Recording, Signal

ROUTE = np.array([(0.0, 0.0), (20.0, 0.0), (20.0, 12.0), (2.0, 12.0)])


def recorded(walk, **missing):
    sensors = {
        "accelerometer": Signal(walk.time, walk.acceleration),
        "gyroscope": Signal(walk.time, walk.angular_rate),
    }
    return Recording("simulated", 0.0, None, **(sensors | missing))


@pytest.fixture(scope="module")
def walk():
    return walk_along(ROUTE, seed=3)


@pytest.fixture(scope="module")
def steps(walk):
    return detect_steps(recorded(walk))


def test_steps_cover_the_way(walk, steps):
    """Every landing but the first and last weak ones; a stride model that was not fitted to this, within a quarter."""
    way = np.hypot(*np.diff(walk.position, axis=0).T).sum()
    assert len(steps) == pytest.approx(len(walk.landings), abs=2)
    assert steps.length.sum() == pytest.approx(way, rel=0.25)
    assert np.all(np.diff(steps.time) > 0)
    assert np.all(steps.duration <= np.diff(steps.time, prepend=steps.start) + 1e-9)


def test_turns_add_up_to_the_turns_of_the_route(walk, steps):
    """Two left turns make π; the simulated gyro's bias and the phone's wander leave a few degrees."""
    turned = steps.turn.sum() + steps.final_turn
    assert turned == pytest.approx(np.pi, abs=0.15)


def test_the_track_has_the_shape_of_the_route(walk, steps):
    track = dead_reckon(steps, heading=0.0)
    truth = np.stack([np.interp(track.time, walk.time, axis) for axis in walk.position.T], axis=1)
    truth -= truth[0]
    scale = np.sum(truth * track.position) / np.sum(track.position**2)
    assert np.hypot(*(scale * track.position - truth).T).max() < 3.0


def test_taller_walkers_take_longer_steps(walk):
    tall, short = (detect_steps(recorded(walk), Walker(height=h)).length.sum() for h in (1.9, 1.5))
    assert tall / short == pytest.approx(1.9 / 1.5, rel=0.01)


def test_without_an_accelerometer_there_are_no_steps(walk):
    with pytest.raises(InputError, match="accelerometer: found no samples"):
        detect_steps(recorded(walk, accelerometer=None))


def test_without_a_gyroscope_the_steps_are_the_same_and_their_turns_unknown(walk):
    complete, deaf = detect_steps(recorded(walk)), detect_steps(recorded(walk, gyroscope=None))
    assert deaf.time == pytest.approx(complete.time)
    assert deaf.length == pytest.approx(complete.length)
    assert not deaf.turn.any()
    assert (deaf.sigma_turn > 10 * complete.sigma_turn).all()
    assert deaf.unknown == ("turns: there is no gyroscope",)


def test_removed_gravity_is_put_back_along_the_axis_that_shook_most(walk):
    """The phone lies level in the simulated walker's hand, so that gravity is its z axis."""
    linear = Signal(walk.time, walk.acceleration - [0, 0, 9.80665])
    complete, found = (
        detect_steps(recorded(walk)),
        detect_steps(recorded(walk, accelerometer=None, linear_acceleration=linear)),
    )
    assert len(found) == len(complete)
    assert found.time == pytest.approx(complete.time, abs=0.1)
    # the axis is up to 20° off here, 3–9° on real walks: its turns are short by the cosine
    assert found.turn.sum() == pytest.approx(complete.turn.sum(), rel=0.1)
    assert "gravity" in found.unknown[0]


def test_wrong_units_and_wild_times_are_refused(walk):
    """An accelerometer in g; a last sample a year later, whose gap nobody could fill."""
    in_g = Signal(walk.time, walk.acceleration / 9.81)
    with pytest.raises(InputError, match=r"median magnitude of 0\.99.*9\.8 m/s²"):
        detect_steps(recorded(walk, accelerometer=in_g))
    late = np.append(walk.time[:-1], 3e7)
    with pytest.raises(InputError, match="are its times in seconds"):
        detect_steps(
            recorded(walk, accelerometer=Signal(late, walk.acceleration), gyroscope=Signal(late, walk.angular_rate))
        )


def test_a_standing_phone_takes_no_steps():
    t = np.arange(0, 20, 0.02)
    quiet = Signal(t, np.random.default_rng(0).normal(0, 0.01, (len(t), 3)))
    gravity = Signal(t, quiet.values * 5 + [0, 0, 9.81])
    steps = detect_steps(Recording("still", 0.0, None, gravity, quiet))
    assert len(steps) == 0
    assert steps.end == pytest.approx(19.98)


def test_walker_toml(tmp_path):
    path = tmp_path / "walker.toml"
    path.write_text("height = 1.81\n")
    assert Walker.load(path).height == 1.81
    for text, complaint in (
        ("hieght = 1.8", "hieght"),
        ("height = 181", "between 0 and 3"),
        ("height = true", "number"),
        ("height", "TOML"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=complaint):
            Walker.load(path)
