"""Estimating processes that die, hang or read nothing: the server goes on, and says so."""

import asyncio
import os
import signal
import time

import estimating_standin
import pytest
from tiers import thorough

from pdr_graph.apps.serve import estimators
from pdr_graph.apps.serve.estimators import MOST_ATTEMPTS, Estimators
from pdr_graph.options import Options

PATIENCE = 60.0  # [s] on a machine under load


@pytest.fixture
def quick(monkeypatch):
    """Processes of the stand-in, with short limits."""
    monkeypatch.setattr(estimators, "run_process", estimating_standin.run_process)
    for name, seconds in (("RESTART", 0.05), ("PING_PERIOD", 0.1), ("LONGEST_SILENCE", 2.0), ("STOPPING", 1.0)):
        monkeypatch.setattr(estimators, name, seconds)


def with_walkers(tmp_path, ids, until, act=lambda running: None):
    """All updates of processes with these walkers, of which each new process hears, until a condition on them."""
    updates = []

    async def go():
        def started(number):
            for id_ in ids:
                running.tell("new", id_)

        running = Estimators(1, tmp_path, Options(), lambda kind, update: updates.append((kind, update)), started)
        await running.start()
        try:
            async with asyncio.timeout(PATIENCE):
                while not until(updates):
                    act(running)
                    await asyncio.sleep(0.02)
        finally:
            began = time.monotonic()
            await running.stop()
            assert time.monotonic() - began < 10.0

    asyncio.run(go())
    return updates


def failures(updates):
    return [update for kind, update in updates if kind == "failed"]


@pytest.mark.parametrize(
    ("walker", "text"),
    [
        ("deadly", "its process was killed or crashed"),
        thorough("freezing", "its process did not answer for 2 s"),
    ],
)
def test_a_walker_that_ends_or_hangs_its_process_again_and_again_is_left_alone(tmp_path, quick, walker, text):
    """And the others of the process go on."""

    def until(updates):
        return len(failures(updates)) >= MOST_ATTEMPTS and ("looked", {"id": "calm"}) in updates

    found = failures(with_walkers(tmp_path, [walker, "calm"], until))
    assert [failure["id"] for failure in found] == [walker] * MOST_ATTEMPTS
    assert [failure["again"] for failure in found] == [True, True, False]
    assert all(failure["text"].startswith(text) for failure in found)
    assert found[-1]["text"].endswith("; it is left alone until the next start; its messages are kept")


def test_a_stopped_process_is_replaced_and_no_message_to_it_waits(tmp_path, quick):
    """With nobody at work no walker is blamed. More messages than a pipe holds do not stop the event loop."""
    stopped = []

    def act(running):
        process = running._running[0].runner
        if not stopped and process.is_alive():
            os.kill(process.pid, signal.SIGSTOP)
            stopped.append(process.pid)
            for _ in range(20_000):
                running.tell("finish", "calm")
        elif stopped != [process.pid] and not stopped[1:]:
            stopped.append(process.pid)
            running.tell("new", "later")

    def until(updates):
        return ("looked", {"id": "later"}) in updates

    assert failures(with_walkers(tmp_path, ["calm"], until, act)) == []
