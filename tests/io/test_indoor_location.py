"""The reader of Indoor Location Competition recordings: what it reads, and what it rejects."""

import numpy as np
import pytest
from refusals import refused

from pdr_graph.io.loading import load

START = 1_574_567_416_839


def lines(seconds=2.0, rate=50):
    """A complete small recording: gravity on z, a turn of 0.5 rad/s, two waypoints, other rows out of time order."""
    out = [f"#\tstartTime:{START}", "#\tSiteID:x\tSiteName:y\tFloorName:F1"]
    for n in range(round(seconds * rate)):
        t = START + n * 1000 // rate
        out.append(f"{t}\tTYPE_ACCELEROMETER\t0.1\t-0.2\t9.81\t3")
        out.append(f"{t}\tTYPE_GYROSCOPE\t0.0\t0.0\t0.5\t3")
        out.append(f"{t}\tTYPE_WIFI\tname\t00:00\t-50\t2412\t{t - 100_000}")
    out.append(f"{START + 1000}\tTYPE_WAYPOINT\t3.0\t4.0")
    out.insert(2, f"{START - 120}\tTYPE_WAYPOINT\t1.0\t2.0")
    return [*out, f"#\tendTime:{START + 2000}"]


def written(tmp_path, content):
    path = tmp_path / "walk.txt"
    path.write_text("\n".join(content) + "\n") if isinstance(content, list) else path.write_bytes(content)
    return path


def test_reader_indoor_location(tmp_path):
    walk = load(written(tmp_path, lines()))
    assert len(walk.accelerometer) == len(walk.gyroscope) == 100
    assert walk.magnetometer is None
    assert walk.clock_origin == walk.epoch == START / 1000
    assert walk.accelerometer.time[0] == 0.0
    assert walk.accelerometer.values[7] == pytest.approx([0.1, -0.2, 9.81])
    assert np.diff(walk.accelerometer.time) == pytest.approx(0.02, abs=1e-6)  # floats hold Unix time to 0.2 µs
    assert walk.truth.time == pytest.approx([-0.12, 1.0])
    assert walk.truth.position == pytest.approx(np.array([[1.0, 2.0], [3.0, 4.0]]))
    assert len(walk.fixes) == 0, "truth is never a fix"
    assert walk.notes == ()


def test_an_access_point_is_received_once_at_its_last_seen_time(tmp_path):
    """Scans repeat receptions for minutes; if the last-seen time is on another clock, the time of the row is used."""
    wifi = [f"{START + 1000 * n}\tTYPE_WIFI\tname\taa:00\t-50\t2412\t{START + 300}" for n in (1, 2, 3)]
    wifi.append(f"{START + 2000}\tTYPE_WIFI\tname\tbb:00\t-60\t2412\t7000000")
    others = [line for line in lines() if "WIFI" not in line]
    received = load(written(tmp_path, [*others[:-1], *wifi, others[-1]])).wifi
    assert received.time == pytest.approx([0.3, 2.0], abs=1e-6)
    assert received.transmitter == ("aa:00", "bb:00")
    assert received.rssi.tolist() == [-50.0, -60.0]


def replaced(old, new):
    return [line.replace(old, new, 1) if line.startswith(f"{START + 20}\tTYPE_ACC") else line for line in lines()]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"time,x,y\n1,2,3\n", "header time,x,y, expected a recording"),
        (lines()[:150], "endTime"),
        ("\n".join(lines()).encode()[:3000], "endTime"),
        ("\n".join(lines()).encode().replace(b"9.81", b"\xff\xfe", 1), "UTF-8"),
        (replaced("9.81", "nan"), "line 7, TYPE_ACCELEROMETER.*nan"),
        (replaced("9.81", "inf"), "line 7"),
        (replaced("9.81", "9,81"), "line 7"),
        (replaced("\t9.81\t3", ""), "line 7"),
        ([*lines()[:2], *reversed(lines()[2:-1]), lines()[-1]], "time order"),
        ([line for line in lines() if "ACC" not in line and "GYR" not in line], "no accelerometer and no gyroscope"),
    ],
)
def test_bad_recordings_raise_one_line(tmp_path, content, message):
    refused(load, written(tmp_path, content), message)


def test_lines_that_are_not_rows_are_noted(tmp_path):
    walk = load(written(tmp_path, [*lines()[:5], "a name with a", "line break", *lines()[5:]]))
    assert len(walk.accelerometer) == 100
    assert "2 lines are not rows (the first: line 6)" in walk.notes[0]


def test_a_missing_file_raises_no_such_file(tmp_path):
    refused(load, tmp_path / "nothing.txt", "no such file")
