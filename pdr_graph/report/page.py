"""A page that needs nothing else: template, style, scripts and content in one file.

Names in recordings and plans are their makers' and may be anything. All of them are in the content, JSON in ASCII
without a "<", which the script shows as text; and the page's own policy allows these two scripts alone, by their
hashes, and no request to anywhere.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from importlib.resources import files
from typing import Any

SCRIPTS = ("content", "walker", "map", "charts", "player", "words", "start")  # one after the other
PLACE = re.compile(rb"\{\{(\w+)\}\}")  # in the template, of a part


def page(content: dict[str, Any]) -> bytes:
    """The file; content: as the head of ``web/content.js`` says."""
    own = files("pdr_graph.report").joinpath("web")
    template, style = own.joinpath("page.html").read_bytes(), own.joinpath("page.css").read_bytes()
    script = b'"use strict";\n' + b"".join(own.joinpath(f"{name}.js").read_bytes() for name in SCRIPTS)
    library = files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()
    policy = f"default-src 'none'; script-src {_hash(library)} {_hash(script)}; style-src 'unsafe-inline'; "
    said = json.dumps(content, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    parts = {
        b"policy": (policy + "img-src data: blob:").encode(),
        b"style": style,
        b"content": said.encode("ascii"),
        b"library": library,
        b"script": script,
    }
    text = PLACE.split(template)  # every second one names a part
    text[1::2] = [parts[name] for name in text[1::2]]
    return b"".join(text)


def _hash(script: bytes) -> str:
    """By which a policy knows a script."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script).digest()).decode()}'"
