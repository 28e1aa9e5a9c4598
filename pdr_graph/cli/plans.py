"""``pdr-graph map``: commands that draw and check floor plans."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from pdr_graph.errors import EXIT_DEGRADED

maps = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Draw and check floor plans.")
PlanPath = Annotated[
    Path, typer.Argument(metavar="PLAN", help="GeoJSON of this project, a Microsoft floor folder, or IPIN21 polygons.")
]


@maps.command("show")
def map_show(
    plan: PlanPath,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="PNG", help="Default: PLAN's name with .png, here.")
    ] = None,
) -> None:
    """Draw a floor plan, all its floors side by side.

    \b
    pdr-graph map show plan.geojson --out plan.png
    """
    from pdr_graph.floor.plan import FloorPlan
    from pdr_graph.plotting import plot_plan

    floors = FloorPlan.load_all(plan)
    target = out or Path(plan.resolve().stem + ".png")
    plot_plan(*floors).savefig(target, dpi=150)
    for floor in floors:
        size = f"{len(floor.areas)} areas, {len(floor.cells)} cells, {floor.walkable_area:.0f} m² walkable"
        typer.echo(f"{floor.label or plan.stem}: {size} -> {target}")


@maps.command("check")
def map_check(plan: PlanPath) -> None:
    """Check a plan for errors that would mislead a walk.

    Sealed rooms, doors to nowhere, links through walls; exit code 3 if there are any.

    \b
    pdr-graph map check plan.geojson
    """
    from pdr_graph.floor.building import Building
    from pdr_graph.floor.check import problems

    building = Building.load(plan)
    for note in building.floors[0].notes:
        typer.echo(f"note: {note}")
    for floor in building.floors:
        kinds = Counter(area.kind for area in floor.areas)
        drawn = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
        height = f"at {floor.height:g} m, " if len(building.floors) > 1 else ""
        typer.echo(f"{floor.label or plan.stem}: {height}{floor.walkable_area:.0f} m² walkable; {drawn}")
    for connection in building.connections:
        joined = ", ".join(building.labels[n] for n in connection.floors)
        typer.echo(f"{connection.kind} {connection.name}".strip() + f": {joined}")
    errors = problems(building)
    for problem in errors:
        typer.echo(f"problem: {problem}")
    if errors:
        raise typer.Exit(EXIT_DEGRADED)
    typer.echo("no problems found")
