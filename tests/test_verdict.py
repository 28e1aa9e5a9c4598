"""The verdict on a walk: honest sources are "ok", sources that contradict each other are named, and teach nothing."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from commands import run
from hypothesis import given
from hypothesis import strategies as st
from simulated import walk_in_the_arcade
from tiers import thorough
from walks import dead_reckon, drawn_beside_beacons, drawn_from_the_model, fixes_at, square_walk

import pdr_graph as pdr
from pdr_graph.apps.cli import learn_radio_map
from pdr_graph.errors import InputError
from pdr_graph.estimation.calibration import calibrate
from pdr_graph.estimation.verdict import independent_positions, stride_determined, teaches_profile
from pdr_graph.geometry import interpolate
from pdr_graph.types import DOUBTFUL, FAILED, Contradiction, Headings, Verdict

DOUBT = Contradiction("plan", "fixes", 3.0, "m", "the plan lies 3 m from the fixes", "the plan")


def sources(judged):
    return {reason.source for reason in judged.reasons}


def estimated(seed, change=lambda fixes: fixes, n=150):
    steps, fixes, _ = drawn_from_the_model(n, seed)
    return pdr.smooth(pdr.WalkGraph(steps, change(fixes)))


def test_the_verdict_is_the_worst_of_its_reasons_which_comes_first():
    assert Verdict.of([]) == Verdict("ok")
    assert Verdict.of([DOUBT]).state == "doubtful"
    worst = replace(DOUBT, source="fixes", state=FAILED)
    judged = Verdict.of([DOUBT, worst, DOUBT])
    assert judged.state == "failed"
    assert judged.reasons == (worst, DOUBT)


@pytest.fixture(scope="module")
def honest():
    return estimated(1)


@given(probability=st.floats(1e-6, 1.0) | st.just(np.nan), wider=st.floats(0.1, 30.0), converged=st.booleans())
def test_ok_is_a_route_of_90_percent_at_a_place_known_to_12_m(honest, probability, wider, converged):
    """Whatever else is measured: RMS sigma per axis times 2.146 holds 90 % of a Gaussian."""
    track = replace(honest.trajectory, covariance=wider**2 * honest.trajectory.covariance)
    judged = pdr.verdict(replace(honest, probability=probability, trajectory=track, converged=converged))
    variance = (track.covariance[:, 0, 0] + track.covariance[:, 1, 1]) / 2
    known = np.median(2.146 * np.sqrt(variance)) <= 12.0
    assert judged.ok == (known and converged and not probability < 0.9)


def test_one_fix_without_a_direction_is_never_ok():
    steps, fixes, _ = drawn_from_the_model(150, 1)
    assert not pdr.verdict(pdr.smooth(pdr.WalkGraph(steps, fixes[:1]))).ok


def test_reasons_are_data_for_json_with_null_for_an_unknown_amount():
    described = Verdict.of([replace(DOUBT, amount=float("nan"))]).describe()
    [reason] = json.loads(json.dumps(described, allow_nan=False))["reasons"]
    assert reason == vars(DOUBT) | {"amount": None}


def test_walks_whose_errors_are_as_stated_are_ok():
    """Drawn from the graph's own model: at least 19 of 20."""
    states = [pdr.verdict(estimated(seed)).state for seed in range(20)]
    assert states.count("ok") >= 19


def test_an_unlikely_route_an_optimiser_that_stopped_and_what_the_smoother_found_are_doubtful():
    estimate = estimated(1)
    assert pdr.verdict(replace(estimate, probability=0.91)).ok
    assert sources(pdr.verdict(replace(estimate, probability=0.89))) == {"route"}
    assert sources(pdr.verdict(replace(estimate, converged=False))) == {"optimiser"}
    assert pdr.verdict(replace(estimate, contradictions=(DOUBT,))).state == DOUBTFUL


@pytest.mark.parametrize("seed", range(3))
def test_where_most_fixes_are_elsewhere_the_walk_has_failed(seed):
    def scattered(fixes):
        away = np.random.default_rng(seed).uniform(-300, 300, fixes.position.shape)
        return replace(fixes, position=fixes.position + away)

    judged = pdr.verdict(estimated(seed, scattered))
    assert judged.state == "failed"
    assert "fixes" in sources(judged)


