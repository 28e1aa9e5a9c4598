"""``pdr-graph map``: commands that draw, check and convert floor plans."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from pdr_graph.apps.cli.options import PlanScale
from pdr_graph.apps.cli.terminal import App, echo
from pdr_graph.errors import EXIT_DEGRADED, count

maps = App(no_args_is_help=True, rich_markup_mode=None, help="Draw, check and convert floor plans.")
PlanPath = Annotated[
    Path, typer.Argument(metavar="PLAN", help="A floor plan of any format in docs/formats.md: a file, folder or zip.")
]


@maps.command("show")
def map_show(
    plan: PlanPath,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="PNG", help="Default: PLAN's name with .png, here.")
    ] = None,
    scale: PlanScale = None,
) -> None:
    """Draw a floor plan, all its floors side by side.

    \b
    pdr-graph map show plan.geojson --out plan.png
    """
    from pdr_graph.apps.report.plotting import picture_bytes, plot_plan
    from pdr_graph.floor.plan_files import FloorPlan
    from pdr_graph.whole_files import write_file

    floors = FloorPlan.load_all(plan, scale)
    target = out or Path(plan.resolve().stem + ".png")
    write_file(target, picture_bytes(plot_plan(*floors), dpi=150))
    for floor in floors:
        size = f"{len(floor.areas)} areas, {len(floor.cells)} cells, {floor.walkable_area:.0f} m² walkable"
        echo(f"{floor.label or plan.stem}: {size} -> {target}")


@maps.command("check")
def map_check(plan: PlanPath, scale: PlanScale = None) -> None:
    """Check a plan for errors that would mislead a walk.

    Sealed rooms, doors to nowhere, links through walls; exit code 3 if there are any.

    \b
    pdr-graph map check plan.geojson
    """
    _report_check(plan, scale)


@maps.command("convert")
def map_convert(
    plan: Annotated[
        Path,
        typer.Argument(metavar="INPUT", help="A plan in any format: DXF, CSV, PDF, PNG, JPEG, ROS map, GeoJSON ..."),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="GEOJSON", help="Default: INPUT's name with .geojson, here.")
    ] = None,
    scale: PlanScale = None,
    two_points: Annotated[
        str | None,
        typer.Option("--two-points", metavar="POINTS", help='The scale by a distance: "x1,y1 x2,y2 = METRES".'),
    ] = None,
    georeference: Annotated[
        str | None,
        typer.Option("--georeference", metavar="POINTS", help='Two points or more: "x,y=lat,lon x,y=lat,lon".'),
    ] = None,
    floor: Annotated[str | None, typer.Option("--floor", metavar="LABEL", help="The label of the only floor.")] = None,
) -> None:
    """Convert a plan to GeoJSON, draw and check it.

    Points are in INPUT's own coordinates: units of a drawing, pixels of a picture from its upper
    left corner, points of a PDF page. Without a georeference the result is in metres along
    INPUT's own axes. Exit code 3 if the check finds problems.

    \b
    pdr-graph map convert floor.dxf --out plan.geojson
    pdr-graph map convert scan.png --two-points "120,80 920,80 = 24.5"
    """
    from pdr_graph.apps.report.plotting import picture_bytes, plot_conversion
    from pdr_graph.floor.formats.conversion import convert
    from pdr_graph.floor.plan_files import FloorPlan
    from pdr_graph.whole_files import write_file

    target = out or Path(plan.resolve().stem + ".geojson")
    drawing = convert(plan, target, scale, two_points, georeference, floor)
    picture = _picture_beside(target, plan)
    write_file(picture, picture_bytes(plot_conversion(drawing.ignored, *FloorPlan.of(plan, drawing)), dpi=150))
    frame = "longitude and latitude" if drawing.frame.georeferenced else "metres along the drawing's own axes"
    for note in drawing.notes:
        echo(f"note: {note}")
    echo(f"-> {target} ({frame}), {picture}")
    _report_check(target)


def _picture_beside(target: Path, plan: Path) -> Path:
    """The PNG beside a conversion's GeoJSON, of another name if that is a file of the input."""
    from pdr_graph.floor.plan_files import files_of

    picture = target.with_suffix(".png")
    is_input = picture.resolve() in {file.resolve() for file in files_of(plan)}
    return target.with_name(f"{target.stem}-plan.png") if is_input else picture


def _report_check(plan: Path, scale: float | None = None) -> None:
    """Print notes, floors, connections and problems of a plan; exit with EXIT_DEGRADED if there are problems."""
    from pdr_graph.floor.check import problems
    from pdr_graph.floor.plan_files import Building

    building = Building.load(plan, scale)
    for note in building.floors[0].notes:
        echo(f"note: {note}")
    for floor in building.floors:
        kinds = Counter(area.kind for area in floor.areas)
        drawn = ", ".join(count(n, kind) for kind, n in sorted(kinds.items()))
        height = f"at {floor.height:g} m, " if len(building.floors) > 1 else ""
        echo(f"{floor.label or plan.stem}: {height}{floor.walkable_area:.0f} m² walkable; {drawn}")
    for connection in building.connections:
        joined = ", ".join(building.labels[n] for n in connection.floors)
        echo(f"{connection.kind} {connection.name}".strip() + f": {joined}")
    errors = problems(building)
    for problem in errors:
        echo(f"problem: {problem}")
    if errors:
        raise typer.Exit(EXIT_DEGRADED)
    echo("no problems found")
