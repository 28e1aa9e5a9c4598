"""The description of the routes: an OpenAPI 3.1 document, and a page of it without any script."""

from __future__ import annotations

import html
from dataclasses import dataclass, field
from typing import Any

import pdr_graph.apps.serve.publishing as publishing
from pdr_graph import __version__

JSON, TEXT, GEO_JSON, EVENTS = "application/json", "text/plain", "application/geo+json", "text/event-stream"
NUMERIC, WORDS, LINES = {"type": ["number", "null"]}, {"type": "string"}, {"type": "array", "items": {"type": "string"}}
REGION = {
    "type": ["object", "null"],
    "description": "Ellipse about x, y that holds the position with the probability; metres, radians from +x.",
    "properties": {name: {"type": "number"} for name in ("probability", "semi_major", "semi_minor", "angle")},
}
PLACE_FIELDS = {name: NUMERIC for name in ("x", "y", "lon", "lat", "heading")} | {"region": REGION}
POSE_SCHEMA = {
    "type": "object",
    "required": ["id", "name", "state", "time", "x", "y", "lon", "lat", "sigma", "heading", "floor"],
    "properties": {
        **dict.fromkeys(("id", "name", "state", "floor"), WORDS),
        **dict.fromkeys(("time", "sigma", "heading_sigma", "bearing"), NUMERIC),
        **PLACE_FIELDS,
        "display": {"type": ["array", "null"], "items": {"type": "number"}},
        "modes": {"type": "array", "items": {"type": "object", "properties": {"probability": NUMERIC, **PLACE_FIELDS}}},
        **dict.fromkeys(("missing", "issues"), LINES),
        "health": {"type": "object", "additionalProperties": WORDS},
        "ignored": {"type": "object", "additionalProperties": {"type": "integer"}},
        "message": {"type": "integer"},
        "steps": {"type": "integer"},
    },
}
REFUSED = {
    "401": "No valid token.",
    "403": "A page of another site, or a session of another user.",
}
POSTED = {
    "400": "Malformed: one line says where.",
    "408": "The message did not arrive completely in time.",
    "413": "Too large, or too many samples.",
    "429": "More than the rate of a session, or too many sessions; see Retry-After.",
    "507": "The server's disk is full.",
}


@dataclass(frozen=True)
class Operation:
    """One method of a path. answer, body: media types of status 200 and of the request; schema: of the answer."""

    method: str
    path: str
    summary: str
    answer: str = JSON
    body: str = ""
    schema: dict[str, Any] = field(default_factory=dict)
    faults: dict[str, str] = field(default_factory=dict)
    query: tuple[str, ...] = ()


ABSENT = {"404": "No such walker, or one of another user."}
OPERATIONS = (
    Operation("get", "/", "The page.", "text/html"),
    Operation("get", "/walkers", "The last pose of each walker.", schema={"type": "array", "items": POSE_SCHEMA}),
    Operation("get", "/walkers/{id}", "The last pose of a walker.", schema=POSE_SCHEMA, faults=ABSENT),
    Operation("get", "/walkers/{id}.geojson", "Path, finalised and current part, and pose.", GEO_JSON, faults=ABSENT),
    Operation("get", "/walkers/{id}.navsatfix", "The pose as sensor_msgs/NavSatFix.", faults=ABSENT),
    Operation("get", "/walkers/{id}/recording", "The recording of a finished walk.", "application/zip", faults=ABSENT),
    Operation("post", "/walkers/{id}/finish", "End a walk.", TEXT, faults=ABSENT),
    Operation("delete", "/walkers/{id}", "Delete a walk with all its files.", TEXT, faults=ABSENT),
    Operation("get", "/events", "Server-sent events: pose, path and forgotten.", EVENTS),
    Operation("get", "/socket", "The same events on a WebSocket, a JSON each, with the member event."),
    Operation("get", "/plan", "The floor plan.", GEO_JSON),
    Operation("get", "/settings", "What the page asks first."),
    Operation("get", "/openapi.json", "This description."),
    Operation("get", "/api", "This description for people.", "text/html"),
    Operation(
        "post",
        "/sensorlogger",
        "A message of Sensor Logger. Status 499: stored too, and its text is shown to the user.",
        TEXT,
        JSON,
        faults=POSTED | {"499": "Stored. The text is advice for the user of the phone."},
        query=("platform", "name"),
    ),
    Operation("post", "/study", "A call of Sensor Logger's study webhook.", TEXT, JSON, faults=POSTED),
    Operation("post", "/owntracks", "A message of OwnTracks.", body=JSON, faults=POSTED),
    Operation("post", "/overland", "A batch of Overland.", body=JSON, faults=POSTED),
    Operation("get", "/osmand", "A position by OsmAnd's protocol, in the query.", TEXT, faults=POSTED),
    Operation("post", "/osmand", "The same as a form, or the JSON of Traccar Client.", TEXT, JSON, faults=POSTED),
)


def document() -> dict[str, Any]:
    """The OpenAPI document."""
    paths = dict[str, dict[str, Any]]()
    for each in OPERATIONS:
        paths.setdefault(each.path, {})[each.method] = _operation(each)
    schemes = {
        "query": {"type": "apiKey", "in": "query", "name": "token"},
        "bearer": {"type": "http", "scheme": "bearer"},
        "basic": {"type": "http", "scheme": "basic", "description": "Any user name; the token as password."},
    }
    about = {"title": "pdr-graph serve", "version": __version__, "description": publishing.__doc__ or ""}
    security = [{name: []} for name in schemes]
    return {
        "openapi": "3.1.0",
        "info": about,
        "paths": paths,
        "components": {"securitySchemes": schemes},
        "security": [{}, *security],
    }


def _operation(each: Operation) -> dict[str, Any]:
    content = {each.answer: {"schema": each.schema} if each.schema else {}}
    answers = {"200": {"description": each.summary, "content": content}}
    answers |= {
        status: {"description": text, "content": {TEXT: {}}} for status, text in (REFUSED | each.faults).items()
    }
    described: dict[str, Any] = {"summary": each.summary, "responses": answers}
    if each.body:
        described["requestBody"] = {"required": True, "content": {each.body: {}}}
    parameters = [{"name": name, "in": "query", "schema": WORDS} for name in each.query]
    if "{id}" in each.path:
        parameters.append({"name": "id", "in": "path", "required": True, "schema": WORDS})
    return described | ({"parameters": parameters} if parameters else {})


def html_page() -> str:
    """The same as a page."""
    rows = "".join(
        f"<h2><code>{each.method.upper()} {html.escape(each.path)}</code></h2><p>{html.escape(each.summary)}</p><ul>"
        + "".join(f"<li>{status}: {html.escape(text)}</li>" for status, text in (REFUSED | each.faults).items())
        + "</ul>"
        for each in OPERATIONS
    )
    shapes = html.escape(publishing.__doc__ or "")
    style = "body{font:16px/1.5 system-ui;max-width:50rem;margin:2rem auto;padding:0 1rem;color-scheme:light dark}"
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>pdr-graph serve</title><style>{style}</style>'
    link = '<p>Also as <a href="openapi.json">OpenAPI</a>.</p>'
    return f"{head}<h1>pdr-graph serve</h1>{link}{rows}<h2>JSON</h2><pre>{shapes}</pre></html>"
