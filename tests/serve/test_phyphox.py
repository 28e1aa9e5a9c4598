"""phyphox polling against a stand-in that speaks the documented calls."""

import asyncio
import contextlib

import numpy as np
import pytest
from phyphox_phone import Phone, serving
from streamed_walks import finished_recording, local_server, soon, until, used

from pdr_graph.apps.serve import pulling
from pdr_graph.apps.serve.pulling import HISTORY, PhoneError, PhyphoxPhone, Sources, follow, messages_of
from pdr_graph.apps.serve.sensor_messages import parse, tables_of
from pdr_graph.errors import InputError
from pdr_graph.io.loading import load

pytestmark = pytest.mark.timeout(60)
UNIX = 1_700_000_000.0


def poll_of(phone):
    return asyncio.run(phone.poll())


@pytest.fixture
def phone():
    """A phone that has recorded a second."""
    phone = Phone()
    phone.start(0.0, UNIX)
    walk(phone, 0, 1)
    return phone


@pytest.fixture
def polled(phone):
    with serving(phone) as url:
        yield PhyphoxPhone(url, timeout=2.0)


def walk(phone, begin, end, step=0.01):
    """Samples of the accelerometer, x a hundredth of their time, one of the gyroscope each, and a fix at the begin."""
    for time in np.arange(begin, end, step).round(6).tolist():
        phone.record("accelerometer", time, time / 100, 0.0, 9.8)
        phone.record("gyroscope", time, 0.0, 0.0, 0.1)
    phone.record("location", begin, 49.45, 11.08, 300.0, 4.0)


def test_each_sample_comes_once_at_its_unix_time(phone, polled):
    """Each request has a connection of its own, and encodes what separates a threshold from its buffer."""
    phone.clear()
    assert poll_of(polled).run == "", "it has not started"
    phone.start(0.0, UNIX)
    assert len(poll_of(polled).tables["accelerometer"]) == 0
    tables = []
    for second in range(4):
        walk(phone, second, second + 1)
        tables.append(poll_of(polled).tables["accelerometer"])
    rows = np.concatenate(tables)
    assert [len(table) for table in tables] == [100] * 4
    np.testing.assert_allclose(rows[:, 0], UNIX + np.arange(0, 4, 0.01), atol=1e-6)
    np.testing.assert_allclose(rows[:, 1], np.arange(0, 0.04, 0.0001), atol=1e-9)
    assert {(connection, "|" in path) for path, connection in phone.asked} == {("close", False)}


def test_the_location_has_its_accuracy_and_the_phone_its_name(phone, polled):
    poll = poll_of(polled)
    np.testing.assert_allclose(poll.tables["location"], [[UNIX, 49.45, 11.08, 4.0]])
    assert (poll.name, poll.measuring, poll.ignored) == ("Fairphone 5", True, ("light",))


def test_a_pause_is_a_gap_in_unix_time(phone, polled):
    first = poll_of(polled)
    phone.pause(1.0, UNIX + 1.0)
    assert not poll_of(polled).measuring
    phone.start(1.0, UNIX + 61.0)
    walk(phone, 1, 2)
    then = poll_of(polled)
    assert then.run == first.run
    assert then.tables["accelerometer"][0, 0] == pytest.approx(UNIX + 61.0)


def test_cleared_data_are_another_run(phone, polled):
    walk(phone, 1, 3)
    first = poll_of(polled)
    phone.clear()
    assert poll_of(polled).run == ""
    phone.start(0.0, UNIX + 100.0)
    walk(phone, 0, 1)
    second = poll_of(polled)
    assert second.run not in ("", first.run)
    assert len(second.tables["accelerometer"]) == 100
    assert second.tables["accelerometer"][0, 0] == pytest.approx(UNIX + 100.0)


def test_data_cleared_between_two_questions_of_a_poll_are_not_given_the_old_clock(phone, polled):
    walk(phone, 1, 3)
    poll_of(polled)
    phone.clear()
    phone.start(0.0, UNIX)  # /time as before
    walk(phone, 0, 1)
    phone._part, part = lambda name, how: part(name, how and f"-1|{how.partition('|')[2] or name}"), phone._part
    assert poll_of(polled).tables == {}, "an answer in full, with times before those asked for"


def test_another_session_is_another_run(phone, polled):
    first = poll_of(polled)
    phone.session = "ffee00"
    walk(phone, 1, 2)
    assert poll_of(polled).tables == {}
    assert poll_of(polled).run not in ("", first.run)


