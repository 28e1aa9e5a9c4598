"""Which way of the phone is ahead, on simulated walks and on accelerations that are known exactly."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pdr_graph.gait.heading import braking_axis, forward_axis, live_forward_axis, reading_axis
from pdr_graph.geometry import wrap_angle
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.lab.papers.gait_methods import principal_axis
from pdr_graph.priors import FORWARD

PERIOD, STEP, AHEAD = 0.01, 0.5, 2.0
TIME = np.arange(0.0, 60.0, PERIOD)
ALWAYS = np.ones(len(TIME), dtype=bool)


def marching(start=None, sway=0.6, push=0.5, heading=None):
    """A phone on a body that rises once a step, pushes with the lead of people, and sways once in two."""
    step = 2 * np.pi * TIME / STEP
    ahead, left = push * np.cos(step + FORWARD.lead), sway * np.cos(step / 2)
    course = AHEAD + (np.zeros(len(TIME)) if heading is None else heading)
    level = (ahead + 1j * left) * np.exp(1j * course)
    world = np.column_stack([level.real, level.imag, 9.81 + 2 * np.cos(step)])
    held = Rotation.from_euler("Z", np.zeros((len(TIME), 1)) + course[:, None]) * (start or Rotation.identity())
    return Attitude(TIME, PERIOD, held, held.inv().apply(world), np.zeros_like(world))


@pytest.mark.parametrize("start", [None, Rotation.from_euler("x", np.pi), Rotation.from_euler("xyz", [1.0, 2.0, 3.0])])
@pytest.mark.parametrize("method", [braking_axis, principal_axis])
def test_the_forward_axis_is_found_in_any_orientation(method, start):
    """Also upside down; the sign is right."""
    found = method(marching(start, sway=0.2), np.zeros(len(TIME)), ALWAYS, STEP)
    assert found.angle == pytest.approx(AHEAD, abs=0.02)


IN_A_POCKET, READ, HELD_ACROSS = ([("x", np.pi / 2)], [("z", -np.pi / 2)], [])


def first_steps(count, turns, reverse_until=0):
    """What the live forward axis says after so many steps; the push is reversed in the first steps, as on stairs."""
    start = Rotation.identity()
    for axis, angle in turns:
        start = Rotation.from_euler(axis, angle) * start
    attitude, part = marching(start, sway=0.2), slice(0, round(count * STEP / PERIOD) + 1)
    backwards = marching(start, sway=0.2, push=-0.5).acceleration
    acceleration = np.where(TIME[:, None] < reverse_until * STEP, backwards, attitude.acceleration)
    walk = Attitude(TIME, PERIOD, attitude.R_world_device, acceleration, np.zeros_like(acceleration))[part]
    return live_forward_axis(walk, np.zeros(len(walk.time)), ALWAYS[part], STEP)


def test_eight_steps_tell_the_forward_axis_of_a_phone_in_a_pocket():
    """The control: seven do not, and more steps narrow it."""
    assert not first_steps(7, IN_A_POCKET).determined
    found = first_steps(8, IN_A_POCKET)
    assert found.angle == pytest.approx(AHEAD, abs=0.1)
    assert found.sigma == pytest.approx(FORWARD.early_sigma)
    assert first_steps(40, IN_A_POCKET).sigma < found.sigma


def test_gait_of_eight_steps_confirms_the_y_axis_of_a_phone_that_is_read():
    sigmas = [first_steps(count, READ).sigma for count in (8, 60)]
    assert sigmas == [FORWARD.confirmed_sigma, FORWARD.reading_sigma]
    assert first_steps(8, READ).angle == pytest.approx(AHEAD, abs=0.01)


def test_eighty_steps_must_contradict_the_y_axis_before_gait_decides():
    """A phone held across; the control: on 40 steps of stairs gait is reversed, and never decides."""
    assert not any(first_steps(count, HELD_ACROSS).determined for count in (8, 24, 48, 72))
    assert first_steps(88, HELD_ACROSS).angle == pytest.approx(AHEAD, abs=0.1)
    found = [first_steps(count, READ, reverse_until=40) for count in (8, 24, 40, 56, 72, 88, 110)]
    told = [wrap_angle(one.angle - AHEAD) for one in found if one.determined]
    assert len(told) >= 1
    assert np.abs(told).max() < 0.1
    assert not any(one.determined for one in found[:3])


def test_a_sway_larger_than_the_push_misleads_only_the_principal_component():
    attitude, straight = marching(sway=1.0), np.zeros(len(TIME))
    assert braking_axis(attitude, straight, ALWAYS, STEP).angle == pytest.approx(AHEAD, abs=0.05)
    assert abs(wrap_angle(2 * (principal_axis(attitude, straight, ALWAYS, STEP).angle - AHEAD))) > 3.0


def test_the_walk_need_not_be_straight():
    turns = np.clip((TIME - 20) / 2, 0, 1) * 2.0
    found = braking_axis(marching(heading=turns), turns, ALWAYS, STEP)
    assert found.angle == pytest.approx(AHEAD, abs=0.05)


def test_a_standing_person_has_no_forward_axis():
    attitude = marching(sway=0.0, push=0.0)
    noise = np.random.default_rng(0).normal(0, 0.1, attitude.acceleration.shape)
    standing = Attitude(TIME, PERIOD, attitude.R_world_device, attitude.acceleration + noise, attitude.angular_rate)
    assert not braking_axis(standing, np.zeros(len(TIME)), ALWAYS, STEP).determined
    for method in (braking_axis, reading_axis, principal_axis, forward_axis):
        assert not method(attitude, np.zeros(len(TIME)), ~ALWAYS, STEP).determined


def test_the_y_axis_of_a_phone_held_for_reading_is_forward():
    """Its y axis, here at AHEAD + 90°, counts if there is no gait; if the gait contradicts it, the gait counts."""
    straight = np.zeros(len(TIME))
    silent = marching(sway=0.0, push=0.0)
    assert forward_axis(silent, straight, ALWAYS, STEP).angle == pytest.approx(AHEAD - 1.5 * np.pi)
    assert forward_axis(marching(), straight, ALWAYS, STEP).angle == pytest.approx(AHEAD, abs=0.05)
    upright = Rotation.from_euler("z", -np.pi / 2 + 0.2)  # held lengthwise, 0.2 rad askew
    agreeing = forward_axis(marching(upright), straight, ALWAYS, STEP)
    assert agreeing.angle == pytest.approx(AHEAD + 0.2, abs=0.01)
    assert agreeing.sigma < forward_axis(silent, straight, ALWAYS, STEP).sigma


@pytest.mark.parametrize("method", [forward_axis, braking_axis, reading_axis, principal_axis])
def test_unusual_sampling_rates_are_accepted(method):
    """At 3 Hz the step frequency is above the Nyquist frequency."""
    slow = slice(None, None, 33)
    attitude = marching()
    sparse = replace(attitude[slow], period=0.33)
    assert method(sparse, np.zeros(len(TIME[slow])), ALWAYS[slow], STEP).sigma > 0
