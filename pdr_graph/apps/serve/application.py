"""The routes of the server: what apps post, what programs and the page read, and their description.

All that the page loads comes from this server, but for the tiles of a server of the user's choice, ``--tiles``.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import html
import re
import zlib
from collections import Counter
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

import msgspec
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import (
    FileResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
)
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

import pdr_graph
from pdr_graph.apps.serve import publishing
from pdr_graph.apps.serve.access import (
    Access,
    Allowance,
    cookie_name,
    is_browser,
    is_foreign,
    is_local,
    is_own,
    token_of,
)
from pdr_graph.apps.serve.publishing import Hub, Published, plan_layers
from pdr_graph.apps.serve.reception import Reception
from pdr_graph.apps.serve.sensor_messages import OWNTRACKS, SENSOR_LOGGER
from pdr_graph.apps.serve.study import StudyReports, upload_of
from pdr_graph.errors import InputError

WEB, OPENAPI = Path(__file__).parent / "web", Path(__file__).parent / "openapi.json"
HEARTBEAT = 15.0  # [s] after which a silent stream sends a comment, by which proxies and the page know that it lives
ARRIVING = 4  # unfinished messages of a user, of the largest size, that are kept in memory at once
REQUESTS = 500.0, 10.0  # of a user: a second on average, and seconds of it at once
SLOWEST_BODY = 30.0  # [s] for a message to arrive completely
SLOWEST_READER = 30.0  # [s] for an event to be taken
SHOW_TO_USER = 499  # status by which Sensor Logger shows the text of the answer
TOKEN = "a token: ?token=… as in the address that pdr-graph serve printed, or Authorization: Bearer …"
ENCODE = msgspec.json.encode  # NaN becomes null
STORING = frozenset({"/sensorlogger", "/owntracks", "/overland", "/osmand", "/study"})  # what phones post to
HOST = re.compile(r"[A-Za-z0-9.:\[\]-]+")  # of a tile server: nothing that could end a directive of the policy


@dataclass
class Server:
    """What the routes share.

    hub: the published walkers; access: who may see them; plan: of `plan_layers`, None without; tiles: address of a tile
    server; reception: the sessions, None for tests of the page; study: reports for studies, None without; arriving:
    bytes of the messages of each user that have not arrived completely.
    """

    hub: Hub
    access: Access
    plan: dict[str, Any] | None = None
    tiles: str | None = None
    reception: Reception | None = None
    study: StudyReports | None = None
    arriving: Counter[str] = field(default_factory=Counter)


def application(server: Server, lifespan: Any = None) -> Starlette:
    """The ASGI application. lifespan: starts and stops what the routes use."""
    routes = [
        Route("/", page),
        Route("/app", app_page),
        Route("/settings", page_settings),
        Route("/walkers", walkers),
        Route("/walkers/{id}.geojson", geojson),
        Route("/walkers/{id}.navsatfix", navsatfix),
        Route("/walkers/{id}/recording", recording),
        Route("/walkers/{id}/finish", finish, methods=["POST"]),
        Route("/walkers/{id}", forget, methods=["DELETE"]),
        Route("/walkers/{id}", walker),
        Route("/sensorlogger", sensorlogger, methods=["POST"]),
        Route("/owntracks", owntracks, methods=["POST"]),
        Route("/overland", overland, methods=["POST"]),
        Route("/osmand", osmand, methods=["GET", "POST"]),
        Route("/study", study, methods=["POST"]),
        Route("/events", events),
        WebSocketRoute("/socket", socket),
        Route("/plan", plan),
        Route("/openapi.json", description),
        Route("/api", description_for_people),
        Mount("/web", StaticFiles(directory=WEB, check_dir=False)),
    ]
    handlers = {HTTPException: refusal, InputError: refusal}
    app = Starlette(False, routes, [Middleware(Guard, server.access)], handlers, lifespan=lifespan)
    app.state.server = server
    return app


class Guard:
    """Refuses requests without a valid token, of other sites' pages and of a user's flood, before any body is read."""

    def __init__(self, app: ASGIApp, access: Access):
        self.app, self.access = app, access
        self._allowances = dict[str, Allowance]()  # of users [requests]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Set the user of a request, or answer with 401, 403 or 429."""
        if scope["type"] not in ("http", "websocket"):
            return await self.app(scope, receive, send)
        connection = HTTPConnection(scope)
        access, headers, stores = self.access, connection.headers, scope["path"] in STORING
        cookies = {} if stores and not is_own(headers) else connection.cookies
        user = access.user_of(token_of(headers, connection.query_params, cookies))
        if user is None:
            status, text = 401, f"found no valid token, expected {TOKEN}"
        elif is_foreign(headers):
            status, text = 403, "found a request of another site's page"
        elif stores and is_browser(headers):
            status, text = 403, "found a request of a browser, expected one of an app or a program"
        elif not (access.tokens or is_local(headers)):
            status, text = 403, "found a proxy or another host's name and no token, expected pdr-graph serve --token"
        elif self._allowances.setdefault(user, Allowance(*REQUESTS)).use(1):
            status, text = 429, f"found more than {REQUESTS[0]:.0f} requests a second of a user, expected fewer"
        else:
            scope["user"] = user

            async def answer(message: Message) -> None:
                """Send, with the header by which a browser shows nothing of it in pages of other sites and ports."""
                if message["type"] == "http.response.start":
                    headers = [*message.get("headers", ()), (b"cross-origin-resource-policy", b"same-origin")]
                    message = {**message, "headers": headers}
                await send(message)

            return await self.app(scope, receive, answer)
        if scope["type"] == "websocket":
            return await WebSocket(scope, receive, send).close(4000 + status)
        header = {401: {"WWW-Authenticate": 'Basic realm="pdr-graph"'}, 429: {"Retry-After": "1"}}.get(status)
        await PlainTextResponse(f"{text}\n", status, header)(scope, receive, send)


