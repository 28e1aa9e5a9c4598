"""Smooth, replay and a lifelog walk say the same of the same degraded inputs: notes, warnings, what is missing.

What only one of them can know: a replay also says what its stream lacked at the end (silent sensors, dropped samples,
a clock reset) and where it was resumed; only a batch counts the different walks that explain the measurements.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
import simulated
from plans import ARCADE

from pdr_graph.apps.lifelog.observation import observe
from pdr_graph.apps.lifelog.reconstruct import reconstruct
from pdr_graph.apps.lifelog.store import RecordingOptions
from pdr_graph.apps.replay import replay_recording
from pdr_graph.apps.report.output_files import smooth_recording
from pdr_graph.errors import InputError
from pdr_graph.online.interface import events_of
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Headings
from pdr_graph.walk import Options, estimate, read
from pdr_graph.walk import observe as observe_walk

ONLY_BATCH = ("different walks explain", "fits the plan poorly")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A walk of half a minute, and files that degrade it."""
    route = np.array([(0.0, 0.0), (20.0, 0.0), (20.0, 10.0)])
    folder = simulated.indoor_location(tmp_path_factory.mktemp("walk"), route, seed=4)
    rows = (folder / "walk.txt").read_text().splitlines()
    for sensor in ("GYROSCOPE", "ACCELEROMETER", "MAGNETIC_FIELD"):
        kept = [row for row in rows if f"TYPE_{sensor}" not in row]
        (folder / f"{sensor}.txt").write_text("\n".join(kept) + "\n")
    header, *fixes = (folder / "fixes.csv").read_text().splitlines()
    late = [f"{float(time) + 1e5},{rest}" for time, rest in (row.split(",", 1) for row in fixes)]
    (folder / "late.csv").write_text("\n".join([header, *fixes, *late]) + "\n")
    far = [row.split(",") for row in fixes]
    (folder / "far.csv").write_text("\n".join([header, *(",".join((t, f"{float(x) + 5e3}", *o)) for t, x, *o in far)]))
    return folder


CASES = {
    "as it is": ("walk.txt", "fixes.csv"),
    "no gyroscope": ("GYROSCOPE.txt", "fixes.csv"),
    "no accelerometer": ("ACCELEROMETER.txt", "fixes.csv"),
    "no magnetometer": ("MAGNETIC_FIELD.txt", "fixes.csv"),
    "fixes outside the recording": ("walk.txt", "late.csv"),
    "no fixes": ("walk.txt", None),
}
# With a lag [s]: a window of ten seconds determines other coefficients than the whole walk
QUICK = {("as it is", 10.0), ("no gyroscope", None), ("no accelerometer", None), ("no fixes", None)}
WITH_LAG = [
    pytest.param(*case, marks=() if case in QUICK else pytest.mark.thorough)
    for case in ((name, lag) for name in CASES for lag in (None, 10.0))
]


def said(run, recording, out, options):
    """Warnings without those of one verb alone, what is missing, and the kinds of measurements reported."""
    missing = run(recording, out, options)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["missing"] == list(missing)
    unsaid = ONLY_BATCH if options.lag is None else (*ONLY_BATCH, "not observable")
    warnings = {line for line in summary["warnings"] if not any(text in line for text in unsaid)}
    return warnings, missing, len(summary["fixes"]), {"fixes", "beacons", "headings"} <= summary.keys()


@pytest.mark.parametrize(("case", "lag"), WITH_LAG)
def test_smooth_and_replay_say_the_same(folder, tmp_path, case, lag):
    recording, fixes = CASES[case]
    options = Options(fixes=fixes and folder / fixes, recorded_fixes=fixes is not None, lag=lag)
    smoothed = said(smooth_recording, folder / recording, tmp_path / "smoothed", options)
    assert said(replay_recording, folder / recording, tmp_path / "replayed", options) == smoothed


def test_smooth_and_replay_refuse_the_same(folder, tmp_path):
    """A plan that no fix can reach."""
    options, lines = Options(fixes=folder / "far.csv", plan=ARCADE), []
    for run in (smooth_recording, replay_recording):
        with pytest.raises(InputError, match="found a plan") as refused:
            run(folder / "walk.txt", tmp_path / run.__name__, options)
        lines.append(str(refused.value))
    assert lines[0] == lines[1]


@pytest.mark.parametrize("case", ["as it is", "no gyroscope", "no magnetometer", "fixes outside the recording"])
def test_a_lifelog_walk_says_what_smooth_says(folder, tmp_path, case):
    recording, fixes = CASES[case]
    options = Options(fixes=folder / fixes, lag=None)
    warnings, missing, *_ = said(smooth_recording, folder / recording, tmp_path / "smoothed", options)
    observed = {"hash": observe(folder / recording, RecordingOptions(fixes=folder / fixes))}
    [outing] = reconstruct("me", "2023-11-14", observed, None).outings
    assert set(outing.missing) == set(missing)
    assert warnings == set(outing.notes)


def test_measurements_of_any_kind_reach_both(folder):
    """A recording carries tables of any registered kind: here walking directions that a user gave."""
    inputs = read(folder / "walk.txt", Options(fixes=folder / "fixes.csv"))
    headings = Headings(np.array([4.0, 9.0]), np.array([0.1, 0.1]), np.array([0.05, 0.05]))
    inputs = replace(inputs, walk=replace(inputs.walk, measurements=(headings,)))
    batch = estimate(observe_walk(inputs)).estimate
    navigator = Navigator(frame=inputs.frame, lag=None)
    for event in events_of(replace(inputs.walk, fixes=inputs.fixes)):
        navigator.push(event)
    live = navigator.finish()
    for found in (batch, live):
        assert [report.time for report in found.reports["headings"]] == [4.0, 9.0]
    assert live.trajectory.position[-1] == pytest.approx(batch.trajectory.position[-1], abs=0.5)
