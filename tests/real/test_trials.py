"""Real logs, served as a competition serves them."""

import pytest
from evaal.evaal_server import Trial, serving
from evaal.trials import assert_same_as_loaded, received, rows_of, run, summary

from pdr_graph.io.loading import load

pytestmark = pytest.mark.thorough

LOGS = (
    "IPIN2023_T3_TrainingTrial01_repetition01.txt",
    "IPIN2023_T3_TrainingTrial24_repetition03.txt",
    "IPIN2023_T3_TrainingTrial52_repetition01.txt",
)


@pytest.mark.parametrize("name", LOGS[:1])
def test_every_row_of_a_real_log_arrives_once_and_in_order(data, tmp_path, name):
    """Though every hundredth answer is lost on the way."""
    rows = rows_of((data / "ipin2023_track3" / name).read_text(errors="replace"))
    trial = Trial(rows, faults=dict.fromkeys(range(7, 1000, 100), "lost"))
    with serving(t=trial) as url:
        ending, _ = run(url, tmp_path)
    assert ending.normal
    assert received(tmp_path) == rows
    said = summary(tmp_path)
    assert said["unread"] == {}
    assert sum(said["rows"].values()) == len(rows)
    print(f"{name}: {len(rows)} rows, {said['requests']} requests, {said['seconds']}")
    again, whole = load(tmp_path / "received.txt"), load(data / "ipin2023_track3" / name)
    assert again.accelerometer.values == pytest.approx(whole.accelerometer.values, rel=0, abs=0)


@pytest.mark.parametrize("name", LOGS)
def test_rows_of_a_real_log_are_read_alike_live_and_as_a_whole(data, name):
    """The median lag so far differs from that of all by the drift of the clocks: 5 ms a minute was seen."""
    worst = assert_same_as_loaded(data / "ipin2023_track3" / name, within=0.025)
    print(f"{name}: times differ by up to {1000 * worst:.1f} ms")