def refusal(_: Request, error: Exception) -> Response:
    """A fault as one line of text; a malformed message has status 400."""
    if not isinstance(error, HTTPException):
        error = HTTPException(400, str(error))
    return PlainTextResponse(f"{error.detail}\n", error.status_code, error.headers)


def _server(connection: HTTPConnection) -> Server:
    return connection.app.state.server


def _walker(request: Request) -> Published:
    """The walker of the address. Raises HTTPException 404, also for those of other users."""
    walker = _server(request).hub.walkers.get(request.path_params["id"])
    if walker is None or not Access.sees(request.scope["user"], walker.user):
        raise HTTPException(404, f"found no walker {request.path_params['id'][:64]!r}, expected one of GET /walkers")
    return walker


def _json(value: Any, media_type: str = "application/json") -> Response:
    return Response(ENCODE(value), media_type=media_type, headers={"Cache-Control": "no-store"})


# ── what phones post ────────────────────────────────────────────────────────────────────────────────────────────────


async def _body(request: Request) -> bytes:
    """The body of a request. Raises HTTPException 413 if it is too large, 408 if it takes too long, 400 if it ends."""
    most, body, arriving = _reception(request).limits.body, bytearray(), _server(request).arriving
    closing, user = {"Connection": "close"}, request.scope["user"]
    too_large = HTTPException(413, f"found more than {most >> 20} MB, expected smaller messages", closing)
    try:
        async with asyncio.timeout(SLOWEST_BODY):
            async for part in request.stream():
                body += part
                arriving[user] += len(part)
                if len(body) > most:
                    raise too_large
                if arriving[user] > ARRIVING * most:
                    text = f"found {arriving[user] >> 20} MB of unfinished messages, expected fewer at once"
                    raise HTTPException(429, text, {**closing, "Retry-After": f"{SLOWEST_BODY:.0f}"})
    except TimeoutError:
        raise HTTPException(408, f"found no end of the message in {SLOWEST_BODY:.0f} s", closing) from None
    except ClientDisconnect:
        raise HTTPException(400, "found a connection that ended within the message") from None
    finally:
        arriving[user] -= len(body)
    encoding = request.headers.get("content-encoding", "identity")
    if encoding not in ("gzip", "identity"):
        raise HTTPException(415, f"found the encoding {encoding[:40]!r}, expected gzip or none")
    if encoding == "identity":
        return bytes(body)
    unpacking = zlib.decompressobj(wbits=16 + zlib.MAX_WBITS)
    try:
        unpacked = unpacking.decompress(body, most)
    except zlib.error as error:
        raise HTTPException(400, f"found a damaged gzip body ({error})") from None
    if unpacking.unconsumed_tail:
        raise too_large
    return unpacked


