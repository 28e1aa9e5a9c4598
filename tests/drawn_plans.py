"""A building of known geometry, and drawings of it in the formats that people have."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import shapely

WIDTH, DEPTH, ROOMS = 36.0, 14.4, 8  # [m] and rooms along each side of the corridor
CORRIDOR = (6.0, 8.4)  # [m] between which it lies
WALL, OUTER = 0.2, 0.4  # [m] thickness
DOOR = 0.9  # [m]


def room_boxes():
    """The free area of each room."""
    width = (WIDTH - 2 * OUTER - (ROOMS - 1) * WALL) / ROOMS
    boxes = []
    for n in range(ROOMS):
        x = OUTER + n * (width + WALL)
        boxes += [shapely.box(x, OUTER, x + width, CORRIDOR[0] - WALL)]
        boxes += [shapely.box(x, CORRIDOR[1] + WALL, x + width, DEPTH - OUTER)]
    return boxes


def corridor():
    return shapely.box(OUTER, CORRIDOR[0], WIDTH - OUTER, CORRIDOR[1])


def openings():
    """The doors: boxes through the walls between rooms and corridor."""
    doors = []
    for box in room_boxes():
        x0, y0, _, y1 = box.bounds
        low, high = (y1, CORRIDOR[0]) if y1 < CORRIDOR[0] else (CORRIDOR[1], y0)
        doors.append(shapely.box(x0 + 1.0, low, x0 + 1.0 + DOOR, high))
    return doors


def entrance():
    return shapely.box(0, 6.7, OUTER, 7.7)


def free():
    """Where one can walk, doors among it."""
    return shapely.union_all([corridor(), *room_boxes(), *openings()])


def walls():
    """The solid walls, doors and the entrance left open."""
    outline = shapely.box(0, 0, WIDTH, DEPTH)
    return shapely.difference(outline, shapely.union_all([free(), entrance()]))


def segments(geometry):
    """The border of polygons as segments ``(n, 2, 2)``."""
    rings = [shapely.get_coordinates(r) for r in shapely.get_rings(shapely.get_parts(geometry))]
    return np.concatenate([np.stack([r[:-1], r[1:]], axis=1) for r in rings])


def csv(lines, scale=1.0):
    """Segments as a table, in units of `scale` metres."""
    rows = [",".join(f"{v / scale:.6f}" for v in line.ravel()) for line in lines]
    return "\n".join(["x1,y1,x2,y2", *rows])


def dxf(path, scale=0.001, units=4, doors=True, layer="A-WALL", door_layer="A-DOOR", texts=True):
    """A DXF drawing with doors as blocks of leaf and swing, texts and furniture; units: $INSUNITS."""
    import ezdxf

    document = ezdxf.new()
    document.header["$INSUNITS"] = units
    space = document.modelspace()
    for ring in shapely.get_rings(shapely.get_parts(walls())):
        corners = shapely.get_coordinates(ring)[:-1] / scale
        space.add_lwpolyline(corners, close=True, dxfattribs={"layer": layer})
    block = document.blocks.new("SWING")
    block.add_line((0, 0), (0, DOOR / scale))
    block.add_arc((0, 0), DOOR / scale, 0, 90)
    for box in openings() if doors else []:
        x0, y0, _, y1 = box.bounds
        inward = y0 >= CORRIDOR[1]
        at = (x0 / scale, (y1 if inward else y0) / scale)
        space.add_blockref("SWING", at, {"layer": door_layer, "yscale": 1 if inward else -1})
    for n, box in enumerate(room_boxes() if texts else []):
        x, y = shapely.get_coordinates(box.centroid)[0] / scale
        space.add_text(f"Room {n}", height=0.3 / scale, dxfattribs={"layer": "A-TEXT"}).set_placement((x, y))
        space.add_lwpolyline(
            [(x, y), (x + 1.6 / scale, y), (x + 1.6 / scale, y + 0.8 / scale), (x, y + 0.8 / scale)],
            close=True,
            dxfattribs={"layer": "A-FURN"},
        )
    document.saveas(path)


def picture(pixel=0.02, skew=0.0, gap=False, thick=True, texts=True, margin=40):
    """A picture of the building, ``pixel`` metres a pixel, as a Pillow image; skew: counter-clockwise [deg]."""
    from PIL import Image, ImageDraw

    size = (int(WIDTH / pixel) + 2 * margin, int(DEPTH / pixel) + 2 * margin)
    image = Image.new("L", size, 255)
    draw = ImageDraw.Draw(image)

    def pixels(corners):
        return [(margin + x / pixel, size[1] - margin - y / pixel) for x, y in corners]

    if thick:
        for polygon in shapely.get_parts(walls()):
            draw.polygon(pixels(shapely.get_coordinates(polygon.exterior)), fill=0)
            for hole in polygon.interiors:
                draw.polygon(pixels(shapely.get_coordinates(hole)), fill=255)
    else:
        for line in segments(walls()):
            draw.line(pixels(line), fill=0, width=2)
    for n, box in enumerate(room_boxes() if texts else []):
        draw.text(pixels([(box.centroid.x, box.centroid.y)])[0], f"{n:03d}", fill=0)
    if gap:  # a line of a pixel across the building
        x = int(margin + 0.37 * WIDTH / pixel)
        draw.line([(x, 0), (x, size[1])], fill=255, width=1)
    return image.rotate(skew, Image.Resampling.BICUBIC, expand=True, fillcolor=255)


def occupancy(folder, resolution=0.05, origin=(-3.0, -2.0, 0.0), name="map.pgm", **settings):
    """A map of ROS map_server in `folder`: free inside, occupied walls, unknown around. Returns the YAML file."""
    from PIL import Image, ImageDraw

    margin = 20
    size = (int(WIDTH / resolution) + 2 * margin, int(DEPTH / resolution) + 2 * margin)
    image = Image.new("L", size, 205)
    draw = ImageDraw.Draw(image)

    def fill(polygon, value):
        corners = shapely.get_coordinates(polygon.exterior)
        draw.polygon([(margin + x / resolution, size[1] - margin - y / resolution) for x, y in corners], fill=value)

    fill(shapely.box(0, 0, WIDTH, DEPTH), 0)
    for part in shapely.get_parts(shapely.union_all([corridor(), *room_boxes(), *openings()])):
        fill(part, 254)
        for hole in part.interiors:
            fill(shapely.Polygon(hole), 0)
    image.save(folder / name)
    lines = {"image": name, "resolution": resolution, "origin": list(origin), "negate": 0}
    lines |= {"occupied_thresh": 0.65, "free_thresh": 0.196} | settings
    (folder / "map.yaml").write_text("".join(f"{key}: {value}\n" for key, value in lines.items()))
    return folder / "map.yaml"


def pdf(path, scale=0.0353, frame=True):
    """A page with the walls as vector lines, and a frame around them; scale: metres a point."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width, height = (WIDTH + 4) / scale / 72, (DEPTH + 4) / scale / 72
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(-2, WIDTH + 2), ylim=(-2, DEPTH + 2))
    axes.axis("off")
    for line in segments(walls()):
        axes.plot(*line.T, color="black", lw=0.5)
    if frame:
        axes.plot(
            [-1.5, WIDTH + 1.5, WIDTH + 1.5, -1.5, -1.5], [-1.5, -1.5, DEPTH + 1.5, DEPTH + 1.5, -1.5], "k", lw=0.5
        )
    figure.savefig(path)


def file_bytes(write):
    """The bytes of the only file that `write(folder)` makes."""
    with TemporaryDirectory() as folder:
        write(Path(folder))
        (file,) = Path(folder).iterdir()
        return file.read_bytes()


def on_picture(points, pixel=0.02, skew=0.0, margin=40):
    """Pixels of points ``(n, 2)`` [m] in the picture of the same arguments."""
    size = np.array([int(WIDTH / pixel) + 2 * margin, int(DEPTH / pixel) + 2 * margin])
    flat = np.stack([margin + points[:, 0] / pixel, size[1] - margin - points[:, 1] / pixel], axis=1)
    cos, sin = np.cos(np.radians(skew)), np.sin(np.radians(skew))
    turned = picture(pixel, skew, margin=margin).size
    return (flat - size / 2) @ np.array([[cos, -sin], [sin, cos]]) + np.array(turned) / 2


def agreement(found, place=lambda points: points):
    """Shared area of a walkable area with the true one, as a share of their union.

    place: converts the building's coordinates ``(n, 2)`` to those of the plan that was found [m].
    """
    true, moved = shapely.transform(free(), place), found
    return shapely.area(shapely.intersection(true, moved)) / shapely.area(shapely.union(true, moved))
