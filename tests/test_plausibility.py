"""Inputs that cannot belong to the walk are refused; others are not. tests/test_refusals.py has the whole lines."""

import numpy as np
import pytest
from plans import ARCADE

from pdr_graph.errors import InputError
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import enu
from pdr_graph.io.tables import clock_hint
from pdr_graph.plausibility import Plausibility
from pdr_graph.types import Fixes, Recording, Signal

PLAN = Building.load(ARCADE)
FRAME = PLAN.floors[0].frame
ON_PLAN = np.array([20.0, 18.0])
DURATION = 120.0  # [s]: the walker can have gone 240 m
STILL = Signal(np.arange(0.0, DURATION + 1), np.zeros((int(DURATION) + 1, 3)))
WALK = Recording("walk", 0.0, 1.7e9, accelerometer=STILL)


def fix(away, sigma=2.0, time=0.0):
    """A fix at a distance north of the plan's middle [m]."""
    return Fixes(np.array([time]), ON_PLAN[None] + [0, away], np.array([sigma]))


def all_of(*fixes):
    return Fixes.concatenate(list(fixes))


RECEIVER = all_of(*(fix(5000, time=float(t)) for t in range(5)))  # inside the recording
NONE = Fixes.none()


def refusal(fixes, listed=NONE, recorded=NONE, plan=ARCADE):
    """The text of the refusal; empty if the inputs are accepted."""
    places = Plausibility.of(WALK, FRAME, fixes, PLAN if plan else None)
    try:
        places.check_fixes(plan, ARCADE.with_name("f.csv"), listed, recorded)
    except InputError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("fixes", "expected"),
    [
        pytest.param(fix(400), "a plan 38", id="400 m from a plan, in two minutes"),
        pytest.param(fix(400), "within 250 m", id="what the walker can reach"),
        pytest.param(all_of(fix(5, time=-600.0), fix(9000)), "the only fix", id="one before the walk"),
        pytest.param(fix(230), "", id="the walk begins outside and enters"),
        pytest.param(fix(400, sigma=40.0), "", id="an inaccurate fix is believed less"),
        pytest.param(all_of(fix(9000), fix(5, time=60.0), fix(-8000, time=90.0)), "", id="one near the plan is enough"),
        pytest.param(fix(9000, time=-600.0), "", id="nothing says where the walk was"),
        pytest.param(NONE, "", id="no fixes"),
    ],
)
def test_a_plan_is_refused_if_no_fix_can_reach_it_within_the_walk(fixes, expected):
    assert expected in refusal(fixes)
    assert bool(refusal(fixes)) == bool(expected)
    assert not refusal(fixes, plan=None)


@pytest.mark.parametrize(
    ("listed", "recorded", "plan", "expected"),
    [
        pytest.param(fix(0), RECEIVER, None, "the only fix 5.0 km or more from those inside the", id="all along"),
        pytest.param(fix(5100), RECEIVER, None, "", id="where the receiver was"),
        pytest.param(fix(0), RECEIVER[:1], None, "", id="one old position contradicts nothing"),
        pytest.param(fix(0), RECEIVER, ARCADE, "", id="fixes on the plan"),
    ],
)
def test_fixes_of_a_file_are_refused_if_the_receiver_was_elsewhere(listed, recorded, plan, expected):
    line = refusal(all_of(listed, recorded), listed, recorded, plan)
    assert expected in line
    assert bool(line) == bool(expected)


def test_swapped_latitude_and_longitude_are_recognised():
    frame = enu(48.0, 11.0)
    places = Plausibility.of(WALK, frame, fix(0), None)
    with pytest.raises(InputError, match=r"from all fixes \(latitude and longitude swapped\?\)"):
        places.check_list(ARCADE, "beacon", frame.from_lonlat(np.array([[48.0, 11.0]])))
    with pytest.raises(InputError, match="from all fixes, expected"):
        places.check_list(ARCADE, "beacon", frame.from_lonlat(np.array([[47.0, 11.0]])))


def test_a_list_within_reach_of_the_walk_is_accepted():
    """Of anchors or beacons, 50 m from the plan and 2 km."""
    for away in (50.0, 240.0):
        Plausibility.of(WALK, FRAME, fix(0), PLAN).check_list(ARCADE, "anchor", ON_PLAN[None] + [0, away])


UNIX = (1.7e9, 1.7e9 + 90)


@pytest.mark.parametrize(
    ("found", "expected", "hint"),
    [
        ((1.7e9 + 7200, 1.7e9 + 7260), UNIX, "exactly 2 h late: time zone?"),
        ((1.7e9 + 7260, 1.7e9 + 7320), UNIX, "(2 h late: time zone?"),
        ((1.7e9 - 12600, 1.7e9 - 12540), UNIX, "3.5 h early: time zone?"),
        ((1.7e9 + 172800, 1.7e9 + 172860), UNIX, "exactly 2 days late: another date?"),
        ((1.7e12, 1.7e12 + 60000), UNIX, "milliseconds?"),
        ((1.7e18, 1.7e18 + 6e10), UNIX, "nanoseconds?"),
        ((0.0, 60.0), UNIX, "seconds from the start"),
        ((1.7e9, 1.7e9 + 60), (0.0, 90.0), "Unix times"),
        ((1.6e9, 1.6e9 + 60), UNIX, ""),
    ],
)
def test_times_of_another_clock_are_explained(found, expected, hint):
    assert hint in clock_hint(found, expected)
    assert bool(clock_hint(found, expected)) == bool(hint)


def test_the_area_of_a_walk_is_its_fix_with_all_that_can_be_walked():
    places = Plausibility.of(WALK, FRAME, fix(0), None)
    assert places.area.margin == pytest.approx([5 * 2.0 + 2.0 * DURATION])
    assert repr(places) == "Plausibility(2 span)"