def _reception(request: Request) -> Reception:
    reception = _server(request).reception
    assert reception is not None
    return reception


async def _receive(request: Request, protocol: str, name: str = "") -> str:
    """Log the message of a request; returns what its user should know, or "". Raises HTTPException, InputError."""
    query = request.query_params
    stated = urlencode([(name, value) for name, value in query.multi_items() if name != "token"])  # for any method
    body = await _body(request) or (stated.encode() if protocol == "osmand" else b"")
    user, platform = request.scope["user"], query.get("platform", "").lower()
    return _reception(request).receive(protocol, user, body, platform, query.get("name", "") or name)


async def sensorlogger(request: Request) -> Response:
    """A message of Sensor Logger: 200, or once 499 with a text that the app shows; the message is stored then too."""
    advice = await _receive(request, SENSOR_LOGGER)
    return PlainTextResponse(advice, SHOW_TO_USER) if advice else Response()


async def owntracks(request: Request) -> Response:
    """A message of OwnTracks; answered by an empty list of commands."""
    user, device = (request.headers.get(f"x-limit-{letter}", "") for letter in "ud")
    await _receive(request, OWNTRACKS, device or user)
    return JSONResponse([])


async def overland(request: Request) -> Response:
    """A batch of Overland; any answer but this one and it comes again."""
    await _receive(request, "overland")
    return JSONResponse({"result": "ok"})


async def osmand(request: Request) -> Response:
    """A position of Traccar Client, OsmAnd or GPSLogger."""
    await _receive(request, "osmand")
    return Response()


async def study(request: Request) -> Response:
    """A call of Sensor Logger's cloud: an upload to a study; 404 unless studies are configured."""
    reports = _server(request).study
    if reports is None:
        raise HTTPException(404, "found no study, expected pdr-graph serve --study STUDY")
    upload = upload_of(await _body(request))
    try:
        reports.accept(upload)
    except OSError as error:
        raise HTTPException(507, error.strerror or str(error), {"Retry-After": "60"}) from None
    return Response()


# ── what programs read, and do with a walker ────────────────────────────────────────────────────────────────────────


async def walkers(request: Request) -> Response:
    """The last pose of each walker that the user may see."""
    shown = _server(request).hub.walkers.values()
    return _json([each.pose for each in shown if Access.sees(request.scope["user"], each.user)])


async def walker(request: Request) -> Response:
    """The last pose of a walker."""
    return _json(_walker(request).pose)


async def geojson(request: Request) -> Response:
    """The path of a walker, finalised and current part, and its pose."""
    walker = _walker(request)
    content = publishing.walk_geojson(walker.pose, walker.path()["finalised"], walker.current)
    return _json(content, "application/geo+json")


async def navsatfix(request: Request) -> Response:
    """The pose of a walker in the shape of sensor_msgs/NavSatFix."""
    return _json(publishing.nav_sat_fix(_walker(request).pose))


async def recording(request: Request) -> Response:
    """The recording of a finished walk, for pdr-graph smooth; 409 before it is finished."""
    id_ = _walker(request).pose["id"]
    file = _reception(request).recording(id_)
    if file is None:
        raise HTTPException(409, "found no recording yet, expected a walk that was finished: POST /walkers/ID/finish")
    return FileResponse(file, filename=f"{id_}{file.suffix}")


async def finish(request: Request) -> Response:
    """End a walk; its recording is made. The next message of its phone would resume it."""
    _reception(request).finish(_walker(request).pose["id"])
    return Response(status_code=202)


