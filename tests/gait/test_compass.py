"""Absolute headings of simulated walks with a magnetometer are right, or there are none."""

from dataclasses import replace

import numpy as np
import pytest

from pdr_graph import magnetic_headings
from pdr_graph.frames import Frame, projected
from pdr_graph.geometry import wrap_angle
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Signal

HERE = np.zeros(2)


def walked(hold="hand", seed=0, minutes=1, **phone):
    laps = [[40, 0], [40, 30], [0, 30], [0, 0]] * minutes
    given = {"seed": seed, "route": [[0, 0], {"stand": 3}, {"to": laps}], "phone": {"hold": hold, "rate": 50} | phone}
    return simulate(Scenario.of(given))


def errors(walk, headings):
    """Errors against the true walking direction, in sigmas and in radians."""
    truth = np.interp(headings.time, walk.body.time, walk.body.heading)
    error = wrap_angle(headings.heading - truth)
    return error / headings.sigma, error


@pytest.mark.parametrize("hold", ["hand", "swinging arm", "trouser pocket", "breast pocket", "bag"])
def test_headings_are_right_or_missing(hold):
    """With steel and 3 µT of hard iron per axis all headings are within three sigmas and 0.8 rad."""
    for seed in range(3):
        walk = walked(hold, seed)
        z, error = errors(walk, magnetic_headings(walk.recording(), walk.frame, HERE))
        assert np.all(np.abs(z) < 3)
        assert np.all(np.abs(error) < 0.8)


def test_many_headings_together_have_the_information_of_one():
    """Their shared error does not average out: after four minutes the direction is known as after one."""

    def known(walk):
        """Sigma of the present direction after the last heading; each step adds 0.02 rad."""
        information, before, landed = 0.0, 0.0, walk.body.landings
        headings = magnetic_headings(walk.recording(), walk.frame, HERE)
        for time, sigma in zip(headings.time, headings.sigma, strict=True):
            steps = np.sum((landed > before) & (landed <= time))
            information = 1 / (1 / information + steps * 0.02**2) if information else 0.0
            information, before = information + sigma**-2.0, time
        return len(headings), information**-0.5

    (few, one), (many, four) = known(walked(minutes=1)), known(walked(minutes=4))
    assert few < many
    assert four == pytest.approx(one, rel=0.2)


def test_a_magnet_on_the_phone_prevents_headings():
    """A case with a magnet adds 150 µT, so that the dip is always wrong."""
    walk = walked()
    recording = walk.recording()
    field = recording.magnetometer
    magnet = replace(recording, magnetometer=Signal(field.time, field.values + np.array([0.0, 0.0, 150.0])))
    assert len(magnetic_headings(magnet, walk.frame, HERE)) == 0


def test_there_are_no_headings_without_a_location_or_a_sensor():
    walk = walked()
    assert len(magnetic_headings(walk.recording(), Frame(), HERE)) == 0
    for sensors in (("accelerometer", "gyroscope"), ("accelerometer", "magnetometer"), ("gyroscope", "magnetometer")):
        assert len(magnetic_headings(walk.recording(*sensors), walk.frame, HERE)) == 0


@pytest.mark.parametrize("samples", [1, 500])
def test_a_magnetometer_that_stopped_gives_no_headings(samples):
    """It recorded one sample, or ten seconds of a walk of four minutes."""
    walk = walked(minutes=3)
    recording = walk.recording()
    field = recording.magnetometer
    stopped = replace(recording, magnetometer=Signal(field.time[:samples], field.values[:samples]))
    assert len(magnetic_headings(stopped, walk.frame, HERE)) == 0


def test_a_standing_person_has_no_headings():
    given = {"route": [[0, 0], {"stand": 30}], "phone": {"rate": 50}}
    standing = simulate(Scenario.of(given))
    assert len(magnetic_headings(standing.recording(), standing.frame, HERE)) == 0


def test_the_grid_convergence_of_a_projection_is_applied():
    """UTM 32 at 6° east of its central meridian and 36° N: the convergence is 6° sin 36°."""
    utm = projected(32632)
    east = utm.from_lonlat(np.array([[15.0, 36.0]]))[0]
    assert np.degrees(utm.bearing_of_east(east)) == pytest.approx(6 * np.sin(np.radians(36)), abs=0.1)
