"""The scenarios that come with the package, each known by its name."""

from __future__ import annotations

from pathlib import Path

from pdr_graph.errors import InputError

PACKAGE = Path(__file__).parents[1]
HOMES = (PACKAGE / "scenarios", PACKAGE.parent / "scenarios")  # of what was installed; of a checkout


def names() -> tuple[str, ...]:
    """Of all of them, in order."""
    return tuple(sorted({file.stem for home in HOMES for file in home.glob("*.toml")}))


def scenario_file(given: str | Path) -> Path:
    """The file of a scenario: a path as it is, or the one that comes along under that name.

    Raises InputError if it is neither.
    """
    path = Path(given)
    if path.is_file():
        return path
    for home in HOMES:
        if (home / f"{given}.toml").is_file():
            return home / f"{given}.toml"
    found = "a folder" if path.is_dir() else "no such file"
    raise InputError(path, "", found, f"a scenario's TOML file, or one of {', '.join(names())}")