async def forget(request: Request) -> Response:
    """Delete a walk with all its files. What the lifelog has of it stays there."""
    _reception(request).forget(_walker(request).pose["id"])
    return Response(status_code=204)


async def plan(request: Request) -> Response:
    """The floor plan as GeoJSON; without one, an empty collection."""
    return Response(ENCODE(_server(request).plan or plan_layers(None)), media_type="application/geo+json")


def document() -> dict[str, Any]:
    """The routes as an OpenAPI 3.1 document."""
    content: dict[str, Any] = msgspec.json.decode(OPENAPI.read_bytes())
    content["info"] |= {"version": pdr_graph.__version__, "description": publishing.__doc__}
    return content


async def description(_: Request) -> Response:
    """The routes as an OpenAPI document."""
    return _json(document())


async def description_for_people(_: Request) -> Response:
    """The OpenAPI document as a page without scripts."""
    content, rows = document(), ""
    shared = {f"#/components/responses/{name}": each for name, each in content["components"]["responses"].items()}
    for path, operations in content["paths"].items():
        for method, operation in operations.items():
            answers = {status: shared.get(each.get("$ref"), each) for status, each in operation["responses"].items()}
            listed = "".join(
                f"<li>{status}: {html.escape(each['description'])}</li>" for status, each in answers.items()
            )
            rows += f"<h2><code>{method.upper()} {html.escape(path)}</code></h2><ul>{listed}</ul>"
    style = "body{font:16px/1.5 system-ui;max-width:50rem;margin:2rem auto;padding:0 1rem;color-scheme:light dark}"
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>pdr-graph serve</title><style>{style}</style>'
    link = '<p>Also as <a href="openapi.json">OpenAPI</a>.</p>'
    shapes = f"<h2>JSON</h2><pre>{html.escape(publishing.__doc__ or '')}</pre>"
    return Response(f"{head}<h1>pdr-graph serve</h1>{link}{rows}{shapes}</html>", media_type="text/html")


# ── streams of events ───────────────────────────────────────────────────────────────────────────────────────────────


async def _relay(
    connection: HTTPConnection, reading: Coroutine[Any, Any, None], send: Callable[[str, Any], Awaitable[None]]
) -> None:
    """Send events, "" for a heartbeat, until ``reading`` from the client ends, it takes none, or the hub ends it."""
    hub = _server(connection).hub
    subscriber = hub.subscribe(connection.scope["user"])
    gone = asyncio.create_task(reading)
    gone.add_done_callback(lambda _: subscriber.wake())
    try:
        while not (subscriber.ended or gone.done()):
            for name, data in subscriber.events() if await subscriber.wait(HEARTBEAT) else [("", {})]:
                async with asyncio.timeout(SLOWEST_READER):
                    await send(name, data)
    except (TimeoutError, WebSocketDisconnect, RuntimeError):
        pass  # the client is gone or reads nothing
    finally:
        gone.cancel()
        hub.unsubscribe(subscriber)


async def events(request: Request) -> ASGIApp:
    """Server-sent events: `pose`, `path` and `forgotten` of all walkers that the user may see."""

    async def stream(scope: Scope, receive: Receive, send: Send) -> None:
        async def disconnected() -> None:
            while (await receive())["type"] != "http.disconnect":
                pass

        async def chunk(body: bytes, more_body: bool = True) -> None:
            await send({"type": "http.response.body", "body": body, "more_body": more_body})

        async def event(name: str, data: Any) -> None:
            await chunk(b"event: %s\ndata: %s\n\n" % (name.encode(), ENCODE(data)) if name else b": alive\n\n")

        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        start = Response(headers=headers, media_type="text/event-stream").raw_headers
        start = [(name, value) for name, value in start if name != b"content-length"]
        await send({"type": "http.response.start", "status": 200, "headers": start})
        await chunk(b"retry: 2000\n\n")
        await _relay(request, disconnected(), event)
        with suppress(TimeoutError):  # who reads nothing is disconnected
            async with asyncio.timeout(1.0):
                await chunk(b"", more_body=False)

    return stream