def followed_by_a_receiver(seed, change):
    """A square walk with a fix each second, within 2 m; ``change``: of its position by time."""
    steps, random = square_walk(side=25, laps=3), np.random.default_rng(seed)
    time, track = np.arange(1.0, steps.end), dead_reckon(steps)
    place = interpolate(time, track.time, track.position) + random.normal(0, 1.0, (len(time), 2)) + change(time)
    return pdr.smooth(pdr.WalkGraph(steps, replace(fixes_at(time, place, 3.0), source=("GNSS",) * len(time))))


@pytest.mark.parametrize(
    ("moment", "seed"),
    [(30.0, 0), (80.0, 1), *(thorough(*case) for case in ((80.0, 0), (30.0, 1), (30.0, 2), (80.0, 2)))],
)
def test_a_receiver_that_jumps_and_stays_there_is_doubtful(moment, seed):
    """By 25 m: whether it was right before or after is unknown. One that comes back was right but for that time."""
    jumps = followed_by_a_receiver(seed, lambda time: 25.0 * (time > moment)[:, None] * [0.6, 0.8])
    assert "GNSS" in sources(pdr.verdict(jumps))
    away = followed_by_a_receiver(seed, lambda time: 25.0 * (abs(time - moment) < 10)[:, None] * [0.6, 0.8])
    assert pdr.verdict(away).ok


@pytest.mark.parametrize("seed", range(3))
def test_a_receiver_that_stays_right_is_ok(seed):
    assert pdr.verdict(followed_by_a_receiver(seed, lambda time: 0.0)).ok


def test_a_ride_is_no_jump_of_the_receiver():
    """Eight metres a second for ten seconds beside the steps."""
    ride = followed_by_a_receiver(0, lambda time: 8.0 * np.clip(time - 30.0, 0, 10)[:, None] * [0.6, 0.8])
    assert "GNSS" not in sources(pdr.verdict(ride))


def test_one_outlier_among_ten_fixes_is_no_reason():
    def moved(fixes):
        position = fixes.position.copy()
        position[4] += 60.0
        return replace(fixes, position=position)

    for seed in range(5):
        assert pdr.verdict(estimated(seed, moved)).ok


@pytest.mark.parametrize("seed", range(4))
def test_fixes_four_times_as_far_off_as_they_state_contradict_the_steps(seed):
    steps, fixes, _ = drawn_from_the_model(300, seed, every=10, wrong=4.0)
    assert "fixes" in sources(pdr.verdict(pdr.smooth(pdr.WalkGraph(steps, fixes))))


def test_a_list_of_another_building_contradicts_the_fixes():
    """Half of its beacons are found elsewhere."""
    steps, fixes, levels, _ = drawn_beside_beacons(150, 1)
    assert pdr.verdict(pdr.smooth(pdr.WalkGraph(steps, fixes, levels=levels))).ok
    elsewhere = replace(levels, position=levels.position + np.array([40.0, 0.0]))
    judged = pdr.verdict(pdr.smooth(pdr.WalkGraph(steps, fixes, levels=elsewhere)))
    assert judged.state == "doubtful"
    assert {reason.source for reason in judged.reasons} == {"beacons"}


def test_headings_ninety_degrees_off_contradict_the_fixes():
    steps, fixes, truth = drawn_from_the_model(200, 3)
    time = np.arange(10.0, steps.end - 5, 10.0)
    heading = np.interp(time, truth.time, np.unwrap(truth.heading)) + np.random.default_rng(0).normal(0, 0.3, len(time))
    for off, found in ((0.0, set()), (np.pi / 2, {"headings"})):
        headings = Headings(time, (heading + off + np.pi) % (2 * np.pi) - np.pi, np.full(len(time), 0.3))
        assert sources(pdr.verdict(pdr.smooth(pdr.WalkGraph(steps, fixes, headings=headings)))) == found


# Plans


@pytest.fixture(scope="module")
def arcade():
    return walk_in_the_arcade()


def on(truth, *times, off=(0.0, 0.0)):
    """Fixes at the true positions, moved by ``off (2,)`` [m]."""
    return fixes_at(times, interpolate(np.array(times), truth.time, truth.position) + np.array(off), 0.5)


@pytest.mark.parametrize(
    ("times", "off", "ok", "teaches"),
    [
        ((1.0, 20.0, 40.0), (0.0, 0.0), True, True),
        ((1.0,), (0.0, 0.0), True, False),
        ((1.0,), (20.0, 0.0), False, False),
        thorough((1.0,), (14.0, 14.0), False, False),
    ],
)
def test_a_walk_on_its_plan_is_ok_by_true_fixes_and_teaches_its_stride_by_several(arcade, times, off, ok, teaches):
    """One fix and the plan do not determine a stride, however sure the posterior."""
    steps, truth, plan = arcade
    estimate = pdr.smooth(pdr.WalkGraph(steps, on(truth, *times, off=off), floor=plan))
    assert (pdr.verdict(estimate).ok, teaches_profile(estimate)) == (ok, teaches)
    assert not ok or estimate.calibration.learnt[-1, 0], "the plan determines it"