def test_messages_are_those_of_sensor_logger(phone, polled):
    walk(phone, 1, 50)
    numbers, times = [], []
    for number, text in enumerate(messages_of(poll_of(polled), 3), 3):
        message = parse(text)
        tables, ignored = tables_of(message.payload)
        assert (message.messageId, message.sessionId, ignored) == (number, f"phyphox-ab12cd-{UNIX:.0f}000", {})
        assert sorted(set(tables) - {"location"}) == ["accelerometeruncalibrated", "gyroscope"]
        numbers.append(number)
        times.append(tables["accelerometeruncalibrated"][:, 0])
    assert numbers == [3, 4, 5], "20 s each"
    np.testing.assert_allclose(np.concatenate(times), UNIX + np.arange(0, 50, 0.01), atol=1e-6)


@pytest.mark.anyio
async def test_a_phone_is_followed_through_its_faults(phone, monkeypatch):
    monkeypatch.setattr(pulling, "POLL_INTERVAL", 0.02)
    monkeypatch.setattr(pulling, "FIRST_RETRY", 0.02)
    received, said = [], []

    async def receive(message, name):
        received.append(parse(message).messageId)

    with serving(phone) as url:
        task = asyncio.create_task(follow(PhyphoxPhone(url, timeout=1.0), receive, said.append))
        await soon(lambda: received)
        phone.faults = ["reset", 500]
        await soon(lambda: len(said) == 3)
        walk(phone, 1, 2)
        await soon(lambda: received == [0, 1])
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
    assert ["answers" in said[0], "no answer" in said[1], "answers" in said[2]] == [True] * 3


def test_of_a_long_experiment_the_last_minutes_are_asked_for(phone, polled):
    walk(phone, 1, 1000, step=1.0)
    times = poll_of(polled).tables["accelerometer"][:, 0]
    assert times[0] - UNIX == pytest.approx(999 - HISTORY, abs=1.0)


def test_nulls_and_unequal_buffers_cost_only_their_rows(phone, polled):
    phone.buffers["accY"][2] = float("nan")
    phone.buffers["accZ"].pop()
    assert len(poll_of(polled).tables["accelerometer"]) == 98
    phone.buffers["accZ"].append(9.8)
    assert len(poll_of(polled).tables["accelerometer"]) == 1, "the row whose last value came late"


OTHER_ANSWERS = {
    "no answer": lambda phone: phone.faults.append("reset"),
    "expected an answer of phyphox": lambda phone: phone.events.append({"event": "START"}),
    "expected phyphox 1.1.8 or later": lambda phone: phone.faults.append(404),
}


@pytest.mark.parametrize("text", OTHER_ANSWERS)
def test_what_is_no_phyphox_is_one_line(phone, polled, text):
    OTHER_ANSWERS[text](phone)
    with pytest.raises(PhoneError, match=text):
        poll_of(polled)


@pytest.mark.parametrize("fault", ["reset", "half", 500])
def test_a_fault_is_one_line_and_loses_nothing(phone, polled, fault):
    poll_of(polled)
    walk(phone, 1, 2)
    phone.faults = [None, fault]  # of /get, after /time
    with pytest.raises(PhoneError, match="127"):
        poll_of(polled)
    again = poll_of(polled)
    assert len(again.tables["accelerometer"]) == 100


def test_an_address_may_lack_the_scheme():
    assert PhyphoxPhone("192.168.0.12:8080").url == "http://192.168.0.12:8080"
    with pytest.raises(InputError, match="as phyphox shows it"):
        PhyphoxPhone("ftp://phone")


def test_a_phone_with_phyphox_is_a_walker_that_goes_on_after_a_restart(phone, tmp_path):
    walk(phone, 1, 8)
    with serving(phone) as url:
        sources = Sources(phyphox=(url,))
        with local_server(tmp_path, sources=sources) as client:
            first = until(lambda: used(client, 1))
            assert (first["name"], first["lat"]) == ("Fairphone 5", pytest.approx(49.45, abs=1e-3))
            assert {"accelerometer", "gyroscope"} <= set(first["health"])
        walk(phone, 8, 14)
        with local_server(tmp_path, sources=sources) as client:
            assert until(lambda: used(client, 2))["id"] == first["id"]
            (tmp_path / "walk.zip").write_bytes(finished_recording(client, first["id"]))
    samples = load(tmp_path / "walk.zip").accelerometer
    np.testing.assert_allclose(samples.time, np.arange(0, 14, 0.01), atol=1e-4)
    np.testing.assert_allclose(samples.values[:, 0], np.arange(0, 0.14, 0.0001), atol=1e-9)


def test_a_phone_that_is_not_there_keeps_nothing_from_starting(tmp_path):
    with local_server(tmp_path, sources=Sources(phyphox=("http://127.0.0.1:9",))) as client:
        assert client.get("/walkers").json() == []
