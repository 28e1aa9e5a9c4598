"""HTTP requests to servers that are not trusted: each ends in time, and reads no more than it is allowed to.

A timeout of a socket limits the silence between two bytes, not the whole: a server that sends a byte now and then, or
headers without end, keeps a client for ever. So a request has a deadline too, at which its connection is shut down,
whatever it is waiting for (a TLS handshake, a head, a chunk). Nothing is unpacked, and no redirect is followed unless
the caller agrees with its address.
"""

from __future__ import annotations

import http.client
import socket
import threading
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http.client import HTTPException, HTTPResponse, IncompleteRead
from io import BytesIO
from typing import Any
from urllib.parse import urljoin, urlsplit
from urllib.request import Request

REDIRECTS, MOST_REDIRECTS = (301, 302, 303, 307, 308), 5
FAULTS = (OSError, HTTPException)  # what a server can cause
Follow = Callable[[str], bool]  # whether to follow a redirect to an address


class TooLongError(OSError):
    """An answer with more bytes than it may have."""


def nowhere(address: str) -> bool:
    """Follow no redirect."""
    return False


def anywhere(address: str) -> bool:
    """Follow all redirects."""
    return True


def same_host(url: str) -> Follow:
    """Follow redirects to the host of an address only."""
    return lambda address: urlsplit(address).hostname == urlsplit(url).hostname


@contextmanager
def answer_to(
    request: Request, silence: float, whole: float, follow: Follow = nowhere, proxies: dict[str, str] | None = None
) -> Iterator[HTTPResponse]:
    """Send a request and yield the answer, of whatever status.

    silence: without a byte, whole: until the end of the context [s]; follow: whether to follow a redirect of a GET to
    another http or https address, which gets no Authorization if its host differs; proxies: by scheme, None: those of
    the environment. Raises OSError or HTTPException, of them TimeoutError after `whole`, also if the connection ended
    only then.
    """
    deadline = _Deadline(whole)
    try:
        with _followed(deadline, request, silence, follow, proxies) as answer:
            yield answer
    except FAULTS:
        if not deadline.passed:
            raise
    finally:
        deadline.cancel()
    if deadline.passed:
        raise TimeoutError(f"no complete answer within {whole:.0f} s")


def body_of(answer: HTTPResponse, most: int) -> bytes:
    """The whole body. Raises IncompleteRead if it was cut off, TooLongError if it has more than `most` bytes."""
    body = BytesIO()
    for piece in pieces_of(answer, most):
        body.write(piece)
    return body.getvalue()


def pieces_of(answer: HTTPResponse, most: int) -> Iterator[bytes]:
    """Yield the body in pieces; raises as `body_of`."""
    size = 0
    while piece := answer.read1(1 << 16):  # chunk: bytes
        size += len(piece)
        if size > most:
            raise TooLongError(f"an answer of more than {most} bytes")
        yield piece
    stated = answer.headers.get("Content-Length", "")
    if stated.isdecimal() and stated.isascii() and size < int(stated[:30]):
        raise IncompleteRead(b"", int(stated[:30]) - size)


def _followed(
    deadline: _Deadline, request: Request, silence: float, follow: Follow, proxies: dict[str, str] | None
) -> HTTPResponse:
    """The answer at the end of all redirects that are followed."""
    opener = urllib.request.OpenerDirector()  # without handlers of errors, redirects, files and FTP
    for handler in (urllib.request.ProxyHandler(proxies), _Http(deadline), _Https(deadline)):
        opener.add_handler(handler)
    opener.add_handler(urllib.request.UnknownHandler())
    for _ in range(MOST_REDIRECTS):
        try:
            answer: HTTPResponse = opener.open(request, timeout=silence)  # type: ignore[assignment]
        except ValueError as error:  # a host's name that cannot be one
            raise OSError(f"{error}") from None
        target = _target(request, answer)
        if answer.status not in REDIRECTS or request.data or not target or not follow(target):
            return answer
        answer.close()
        headers = dict(request.header_items())
        if urlsplit(target)[:2] != urlsplit(request.full_url)[:2]:
            headers.pop("Authorization", None)
        headers.pop("Host", None)
        request = Request(target, headers=headers)
    raise OSError(f"more than {MOST_REDIRECTS} redirects")


def _target(request: Request, answer: HTTPResponse) -> str:
    """The http or https address to which an answer redirects; empty without one."""
    try:
        target = urljoin(request.full_url, answer.headers.get("Location") or "")
        return target if urlsplit(target).scheme in ("http", "https") else ""
    except ValueError:
        return ""


class _Deadline:
    """Shuts down the connections of a request after some time [s]. passed: True from then on."""

    def __init__(self, seconds: float):
        self.passed = False
        self._lock, self._connections = threading.Lock(), list[socket.socket]()
        self._timer = threading.Timer(seconds, self._pass)
        self._timer.daemon = True
        self._timer.start()

    def watch(self, connection: socket.socket) -> None:
        """Shut this connection down at the deadline. A duplicate is kept, since TLS takes over the socket itself."""
        with self._lock:
            self._connections.append(connection.dup())
        if self.passed:
            self._pass()

    def cancel(self) -> None:
        """Forget all connections."""
        self._timer.cancel()
        with self._lock:
            while self._connections:
                self._connections.pop().close()

    def _pass(self) -> None:
        self.passed = True
        with self._lock:
            for connection in self._connections:
                with suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)


class _Connection(http.client.HTTPConnection):
    """A connection that is watched from before its TLS handshake on."""

    deadline: _Deadline

    def connect(self) -> None:
        super().connect()
        self.deadline.watch(self.sock)


class _TlsConnection(http.client.HTTPSConnection, _Connection):
    """The same with TLS: its ``connect`` calls the other one before the handshake."""


def _watched(kind: type[_Connection], deadline: _Deadline) -> Any:
    """A function that makes connections of a kind."""

    def connection(*arguments: Any, **options: Any) -> _Connection:
        made = kind(*arguments, **options)
        made.deadline = deadline
        return made

    return connection


class _Http(urllib.request.HTTPHandler):
    """Opens http addresses."""

    def __init__(self, deadline: _Deadline):
        super().__init__()
        self._connection = _watched(_Connection, deadline)

    def http_open(self, req: Request) -> HTTPResponse:
        return self.do_open(self._connection, req)


class _Https(urllib.request.HTTPSHandler):
    """Opens https addresses."""

    def __init__(self, deadline: _Deadline):
        super().__init__()
        self._connection = _watched(_TlsConnection, deadline)

    def https_open(self, req: Request) -> HTTPResponse:
        return self.do_open(self._connection, req)
