"""PDF pages: their vector lines, or, without any, the picture on them."""

from __future__ import annotations

import ctypes
import re
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph.errors import InputError, count
from pdr_graph.floor.formats.drawing import Drawing, check_file_size, required_library
from pdr_graph.floor.formats.floor_picture import drawing_of_picture
from pdr_graph.floor.formats.line_drawing import MOST_SEGMENTS, UNCLEAR, drawing_of_lines
from pdr_graph.types import Array

LARGEST_CONTENT = 30_000_000  # [bytes] a plan of 200 000 segments has some 5 MB
STREAM = re.compile(rb"\bstream\r?\n")
LARGEST_PAGE = 15_000  # [point] 5 m of paper
# Weights of the four points of a cubic Bézier curve: a quarter of a circle in eight chords
BEZIER = np.array([[(1 - t) ** 3, 3 * (1 - t) ** 2 * t, 3 * (1 - t) * t**2, t**3] for t in np.linspace(0, 1, 9)[1:]])


def read(path: Path, scale: float | None) -> Drawing:
    """Read the first page of a PDF file, in points of 1/72 inch from its lower left corner.

    scale: metres per point, 0.0353 for a plan of 1:100; the format states none. Raises InputError for a damaged file.
    """
    with required_library(path, "a PDF page", "pypdfium2"):
        import pypdfium2
    check_file_size(path, 100_000_000)  # [bytes]
    _check_unpacked(path)
    try:
        document = pypdfium2.PdfDocument(path)
    except (pypdfium2.PdfiumError, OSError, ValueError) as error:
        raise InputError(path, "", f"a damaged PDF file ({str(error)[:80]})", "a whole one without password") from None
    with document:
        return _read_page(path, document, scale)


def _check_unpacked(path: Path) -> None:
    """Raise InputError if the packed streams that are no pictures have more than LARGEST_CONTENT, all of them together.

    A page's content takes twenty times its size when it is read.
    """
    content, size = path.read_bytes(), 0
    for stream in STREAM.finditer(content):
        if b"/Image" in content[max(0, stream.start() - 300) : stream.start()]:
            continue
        unpacking = zlib.decompressobj()
        with suppress(zlib.error):  # damage
            # in pieces: zlib copies what lies behind a stream's end
            for start in range(stream.end(), len(content), 10_000):
                packed = content[start : start + 10_000]
                while packed and size <= LARGEST_CONTENT:
                    size += len(unpacking.decompress(packed, 1_000_000))
                    packed = unpacking.unconsumed_tail
                if unpacking.eof or size > LARGEST_CONTENT:
                    break
        if size > LARGEST_CONTENT:
            raise InputError(path, "", f"a page of more than {LARGEST_CONTENT} bytes unpacked", "the plan of one floor")


def _read_page(path: Path, document: Any, scale: float | None) -> Drawing:
    import pypdfium2

    notes = [f"the first of {len(document)} pages was read"] if len(document) > 1 else []
    try:
        page = document[0]
        width, height = page.get_size()
        if not 0 < max(width, height) <= LARGEST_PAGE:
            raise InputError(path, "", f"a page of {width:g} by {height:g} points", f"at most {LARGEST_PAGE} points")
        # a page with fewer than 20 lines is a picture, rendered with 3000 pixels on its longer side
        segments, finer = _segments(path, page), 3000 / max(width, height)
        picture = None if len(segments) >= 20 else page.render(scale=finer, grayscale=True).to_numpy()
    except (pypdfium2.PdfiumError, IndexError) as error:
        raise InputError(path, "", f"a damaged PDF page ({str(error)[:80]})", "a page with a plan") from None
    if picture is None:
        notes.append(f"{count(len(segments), 'segment')} of the page's vector lines")
        return drawing_of_lines(path, segments, [UNCLEAR] * len(segments), scale, None, notes, framed=True)
    notes.append(f"{count(len(segments), 'vector line')} on the page: its picture was traced")
    return drawing_of_picture(path, np.ascontiguousarray(picture.reshape(picture.shape[:2])), scale, finer, notes)


def _segments(path: Path, page: Any) -> Array:
    """The lines of all visible paths of a page ``(n, 2, 2)`` [point]."""
    from pypdfium2 import raw

    found, number = [np.empty((0, 2, 2))], 0
    for item in page.get_objects(filter=[raw.FPDF_PAGEOBJ_PATH], max_depth=8):
        matrix = item.get_matrix().get()
        for points in _subpaths(item.raw):
            a, b, c, d, e, f = matrix
            placed = points @ np.array([[a, b], [c, d]]) + (e, f)
            found.append(np.stack([placed[:-1], placed[1:]], axis=1))
            number += len(placed) - 1
        if number > MOST_SEGMENTS:
            raise InputError(path, "", f"more than {MOST_SEGMENTS} segments", "the plan of one floor")
    segments = np.concatenate(found)
    return segments[np.isfinite(segments).all(axis=(1, 2))]


def _subpaths(item: Any) -> Iterator[Array]:
    """The polylines ``(n, 2)`` of a path object, curves as chords."""
    from pypdfium2 import raw

    points, control = list[Array](), list[Array]()
    x, y = ctypes.c_float(), ctypes.c_float()
    for n in range(raw.FPDFPath_CountSegments(item)):
        part = raw.FPDFPath_GetPathSegment(item, n)
        raw.FPDFPathSegment_GetPoint(part, x, y)
        kind, point = raw.FPDFPathSegment_GetType(part), np.array([x.value, y.value], dtype=float)
        if kind == raw.FPDF_SEGMENT_MOVETO:
            if len(points) > 1:
                yield np.array(points)
            points, control = [point], []
        elif kind == raw.FPDF_SEGMENT_BEZIERTO and points:
            control.append(point)
            if len(control) == 3:
                ends = np.array([points[-1], *control])
                points, control = points + list(BEZIER @ ends), []
        elif points:
            points.append(point)
        if raw.FPDFPathSegment_GetClose(part) and len(points) > 1:
            points.append(points[0])
    if len(points) > 1:
        yield np.array(points)
