"""What the server fetches by itself: phones with phyphox, messages of a broker, recordings of a study."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from starlette.exceptions import HTTPException

from pdr_graph.apps.serve.access import OWNER
from pdr_graph.apps.serve.intake import SENSOR_LOGGER
from pdr_graph.apps.serve.live_walk import LOG
from pdr_graph.apps.serve.mqtt import Broker, subscribe
from pdr_graph.apps.serve.phyphox_polling import PLATFORM, PhyphoxPhone, Stored, follow, stored_of
from pdr_graph.apps.serve.reception import Reception, id_of
from pdr_graph.apps.serve.study import StudyReports
from pdr_graph.errors import InputError
from pdr_graph.online.journal import read_body, read_entries

REFUSED_FOR_NOW = (429, 503, 507)  # status of a refusal that passes: too fast, not ready, disk full
REFUSAL_PAUSE = 5.0  # [s] until a message that was refused for a while is given again

Say = Callable[[str], None]


@dataclass(frozen=True)
class Sources:
    """phyphox: addresses of phones; broker: of MQTT, None without; study: reports for studies, None without."""

    phyphox: tuple[str, ...] = ()
    broker: Broker | None = None
    study: StudyReports | None = None


@asynccontextmanager
async def running(sources: Sources, reception: Reception, say: Say) -> AsyncIterator[None]:
    """Fetch from all sources while the context lasts. All walkers are the owner's."""
    work: list[Coroutine[Any, Any, None]] = [
        follow(PhyphoxPhone(url, partial(stored, reception)), partial(receive_patiently, reception, say), say)
        for url in sources.phyphox
    ]
    if sources.broker is not None:
        work.append(subscribe(sources.broker, partial(receive_once, reception), say))
    if sources.study is not None:
        work.append(sources.study.run())
    tasks = [asyncio.create_task(_reported(each, say)) for each in work]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _reported(work: Coroutine[Any, Any, None], say: Say) -> None:
    """Do some work; the error that ends it is told, and the server goes on."""
    try:
        await work
    except Exception as error:
        say(f"{type(error).__name__}: {error}")


def stored(reception: Reception, run: str) -> Stored | None:
    """What is stored of a run of phyphox; None of a new one."""
    log = reception.root / id_of(run) / LOG
    entries = list(read_entries(log)) if log.exists() else []
    if not entries:
        return None
    last = max(entries, key=lambda entry: entry.identity)
    return stored_of(last.identity + 1, read_body(log, last))


async def receive_patiently(reception: Reception, say: Say, body: bytes, name: str) -> None:
    """Store a message of a phone that keeps what it was not asked for: while there is no room, wait."""
    while True:
        try:
            reception.receive(SENSOR_LOGGER, OWNER, body, PLATFORM, name)
            return
        except InputError as refused:
            return say(f"{name}: {refused}")
        except HTTPException as refused:
            if refused.status_code not in REFUSED_FOR_NOW:
                return say(f"{name}: {refused.detail}")
        await asyncio.sleep(REFUSAL_PAUSE)


def receive_once(reception: Reception, body: bytes) -> None:
    """Store a message of a broker; one that is refused is lost, as by MQTT it may be."""
    with contextlib.suppress(HTTPException, InputError):
        reception.receive(SENSOR_LOGGER, OWNER, body)
