"""The client of the EvAAL API with a test server, and with a navigator that echoes the last fix."""

import csv
import runpy
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from evaal.evaal_server import Trial, serving
from evaal.trials import Echo, assert_same_as_loaded, received, rows_of, run, summary
from evaal_client import TRIES, Api, State
from evaal_rows import FIRST_SECOND, RowStream
from evaal_trial import INTERVAL, PositionFormat, run_trial
from recorders import G, get_sensor_data, sample

from pdr_graph.errors import InputError
from pdr_graph.frames import enu
from pdr_graph.io.loading import load
from pdr_graph.online.interface import Samples, Scan
from pdr_graph.types import Fixes

EXAMPLE = Path(__file__).resolve().parents[2] / "scripts" / "examples" / "evaal"
INITIAL = "11.10000000,49.45000000,1"


@pytest.fixture(scope="module")
def sampled():
    return sample()


@pytest.fixture(scope="module")
def log(sampled):
    """Ten seconds of rows of GetSensorData, without comments and truth."""
    return [row for row in rows_of(get_sensor_data(sampled)) if float(row.split(";")[1]) < 10.0]


def run_alone(trial, out, **options):
    """How a trial ends that is the only one of its server, and its navigator."""
    with serving(t=trial) as url:
        return run(url, out, **options)


# Peculiarities of the API


def test_a_405_with_time_left_is_a_timeout_of_the_server(tmp_path, log):
    """With 15 s of slack and 1.5 s per request, requests of 4 s exceed it at the seventh."""
    trial = Trial(log, took=4.0)
    ending, _ = run_alone(trial, tmp_path)
    assert (ending.normal, "timeout" in ending.text) == (False, True)
    assert trial.sent_rows < len(log)
    assert received(tmp_path) == log[: trial.sent_rows], "received rows are kept"


@pytest.mark.parametrize("position", ["", "11.1,49.45,0", "10.422057;43.718278;1", "1,2,3,4,5"])
def test_a_state_has_eight_fields_for_any_text_of_its_position(position):
    state = State.parse(f"0.000,-1.000,3.000,15.000,0.000,0.000,0.000,{position}\n")
    assert state.position == position
    assert (state.begun, state.offline) == (False, False)
    assert State.parse(f"0,-2,3,15,0,0,0,{position}").offline
    assert State.parse(f"3.5,0,3,-0.1,0,0.5,3,{position}").timed_out
    assert State.parse("<html>no such page</html>") is None


@pytest.mark.parametrize("fault", ["away", "lost", "cut", 423, 503])
def test_a_failed_request_is_repeated_without_losing_a_row(tmp_path, log, fault):
    trial, pauses = Trial(log, INITIAL, faults={1: fault, 5: fault, 6: fault, 9: fault}), []
    ending, _ = run_alone(trial, tmp_path, pauses=pauses)
    assert ending.normal
    assert received(tmp_path) == log, "each row once, in order"
    assert pauses == [0.05, 0.05, 0.1, 0.05], "each pause is twice as long"
    assert summary(tmp_path)["repeated"] == 4
    assert summary(tmp_path)["requests"] == trial.calls - 4 - 1
    labels = [call.split("label=")[1].split("&")[0] for call in trial.log if "nextdata" in call]
    if isinstance(fault, int):
        assert labels[:10] == ["0", "0", "1", "2", "3", "3", "3", "4", "5", "5"], "the request itself comes again"
    assert not any("reload" in call for call in trial.log)


def test_the_rows_of_an_offline_trial_are_requested_once(tmp_path, log):
    trial = Trial(log, INITIAL, offline=True, faults={1: "lost"})
    with serving(t=trial) as url:
        with pytest.raises(InputError, match="requested once"):
            run(url, tmp_path)
        with pytest.raises(InputError, match="a second request would end this one"):
            run(url, tmp_path)
    assert trial.calls == 1


def test_the_first_request_has_no_position(tmp_path, log):
    trial = Trial(log, INITIAL)
    run_alone(trial, tmp_path)
    first, second = [call for call in trial.log if "nextdata" in call][:2]
    assert "position" not in first
    assert "position=11.10000000,49.45000000,1" in second
    assert [t for t, _ in trial.estimates] == pytest.approx(INTERVAL * np.arange(1, len(trial.estimates) + 1), abs=0.01)


