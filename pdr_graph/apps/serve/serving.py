"""The server as a whole: sessions, estimating processes, routes and uvicorn."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import multiprocessing
import os
import socket
import sys
import threading
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from uvicorn.protocols.http.h11_impl import H11Protocol

from pdr_graph.apps.replay import navigator_of
from pdr_graph.apps.serve.access import Access
from pdr_graph.apps.serve.application import Server, application
from pdr_graph.apps.serve.estimators import STOPPING, Estimators, end_all
from pdr_graph.apps.serve.home_assistant import announce
from pdr_graph.apps.serve.live_walk import Session, finish
from pdr_graph.apps.serve.publishing import Hub, plan_layers
from pdr_graph.apps.serve.pulling import Sources, running
from pdr_graph.apps.serve.receivers import listen
from pdr_graph.apps.serve.reception import Limits, Reception
from pdr_graph.errors import InputError, Interrupted
from pdr_graph.floor.building import Building
from pdr_graph.types import Beacons
from pdr_graph.walk import LIVE, Options

SESSIONS, TOKENS = "sessions", "tokens.json"


@dataclass(frozen=True)
class Settings:
    """Options of the server.

    folder: of sessions and tokens; options: of the estimates, fields of `Options`; store: lifelog of finished sessions;
    workers: estimating processes, 0 for a thread; tokens: by user, none if every request is the owner's; tiles: address
    of a tile server for the page; sources: what the server fetches by itself.
    """

    folder: Path
    options: Mapping[str, Any] = field(default_factory=dict)
    store: Path | None = None
    workers: int = 1
    tokens: Mapping[str, str] = field(default_factory=dict)
    tiles: str | None = None
    limits: Limits = field(default_factory=Limits)
    sources: Sources = field(default_factory=Sources)


def read_inputs(options: Mapping[str, Any]) -> tuple[Building | None, Beacons | None]:
    """The plan and the beacons of live estimates. Raises InputError if a file of the options cannot be used."""
    known = navigator_of(Options(**options, method=LIVE)).keywords
    return known["floor"], known["beacons"]


def build(settings: Settings, building: Building | None = None) -> Starlette:
    """The application, whose lifespan starts and stops everything. building: of `read_inputs`."""
    hub = Hub()
    pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), max_tasks_per_child=20)

    async def finishing(session: Session) -> str:
        arguments = (reception.root / session.id, settings.store, settings.options.get("plan"))
        try:
            return await asyncio.get_running_loop().run_in_executor(pool, finish, *arguments)
        except (RuntimeError, OSError) as error:  # the pool was shut down, or its process was killed
            return f"the recording could not be completed: {error}"

    reception = Reception(settings.folder / SESSIONS, hub, settings.limits, finishing, say)
    estimators = Estimators(settings.workers, reception.root, settings.options, reception.update, reception.started)
    reception.estimators = estimators

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        reception.load()
        await estimators.start()
        try:
            home, receivers = settings.sources.home, settings.sources.receivers
            more = [] if home is None else [announce(home, hub, building, say)]
            more += [] if receivers is None else [listen(receivers, reception, say)]
            async with running(settings.sources, reception, say, more):
                try:
                    yield
                finally:
                    hub.close()  # before the tasks are cancelled, which aiomqtt may swallow in Python 3.11
        finally:
            await estimators.stop()
            reception.close()
            finishers = list((pool._processes or {}).values())  # else the interpreter's end waits for them
            pool.shutdown(wait=False, cancel_futures=True)
            await end_all(finishers, STOPPING, force=True)

    access, study = Access(settings.tokens), settings.sources.study
    plan = plan_layers(building)
    return application(Server(hub, access, plan, settings.tiles, reception, study), lifespan)


def say(text: str) -> None:
    """Print a line about a source."""
    print(text, file=sys.stderr, flush=True)


class Protocol(H11Protocol):
    """HTTP that closes connections which send no complete head in time; uvicorn's own waits for ever."""

    def connection_made(self, transport: Any) -> None:
        """Begin to wait for the first request."""
        super().connection_made(transport)
        self.loop.call_later(20.0, self._close_if_silent)  # [s] for the head of a request to arrive

    def _close_if_silent(self) -> None:
        if self.cycle is None and not self.transport.is_closing():
            self.transport.close()


class Uvicorn(uvicorn.Server):
    """A server whose streams end when it does: else it waits for them. Then the process has STOPPING seconds."""

    def __init__(self, config: uvicorn.Config, end_streams: Callable[[], None]):
        super().__init__(config)
        self._end_streams = end_streams

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End streams, then all else; a thread that waits for a silent name server would keep the process."""
        self._end_streams()
        await super().shutdown(sockets)
        end = threading.Timer(STOPPING, os._exit, (0,))
        end.daemon = True
        end.start()


def is_news(record: logging.LogRecord) -> bool:
    """False for the traceback of a request that was cancelled because the server ends."""
    return not (record.exc_info and isinstance(record.exc_info[1], asyncio.CancelledError))


def serve(app: Starlette, host: str, port: int, ready: Callable[[int], None] = lambda port: None) -> None:
    """Serve until Ctrl-C or SIGTERM, by which the process ends too.

    ready: called with the port when it accepts connections; port 0: any free one.
    Raises InputError if the address cannot be used.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
        listening.listen(1024)
    except OSError as error:
        listening.close()
        expected = "a free port, and an address of this machine"
        raise InputError("--host, --port", f"{host}:{port}", error.strerror or str(error), expected) from None
    config = uvicorn.Config(
        app,
        http=Protocol,
        ws="websockets-sansio",
        log_level="warning",
        access_log=False,  # it would have the tokens of the addresses
        limit_concurrency=1000,  # connections
        timeout_keep_alive=75,  # [s]: a phone that posts every minute keeps its connection
        timeout_graceful_shutdown=3,
        server_header=False,
        ws_max_size=1 << 16,
    )
    logging.getLogger("uvicorn.error").addFilter(is_news)
    hub = getattr(getattr(app.state, "server", None), "hub", None)
    server = Uvicorn(config, hub.close if isinstance(hub, Hub) else lambda: None)
    ready(listening.getsockname()[1])
    with contextlib.suppress(KeyboardInterrupt, Interrupted), listening:
        server.run(sockets=[listening])


def addresses(host: str, port: int) -> list[str]:
    """The addresses under which a phone reaches the server."""
    if host not in ("0.0.0.0", "::"):
        return [f"http://{f'[{host}]' if ':' in host else host}:{port}"]
    return [f"http://{own}:{port}" for own in own_addresses()]


def own_addresses() -> list[str]:
    """The IPv4 addresses of this machine, that of the route to outside first; nothing is sent."""
    found = dict[str, None]()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
        probe.connect(("192.0.2.1", 9))  # an address for documentation: UDP connects without a packet
        found[probe.getsockname()[0]] = None
    with contextlib.suppress(OSError):
        found |= {str(info[4][0]): None for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    return [own for own in found if not own.startswith("127.")] or ["127.0.0.1"]
