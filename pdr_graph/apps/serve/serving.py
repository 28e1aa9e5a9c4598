"""The server as a whole: sessions, estimating processes, routes and uvicorn."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import multiprocessing
import os
import socket
import ssl
import sys
import threading
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h11
import uvicorn
from starlette.applications import Starlette
from uvicorn.protocols.http.h11_impl import H11Protocol

from pdr_graph.apps.replay import navigator_of
from pdr_graph.apps.serve.access import Access
from pdr_graph.apps.serve.application import Server, application
from pdr_graph.apps.serve.estimators import STOPPING, Estimators, end_all
from pdr_graph.apps.serve.home_assistant import NO_SENSORS, alert, announce, phone_of, watch
from pdr_graph.apps.serve.live_walk import NOT_RECORDED, finish
from pdr_graph.apps.serve.publishing import Hub, plan_layers
from pdr_graph.apps.serve.pulling import Sources, running
from pdr_graph.apps.serve.receivers import listen
from pdr_graph.apps.serve.reception import Limits, Reception
from pdr_graph.errors import InputError, Interrupted, one_line
from pdr_graph.floor.building import Building
from pdr_graph.options import LIVE, Options
from pdr_graph.types import Beacons

SESSIONS, TOKENS = "sessions", "tokens.json"


@dataclass(frozen=True)
class Settings:
    """Options of the server.

    folder: of sessions and tokens; options: of the estimates; store: lifelog of finished sessions;
    workers: estimating processes, 0 for a thread; tokens: by user, none if every request is the owner's; tiles: address
    of a tile server for the page; sources: what the server fetches by itself.
    """

    folder: Path
    options: Options = field(default_factory=Options)
    store: Path | None = None
    workers: int = 1
    tokens: Mapping[str, str] = field(default_factory=dict)
    tiles: str | None = None
    limits: Limits = field(default_factory=Limits)
    sources: Sources = field(default_factory=Sources)


def read_inputs(options: Options) -> tuple[Building | None, Beacons | None]:
    """The plan and the beacons of live estimates. Raises InputError if a file of the options cannot be used."""
    known = navigator_of(replace(options, method=LIVE)).keywords
    return known["floor"], known["beacons"]


def build(settings: Settings, building: Building | None = None) -> Starlette:
    """The application, whose lifespan starts and stops everything. building: of `read_inputs`."""
    hub, recorder = Hub(), Recorder(settings.store, settings.options.plan)
    reception = Reception(settings.folder / SESSIONS, hub, settings.limits, recorder.record, say)
    estimators = Estimators(settings.workers, reception.root, settings.options, reception.update, reception.started)
    reception.estimators = estimators

    def known() -> set[str]:
        return {phone_of(session.user, session.name) for session in reception.sessions()}

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        reception.load()
        await estimators.start()
        try:
            home, receivers = settings.sources.home, settings.sources.receivers
            motion, alerts = settings.sources.motion or NO_SENSORS, settings.sources.alerts
            more = [] if home is None else [announce(home, hub, building, known, say, motion)]
            more += [watch(home, motion, say)] if home is not None and motion.rooms else []
            more += [alert(alerts, hub, building, say)] if alerts else []
            more += [] if receivers is None else [listen(receivers, reception, say)]
            async with running(settings.sources, reception, say, more):
                try:
                    yield
                finally:
                    hub.close()  # before the tasks are cancelled, which aiomqtt may swallow in Python 3.11
        finally:
            await estimators.stop()
            reception.close()
            await recorder.close()

    access, study = Access(settings.tokens), settings.sources.study
    plan = plan_layers(building)
    return application(Server(hub, access, plan, settings.tiles, reception, study), lifespan)


class Recorder:
    """Makes the recordings of finished walks in one process, one after the other; another after TASKS, or if it ended.

    Its executor's own ``max_tasks_per_child`` stops for ever where tasks wait (cpython issue 115634, 3.11 to 3.13).
    """

    TASKS = 20  # recordings of a process, whose memory grows

    def __init__(self, store: Path | None, plan: Path | None):
        self._arguments = store, plan
        self._turn, self._tasks, self._closed = asyncio.Lock(), 0, False
        self._pool: ProcessPoolExecutor | None = None

    async def record(self, folder: Path) -> str:
        """Make the recording of a walk's folder; returns an issue, or ""."""
        async with self._turn:
            if self._tasks == self.TASKS:
                await self._end()
            if self._closed:
                return NOT_RECORDED
            if self._pool is None:
                self._pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))
            self._tasks += 1
            try:
                return await asyncio.get_running_loop().run_in_executor(self._pool, finish, folder, *self._arguments)
            except (RuntimeError, OSError) as error:  # its process was killed, or is ended with the server
                await self._end()
                return f"{NOT_RECORDED}: {error}"

    async def _end(self) -> None:
        pool, self._pool, self._tasks = self._pool, None, 0
        if pool is not None:
            processes = list((pool._processes or {}).values())  # else the interpreter's end waits for them
            pool.shutdown(wait=False, cancel_futures=True)
            await end_all(processes, STOPPING, force=True)

    async def close(self) -> None:
        """End its process; no other is begun."""
        self._closed = True
        await self._end()


