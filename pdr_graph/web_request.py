"""HTTP requests to servers that are not trusted: each ends in time, and reads no more than it is allowed to.

Timeouts of a socket limit the silence between two bytes, not the whole: a server that sends a byte now and then, or
headers without end, keeps a client for ever. So a request is a task of an event loop that is cancelled at a deadline,
whatever it waits for (a TLS handshake, a head, a chunk). Nothing is unpacked, and no redirect is followed unless the
caller agrees with its address.
"""

from __future__ import annotations

import asyncio
import socket
import ssl
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from ipaddress import ip_address
from typing import Any, BinaryIO, Literal

REDIRECTS, MOST_REDIRECTS = (301, 302, 303, 307, 308), 5


class TooLongError(OSError):
    """An answer with more bytes than it may have."""


@dataclass(frozen=True)
class Answer:
    """An answer of whatever status. location: to which it redirects, "" without one."""

    status: int
    body: bytes
    location: str


def ask(*arguments: Any, **options: Any) -> Answer:
    """The answer of `request`, outside of an event loop."""
    return asyncio.run(request(*arguments, **options))


async def request(
    address: str,
    silence: float,
    whole: float,
    most: int,
    follow: Literal["", "same host", "public"] = "",
    *,
    method: str = "GET",
    body: bytes | None = None,
    headers: Mapping[str, str] | None = None,
    proxies: bool = True,
    out: BinaryIO | None = None,
) -> Answer:
    """Send a request and return the answer.

    silence: longest time without a byte, whole: until the end of the body [s]; most: bytes of the body; follow: where
    redirects of a GET to another http or https address are followed; another host gets no Authorization, and "public"
    leads to none in a private network, unless the first is in one; proxies: use those of the environment; out: takes
    the body instead of the answer.
    Raises OSError, of them TimeoutError after `whole` and TooLongError for a longer body.
    """
    import httpx

    options = {"timeout": silence, "trust_env": proxies, "verify": _certificates(), "http2": False}
    fixed = {"Accept-Encoding": "identity", "Connection": "close"}
    try:
        async with asyncio.timeout(whole), httpx.AsyncClient(**options, headers=fixed) as client:
            sent = client.build_request(method, address, content=body, headers=headers)
            for _ in range(MOST_REDIRECTS):
                answer = await client.send(sent, stream=True)
                next_ = answer.next_request if body is None else None
                allowed = follow and next_ and next_.url.host == sent.url.host
                if follow == "public" and next_ and not allowed:
                    allowed = await _is_public(next_.url.host) or not await _is_public(sent.url.host)
                if next_ is None or next_.url.scheme not in ("http", "https") or not allowed:
                    content, size = out or BytesIO(), 0
                    async for piece in answer.aiter_raw():
                        size += len(piece)
                        if size > most:
                            raise TooLongError(f"an answer of more than {most} bytes")
                        content.write(piece)
                    whole_body = content.getvalue() if isinstance(content, BytesIO) else b""
                    return Answer(answer.status_code, whole_body, answer.headers.get("Location", ""))
                await answer.aclose()
                sent = next_
        raise OSError(f"more than {MOST_REDIRECTS} redirects")
    except TimeoutError:
        raise TimeoutError(f"no complete answer within {whole:.0f} s") from None
    except (httpx.HTTPError, httpx.InvalidURL, ValueError) as error:  # the last of names that no host has
        text, cause = str(error), error.__context__
        while cause is not None:  # httpx itself says no more than that all attempts failed
            text = str(cause) if isinstance(cause, OSError) else text
            cause = cause.__cause__ or cause.__context__
        raise OSError(text or type(error).__name__) from None


async def _is_public(host: str) -> bool:
    """True if no address of a host is of this machine or of a private network. Raises OSError if it has none."""
    found = await asyncio.get_running_loop().getaddrinfo(host, None, type=socket.SOCK_STREAM)
    addresses = [ip_address(str(each[4][0]).partition("%")[0]) for each in found]
    return all((getattr(address, "ipv4_mapped", None) or address).is_global for address in addresses)


@cache
def _certificates() -> ssl.SSLContext:
    """The certificates that the system trusts; loading them takes a while."""
    return ssl.create_default_context()
