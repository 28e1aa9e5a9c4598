"""HTTP requests to servers that are not trusted: each ends in time, and reads no more than it is allowed to.

Timeouts of a socket limit the silence between two bytes, not the whole: a server that sends a byte now and then, or
headers without end, keeps a client for ever. So a request is a task of an event loop that is cancelled at a deadline,
whatever it waits for (a TLS handshake, a head, a chunk). Nothing is unpacked, and no redirect is followed unless the
caller agrees with its address.
"""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from typing import Any, BinaryIO
from urllib.parse import urlsplit

REDIRECTS, MOST_REDIRECTS = (301, 302, 303, 307, 308), 5
Follow = Callable[[str], bool]  # whether to follow a redirect to an address


class TooLongError(OSError):
    """An answer with more bytes than it may have."""


@dataclass(frozen=True)
class Answer:
    """An answer of whatever status. location: to which it redirects, "" without one."""

    status: int
    body: bytes
    location: str


def nowhere(address: str) -> bool:
    """Follow no redirect."""
    return False


def anywhere(address: str) -> bool:
    """Follow all redirects."""
    return True


def same_host(url: str) -> Follow:
    """Follow redirects to the host of an address only."""
    return lambda address: urlsplit(address).hostname == urlsplit(url).hostname


def ask(
    address: str,
    silence: float,
    whole: float,
    most: int,
    follow: Follow = nowhere,
    *,
    method: str = "GET",
    body: bytes | None = None,
    headers: Mapping[str, str] | None = None,
    proxies: bool = True,
    out: BinaryIO | None = None,
) -> Answer:
    """Send a request and return the answer.

    silence: longest time without a byte, whole: until the end of the body [s]; most: bytes of the body; follow: whether
    to follow a redirect of a GET to another http or https address, which gets no Authorization if its host differs;
    proxies: use those of the environment; out: takes the body instead of the answer.
    Raises OSError, of them TimeoutError after `whole` and TooLongError for a longer body.
    """
    import httpx

    async def answer() -> Answer:
        options = {"timeout": silence, "trust_env": proxies, "verify": _trusted(), "http2": False}
        fixed = {"Accept-Encoding": "identity", "Connection": "close"}
        async with asyncio.timeout(whole), httpx.AsyncClient(**options, headers=fixed) as client:
            request = client.build_request(method, address, content=body, headers=headers)
            for _ in range(MOST_REDIRECTS):
                answer = await client.send(request, stream=True)
                following = answer.next_request if body is None else None
                if following is None or following.url.scheme not in ("http", "https") or not follow(str(following.url)):
                    return await _read(answer, most, out)
                await answer.aclose()
                request = following
        raise OSError(f"more than {MOST_REDIRECTS} redirects")

    try:
        return asyncio.run(answer())
    except TimeoutError:
        raise TimeoutError(f"no complete answer within {whole:.0f} s") from None
    except (httpx.HTTPError, httpx.InvalidURL, ValueError) as error:  # the last of names that no host has
        text, cause = str(error), error.__context__
        while cause is not None:  # httpx itself says no more than that all attempts failed
            text = str(cause) if isinstance(cause, OSError) else text
            cause = cause.__cause__ or cause.__context__
        raise OSError(text or type(error).__name__) from None


async def _read(answer: Any, most: int, out: BinaryIO | None) -> Answer:
    """The answer with its body, which is written to `out` if there is one. Raises TooLongError."""
    content, size = out or BytesIO(), 0
    async for piece in answer.aiter_raw():
        size += len(piece)
        if size > most:
            raise TooLongError(f"an answer of more than {most} bytes")
        content.write(piece)
    body = content.getvalue() if isinstance(content, BytesIO) else b""
    return Answer(answer.status_code, body, answer.headers.get("Location", ""))


@cache
def _trusted() -> ssl.SSLContext:
    """The certificates that the system trusts; loading them takes a while."""
    return ssl.create_default_context()