def test_a_walk_that_fits_several_places_of_its_plan_is_doubtful_but_a_shape_alone_is_ok(arcade):
    steps, _, plan = arcade
    estimate = pdr.smooth(pdr.WalkGraph(steps, floor=plan))
    assert estimate.probability < 0.9
    assert sources(pdr.verdict(estimate)) == {"route"}
    assert pdr.verdict(estimate).state == "doubtful"
    assert not teaches_profile(estimate)
    assert pdr.verdict(pdr.smooth(pdr.WalkGraph(steps))).ok


def test_a_plan_beside_all_fixes_is_doubtful_and_the_reason_says_how_far(arcade):
    steps, truth, plan = arcade
    judged = pdr.verdict(pdr.smooth(pdr.WalkGraph(steps, on(truth, 1.0, 20.0, 40.0, off=[500.0, 0.0]), floor=plan)))
    assert judged.state == "doubtful"
    [reason] = judged.reasons
    assert (reason.source, reason.against, reason.unit) == ("plan", "fixes", "m")
    assert 430 < reason.amount < 500, "from the edge of the plan, which is 60 m wide"


# What may be learnt


def test_two_fixes_determine_a_stride_if_they_are_far_apart():
    """Of 1 m sigma: their distance must be known to a tenth, half of an unknown stride's variance."""
    steps = square_walk(side=30)
    track = dead_reckon(steps)
    near, far = track.position[[0, 20]], track.position[[0, 60]]
    assert not stride_determined(pdr.smooth(pdr.WalkGraph(steps, fixes_at(track.time[[0, 20]], near, 1.5))))
    assert stride_determined(pdr.smooth(pdr.WalkGraph(steps, fixes_at(track.time[[0, 60]], far, 1.0))))


def test_correlated_fixes_of_one_receiver_count_once_and_teach_no_profile():
    """Fixes within a minute and 84 m: of the user 21 positions, of a receiver fewer than three."""
    steps = square_walk(side=30)
    track = dead_reckon(steps)
    fixes = fixes_at(track.time[::6], track.position[::6], 1.0)
    of_user = pdr.smooth(pdr.WalkGraph(steps, fixes))
    assert (independent_positions(of_user), teaches_profile(of_user)) == ({"fixes": 21.0}, True)
    of_receiver = pdr.smooth(pdr.WalkGraph(steps, replace(fixes, source=("GNSS",) * len(fixes))))
    assert 1.0 < independent_positions(of_receiver)["GNSS"] < 3.0
    assert not teaches_profile(of_receiver)
    assert not teaches_profile(replace(of_user, assumed=("calibration: another walker",)))


def test_a_stride_of_no_usual_walker_is_doubtful_until_three_fixes_confirm_it():
    steps = square_walk(side=30)
    track = dead_reckon(steps)
    long = 1.5 * track.position
    for rows, state in (([0, 60], "doubtful"), ([0, 15, 30, 45, 60, 90, 119], "ok")):
        estimate = pdr.smooth(pdr.WalkGraph(steps, fixes_at(track.time[rows], long[rows], 0.5)))
        assert pdr.verdict(estimate).state == state
        assert any("stride scale R_s is 1." in line for line in estimate.warnings)


def test_strides_too_short_for_any_walker_are_doubtful_whatever_confirms_them():
    """A plan drawn at two thirds of its scale: all fixes agree."""
    steps = square_walk(side=30)
    track = dead_reckon(steps)
    estimate = pdr.smooth(pdr.WalkGraph(steps, fixes_at(track.time[::6], 0.66 * track.position[::6], 0.5)))
    [reason] = pdr.verdict(estimate).reasons
    assert reason.source == "stride"
    assert "in 120 steps, 0.46 m each: 67 % of what walkers" in reason.text


