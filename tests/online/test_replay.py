"""``pdr-graph replay`` with a stand-in for the navigator: its options and its output."""

import csv
import json
from dataclasses import replace

import commands
import numpy as np
import pytest
import simulated
from standin import Metronome
from tiers import thorough

from pdr_graph import InputError
from pdr_graph.apps.cli.terminal import live_lines
from pdr_graph.apps.replay import Latency, replay_recording
from pdr_graph.apps.report.evaluation import coverage
from pdr_graph.io.tables import read_trajectory
from pdr_graph.io.writers import write_trajectory
from pdr_graph.types import Trajectory
from pdr_graph.walk import Options

ROUTE = np.array([(0.0, 0.0), (20.0, 0.0), (20.0, 10.0)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return simulated.indoor_location(tmp_path_factory.mktemp("walk"), ROUTE, seed=4)


@pytest.fixture(scope="module")
def result(folder):
    assert replay_recording(folder / "walk.txt", folder / "live", Options(fixes=folder / "fixes.csv"), Metronome) == ()
    return folder / "live"


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_it_writes_what_the_contract_names(result):
    written = {path.name for path in result.iterdir()}
    assert {"causal.csv", "latency.json", "trajectory.csv", "figure.png", "summary.json"} <= written
    causal, summary = rows(result / "causal.csv"), json.loads((result / "summary.json").read_text())
    assert list(causal[0]) == list(rows(result / "trajectory.csv")[0])
    assert len(causal) == summary["steps"] + 1, "the first pose and one of each step"
    assert np.diff([float(row["time"]) for row in causal]) == pytest.approx(0.5, abs=0.03)
    assert float(causal[0]["time"]) == pytest.approx(simulated.START, abs=0.03), "the recorder's clock"
    assert "the compass is broken" in summary["warnings"]
    assert summary["settings"]["lag"] == 60.0
    assert {"reading", "replay", "finish", "write"} <= set(summary["seconds"])


def test_the_summary_headlines_the_live_track(folder, result):
    """With the truth its error and coverage, as `evaluate` has it, and those of the smoothed walk beside it."""
    causal, summary = rows(result / "causal.csv"), json.loads((result / "summary.json").read_text())
    live = summary["live"]
    assert (live["poses"], live["sigma"]) == (len(causal), 1.0)
    assert live["first_pose"] == pytest.approx(0.0, abs=0.01)
    assert live["error"]["p95"] > 3.0, "the metronome goes to the east"
    [line] = live_lines(live | {"error": None})
    assert line == "live, known at once: first pose after 0.0 s, median sigma 1.0 m"
    truth = Trajectory(np.array([float(row["time"]) for row in causal]), *moved(causal, 2.0))
    write_trajectory(folder / "truth.csv", truth, 0.0)
    options = Options(fixes=folder / "fixes.csv", truth=folder / "truth.csv")
    replay_recording(folder / "walk.txt", folder / "scored", options, Metronome)
    live = json.loads((folder / "scored" / "summary.json").read_text())["live"]
    assert [live["error"][name] for name in ("p50", "p75", "p95")] == pytest.approx([2.0] * 3, abs=0.02)
    assert live["error"]["in_90"] == 1.0
    assert live["hindsight"]["error"]["p50"] > 0
    track = read_trajectory(folder / "scored" / "causal.csv")
    outside = Trajectory(truth.time, *moved(causal, 3.0))
    assert coverage(track, truth) == 1.0
    assert coverage(track, outside) == 0.0, "a control: 3 m at a sigma of 1 m"
    lines = [f"{t},{x},{y},1.0" for t, (x, y) in zip(outside.time, outside.position, strict=True)]
    (folder / "noisy.csv").write_text("\n".join(["time,x,y,sigma", *lines]))
    assert coverage(track, read_trajectory(folder / "noisy.csv")) == 1.0, "the truth's sigma widens the region"
    lines = list(live_lines(live))
    assert lines[0].startswith("live, known at once: error 50 / 75 / 95 %: 2.0 / 2.0 / 2.0 m, 100 % in the 90 % region")
    assert lines[1].startswith("in hindsight, smoothed: error ")
    content = (folder / "scored" / "report.html").read_text()
    assert "live, known at once: error 50 / 75 / 95 %" in content
    assert "in hindsight, smoothed" in content


def moved(causal, distance):
    """Positions and headings of a truth that is so far [m] from the current poses."""
    position = np.array([(float(row["x"]) + distance, float(row["y"])) for row in causal])
    return position, np.zeros(len(causal))


def test_poses_are_causal(folder, result, tmp_path):
    lines = (folder / "fixes.csv").read_text().splitlines()
    (tmp_path / "fixes.csv").write_text("\n".join(lines[:3]) + "\n")
    later = float(lines[3].split(",")[0])
    replay_recording(folder / "walk.txt", tmp_path, Options(fixes=tmp_path / "fixes.csv"), Metronome)
    few, all_ = rows(tmp_path / "causal.csv"), rows(result / "causal.csv")
    assert [row for row in few if float(row["time"]) < later] == [row for row in all_ if float(row["time"]) < later]
    assert few[-1] != all_[-1], "a control: they differ in the end"


def test_latency_covers_all_events_between_two_steps(monkeypatch):
    ticks = iter(np.cumsum([0, 1, 0, 2, 0, 7, 0, 4, 0, 5]) / 1000.0)
    monkeypatch.setattr("time.perf_counter", lambda: next(ticks))
    latency = Latency()
    latency.push(lambda event: None, "1 ms")
    latency.push(lambda event: None, "2 ms")
    assert latency.step(lambda: "7 ms") == "7 ms"
    latency.push(lambda event: None, "4 ms")
    latency.step(lambda: "5 ms")
    described = latency.describe()
    assert (described["steps"], described["push"]["median"], described["push"]["max"]) == (2, 3.5, 4.0)
    assert (described["pose"]["median"], described["pose"]["max"]) == (6.0, 7.0)


def test_latency_of_a_replay(result):
    described = json.loads((result / "latency.json").read_text())
    assert list(described["push"]) == ["median", "p95", "p99", "p99.9", "max"]
    assert list(described["push"].values()) == sorted(described["push"].values())
    assert described["steps"] == json.loads((result / "summary.json").read_text())["steps"]
    assert described["peak_memory"] is None or described["peak_memory"] > 10
    assert all(look["resident"] > 10 for look in described["memory"])


def test_long_walks_have_as_many_memory_measurements_as_short_ones():
    latency = Latency()
    for now in range(100_000):
        latency.measure_memory(float(now))
    assert 50 < len(latency.memory) <= 200
    assert latency.memory[0][0] == 0
    assert latency.memory[-1][0] > 99_000


class Dies(Metronome):
    """Of Ctrl-C, half-way."""

    def push(self, event):
        super().push(event)
        if self.steps == 25:
            raise KeyboardInterrupt


def test_a_journal_resumes_where_it_was_interrupted(folder, result, tmp_path):
    options = Options(fixes=folder / "fixes.csv", journal=tmp_path / "walk.journal")
    with pytest.raises(KeyboardInterrupt):
        replay_recording(folder / "walk.txt", tmp_path, options, Dies)
    replay_recording(folder / "walk.txt", tmp_path, options, Metronome)
    assert (tmp_path / "trajectory.csv").read_text() == (result / "trajectory.csv").read_text()
    assert "events were in the journal" in " ".join(json.loads((tmp_path / "summary.json").read_text())["warnings"])
    causal = rows(tmp_path / "causal.csv")
    assert causal == rows(result / "causal.csv")[-len(causal) :]
    with pytest.raises(InputError, match="lag"):
        replay_recording(folder / "walk.txt", tmp_path, replace(options, lag=None), Metronome)


def invoked(monkeypatch, *arguments, kind=Metronome):
    monkeypatch.setattr("pdr_graph.online.navigator.Navigator", kind)
    return commands.run("replay", *arguments)


@pytest.mark.parametrize(("said", "lag"), [("30", 30.0), ("inf", None), ("none", None)])
def test_the_command_line(folder, tmp_path, monkeypatch, said, lag):
    seen = []

    class Seen(Metronome):
        def __init__(self, *given, **options):
            super().__init__(*given, **options)
            seen.append(self.lag)

    arguments = (folder / "walk.txt", "--fixes", folder / "fixes.csv", "--lag", said, "--out", tmp_path)
    done = invoked(monkeypatch, *arguments, kind=Seen)
    assert done.code == 0
    assert "\r" not in done.output, "no progress in a pipe"
    assert done.output.endswith(f"\n-> {tmp_path / 'report.html'}\n")
    assert seen == [lag]


@pytest.mark.parametrize("said", ["-1", "0", "nan", "long"])
def test_invalid_lags_are_errors(folder, tmp_path, monkeypatch, said):
    done = invoked(monkeypatch, folder / "walk.txt", "--lag", said, "--out", tmp_path)
    assert (done.code, len(done.errors)) == (2, 1)
    assert done.errors[0].startswith("pdr-graph: --lag: found")


GPX = """<gpx xmlns="http://www.topografix.com/GPX/1/1" version="1.1" creator="t"><trk><trkseg>
<trkpt lat="35" lon="135"><time>2024-01-01T00:00:00Z</time></trkpt>
<trkpt lat="35.0001" lon="135"><time>2024-01-01T00:00:10Z</time></trkpt>
</trkseg></trk></gpx>"""


def test_without_sensors_the_fixes_are_smoothed_with_a_note(tmp_path, monkeypatch):
    (tmp_path / "walk.gpx").write_text(GPX)
    done = invoked(monkeypatch, tmp_path / "walk.gpx", "--out", tmp_path / "live")
    assert done.code == 0
    assert "note: positions alone: " in done.output
    assert len(rows(tmp_path / "live" / "trajectory.csv")) == 2
    assert rows(tmp_path / "live" / "causal.csv") == []


def test_without_steps_and_fixes_is_an_input_error(folder, tmp_path):
    class Nothing(Metronome):
        def push(self, event):
            pass

    with pytest.raises(InputError, match="neither steps nor fixes"):
        replay_recording(folder / "walk.txt", tmp_path, Options(recorded_fixes=False), Nothing)


@pytest.mark.parametrize("journal", [False, thorough(True)])
def test_a_walk_whose_only_fix_has_left_the_window_has_a_place(folder, tmp_path, journal):
    """The direction is given. Its score is that of the walk whose fix is still in the window, or nearly."""
    scores = {}
    table = (folder / "fixes.csv").read_text().splitlines()
    (tmp_path / "first.csv").write_text("\n".join(table[:2]) + "\n")
    for lag in (6.0, 1000.0):
        given = Options(fixes=tmp_path / "first.csv", start_heading=90.0, truth=folder / "truth.csv", lag=lag)
        given = replace(given, journal=tmp_path / f"{lag}.journal" if journal else None)
        assert replay_recording(folder / "walk.txt", tmp_path / "out", given) == ()
        summary = json.loads((tmp_path / "out" / "summary.json").read_text())
        assert summary["sigma"] is not None
        scores[lag] = summary["live"]["hindsight"]["error"]["p50"]
    assert scores[6.0] == pytest.approx(scores[1000.0], abs=0.5)