def say(text: str) -> None:
    """Print a line about a source."""
    print(text, file=sys.stderr, flush=True)


MOST_CONNECTIONS = 1000
HEAD_TIME, BODY_TIME = 20.0, 40.0  # [s] for all of a head and of a body to arrive; phones' bodies have less


class Protocol(H11Protocol):
    """HTTP whose connections end if a head or a body does not arrive in time, however it drips; uvicorn's own wait.

    Where MOST_CONNECTIONS are near, a new one ends the one that has longest had no request to be answered.
    """

    _end: asyncio.TimerHandle | None = None  # of the head or body that is arriving
    _of_body = False
    _idle_since = 0.0  # [s] of the loop

    def connection_made(self, transport: Any) -> None:
        """Begin to wait for the first request."""
        super().connection_made(transport)
        self._idle_since = self.loop.time()
        self._end = self.loop.call_later(HEAD_TIME, self._close)
        if len(self.connections) > 0.9 * MOST_CONNECTIONS:
            others = (each for each in self.connections if isinstance(each, Protocol) and each is not self)
            idle = min(filter(Protocol.is_idle, others), key=lambda each: each._idle_since, default=None)
            if idle is not None:
                idle._close()

    def is_idle(self) -> bool:
        """True while it is open and no request is answered."""
        return not self.transport.is_closing() and (self.cycle is None or self.cycle.response_complete)

    def data_received(self, data: bytes) -> None:
        """Take what arrived."""
        super().data_received(data)
        self._watch()

    def on_response_complete(self) -> None:
        """Wait for the next request, or for the rest of a body that nobody read."""
        self._idle_since = self.loop.time()
        super().on_response_complete()
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        """End the timer."""
        self._stop_timer()
        super().connection_lost(exc)

    def _watch(self) -> None:
        """Start the time of a head or a body that is arriving; it ends when that is complete."""
        body, begun = self.conn.their_state is h11.SEND_BODY, bool(self.conn.trailing_data[0])
        if self not in self.connections or not (body or (begun and self.conn.their_state is h11.IDLE)):
            self._stop_timer()
        elif self._end is None or body != self._of_body:
            self._stop_timer()
            self._end = self.loop.call_later(BODY_TIME if body else HEAD_TIME, self._close)
            self._of_body = body

    def _stop_timer(self) -> None:
        if self._end is not None:
            self._end.cancel()
            self._end = None

    def _close(self) -> None:
        self._stop_timer()
        if self in self.connections and not self.transport.is_closing():  # else it is a WebSocket's
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


def check_certificate(file: Path) -> None:
    """Raise InputError if a file has no PEM certificate with its private key, without a password."""
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(file, password=lambda: "")
    except (OSError, ValueError) as error:  # SSLError is an OSError
        text = error.strerror if isinstance(error, FileNotFoundError) else one_line(str(error))
        expected = "a PEM file with a certificate and its private key, without a password"
        raise InputError("--certificate", str(file), text or "no certificate", expected) from None


def serve(
    app: Starlette,
    host: str,
    port: int,
    ready: Callable[[int], None] = lambda port: None,
    certificate: Path | None = None,
) -> None:
    """Serve until Ctrl-C or SIGTERM, by which the process ends too.

    ready: called with the port when it accepts connections; port 0: any free one; certificate: as for
    `check_certificate`, for HTTPS, None for HTTP. Raises InputError if the address cannot be used.
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
        limit_concurrency=MOST_CONNECTIONS,
        timeout_keep_alive=75,  # [s]: a phone that posts every minute keeps its connection
        timeout_graceful_shutdown=3,
        server_header=False,
        ws_max_size=1 << 16,
        ssl_certfile=certificate,
    )
    logging.getLogger("uvicorn.error").addFilter(is_news)
    hub = getattr(getattr(app.state, "server", None), "hub", None)
    server = Uvicorn(config, hub.close if isinstance(hub, Hub) else lambda: None)
    ready(listening.getsockname()[1])
    with contextlib.suppress(KeyboardInterrupt, Interrupted), listening:
        server.run(sockets=[listening])


def addresses(host: str, port: int, scheme: str = "http") -> list[str]:
    """The addresses under which a phone reaches the server."""
    if host not in ("0.0.0.0", "::"):
        return [f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}"]
    return [f"{scheme}://{own}:{port}" for own in own_addresses()]


def own_addresses() -> list[str]:
    """The IPv4 addresses of this machine, that of the route to outside first; nothing is sent."""
    found = dict[str, None]()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
        probe.connect(("192.0.2.1", 9))  # an address for documentation: UDP connects without a packet
        found[probe.getsockname()[0]] = None
    with contextlib.suppress(OSError):
        found |= {str(info[4][0]): None for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    return [own for own in found if not own.startswith("127.")] or ["127.0.0.1"]
