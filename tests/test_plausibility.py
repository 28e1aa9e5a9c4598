"""Inputs that cannot belong to the walk are refused, in one line, before anything is written; others are not."""

from dataclasses import replace

import numpy as np
import pytest
import simulated
from commands import run
from plans import ARCADE, MAPS
from simulated import ROUTE

from pdr_graph.apps.replay import navigator_of
from pdr_graph.errors import InputError
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import enu
from pdr_graph.io.tables import clock_hint
from pdr_graph.plausibility import Plausibility
from pdr_graph.types import Fixes, Recording, Signal
from pdr_graph.walk import Options, read

PLAN = Building.load(ARCADE)
FRAME = PLAN.floors[0].frame
ON_PLAN = np.array([20.0, 18.0])
DURATION = 120.0  # [s]: the walker can have gone 240 m
STILL = Signal(np.arange(0.0, DURATION + 1), np.zeros((int(DURATION) + 1, 3)))
WALK = Recording("walk", 0.0, 1.7e9, accelerometer=STILL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return simulated.indoor_location(tmp_path_factory.mktemp("walk"), ROUTE, seed=4)


@pytest.fixture
def clock(folder):
    """The recorder's time at the start of the walk [s]."""
    return read(folder / "walk.txt").walk.clock_origin


def fix(away, sigma=2.0, time=0.0):
    """A fix at a distance north of the plan's middle [m]."""
    return Fixes(np.array([time]), ON_PLAN[None] + [0, away], np.array([sigma]))


def refusal(fixes, listed=None, recorded=None, plan=ARCADE):
    """The text of the refusal; empty if the inputs are accepted."""
    building = None if plan is None else PLAN
    listed, recorded = listed or Fixes.none(), recorded or Fixes.none()
    try:
        Plausibility.of(WALK, FRAME, fixes, building).check_fixes(
            plan, plan and ARCADE.with_name("f.csv"), listed, recorded
        )
    except InputError as error:
        return str(error)
    return ""


def written(folder, name, header, *rows):
    path = folder / name
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def test_a_plan_is_refused_if_no_fix_can_reach_it_within_the_walk():
    assert not refusal(fix(230)), "the walk begins outside and enters"
    assert "a plan 38" in refusal(fix(400))
    assert "the only fix" in refusal(fix(400))
    assert "within 250 m" in refusal(fix(400))


def test_an_inaccurate_fix_is_believed_less():
    assert not refusal(fix(400, sigma=40.0))


def test_a_single_fix_near_the_plan_is_enough_to_keep_it():
    assert not refusal(Fixes.concatenate([fix(9000), fix(5, time=60.0), fix(-8000, time=90.0)]))


def test_fixes_before_or_after_the_recording_do_not_count():
    assert refusal(Fixes.concatenate([fix(5, time=-600.0), fix(9000)]))
    assert not refusal(fix(9000, time=-600.0)), "nothing says where the walk was"


def test_a_walk_without_fixes_or_plan_cannot_be_refused():
    assert not refusal(Fixes.none())
    assert not refusal(fix(9000), plan=None)


def test_fixes_of_a_file_are_refused_if_the_receiver_was_elsewhere_all_along():
    recorded = Fixes.concatenate([fix(5000, time=float(t)) for t in range(5)])
    elsewhere, here = fix(0), fix(5100)
    for listed, accepted in ((elsewhere, False), (here, True)):
        places = Plausibility.of(WALK, FRAME, Fixes.concatenate([listed, recorded]), None)
        if accepted:
            places.check_fixes(None, ARCADE, listed, recorded)
            continue
        with pytest.raises(InputError, match=r"the only fix 5.0 km or more from those inside the recording"):
            places.check_fixes(None, ARCADE, listed, recorded)
        places.check_fixes(None, ARCADE, listed, recorded[:1])  # one old position contradicts nothing


def test_fixes_on_the_plan_are_kept_though_the_receiver_was_elsewhere():
    recorded = Fixes.concatenate([fix(5000, time=float(t)) for t in range(5)])
    assert not refusal(Fixes.concatenate([fix(0), recorded]), fix(0), recorded)


def test_swapped_latitude_and_longitude_are_recognised():
    frame = enu(48.0, 11.0)
    places = Plausibility.of(WALK, frame, fix(0), None)
    with pytest.raises(InputError, match=r"from all fixes \(latitude and longitude swapped\?\)"):
        places.check_list(ARCADE, "beacon", frame.from_lonlat(np.array([[48.0, 11.0]])))
    with pytest.raises(InputError, match="from all fixes, expected"):
        places.check_list(ARCADE, "beacon", frame.from_lonlat(np.array([[47.0, 11.0]])))


@pytest.mark.parametrize(
    ("found", "expected", "hint"),
    [
        ((1.7e9 + 7200, 1.7e9 + 7260), (1.7e9, 1.7e9 + 90), "2 h late: time zone?"),
        ((1.7e9 - 12600, 1.7e9 - 12540), (1.7e9, 1.7e9 + 90), "3.5 h early: time zone?"),
        ((1.7e12, 1.7e12 + 60000), (1.7e9, 1.7e9 + 90), "milliseconds?"),
        ((0.0, 60.0), (1.7e9, 1.7e9 + 90), "seconds from the start"),
        ((1.7e18, 1.7e18 + 6e10), (1.7e9, 1.7e9 + 90), "nanoseconds?"),
        ((1.7e9 + 7200, 1.7e9 + 7260), (1.7e9, 1.7e9 + 90), "(exactly 2 h late"),
        ((1.7e9 + 7260, 1.7e9 + 7320), (1.7e9, 1.7e9 + 90), "(2 h late"),
        ((1.7e9 + 172800, 1.7e9 + 172860), (1.7e9, 1.7e9 + 90), "exactly 2 days late: another date?"),
        ((1.7e9, 1.7e9 + 60), (0.0, 90.0), "Unix times"),
        ((1.6e9, 1.6e9 + 60), (1.7e9, 1.7e9 + 90), ""),
    ],
)
def test_times_of_another_clock_are_explained(found, expected, hint):
    assert hint in clock_hint(found, expected)
    assert bool(clock_hint(found, expected)) == bool(hint)


def test_nothing_is_written_for_a_plan_in_another_country(folder, tmp_path, clock):
    fixes = written(
        tmp_path, "fixes.csv", "time,lat,lon,sigma", (clock + 1, 48.1, 11.5, 2), (clock + 20, 48.1, 11.5, 2)
    )
    command = [folder / "walk.txt", "--map", MAPS / "mall.geojson", "--fixes", fixes]
    for verb in ("smooth", "replay"):
        out = tmp_path / verb
        code, _, errors = run(verb, *command, "--out", out)
        assert (code, len(errors)) == (2, 1)
        assert "mall.geojson: found a plan" in errors[0]
        assert "km or more from each of 2 fixes, expected a plan within" in errors[0]
        assert not out.exists()
    code, _, errors = run("lifelog", "add", tmp_path / "days.db", *command)
    assert code == 2
    assert "found a plan" in errors[0]
    assert "expected a plan within" in errors[0]


def test_a_truth_of_another_place_or_time_is_refused(folder, tmp_path, clock):
    options = Options(plan=ARCADE, fixes=folder / "fixes.csv")
    for shift, row, text in (
        (0.0, (500000, 5500000), r"truth.csv: found each of 2 rows .* km or more from fixes and plan"),
        (3600.0, (20, 18), r"truth.csv, time: .*1 h late: time zone\?"),
    ):
        truth = written(tmp_path, "truth.csv", "time,x,y", (clock + shift, *row), (clock + shift + 9, *row))
        with pytest.raises(InputError, match=text):
            read(folder / "walk.txt", replace(options, truth=truth))


def test_anchors_of_another_building_are_refused(folder, tmp_path, clock):
    ranges = written(tmp_path, "ranges.csv", "time,anchor,range", (clock + 1, "A", 5), (clock + 2, "B", 6))
    for away, accepted in ((50, True), (9000, False)):
        listed = written(tmp_path, "anchors.csv", "beacon,x,y", ("A", away, 18), ("B", away + 5, 18), ("C", 20, 18))
        options = Options(plan=ARCADE, fixes=folder / "fixes.csv", beacons=listed, ranges=ranges)
        if accepted:
            assert len(read(folder / "walk.txt", options).walk.measurements) == 1
            continue
        with pytest.raises(
            InputError, match=r"anchors.csv: found each of 2 anchors 8.9 km or more from fixes and plan"
        ):
            read(folder / "walk.txt", options)


def test_a_live_walk_is_refused_beacons_of_another_town(tmp_path):
    for away, accepted in ((2000, True), (90000, False)):
        listed = written(tmp_path, "beacons.csv", "beacon,x,y", ("A", away, 18), ("B", away + 5, 18))
        options = Options(plan=ARCADE, beacons=listed)
        if accepted:
            assert navigator_of(options).keywords["floor"].labels == PLAN.labels
            continue
        with pytest.raises(InputError, match=r"beacons.csv: found each of 2 beacons 90 km or more from the plan"):
            navigator_of(options)


def test_the_area_of_a_walk_is_its_fix_with_all_that_can_be_walked():
    places = Plausibility.of(WALK, FRAME, fix(0), None)
    assert places.area.margin == pytest.approx([5 * 2.0 + 2.0 * DURATION])
    assert repr(places) == "Plausibility(2 span)"