@pytest.mark.parametrize("separator", [";", ",", "\t"])
def test_other_separators_and_unknown_tags_are_read(tmp_path, log, separator):
    rows = [row.replace(";", separator) for row in log]
    rows[40:40] = [f"VISO{separator}0.8{separator}1", "garbage", f"ACCE{separator}0.81{separator}x"]
    rows.sort(key=lambda row: float(row.split(separator)[1]) if separator in row else 0.8)
    stream = RowStream()
    events = stream.feed("\n".join(rows))
    sensors = {e.sensor for e in events if isinstance(e, Samples)}
    assert sensors == {"accelerometer", "gyroscope", "magnetometer", "barometer"}
    assert {e.radio for e in events if isinstance(e, Scan)} == {"bluetooth", "wifi"}
    assert stream.rows["VISO"] == stream.rows["garbage"] == 1
    assert dict(stream.unread) == {"ACCE": 1}
    (tmp_path / "received.txt").write_text("\n".join(row for row in rows if row[-2:] != separator + "x"))
    assert len(load(tmp_path / "received.txt").accelerometer) == stream.rows["ACCE"] - 1


def test_a_slot_without_rows_is_not_the_end(tmp_path, log):
    gap = [row for row in log if not 5.0 <= float(row.split(";")[1]) < 9.0]
    assert run_alone(Trial(gap), tmp_path)[0].normal
    assert received(tmp_path) == gap


@pytest.mark.parametrize("initial", ["0,0,0", "0.0;0.0;0.0", "", "unknown\x1b[2J\x07"])
def test_a_trial_without_an_initial_position_has_no_initial_fix(tmp_path, log, initial):
    """The xDR server sends 0,0,0 for every trial. Texts of the server are printed without control characters."""
    ending, echo = run_alone(Trial(log, initial), tmp_path)
    assert (ending.normal, ending.text.isprintable()) == (True, True)
    fixes = [e for e in echo.events if isinstance(e, Fixes)]
    assert {source for fix in fixes for source in fix.source} == {"GNSS"}


def test_positions_are_sent_in_ascii():
    form = PositionFormat(True, "11.1,49.45,2")
    assert form.written(np.array([11.1, 49.45]), "地下1") == "11.10000000,49.45000000,2"
    assert form.written(np.array([11.1, 49.45]), "a,b").endswith(",2")
    assert form.written(np.array([11.1, np.nan]), "1") == ""
    assert PositionFormat(False, "").text(np.array([1.23456, -2.0]), "", None) == "1.235,-2.000,0"


# Failures


@pytest.mark.parametrize("fault", ["dies before it counts", "dies after it counted"])
def test_an_interrupted_trial_resumes_without_losing_a_row(tmp_path, log, fault):
    """Rows and sent positions are those of a trial without interruption."""
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    unbroken, trial = Trial(log, INITIAL), Trial(log, INITIAL, faults={17: fault})
    with serving(t=unbroken, u=trial) as url:
        run(url, whole)
        ending, _ = run(url, broken, "u")
        assert not ending.normal
        assert f"after {TRIES} tries" in ending.text
        assert (broken / "causal.csv").exists(), "results so far are written"
        trial.down = False
        with (broken / "received.txt").open("a") as file:
            file.write("ACCE;7.9;1;2")  # cut off by a kill while writing
        with (broken / "requests.log").open("a") as file:
            file.write("got\t1")
        ending, _ = run(url, broken, "u")
    assert ending.normal
    assert received(broken) == log
    assert trial.estimates == unbroken.estimates
    for name in ("causal.csv", "trajectory.csv"):
        assert (broken / name).read_text() == (whole / name).read_text()


def test_a_request_is_on_disk_before_it_is_sent(tmp_path, log):
    class Watched(Api):
        def next_data(self, label, position, horizon):
            last = (tmp_path / "requests.log").read_text().splitlines()[-1].split("\t")
            assert (last[0], last[1], last[3]) == ("ask", label, position)
            return super().next_data(label, position, horizon)

    with serving(t=Trial(log, INITIAL)) as url:
        assert run_trial(Watched(url, "t"), tmp_path, kind=Echo).normal


def test_a_folder_belongs_to_one_trial(tmp_path, log):
    with serving(t=Trial(log), u=Trial(log)) as url:
        run(url, tmp_path)
        with pytest.raises(InputError, match="a folder for each trial"):
            run(url, tmp_path, "u")


def test_a_reloaded_trial_requires_another_folder(tmp_path, log):
    trials = {"t": Trial(log, faults={3: "dies after it counted"})}
    with serving(**trials) as url:
        run(url, tmp_path)
        trials["t"].__init__(log)
        with pytest.raises(InputError, match="another --out"):
            run(url, tmp_path)


