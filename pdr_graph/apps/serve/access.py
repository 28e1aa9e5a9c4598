"""Who may post and see: tokens in a file that only its owner can read, and requests from pages of other sites.

The owner sees all walkers; each further user has a token and sees the own ones. On this machine alone, without a token,
every request is the owner's.
"""

from __future__ import annotations

import base64
import hmac
import json
import secrets
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from urllib.parse import urlsplit

from pdr_graph.apps.lifelog.cache import write
from pdr_graph.errors import InputError

OWNER = "owner"
LOCAL_HOSTS = ("127.0.0.1", "localhost", "::1")
SHORTEST_TOKEN = 16  # characters of a token by hand: those made here have 32 and 192 bits


class Access:
    """Tokens by user; without any, every request is the owner's."""

    def __init__(self, tokens: Mapping[str, str]):
        self.tokens = dict(tokens)

    def user_of(self, token: str | None) -> str | None:
        """The user with that token; None if there is none."""
        if not self.tokens:
            return OWNER
        users = [user for user, own in self.tokens.items() if hmac.compare_digest(own.encode(), (token or "").encode())]
        return users[0] if users else None

    @staticmethod
    def sees(viewer: str, user: str) -> bool:
        """True if a viewer may see and delete the walkers of a user."""
        return viewer in (OWNER, user)


def token_of(headers: Mapping[str, str], query: Mapping[str, str], cookies: Mapping[str, str]) -> str | None:
    """The token of a request: ``?token=``, Authorization (Bearer, or the password of Basic), or the page's cookie.

    cookies: of a request that may be a page's; of one that stores, only if `is_own`: a page of another port has the
    cookie too.
    """
    if "token" in query:
        return query["token"]
    scheme, _, value = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return value.strip()
    if scheme.lower() == "basic":
        try:
            return base64.b64decode(value, validate=True).decode().partition(":")[2]
        except ValueError:
            return None
    return cookies.get(cookie_name(headers))


def cookie_name(headers: Mapping[str, str]) -> str:
    """The name of the page's cookie, by the port of the request: browsers send a cookie to all ports of a host."""
    host, _, port = headers.get("host", "").rpartition(":")
    return f"pdr_graph_token_{port}" if host and port.isdecimal() else "pdr_graph_token"


def is_foreign(headers: Mapping[str, str]) -> bool:
    """True for a request that a page of another site or port makes in the user's browser, unless it opens a page."""
    origin = headers.get("origin")
    if origin is not None and origin.partition("://")[2] != headers.get("host", ""):
        return True
    foreign = headers.get("sec-fetch-site") in ("cross-site", "same-site")
    return foreign and headers.get("sec-fetch-mode") != "navigate"


def is_browser(headers: Mapping[str, str]) -> bool:
    """True for a request of a browser that is not surely of this server's own page: nothing of it is stored.

    An image, a frame, a form or a link on any page can make a browser ask for an address; the apps on phones send none
    of these headers.
    """
    if headers.get("sec-fetch-site") == "same-origin":
        return False
    if origin := headers.get("origin"):
        return origin.partition("://")[2] != headers.get("host", "")
    signs = ("sec-fetch-site", "sec-fetch-mode", "sec-fetch-dest", "sec-purpose", "purpose", "referer")
    accepted = headers.get("accept", "")
    shows = "text/html" in accepted or "image/" in accepted
    return shows or headers.get("user-agent", "").startswith("Mozilla/") or any(name in headers for name in signs)


def is_own(headers: Mapping[str, str]) -> bool:
    """True for a request that a page of this very server makes, which no page of another site or port can claim."""
    host = headers.get("host", "")
    return bool(host) and headers.get("origin") in (f"http://{host}", f"https://{host}")


def is_local(headers: Mapping[str, str]) -> bool:
    """True for a request that names this machine by an own name and came through no proxy.

    Others are refused where there are no tokens: behind a proxy every user would be the owner, and the page of another
    site can make its own name point here.
    """
    if any(name in headers for name in ("forwarded", "x-forwarded-for", "x-real-ip", "via")):
        return False
    try:
        return urlsplit(f"//{headers.get('host', '')}").hostname in LOCAL_HOSTS
    except ValueError:
        return False


def load_tokens(file: Path, users: Sequence[str], token: str | None) -> dict[str, str]:
    """The tokens of the owner and of ``users``, read from a file; new ones are created and stored in it.

    token: of the owner, instead of a created one. Raises InputError if the file is no list of tokens, or others than
    its owner can read it; OSError of the disk.
    """
    tokens = _read(file) if file.exists() else {}
    if token is not None and len(token) < SHORTEST_TOKEN:
        raise InputError("--token", "", f"{len(token)} characters", f"{SHORTEST_TOKEN} or more, or none to create one")
    wanted = {**tokens, **({OWNER: token} if token is not None else {})}
    for user in (OWNER, *users):
        if not (user.strip() and user.isprintable() and len(user) <= 64):
            raise InputError("--user", "", repr(user), "a name of up to 64 printable characters")
        wanted.setdefault(user, secrets.token_urlsafe(24))  # bytes
    if wanted != tokens:
        write(file, json.dumps(wanted, indent=1).encode())
    return wanted


def _read(file: Path) -> dict[str, str]:
    mode = file.stat().st_mode & 0o777
    if mode & 0o077:
        raise InputError(file, "", f"mode {mode:o}: others can read it", f"600: chmod 600 {file}")
    try:
        tokens = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(file, "", str(error), "a JSON object of users and tokens") from None
    if not isinstance(tokens, dict) or not all(isinstance(text, str) and text for text in tokens.values()):
        raise InputError(file, "", "another content", "a JSON object of users and tokens")
    return tokens


class Allowance:
    """What may be used on average ``rate`` a second; unused, it adds up to ``burst`` seconds of it."""

    def __init__(self, rate: float, burst: float):
        self._rate, self._most = rate, rate * burst
        self._left, self._at = self._most, time.monotonic()

    def use(self, amount: float) -> float:
        """Use an amount if it is there, and return 0; else the time until it is [s]."""
        now = time.monotonic()
        self._left = min(self._most, self._left + (now - self._at) * self._rate)
        self._at = now
        if amount > self._left:
            return (amount - self._left) / self._rate
        self._left -= amount
        return 0.0