async def socket(websocket: WebSocket) -> None:
    """A WebSocket with the same events, one JSON a message, each with its name in the member ``event``."""
    await websocket.accept()

    async def closed() -> None:
        with suppress(WebSocketDisconnect, RuntimeError, KeyError):
            while True:
                await websocket.receive_text()

    async def event(name: str, data: Any) -> None:
        if name:  # its own pings are the heartbeat
            await websocket.send_text(ENCODE({"event": name, **data}).decode())

    await _relay(websocket, closed(), event)


# ── the page ────────────────────────────────────────────────────────────────────────────────────────────────────────


def checked_tiles(url: str | None) -> str | None:
    """The address of a tile server, ``https://host/{z}/{x}/{y}.png``; None without one. Raises InputError."""
    if url is None:
        return None
    places = all(place in url for place in ("{z}", "{x}", "{y}"))
    try:
        parts = urlsplit(url)
        right = parts.scheme in ("http", "https") and HOST.fullmatch(parts.netloc) and places
    except ValueError:
        right = False
    if not right:
        raise InputError("--tiles", "", repr(url), "an address such as https://host/{z}/{x}/{y}.png")
    return url


def security_headers(tiles: str | None, form: str = "'none'", style: str = "", script: str = "") -> dict[str, str]:
    """Headers of a page: scripts, styles and connections of this server alone; images of the tile server too.

    form: where its forms lead; style, script: more sources of these.
    """
    elsewhere = " {0.scheme}://{0.netloc}".format(urlsplit(tiles)) if tiles else ""
    policy = [
        *("default-src 'none'", f"script-src 'self'{script}", f"style-src 'self'{style}", "worker-src 'self'"),
        f"img-src 'self' data: blob:{elsewhere}",
        f"connect-src 'self'{elsewhere}",
        *("base-uri 'none'", f"form-action {form}", "frame-ancestors 'none'"),
    ]
    return {
        "Content-Security-Policy": "; ".join(policy),
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-cache",
    }


async def page(request: Request) -> Response:
    """The page. A token in its address moves to a cookie, so that it stays in no history and no link."""
    return _shown(request, "index.html", security_headers(_server(request).tiles))


async def app_page(request: Request) -> Response:
    """The page that sends the sensors of the phone that shows it; its token moves to a cookie too."""
    style, script = _inline("app.html")
    return _shown(request, "app.html", security_headers(_server(request).tiles, style=style, script=script))


def _shown(request: Request, name: str, headers: dict[str, str]) -> Response:
    if "token" not in request.query_params:
        return FileResponse(WEB / name, headers=headers)
    here = f".{request.url.path[request.url.path.rindex('/') :]}"  # relative: a proxy may have put a path before it
    response = RedirectResponse(here, 303)
    token, secure = request.query_params["token"], request.url.scheme == "https"
    # max_age: four months, in seconds
    name = cookie_name(request.headers)
    response.set_cookie(name, token, httponly=True, samesite="strict", secure=secure, max_age=10**7)
    return response


@cache
def _inline(name: str) -> tuple[str, str]:
    """Sources by which a policy allows the styles and the scripts within a page, each with a space before: hashes."""
    text = (WEB / name).read_bytes()
    style, script = (
        "".join(
            f" 'sha256-{base64.b64encode(hashlib.sha256(inline).digest()).decode()}'"
            for inline in re.findall(rb"<%s[^>]*>(.*?)</%s>" % (tag, tag), text, re.DOTALL)
        )
        for tag in (b"style", b"script")
    )
    return style, script


async def page_settings(request: Request) -> Response:
    """What the page asks first."""
    server = _server(request)
    return _json(settings(server.tiles, bool(server.access.tokens)))


def settings(tiles: str | None, guarded: bool) -> dict[str, Any]:
    """Settings of the page. guarded: phones need a token."""
    host = urlsplit(tiles).hostname if tiles else None
    return {"tiles": {"url": tiles, "attribution": f"tiles: {host}"} if tiles else None, "guarded": guarded}