def test_a_trial_that_has_begun_is_joined_with_a_warning(tmp_path, log):
    trial = Trial(log, INITIAL)
    trial.next_data({"horizon": ["3"]})
    ending, echo = run_alone(trial, tmp_path)
    assert ending.normal
    assert "its rows before 3.0 s are lost" in summary(tmp_path)["warnings"][0]
    assert all(e.source == ("GNSS",) for e in echo.events if isinstance(e, Fixes)), "the initial position is not used"


@pytest.mark.parametrize("code", [400, 404, 405, 409, 422, 500])
def test_an_unexpected_answer_raises_one_line(tmp_path, log, code):
    with serving(t=Trial(log, faults={1: code}), u=Trial(log, faults={9: code})) as url:
        with pytest.raises(InputError, match=rf"t: found {code} 'not now', expected "):
            run(url, tmp_path / "t")
        ending, _ = run(url, tmp_path / "u", "u")
    assert not ending.normal
    assert f"found {code}" in ending.text
    assert (tmp_path / "u" / "trajectory.csv").exists()


def test_a_wrong_url_or_trial_raises_one_line(tmp_path, log):
    with serving(t=Trial(log)) as url:
        with pytest.raises(InputError, match=r"404.*expected the base URL, which ends in /evaalapi/, and the trial"):
            run(url, tmp_path / "a", "nobody")
        with pytest.raises(InputError, match="404"):
            run(url.replace("evaalapi/", ""), tmp_path / "b")
    with pytest.raises(InputError, match=r"Connect call failed.*expected a server of the EvAAL API"):
        run(url, tmp_path / "c")
    for wrong in ("file:///etc/passwd", "localhost:5000", "http://", "http://[", ""):
        with pytest.raises(InputError, match="expected http"):
            Api(wrong, "t")


def test_a_too_long_answer_raises(tmp_path, log, monkeypatch):
    monkeypatch.setattr("evaal_client.MAXIMUM_REQUEST", 3000)
    with serving(t=Trial(log)) as url, pytest.raises(InputError, match="more than 3000 bytes"):
        Api(url, "t").next_data("0", "", 20.0)


# Offline trials


def test_an_offline_trial_from_the_command_line(tmp_path, sampled, log, monkeypatch, capsys):
    """From initial position and GNSS fixes to a position each half second, as accurate as the fixes."""
    lon, lat = sampled.lonlat[0]
    trial = Trial(log, f"{lon:.8f},{lat:.8f},1", offline=True)
    with serving(t=trial) as url:
        assert command(monkeypatch, url, "t", "--out", tmp_path) == 0
        assert command(monkeypatch, url, "t", "--out", tmp_path) == 2
    assert "positions that were sent" in capsys.readouterr().err
    assert trial.calls == 1
    times = np.array([t for t, _ in trial.estimates])
    assert np.diff(times) == pytest.approx(0.5)
    places = np.array([[float(c) for c in p.split(",")] for _, p in trial.estimates])
    assert set(places[:, 2]) == {1.0}
    truth = np.column_stack([np.interp(times, sampled.fix_time, sampled.lonlat[:, n]) for n in (0, 1)])
    frame = enu(lat, lon)
    off = np.hypot(*(frame.from_lonlat(places[:, :2]) - frame.from_lonlat(truth)).T)
    assert np.median(off) < 1.0, "the fixes of this log are exact"
    assert summary(tmp_path)["ended"].startswith("201")


# Rows


def times_of(events):
    return np.concatenate([event.time for event in events])


@pytest.mark.parametrize("unit", [1.0, 1 / G], ids=["IPIN", "xDR, in g"])
def test_the_stream_gives_the_samples_of_the_whole_log(tmp_path, sampled, unit):
    """Times differ by the median of the lag so far against that of the whole log; here by rounding."""
    path = tmp_path / "log.txt"
    path.write_text(get_sensor_data(sampled, unit))
    assert_same_as_loaded(path, within=1e-3)


def test_samples_are_delayed_until_their_unit_is_known(log):
    stream, early = RowStream(), [row for row in log if float(row.split(";")[1]) < FIRST_SECOND - 0.1]
    assert not any(isinstance(e, Samples) for e in stream.feed("\n".join(early)))
    later = [row for row in log if row not in early]
    first = [e.time[0] for e in stream.feed("\n".join(later)) if isinstance(e, Samples) and e.sensor == "accelerometer"]
    assert first[0] == pytest.approx(0.004, abs=1e-3), "no sample is lost"