def test_a_receiver_whose_fixes_lie_away_from_the_walk_is_named():
    steps, fixes, truth = drawn_from_the_model(200, 3)
    time = np.arange(20.0, steps.end - 20, 30.0)
    place = interpolate(time, truth.time, truth.position) + np.array([0.0, 40.0])
    away = replace(fixes_at(time, place, 4.0), source=("watch",) * len(time))
    judged = pdr.verdict(pdr.smooth(pdr.WalkGraph(steps, pdr.Fixes.concatenate([fixes, away]))))
    assert any("fixes of watch lie more than" in reason.text and " m (" in reason.text for reason in judged.reasons)


def test_one_rejected_fix_has_a_line_and_a_route_without_others_has_no_probability():
    def moved(fixes):
        position = fixes.position.copy()
        position[4] += 60.0
        return replace(fixes, position=position)

    estimate = estimated(1, moved)
    assert any(line.startswith("1 fix rejected, weight 0: at ") and "8" in line for line in estimate.warnings)
    assert np.isnan(estimate.probability)


def test_a_route_at_twice_the_scale_calibrates_nobody():
    """The line is followed, but half of the fixes on it contradict the steps."""
    steps = square_walk(side=30)
    line = np.array([(0.0, 0.0), (21.0, 0.0), (21.0, 21.0), (0.0, 21.0), (0.0, 0.0)])
    calibrate(steps, line)
    with pytest.raises(InputError, match="found steps of"):
        calibrate(steps, 2 * line)


# Files


def moved_fixes(walk, folder, off, number=None):
    """Some fixes of a walk, or all, moved along x. [m]"""
    first, *rows = (walk / "fixes.csv").read_text().splitlines()
    moved = [",".join([t, str(float(x) + off), *rest]) for t, x, *rest in (row.split(",") for row in rows[:number])]
    (folder / f"{off}.csv").write_text("\n".join([first, *moved]) + "\n")
    return folder / f"{off}.csv"


def smoothed(walk, out, fixes, verb="smooth"):
    code, printed, _ = run(verb, walk, "--map", walk / "plan.geojson", "--fixes", fixes, "--out", out)
    return code, printed, json.loads((out / "summary.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("verb", ["smooth", "replay"])
def test_output_summary_and_exit_code_say_the_same_and_only_a_good_walk_leaves_a_profile(arcade_walk, tmp_path, verb):
    code, printed, summary = smoothed(arcade_walk, tmp_path / "good", arcade_walk / "fixes.csv", verb)
    assert (code, printed[:4], summary["verdict"]) == (0, "ok: ", {"state": "ok", "reasons": []})
    if verb == "smooth":
        written = (tmp_path / "good" / "walker.toml").read_text()
        assert tomllib.loads(written)["calibration"]
        assert written.startswith(f"# learnt from {arcade_walk.name}: 7 independent positions (fixes 7);")
    code, printed, summary = smoothed(arcade_walk, tmp_path / "bad", moved_fixes(arcade_walk, tmp_path, 120), verb)
    assert (code, printed[:10]) == (3, "doubtful: ")
    [reason] = summary["verdict"]["reasons"]
    assert reason["source"] == "plan"
    assert reason["text"] in printed
    assert not (tmp_path / "bad" / "walker.toml").exists()
    assert (tmp_path / "bad" / "report.html").exists()


def test_a_walk_that_is_not_ok_teaches_no_radio_map(arcade_walk, tmp_path):
    code, _, summary = smoothed(arcade_walk, tmp_path / "bad", moved_fixes(arcade_walk, tmp_path, 20, number=1))
    assert code == 3
    assert summary["verdict"]["state"] != "ok"
    assert not (tmp_path / "bad" / "walker.toml").exists()
    with pytest.raises(InputError, match="verdict: found"):
        learn_radio_map([arcade_walk, tmp_path / "bad"], tmp_path / "map.npz")


def test_the_navigator_says_so_while_the_walk_goes_on(arcade_walk):
    """On the way it may name a fix that is 14 m off, which it leaves out."""
    recording = pdr.load(arcade_walk)
    plan = pdr.FloorPlan.load(arcade_walk / "plan.geojson")
    fixes = pdr.read_fixes(arcade_walk / "fixes.csv", recording, plan.frame)
    elsewhere = replace(fixes, position=fixes.position + np.array([250.0, 0.0]))
    for some, state in ((fixes, "ok"), (elsewhere, "doubtful")):
        nav = pdr.Navigator(plan)
        for event in pdr.events_of(replace(recording, fixes=some)):
            nav.push(event)
        judged = nav.status.verdict
        assert judged.state == state or all("fix at 24 s" in reason.text for reason in judged.reasons)
        assert pdr.verdict(nav.finish()).state == state
