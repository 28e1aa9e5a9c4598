"""Formats of drawings and pictures, which are read with a scale: one module each, recognised by the first bytes."""

from __future__ import annotations

from pathlib import Path

from pdr_graph.errors import InputError
from pdr_graph.floor.formats import cad_segments, dxf, floor_picture, pdf_page, ros_map
from pdr_graph.floor.formats.drawing import Drawing

MODULES = (dxf, pdf_page, floor_picture, ros_map, cad_segments)
HEAD = 4096  # [bytes] that show the format
UNREAD = {  # first bytes: what it is, what to do
    b"AC10": ("a DWG drawing", "the same saved as DXF"),
    b"P5": ("the picture of a ROS map", "its .yaml file"),
}


def recognizes(path: Path) -> bool:
    """True for a file of one of these formats. Raises InputError with advice for one that cannot be read."""
    if not path.is_file():
        return False
    head = _head(path)
    for begin, (found, advice) in UNREAD.items():
        if head.startswith(begin):
            raise InputError(path, "", found, advice)
    return any(module.recognizes(path, head) for module in MODULES)


def read(path: Path, scale: float | None) -> Drawing:
    """Read a drawing or a picture. scale: metres per unit or pixel; None: as the file states, or InputError."""
    head = _head(path)
    return next(module for module in MODULES if module.recognizes(path, head)).read(path, scale)


def files_of(path: Path) -> tuple[Path, ...]:
    """The files that `read` reads: the drawing, or a map of ROS and its picture."""
    return (path, ros_map.picture_of(path)) if ros_map.recognizes(path, _head(path)) else (path,)


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(HEAD)
