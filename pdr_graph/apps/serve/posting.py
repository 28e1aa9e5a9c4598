"""What phones post, and what is done with a session: the routes that change something."""

from __future__ import annotations

import asyncio
import zlib

from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route

from pdr_graph.apps.serve.access import Access
from pdr_graph.apps.serve.intake import SENSOR_LOGGER
from pdr_graph.apps.serve.reception import SHOW_TO_USER, Reception, RefusalError
from pdr_graph.apps.serve.study import upload_of
from pdr_graph.errors import InputError

MOST_DISCARDED = 256 << 20  # bytes of a body that is too large, read and dropped: else its sender sees no answer
SLOWEST_BODY = 30.0  # [s] for a message to arrive completely


def routes() -> list[BaseRoute]:
    """The routes of this file."""
    return [
        Route("/sensorlogger", sensorlogger, methods=["POST"]),
        Route("/owntracks", owntracks, methods=["POST"]),
        Route("/overland", overland, methods=["POST"]),
        Route("/osmand", osmand, methods=["GET", "POST"]),
        Route("/study", study, methods=["POST"]),
        Route("/walkers/{id}/recording", recording),
        Route("/walkers/{id}/finish", finish, methods=["POST"]),
        Route("/walkers/{id}", forget, methods=["DELETE"]),
    ]


def _reception(request: Request) -> Reception:
    reception: Reception = request.app.state.server.reception
    return reception


def _session(request: Request) -> str:
    """The id of the session in the address. Raises HTTPException 404, also for those of other users."""
    id_, viewer = request.path_params["id"], request.scope["user"]
    user = _reception(request).user_of(id_)
    if user is None or not Access.sees(viewer, user):
        raise HTTPException(404, f"found no walker {id_[:64]!r}, expected one of GET /walkers")
    return id_


async def _body(request: Request) -> bytes:
    """The body of a request. Raises HTTPException 413 if it is too large, 408 if it takes too long, 400 if it ends."""
    most = _reception(request).limits.body
    too_large = HTTPException(
        413, f"found more than {most >> 20} MB, expected smaller messages", {"Connection": "close"}
    )
    received, size = bytearray(), 0
    stated = int(request.headers.get("content-length", 0))  # digits, checked by the HTTP parser
    if stated > most and (stated > MOST_DISCARDED or "expect" in request.headers):
        raise too_large
    try:
        async with asyncio.timeout(SLOWEST_BODY):
            async for part in request.stream():
                size += len(part)
                if len(received) <= most:
                    received += part
                elif size > MOST_DISCARDED:
                    break
    except TimeoutError:
        raise HTTPException(
            408, f"found no end of the message in {SLOWEST_BODY:.0f} s", {"Connection": "close"}
        ) from None
    except ClientDisconnect:
        raise HTTPException(400, "found a connection that ended within the message") from None
    if len(received) > most:
        raise too_large
    encoding = request.headers.get("content-encoding", "identity")
    if encoding == "gzip":
        return _unzipped(bytes(received), most, too_large)
    if encoding != "identity":
        raise HTTPException(415, f"found the encoding {encoding[:40]!r}, expected gzip or none")
    return bytes(received)


def _unzipped(packed: bytes, most: int, too_large: HTTPException) -> bytes:
    """The content of a gzip body, without allocating more than ``most`` bytes."""
    unpacking = zlib.decompressobj(wbits=16 + zlib.MAX_WBITS)
    try:
        body = unpacking.decompress(packed, most)
    except zlib.error as error:
        raise HTTPException(400, f"found a damaged gzip body ({error})") from None
    if unpacking.unconsumed_tail:
        raise too_large
    return body


async def _receive(request: Request, protocol: str, name: str = "") -> str:
    """Log the message of a request; returns what its user should know, or "". Raises HTTPException."""
    body = await _body(request)
    query = request.query_params
    if not body and request.method == "GET":
        body = request.url.query.encode()
    try:
        user, platform = request.scope["user"], query.get("platform", "").lower()
        return _reception(request).receive(protocol, user, body, platform, query.get("name", "") or name)
    except RefusalError as refused:
        raise HTTPException(refused.status, refused.text, refused.headers or None) from None


async def sensorlogger(request: Request) -> Response:
    """A message of Sensor Logger: 200, or once 499 with a text that the app shows; the message is stored then too."""
    advice = await _receive(request, SENSOR_LOGGER)
    return PlainTextResponse(advice, SHOW_TO_USER) if advice else Response()


async def owntracks(request: Request) -> Response:
    """A message of OwnTracks; answered by an empty list of commands."""
    user, device = (request.headers.get(f"x-limit-{letter}", "") for letter in "ud")
    await _receive(request, "owntracks", device or user)
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
    reports = request.app.state.server.study
    if reports is None:
        raise HTTPException(404, "found no study, expected pdr-graph serve --study STUDY")
    try:
        reports.accept(upload_of(await _body(request)))
    except InputError as error:
        raise HTTPException(400, str(error)) from None
    except OSError as error:
        raise HTTPException(507, error.strerror or str(error), {"Retry-After": "60"}) from None
    return Response()


async def recording(request: Request) -> Response:
    """The recording of a finished walk, for pdr-graph smooth; 409 before it is finished."""
    id_ = _session(request)
    file = _reception(request).recording(id_)
    if file is None:
        raise HTTPException(409, "found a walk under way, expected a finished one: POST /walkers/ID/finish")
    return FileResponse(file, filename=f"{id_}{file.suffix}")


async def finish(request: Request) -> Response:
    """End a walk; its recording is made. The next message of its phone would resume it."""
    _reception(request).finish(_session(request))
    return Response(status_code=202)


async def forget(request: Request) -> Response:
    """Delete a walk with all its files. What the lifelog has of it stays there."""
    _reception(request).forget(_session(request))
    return Response(status_code=204)
