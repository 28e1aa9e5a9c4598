"""The routes of the server: what apps post, what programs and the page read."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Any

import msgspec
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import HTTPConnection, Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from pdr_graph.apps.serve import openapi, posting
from pdr_graph.apps.serve.access import Access, is_foreign, is_local, token_of
from pdr_graph.apps.serve.hub import Hub, Published, Subscriber
from pdr_graph.apps.serve.plan_layers import plan_layers
from pdr_graph.apps.serve.publishing import nav_sat_fix, walk_geojson
from pdr_graph.apps.serve.reception import Reception
from pdr_graph.apps.serve.study import StudyReports
from pdr_graph.apps.serve.web_page import WEB, page, settings

HEARTBEAT = 15.0  # [s] after which a silent stream sends a comment, by which proxies and the page know that it lives
TOKEN = "a token: ?token=… as in the address that pdr-graph serve printed, or Authorization: Bearer …"
ENCODE = msgspec.json.encode  # NaN becomes null


class Server:
    """What the routes share.

    hub: the published walkers; access: who may see them; reception: the sessions, None for tests of the page; plan: of
    `plan_layers`; tiles: address of a tile server; study: reports for studies, None without.
    """

    def __init__(
        self,
        hub: Hub,
        access: Access,
        plan: dict[str, Any] | None = None,
        tiles: str | None = None,
        reception: Reception | None = None,
        study: StudyReports | None = None,
    ):
        self.hub, self.access, self.plan, self.tiles = hub, access, plan or plan_layers(None), tiles
        self.reception, self.study = reception, study


def application(server: Server, lifespan: Any = None) -> Starlette:
    """The ASGI application. lifespan: starts and stops what the routes use."""
    routes = [
        Route("/", page),
        Route("/settings", page_settings),
        Route("/walkers", walkers),
        Route("/walkers/{id}.geojson", geojson),
        Route("/walkers/{id}.navsatfix", navsatfix),
        *posting.routes(),
        Route("/walkers/{id}", walker),
        Route("/events", events),
        WebSocketRoute("/socket", socket),
        Route("/plan", plan),
        Route("/openapi.json", description),
        Route("/api", described),
        Mount("/web", StaticFiles(directory=WEB, check_dir=False)),
    ]
    handlers = {HTTPException: refusal}
    app = Starlette(False, routes, [Middleware(Guard, server.access)], handlers, lifespan=lifespan)
    app.state.server = server
    return app


class Guard:
    """Refuses requests without a valid token and those of other sites' pages, before any body is read."""

    def __init__(self, app: ASGIApp, access: Access):
        self.app, self.access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Set the user of a request, or answer with 401 or 403."""
        if scope["type"] not in ("http", "websocket"):
            return await self.app(scope, receive, send)
        connection = HTTPConnection(scope)
        access, headers = self.access, connection.headers
        user = access.user_of(token_of(headers, connection.query_params, connection.cookies))
        if user is None:
            status, text = 401, f"found no valid token, expected {TOKEN}"
        elif is_foreign(headers):
            status, text = 403, "found a request of another site's page"
        elif not (access.tokens or is_local(headers)):
            status, text = 403, "found a proxy or another host's name and no token, expected pdr-graph serve --token"
        else:
            scope["user"] = user
            return await self.app(scope, receive, send)
        if scope["type"] == "websocket":
            return await WebSocket(scope, receive, send).close(4000 + status)
        header = {"WWW-Authenticate": 'Basic realm="pdr-graph"'} if status == 401 else None
        await PlainTextResponse(f"{text}\n", status, header)(scope, receive, send)


def refusal(_: Request, error: Exception) -> Response:
    """A fault as one line of text."""
    assert isinstance(error, HTTPException)
    return PlainTextResponse(f"{error.detail}\n", error.status_code, error.headers)


def _server(connection: HTTPConnection) -> Server:
    return connection.app.state.server


def _sees(connection: HTTPConnection) -> Callable[[str], bool]:
    """Whether the user of a request may see the walkers of a user."""
    return lambda user: Access.sees(connection.scope["user"], user)


def _walker(request: Request) -> Published:
    """The walker of the address. Raises HTTPException 404, also for those of other users."""
    walker = _server(request).hub.walkers.get(request.path_params["id"])
    if walker is None or not _sees(request)(walker.user):
        raise HTTPException(404, f"found no walker {request.path_params['id'][:64]!r}, expected one of GET /walkers")
    return walker


def _json(value: Any) -> Response:
    return Response(ENCODE(value), media_type="application/json", headers={"Cache-Control": "no-store"})


async def page_settings(request: Request) -> Response:
    """What the page needs to know first."""
    server = _server(request)
    return _json(settings(server.tiles, bool(server.access.tokens)))


async def walkers(request: Request) -> Response:
    """The last pose of each walker that the user may see."""
    sees = _sees(request)
    return _json([each.pose for each in _server(request).hub.walkers.values() if sees(each.user)])


async def walker(request: Request) -> Response:
    """The last pose of a walker."""
    return _json(_walker(request).pose)


async def geojson(request: Request) -> Response:
    """The path of a walker, finalised and current part, and its pose."""
    found = _walker(request)
    content = ENCODE(walk_geojson(found.pose, found.finalised, found.current))
    return Response(content, media_type="application/geo+json", headers={"Cache-Control": "no-store"})


async def navsatfix(request: Request) -> Response:
    """The pose of a walker in the shape of sensor_msgs/NavSatFix."""
    return _json(nav_sat_fix(_walker(request).pose))


async def plan(request: Request) -> Response:
    """The floor plan as GeoJSON; without one, an empty collection."""
    return Response(ENCODE(_server(request).plan), media_type="application/geo+json")


async def description(_: Request) -> Response:
    """The routes as an OpenAPI document."""
    return Response(ENCODE(openapi.document()), media_type="application/json")


async def described(_: Request) -> Response:
    """The routes for people."""
    return Response(openapi.html_page(), media_type="text/html")


def _subscribe(connection: HTTPConnection) -> Subscriber:
    subscriber = _server(connection).hub.subscribe(_sees(connection))
    if subscriber is None:
        raise HTTPException(
            503, "found the most event streams that this server has, expected fewer", {"Retry-After": "10"}
        )
    return subscriber


async def events(request: Request) -> Response:
    """Server-sent events: `pose`, `path` and `forgotten` of all walkers that the user may see."""
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(_stream(request, _subscribe(request)), media_type="text/event-stream", headers=headers)


async def _stream(request: Request, subscriber: Subscriber) -> AsyncIterator[bytes]:
    try:
        yield b"retry: 2000\n\n"
        hub = _server(request).hub
        while not (hub.closed or await request.is_disconnected()):
            if not await subscriber.wait(HEARTBEAT):
                yield b": alive\n\n"
            for name, data in subscriber.events():
                yield b"event: %s\ndata: %s\n\n" % (name.encode(), ENCODE(data))
    finally:
        _server(request).hub.unsubscribe(subscriber)


async def socket(websocket: WebSocket) -> None:
    """A WebSocket with the same events, one JSON a message, each with its name in the member ``event``."""
    try:
        subscriber = _subscribe(websocket)
    except HTTPException:
        return await websocket.close(1013)
    await websocket.accept()
    reading = asyncio.create_task(_until_closed(websocket))
    try:
        hub = _server(websocket).hub
        while not (hub.closed or reading.done()):
            await subscriber.wait(HEARTBEAT)
            for name, data in subscriber.events():
                # stuck [s] after which a subscriber that reads nothing is disconnected
                async with asyncio.timeout(30.0):
                    await websocket.send_text(ENCODE({"event": name, **data}).decode())
    except (TimeoutError, WebSocketDisconnect, RuntimeError):
        pass
    finally:
        reading.cancel()
        _server(websocket).hub.unsubscribe(subscriber)


async def _until_closed(websocket: WebSocket) -> None:
    """Discard what a client sends, until it closes."""
    try:
        while True:
            await websocket.receive_text()
    except (WebSocketDisconnect, RuntimeError, KeyError):
        return
