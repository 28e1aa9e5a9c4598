"""The page: its file, its content security policy, its settings. All that it loads comes from this server.

The one exception is a tile server of the user's own choice, ``--tiles``.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response

from pdr_graph.apps.serve.access import COOKIE
from pdr_graph.errors import InputError

WEB = Path(__file__).parent / "web"
HOST = re.compile(r"[A-Za-z0-9.:\[\]-]+")  # of a tile server: nothing that could end a directive of the policy


def checked_tiles(url: str | None) -> str | None:
    """The address of a tile server, ``https://host/{z}/{x}/{y}.png``; None without one. Raises InputError."""
    if url is None:
        return None
    parts = urlsplit(url)
    places = all(place in url for place in ("{z}", "{x}", "{y}"))
    if parts.scheme not in ("http", "https") or not HOST.fullmatch(parts.netloc) or not places:
        raise InputError("--tiles", "", repr(url), "an address such as https://host/{z}/{x}/{y}.png")
    return url


def security_headers(tiles: str | None) -> dict[str, str]:
    """Headers of the page: scripts, styles and connections of this server alone; images of the tile server too."""
    elsewhere = " {0.scheme}://{0.netloc}".format(urlsplit(tiles)) if tiles else ""
    policy = [
        *("default-src 'none'", "script-src 'self'", "style-src 'self'", "worker-src 'self'"),
        f"img-src 'self' data: blob:{elsewhere}",
        f"connect-src 'self'{elsewhere}",
        *("base-uri 'none'", "form-action 'none'", "frame-ancestors 'none'"),
    ]
    return {
        "Content-Security-Policy": "; ".join(policy),
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-cache",
    }


async def page(request: Request) -> Response:
    """The page. A token in its address moves to a cookie, so that it stays in no history and no link."""
    if "token" in request.query_params:
        response: Response = RedirectResponse("./", 303)  # relative: a proxy may have put a path before it
        token, secure = request.query_params["token"], request.url.scheme == "https"
        # cookie life [s]: four months
        response.set_cookie(COOKIE, token, httponly=True, samesite="strict", secure=secure, max_age=10**7)
        return response
    index = WEB / "index.html"
    if not index.exists():
        return PlainTextResponse("the page is missing in this installation; see /walkers and /events\n")
    headers = security_headers(request.app.state.server.tiles)
    return Response(index.read_bytes(), media_type="text/html", headers=headers)


def settings(tiles: str | None, guarded: bool) -> dict[str, Any]:
    """What the page asks first. guarded: phones need a token."""
    host = urlsplit(tiles).hostname if tiles else None
    return {"tiles": {"url": tiles, "attribution": f"tiles: {host}"} if tiles else None, "guarded": guarded}
