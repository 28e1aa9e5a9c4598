"""Pictures of a floor, PNG and JPEG: dark pixels become walls; skew, specks, thin lines and small gaps are removed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage

from pdr_graph.errors import InputError
from pdr_graph.floor.formats.drawing import Drawing, required_library
from pdr_graph.floor.formats.line_drawing import Lines, areas_of, metres_per_unit
from pdr_graph.frames import Frame
from pdr_graph.types import Array, Mask


def read(path: Path, scale: float | None) -> Drawing:
    """Trace the walls of a picture. scale: metres per pixel; the format states none."""
    picture, factor = opened(path, ("PNG", "JPEG"))
    return drawing_of_picture(path, picture, scale, 1.0 / factor, ["the walls were traced from a picture"])


def drawing_of_picture(path: Path, picture: Picture, scale: float | None, finer: float, notes: list[str]) -> Drawing:
    """The plan in a picture's brightness, x right and y up from its lower left corner.

    scale: metres per pixel of the file; finer: pixels of `picture` per pixel of the file. Raises InputError without a
    scale, or if the dark lines enclose no building.
    """
    rows, columns = np.array(picture.shape) / finer
    if scale is None:
        found = f"a picture of {columns:.0f} by {rows:.0f} pixels and no scale"
        expected = '--scale METRES_PER_PIXEL, or pdr-graph map convert --two-points "x1,y1 x2,y2 = METRES"'
        raise InputError(path, "", found, expected)
    metres = metres_per_unit(path, np.array([[0.0, 0.0], [columns, rows]]), scale, "a picture in pixels") / finer
    with required_library(path, "a picture", "scikit-image"):
        walls, affine = traced(picture, metres, notes)
    if shapely.is_empty(walls):
        raise InputError(path, "", "a picture without dark lines", "the walls of a floor")
    areas, outside = areas_of(Lines(np.empty((0, 2, 2)), solid=walls), notes)
    if not areas:
        raise InputError(path, "", "dark lines that enclose no building", "walls with gaps of at most 5 m around it")
    (a, b, c), (d, e, f) = affine.tolist()
    return Drawing(
        {"": areas}, Frame(), tuple(notes), affine=(a * finer, b * finer, c, d * finer, e * finer, f), ignored=outside
    )


Picture = NDArray[np.uint8]  # brightness ``(rows, columns)``, 0 black, 255 white


# What is a wall in a picture; chosen by hand
SKEW = 12.0  # [deg] largest rotation of a scan that is removed
GAP = 2  # [pixel] gaps that are closed
THICK = 5  # [pixel] walls from here on are drawn thick, and thinner strokes are other things
TEXT = 0.8  # [m] largest side of a letter or a speck


def traced(picture: Picture, metres: float, notes: list[str]) -> tuple[shapely.Geometry, Array]:
    """Polygons of the walls in a picture [m], x right and y up, and the affine ``(2, 3)`` from its pixels to metres.

    metres: per pixel. What was removed is appended to `notes`. The origin is the lower left corner, about which the
    skew is removed; pixels count from the upper left one, (0, 0), to the right and downwards.
    """
    from skimage.filters import threshold_otsu

    threshold = int(threshold_otsu(picture)) if np.ptp(picture) else 0
    if np.mean(picture <= threshold) > 0.5:
        picture, threshold = (255 - picture).astype(np.uint8), 254 - threshold
        notes.append("bright lines on a dark ground: brightness was inverted")
    skew, rows = skew_of(picture <= threshold), len(picture)
    cos, sin = np.cos(np.radians(skew)), np.sin(np.radians(skew))
    turn = np.array([[cos, -sin], [sin, cos]])  # of pixel coordinates
    affine = metres * np.array([[1.0], [-1.0]]) * turn
    affine = np.column_stack([affine, -affine @ (-0.5, rows - 0.5)])
    centre = _centre(picture.shape)
    if abs(skew) > 0.1:
        notes.append(f"a skew of {abs(skew):.1f}° was removed")
        picture = np.asarray(ndimage.rotate(picture, -skew, order=1, cval=255), dtype=np.uint8)
    polygons = outlines(_cleaned(picture <= threshold, metres, notes))

    def to_metres(pixels: Array) -> Array:
        return ((pixels - _centre(picture.shape)) @ turn + centre) @ affine[:, :2].T + affine[:, 2]

    return shapely.transform(polygons, to_metres), affine


def _centre(shape: tuple[int, ...]) -> Array:
    """The centre ``(x, y)`` of a picture of ``(rows, columns)`` [pixel]; centres of pixels are whole numbers."""
    return (np.array(shape[::-1]) - 1) / 2


def skew_of(dark: Mask) -> float:
    """Rotation [deg] of pixel coordinates that aligns the walls with the axes; 0 if no angle stands out.

    Sums of the dark pixels along rows and columns are sharpest if the walls lie along them.
    """
    y, x = np.nonzero(dark)
    if len(x) < 100:
        return 0.0
    chosen = np.random.default_rng(0).permutation(len(x))[:60_000]
    x, y = x[chosen] - x.mean(), y[chosen] - y.mean()

    def sharpness(angle: float) -> float:
        cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        profiles = (x * cos - y * sin, x * sin + y * cos)
        return sum(float(np.sum(np.bincount((p - p.min()).astype(int)).astype(float) ** 2)) for p in profiles)

    coarse = np.arange(-SKEW, SKEW + 0.1, 0.5)
    best = coarse[np.argmax([sharpness(a) for a in coarse])]
    fine = best + np.arange(-0.5, 0.51, 0.05)
    best = float(fine[np.argmax([sharpness(a) for a in fine])])
    return best if sharpness(best) > 1.1 * sharpness(0.0) else 0.0


def _cleaned(dark: Mask, metres: float, notes: list[str]) -> Mask:
    """Dark pixels of walls: without specks and letters, without thin strokes beside thick walls, gaps closed."""
    square = np.ones((3, 3))
    padded = ndimage.binary_closing(np.pad(dark, GAP + 1), np.ones((GAP + 1, GAP + 1)))
    closed: Mask = np.asarray(padded, dtype=bool)[GAP + 1 : -GAP - 1, GAP + 1 : -GAP - 1]
    core: Mask = np.asarray(ndimage.binary_opening(closed, np.ones((THICK, THICK))), dtype=bool)
    if core.sum() > 0.6 * closed.sum():
        thin = int(closed.sum() - core.sum())
        closed = closed & np.asarray(ndimage.binary_dilation(core, square), dtype=bool)
        if thin:
            notes.append(f"lines thinner than {THICK} pixels beside thick walls were left out ({thin} pixels)")
    parts: Any = ndimage.label(closed, square)
    if not parts[1]:
        return closed
    boxes: Any = ndimage.find_objects(parts[0])
    sides = metres * np.array([[side.stop - side.start for side in box] for box in boxes])
    filled = np.bincount(parts[0].ravel())[1:] * metres**2 / np.prod(sides, axis=1)
    # a column is 0.2 m wide or more, and fills most of its box
    column = (sides.min(axis=1) >= 0.2) & (filled >= 0.7)
    speck = (sides.max(axis=1) < TEXT) & ~column
    if speck.any():
        notes.append(f"{np.count_nonzero(speck)} specks and letters smaller than {TEXT:g} m were left out")
    return closed & ~np.append(False, speck)[parts[0]]


def outlines(dark: Mask) -> shapely.Geometry:
    """Polygons around dark pixels, in pixels: x to the right, y downwards, centres of pixels are whole numbers."""
    from skimage.measure import find_contours

    rings = [ring[:, ::-1] - 1 for ring in find_contours(np.pad(dark, 1).astype(float), 0.5)]
    lines = [shapely.LineString(ring) for ring in rings if len(ring) > 3]
    polygons = shapely.build_area(shapely.geometrycollections(lines))
    return shapely.make_valid(shapely.simplify(polygons, 0.75))


LARGEST_PICTURE = 80_000_000  # [pixel]


def opened(path: object, formats: tuple[str, ...]) -> tuple[Picture, int]:
    """The brightness of a picture on white ground, and the factor by which it was reduced.

    Raises InputError for a damaged or too large one; its size is read before it is decoded.
    """
    from PIL import Image

    try:
        with Image.open(str(path), formats=formats) as image:
            width, height = image.size
            if width * height > LARGEST_PICTURE or min(width, height) < 8:
                raise InputError(str(path), "", f"{width} by {height} pixels", f"8 to {LARGEST_PICTURE} pixels in all")
            factor = -(-max(width, height) // 5000)  # larger pictures are reduced to a side of 5000 pixels
            image = image.convert("RGBA") if "A" in image.getbands() or "transparency" in image.info else image
            if image.mode == "RGBA":
                image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
            grey = image.convert("L")
            return np.asarray(grey.reduce(factor) if factor > 1 else grey), factor
    except InputError:
        raise
    except Exception as error:  # Pillow's plugins raise all kinds for damaged files
        raise InputError(str(path), "", f"a damaged picture ({str(error)[:80]})", "a whole one") from None