def test_a_sensor_clock_that_stands_still_is_not_used(sampled):
    rows = [f"GYRO;{t:.4f};0.0;0.1;0.2;0.3;3" for t in sampled.time]
    assert times_of(RowStream().feed("\n".join(rows))) == pytest.approx(sampled.time, abs=1e-4)


def test_a_sensor_clock_that_jumps_is_replaced_by_the_apps(sampled):
    stream, found, time = RowStream(), [], sampled.time[sampled.time < 10.0]
    for slot in np.split(time, np.searchsorted(time, np.arange(0.5, 10.0, 0.5))):
        rows = [f"GYRO;{t + 0.004:.4f};{t + (100.0 if t < 5 else 7.0):.4f};0.1;0.2;0.3;3" for t in slot]
        found += stream.feed("\n".join(rows))
    assert (np.diff(times_of(found)) > 0).all()
    assert times_of(found) == pytest.approx(time + 0.004, abs=1e-3)


def test_garbage_is_counted_and_left_out(log):
    stream = RowStream()
    good = sum(len(e.time) for e in RowStream().feed("\n".join(log)) if isinstance(e, Samples))
    rubbish = [
        "ACCE;nan;1;1;1;1;3",
        "ACCE;1e11;1;1;1;1;3",
        "GYRO;2.0",
        "GYRO;2.0;2.0;1e300;inf;0;3",
        "MAGN;" + "1" * 20_000,
        "GNSS;2.0;3.0;north;east;;;;;;",
        "BLE4;x;iBeacon;BE:AC:20:23:00:01;-90",
        "WIFI;2.0;;;;",
        '"',
        "\x00\x01",
        ";;;;",
    ]
    events = stream.feed("\n".join([*log[:300], *rubbish, *log[300:]]))
    assert sum(len(e.time) for e in events if isinstance(e, Samples)) == good
    assert sum(stream.unread.values()) == 8
    assert sum(stream.rows.values()) == len(log) + len(rubbish)


def test_truth_is_not_used(sampled):
    text = get_sensor_data(sampled)
    assert "POSI" in text
    stream = RowStream()
    with_truth = stream.feed(text)
    assert stream.rows["POSI"] == 1
    assert len(with_truth) == len(RowStream().feed("\n".join(rows_of(text))))


# The command line


def command(monkeypatch, *arguments):
    """The exit code of a command."""
    stand_in = types.ModuleType("pdr_graph.online.navigator")
    stand_in.Navigator = Echo
    monkeypatch.setitem(sys.modules, "pdr_graph.online.navigator", stand_in)
    monkeypatch.setattr(sys, "argv", ["evaal", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(EXAMPLE), run_name="__main__")
    return ended.value.code


def test_exit_codes_and_files_of_the_command_line(tmp_path, log, monkeypatch, capsys):
    with serving(t=Trial(log, INITIAL), late=Trial(log, took=4.0)) as url:
        assert command(monkeypatch, url, "t", "--out", tmp_path / "t") == 0
        assert command(monkeypatch, url, "late", "--out", tmp_path / "late") == 3
        assert "timeout" in capsys.readouterr().err
        assert command(monkeypatch, url, "nobody", "--out", tmp_path / "n") == 2
    error = capsys.readouterr().err
    assert error.startswith("evaal: ")
    assert error.count("\n") == 1
    with (tmp_path / "t" / "causal.csv").open(newline="") as file:
        header = next(csv.reader(file))
    assert header == ["time", "x", "y", "heading", "floor", "sigma_x", "sigma_y", "cov_xy", "sigma_heading"]
    written = summary(tmp_path / "t")
    assert (written["initial"], written["missing"]) == (INITIAL, [])
    files = {"requests.log", "received.txt", "log.txt", "causal.csv", "trajectory.csv", "summary.json"}
    assert {path.name for path in (tmp_path / "t").iterdir()} == files


def test_positions_in_the_output_frame_begin_at_the_initial_position(tmp_path, log):
    alone = [row for row in log if not row.startswith("GNSS")]
    trial = Trial(alone, "12.5;-3.25;2")
    with serving(t=trial, u=Trial(alone, "12.5;-3.25;2")) as url:
        run(url, tmp_path / "t", lonlat=False)
        ending, echo = run(url, tmp_path / "u", "u", lonlat=False, ignored=True)
    assert {position for _, position in trial.estimates} == {"12.500,-3.250,2"}
    assert not any(isinstance(e, Fixes) for e in echo.events)
    assert ending.missing == ("causal.csv: no position was available during the trial", "trajectory.csv: no fix came")
